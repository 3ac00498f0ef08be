//! Density control: adds Gaussians in some places and removes them in others (R9).
//!
//! The criterion is the mean, over the renders since the last refinement in which a Gaussian was visible,
//! of
//!
//! ```text
//! | (½ W Σ_p |∂L_p/∂x|,  ½ H Σ_p |∂L_p/∂y|) |₂
//! ```
//!
//! This is the absolute gradient of the loss with respect to the Gaussian's position on the screen, so that
//! opposite gradients do not cancel. It is scaled to the image size for which the threshold is meant. Above
//! the threshold, a Gaussian whose largest standard deviation exceeds a size is replaced by two drawn from
//! it, smaller by a factor; a smaller one gets a twin. Faint and huge Gaussians are removed, but never below
//! a floor (the most opaque stay), and growth stops at a cap (the largest gradients first). New Gaussians
//! start with zero moments.
//!
//! Other rules are settings: children on the long axis ([`Draws::child`]), a choice by errors, a floor of
//! sizes ([`Evidence`]), and a budget.
//!
//! An engine returns a [`Survey`]; [`plan`] computes the rows of the refined scene, and [`rebuilt`] the
//! content of each row. Both are functions of their arguments alone, so that every engine refines alike: it
//! may call `rebuilt` or do the same where its arrays are.

mod evidence;
mod noise;
mod rebuild;
mod schedule;

pub use evidence::Evidence;
pub(crate) use evidence::GrowthViews;
pub(crate) use noise::scatter;
pub use rebuild::{Child, Children, Draws, Origin, rebuilt};
pub(crate) use schedule::Refinement;

use use3d_numerics::math;
use use3d_splat::Gaussians;

use crate::engine::Statistics;

/// The input of density control for every Gaussian: N rows each.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Survey {
    /// Opacity logits.
    pub opacity_logits: Vec<f32>,
    /// The largest of the three log standard deviations.
    pub log_sizes: Vec<f32>,
    /// Screen gradients since the last refinement.
    pub statistics: Statistics,
    /// The evidence of several views; empty if no rule looks at them.
    pub evidence: Evidence,
}

impl Survey {
    /// The survey of Gaussians and their statistics in main memory.
    pub fn of(gaussians: &Gaussians, statistics: &Statistics) -> Self {
        Self {
            opacity_logits: gaussians.opacity_logits.clone(),
            log_sizes: gaussians.log_scales.iter().map(|s| s[0].max(s[1]).max(s[2])).collect(),
            statistics: statistics.clone(),
            evidence: Evidence::default(),
        }
    }
}

/// The settings of one refinement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RefineSettings {
    /// True if Gaussians are split and duplicated.
    pub grow: bool,
    /// Mean absolute screen gradient above which they are split or duplicated.
    pub gradient_threshold: f64,
    /// Mean absolute screen gradient above which they are split, if another one decides on duplicates.
    pub split_threshold: Option<f64>,
    /// Largest standard deviation of a duplicate.
    pub split_scale: f64,
    /// Opacity below which Gaussians are removed.
    pub cull_opacity: f64,
    /// Standard deviation above which they are removed.
    pub cull_scale: f64,
    /// Radius on the screen above which they are removed, pixels.
    pub cull_radius: f64,
    /// The factor by which children are smaller, if Gaussians are removed by their sizes after growth; `None`
    /// if before.
    pub after_growth: Option<f64>,
    /// Culling leaves at least this many Gaussians.
    pub floor: usize,
    /// Growth leaves at most this many Gaussians.
    pub most: usize,
    /// The number of Gaussians to which a scene grows, whatever the thresholds.
    pub budget: Option<usize>,
}

/// The result of a refinement.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RefineReport {
    /// Number of Gaussians replaced by two smaller ones.
    pub split: usize,
    /// Number of Gaussians that got a twin.
    pub duplicated: usize,
    /// Number of Gaussians removed.
    pub culled: usize,
    /// Number of Gaussians that were kept only because of the floor.
    pub spared: usize,
    /// Number of Gaussians that were not split or duplicated because of the cap.
    pub held_back: usize,
}

