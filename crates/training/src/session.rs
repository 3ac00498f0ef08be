//! The skeleton of a training loop: resume from a checkpoint, do the steps, report the pace, write
//! checkpoints that are due, stop on request.
//!
//! ```text
//! resume ─▶ step ─▶ report ─▶ due, stop requested, or last? save ─▶ stop requested? return
//!           ▲                                                           │
//!           └───────────────────────────────────────────────────────────┘
//! ```
//!
//! Checkpoints and progress do not change a result, so both loops follow the same rules: a checkpoint is
//! written after a number of steps or minutes, when the observer requests a stop, and at the end. The last
//! one stays in its place.

use std::ops::Range;
use std::time::Instant;

use crate::chain::{Checkpoints, Resumable};
use crate::checkpoint::CheckpointError;
use crate::observer::{Observer, Snapshot, TrainingProgress};
use crate::pace::Pace;

/// The work of a loop, one step after another.
pub trait Steps {
    /// The loop's errors.
    type Error: From<CheckpointError>;

    /// Does step `step` (from 0), and everything else before the next one.
    fn step(&mut self, step: u64, observer: &mut dyn Observer) -> Result<(), Self::Error>;

    /// Writes the state after `done` steps, all of which have been reported.
    fn save(&mut self, done: u64, checkpoints: &Checkpoints) -> Result<(), Self::Error>;

    /// The work of these steps, in any unit that is the same for all.
    fn work(&self, steps: Range<u64>) -> f64 {
        steps.end.saturating_sub(steps.start) as f64
    }

    /// A copy of the present trained state for an observer; `None` if there is nothing to show. It must not
    /// change later steps.
    fn view(&mut self) -> Result<Option<Snapshot>, Self::Error> {
        Ok(None)
    }

    /// The numbers to display after a step: smoothed loss and PSNR, and the number of Gaussians. The skeleton
    /// adds the rest.
    fn shown(&self) -> TrainingProgress;
}

/// The end of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SessionEnd {
    /// The last step was done.
    Done,
    /// The run was stopped on request.
    Stopped {
        /// Number of steps done.
        step: u64,
        /// True if a checkpoint contains the state.
        saved: bool,
    },
}

/// The length of a run, and the rules for its checkpoints.
#[derive(Clone, Debug)]
pub struct Session {
    /// Total number of steps.
    pub steps: u64,
    /// The checkpoints; `None` writes none.
    pub checkpoints: Option<Checkpoints>,
    /// Number of steps between checkpoints, at least 1.
    pub every_steps: u64,
    /// Number of minutes after which a checkpoint is also due.
    pub every_minutes: f64,
}

impl Session {
    /// The latest state to resume from. Anything the user should know goes to the observer: files that cannot
    /// be read, are damaged, or belong to other runs; the run then starts from the beginning.
    pub fn furthest<T: Resumable>(&self, observer: &mut dyn Observer) -> Option<T> {
        let checkpoints = self.checkpoints.as_ref()?;
        match checkpoints.load::<T>() {
            Ok(found) => {
                found.notices.iter().for_each(|notice| observer.notice(notice));
                if found.state.is_none()
                    && let Some((step, length)) = checkpoints.apart()
                {
                    observer.notice(&format!(
                        "another engine or version of this program has done {step} of {length} steps of the \
                         same training; its checkpoint is kept, and this run starts from the beginning \
                         (`use3d reconstruct` and `use3d enhance` resume across engines)"
                    ));
                }
                found.state
            }
            Err(error) => {
                observer.notice(&format!("{error}; starting from the beginning"));
                None
            }
        }
    }

    /// Reports that the run resumes after `done` steps.
    pub fn tell_resumed(&self, done: u64, observer: &mut dyn Observer) {
        observer.notice(&format!("resuming from step {done} of {}", self.steps));
    }

    /// Does the steps after the first `done`. On an error, the observer gets a message about the last
    /// checkpoint.
    pub fn run<S: Steps>(
        &self,
        done: u64,
        work: &mut S,
        observer: &mut dyn Observer,
    ) -> Result<SessionEnd, S::Error> {
        let mut saved = done;
        let ended = self.advance(done, &mut saved, work, observer);
        if ended.is_err() {
            observer.notice(&match (&self.checkpoints, saved) {
                (None, _) | (_, 0) => {
                    "nothing was saved yet: the same command starts from the beginning".to_string()
                }
                (Some(_), saved) => {
                    format!(
                        "the checkpoint of step {saved} is kept; run the same command to continue from there"
                    )
                }
            });
        }
        ended
    }

