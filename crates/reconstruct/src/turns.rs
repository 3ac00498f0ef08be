//! Turns in which the water or the colours move alone: the schedule of SeaSplat.
//!
//! ```text
//! step      0 … S − 1     S                                  S + 1 …
//! moves     everything    water × n₁, colours × (n₂ + 1)     Gaussians, after water × W at every E-th step
//! ```
//!
//! Before the step `S` there is no water, and its colour is the background behind the scene. `S`, `n₁` and
//! `n₂` are shares of the run, and so they scale with its length. An *update* is one view, its loss and the
//! moves that follow. A step has one update of its own, after those of its turns. Refinements, lines of the
//! log and evaluations count steps. Checkpoints, the order of the views and the progress count updates.

use crate::engine::Moves;
use crate::{ReconstructParams, Turns};

/// The cost of an update of the water alone, relative to a whole one.
const WATER_ALONE: f64 = 0.6;

/// An update of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Update {
    /// The step to which it belongs.
    pub(crate) step: u64,
    /// The parameters that it moves.
    pub(crate) moves: Moves,
    /// True if the step is done with it.
    pub(crate) ends_step: bool,
    /// True if there is water from this update on, and was none before.
    pub(crate) begins_water: bool,
    /// Earlier updates that moved the water, since there is some.
    pub(crate) water_updates: u64,
}

impl ReconstructParams {
    /// True if water or colours have turns of their own.
    pub(crate) fn has_turns(&self) -> bool {
        self.turns.water > 0
    }

    /// The step from which there is water.
    pub fn water_begins(&self) -> u64 {
        if self.has_turns() { self.steps_of(self.turns.from) } else { 0 }
    }

    /// True if there is water in a step.
    pub(crate) fn has_water(&self, step: u64) -> bool {
        step >= self.water_begins()
    }

    fn steps_of(&self, share: f64) -> u64 {
        (share * self.course() as f64).round() as u64
    }

    /// Updates of turns in all steps before this one.
    fn turned_before(&self, step: u64) -> u64 {
        let begins = self.water_begins();
        if !self.has_turns() || step <= begins {
            return 0;
        }
        let Turns { water_first, colors_first, every, water, .. } = self.turns;
        let later = step / every - (begins + 1) / every;
        self.steps_of(water_first) + self.steps_of(colors_first) + later * water
    }

    /// The updates of the whole run.
    pub fn updates(&self) -> u64 {
        self.iterations + self.turned_before(self.iterations)
    }

    /// The cost of an update relative to a step on whole images. One of the water alone needs no gradients of
    /// the Gaussians.
    pub(crate) fn update_work(&self, number: u64) -> f64 {
        let Update { step, moves, .. } = self.update(number);
        self.step_work(step) * if moves == Moves::Water { WATER_ALONE } else { 1.0 }
    }

