//! The data that a stage's function gets: inputs by role and a folder to fill. It holds nothing that the
//! result must not depend on.

use std::any::Any;
use std::fmt::Display;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Instant;

use use3d_capture::name::shown_lines;

use crate::cache::manifest::Notes;
use crate::cache::{lock, machine, memory};
use crate::error::StageError;
use crate::share::pulse::Progress;
use crate::stage::events::{Event, Listener};
use crate::stage::inputs::StageInput;

/// The data that a stage's function gets.
pub struct StageContext {
    pub(crate) inputs: Vec<StageInput>,
    pub(crate) missing: Vec<String>,
    pub(crate) output: PathBuf,
    pub(crate) checkpoints: Option<PathBuf>,
    pub(crate) seed: u64,
    pub(crate) threads: usize,
    pub(crate) stop: Arc<AtomicBool>,
    pub(crate) node: usize,
    pub(crate) label: String,
    pub(crate) listener: Arc<dyn Listener>,
    pub(crate) log: Log,
    /// Share of the work that was found done in checkpoints, in millionths.
    pub(crate) resumed: AtomicU64,
    /// Notes that are kept beside the artifact; `None` where nothing keeps them.
    pub(crate) notes: Option<Mutex<Notes>>,
    /// Progress of the work, for other processes that read its lease.
    pub(crate) reached: Arc<Progress>,
}

impl StageContext {
    /// The input of a role.
    pub fn input(&self, role: &str) -> Result<&Path, StageError> {
        self.optional_input(role).ok_or_else(|| {
            let have: Vec<&str> = self.inputs.iter().map(|i| i.role.as_str()).collect();
            StageError::message(format!("{} has no input `{role}`; it has: {}", self.label, have.join(", ")))
        })
    }

    /// The input of a role, or `None`.
    pub fn optional_input(&self, role: &str) -> Option<&Path> {
        self.inputs.iter().find(|i| i.role == role).map(|i| i.path.as_path())
    }

    /// All inputs; in a stage over all scenes, one of each role per scene and variant, in the pipeline's
    /// order.
    pub fn inputs(&self) -> &[StageInput] {
        &self.inputs
    }

    /// The inputs that could not be made, as text; in a stage over all scenes.
    pub fn missing(&self) -> &[String] {
        &self.missing
    }

    /// The empty folder to fill. Everything in it becomes the artifact; only bytes that follow from the
    /// inputs, parameters and seed belong there (no times, no host names, no absolute paths).
    pub fn output(&self) -> &Path {
        &self.output
    }

    /// The folder for the checkpoints of a resumable stage. Another run may have left some, possibly beyond
    /// the length of this run, and another process may write the same ones at the same time. So names should
    /// contain the step, and files should appear by renaming.
    pub fn checkpoints(&self) -> Option<&Path> {
        self.checkpoints.as_deref()
    }

    /// The seed of every random draw of the stage: the pipeline's, or the variant's where it has its own. All
    /// stages use it unchanged (the purpose of a draw tells draws apart), so one number changes all draws. It
    /// is 0 for a stage that does not declare random draws.
    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// Threads to use. The function already runs inside a rayon pool of this size.
    pub fn threads(&self) -> usize {
        self.threads
    }

