//! The result of one node of a run, for events and summaries.

use std::path::PathBuf;
use std::sync::Arc;

use serde::Serialize;

use crate::cache::artifacts::Artifact;
use crate::stage::parameters::Parameters;

/// The result of a node.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(rename_all = "lowercase", tag = "result", content = "detail")]
pub enum NodeResult {
    /// Computed in this run.
    Done,
    /// Found in the cache.
    Cached,
    /// Failed.
    Failed {
        /// The reason.
        reason: String,
        /// Its log.
        log: PathBuf,
        /// True if its inputs are the reason, and not its own work.
        #[serde(skip)]
        bad_input: bool,
    },
    /// Not run because another node failed; the text names that node.
    Blocked(String),
    /// Not run because the run ended before it.
    NotRun,
    /// Missing, in a run that computes only stages over the whole batch.
    Missing,
    /// Left to another process, which computes it or its inputs, or left to the next submission, because it
    /// failed or was killed in another task of this one; the text names the process or the task.
    Elsewhere(String),
    /// Not requested.
    Unwanted,
}

/// A node of a summary.
#[derive(Clone, Debug, Serialize)]
pub struct RanNode {
    /// The stage.
    pub stage: &'static str,
    /// The scene; empty for stages over all scenes.
    pub scene: String,
    /// The variant; empty where there are none.
    pub variant: String,
    /// Scene, variant and stage, for display.
    pub label: String,
    /// Its result.
    #[serde(flatten)]
    pub result: NodeResult,
    /// Duration in seconds.
    pub seconds: f64,
    /// True if another node did its work.
    pub shared: bool,
    /// Its parameters, defaults filled in.
    #[serde(skip)]
    pub parameters: Parameters,
    /// The folder of its result among a scene's results.
    #[serde(skip)]
    pub delivered: Option<&'static str>,
    /// The name of the preset below its parameters; empty for none.
    #[serde(skip)]
    pub preset: String,
    /// The seed of its random draws.
    #[serde(skip)]
    pub seed: Option<u64>,
    /// The reason and the log of its failure in an earlier run, if it is missing now.
    #[serde(skip)]
    pub failure: Option<(String, PathBuf)>,
    /// Its artifact.
    #[serde(skip)]
    pub artifact: Option<Arc<Artifact>>,
}
