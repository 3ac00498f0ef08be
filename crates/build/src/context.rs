//! What a stage's function is given: inputs by role, a folder to fill, and nothing that its result may not
//! depend on.

use std::any::Any;
use std::collections::BTreeMap;
use std::fmt::Display;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use use3d_capture::name::shown_lines;

use super::error::StageError;
use super::events::{Event, Listener};
use super::pulse::Progress;
use super::{machine, memory};

/// One input as a stage sees it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StageInput {
    /// What it is for.
    pub role: String,
    /// The file or folder; to be read only.
    pub path: PathBuf,
    /// In a stage over all scenes: the scene it comes from, else empty.
    pub scene: String,
    /// The scene's group, else empty.
    pub group: String,
    /// The variant it comes from, else empty.
    pub variant: String,
}

/// What a stage's function is given.
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
    /// Share of the work found done in checkpoints, in millionths.
    pub(crate) resumed: AtomicU64,
    /// What is kept beside the artifact; none where nothing keeps it.
    pub(crate) notes: Option<Mutex<Notes>>,
    /// How far the work is, for those who look at its lease.
    pub(crate) reached: Arc<Progress>,
}

/// What a stage measured that does not follow from its inputs, such as times: by name, kept in the manifest
/// beside the duration, and no part of the artifact or its digest.
pub type Notes = BTreeMap<String, serde_json::Value>;

impl StageContext {
    /// The input of a role.
    pub fn input(&self, role: &str) -> Result<&Path, StageError> {
        self.optional_input(role).ok_or_else(|| {
            let have: Vec<&str> = self.inputs.iter().map(|i| i.role.as_str()).collect();
            StageError::message(format!("{} has no input `{role}`; it has: {}", self.label, have.join(", ")))
        })
    }

    /// The input of a role, where there is one.
    pub fn optional_input(&self, role: &str) -> Option<&Path> {
        self.inputs.iter().find(|i| i.role == role).map(|i| i.path.as_path())
    }

    /// All inputs; in a stage over all scenes, one of each role per scene and variant, in the pipeline's
    /// order.
    pub fn inputs(&self) -> &[StageInput] {
        &self.inputs
    }

    /// In a stage over all scenes: which inputs could not be made, in words.
    pub fn missing(&self) -> &[String] {
        &self.missing
    }

    /// The empty folder to fill. Everything in it becomes the artifact; only bytes that follow from the
    /// inputs, parameters and seed belong there (no times, no host names, no absolute paths).
    pub fn output(&self) -> &Path {
        &self.output
    }

    /// Where a resumable stage keeps its checkpoints. Another run may have left some, possibly beyond the
    /// length asked for now, and another process may write the same ones at the same time: names should
    /// say the step, and files appear by renaming.
    pub fn checkpoints(&self) -> Option<&Path> {
        self.checkpoints.as_deref()
    }

    /// The seed of every random draw of the stage: the pipeline's, or the variant's where it has its own. All
    /// stages take it as it is (draws are told apart by their purpose), so one number moves everything. 0
    /// for a stage that did not say it draws random numbers.
    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// Threads to use. The function already runs inside a rayon pool of this size.
    pub fn threads(&self) -> usize {
        self.threads
    }

