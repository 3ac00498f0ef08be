//! The scene that is shown now, and the commands for the training.
//!
//! This is the only state that both sides share. A training stores figures and copies of its scene, and
//! checks if it must wait. The page's requests read them and leave commands. All data is copied or shared for
//! reading: no training waits for a picture.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use use3d_scene::{Scene, White};
use use3d_web::{Page, PageData, PageView, SavedViews, WebError};

use crate::curve::Curve;

/// Shortest time between two copies of a scene that is trained.
const APART: Duration = Duration::from_secs(2);
/// Copying may take this share of the time until the next copy.
const COPYING: f64 = 0.01;
/// A page that sent no request for this long counts as closed.
const LOOKING: Duration = Duration::from_secs(10);
/// The default share of the machine's cores for drawing during a training.
const SHARE: f64 = 0.03;
/// The largest share that can be set.
const MOST_SHARE: f64 = 0.5;
/// Interval at which a waiting thread checks if it must stop.
const WAIT: Duration = Duration::from_millis(100);

/// A scene with the data that is shown with it.
#[derive(Clone, Debug)]
pub struct Shown {
    /// Its name.
    pub name: String,
    /// The scene.
    pub scene: Arc<Scene>,
    /// The views that a visitor can move to.
    pub views: Arc<Vec<PageView>>,
    /// Metres per unit of the COLMAP model, if that is known.
    pub metres_per_unit: Option<f64>,
    /// The views saved from an earlier page.
    pub saved: Option<Arc<SavedViews>>,
    /// The white balance that the page opens with.
    pub white: Option<Arc<White>>,
    /// Number of training steps so far; `None` for a scene that is not trained here.
    pub step: Option<u64>,
    /// True for the sparse points of a capture, which is no scene yet.
    pub points: bool,
}

impl Shown {
    /// A scene without metres, saved views and white balance.
    pub fn new(
        name: String,
        scene: impl Into<Arc<Scene>>,
        views: impl Into<Arc<Vec<PageView>>>,
        step: Option<u64>,
    ) -> Self {
        let (scene, views) = (scene.into(), views.into());
        Self { name, scene, views, metres_per_unit: None, saved: None, white: None, step, points: false }
    }

    fn page(&self) -> Page<'_> {
        Page {
            name: &self.name,
            scene: &self.scene,
            views: self.views.to_vec(),
            metres_per_unit: self.metres_per_unit,
            saved: self.saved.as_deref(),
            white: self.white.as_deref(),
        }
    }
}

#[derive(Debug, Default)]
struct LiveState {
    /// The thing that is waited for, or the result at the end.
    words: String,
    /// True while a training runs.
    training: bool,
    ended: bool,
    /// The stage and its scene.
    label: String,
    step: u64,
    steps: u64,
    figures: Vec<(String, f64)>,
    loss: Curve,
    psnr: Curve,
    held_out: Curve,
    shown: Option<Shown>,
    /// The page's data about the scene, without its pictures.
    header: Value,
    /// The data sent to the browser, if it draws the scene.
    data: Option<Arc<PageData>>,
    /// Changes with another scene or other views.
    generation: u64,
    /// Changes with every new state of the scene.
    version: u64,
    paused: bool,
    share: f64,
    looked: Option<Instant>,
    copied: Option<Instant>,
    copying: Duration,
}

impl LiveState {
    /// True if `shown` is another state of the scene that is shown now, so that it can replace it without
    /// reloading the page.
    fn continues(&self, shown: &Shown) -> bool {
        self.data.is_none()
            && self.shown.as_ref().is_some_and(|old| {
                old.name == shown.name
                    && Arc::ptr_eq(&old.views, &shown.views)
                    && old.scene.enhancement.is_some() == shown.scene.enhancement.is_some()
                    && old.scene.medium.kind() == shown.scene.medium.kind()
            })
    }
}

/// The scene that is shown, shared by a server and the producer of the scene.
#[derive(Debug)]
pub struct Live {
    state: Mutex<LiveState>,
    changed: Condvar,
    /// Set by the page's stop button or by another reason to stop the training; `None` if nothing can be
    /// paused or stopped.
    stop: Option<Arc<AtomicBool>>,
    cores: usize,
}

impl Live {
    /// Starts without a scene. `stop` is the flag that ends the training with a checkpoint; without it the
    /// page cannot pause or stop anything.
    pub fn new(words: &str, stop: Option<Arc<AtomicBool>>) -> Self {
        let state = LiveState { words: words.into(), share: SHARE, ..LiveState::default() };
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        Self { state: Mutex::new(state), changed: Condvar::new(), stop, cores }
    }

    fn state(&self) -> MutexGuard<'_, LiveState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sets the text that is shown until there is a scene.
    pub fn wait_for(&self, words: &str) {
        self.state().words = words.into();
    }

