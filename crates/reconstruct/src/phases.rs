//! The phases of a training: from which share of the run on which groups of parameters move, and how fast.
//!
//! ```text
//! r_g(s) = f_g κ_g ρ_g(s),        κ_g = min(schedule / course, 10) for water and views, 1 for Gaussians
//! ```
//!
//! | symbol | meaning |
//! |---|---|
//! | ρ | the learning rate of a parameter of group g at step s, from its first to its last value |
//! | f | the group's factor in the phase of the step: 0 holds it, 1 lets it move |
//! | κ | the factor by which a short run takes longer steps |
//!
//! Water starts far from its final state, and Adam's steps have the length of the rate for any gradient. So
//! a compressed run takes longer steps to get as far, within reason. Gaussians start near their final state.

use crate::colors::{ColorField, ColorStep};
use crate::engine::StepRates;
use crate::{Rate, ReconstructParams};

/// The largest factor by which a short run multiplies the rates of water and views.
const MOST_COMPRESSED: f64 = 10.0;

/// Parameters that move together.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Group {
    /// All parameters of the Gaussians.
    Gaussians,
    /// All parameters of the water.
    Water,
    /// All parameters of single views.
    Views,
}

/// A part of a training.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Phase {
    /// Share of the course, 0 to 1, from which it holds.
    pub from: f64,
    factors: [f64; 3],
}

impl Phase {
    /// A phase in which all groups move at their rates.
    pub fn new(from: f64) -> Self {
        Self { from, factors: [1.0; 3] }
    }

    /// The same with another factor of a group, 0 to 1.
    #[must_use]
    pub fn with(mut self, group: Group, factor: f64) -> Self {
        self.factors[group as usize] = factor;
        self
    }

    /// The factor of a group's rates.
    pub fn factor(&self, group: Group) -> f64 {
        self.factors[group as usize]
    }
}

impl ReconstructParams {
    /// The phases of a run. The first starts at 0, and each ends where the next begins. Water that was found
    /// beforehand is held for `medium_hold` of the course, and then moves at `medium_release` of its rates.
    pub fn phases(&self, found_water: bool) -> Vec<Phase> {
        match found_water {
            false => vec![Phase::new(0.0)],
            true => vec![
                Phase::new(0.0).with(Group::Water, 0.0),
                Phase::new(self.medium_hold).with(Group::Water, self.medium_release),
            ],
        }
    }

    /// The learning rates of a step, and that of the views' gains. `phases` are ordered by their start.
    pub fn rates(&self, phases: &[Phase], step: u64) -> (StepRates, f64) {
        let course = self.course();
        let reached = phases.iter().rev().find(|phase| step as f64 >= phase.from * course as f64);
        let phase = reached.copied().unwrap_or(Phase::new(0.0));
        let compressed = (self.schedule as f64 / course as f64).min(MOST_COMPRESSED);
        let of = |group: Group, rate: Rate| {
            let slow = if group == Group::Gaussians { 1.0 } else { compressed };
            phase.factor(group) * slow * rate.at(step, course)
        };
        let r = &self.learning_rates;
        let rates = StepRates {
            means: of(Group::Gaussians, r.means),
            sh_constant: of(Group::Gaussians, r.sh_constant),
            sh_directional: of(Group::Gaussians, r.sh_directional),
            opacity: of(Group::Gaussians, r.opacity),
            scales: of(Group::Gaussians, r.scales),
            quaternions: of(Group::Gaussians, r.quaternions),
            medium_constant: of(Group::Water, r.medium_constant),
            medium_directional: of(Group::Water, r.medium_directional),
            medium_network: of(Group::Water, r.medium_network),
        };
        (rates, of(Group::Views, r.exposure))
    }

    /// The settings of the colour field in a step; `None` without a field. Its rates are those of a run of
    /// any length.
    pub fn color_step(&self, step: u64) -> Option<ColorStep> {
        let (course, rates) = (self.course(), &self.learning_rates.color_field);
        (self.color_field != ColorField::Off).then(|| ColorStep {
            rates: [rates.grid, rates.network, rates.code].map(|rate| rate.at(step, course)),
            weight: self.color_weight,
            alone: (step as f64) < self.color_alone * course as f64,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn found_water_is_held_and_then_released() {
        let params = ReconstructParams {
            iterations: 1000,
            schedule: 1000,
            medium_hold: 0.5,
            medium_release: 0.3,
            ..ReconstructParams::default()
        };
        let (free, held) = (params.phases(false), params.phases(true));
        let water = |phases: &[Phase], step| params.rates(phases, step).0.medium_constant;
        assert_eq!((water(&held, 0), water(&held, 499)), (0.0, 0.0));
        assert_eq!(water(&held, 500), 0.3 * water(&free, 500));
        assert_eq!(params.rates(&held, 100).0.means, params.rates(&free, 100).0.means);
        // Without a hold the water moves from the first step on.
        let at_once = ReconstructParams { medium_hold: 0.0, ..params.clone() };
        assert!(at_once.rates(&at_once.phases(true), 0).0.medium_constant > 0.0);
    }

    #[test]
    fn every_group_can_be_held_alone() {
        let params = ReconstructParams::default();
        let all = params.rates(&params.phases(false), 7);
        for group in [Group::Gaussians, Group::Water, Group::Views] {
            let phases = [Phase::new(0.0).with(group, 0.0), Phase::new(0.5)];
            let (rates, views) = params.rates(&phases, 7);
            let moves = [rates.means, rates.medium_network, views].map(|rate| rate > 0.0);
            assert_eq!(moves, [Group::Gaussians, Group::Water, Group::Views].map(|g| g != group));
            assert_eq!(
                params.rates(&phases, params.course()),
                params.rates(&params.phases(false), params.course())
            );
        }
        assert!(all.0.means > 0.0);
    }

    #[test]
    fn a_field_is_learnt_alone_for_its_share_of_the_run() {
        let mut params = ReconstructParams { iterations: 900, schedule: 900, ..ReconstructParams::default() };
        assert_eq!(params.color_step(0), None);
        (params.color_field, params.color_alone) = (ColorField::Caustics, 1.0 / 3.0);
        let alone = |step| params.color_step(step).map(|colors| colors.alone);
        assert_eq!([0, 299, 300, 899].map(alone), [Some(true), Some(true), Some(false), Some(false)]);
        let rates = params.color_step(0).unwrap().rates;
        let expected = [1e-2, 1e-3, 2e-3];
        assert!(rates.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12), "{rates:?}");
    }

    #[test]
    fn short_runs_take_longer_steps_for_water_and_views_only() {
        let long = ReconstructParams { iterations: 15_000, ..ReconstructParams::default() };
        let short = ReconstructParams { iterations: 3000, ..long.clone() };
        let [long, short] = [long, short].map(|p| p.rates(&p.phases(false), 0));
        assert_eq!(short.0.means, long.0.means);
        assert_eq!(short.0.medium_constant, 5.0 * long.0.medium_constant);
        assert_eq!(short.1, 5.0 * long.1);
    }
}