    /// The update with this number, from 0.
    pub(crate) fn update(&self, number: u64) -> Update {
        if !self.has_turns() {
            let (ends_step, begins_water) = (true, false);
            return Update {
                step: number,
                moves: Moves::All,
                ends_step,
                begins_water,
                water_updates: number,
            };
        }
        // The last step that begins at this update or before it.
        let (mut step, mut after) = (0, number + 1);
        while after - step > 1 {
            let middle = step + (after - step) / 2;
            if middle + self.turned_before(middle) <= number { step = middle } else { after = middle }
        }
        let begins = self.water_begins();
        let (before, first) = (self.turned_before(step), self.steps_of(self.turns.water_first));
        let at = number - step - before;
        let ends_step = at == self.turned_before(step + 1) - before;
        let moves = match (ends_step, step < begins) {
            (true, true) => Moves::All,
            (true, false) if step > begins => Moves::Gaussians,
            (true, false) => Moves::Colors,
            (false, _) if step > begins || at < first => Moves::Water,
            (false, _) => Moves::Colors,
        };
        let water_updates = match step.cmp(&begins) {
            std::cmp::Ordering::Less => step,
            std::cmp::Ordering::Equal => at.min(first),
            std::cmp::Ordering::Greater => before - self.steps_of(self.turns.colors_first) + at,
        };
        let begins_water = step == begins && at == 0;
        Update { step, moves, ends_step, begins_water, water_updates }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The authors' schedule in a run of `iterations` steps.
    fn params(iterations: u64) -> ReconstructParams {
        let turns = Turns {
            from: 1.0 / 3.0,
            water_first: 1.0 / 30.0,
            colors_first: 1.0 / 15.0,
            every: 100,
            water: 50,
        };
        ReconstructParams { iterations, schedule: 30_000, turns, ..ReconstructParams::default() }
    }

    #[test]
    fn the_authors_schedule_has_its_turns() {
        let p = params(30_000);
        assert_eq!((p.water_begins(), p.updates()), (10_000, 30_000 + 3000 + 200 * 50));
        let at = |number| {
            let u = p.update(number);
            (u.step, u.moves, u.ends_step, u.water_updates)
        };
        assert_eq!(at(9999), (9999, Moves::All, true, 9999));
        assert_eq!(at(10_000), (10_000, Moves::Water, false, 0));
        assert!(p.update(10_000).begins_water && !p.update(10_001).begins_water);
        assert_eq!(at(10_999), (10_000, Moves::Water, false, 999));
        assert_eq!(at(11_000), (10_000, Moves::Colors, false, 1000));
        assert_eq!(at(12_999), (10_000, Moves::Colors, false, 1000));
        assert_eq!(at(13_000), (10_000, Moves::Colors, true, 1000));
        assert_eq!(at(13_098), (10_098, Moves::Gaussians, true, 1000));
        assert_eq!(at(13_099), (10_099, Moves::Water, false, 1000));
        assert_eq!(at(13_148), (10_099, Moves::Water, false, 1049));
        assert_eq!(at(13_149), (10_099, Moves::Gaussians, true, 1050));
        assert_eq!(at(42_999), (29_999, Moves::Gaussians, true, 1000 + 200 * 50));
        assert_eq!(p.update(43_000).step, 30_000);
    }

    #[test]
    fn every_step_ends_once_and_a_longer_run_begins_like_a_shorter_one() {
        for (iterations, begins, updates) in [(300, 100, 300 + 30 + 2 * 50), (1000, 333, 1000 + 100 + 7 * 50)]
        {
            let p = params(iterations);
            assert_eq!((p.water_begins(), p.updates()), (begins, updates));
            let all: Vec<Update> = (0..updates).map(|number| p.update(number)).collect();
            let ends: Vec<u64> = all.iter().filter(|u| u.ends_step).map(|u| u.step).collect();
            assert_eq!(ends, (0..iterations).collect::<Vec<_>>());
            assert_eq!(all.iter().filter(|u| u.begins_water).count(), 1);
            let mut moved = 0;
            for update in all.iter().filter(|u| u.step >= begins) {
                assert_eq!(update.water_updates, moved);
                moved += u64::from(update.moves == Moves::Water);
            }
        }
        let (short, long) = (params(30_000), ReconstructParams { iterations: 40_000, ..params(30_000) });
        assert!((0..short.updates()).step_by(37).all(|number| short.update(number) == long.update(number)));
    }

    #[test]
    fn without_turns_an_update_is_a_step() {
        let p = ReconstructParams { iterations: 70, ..ReconstructParams::default() };
        assert_eq!((p.updates(), p.water_begins(), p.update(69).step), (70, 0, 69));
        assert_eq!((p.update(69).moves, p.update(69).water_updates), (Moves::All, 69));
        let wrong = ReconstructParams { turns: Turns { every: 0, ..Turns::default() }, ..p };
        assert!(wrong.validate().unwrap_err().to_string().contains("turns.every"));
    }
}
