//! Estimates the device memory that a training takes from its sizes alone.
//!
//! The table lists the bytes by which memory grows per unit, as the buffers are made ([`crate`] lists
//! them):
//!
//! | per | bytes | use |
//! |---|---|---|
//! | Gaussian | 720 | parameters and both moments |
//! | | 112 | statistics, splat, tiles, depth order, offsets, run, gradient of the colour |
//! | possible entry | 68 | records, owners, order by tile |
//! | pixel of the largest view | 140 | image, gradients, sums along rays, water, photograph, mask, prior |
//! | | 83 | three levels of the similarity |
//!
//! There is room for one and a half times as many entries as the fullest view needs. The views themselves
//! are additional.

/// Bytes of a Gaussian: parameters, moments, statistics, splat, the data for the order by depth, and the
/// gradient of its colour.
const PER_GAUSSIAN: f64 = 3.0 * 240.0 + 8.0 + 48.0 + 4.0 + 16.0 + 4.0 + 8.0 + 24.0 + 0.3;
/// Bytes of an entry: record, owner, and the data for the order by tile.
const PER_ENTRY: f64 = 48.0 + 4.0 + 16.0 + 0.3;
/// Bytes of a pixel: forward pass, gradients, water, the photograph's floats with mask and prior.
const PER_PIXEL: f64 = 68.0 + 16.0 + 36.0 + 20.0 + 0.6;
/// Bytes of a pixel in the levels of the similarity: in the first level, and in the later ones.
const PER_LEVEL_PIXEL: f64 = 60.0 + 72.0 / 4.0 + 72.0 / 16.0 + 0.2;
/// Bytes of tables, reports, and buffers that have some room from the start.
const FIXED: f64 = 3e6;

/// Estimates the bytes that a training takes on its device besides its views. The arguments are the number
/// of Gaussians, the pixels of the largest view, and the (tile, Gaussian) entries of the fullest view.
pub fn training_bytes(gaussians: usize, pixels: usize, entries: usize) -> u64 {
    let room = 1.5 * entries as f64;
    let pixels = (PER_PIXEL + PER_LEVEL_PIXEL) * pixels as f64;
    (PER_GAUSSIAN * gaussians as f64 + PER_ENTRY * room + pixels + FIXED) as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Three entries per Gaussian, as is usual for scenes at this size.
    #[test]
    fn a_million_gaussians_at_1400_by_933_take_less_than_a_gigabyte_and_a_half() {
        let bytes = training_bytes(1_000_000, 1400 * 933, 3_100_000);
        assert!((1_200_000_000..=1_500_000_000).contains(&bytes), "{bytes}");
    }
}
