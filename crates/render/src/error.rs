//! The errors of rendering.

/// An error of rendering.
#[derive(Debug, thiserror::Error)]
pub enum RenderError {
    /// The scene was not processed by stage 2.
    #[error("the scene has no enhancement; run `use3d enhance` on it first")]
    NotEnhanced,
    /// The strength is outside `[0, 1]`.
    #[error("strength is {0}; expected 0 (the reconstruction) to 1 (fully enhanced)")]
    Strength(f32),
    /// The amount of water is outside `[0, 1]`.
    #[error("the amount of water is {0}; expected 0 (none is left) to 1 (all of it)")]
    Water(f32),
    /// Water is baked as seen by cameras, and there are none.
    #[error("a look with water is baked as cameras saw it: give at least one camera")]
    NoCameras,
    /// Water of finished images, with normalised distances or a network of the depth, cannot be baked.
    #[error(
        "the water `{0}` belongs to finished images and cannot be written into colours; choose the look `clear`"
    )]
    NoPlace(&'static str),
    /// The device of a composer failed. [`crate::Processor`] never returns this.
    #[error("drawing on {device} failed: {problem}; the CPU draws the same pictures")]
    Device {
        /// The device, by its name.
        device: String,
        /// The failure in words: lost, out of memory, ....
        problem: String,
    },
}
