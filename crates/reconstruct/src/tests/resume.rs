//! Interrupted, longer and simultaneous runs produce the same bytes.

use std::borrow::Cow;

use use3d_training::{Drain, EngineError};

use super::*;
use crate::density::{Draws, Origin, Survey};
use crate::engine::StepReport;

/// An engine that does some steps and then loses its device: from then on every call fails.
struct Mortal {
    engine: CpuEngine,
    steps: u64,
}

impl Mortal {
    fn alive(&mut self) -> Result<&mut CpuEngine, EngineError> {
        if self.steps > 0 {
            return Ok(&mut self.engine);
        }
        Err(EngineError::DeviceLost { engine: "mortal", reason: "it was pulled out".into() })
    }
}

impl Engine for Mortal {
    fn upload(&mut self, view: TrainingView) -> Result<usize, EngineError> {
        self.alive()?.upload(view)
    }
    fn load(&mut self, state: TrainingState) -> Result<(), EngineError> {
        self.alive()?.load(state)
    }
    fn save(&mut self) -> Result<Cow<'_, TrainingState>, EngineError> {
        self.alive()?.save()
    }
    fn step(&mut self, view: usize, plan: &StepPlan) -> Result<(), EngineError> {
        self.alive()?.step(view, plan)?;
        self.steps -= 1;
        Ok(())
    }
    fn drain(&mut self, which: Drain) -> Result<Vec<StepReport>, EngineError> {
        self.alive()?.drain(which)
    }
    fn survey(&mut self) -> Result<Survey, EngineError> {
        self.alive()?.survey()
    }
    fn forget_statistics(&mut self) -> Result<(), EngineError> {
        self.alive()?.forget_statistics()
    }
    fn rebuild(&mut self, rows: &[Origin], draws: &Draws) -> Result<(), EngineError> {
        self.alive()?.rebuild(rows, draws)
    }
    fn limit_opacity(&mut self, ceiling: f64) -> Result<(), EngineError> {
        self.alive()?.limit_opacity(ceiling)
    }
    fn forget_water_moments(&mut self) -> Result<(), EngineError> {
        self.alive()?.forget_water_moments()
    }
    fn render(&mut self, camera: &Camera, degrees: Degrees, out: &mut Image) -> Result<(), EngineError> {
        self.alive()?.render(camera, degrees, out)
    }
}

#[test]
fn a_lost_device_ends_the_run_with_a_word_and_its_checkpoints_are_gone_on_from() {
    let (capture, loaded) = tiny_capture(6);
    let params = ReconstructParams { checkpoint_steps: 8, ..tiny_params(40) };
    let dir = tempfile::tempdir().unwrap();
    let mut mortal = Mortal { engine: CpuEngine::default(), steps: 27 };
    let known = Known::default();
    let (place, loader) = (Some(dir.path()), loader(&loaded));
    let mut told = StoppingObserver::default();
    let lost = crate::reconstruct(&capture, &known, &loader, &params, &mut mortal, place, &mut told);
    let said = lost.map(|_| ()).unwrap_err().to_string();
    assert!(said.ends_with("lost its device (it was pulled out)"), "{said}");
    assert!(told.notices.iter().any(|n| n.contains("is kept; run the same command")), "{:?}", told.notices);
    let mut watcher = StoppingObserver::default();
    let resumed = reconstruct(&capture, &loader, &params, place, &mut watcher).unwrap();
    let from = watcher.notices.iter().find(|notice| notice.contains("resuming from step"));
    assert!(from.is_some_and(|notice| notice.contains("step 2") || notice.contains("step 1")), "{from:?}");
    assert!(same(
        &reconstruct(&capture, &loader, &params, None, &mut StoppingObserver::default()).unwrap(),
        &resumed
    ));
}

