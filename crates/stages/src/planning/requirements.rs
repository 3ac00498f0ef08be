//! Requirements that several stages have, checked before anything runs: the weights of networks, and files
//! that the pipeline names.
//!
//! They decide whether a run begins, never a result. Captures are not among them: a missing capture fails
//! only its own scene, and the others run.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};
use std::time::SystemTime;

use use3d_nets::{Models, Network};
use use3d_workflow::{AllParameters, Lacking, Named};

use crate::parts::proposer::ProposerChoice;
use crate::parts::target_params;
use crate::parts::weights::NU2NET;

pub(crate) fn lacking(
    what: impl Into<String>,
    remedy: impl Into<String>,
    without: impl Into<String>,
) -> Lacking {
    Lacking { what: what.into(), remedy: remedy.into(), without: without.into() }
}

/// The setting that uses the classical enhancer in place of Nu2Net.
fn without_nu2net(all: &AllParameters, stage: &str) -> String {
    // A proposer that is set for the targets applies to the other stages, too.
    let by_targets = all.of::<target_params::Params>().is_some_and(|p| p.proposer == ProposerChoice::Nu2net);
    format!("--set {}.proposer=fusion", if by_targets { "targets" } else { stage })
}

/// Nu2Net's weights if a stage's proposer is the network and they are missing, or if they are there for
/// `auto` and cannot be used.
pub(crate) fn weights(
    all: &AllParameters,
    named: &Named,
    (stage, proposer): (&str, ProposerChoice),
) -> Option<Lacking> {
    match proposer {
        ProposerChoice::Nu2net => nu2net(all, named, stage),
        ProposerChoice::Auto => nu2net(all, named, stage).filter(|_| has_nu2net(named)),
        _ => None,
    }
}

fn has_nu2net(named: &Named) -> bool {
    folder(named).is_some_and(|folder| NU2NET.iter().any(|network| folder.has(*network)))
}

/// The models folder, if it exists.
fn folder(named: &Named) -> Option<Models> {
    named.path("models").filter(|dir| dir.is_dir()).map(Models::open)
}

pub(crate) fn nu2net(all: &AllParameters, named: &Named, stage: &str) -> Option<Lacking> {
    let what = "the weights of Nu2Net, the 2D enhancer of the paper";
    network(named, what, &NU2NET, &without_nu2net(all, stage))
}

/// The reason why the file of a network cannot be used. A file is checked once, for all scenes, until it
/// changes.
fn unusable(folder: &Models, network: Network) -> Option<String> {
    type File = (PathBuf, u64, Option<SystemTime>);
    static CHECKED: Mutex<BTreeMap<File, Option<String>>> = Mutex::new(BTreeMap::new());
    let path = folder.find(network)?;
    let metadata = std::fs::metadata(&path).ok()?;
    let file = (path, metadata.len(), metadata.modified().ok());
    let mut checked = CHECKED.lock().unwrap_or_else(PoisonError::into_inner);
    let check = || folder.check(network).err().map(|error| error.to_string());
    checked.entry(file).or_insert_with(check).clone()
}

/// The missing weights of a network that is available in several files; `None` if one of them is present.
pub(crate) fn network(named: &Named, what: &str, networks: &[Network], without: &str) -> Option<Lacking> {
    if let Some(folder) = folder(named)
        && let Some(network) = networks.iter().find(|network| folder.has(**network))
    {
        return unusable(&folder, *network).map(|reason| {
            let origin = network.known().origin;
            let remedy = format!("{reason}; put the file there that is published at {origin}");
            lacking(format!("{what}, in a file that can be used"), remedy, without)
        });
    }
    let files = networks.iter().map(|network| network.known());
    let files = files.map(|k| format!("{} (published at {})", k.files[0], k.origin));
    let place = match named.path("models") {
        Some(dir) => format!("into {}", dir.display()),
        None => "into a folder, and name that with --models or USE3D_MODELS".into(),
    };
    let mut remedy = format!("put {} {place}", files.collect::<Vec<_>>().join(" or "));
    if let Some(reason) = named.problem("models") {
        remedy += &format!("; the models folder cannot be found: {reason}");
    }
    Some(lacking(what, remedy, without))
}

/// The reason why a named file cannot be used; `None` if it exists.
pub(crate) fn unfound(named: &Named, external: &str) -> Option<String> {
    let by = named.by(external);
    let by = if by.is_empty() { String::new() } else { format!(", named by {by}") };
    if let Some(reason) = named.problem(external) {
        return Some(format!("{reason}{by}"));
    }
    let path = named.path(external)?;
    let gone = || format!("{} does not exist{by}; correct the path or put the data there", path.display());
    (!path.exists()).then(gone)
}
