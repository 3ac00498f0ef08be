//! The files of a models folder that a stage reads. Only these count in its key, not the other files there.

use std::path::{Path, PathBuf};

use use3d_nets::{Models, Network};
use use3d_workflow::StageError;

use super::proposer::ProposerChoice;

/// The networks that have the weights of Nu2Net: one of them is enough.
pub(crate) const NU2NET: [Network; 2] = [Network::Nu2NetReleased, Network::Nu2Net];

/// The files in a models folder that a proposer reads, relative to it.
pub(crate) fn proposer_files(models: &Path) -> Vec<PathBuf> {
    model_files(models, &NU2NET)
}

/// The files in a models folder that a proposer of this choice reads, relative to it. If the
/// parameters name a proposer whose weights are missing, the error lists the files to put there.
pub(crate) fn files_of_proposer(choice: ProposerChoice, models: &Path) -> Result<Vec<PathBuf>, StageError> {
    if choice == ProposerChoice::Fusion {
        return Ok(Vec::new());
    }
    let files = proposer_files(models);
    if files.is_empty() && choice == ProposerChoice::Nu2net {
        return Err(MissingWeights::new("Nu2Net", &NU2NET, models).into());
    }
    Ok(files)
}

/// Requested weights that are missing.
#[derive(Debug, thiserror::Error)]
#[error("the weights of {what} are not in {}: put {} there (`use3d models` says where it is published)",
    models.display(), files.join(" or "))]
pub(crate) struct MissingWeights {
    what: &'static str,
    /// The files that would do.
    files: Vec<&'static str>,
    models: PathBuf,
}

impl MissingWeights {
    pub(crate) fn new(what: &'static str, networks: &[Network], models: &Path) -> Self {
        let files = networks.iter().map(|network| network.known().files[0]).collect();
        Self { what, files, models: models.to_path_buf() }
    }
}

/// The files in a models folder that the evaluation reads, relative to it.
pub(crate) fn judge_files(models: &Path) -> Vec<PathBuf> {
    use Network::{AlexNet, LpipsHeads, Musiq, RaftLarge, URanker};
    let [released, trained] = NU2NET;
    model_files(models, &[released, trained, LpipsHeads, AlexNet, RaftLarge, URanker, Musiq])
}

/// The files of some networks that are in a models folder, relative to it.
pub(crate) fn model_files(models: &Path, networks: &[Network]) -> Vec<PathBuf> {
    let folder = Models::open(models);
    let found = networks.iter().filter_map(|n| folder.find(*n));
    found.filter_map(|path| path.strip_prefix(models).ok().map(Path::to_path_buf)).collect()
}
