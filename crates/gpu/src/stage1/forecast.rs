//! How much of a device's memory a training takes, from its sizes alone.
//!
//! What grows with what, in bytes, as the buffers are made ([`crate`] lists them):
//!
//! | per | bytes | of what |
//! |---|---|---|
//! | Gaussian | 720 | parameters and both moments |
//! | | 88 | statistics, splat, tiles, depth order, offsets, run |
//! | entry there is room for | 68 | records, owners, order by tile |
//! | pixel of the largest view | 120 | image, slopes, sums along rays, water, photograph with mask and prior |
//! | | 83 | three levels of the similarity |
//!
//! Room for entries is half as much again as the fullest view needs. Views come on top.

/// Bytes of a Gaussian: parameters, moments, statistics, splat, and what orders it by depth.
const PER_GAUSSIAN: f64 = 3.0 * 240.0 + 8.0 + 48.0 + 4.0 + 16.0 + 4.0 + 8.0 + 0.3;
/// Bytes of an entry: record, owner, and what orders it by tile.
const PER_ENTRY: f64 = 48.0 + 4.0 + 16.0 + 0.3;
/// Bytes of a pixel: forward pass, slopes, water, the photograph's floats with mask and prior.
const PER_PIXEL: f64 = 64.0 + 16.0 + 36.0 + 20.0 + 0.6;
/// Bytes of a pixel in the levels of the similarity: the first, and those after it.
const PER_LEVEL_PIXEL: f64 = 60.0 + 72.0 / 4.0 + 72.0 / 16.0 + 0.2;
/// Tables, reports, and buffers that are made with some room at first.
const FIXED: f64 = 3e6;

/// About how many bytes a training takes on its device beside its views: with so many Gaussians, pixels of
/// the largest view, and (tile, Gaussian) entries of the fullest view.
pub fn training_bytes(gaussians: usize, pixels: usize, entries: usize) -> u64 {
    let room = 1.5 * entries as f64;
    let pixels = (PER_PIXEL + PER_LEVEL_PIXEL) * pixels as f64;
    (PER_GAUSSIAN * gaussians as f64 + PER_ENTRY * room + pixels + FIXED) as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Three entries to a Gaussian, as scenes have them at this size.
    #[test]
    fn a_million_gaussians_at_1400_by_933_take_less_than_a_gigabyte_and_a_half() {
        let bytes = training_bytes(1_000_000, 1400 * 933, 3_100_000);
        assert!((1_200_000_000..=1_500_000_000).contains(&bytes), "{bytes}");
    }
}
