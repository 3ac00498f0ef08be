//! The present speed of a loop, and the estimated time of the remaining steps.
//!
//! Steps differ: those on smaller images take less time. A loop therefore gives each step a weight, its
//! *work*, in any unit that stays the same during the run, and reports the remaining work. The pace is that
//! of the last seconds, so that it follows growing scenes and a slower machine, and a resumed run does not
//! count steps that it did not do.
//!
//! The pace is for display only: it must not affect any result.

use std::time::Instant;

use use3d_numerics::math;

/// Older steps have the weight `e^(−age / WINDOW)`, in seconds.
const WINDOW: f64 = 20.0;

/// A step is taken for a pause of the process if it takes this many seconds and this many times longer than
/// the steps before it. Of two such steps in a row the second counts.
const PAUSE: (f64, f64) = (5.0, 10.0);

/// Steps and work per second, over the last seconds.
#[derive(Clone, Copy, Debug)]
pub struct Pace {
    last: Instant,
    seconds: f64,
    steps: f64,
    work: f64,
    /// True if the last step was taken for a pause.
    paused: bool,
}

impl Pace {
    /// Starts the clock.
    pub fn start() -> Self {
        Self { last: Instant::now(), seconds: 0.0, steps: 0.0, work: 0.0, paused: false }
    }

    /// Records the end of a step with this work.
    pub fn step(&mut self, work: f64) {
        let now = Instant::now();
        self.took(now.duration_since(self.last).as_secs_f64(), work);
        self.last = now;
    }

    fn took(&mut self, seconds: f64, work: f64) {
        let usual = self.seconds_for(work).unwrap_or(f64::INFINITY);
        self.paused = !self.paused && seconds > PAUSE.0.max(PAUSE.1 * usual);
        if self.paused {
            return;
        }
        let kept = math::exp(-seconds / WINDOW);
        self.seconds = kept * self.seconds + seconds;
        self.steps = kept * self.steps + 1.0;
        self.work = kept * self.work + work;
    }

    /// Steps per second; `None` before the first step.
    pub fn steps_per_second(&self) -> Option<f64> {
        (self.seconds > 0.0).then(|| self.steps / self.seconds)
    }

    /// Estimated seconds for `work`; `None` before the first step.
    pub fn seconds_for(&self, work: f64) -> Option<f64> {
        (self.work > 0.0).then(|| work.max(0.0) * self.seconds / self.work)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(a: Option<f64>, b: f64) -> bool {
        a.is_some_and(|a| (a - b).abs() < 1e-3 * b)
    }

    #[test]
    fn knows_nothing_before_the_first_step() {
        let pace = Pace::start();
        assert_eq!((pace.steps_per_second(), pace.seconds_for(1.0)), (None, None));
    }

    #[test]
    fn follows_the_last_seconds() {
        let mut pace = Pace::start();
        (0..1000).for_each(|_| pace.took(0.01, 1.0));
        assert!(close(pace.steps_per_second(), 100.0));
        // Ten times slower: after a time of many windows the fast steps have no weight.
        (0..3000).for_each(|_| pace.took(0.1, 1.0));
        assert!(close(pace.steps_per_second(), 10.0), "{pace:?}");
        assert!(close(pace.seconds_for(50.0), 5.0));
    }

    #[test]
    fn a_pause_of_the_process_does_not_count_and_slower_steps_do() {
        let mut pace = Pace::start();
        (0..100).for_each(|_| pace.took(0.1, 1.0));
        pace.took(600.0, 1.0);
        assert!(close(pace.seconds_for(100.0), 10.0), "{pace:?}");
        pace.took(0.1, 1.0);
        (0..2).for_each(|_| pace.took(60.0, 1.0));
        assert!(pace.seconds_for(1.0) > Some(10.0), "{pace:?}");
    }

    #[test]
    fn counts_work_to_come_by_its_weight() {
        let mut pace = Pace::start();
        // Small images: a quarter of the work, a quarter of the time.
        (0..100).for_each(|_| pace.took(0.05, 0.25));
        // A hundred steps on whole images.
        assert!(close(pace.seconds_for(100.0), 20.0), "{pace:?}");
    }
}