/// Computes the rows of the refined scene: survivors in their order, then twins and children in the order
/// of their parents. All arrays of `survey` have the same length.
pub fn plan(survey: &Survey, settings: &RefineSettings) -> (Vec<Origin>, RefineReport) {
    let Survey { opacity_logits, log_sizes, statistics, evidence } = survey;
    let n = opacity_logits.len();
    let mut report = RefineReport::default();
    let largest = |i: usize| math::exp(f64::from(log_sizes[i]));
    let faint = logit(settings.cull_opacity);
    let wide = |i: usize| largest(i) > settings.split_scale;
    // In units of the threshold of duplicates, so that splits and duplicates can be compared.
    let pull = |i: usize| match settings.split_threshold {
        Some(split) if wide(i) => statistics.absolute_mean(i) * settings.gradient_threshold / split,
        _ => statistics.mean(i),
    };
    let pulled = |i: usize| pull(i) > settings.gradient_threshold;
    let radius = |i: usize| f64::from(statistics.radii.get(i).copied().unwrap_or(0.0));
    let fits = |i: usize| match settings.after_growth.filter(|_| settings.grow && pulled(i) && wide(i)) {
        // Children have no radius yet.
        Some(shrink) => largest(i) <= shrink * settings.cull_scale,
        None => largest(i) <= settings.cull_scale && radius(i) <= settings.cull_radius,
    };
    let mut keep: Vec<bool> = (0..n).map(|i| opacity_logits[i] >= faint && fits(i)).collect();
    let survivors = keep.iter().filter(|k| **k).count();
    let floor = settings.floor.min(n);
    if survivors < floor {
        let mut condemned: Vec<usize> = (0..n).filter(|&i| !keep[i]).collect();
        let opacity = |i: usize| opacity_logits[i];
        condemned.sort_by(|&a, &b| opacity(b).total_cmp(&opacity(a)).then(a.cmp(&b)));
        for &i in condemned.iter().take(floor - survivors) {
            keep[i] = true;
            report.spared += 1;
        }
    }
    let survivors = keep.iter().filter(|k| **k).count();
    report.culled = n - survivors;

    let mut grow = vec![false; n];
    if settings.grow {
        let may = |i: usize| keep[i] && !evidence.too_small.get(i).is_some_and(|small| *small);
        let rank = |i: usize| evidence.scores.get(i).map_or_else(|| pull(i), |score| f64::from(*score));
        let wanted = match settings.budget {
            Some(budget) => budget.saturating_sub(survivors),
            None => (0..n).filter(|&i| may(i) && pulled(i)).count(),
        };
        let ranked = settings.budget.is_some() || !evidence.scores.is_empty();
        let candidate = |i: usize| may(i) && if ranked { rank(i) > 0.0 } else { pulled(i) };
        let mut chosen: Vec<usize> = (0..n).filter(|&i| candidate(i)).collect();
        let (wanted, room) = (wanted.min(chosen.len()), settings.most.saturating_sub(survivors));
        report.held_back = wanted.saturating_sub(room);
        if chosen.len() > wanted.min(room) {
            chosen.sort_by(|&a, &b| rank(b).total_cmp(&rank(a)).then(a.cmp(&b)));
            chosen.truncate(wanted.min(room));
        }
        for i in chosen {
            grow[i] = true;
        }
    }
    let splits = |i: usize| grow[i] && wide(i);
    let mut rows: Vec<Origin> = (0..n).filter(|&i| keep[i] && !splits(i)).map(Origin::Kept).collect();
    for i in (0..n).filter(|&i| grow[i]) {
        if splits(i) {
            report.split += 1;
            rows.extend([Origin::Child(i, 0), Origin::Child(i, 1)]);
        } else {
            report.duplicated += 1;
            rows.push(Origin::Twin(i));
        }
    }
    (rows, report)
}

