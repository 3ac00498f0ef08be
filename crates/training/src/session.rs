//! The skeleton of a training loop: go on from a checkpoint, step, say how fast, write what is due, stop when
//! asked.
//!
//! ```text
//! resume ─▶ step ─▶ tell progress ─▶ due, asked to stop, or last? save ─▶ asked to stop? leave
//!             ▲                                                              │
//!             └──────────────────────────────────────────────────────────────┘
//! ```
//!
//! Checkpoints and progress change nothing about a result, so both loops follow the same rules: a checkpoint
//! is written after so many steps or minutes, when the observer asks to stop, and at the end. The last one
//! stays where it is.

use std::ops::Range;
use std::time::Instant;

use crate::chain::{Checkpoints, Resumable};
use crate::checkpoint::CheckpointError;
use crate::observer::{Observer, Progress, Snapshot};
use crate::pace::Pace;

/// What a loop does, one step after another.
pub trait Steps {
    /// What may go wrong.
    type Error: From<CheckpointError>;

    /// Does step `step` (from 0), with everything that happens before the next one.
    fn step(&mut self, step: u64, observer: &mut dyn Observer) -> Result<(), Self::Error>;

    /// Writes the state after `done` steps, every one of them reported.
    fn save(&mut self, done: u64, checkpoints: &Checkpoints) -> Result<(), Self::Error>;

    /// What these steps cost, in any unit that is the same for all.
    fn work(&self, steps: Range<u64>) -> f64 {
        steps.end.saturating_sub(steps.start) as f64
    }

    /// A copy of what is trained as it stands, for somebody who looks on; `None` where there is nothing to
    /// look at. It must leave the steps to come as they are.
    fn view(&mut self) -> Result<Option<Snapshot>, Self::Error> {
        Ok(None)
    }

    /// What a person sees after a step: smoothed loss and PSNR, and the number of Gaussians. The skeleton
    /// fills in the rest.
    fn shown(&self) -> Progress;
}

/// How a run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ended {
    /// With its last step.
    Done,
    /// On request.
    Stopped {
        /// Steps done.
        step: u64,
        /// Whether a checkpoint holds the state.
        saved: bool,
    },
}

/// How far a run goes and when it writes its state.
#[derive(Clone, Debug)]
pub struct Session {
    /// Steps in all.
    pub steps: u64,
    /// Where checkpoints lie; `None`: none are written.
    pub checkpoints: Option<Checkpoints>,
    /// A checkpoint is due after so many steps, at least 1.
    pub every_steps: u64,
    /// And after so many minutes.
    pub every_minutes: f64,
}

impl Session {
    /// The furthest state that can be gone on from. What a person should know is told to the observer: files
    /// that cannot be read, are damaged, or belong to other runs; the run then starts anew.
    pub fn furthest<T: Resumable>(&self, observer: &mut dyn Observer) -> Option<T> {
        let checkpoints = self.checkpoints.as_ref()?;
        match checkpoints.load::<T>() {
            Ok(found) => {
                found.notices.iter().for_each(|notice| observer.notice(notice));
                if found.state.is_none()
                    && let Some((step, length)) = checkpoints.apart()
                {
                    observer.notice(&format!(
                        "the same training is at step {step} of {length} with another engine or another version of this program; \
                         that one is kept apart, and this one starts anew (`use3d reconstruct` and `use3d enhance` go on across engines)"
                    ));
                }
                found.state
            }
            Err(error) => {
                observer.notice(&format!("{error}; starting anew"));
                None
            }
        }
    }

    /// Says that the run goes on after `done` steps.
    pub fn tell_resumed(&self, done: u64, observer: &mut dyn Observer) {
        observer.notice(&format!("going on from step {done} of {}", self.steps));
    }

