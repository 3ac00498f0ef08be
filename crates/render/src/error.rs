//! What keeps a scene from being drawn.

/// An error of rendering.
#[derive(Debug, thiserror::Error)]
pub enum RenderError {
    /// A scene that stage 2 has not seen.
    #[error("the scene has no enhancement; run `use3d enhance` on it first")]
    NotEnhanced,
    /// A strength outside `[0, 1]`.
    #[error("strength is {0}; expected 0 (the reconstruction) to 1 (fully enhanced)")]
    Strength(f32),
    /// An amount of water outside `[0, 1]`.
    #[error("the amount of water is {0}; expected 0 (none is left) to 1 (all of it)")]
    Water(f32),
    /// Water is baked as cameras saw it, and there is none.
    #[error("a look with water is baked as cameras saw it: give at least one camera")]
    NoCameras,
    /// The device that a backend draws on failed. [`crate::Cpu`] never gives this.
    #[error("drawing on {device} failed: {problem}; the CPU draws the same pictures")]
    Device {
        /// The device, by its name.
        device: String,
        /// What went wrong: lost, out of memory, ..., in words.
        problem: String,
    },
}