#[test]
fn the_same_scene_on_any_number_of_threads_and_after_any_interruption() {
    let (capture, loaded) = tiny_capture(7);
    let params = ReconstructParams { checkpoint_steps: 8, schedule: 60, ..tiny_params(60) };
    let on = |threads: usize, dir: Option<&std::path::Path>, observer: &mut StoppingObserver| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let work = || reconstruct(&capture, &loader(&loaded), &params, dir, observer);
        pool.install(work)
    };
    let whole = on(1, None, &mut StoppingObserver::default()).unwrap();
    assert!(
        same(&whole, &on(3, None, &mut StoppingObserver::default()).unwrap()),
        "threads change the scene"
    );

    let dir = tempfile::tempdir().unwrap();
    // The observer requests a stop: the state of exactly that step is saved.
    let stopped =
        on(2, Some(dir.path()), &mut StoppingObserver { stop_at: Some(27), ..StoppingObserver::default() });
    assert!(matches!(stopped, Err(ReconstructError::Interrupted { step: 27, steps: 60, saved: true })));
    // The run is killed: the next run continues from the last checkpoint.
    let killed = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
        on(1, Some(dir.path()), &mut StoppingObserver { panic_at: Some(46), ..StoppingObserver::default() })
    }));
    assert!(killed.is_err());
    let mut watcher = StoppingObserver::default();
    let resumed = on(2, Some(dir.path()), &mut watcher).unwrap();
    assert!(watcher.notices.iter().any(|n| n.contains("resuming from step 43")), "{:?}", watcher.notices);
    assert!(same(&whole, &resumed), "interruptions change the scene");
    // A finished run is not repeated.
    assert!(same(
        &whole,
        &on(1, Some(dir.path()), &mut StoppingObserver { panic_at: Some(1), ..StoppingObserver::default() })
            .unwrap()
    ));

    // Twenty more steps cost twenty steps, with the same result as an uninterrupted longer run.
    let longer = ReconstructParams { iterations: 80, ..params.clone() };
    let run_longer = |dir: Option<&std::path::Path>, observer: &mut StoppingObserver| {
        reconstruct(&capture, &loader(&loaded), &longer, dir, observer).unwrap()
    };
    let mut watcher = StoppingObserver::default();
    let extended = run_longer(Some(dir.path()), &mut watcher);
    assert!(watcher.notices.iter().any(|n| n.contains("resuming from step 60")), "{:?}", watcher.notices);
    assert!(
        same(&run_longer(None, &mut StoppingObserver::default()), &extended),
        "extending changes the scene"
    );

    // Checkpoints of other parameters, and damaged ones, are not touched, and a notice is given.
    let other = ReconstructParams { seed: 7, iterations: 90, ..params.clone() };
    let mut watcher = StoppingObserver::default();
    reconstruct(&capture, &loader(&loaded), &other, Some(dir.path()), &mut watcher).unwrap();
    assert!(watcher.notices.iter().any(|n| n.contains("other parameters")), "{:?}", watcher.notices);
    let files = |dir: &std::path::Path| -> Vec<_> {
        std::fs::read_dir(dir).unwrap().map(|entry| entry.unwrap().path()).collect()
    };
    assert_eq!(files(dir.path()).len(), 3, "one of each run");
    for file in files(dir.path()) {
        std::fs::write(file, b"3d-use state v01 nonsense").unwrap();
    }
    let mut watcher = StoppingObserver::default();
    reconstruct(&capture, &loader(&loaded), &other, Some(dir.path()), &mut watcher).unwrap();
    assert!(
        watcher.notices.iter().any(|n| n.contains("starting from the beginning")),
        "{:?}",
        watcher.notices
    );
}

#[test]
fn every_rule_of_growth_gives_the_same_scene_on_any_number_of_threads_and_after_an_interruption() {
    let (capture, loaded) = tiny_capture(7);
    let mut params = ReconstructParams { checkpoint_steps: 8, schedule: 100, ..tiny_params(100) };
    params.densify = crate::Densify {
        split: crate::density::Children::LongAxis,
        candidates: crate::Candidates::Error,
        views: 3,
        budget: 500,
        split_floor: 0.6,
        until: 0.7,
        ..params.densify
    };
    let on = |threads: usize, dir: Option<&std::path::Path>, stop_at: Option<u64>| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let mut observer = StoppingObserver { stop_at, ..StoppingObserver::default() };
        pool.install(|| reconstruct(&capture, &loader(&loaded), &params, dir, &mut observer))
    };
    let whole = on(1, None, None).unwrap();
    assert!(same(&whole, &on(3, None, None).unwrap()), "threads change the scene");
    let counts: Vec<usize> = whole
        .log
        .iter()
        .filter_map(|e| if let LogEntry::Refine { gaussians, .. } = e { Some(*gaussians) } else { None })
        .collect();
    assert!(counts.iter().max() > Some(&300), "{counts:?}");
    let dir = tempfile::tempdir().unwrap();
    // In growth, and after it.
    for step in [47, 83] {
        assert!(on(2, Some(dir.path()), Some(step)).is_err());
    }
    assert!(same(&whole, &on(2, Some(dir.path()), None).unwrap()), "interruptions change the scene");
}

#[test]
fn going_on_from_the_end_of_a_shorter_run_leaves_no_trace_of_that_end() {
    let (capture, loaded) = tiny_capture(6);
    // The shorter run ends between two lines of the log, and on a step at which a longer one is evaluated.
    let params = |iterations| ReconstructParams {
        iterations,
        schedule: 18,
        log_every: 10,
        evaluate_every: 9,
        ..tiny_params(18)
    };
    let run = |iterations, dir: Option<&std::path::Path>| {
        reconstruct(&capture, &loader(&loaded), &params(iterations), dir, &mut StoppingObserver::default())
            .unwrap()
    };
    let dir = tempfile::tempdir().unwrap();
    let short = run(27, Some(dir.path()));
    let long = run(36, Some(dir.path()));
    assert!(same(&long, &run(36, None)), "{}", long.log_lines());
    assert!(same(&short, &run(27, Some(dir.path()))), "the longer run took nothing from it");
}

#[test]
fn runs_of_two_lengths_at_once_share_a_folder() {
    let (capture, loaded) = tiny_capture(5);
    let params = |iterations| ReconstructParams { iterations, checkpoint_steps: 1, ..tiny_params(12) };
    let dir = tempfile::tempdir().unwrap();
    let run = |iterations, dir: Option<&std::path::Path>| {
        reconstruct(&capture, &loader(&loaded), &params(iterations), dir, &mut StoppingObserver::default())
            .unwrap()
    };
    std::thread::scope(|scope| {
        let runs: Vec<_> = [12, 13, 12]
            .map(|iterations| {
                let (run, dir) = (&run, dir.path());
                scope.spawn(move || (iterations, run(iterations, Some(dir))))
            })
            .into_iter()
            .collect();
        for one in runs {
            let (iterations, outcome) = one.join().unwrap();
            assert!(same(&outcome, &run(iterations, None)), "{iterations}");
        }
    });
}
