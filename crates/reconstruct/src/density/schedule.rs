//! The steps at which density control works, and its settings there (R9).

use super::RefineSettings;
use crate::{ReconstructParams, Strategy};

/// The work of density control after a step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct DensityWork {
    /// The statistics of the screen gradients are used or forgotten.
    pub(crate) refinement: Option<Refinement>,
    /// Opacities are lowered to this afterwards.
    pub(crate) ceiling: Option<f64>,
}

/// The use of the statistics that were gathered since the last one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Refinement {
    /// Gaussians are added and removed.
    Grow,
    /// Gaussians are only removed.
    Cull,
    /// The pause after a ceiling: the statistics are forgotten.
    Pause,
}

impl ReconstructParams {
    /// The work of density control after `step`, with `views` training views. Densification waits after a
    /// ceiling until most views were seen again; culling alone continues to the end.
    pub(crate) fn density_work(&self, step: u64, views: usize) -> DensityWork {
        let d = &self.densify;
        if !d.enabled || step <= self.warm_up() {
            return DensityWork::default();
        }
        if d.strategy == Strategy::Signed {
            let done = step + 1;
            let at = |every: u64| done < self.densify_end() && done.is_multiple_of(every);
            let refinement = at(d.every).then_some(Refinement::Grow);
            let lower = [(d.period, d.opacity_ceiling), (d.lower_every, d.lower_to)];
            let mut due = lower.into_iter().filter(|(every, _)| *every > 0 && at(*every));
            let ceiling = due.next().filter(|_| !self.is_gentle()).map(|(_, most)| most);
            return DensityWork { refinement, ceiling };
        }
        let growing = step < self.densify_end();
        let ceilings = growing && !self.is_gentle();
        let phase = step % d.period;
        let pause = d.pause.min(views as u64 + d.every);
        let refinement = step.is_multiple_of(d.every).then_some(match (growing, ceilings && phase < pause) {
            (_, true) => Refinement::Pause,
            (true, false) => Refinement::Grow,
            (false, false) => Refinement::Cull,
        });
        let ceiling = (ceilings && phase == d.every % d.period).then_some(d.opacity_ceiling);
        DensityWork { refinement, ceiling }
    }

    /// The number of Gaussians to which a scene has grown after `step`.
    fn budget(&self, step: u64) -> Option<usize> {
        let (from, until) = (self.warm_up() as f64, self.densify_end() as f64);
        let share = ((step as f64 - from) / (until - from).max(1.0)).clamp(0.0, 1.0);
        (self.densify.budget > 0).then(|| (share.sqrt() * self.densify.budget as f64) as usize)
    }

