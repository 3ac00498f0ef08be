//! The time of each part of a step.

use std::time::{Duration, Instant};

/// The parts of a loop's step.
pub trait Part: Copy + PartialEq + 'static {
    /// All parts in order, with their names for tables.
    const ALL: &'static [(Self, &'static str)];
}

/// Time per part, summed over steps. Never stored: it differs from run to run.
#[derive(Clone, Debug)]
pub struct Profile<P> {
    /// Number of steps measured.
    pub steps: u64,
    spent: Vec<(P, Duration)>,
    last: Option<Instant>,
}

impl<P: Part> Default for Profile<P> {
    fn default() -> Self {
        let spent = P::ALL.iter().map(|(part, _)| (*part, Duration::ZERO)).collect();
        Self { steps: 0, spent, last: None }
    }
}

impl<P: Part> Profile<P> {
    /// Starts the clock.
    pub fn start(&mut self) {
        self.last = Some(Instant::now());
    }

    /// Adds the time since the last call to `part`; does nothing while the clock is stopped.
    pub fn lap(&mut self, part: P) {
        if let Some(last) = &mut self.last {
            let now = Instant::now();
            if let Some((_, spent)) = self.spent.iter_mut().find(|(known, _)| *known == part) {
                *spent += now - *last;
            }
            *last = now;
        }
    }

    /// Stops the clock: the time after it belongs to no step.
    pub fn stop(&mut self) {
        self.last = None;
    }

    /// Time of all parts, summed over steps.
    pub fn spent(&self) -> Duration {
        self.spent.iter().map(|(_, spent)| spent).sum()
    }

    /// Seconds per step of a part.
    pub fn seconds(&self, part: P) -> f64 {
        let spent = self.spent.iter().find(|(known, _)| *known == part);
        spent.map_or(Duration::ZERO, |(_, spent)| *spent).as_secs_f64() / self.steps.max(1) as f64
    }

    /// Seconds per step of all parts.
    pub fn total(&self) -> f64 {
        P::ALL.iter().map(|(part, _)| self.seconds(*part)).sum()
    }

    /// A table: milliseconds per step and share of each part.
    pub fn table(&self) -> String {
        let total = self.total();
        let mut text = format!("{} steps, {:.2} ms per step\n", self.steps, 1e3 * total);
        for &(part, name) in P::ALL {
            let seconds = self.seconds(part);
            let share = if total > 0.0 { 100.0 * seconds / total } else { 0.0 };
            text += &format!("{:>17} {:>9.2} ms {share:>5.1} %\n", name, 1e3 * seconds);
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Clone, Copy, PartialEq)]
    enum Half {
        First,
        Second,
    }

    impl Part for Half {
        const ALL: &'static [(Self, &'static str)] = &[(Self::First, "first"), (Self::Second, "second")];
    }

    #[test]
    fn time_goes_to_the_part_that_ended() {
        let mut profile = Profile::default();
        profile.lap(Half::First);
        profile.start();
        std::thread::sleep(Duration::from_millis(5));
        profile.lap(Half::Second);
        profile.steps = 1;
        profile.stop();
        profile.lap(Half::First);
        assert!(profile.seconds(Half::First) == 0.0 && profile.seconds(Half::Second) >= 5e-3);
        assert_eq!(profile.spent(), profile.spent[1].1);
        assert!(profile.table().contains("second"), "{}", profile.table());
    }
}
