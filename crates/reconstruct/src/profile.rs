//! The time that stage 1 takes: the parts of a step, and the growth of a step with the scene.

use std::time::Duration;

use use3d_training::Part;

/// The parts of a step, in order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StepPart {
    /// The target at the step's size.
    Target,
    /// The water's maps.
    Water,
    /// Projection, sorting, tile lists.
    Project,
    /// The compositor.
    Compose,
    /// Losses and their gradient with respect to the image.
    Loss,
    /// The compositor and the projection backward.
    ComposeBackward,
    /// The water backward.
    WaterBackward,
    /// Adam.
    Adam,
    /// Density statistics and refinements.
    Density,
}

impl Part for StepPart {
    const ALL: &'static [(Self, &'static str)] = &[
        (Self::Target, "target"),
        (Self::Water, "water"),
        (Self::Project, "project"),
        (Self::Compose, "compose"),
        (Self::Loss, "loss"),
        (Self::ComposeBackward, "compose backward"),
        (Self::WaterBackward, "water backward"),
        (Self::Adam, "adam"),
        (Self::Density, "density"),
    ];
}

/// A stretch of the run, and the time of its steps. It is never stored, because times differ from run to
/// run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stretch {
    /// The last step of the stretch, counted from 1.
    pub step: u64,
    /// Number of steps in the stretch.
    pub steps: u64,
    /// Image divisor at its end.
    pub divisor: usize,
    /// Number of Gaussians at its end.
    pub gaussians: usize,
    /// Millions of (pixel, Gaussian) pairs that contribute to the last step's view, estimated from every
    /// fourth pixel in both directions.
    pub pairs: f64,
    /// Time of all its steps.
    pub spent: Duration,
}

/// A table of stretches: step time beside contributing pairs.
pub fn growth(stretches: &[Stretch]) -> String {
    let mut text = format!(
        "{:>9} {:>7} {:>10} {:>9} {:>9} {:>8}\n",
        "to step", "divisor", "Gaussians", "M pairs", "ms/step", "ns/pair"
    );
    for s in stretches {
        let step = s.spent.as_secs_f64() / s.steps.max(1) as f64;
        text += &format!(
            "{:>9} {:>7} {:>10} {:>9.2} {:>9.2} {:>8.2}\n",
            s.step,
            s.divisor,
            s.gaussians,
            s.pairs,
            1e3 * step,
            if s.pairs > 0.0 { 1e3 * step / s.pairs } else { 0.0 },
        );
    }
    text
}