    /// Whether to stop: save a checkpoint and return [`StageError::Cancelled`].
    pub fn cancelled(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    /// The flag behind [`cancelled`](Self::cancelled), for loops that take one.
    pub fn stop_flag(&self) -> Arc<AtomicBool> {
        self.stop.clone()
    }

    /// Returns [`StageError::Cancelled`] when asked to stop: `context.alive()?` in loops.
    pub fn alive(&self) -> Result<(), StageError> {
        if self.cancelled() { Err(StageError::Cancelled) } else { Ok(()) }
    }

    /// Reports how far the work is, e.g. `progress(300, 15_000, "steps")`.
    pub fn progress(&self, done: u64, total: u64, unit: &str) {
        self.progress_with(done, total, unit, "");
    }

    /// As [`progress`](Self::progress), with a few words such as the present loss.
    pub fn progress_with(&self, done: u64, total: u64, unit: &str, message: &str) {
        self.progress_left(done, total, unit, message, None);
    }

    /// As [`progress_with`](Self::progress_with), for work of which the stage knows how many seconds are
    /// left.
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

    /// Tells a step's numbers by name, for who draws curves.
    pub fn figures(&self, step: u64, steps: u64, figures: &[(&str, f64)]) {
        self.listener.event(&Event::Figures { label: &self.label, step, steps, figures });
    }

    /// Whether somebody wants to see what the stage is making. To look at only: nothing may depend on it.
    pub fn wants_view(&self) -> bool {
        let wanted = AtomicBool::new(false);
        self.listener.event(&Event::AsksForView { label: &self.label, wanted: &wanted });
        wanted.into_inner()
    }

    /// Shows what the stage is making, as it stands.
    pub fn view(&self, view: &Arc<dyn Any + Send + Sync>) {
        self.listener.event(&Event::View { label: &self.label, inputs: &self.inputs, view });
    }

    /// Says that `done` of `total` steps were found in a checkpoint, so that the time taken is not mistaken
    /// for the whole.
    pub fn resumed(&self, done: u64, total: u64) {
        let share = if total == 0 { 0.0 } else { done as f64 / total as f64 };
        self.resumed.store((share.clamp(0.0, 1.0) * 1e6) as u64, Ordering::Relaxed);
        self.log(format_args!("going on from step {done} of {total}"));
    }

    /// Says before the work what memory it takes: refuses what cannot even begin here, and tells the user
    /// when it may end for want of memory. `start` and `most` are bytes, at the start and at the most;
    /// `lower` says in words what makes it less.
    ///
    /// # Errors
    /// `start` is more than this process may still take.
    pub fn needs_memory(&self, start: u64, most: u64, lower: &str) -> Result<(), StageError> {
        let Some(free) = machine::available_memory() else { return Ok(()) };
        if let Some(notice) = memory::judge(free, start, most, lower).map_err(StageError::message)? {
            self.say(notice);
        }
        Ok(())
    }

    /// Writes a line to the stage's log.
    pub fn log(&self, line: impl Display) {
        self.log.line(&line.to_string());
    }

    /// Writes a line to the log and tells the user at once.
    pub fn say(&self, line: impl Display) {
        let line = line.to_string();
        self.log.line(&line);
        self.listener.event(&Event::Note { label: &self.label, text: &line });
    }

    /// Whether [`note`](Self::note) is heard: not where a stage is run by hand, or again to verify it.
    pub fn keeps_notes(&self) -> bool {
        self.notes.is_some()
    }

    /// Keeps a measurement beside the artifact, where it changes neither bytes nor keys. Whoever shows
    /// results may add it.
    pub fn note(&self, name: &str, value: &impl serde::Serialize) {
        if let (Some(notes), Ok(value)) = (&self.notes, serde_json::to_value(value)) {
            notes.lock().unwrap_or_else(PoisonError::into_inner).insert(name.to_string(), value);
        }
    }

    /// What was noted.
    pub(crate) fn take_notes(&self) -> Notes {
        let take =
            |notes: &Mutex<Notes>| std::mem::take(&mut *notes.lock().unwrap_or_else(PoisonError::into_inner));
        self.notes.as_ref().map(take).unwrap_or_default()
    }

    /// Writes to the log where the time went, and tells those who ask.
    pub fn profile(&self, table: &str) {
        self.log.line(table);
        self.listener.event(&Event::Profile { label: &self.label, text: table });
    }

    /// The stage's log as a writer.
    pub fn log_writer(&self) -> impl Write + Send + use<> {
        LogWriter { log: self.log.clone(), rest: Vec::new() }
    }
}

/// A stage's log: lines with the seconds since its start. Losing a line is no reason to lose the work.
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
        let mut sink = self.sink.lock().unwrap_or_else(PoisonError::into_inner);
        // A log is read on terminals, and quotes what files say.
        let _ = writeln!(sink, "{:>9.2} {}", self.start.elapsed().as_secs_f64(), shown_lines(line));
    }
}

struct LogWriter {
    log: Log,
    rest: Vec<u8>,
}

impl Write for LogWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.rest.extend_from_slice(bytes);
        while let Some(end) = self.rest.iter().position(|b| *b == b'\n') {
            let line: Vec<u8> = self.rest.drain(..=end).collect();
            self.log.line(String::from_utf8_lossy(&line[..end]).as_ref());
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Drop for LogWriter {
    fn drop(&mut self) {
        if !self.rest.is_empty() {
            self.log.line(String::from_utf8_lossy(&self.rest).as_ref());
        }
    }
}