    /// Does the steps that are left after the first `done`. Where that fails, the observer is told what is kept.
    pub fn run<S: Steps>(
        &self,
        done: u64,
        work: &mut S,
        observer: &mut dyn Observer,
    ) -> Result<Ended, S::Error> {
        let mut saved = done;
        let ended = self.advance(done, &mut saved, work, observer);
        if ended.is_err() {
            observer.notice(&match (&self.checkpoints, saved) {
                (None, _) | (_, 0) => "nothing was saved yet: the same command starts anew".to_string(),
                (Some(_), saved) => {
                    format!("the checkpoint of step {saved} is kept; the same command goes on from there")
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
    ) -> Result<Ended, S::Error> {
        let mut left = work.work(done..self.steps.max(done));
        let mut pace = Pace::start();
        let mut saved_at = Instant::now();
        for step in done..self.steps {
            work.step(step, observer)?;
            let done = step + 1;
            let cost = work.work(step..done);
            left -= cost;
            pace.step(cost);
            observer.progress(&Progress {
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
                return Ok(Ended::Stopped { step: done, saved: self.checkpoints.is_some() });
            }
        }
        Ok(Ended::Done)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::State;

    /// Counts, and writes down after which steps it was saved.
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
            checkpoints.save(done, &State { fingerprint: [1; 32], step: done })
        }
        fn view(&mut self) -> Result<Option<Snapshot>, CheckpointError> {
            Ok(Some(std::sync::Arc::new(self.steps.clone())))
        }
        fn shown(&self) -> Progress {
            Progress { loss: Some(0.5), ..Progress::default() }
        }
    }

    #[derive(Default)]
    struct Watcher {
        stop_at: Option<u64>,
        seen: Vec<Progress>,
        notices: Vec<String>,
        views: Vec<Snapshot>,
    }

    impl Observer for Watcher {
        fn progress(&mut self, progress: &Progress) {
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

    #[test]
    fn a_run_stops_where_it_is_asked_to_and_goes_on_from_there() {
        let dir = tempfile::tempdir().unwrap();
        let session = Session {
            steps: 10,
            checkpoints: Some(Checkpoints::new(dir.path(), "count", &[1; 32], 10)),
            every_steps: 4,
            every_minutes: f64::INFINITY,
        };
        let mut watcher = Watcher { stop_at: Some(6), ..Watcher::default() };
        assert!(session.furthest::<State>(&mut watcher).is_none());
        let mut first = Counter::default();
        let ended = session.run(0, &mut first, &mut watcher).unwrap();
        assert_eq!(ended, Ended::Stopped { step: 6, saved: true });
        assert_eq!((first.steps.len(), first.saved), (6, vec![4, 6]));
        // Six of ten steps are done, and what is shown is the loop's own.
        let last = watcher.seen.last().unwrap();
        assert_eq!((last.step, last.steps, last.loss), (6, 10, Some(0.5)));

        // What is trained is shown when it is wanted, as it stands.
        let shown = watcher.views.iter().map(|view| view.downcast_ref::<Vec<u64>>().expect("steps").len());
        assert_eq!(shown.collect::<Vec<_>>(), [3, 6]);

        let mut second = Counter::default();
        let state = session.furthest::<State>(&mut watcher).expect("a checkpoint");
        session.tell_resumed(state.step, &mut watcher);
        assert!(watcher.notices.contains(&"going on from step 6 of 10".to_string()), "{:?}", watcher.notices);
        assert_eq!(session.run(state.step, &mut second, &mut watcher).unwrap(), Ended::Done);
        assert_eq!((second.steps, second.saved), (vec![6, 7, 8, 9], vec![10]));
        // Nothing is left to do, and nothing is written.
        let mut third = Counter::default();
        let state = session.furthest::<State>(&mut watcher).expect("the last checkpoint stays");
        assert_eq!(session.run(state.step, &mut third, &mut watcher).unwrap(), Ended::Done);
        assert!(third.steps.is_empty() && third.saved.is_empty());
    }

    #[test]
    fn a_run_that_fails_says_what_is_kept_of_it() {
        let dir = tempfile::tempdir().unwrap();
        let session =
            |checkpoints| Session { steps: 10, checkpoints, every_steps: 4, every_minutes: f64::INFINITY };
        let own = || Some(Checkpoints::new(dir.path(), "count", &[1; 32], 10));
        for (checkpoints, fails_at, expected) in [
            (own(), 3, "nothing was saved yet"),
            (None, 9, "nothing was saved yet"),
            (own(), 6, "the checkpoint of step 4 is kept; the same command goes on from there"),
        ] {
            let mut watcher = Watcher::default();
            let mut work = Counter { fails_at: Some(fails_at), ..Counter::default() };
            session(checkpoints).run(0, &mut work, &mut watcher).unwrap_err();
            assert!(
                watcher.notices.len() == 1 && watcher.notices[0].contains(expected),
                "{:?}",
                watcher.notices
            );
        }
        // Gone on from and lost before the next one is due: the same one is kept.
        let mut watcher = Watcher::default();
        let mut work = Counter { fails_at: Some(5), ..Counter::default() };
        session(own()).run(4, &mut work, &mut watcher).unwrap_err();
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
            .run(0, &mut Counter { fails_at: Some(6), ..Counter::default() }, &mut Watcher::default())
            .unwrap_err();
        let told = |session: Session| {
            let mut watcher = Watcher::default();
            assert!(session.furthest::<State>(&mut watcher).is_none());
            watcher.notices.join("\n")
        };
        let said = told(of("b", 1));
        assert!(
            said.contains("at step 4 of 10 with another engine") && said.contains("starts anew"),
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
        let mut watcher = Watcher::default();
        assert!(session.furthest::<State>(&mut watcher).is_none());
        let told = watcher.notices.join("\n");
        assert!(told.contains("another version") && told.contains("starting anew"), "{told}");
    }
}
