//! What the builder tells while it works; the command line draws it.

use std::any::Any;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use super::context::StageInput;
use super::digest::Digest;
use super::run::RanNode;

/// Something that happened.
#[derive(Clone, Copy, Debug)]
pub enum Event<'a> {
    /// A stage starts.
    Started {
        /// The node in the graph.
        node: usize,
        /// BatchScene, variant and stage in words.
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
        /// BatchScene, variant and stage in words.
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
    /// Numbers of a step, by name, for curves. Told after every step; whoever
    /// holds this up holds up the stage.
    Figures {
        /// BatchScene, variant and stage in words.
        label: &'a str,
        /// Steps done.
        step: u64,
        /// Steps in all.
        steps: u64,
        /// Name and value.
        figures: &'a [(&'a str, f64)],
    },
    /// A stage asks whether somebody wants to see what it is making; who does raises the flag.
    AsksForView {
        /// BatchScene, variant and stage in words.
        label: &'a str,
        /// Raised by who wants to see it.
        wanted: &'a AtomicBool,
    },
    /// What a stage is making, as it stands: a copy, of a type that the stage says.
    View {
        /// BatchScene, variant and stage in words.
        label: &'a str,
        /// What it is made from.
        inputs: &'a [StageInput],
        /// What it is.
        view: &'a Arc<dyn Any + Send + Sync>,
    },
    /// Another process computes the same thing; this one does something else meanwhile, or waits for it. Told
    /// once.
    Waiting {
        /// The node in the graph.
        node: usize,
        /// BatchScene, variant and stage in words.
        label: &'a str,
        /// Who.
        holder: &'a str,
    },
    /// A stage is finished.
    Done {
        /// The node in the graph.
        node: usize,
        /// BatchScene, variant and stage in words.
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
        /// Its nodes as they stand now.
        nodes: &'a [RanNode],
    },
    /// A stage failed.
    Failed {
        /// The node in the graph.
        node: usize,
        /// BatchScene, variant and stage in words.
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
    /// Something is wrong, and the builder goes on: a damaged artifact, a determinism alarm.
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
