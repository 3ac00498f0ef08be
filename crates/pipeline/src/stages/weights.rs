//! The files of a models folder that a stage reads. Only these count in its key, not the other files there.

use std::path::{Path, PathBuf};

use serde_json::Value;

#[cfg(feature = "nets")]
use use3d_nets::{Models, Network};

/// The networks that have the weights of Nu2Net: one of them is enough.
#[cfg(feature = "nets")]
pub(super) const NU2NET: [Network; 2] = [Network::Nu2NetReleased, Network::Nu2Net];

/// The files in a models folder that a proposer reads, relative to it.
pub(super) fn proposer_files(models: &Path) -> Vec<PathBuf> {
    #[cfg(feature = "nets")]
    return model_files(models, &NU2NET);
    #[cfg(not(feature = "nets"))]
    no_files(models)
}

/// The files in a models folder that the proposer of these parameters reads, relative to it. If the
/// parameters name a proposer whose weights are missing, the error lists the files to put there.
pub(super) fn files_of_proposer(parameters: &Value, models: &Path) -> Result<Vec<PathBuf>, String> {
    if parameters["proposer"] == "fusion" {
        return Ok(Vec::new());
    }
    let files = proposer_files(models);
    #[cfg(feature = "nets")]
    if files.is_empty() && parameters["proposer"] == "nu2net" {
        return Err(not_there("Nu2Net", &NU2NET, models));
    }
    Ok(files)
}

/// The message for requested weights that are missing: it names the files that would do.
#[cfg(feature = "nets")]
pub(super) fn not_there(what: &str, networks: &[Network], models: &Path) -> String {
    let files: Vec<&str> = networks.iter().map(|network| network.known().files[0]).collect();
    format!(
        "the weights of {what} are not in {}: put {} there (`use3d models` says where it is published)",
        models.display(),
        files.join(" or ")
    )
}

/// The files in a models folder that the evaluation reads, relative to it.
pub(super) fn judge_files(models: &Path) -> Vec<PathBuf> {
    #[cfg(feature = "nets")]
    {
        use Network::{AlexNet, LpipsHeads, Musiq, RaftLarge, URanker};
        let [released, trained] = NU2NET;
        model_files(models, &[released, trained, LpipsHeads, AlexNet, RaftLarge, URanker, Musiq])
    }
    #[cfg(not(feature = "nets"))]
    no_files(models)
}

/// The files of some networks that are in a models folder, relative to it.
#[cfg(feature = "nets")]
pub(super) fn model_files(models: &Path, networks: &[Network]) -> Vec<PathBuf> {
    let folder = Models::open(models);
    let found = networks.iter().filter_map(|n| folder.find(*n));
    found.filter_map(|path| path.strip_prefix(models).ok().map(Path::to_path_buf)).collect()
}

/// A build without networks reads no model files.
#[cfg(not(feature = "nets"))]
fn no_files(_: &Path) -> Vec<PathBuf> {
    Vec::new()
}