    fn advance<S: Steps>(
        &self,
        done: u64,
        saved: &mut u64,
        work: &mut S,
        observer: &mut dyn Observer,
    ) -> Result<SessionEnd, S::Error> {
        let mut left = work.work(done..self.steps.max(done));
        let mut pace = Pace::start();
        let mut saved_at = Instant::now();
        for step in done..self.steps {
            work.step(step, observer)?;
            let done = step + 1;
            let cost = work.work(step..done);
            left -= cost;
            pace.step(cost);
            observer.progress(&TrainingProgress {
                step: done,
                steps: self.steps,
                steps_per_second: pace.steps_per_second(),
                seconds_left: pace.seconds_for(left),
                ..work.shown()
            });
            if observer.wants_view()
                && let Some(view) = work.view()?
            {
                observer.view(view);
            }
            let last = done == self.steps;
            let stop = !last && observer.should_stop();
            let due = done - *saved >= self.every_steps
                || saved_at.elapsed().as_secs_f64() >= 60.0 * self.every_minutes;
            if (due || stop || last)
                && let Some(checkpoints) = &self.checkpoints
            {
                work.save(done, checkpoints)?;
                (saved_at, *saved) = (Instant::now(), done);
            }
            if stop {
                return Ok(SessionEnd::Stopped { step: done, saved: self.checkpoints.is_some() });
            }
        }
        Ok(SessionEnd::Done)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::SavedStep;

    /// Counts steps, and records the steps after which it was saved.
    #[derive(Default)]
    struct Counter {
        steps: Vec<u64>,
        saved: Vec<u64>,
        fails_at: Option<u64>,
    }

    impl Steps for Counter {
        type Error = CheckpointError;
        fn step(&mut self, step: u64, _: &mut dyn Observer) -> Result<(), CheckpointError> {
            if self.fails_at == Some(step) {
                return Err(CheckpointError::Damaged {
                    path: "x".into(),
                    reason: "the device is gone".into(),
                });
            }
            self.steps.push(step);
            Ok(())
        }
        fn save(&mut self, done: u64, checkpoints: &Checkpoints) -> Result<(), CheckpointError> {
            self.saved.push(done);
            checkpoints.save(done, &SavedStep { fingerprint: [1; 32], step: done })
        }
        fn view(&mut self) -> Result<Option<Snapshot>, CheckpointError> {
            Ok(Some(std::sync::Arc::new(self.steps.clone())))
        }
        fn shown(&self) -> TrainingProgress {
            TrainingProgress { loss: Some(0.5), ..TrainingProgress::default() }
        }
    }

    #[derive(Default)]
    struct TestObserver {
        stop_at: Option<u64>,
        seen: Vec<TrainingProgress>,
        notices: Vec<String>,
        views: Vec<Snapshot>,
    }

    impl Observer for TestObserver {
        fn progress(&mut self, progress: &TrainingProgress) {
            self.seen.push(*progress);
        }
        fn notice(&mut self, message: &str) {
            self.notices.push(message.into());
        }
        fn should_stop(&self) -> bool {
            self.seen.last().is_some_and(|p| Some(p.step) == self.stop_at)
        }
        fn wants_view(&self) -> bool {
            self.seen.last().is_some_and(|p| p.step.is_multiple_of(3))
        }
        fn view(&mut self, view: Snapshot) {
            self.views.push(view);
        }
    }

    /// Ten steps, with a checkpoint after every fourth.
    fn ten_steps(checkpoints: Option<Checkpoints>) -> Session {
        Session { steps: 10, checkpoints, every_steps: 4, every_minutes: f64::INFINITY }
    }

    #[test]
    fn a_run_stops_where_it_is_asked_to_and_goes_on_from_there() {
        let dir = tempfile::tempdir().unwrap();
        let session = ten_steps(Some(Checkpoints::new(dir.path(), "count", &[1; 32], 10)));
        let mut watcher = TestObserver { stop_at: Some(6), ..TestObserver::default() };
        assert!(session.furthest::<SavedStep>(&mut watcher).is_none());
        let mut first = Counter::default();
        let ended = session.run(0, &mut first, &mut watcher).unwrap();
        assert_eq!(ended, SessionEnd::Stopped { step: 6, saved: true });
        assert_eq!((first.steps.len(), first.saved), (6, vec![4, 6]));
        // Six of ten steps are done, and the displayed numbers are the loop's own.
        let last = watcher.seen.last().unwrap();
        assert_eq!((last.step, last.steps, last.loss), (6, 10, Some(0.5)));

        // Views show the present state, when they are wanted.
        let shown = watcher.views.iter().map(|view| view.downcast_ref::<Vec<u64>>().expect("steps").len());
        assert_eq!(shown.collect::<Vec<_>>(), [3, 6]);

        let mut second = Counter::default();
        let state = session.furthest::<SavedStep>(&mut watcher).expect("a checkpoint");
        session.tell_resumed(state.step, &mut watcher);
        assert!(watcher.notices.contains(&"resuming from step 6 of 10".to_string()), "{:?}", watcher.notices);
        assert_eq!(session.run(state.step, &mut second, &mut watcher).unwrap(), SessionEnd::Done);
        assert_eq!((second.steps, second.saved), (vec![6, 7, 8, 9], vec![10]));
        // No step is left, and no file is written.
        let mut third = Counter::default();
        let state = session.furthest::<SavedStep>(&mut watcher).expect("the last checkpoint stays");
        assert_eq!(session.run(state.step, &mut third, &mut watcher).unwrap(), SessionEnd::Done);
        assert!(third.steps.is_empty() && third.saved.is_empty());
    }

    #[test]
    fn a_run_that_fails_says_what_is_kept_of_it() {
        let dir = tempfile::tempdir().unwrap();
        let own = || Some(Checkpoints::new(dir.path(), "count", &[1; 32], 10));
        for (checkpoints, fails_at, expected) in [
            (own(), 3, "nothing was saved yet"),
            (None, 9, "nothing was saved yet"),
            (own(), 6, "the checkpoint of step 4 is kept; run the same command to continue from there"),
        ] {
            let mut watcher = TestObserver::default();
            let mut work = Counter { fails_at: Some(fails_at), ..Counter::default() };
            ten_steps(checkpoints).run(0, &mut work, &mut watcher).unwrap_err();
            assert!(
                watcher.notices.len() == 1 && watcher.notices[0].contains(expected),
                "{:?}",
                watcher.notices
            );
        }
        // A run that resumed and failed before its next checkpoint keeps the old one.
        let mut watcher = TestObserver::default();
        let mut work = Counter { fails_at: Some(5), ..Counter::default() };
        ten_steps(own()).run(4, &mut work, &mut watcher).unwrap_err();
        assert!(watcher.notices[0].contains("step 4 is kept"), "{:?}", watcher.notices);
    }

    #[test]
    fn the_same_run_under_another_key_is_told_and_left_alone() {
        let dir = tempfile::tempdir().unwrap();
        let place = |key: &str| dir.path().join(key.repeat(64));
        let of = |key: &str, run: u8| Session {
            steps: 10,
            checkpoints: Some(Checkpoints::new(&place(key), "count", &[run; 32], 10)),
            every_steps: 4,
            every_minutes: f64::INFINITY,
        };
        of("a", 1)
            .run(0, &mut Counter { fails_at: Some(6), ..Counter::default() }, &mut TestObserver::default())
            .unwrap_err();
        let told = |session: Session| {
            let mut watcher = TestObserver::default();
            assert!(session.furthest::<SavedStep>(&mut watcher).is_none());
            watcher.notices.join("\n")
        };
        let said = told(of("b", 1));
        assert!(
            said.contains("another engine or version")
                && said.contains("4 of 10 steps")
                && said.contains("starts from the beginning"),
            "{said}"
        );
        assert_eq!(told(of("b", 2)), "", "another run");
    }

    #[test]
    fn a_checkpoint_of_another_version_is_refused_by_name() {
        let dir = tempfile::tempdir().unwrap();
        let checkpoints = Checkpoints::new(dir.path(), "count", &[1; 32], 10);
        let mut old = b"3d-use state v01".to_vec();
        old.extend([7; 64]);
        std::fs::write(checkpoints.path(5), old).unwrap();
        let session =
            Session { steps: 10, checkpoints: Some(checkpoints), every_steps: 4, every_minutes: 1.0 };
        let mut watcher = TestObserver::default();
        assert!(session.furthest::<SavedStep>(&mut watcher).is_none());
        let told = watcher.notices.join("\n");
        assert!(told.contains("another version") && told.contains("starting from the beginning"), "{told}");
    }
}