    /// Stores the numbers of a training step. Those of one stage make a curve; another stage that trains at
    /// the same time is not shown.
    pub fn figures(&self, label: &str, step: u64, steps: u64, figures: &[(&str, f64)]) {
        let mut state = self.state();
        if state.training && state.label != label {
            return;
        }
        if state.label != label {
            (state.loss, state.psnr, state.held_out) = Default::default();
            state.copied = None;
            state.label = label.into();
        }
        (state.training, state.step, state.steps) = (true, step, steps);
        state.figures = figures.iter().map(|(name, value)| ((*name).to_string(), *value)).collect();
        for (name, value) in figures {
            match *name {
                "loss" => state.loss.add(step, *value),
                "psnr" => state.psnr.add(step, *value),
                // The value comes with every step, but is measured only at few.
                "held-out psnr" if state.held_out.last() != Some(*value) => state.held_out.add(step, *value),
                _ => {}
            }
        }
    }

    /// Marks a stage as finished; another one may train.
    pub fn over(&self, label: &str) {
        let mut state = self.state();
        if state.label == label {
            state.training = false;
        }
    }

    /// Marks the whole run as finished, with a text on the result.
    pub fn end(&self, words: &str) {
        let mut state = self.state();
        (state.words, state.ended, state.training) = (words.into(), true, false);
    }

    /// Waits a moment so that an open page can fetch the result.
    pub fn let_them_know(&self) {
        // Between two stages a page sends a request every two seconds.
        const MOMENT: Duration = Duration::from_secs(4);
        let ended = Instant::now();
        let waits = |state: &LiveState| {
            let looked = state.looked.filter(|at| at.elapsed() < LOOKING);
            looked.is_some_and(|at| at < ended) && ended.elapsed() < MOMENT
        };
        while waits(&self.state()) {
            std::thread::sleep(WAIT);
        }
        // The answer is still being sent.
        if self.state().looked.is_some_and(|at| at >= ended) {
            std::thread::sleep(WAIT);
        }
    }

    /// True if a copy of the scene that this stage trains is wanted now: a page is open, and the last copy is
    /// old enough.
    pub fn wants_copy(&self, label: &str) -> bool {
        let mut state = self.state();
        if !state.training || state.label != label || state.looked.is_none_or(|at| at.elapsed() >= LOOKING) {
            return false;
        }
        let stale = state.shown.as_ref().is_none_or(|shown| shown.step != Some(state.step));
        let apart = APART.max(state.copying.div_f64(COPYING));
        let due = state.copied.is_none_or(|at| at.elapsed() >= apart) || state.paused && stale;
        if due {
            state.copied = Some(Instant::now());
        }
        due
    }

    /// Records that the requested copy was taken.
    pub fn copied(&self) {
        let mut state = self.state();
        state.copying = state.copied.map_or(Duration::ZERO, |at| at.elapsed());
    }

