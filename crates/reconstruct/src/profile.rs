//! The parts of a step of stage 1.

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
