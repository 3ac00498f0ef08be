//! What became of a run, node by node.

use std::path::PathBuf;
use std::sync::Arc;

use serde::Serialize;

use super::cache::Artifact;
use super::lease::RunLease;

/// What became of a node.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(rename_all = "lowercase", tag = "result", content = "detail")]
pub enum Became {
    /// Computed now.
    Done,
    /// There already.
    Cached,
    /// Failed.
    Failed {
        /// Why.
        reason: String,
        /// Its log.
        log: PathBuf,
    },
    /// Not run because another node failed: which.
    Blocked(String),
    /// Not run because the run ended before.
    NotRun,
    /// Left to another process, which computes it or what it needs: who, in words.
    Elsewhere(String),
    /// Nobody asked for it.
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
    /// BatchScene, variant and stage in words.
    pub label: String,
    /// What became of it.
    #[serde(flatten)]
    pub result: Became,
    /// How long it took, seconds.
    pub seconds: f64,
    /// Whether another node did its work.
    pub shared: bool,
    /// Its parameters, defaults filled in.
    #[serde(skip)]
    pub parameters: serde_json::Value,
    /// The name of the preset below its parameters; empty for none.
    #[serde(skip)]
    pub preset: String,
    /// The seed that it draws from.
    #[serde(skip)]
    pub seed: Option<u64>,
    /// Its artifact.
    #[serde(skip)]
    pub artifact: Option<Artifact>,
}

/// What became of a batch.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// The pipeline's name.
    pub pipeline: String,
    /// The nodes, inputs first.
    pub nodes: Vec<RanNode>,
    /// Whether it was interrupted.
    pub interrupted: bool,
    /// Whether it left for want of time, with work for another one.
    pub left: bool,
    /// How long it took, seconds.
    pub seconds: f64,
    /// Keeps others from cleaning up what the summary points to while it is being used.
    #[serde(skip)]
    #[expect(dead_code, reason = "held until the summary goes, never read")]
    pub(super) lease: Option<Arc<RunLease>>,
}

impl Summary {
    /// What is known of one scene in one variant, for who wants its results before the batch ends.
    pub fn of_scene(nodes: &[RanNode], scene: &str, variant: &str) -> Self {
        // A result for all scenes is part of this scene's history, too.
        let own = nodes.iter().filter(|n| n.variant == variant && (n.scene == scene || n.scene.is_empty()));
        Self {
            pipeline: String::new(),
            nodes: own.cloned().collect(),
            interrupted: false,
            left: false,
            seconds: 0.0,
            lease: None,
        }
    }

    /// 0 all done (or in the hands of others), 1 something failed, 75 out of time: the same again goes on,
    /// 130 interrupted.
    pub fn exit_code(&self) -> u8 {
        let any = |bad: fn(&Became) -> bool| self.nodes.iter().any(|n| bad(&n.result));
        if self.left && any(|r| matches!(r, Became::NotRun)) {
            return 75;
        }
        if self.interrupted && !self.left {
            return 130;
        }
        u8::from(any(|r| matches!(r, Became::Failed { .. } | Became::Blocked(_) | Became::NotRun)))
    }

    /// How many nodes were left to other processes.
    pub fn elsewhere(&self) -> usize {
        self.count(|r| matches!(r, Became::Elsewhere(_)))
    }

    /// How many nodes were computed now.
    pub fn done(&self) -> usize {
        self.count(|r| *r == Became::Done)
    }

    /// How many were there already.
    pub fn cached(&self) -> usize {
        self.count(|r| *r == Became::Cached)
    }

    /// The nodes that failed.
    pub fn failed(&self) -> impl Iterator<Item = &RanNode> {
        self.nodes.iter().filter(|n| !n.shared && matches!(n.result, Became::Failed { .. }))
    }

    /// The artifact of a stage of a scene (empty for stages over all scenes) in a variant (empty: the first).
    pub fn artifact(&self, scene: &str, variant: &str, stage: &str) -> Option<&Artifact> {
        let fits = |n: &&RanNode| {
            n.stage == stage
                && (n.scene.is_empty() || n.scene == scene)
                && (variant.is_empty() || n.variant.is_empty() || n.variant == variant)
        };
        self.nodes.iter().find(fits).and_then(|n| n.artifact.as_ref())
    }

    pub(crate) fn count(&self, which: impl Fn(&Became) -> bool) -> usize {
        self.nodes.iter().filter(|n| !n.shared && which(&n.result)).count()
    }
}
