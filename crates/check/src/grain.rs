//! The grain of a photograph: noise that differs from pixel to pixel.
//!
//! The second difference in both directions, `[1 −2 1; −2 4 −2; 1 −2 1]`, takes away steps and edges. Of
//! noise with the standard deviation σ it leaves values with the mean absolute value `6 σ √(2/π)` (Immerkær
//! 1996). Fine texture leaves some, too. So the mean is taken in blocks of [`BLOCK`] pixels, and the grain
//! is that of the lower quarter of the blocks.

use use3d_numerics::order::Ascending;

/// The side of a block, pixels.
const BLOCK: usize = 16;
/// The share of the blocks that are flatter than the one whose noise is taken.
const FLAT: f64 = 0.25;

/// The standard deviation of the noise, in units of `luma`; 0 for pictures of less than a block.
pub(crate) fn grain(width: usize, height: usize, luma: impl Fn(usize, usize) -> f64) -> f64 {
    let second = |x: usize, y: usize| {
        let row = |y: usize| luma(x - 1, y) - 2.0 * luma(x, y) + luma(x + 1, y);
        (row(y - 1) - 2.0 * row(y) + row(y + 1)).abs()
    };
    let starts = |side: usize| (1..side.saturating_sub(BLOCK)).step_by(BLOCK);
    let mean = |x0: usize, y0: usize| {
        let all = (0..BLOCK * BLOCK).map(|k| second(x0 + k % BLOCK, y0 + k / BLOCK));
        all.sum::<f64>() / (BLOCK * BLOCK) as f64
    };
    let blocks = starts(height).flat_map(|y| starts(width).map(move |x| (x, y))).map(|(x, y)| mean(x, y));
    let flat = Ascending::of(blocks).at(FLAT).unwrap_or(0.0);
    flat * (std::f64::consts::PI / 2.0).sqrt() / 6.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_numerics::math;

    /// A number near the normal distribution, for each pixel.
    fn noise(x: usize, y: usize) -> f64 {
        let uniform = |k: usize| {
            let mut z =
                ((x * 7919 + y * 104_729 + k * 15_485_863) as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15);
            z = (z ^ z >> 29).wrapping_mul(0xBF58_476D_1CE4_E5B9);
            (z >> 11) as f64 / (1u64 << 53) as f64
        };
        (0..12).map(uniform).sum::<f64>() - 6.0
    }

    #[test]
    fn grain_is_measured_over_slopes_edges_and_waves() {
        let scene = |x: usize, y: usize| {
            let edge = if (x / 40 + y / 30).is_multiple_of(2) { 60.0 } else { 130.0 };
            edge + 0.4 * x as f64 + 12.0 * math::sin(0.15 * y as f64)
        };
        assert!(grain(160, 120, scene) < 0.3);
        for sigma in [4.0, 20.0] {
            let found = grain(160, 120, |x, y| scene(x, y) + sigma * noise(x, y));
            assert!((0.9..1.1).contains(&(found / sigma)), "{found} of {sigma}");
        }
        assert_eq!(grain(5, 5, noise), 0.0);
    }
}