    /// The settings of a refinement after `step` of a scene that began with `initial` Gaussians and may have
    /// `most`. Sizes are in units of `unit`.
    pub(crate) fn refine_settings(
        &self,
        grow: bool,
        (step, unit): (u64, f64),
        initial: usize,
        most: usize,
    ) -> RefineSettings {
        let d = &self.densify;
        let signed = d.strategy == Strategy::Signed;
        let by_size = !signed || step + 1 > d.period;
        let limit = |size: f64| if by_size && size > 0.0 { size } else { f64::INFINITY };
        RefineSettings {
            grow,
            gradient_threshold: d.gradient_threshold,
            split_threshold: d.compares_both().then_some(d.split_threshold),
            split_scale: unit * d.split_scale,
            cull_opacity: self.cull_opacity(grow),
            cull_scale: limit(unit * d.cull_scale),
            cull_radius: limit(if signed { d.cull_screen } else { 0.0 }),
            after_growth: signed.then_some(d.shrink),
            floor: d.floor.max((d.floor_share * initial as f64) as usize),
            most,
            budget: self.budget(step),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Densify;

    /// The values of the preset `paper`.
    fn paper() -> ReconstructParams {
        let densify = Densify {
            statistics_from: 100,
            warm_up: 600,
            every: 100,
            period: 500,
            pause: 250,
            until: 2.0 / 3.0,
            gradient_threshold: 8e-4,
            cull_opacity: 0.5,
            cull_opacity_late: 0.1,
            gentle_below: 0,
            ..Densify::default()
        };
        ReconstructParams { iterations: 15_000, schedule: 15_000, densify, ..ReconstructParams::default() }
    }

    /// Steps of 15,000 with some work.
    fn steps(params: &ReconstructParams, views: usize, which: impl Fn(DensityWork) -> bool) -> Vec<u64> {
        (0..15_000).filter(|&step| which(params.density_work(step, views))).collect()
    }

    /// The blocks of 500 steps from the first to the last one before 10,000, with some steps of each; the
    /// warm-up ends at 600.
    fn of_each_block(offsets: &[u64]) -> Vec<u64> {
        let all = (0..20).flat_map(|block| offsets.iter().map(move |offset| 500 * block + offset));
        all.filter(|&step| step > 600).collect()
    }

    /// The rule of R9 with its numbers, by hand. A ceiling comes 100 steps into each block of 500. The pause
    /// lasts until the smaller of 250 and N + 100 steps into the block: 118 for 18 views, 200 for 100, 205
    /// for 105, 250 for 250. Refinements come every 100 steps, so the first after the pause is at 200 for 18
    /// and for 100 views, and at 300 for 105 and for 250. From step 10,000 on Gaussians are only removed.
    #[test]
    fn fifteen_thousand_steps_for_captures_of_four_sizes() {
        let params = paper();
        for (views, pauses, grows) in [
            (18, &[0, 100][..], &[200, 300, 400][..]),
            (100, &[0, 100], &[200, 300, 400]),
            (105, &[0, 100, 200], &[300, 400]),
            (250, &[0, 100, 200], &[300, 400]),
            (5000, &[0, 100, 200], &[300, 400]),
        ] {
            let refinement = |which| steps(&params, views, |work| work.refinement == Some(which));
            assert_eq!(refinement(Refinement::Pause), of_each_block(pauses), "{views} views");
            assert_eq!(refinement(Refinement::Grow), of_each_block(grows), "{views} views");
            let late: Vec<u64> = (100..150).map(|hundreds| 100 * hundreds).collect();
            assert_eq!(refinement(Refinement::Cull), late, "{views} views");
            assert_eq!(
                steps(&params, views, |work| work.ceiling.is_some()),
                of_each_block(&[100]),
                "{views} views"
            );
        }
        // Blocks 2 to 19 have a ceiling: those of steps 100 and 600 are in the warm-up.
        let ceilings = steps(&params, 18, |work| work.ceiling.is_some());
        assert_eq!((ceilings.len(), ceilings[0], ceilings[17]), (18, 1100, 9600));
    }

    #[test]
    fn a_gentle_run_neither_pauses_nor_lowers_and_one_without_density_control_does_nothing() {
        let mut params = paper();
        params.densify.gentle_below = 15_001;
        let every: Vec<u64> = (7..100).map(|hundreds| 100 * hundreds).collect();
        assert_eq!(steps(&params, 18, |work| work.refinement == Some(Refinement::Grow)), every);
        assert!(steps(&params, 18, |work| work.ceiling.is_some()).is_empty());
        params.densify.enabled = false;
        assert!(steps(&params, 18, |work| work != DensityWork::default()).is_empty());
    }

    #[test]
    fn the_rules_of_3dgs_have_no_pause_and_no_late_culling_and_limit_sizes_after_the_first_ceiling() {
        let mut params = paper();
        params.densify.strategy = Strategy::Signed;
        (params.densify.warm_up, params.densify.period, params.densify.cull_screen) = (500, 3000, 20.0);
        (params.densify.cull_scale, params.densify.split_scale) = (0.1, 0.01);
        let grown = steps(&params, 18, |work| work.refinement == Some(Refinement::Grow));
        assert_eq!((grown[0], grown[1], grown.len(), grown[93]), (599, 699, 94, 9899));
        assert!(
            steps(&params, 18, |work| !matches!(work.refinement, None | Some(Refinement::Grow))).is_empty()
        );
        assert_eq!(steps(&params, 18, |work| work.ceiling.is_some()), [2999, 5999, 8999]);
        let at = |step| params.refine_settings(true, (step, 2.0), 5000, 70_000);
        assert_eq!((at(2999).cull_scale, at(2999).cull_radius), (f64::INFINITY, f64::INFINITY));
        assert_eq!((at(3099).cull_scale, at(3099).cull_radius, at(3099).split_scale), (0.2, 20.0, 0.02));
        assert_eq!(at(0).after_growth, Some(params.densify.shrink));
        // 3D-UIR lowers opacities between two ceilings, too.
        (params.densify.lower_every, params.densify.lower_to) = (500, 0.8);
        let lowered: Vec<_> = [2499, 2999, 3499].map(|step| params.density_work(step, 18).ceiling).into();
        assert_eq!(lowered, [Some(0.8), Some(params.densify.opacity_ceiling), Some(0.8)]);
        assert_eq!(steps(&params, 18, |work| work.ceiling.is_some()).len(), 18);
    }

    #[test]
    fn a_budget_follows_the_root_of_the_time() {
        let mut params = paper();
        params.densify.budget = 40_000;
        let budget = |step| params.refine_settings(true, (step, 1.0), 300, 70_000).budget;
        assert_eq!([600, 2950, 10_000].map(budget), [Some(0), Some(20_000), Some(40_000)]);
        params.densify.budget = 0;
        assert_eq!(params.refine_settings(true, (2950, 1.0), 300, 70_000).budget, None);
    }

    #[test]
    fn faint_gaussians_are_removed_below_a_half_while_growing_and_below_a_tenth_afterwards() {
        let growing = paper().refine_settings(true, (700, 1.0), 5000, 70_000);
        let expected = RefineSettings {
            grow: true,
            gradient_threshold: 8e-4,
            split_threshold: None,
            split_scale: 1e-3,
            cull_opacity: 0.5,
            cull_scale: 10.0,
            cull_radius: f64::INFINITY,
            after_growth: None,
            floor: 500,
            most: 70_000,
            budget: None,
        };
        assert_eq!(growing, expected);
        let late = paper().refine_settings(false, (700, 1.0), 300, 70_000);
        assert_eq!(late, RefineSettings { grow: false, cull_opacity: 0.1, floor: 100, ..expected });
    }
}
