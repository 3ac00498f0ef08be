//! A scene's Gaussians as files for viewers made by others. None of these formats can hold water: the colours
//! of the Gaussians must be those that are to be seen without it.
//!
//! Readers of SPZ assume that y is up. All formats state in their header that the water is missing
//! ([`NO_WATER`]), except SPZ, which has no room for text.
//!
//! | file | up | losses |
//! |---|---|---|
//! | [`glb`]: glTF with `KHR_gaussian_splatting` | y, by the node | nothing |
//! | [`spz`]: versions 3 and 4 | as given | 8-bit colours and sizes, 24-bit positions, 4/5-bit harmonics |
//! | [`compressed_ply`]: PlayCanvas's | as given | 11 bits within chunks of 256, 8-bit harmonics |

pub mod compressed_ply;
pub mod glb;
pub mod spz;

use std::io::{self, Write};

use use3d_numerics::math;

/// The note in every file whose format has room for text; SPZ has none.
pub const NO_WATER: &str = "colours alone: this format cannot hold the water itself";

/// The unit quaternion, wxyz; the identity if the quaternion is zero.
fn normalised(q: [f32; 4]) -> [f32; 4] {
    let norm = q.iter().map(|v| v * v).sum::<f32>().sqrt();
    if norm > 0.0 && norm.is_finite() { q.map(|v| v / norm) } else { [1.0, 0.0, 0.0, 0.0] }
}

/// Writes 32-bit words, the lowest byte first.
fn write_words(mut out: impl Write, words: &[u32]) -> io::Result<()> {
    words.iter().try_for_each(|word| out.write_all(&word.to_le_bytes()))
}

/// Opacity in `[0, 1]` from its logit.
fn opacity(logit: f32) -> f32 {
    1.0 / (1.0 + math::exp(-logit))
}

/// The index of the component of largest magnitude.
fn largest(q: &[f32; 4]) -> usize {
    (1..4).fold(0, |best, i| if q[i].abs() > q[best].abs() { i } else { best })
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use use3d_numerics::random::{Purpose, Stream};
    use use3d_splat::Gaussians;

    /// Gaussians in which every value varies.
    pub(crate) fn varied(count: usize, degree: usize) -> Gaussians {
        let draw = Stream::new(4, Purpose::new("foreign files"), 0);
        let mut at = 0u64;
        let mut next = || {
            at += 1;
            draw.normal(at) as f32
        };
        let mut g = Gaussians::empty(degree);
        for _ in 0..count {
            g.means.push(std::array::from_fn(|_| next()));
            g.log_scales.push(std::array::from_fn(|_| -3.0 + 0.5 * next()));
            g.quaternions.push(std::array::from_fn(|_| next()));
            g.opacity_logits.push(next());
            let mut sh = [[0.0; 3]; 16];
            for band in &mut sh[..(degree + 1) * (degree + 1)] {
                *band = std::array::from_fn(|_| 0.25 * next().clamp(-3.0, 3.0));
            }
            g.sh.push(sh);
        }
        g
    }

    /// Asserts that the Gaussians read equal those written, within tolerances of position, log size,
    /// rotation, opacity, constant and higher harmonics.
    pub(crate) fn assert_alike(written: &Gaussians, read: &Gaussians, tolerance: [f32; 6]) {
        assert_eq!((written.len(), written.sh_degree), (read.len(), read.sh_degree));
        let far = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0f32, f32::max);
        for i in 0..written.len() {
            let (p, q) = (normalised(written.quaternions[i]), normalised(read.quaternions[i]));
            let cosine: f32 = p.iter().zip(q).map(|(a, b)| a * b).sum();
            let apart = [
                far(&written.means[i], &read.means[i]),
                far(&written.log_scales[i], &read.log_scales[i]),
                1.0 - cosine.abs(),
                (opacity(written.opacity_logits[i]) - opacity(read.opacity_logits[i])).abs(),
                far(&written.sh[i][0], &read.sh[i][0]),
                far(written.sh[i][1..].as_flattened(), read.sh[i][1..].as_flattened()),
            ];
            assert!(
                apart.iter().zip(tolerance).all(|(a, t)| *a <= t),
                "Gaussian {i}: {apart:?}, allowed {tolerance:?}"
            );
        }
    }
}
