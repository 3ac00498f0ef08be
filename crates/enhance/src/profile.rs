//! The parts of a step of stage 2.

use use3d_training::Part;

/// The parts of a step, in order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StepPart {
    /// The view's constants, if they do not stay in memory.
    Prepare,
    /// The field at the Gaussians of the step, and their colours.
    Field,
    /// The water's maps.
    Water,
    /// The compositor.
    Compose,
    /// The extractor, the losses, their gradient with respect to the image.
    Loss,
    /// The compositor backward.
    ComposeBackward,
    /// The field backward, its total variation included.
    FieldBackward,
    /// The water backward.
    WaterBackward,
    /// Adam.
    Adam,
}

impl Part for StepPart {
    const ALL: &'static [(Self, &'static str)] = &[
        (Self::Prepare, "prepare"),
        (Self::Field, "field"),
        (Self::Water, "water"),
        (Self::Compose, "compose"),
        (Self::Loss, "loss"),
        (Self::ComposeBackward, "compose backward"),
        (Self::FieldBackward, "field backward"),
        (Self::WaterBackward, "water backward"),
        (Self::Adam, "adam"),
    ];
}
