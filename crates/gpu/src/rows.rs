//! The sizes of the rows that the device keeps of every Gaussian.

/// Four floats.
pub(crate) type Float4 = [f32; 4];
/// Number of rows of geometry per Gaussian.
pub(crate) const GEOMETRY: usize = 3;
/// Number of floats of colour per Gaussian.
pub(crate) const COLORS: usize = 48;
/// Number of rows of a splat, the largest data of every Gaussian that must fit into one binding.
pub(crate) const SPLAT: usize = 3;