/// `ln(p / (1 − p))` of an opacity, with the ends at ±infinity.
pub fn logit(p: f64) -> f32 {
    math::ln(p / (1.0 - p)) as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::zeros;

    const SETTINGS: RefineSettings = RefineSettings {
        grow: true,
        gradient_threshold: 8e-4,
        split_threshold: None,
        split_scale: 1e-3,
        cull_opacity: 0.5,
        cull_scale: 10.0,
        cull_radius: f64::INFINITY,
        after_growth: None,
        floor: 2,
        most: 1000,
        budget: None,
    };
    const DRAWS: Draws = Draws { split: Children::Drawn, seed: 1, step: 700, shrink: 1.6 };

    /// Gaussians from rows of (opacity logit, standard deviation, mean screen gradient).
    fn scene(rows: &[(f32, f32, f32)]) -> (Gaussians, Survey) {
        let mut g = zeros(rows.len(), 0);
        let mut statistics = Statistics::new(rows.len());
        for (i, &(logit, deviation, gradient)) in rows.iter().enumerate() {
            g.opacity_logits[i] = logit;
            g.log_scales[i] = [math::ln(deviation), -9.0, -9.0];
            g.quaternions[i] = [1.0, 0.0, 0.0, 0.0];
            g.means[i] = [i as f32, 0.0, 0.0];
            statistics.norms[i] = 4.0 * gradient;
            statistics.renders[i] = 4;
        }
        let survey = Survey::of(&g, &statistics);
        (g, survey)
    }

    #[test]
    fn the_rules_in_turn() {
        let (g, s) = scene(&[
            (2.0, 0.1, 0.0),   // stays
            (2.0, 0.1, 1e-3),  // splits
            (2.0, 5e-4, 1e-3), // duplicates
            (-0.1, 0.1, 1.0),  // faint: removed
            (2.0, 11.0, 1.0),  // huge: removed
        ]);
        let (rows, report) = plan(&s, &SETTINGS);
        use Origin::*;
        assert_eq!(rows, [Kept(0), Kept(2), Child(1, 0), Child(1, 1), Twin(2)]);
        assert_eq!(report, RefineReport { split: 1, duplicated: 1, culled: 2, spared: 0, held_back: 0 });
        let refined = rebuilt(&g, &rows, &DRAWS);
        assert_eq!(refined.means[4], g.means[2]);
        assert!((refined.log_scales[2][0] - math::ln(0.1f32 / 1.6)).abs() < 1e-6);
        assert!(refined.means[2] != refined.means[3] && (refined.means[2][0] - 1.0).abs() < 0.6);
        // Children are drawn from the parent, so they hardly move along its thin axes.
        assert!(refined.means[2][1].abs() < 1e-2);
        // Without growth Gaussians are only removed.
        let (rows, _) = plan(&s, &RefineSettings { grow: false, ..SETTINGS });
        assert_eq!(rows, [Kept(0), Kept(1), Kept(2)]);
    }

    /// One percent around each threshold, on both sides: `exp(log s)` and `logit` in single precision err by
    /// 1e-6 at most.
    #[test]
    fn every_threshold_lies_where_the_settings_say() {
        let opacity = |p: f64| math::ln(p / (1.0 - p)) as f32;
        let settings = RefineSettings { cull_opacity: 0.1, ..SETTINGS };
        let (_, s) = scene(&[
            (2.0, 5e-4, 8e-4 * 0.99),
            (2.0, 5e-4, 8e-4 * 1.01),
            (2.0, 1e-3 * 0.99, 1.0),
            (2.0, 1e-3 * 1.01, 1.0),
            (opacity(0.1 * 0.99), 0.1, 0.0),
            (opacity(0.1 * 1.01), 0.1, 0.0),
            (2.0, 10.0 * 0.99, 0.0),
            (2.0, 10.0 * 1.01, 0.0),
        ]);
        let (rows, report) = plan(&s, &settings);
        use Origin::*;
        let kept = [0, 1, 2, 5, 6].map(Kept);
        assert_eq!(rows, [&kept[..], &[Twin(1), Twin(2), Child(3, 0), Child(3, 1)]].concat());
        assert_eq!(report, RefineReport { split: 1, duplicated: 2, culled: 2, spared: 0, held_back: 0 });
    }

    #[test]
    fn the_floor_spares_the_most_opaque_and_the_cap_prefers_the_strongest_pulls() {
        let (_, s) = scene(&[(-3.0, 0.1, 0.0), (-1.0, 0.1, 0.0), (-2.0, 0.1, 0.0)]);
        let (rows, report) = plan(&s, &SETTINGS);
        assert_eq!(rows, [Origin::Kept(1), Origin::Kept(2)]);
        assert_eq!((report.culled, report.spared), (1, 2));
        let (_, s) = scene(&[(2.0, 1e-4, 1e-3), (2.0, 1e-4, 3e-3), (2.0, 1e-4, 2e-3)]);
        let (rows, report) = plan(&s, &RefineSettings { most: 4, ..SETTINGS });
        assert_eq!(rows.last(), Some(&Origin::Twin(1)));
        assert_eq!((rows.len(), report.held_back), (4, 2));
    }

    #[test]
    fn large_gaussians_of_3dgs_are_removed_after_growth() {
        // Three are larger than allowed; the first is split below that size, and the second is not.
        let rows =
            [(3.0, 0.15, 9e-4), (3.0, 0.2, 9e-4), (3.0, 0.15, 0.0), (3.0, 0.05, 0.0), (3.0, 0.05, 0.0)];
        let (_, mut s) = scene(&rows);
        s.statistics.radii = vec![0.0, 0.0, 0.0, 30.0, 10.0];
        let limits = RefineSettings { cull_scale: 0.1, cull_radius: 20.0, ..SETTINGS };
        let (rows, report) = plan(&s, &RefineSettings { after_growth: Some(1.6), ..limits });
        assert_eq!(rows, [Origin::Kept(4), Origin::Child(0, 0), Origin::Child(0, 1)]);
        assert_eq!((report.split, report.culled), (1, 3));
        let (rows, _) = plan(&s, &RefineSettings { floor: 0, ..limits });
        assert_eq!(rows, [Origin::Kept(4)], "before growth the first is too large, too");
    }

    #[test]
    fn absolute_gradients_split_and_signed_ones_duplicate() {
        // Two large and two small Gaussians. One of each has a signed gradient, and one an absolute one.
        let (_, mut s) = scene(&[(3.0, 0.1, 3e-4), (3.0, 0.1, 0.0), (3.0, 5e-4, 3e-4), (3.0, 5e-4, 0.0)]);
        let absolute = [0.0, 5e-4, 0.0, 5e-4].map(|norm: f32| 4.0 * norm);
        s.statistics.norms.extend(absolute);
        let settings = RefineSettings { gradient_threshold: 2e-4, split_threshold: Some(4e-4), ..SETTINGS };
        use Origin::*;
        let (rows, report) = plan(&s, &settings);
        assert_eq!(rows, [Kept(0), Kept(2), Kept(3), Child(1, 0), Child(1, 1), Twin(2)]);
        assert_eq!((report.split, report.duplicated), (1, 1));
        let (rows, _) = plan(&s, &RefineSettings { split_threshold: Some(5.1e-4), ..settings });
        assert_eq!(rows, [Kept(0), Kept(1), Kept(2), Kept(3), Twin(2)]);
    }

    #[test]
    fn a_budget_takes_the_first_candidates_whatever_the_threshold() {
        use Origin::*;
        let (_, mut s) = scene(&[(2.0, 1e-4, 1e-5), (2.0, 1e-4, 3e-5), (2.0, 1e-4, 2e-5), (2.0, 1e-4, 0.0)]);
        let to = |budget| RefineSettings { budget: Some(budget), ..SETTINGS };
        let born = |s: &Survey, settings: &RefineSettings| -> Vec<Origin> {
            plan(s, settings).0.into_iter().filter(|row| !matches!(row, Kept(_))).collect()
        };
        assert_eq!(born(&s, &to(6)), [Twin(1), Twin(2)]);
        assert_eq!(born(&s, &to(3)), []);
        assert_eq!(born(&s, &to(90)), [Twin(0), Twin(1), Twin(2)], "the last one was not seen");
        let (rows, report) = plan(&s, &RefineSettings { most: 5, ..to(6) });
        assert_eq!((rows.len(), report.held_back), (5, 1));
        // A Gaussian that the screen does not resolve is left alone.
        s.evidence.too_small = vec![false, true, false, false];
        assert_eq!(born(&s, &to(6)), [Twin(0), Twin(2)]);
    }

    #[test]
    fn errors_choose_as_many_as_the_gradient_would() {
        use Origin::*;
        let (_, mut s) = scene(&[(2.0, 1e-4, 1e-3), (2.0, 1e-4, 0.0), (2.0, 1e-4, 9e-4), (2.0, 1e-4, 0.0)]);
        s.evidence.scores = vec![0.1, 0.4, 0.2, 0.3];
        assert_eq!(plan(&s, &SETTINGS).0[4..], [Twin(1), Twin(3)]);
    }

    #[test]
    fn children_on_the_long_axis_end_where_their_parent_ends() {
        let (mut g, s) = scene(&[(2.0, 0.1, 1.0)]);
        // The long axis is the second one; a quarter turn about z lays it along −x.
        g.log_scales[0] = [math::ln(0.02f32), math::ln(0.1f32), math::ln(0.03f32)];
        g.quaternions[0] = [1.0, 0.0, 0.0, 1.0];
        let (rows, _) = plan(&s, &RefineSettings { floor: 0, ..SETTINGS });
        let children = rebuilt(&g, &rows, &Draws { split: Children::LongAxis, ..DRAWS });
        assert_eq!(children.len(), 2);
        for (i, side) in [(0, 1.0f32), (1, -1.0)] {
            let [x, y, z] = children.means[i];
            let scales = children.log_scales[i].map(math::exp);
            assert!(
                (x - side * 0.135).abs() < 1e-6 && y.abs() < 1e-6 && z.abs() < 1e-6,
                "{:?}",
                children.means
            );
            // Three standard deviations of the child end at three of the parent: 0.3.
            assert!((x.abs() + 3.0 * scales[1] - 0.3).abs() < 1e-6, "{scales:?}");
            let section = (1.0f32 - 0.45 * 0.45).sqrt();
            assert!((scales[0] - 0.02 * section).abs() < 1e-7 && (scales[2] - 0.03 * section).abs() < 1e-7);
            let opacity = |logit: f32| 1.0 / (1.0 + math::exp(-logit));
            assert!((opacity(children.opacity_logits[i]) - 0.6 * opacity(2.0)).abs() < 1e-6);
        }
        let on_screen = Draws { split: Children::LongAxis, ..DRAWS }.shrinkage();
        assert!((on_screen - 1.0 / (0.55f64 * (1.0f64 - 0.2025).sqrt()).sqrt()).abs() < 1e-12);
    }

    #[test]
    fn children_have_the_spread_of_their_parent() {
        let n = 4000;
        let (mut g, s) = scene(&vec![(2.0, 0.2, 1.0); n]);
        let angle = std::f32::consts::FRAC_PI_4;
        for i in 0..n {
            g.means[i] = [0.0; 3];
            // A quarter turn about z, as a quaternion of length 2: the long axis is y.
            g.quaternions[i] = [2.0 * math::cos(angle), 0.0, 0.0, 2.0 * math::sin(angle)];
        }
        let settings = RefineSettings { most: 10 * n, ..SETTINGS };
        let (rows, _) = plan(&s, &settings);
        let refined = rebuilt(&g, &rows, &DRAWS);
        let spread = |axis: usize| {
            (refined.means.iter().map(|m| math::powi(f64::from(m[axis]), 2)).sum::<f64>()
                / refined.len() as f64)
                .sqrt()
        };
        assert!((spread(1) - 0.2).abs() < 0.01 && spread(0) < 1e-3, "{} {}", spread(0), spread(1));
    }
}
