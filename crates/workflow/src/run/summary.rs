//! The result of a run, node by node.

use std::sync::Arc;

use serde::Serialize;

use crate::cache::artifacts::Artifact;
use crate::share::lease::RunLease;
pub use crate::stage::result::{NodeResult, RanNode};

/// The result of a batch.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// The pipeline's name.
    pub pipeline: String,
    /// The nodes, inputs first.
    pub nodes: Vec<RanNode>,
    /// True if it was interrupted.
    pub interrupted: bool,
    /// True if it ended for lack of time and another run can continue it.
    pub left: bool,
    /// Duration in seconds.
    pub seconds: f64,
    /// Protects the artifacts of the summary from being cleaned up while it is used.
    #[serde(skip)]
    #[expect(dead_code, reason = "held until the summary goes, never read")]
    pub(crate) lease: Option<Arc<RunLease>>,
}

impl Summary {
    /// A summary of nodes that have already run.
    pub fn of_nodes(nodes: Vec<RanNode>) -> Self {
        Self { pipeline: String::new(), nodes, interrupted: false, left: false, seconds: 0.0, lease: None }
    }

    /// The present results of one scene in one variant, for use before the batch ends.
    pub fn of_scene(nodes: &[RanNode], scene: &str, variant: &str) -> Self {
        // A result for all scenes also belongs to this scene.
        let own = nodes.iter().filter(|n| n.variant == variant && (n.scene == scene || n.scene.is_empty()));
        Self::of_nodes(own.cloned().collect())
    }

    /// The exit code: 0 if all is done or left to other processes, 1 if something failed, 75 if the time was
    /// over (the same command continues the work), 130 if it was interrupted.
    pub fn exit_code(&self) -> u8 {
        let any = |bad: fn(&NodeResult) -> bool| self.nodes.iter().any(|n| bad(&n.result));
        if self.left && any(|r| matches!(r, NodeResult::NotRun)) {
            return 75;
        }
        if self.interrupted && !self.left {
            return 130;
        }
        use NodeResult::{Blocked, Failed, Missing, NotRun};
        u8::from(any(|r| matches!(r, Failed { .. } | Blocked(_) | NotRun | Missing)))
    }

    /// Number of nodes that were left to other processes.
    pub fn elsewhere(&self) -> usize {
        self.count(|r| matches!(r, NodeResult::Elsewhere(_)))
    }

    /// The nodes that are missing and were not requested.
    pub fn missing(&self) -> impl Iterator<Item = &RanNode> {
        self.nodes.iter().filter(|n| !n.shared && n.result == NodeResult::Missing)
    }

    /// Number of nodes that were computed in this run.
    pub fn done(&self) -> usize {
        self.count(|r| *r == NodeResult::Done)
    }

    /// Number of nodes that were found in the cache.
    pub fn cached(&self) -> usize {
        self.count(|r| *r == NodeResult::Cached)
    }

    /// The nodes that failed.
    pub fn failed(&self) -> impl Iterator<Item = &RanNode> {
        self.nodes.iter().filter(|n| !n.shared && matches!(n.result, NodeResult::Failed { .. }))
    }

    /// The artifact of a stage of a scene (empty for stages over all scenes) in a variant (empty: the first).
    pub fn artifact(&self, scene: &str, variant: &str, stage: &str) -> Option<&Artifact> {
        let fits = |n: &&RanNode| {
            n.stage == stage
                && (n.scene.is_empty() || n.scene == scene)
                && (variant.is_empty() || n.variant.is_empty() || n.variant == variant)
        };
        self.nodes.iter().find(fits).and_then(|n| n.artifact.as_deref())
    }

    pub(crate) fn count(&self, which: impl Fn(&NodeResult) -> bool) -> usize {
        self.nodes.iter().filter(|n| !n.shared && which(&n.result)).count()
    }
}
