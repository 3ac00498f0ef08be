//! The stages: each a pure function from artifacts and parameters to one artifact.
//!
//! ```text
//! import ─┬───────────────▶ reconstruct ─┬─▶ targets ─▶ enhance ─┬─▶ render ──┐
//! depth ──┘                              │      ▲                └─▶ evaluate ├─▶ report
//! pairs ─▶ calibrate ────────────────────┴──────┘                             ┘
//! ```
//!
//! For comparison, `propose` can stand before `reconstruct`, which then learns from photographs enhanced one by one; `targets`
//! and `enhance` are left out then. `pairs` and `calibrate` are made once for all scenes, and not at all where every scene is given a
//! finished calibrator; `report` once from everything.

mod calibrate;
mod calibrator;
mod common;
mod contact;
#[cfg(feature = "nets")]
mod depth;
mod enhance;
pub mod evaluate;
mod import;
mod pairs;
mod propose;
mod proposer;
mod reconstruct;
mod render;
pub mod report;
mod targets;

pub use calibrate::CALIBRATOR;
pub use common::{read_json, write_json};
#[cfg(feature = "nets")]
pub use depth::wanted as depth_wanted;
pub use proposer::{ProposerChoice, open as open_proposer};
pub use targets::TARGETS;

use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::engine::{EngineError, Registry};

/// The table of stages with the short words of the pipeline file.
pub fn registry() -> Result<Registry, EngineError> {
    let stages = vec![
        import::stage(),
        #[cfg(feature = "nets")]
        depth::stage(),
        pairs::stage(),
        calibrate::stage(),
        propose::stage(),
        reconstruct::stage(),
        targets::stage(),
        enhance::stage(),
        render::stage(),
        evaluate::stage(),
        report::stage(),
    ];
    Ok(Registry::new(stages)?
        .shorthand("scene", "size", "import", "size")
        .shorthand("calibrator", "proposer", "pairs", "proposer")
        .shorthand("calibrator", "proposer", "targets", "proposer")
        .shorthand("calibrator", "steps", "calibrate", "steps"))
}

#[cfg(feature = "nets")]
use use3d_nets::{Models, Network};

/// The files in a models folder that a proposer reads, relative to it.
fn proposer_files(models: &Path) -> Vec<PathBuf> {
    #[cfg(feature = "nets")]
    return model_files(models, &[Network::Nu2NetReleased, Network::Nu2Net]);
    #[cfg(not(feature = "nets"))]
    no_files(models)
}

/// The files in a models folder that the proposer of these parameters reads, relative to it; says what to put there where it is asked
/// for by name and its weights are not there.
fn files_of_proposer(parameters: &Value, models: &Path) -> Result<Vec<PathBuf>, String> {
    if parameters["proposer"] == "fusion" {
        return Ok(Vec::new());
    }
    let files = proposer_files(models);
    #[cfg(feature = "nets")]
    if files.is_empty() && parameters["proposer"] == "nu2net" {
        return Err(not_there("Nu2Net", &[Network::Nu2NetReleased, Network::Nu2Net], models));
    }
    Ok(files)
}

/// Weights that are asked for and not there: which files would do.
#[cfg(feature = "nets")]
fn not_there(what: &str, networks: &[Network], models: &Path) -> String {
    let files: Vec<&str> = networks.iter().map(|network| network.known().files[0]).collect();
    format!(
        "the weights of {what} are not in {}: put {} there (`use3d models` says where it is published)",
        models.display(),
        files.join(" or ")
    )
}

/// The files in a models folder that the evaluation reads, relative to it.
fn judge_files(models: &Path) -> Vec<PathBuf> {
    #[cfg(feature = "nets")]
    return model_files(
        models,
        &[
            Network::Nu2NetReleased,
            Network::Nu2Net,
            Network::LpipsHeads,
            Network::AlexNet,
            Network::RaftLarge,
            Network::URanker,
            Network::Musiq,
        ],
    );
    #[cfg(not(feature = "nets"))]
    no_files(models)
}

/// The files of some networks that are in a models folder, relative to it.
#[cfg(feature = "nets")]
fn model_files(models: &Path, networks: &[Network]) -> Vec<PathBuf> {
    let folder = Models::open(models);
    let found = networks.iter().filter_map(|n| folder.find(*n));
    found.filter_map(|path| path.strip_prefix(models).ok().map(Path::to_path_buf)).collect()
}

/// A build without networks reads no model files.
#[cfg(not(feature = "nets"))]
fn no_files(_: &Path) -> Vec<PathBuf> {
    Vec::new()
}
