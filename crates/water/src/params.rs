//! The settings of the estimate.

/// The user's settings of the estimate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WaterParams {
    /// A point counts if its farthest view is at least this many times as far away as its nearest.
    pub distance_ratio: f64,
    /// With fewer such points than this nothing is estimated.
    pub min_points: usize,
    /// True if the veil may depend on the direction, to first order.
    pub directional_veil: bool,
    /// True if open water is used to measure the veil.
    pub open_water: bool,
    /// True if each view may have a gain of its own.
    pub gains: bool,
    /// Standard deviation of `ln(β_b/β_a)` around 0 that is assumed beforehand. It matters only where the
    /// data do not decide.
    pub ratio_width: f64,
}

impl Default for WaterParams {
    fn default() -> Self {
        Self {
            distance_ratio: 1.25,
            min_points: 150,
            directional_veil: true,
            open_water: true,
            gains: true,
            ratio_width: 0.5,
        }
    }
}
