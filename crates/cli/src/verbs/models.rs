//! Networks trained by others: what is looked for, what is there.

use crate::args::ModelsArgs;
use crate::error::{CliError, Done};

#[cfg(feature = "nets")]
pub(crate) fn run(args: &ModelsArgs) -> Done {
    use use3d_build::machine::bytes;
    use use3d_nets::models::Verdict;

    use crate::interrupt;

    let dir = args.dir.clone().unwrap_or_else(|| "models".into());
    if args.dir.is_some() && !dir.is_dir() {
        let what = "there is no such folder; make it and put the files in, or name another one";
        return Err(CliError::Input(format!("--dir {}: {what}", dir.display())));
    }
    let go_on = || !interrupt::requested();
    let status = use3d_nets::Models::open(&dir).status_while(&go_on).map_err(CliError::input)?;
    let status = status.ok_or(CliError::Stopped)?;
    if args.json {
        return crate::verbs::run::json(&status);
    }
    let absent = if dir.is_dir() { "" } else { " (not there; name yours with --dir or USE3D_MODELS)" };
    println!("models folder: {}{absent}\n", dir.display());
    for row in &status {
        let (mark, file) = match &row.found {
            Some(found) => {
                let verdict = match &found.verdict {
                    Verdict::Official => "official".to_string(),
                    Verdict::Unknown => "digest not published".to_string(),
                    Verdict::Different { expected } => format!("NOT the official file (expected {expected})"),
                };
                ("found  ", format!("{} ({verdict}, sha256 {})", found.path.display(), &found.sha256[..16]))
            }
            None => ("missing", format!("put {} here", row.known.files.join(" or "))),
        };
        println!("{mark}  {:<28} {}", row.known.title, row.known.used_for);
        println!("         {file}");
        let size = bytes(row.known.bytes);
        println!("         {size}, {}, {}\n", row.known.licence, row.known.origin);
    }
    println!("Nothing is ever downloaded by this program.");
    Ok(())
}

#[cfg(not(feature = "nets"))]
pub(crate) fn run(_: &ModelsArgs) -> Done {
    Err(CliError::Input("this program was built without networks (cargo feature `nets`)".into()))
}
