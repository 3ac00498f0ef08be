//! Networks trained by others: the files that are searched for, and those found.

use use3d_nets::Network;

use crate::args::ModelsArgs;
use crate::error::{Done, WorkError};

pub(crate) fn run(args: &ModelsArgs) -> Done {
    use use3d_nets::models::DigestCheck;
    use use3d_workflow::machine::bytes;

    use crate::interrupt;

    let dir = args.dir.clone().unwrap_or_else(|| "models".into());
    if args.dir.is_some() && !dir.is_dir() {
        let what = "there is no such folder; make it and put the files into it, or name another one";
        return Err(WorkError::Input(format!("--dir {}: {what}", dir.display())));
    }
    let go_on = || !interrupt::requested();
    let folder = use3d_nets::Models::open(&dir);
    let status = folder.status_while(&go_on).map_err(WorkError::input)?;
    let mut status = status.ok_or(WorkError::Stopped)?;
    let needed = args.preset.as_deref().map(needed_for).transpose()?;
    if let Some(needed) = &needed {
        status.retain(|row| needed.iter().any(|one| one.contains(&row.known.network)));
    }
    let there = |network: &Network| status.iter().any(|r| r.known.network == *network && r.found.is_some());
    let missing = needed.iter().flatten().filter(|one| !one.iter().any(there));
    let mut missing: Vec<&str> = missing.map(|one| one[0].known().title).collect();
    // The files of a preset are also opened: a run would refuse a damaged one.
    let unusable = |network: Network| needed.as_ref().and_then(|_| folder.check(network).err());
    let found = status.iter().filter(|row| row.found.is_some());
    missing.extend(found.filter(|row| unusable(row.known.network).is_some()).map(|row| row.known.title));
    let complete = || match (missing.is_empty(), &args.preset) {
        (false, Some(preset)) => Err(WorkError::Input(format!(
            "missing for the preset {preset}: {}; the list above says where to put each file",
            missing.join(", ")
        ))),
        _ => Ok(()),
    };
    if args.json {
        crate::output::json(&status)?;
        return complete();
    }
    let absent = if dir.is_dir() { "" } else { " (not there; name yours with --dir or USE3D_MODELS)" };
    println!("models folder: {}{absent}\n", dir.display());
    for row in &status {
        let (mark, file) = match &row.found {
            Some(found) => {
                let verdict = match &found.verdict {
                    DigestCheck::Official => "official".to_string(),
                    DigestCheck::Unknown => "digest not published".to_string(),
                    DigestCheck::Different { expected } => {
                        format!("NOT the official file (expected {expected})")
                    }
                };
                ("found  ", format!("{} ({verdict}, sha256 {})", found.path.display(), &found.sha256[..16]))
            }
            None => ("missing", format!("put {} here", row.known.files.join(" or "))),
        };
        println!("{mark}  {:<28} {}", row.known.title, row.known.used_for);
        println!("         {file}");
        if let Some(reason) = row.found.as_ref().and_then(|_| unusable(row.known.network)) {
            println!("         cannot be used: {reason}");
        }
        let size = bytes(row.known.bytes);
        println!("         {size}, {}, {}\n", row.known.licence, row.known.origin);
    }
    println!("Nothing is ever downloaded by this program.");
    complete()
}

/// The networks that a preset needs; one network of each inner list is enough.
fn needed_for(preset: &str) -> Result<Vec<Vec<Network>>, WorkError> {
    let values = use3d_config::preset_values(preset).map_err(WorkError::input)?;
    let said = |stage: &str, key: &str, value: &str| values.get(stage).is_some_and(|p| p[key] == value);
    let mut needed = Vec::new();
    if ["pairs", "propose", "targets", "evaluate"].iter().any(|stage| said(stage, "proposer", "nu2net")) {
        needed.push(vec![Network::Nu2NetReleased, Network::Nu2Net]);
    }
    if said("reconstruct", "depth_prior", "depth-anything-v2") {
        let sizes = [
            ("vitl", Network::DepthAnythingV2Large),
            ("vitb", Network::DepthAnythingV2Base),
            ("vits", Network::DepthAnythingV2Small),
        ];
        let named = sizes.iter().filter(|(name, _)| said("depth", "encoder", name));
        let named: Vec<Network> = named.map(|(_, network)| *network).collect();
        needed.push(if named.is_empty() { sizes.map(|(_, network)| network).to_vec() } else { named });
    }
    if said("evaluate", "scores", "all") {
        use Network::{AlexNet, LpipsHeads, Musiq, RaftLarge, URanker};
        needed.extend([LpipsHeads, AlexNet, RaftLarge, URanker, Musiq].map(|network| vec![network]));
    }
    Ok(needed)
}