    /// Returns true if the stage must stop: save a checkpoint and return [`StageError::Cancelled`].
    pub fn cancelled(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    /// Is set when the stage must stop, for work that watches it itself.
    pub fn stop(&self) -> &AtomicBool {
        &self.stop
    }

    /// Returns [`StageError::Cancelled`] if the stage must stop: `context.alive()?` in loops.
    pub fn alive(&self) -> Result<(), StageError> {
        if self.cancelled() { Err(StageError::Cancelled) } else { Ok(()) }
    }

    /// Reports the progress of the work, e.g. `progress(300, 15_000, "steps")`.
    pub fn progress(&self, done: u64, total: u64, unit: &str) {
        self.progress_with(done, total, unit, "");
    }

    /// Like [`progress`](Self::progress), with a short text such as the present loss.
    pub fn progress_with(&self, done: u64, total: u64, unit: &str, message: &str) {
        self.progress_left(done, total, unit, message, None);
    }

    /// Like [`progress_with`](Self::progress_with), for work whose remaining seconds the stage can estimate.
    pub fn progress_left(&self, done: u64, total: u64, unit: &str, message: &str, seconds_left: Option<f64>) {
        self.reached.note(done, total, unit);
        self.listener.event(&Event::Progress {
            node: self.node,
            label: &self.label,
            done,
            total,
            unit,
            message,
            seconds_left,
        });
    }

    /// Reports a step's numbers by name, for drawing curves.
    pub fn figures(&self, step: u64, steps: u64, figures: &[(&str, f64)]) {
        self.listener.event(&Event::Figures { label: &self.label, step, steps, figures });
    }

    /// Returns true if a listener wants a view of the unfinished result. It is for display: the result must
    /// not depend on it.
    pub fn wants_view(&self) -> bool {
        let wanted = AtomicBool::new(false);
        self.listener.event(&Event::AsksForView { label: &self.label, wanted: &wanted });
        wanted.into_inner()
    }

    /// Sends a view of the unfinished result to the listeners.
    pub fn view(&self, view: &Arc<dyn Any + Send + Sync>) {
        self.listener.event(&Event::View { label: &self.label, inputs: &self.inputs, view });
    }

    /// Records that `done` of `total` steps were found in a checkpoint, so that the measured time is not
    /// taken for the whole.
    pub fn resumed(&self, done: u64, total: u64) {
        let share = if total == 0 { 0.0 } else { done as f64 / total as f64 };
        self.resumed.store((share.clamp(0.0, 1.0) * 1e6) as u64, Ordering::Relaxed);
        self.log(format_args!("resuming from step {done} of {total}"));
    }

    /// Checks before the work that there is enough memory: fails if the work cannot even start here, and
    /// shows a message if it may run out of memory later. `start` and `most` are bytes, at the start and at
    /// the most; `lower` is the text that says how to need less.
    ///
    /// # Errors
    /// Fails if `start` is more than this process may still take.
    pub fn needs_memory(&self, start: u64, most: u64, lower: &str) -> Result<(), StageError> {
        let Some(free) = machine::available_memory() else { return Ok(()) };
        if let Some(notice) = memory::judge(free, start, most, lower)? {
            self.say(notice);
        }
        Ok(())
    }

    /// Writes a line to the stage's log.
    pub fn log(&self, line: impl Display) {
        self.log.line(&line.to_string());
    }

    /// Writes a line to the log and shows it to the user at once.
    pub fn say(&self, line: impl Display) {
        let line = line.to_string();
        self.log.line(&line);
        self.listener.event(&Event::Note { label: &self.label, text: &line });
    }

    /// Writes a line to the log and shows it to a user who asks for details.
    pub fn detail(&self, line: impl Display) {
        let line = line.to_string();
        self.log.line(&line);
        self.listener.event(&Event::Detail { label: &self.label, text: &line });
    }

    /// Returns true if [`note`](Self::note) keeps notes: not where a stage is run by hand, or again to verify
    /// it.
    pub fn keeps_notes(&self) -> bool {
        self.notes.is_some()
    }

    /// Keeps a measurement beside the artifact, where it changes neither bytes nor keys. Pages that show
    /// the results may include it.
    pub fn note(&self, name: &str, value: &impl serde::Serialize) {
        if let (Some(notes), Ok(value)) = (&self.notes, serde_json::to_value(value)) {
            lock(notes).insert(name.to_string(), value);
        }
    }

    /// Returns the notes and clears them.
    pub(crate) fn take_notes(&self) -> Notes {
        self.notes.as_ref().map(|notes| std::mem::take(&mut *lock(notes))).unwrap_or_default()
    }

    /// Writes the table of time per part to the log and sends it to the listeners.
    pub fn profile(&self, table: &str) {
        self.log.line(table);
        self.listener.event(&Event::Profile { label: &self.label, text: table });
    }
}

/// A stage's log: lines with the seconds since its start. A line that cannot be written is dropped, and the
/// work continues.
#[derive(Clone)]
pub(crate) struct Log {
    sink: Arc<Mutex<Box<dyn Write + Send>>>,
    start: Instant,
}

impl Log {
    pub(crate) fn new(sink: Box<dyn Write + Send>) -> Self {
        Self { sink: Arc::new(Mutex::new(sink)), start: Instant::now() }
    }

    pub(crate) fn line(&self, line: &str) {
        // People read logs on terminals, and lines may quote file contents: control characters are escaped.
        let _ =
            writeln!(lock(&self.sink), "{:>9.2} {}", self.start.elapsed().as_secs_f64(), shown_lines(line));
    }
}