    /// Waits while the page has paused the training.
    pub fn hold(&self) {
        let Some(stop) = &self.stop else { return };
        let mut state = self.state();
        while state.paused && !stop.load(Ordering::Relaxed) {
            state = self.changed.wait_timeout(state, WAIT).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// The current step of the stage that is shown.
    pub fn step(&self) -> u64 {
        self.state().step
    }

    /// Shows a scene from now on, drawn by this program.
    pub fn show(&self, shown: Shown) {
        let mut header = None;
        loop {
            let state = self.state();
            // The header is also valid for another state of the same scene; another thread may have shown a
            // different scene while the header was made.
            if header.is_some() || state.continues(&shown) {
                return self.put(state, shown, header, None);
            }
            drop(state);
            header = Some(use3d_web::header(&shown.page()));
        }
    }

    /// Shows a scene that does not change, drawn in the browser.
    ///
    /// # Errors
    /// Fails for a scene without Gaussians.
    pub fn hand_over(&self, shown: Shown) -> Result<(), WebError> {
        let data = use3d_web::data(&shown.page())?;
        let header = data.header.clone();
        self.put(self.state(), shown, Some(header), Some(Arc::new(data)));
        Ok(())
    }

    fn put(
        &self,
        mut state: MutexGuard<'_, LiveState>,
        shown: Shown,
        header: Option<Value>,
        data: Option<Arc<PageData>>,
    ) {
        if let Some(header) = header {
            state.header = header;
            state.header["points"] = shown.points.into();
            state.generation += 1;
        }
        state.version += 1;
        (state.shown, state.data) = (Some(shown), data);
        self.changed.notify_all();
    }

    /// Sets the share of the machine's cores that drawing may use during a training, in `(0, ½]`.
    pub fn set_share(&self, share: f64) {
        if share.is_finite() {
            self.state().share = share.clamp(0.001, MOST_SHARE);
        }
    }

    /// Executes a command of the page; false if it is unknown or not possible.
    pub(crate) fn command(&self, name: &str, share: Option<f64>) -> bool {
        let Some(stop) = &self.stop else { return false };
        match name {
            "pause" => self.state().paused = true,
            "resume" => self.state().paused = false,
            "stop" => {
                stop.store(true, Ordering::Relaxed);
                self.state().paused = false;
            }
            "share" => match share {
                Some(share) => self.set_share(share),
                None => return false,
            },
            _ => return false,
        }
        self.changed.notify_all();
        true
    }

    /// Records that a page sent a request.
    pub(crate) fn looked(&self) {
        self.state().looked = Some(Instant::now());
    }

    /// The scene that is shown, with its version.
    pub(crate) fn shown(&self) -> Option<(Shown, u64)> {
        let state = self.state();
        state.shown.clone().map(|shown| (shown, state.version))
    }

    /// The version of the scene that is shown.
    pub(crate) fn version(&self) -> u64 {
        self.state().version
    }

    /// The time to rest after a drawing that took one thread for `took`; `None` if no training runs.
    pub(crate) fn rest(&self, took: Duration) -> Option<Duration> {
        let state = self.state();
        let beside = state.training && !state.paused;
        beside.then(|| took.mul_f64((1.0 / (state.share * self.cores as f64) - 1.0).max(0.0)))
    }

    /// The data with which a page starts.
    pub(crate) fn beginning(&self) -> Value {
        let state = self.state();
        if state.shown.is_none() {
            return json!({ "waiting": state.words });
        }
        json!({ "generation": state.generation, "header": state.header, "drawn": if state.data.is_some() { "browser" } else { "server" } })
    }

    /// A section of a scene that the browser draws.
    pub(crate) fn section(&self, name: &str) -> Option<Vec<u8>> {
        let data = self.state().data.clone()?;
        data.sections.iter().find(|(section, _)| *section == name).map(|(_, bytes)| bytes.clone())
    }

    /// The status for the page.
    pub(crate) fn status(&self) -> Value {
        let state = self.state();
        let figure =
            |name: &str| state.figures.iter().find(|(known, _)| known == name).map(|(_, value)| value);
        json!({
            "generation": state.generation,
            "version": state.version,
            "shownStep": state.shown.as_ref().and_then(|shown| shown.step),
            "words": state.words,
            "training": state.training,
            "ended": state.ended,
            "label": state.label,
            "step": state.step,
            "steps": state.steps,
            "loss": figure("loss"),
            "psnr": figure("psnr"),
            "heldOutPsnr": figure("held-out psnr"),
            "gaussians": figure("gaussians"),
            "secondsLeft": figure("seconds left"),
            "curves": { "loss": state.loss.json(), "psnr": state.psnr.json(), "heldOut": state.held_out.json() },
            "controls": self.stop.is_some(),
            "paused": state.paused,
            "stopping": self.stop.as_ref().is_some_and(|stop| stop.load(Ordering::Relaxed)),
            "share": state.share,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn copies_are_taken_while_somebody_looks_and_not_often() {
        let live = Live::new("", Some(Arc::default()));
        live.figures("reef", 1, 10, &[("loss", 0.5)]);
        assert!(!live.wants_copy("reef"), "nobody looks");
        let start = Instant::now();
        live.looked();
        assert!(!live.wants_copy("other"), "another stage is not shown");
        assert!(live.wants_copy("reef"));
        live.copied();
        // On a machine that stalled for longer than the minimum time between copies, this proves nothing.
        assert!(!live.wants_copy("reef") || start.elapsed() >= APART, "just taken");
        // After a pause, the page gets the step at which the training waits.
        assert!(live.command("pause", None) && live.wants_copy("reef"));
        assert_eq!(live.rest(Duration::from_millis(10)), None, "nothing to be slowed while it is paused");
    }

    #[test]
    fn drawing_beside_a_training_keeps_to_its_share() {
        let live = Live { cores: 2, ..Live::new("", Some(Arc::default())) };
        let took = Duration::from_millis(30);
        assert_eq!(live.rest(took), None);
        live.figures("reef", 1, 10, &[]);
        // One thread of two cores: 30 ms in half a second are 3 % of the machine.
        assert_eq!(live.rest(took), Some(Duration::from_millis(470)));
        assert!(live.command("share", Some(0.5)) && live.rest(took) == Some(Duration::ZERO));
        live.over("reef");
        assert_eq!(live.rest(took), None);
    }

    #[test]
    fn a_paused_training_goes_on_when_it_is_resumed_or_stopped() {
        let stop = Arc::new(AtomicBool::new(false));
        let live = Arc::new(Live::new("", Some(stop.clone())));
        for command in ["resume", "stop"] {
            assert!(live.command("pause", None));
            let held = {
                let live = live.clone();
                std::thread::spawn(move || live.hold())
            };
            assert!(live.command(command, None));
            held.join().unwrap();
        }
        assert!(stop.load(Ordering::Relaxed) && !live.command("format", None));
        assert!(!Live::new("", None).command("stop", None), "nothing to stop");
    }
}
