//! The builder's events during a run; the command line displays them.

use std::any::Any;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use crate::stage::inputs::StageInput;
use crate::stage::result::RanNode;
use use3d_code::digest::Digest;

/// An event of a run.
#[derive(Clone, Copy, Debug)]
pub enum Event<'a> {
    /// A stage starts.
    Started {
        /// The node in the graph.
        node: usize,
        /// Scene, variant and stage, for display.
        label: &'a str,
        /// The stage's work, for display.
        about: &'a str,
        /// Its key.
        key: Digest,
        /// Number of its threads.
        threads: usize,
    },
    /// Progress of a stage.
    Progress {
        /// The node in the graph.
        node: usize,
        /// Scene, variant and stage, for display.
        label: &'a str,
        /// Work done.
        done: u64,
        /// Total work.
        total: u64,
        /// The unit of the work.
        unit: &'a str,
        /// A short text, or empty.
        message: &'a str,
        /// Seconds left, if the stage can estimate them.
        seconds_left: Option<f64>,
    },
    /// Progress of all stages of a run together, from a listener that computes it. 100 % ends the display.
    WholeRun {
        /// Share of the time that has passed, 0 to 100.
        percent: u64,
        /// Seconds since the start of the run.
        seconds: f64,
        /// Seconds left.
        seconds_left: f64,
    },
    /// The number of stages that are over, and of all stages that a run has to compute, from a listener that
    /// counts them. Sent before the event of the stage's end.
    Counted {
        /// Stages that are done or failed.
        done: usize,
        /// All stages.
        total: usize,
    },
    /// Numbers of a step, by name, for curves. Sent after every step; a slow listener slows down the stage.
    Figures {
        /// Scene, variant and stage, for display.
        label: &'a str,
        /// Steps done.
        step: u64,
        /// Total number of steps.
        steps: u64,
        /// Name and value.
        figures: &'a [(&'a str, f64)],
    },
    /// A stage checks if a listener wants a view of its unfinished result; such a listener sets the flag.
    AsksForView {
        /// Scene, variant and stage, for display.
        label: &'a str,
        /// The flag; a listener that wants a view sets it to true.
        wanted: &'a AtomicBool,
    },
    /// A view of a stage's unfinished result: a copy, of a type that the stage defines.
    View {
        /// Scene, variant and stage, for display.
        label: &'a str,
        /// The inputs of the stage.
        inputs: &'a [StageInput],
        /// The view.
        view: &'a Arc<dyn Any + Send + Sync>,
    },
    /// Another process computes the same node; this process works on other nodes meanwhile, or waits for it.
    /// Sent once.
    Waiting {
        /// The node in the graph.
        node: usize,
        /// Scene, variant and stage, for display.
        label: &'a str,
        /// The other process, for display.
        holder: &'a str,
    },
    /// A stage is finished.
    Done {
        /// The node in the graph.
        node: usize,
        /// Scene, variant and stage, for display.
        label: &'a str,
        /// True if the artifact was in the cache already.
        cached: bool,
        /// Duration in seconds.
        seconds: f64,
    },
    /// All stages of a scene are done or failed; other scenes of the batch may still run for long.
    SceneOver {
        /// The scene.
        scene: &'a str,
        /// The variant; empty where there are none.
        variant: &'a str,
        /// The nodes of the scene, and the shared ones of its variant, with their present states.
        nodes: &'a [RanNode],
    },
    /// A stage failed.
    Failed {
        /// The node in the graph.
        node: usize,
        /// Scene, variant and stage, for display.
        label: &'a str,
        /// The reason.
        reason: &'a str,
        /// The path of its log.
        log: &'a Path,
    },
    /// A message for the user.
    Note {
        /// The subject of the message.
        label: &'a str,
        /// The message.
        text: &'a str,
    },
    /// A message with technical details, for display on request.
    Detail {
        /// The subject of the message.
        label: &'a str,
        /// The message.
        text: &'a str,
    },
    /// The table of time per part of a stage, for display on request; no part of any artifact.
    Profile {
        /// The subject of the table.
        label: &'a str,
        /// A table.
        text: &'a str,
    },
    /// A problem that does not stop the builder: a damaged artifact, a determinism alarm.
    Warning {
        /// The subject of the warning.
        label: &'a str,
        /// The warning.
        text: &'a str,
    },
}

/// A receiver of events; several threads call it.
pub trait Listener: Send + Sync {
    /// Handles an event.
    fn event(&self, event: &Event<'_>);
}

/// Ignores all events.
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
