//! What the engine tells while it works; the command line draws it.

use std::path::Path;

use super::digest::Digest;
use super::run::RanNode;

/// Something that happened.
#[derive(Clone, Copy, Debug)]
pub enum Event<'a> {
    /// A stage starts.
    Started {
        /// The node in the graph.
        node: usize,
        /// Scene, variant and stage in words.
        label: &'a str,
        /// Its key.
        key: Digest,
        /// Threads it was given.
        threads: usize,
    },
    /// A stage is this far.
    Progress {
        /// The node in the graph.
        node: usize,
        /// Scene, variant and stage in words.
        label: &'a str,
        /// Work done.
        done: u64,
        /// Work in all.
        total: u64,
        /// What is counted.
        unit: &'a str,
        /// A few words, or nothing.
        message: &'a str,
        /// Seconds left, where the stage knows.
        seconds_left: Option<f64>,
    },
    /// Another process computes the same thing; this one waits for it.
    Waiting {
        /// The node in the graph.
        node: usize,
        /// Scene, variant and stage in words.
        label: &'a str,
        /// Who.
        holder: &'a str,
    },
    /// A stage is finished.
    Done {
        /// The node in the graph.
        node: usize,
        /// Scene, variant and stage in words.
        label: &'a str,
        /// Whether it was there already.
        cached: bool,
        /// How long it took, seconds.
        seconds: f64,
    },
    /// All stages of a scene are over, done or failed; the batch may go on for long.
    SceneOver {
        /// The scene.
        scene: &'a str,
        /// The variant; empty where there are none.
        variant: &'a str,
        /// All nodes of the run as they stand now.
        nodes: &'a [RanNode],
    },
    /// A stage failed.
    Failed {
        /// The node in the graph.
        node: usize,
        /// Scene, variant and stage in words.
        label: &'a str,
        /// Why.
        reason: &'a str,
        /// Where its log is.
        log: &'a Path,
    },
    /// Something the user should know.
    Note {
        /// What it is about.
        label: &'a str,
        /// What.
        text: &'a str,
    },
    /// Where a stage's time went, for those who ask; no part of any artifact.
    Profile {
        /// What it is about.
        label: &'a str,
        /// A table.
        text: &'a str,
    },
    /// Something is wrong, and the engine goes on: a damaged artifact, a determinism alarm.
    Warning {
        /// What it is about.
        label: &'a str,
        /// What.
        text: &'a str,
    },
}

/// Is told what happens, from several threads.
pub trait Listener: Send + Sync {
    /// Something happened.
    fn event(&self, event: &Event<'_>);
}

/// Listens to nothing.
#[derive(Clone, Copy, Debug, Default)]
pub struct Silent;

impl Listener for Silent {
    fn event(&self, _: &Event<'_>) {}
}

impl<F: Fn(&Event<'_>) + Send + Sync> Listener for F {
    fn event(&self, event: &Event<'_>) {
        self(event);
    }
}
