//! PlayCanvas's compressed PLY: 16 bytes per Gaussian and one per harmonic, for SuperSplat and related
//! viewers.
//!
//! Gaussians are stored in chunks of 256 neighbours. A chunk holds the ranges of its positions, logarithms of
//! sizes and colours `f C₀ + ½`. A Gaussian holds its values within these ranges: positions and sizes in 11,
//! 10, 11 bits, colour and opacity in four bytes, its rotation as two bits for the largest component of wxyz
//! and ten for each other one. Harmonics, channel by channel, are bytes over `[−4, 4]`.

use std::io::{self, Write};

use use3d_numerics::order::median;
use use3d_numerics::spherical_harmonics::{C0, bands};
use use3d_splat::Gaussians;

use super::{NO_WATER, largest, normalised, opacity};
use crate::geometry::along_curve;

const CHUNK: usize = 256;
/// Logarithms of sizes are clamped to ± this.
const LARGEST_LOG: f32 = 20.0;

/// The step of positions in the file, units: that of the median chunk along its widest side.
pub fn step(gaussians: &Gaussians) -> f64 {
    let order = along_curve(gaussians);
    let side = |chunk: &[u32]| {
        let means: Vec<[f32; 3]> = chunk.iter().map(|i| gaussians.means[*i as usize]).collect();
        let [low, high] = range(&means);
        (0..3).map(|k| f64::from(high[k] - low[k])).fold(0.0, f64::max)
    };
    // The coarsest axis has ten bits.
    median(order.chunks(CHUNK).map(side)).map_or(0.0, |side| side / 1023.0)
}

/// Writes Gaussians in their given frame, ordered along a space-filling curve.
///
/// # Errors
/// Returns the errors of the writer.
pub fn write(gaussians: &Gaussians, comments: &[String], mut writer: impl Write) -> io::Result<()> {
    let order: Vec<usize> = along_curve(gaussians).into_iter().map(|i| i as usize).collect();
    let g = gaussians.select(&order);
    let n = g.len();
    writeln!(writer, "ply\nformat binary_little_endian 1.0\ncomment {NO_WATER}")?;
    for comment in comments {
        writeln!(writer, "comment {comment}")?;
    }
    writeln!(writer, "element chunk {}", n.div_ceil(CHUNK))?;
    for (prefix, names) in [("", ["x", "y", "z"]), ("scale_", ["x", "y", "z"]), ("", ["r", "g", "b"])] {
        for end in ["min", "max"] {
            names.iter().try_for_each(|name| writeln!(writer, "property float {end}_{prefix}{name}"))?;
        }
    }
    writeln!(writer, "element vertex {n}")?;
    for name in ["position", "rotation", "scale", "color"] {
        writeln!(writer, "property uint packed_{name}")?;
    }
    let rest = 3 * (bands(g.sh_degree) - 1);
    if rest > 0 {
        writeln!(writer, "element sh {n}")?;
        (0..rest).try_for_each(|k| writeln!(writer, "property uchar f_rest_{k}"))?;
    }
    writeln!(writer, "end_header")?;

    let sizes: Vec<[f32; 3]> =
        g.log_scales.iter().map(|s| s.map(|v| v.clamp(-LARGEST_LOG, LARGEST_LOG))).collect();
    let colors: Vec<[f32; 3]> = g.sh.iter().map(|sh| sh[0].map(|v| v * C0 + 0.5)).collect();
    let mut vertices = Vec::with_capacity(16 * n);
    for start in (0..n).step_by(CHUNK) {
        let members = start..(start + CHUNK).min(n);
        let ranges = [&g.means, &sizes, &colors].map(|values| range(&values[members.clone()]));
        for [low, high] in ranges {
            for v in low.into_iter().chain(high) {
                writer.write_all(&v.to_le_bytes())?;
            }
        }
        for i in members {
            let [p, s, c] =
                [(&g.means, 0), (&sizes, 1), (&colors, 2)].map(|(values, r)| share(values[i], ranges[r]));
            let color = (bits(c[0], 8) << 24) | (bits(c[1], 8) << 16) | (bits(c[2], 8) << 8);
            let words =
                [place(p), turn(g.quaternions[i]), place(s), color | bits(opacity(g.opacity_logits[i]), 8)];
            words.iter().for_each(|word| vertices.extend(word.to_le_bytes()));
        }
    }
    writer.write_all(&vertices)?;
    for sh in g.sh.iter().filter(|_| rest > 0) {
        for channel in 0..3 {
            let bytes: Vec<u8> = sh[1..bands(g.sh_degree)]
                .iter()
                .map(|band| ((band[channel] / 8.0 + 0.5) * 256.0).floor().clamp(0.0, 255.0) as u8)
                .collect();
            writer.write_all(&bytes)?;
        }
    }
    writer.flush()
}

fn range(values: &[[f32; 3]]) -> [[f32; 3]; 2] {
    let fold = |pick: fn(f32, f32) -> f32| {
        values.iter().copied().reduce(|a, b| std::array::from_fn(|k| pick(a[k], b[k]))).unwrap_or_default()
    };
    [fold(f32::min), fold(f32::max)]
}

/// The position of `v` within its range, in `[0, 1]`.
fn share(v: [f32; 3], [low, high]: [[f32; 3]; 2]) -> [f32; 3] {
    std::array::from_fn(|k| {
        let side = high[k] - low[k];
        if side > 0.0 { (v[k] - low[k]) / side } else { 0.0 }
    })
}

fn bits(share: f32, count: u32) -> u32 {
    let most = ((1u32 << count) - 1) as f32;
    (share * most).round().clamp(0.0, most) as u32
}

fn place([x, y, z]: [f32; 3]) -> u32 {
    (bits(x, 11) << 21) | (bits(y, 10) << 11) | bits(z, 11)
}

fn turn(q: [f32; 4]) -> u32 {
    let q = normalised(q);
    let top = largest(&q);
    let sign = if q[top] < 0.0 { -1.0 } else { 1.0 };
    (0..4).filter(|&i| i != top).fold(top as u32, |word, i| {
        (word << 10) | bits(sign * q[i] * std::f32::consts::FRAC_1_SQRT_2 + 0.5, 10)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::foreign::tests::{assert_alike, varied};
    use use3d_numerics::math;

    fn read(file: &[u8]) -> Gaussians {
        let end = file.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
        let header = std::str::from_utf8(&file[..end]).unwrap();
        assert!(header.contains("water") && header.contains("comment mine\n"));
        let count = |element: &str| -> usize {
            let line = header.lines().find_map(|l| l.strip_prefix(&format!("element {element} ")));
            line.map_or(0, |n| n.parse().unwrap())
        };
        let (chunks, n) = (count("chunk"), count("vertex"));
        let rest = header.lines().filter(|l| l.starts_with("property uchar f_rest_")).count();
        let word = |at: usize| u32::from_le_bytes(file[at..at + 4].try_into().unwrap());
        let (vertices, sh) = (end + 72 * chunks, end + 72 * chunks + 16 * n);
        assert_eq!(file.len(), sh + n * rest);
        let degree = [0, 9, 24, 45].iter().position(|&r| r == rest).unwrap();
        let mut g = Gaussians::empty(degree);
        for i in 0..n {
            let ends = |group: usize| -> [[f32; 3]; 2] {
                let at = end + 72 * (i / CHUNK) + 24 * group;
                [0, 3].map(|o| std::array::from_fn(|k| f32::from_bits(word(at + 4 * (o + k)))))
            };
            let [p, r, s, c] = [0, 1, 2, 3].map(|k| word(vertices + 16 * i + 4 * k));
            let unpack = |w: u32| {
                [(w >> 21) as f32 / 2047.0, (w >> 11 & 1023) as f32 / 1023.0, (w & 2047) as f32 / 2047.0]
            };
            let between = |t: [f32; 3], [low, high]: [[f32; 3]; 2]| -> [f32; 3] {
                std::array::from_fn(|k| low[k] + t[k] * (high[k] - low[k]))
            };
            g.means.push(between(unpack(p), ends(0)));
            g.log_scales.push(between(unpack(s), ends(1)));
            let color = between([24, 16, 8].map(|o| (c >> o & 255) as f32 / 255.0), ends(2));
            let alpha = ((c & 255) as f32 / 255.0).clamp(1e-6, 1.0 - 1e-6);
            g.opacity_logits.push(math::ln(alpha / (1.0 - alpha)));
            let top = (r >> 30) as usize;
            let mut q = [0.0f32; 4];
            for (slot, k) in (0..4).filter(|&k| k != top).enumerate() {
                q[k] = ((r >> (20 - 10 * slot) & 1023) as f32 / 1023.0 - 0.5) * std::f32::consts::SQRT_2;
            }
            q[top] = (1.0 - q.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
            g.quaternions.push(q);
            let mut bands_ = [[0.0; 3]; 16];
            bands_[0] = color.map(|v| (v - 0.5) / C0);
            for k in 0..rest {
                let (channel, band) = (k / (rest / 3), k % (rest / 3) + 1);
                bands_[band][channel] = ((f32::from(file[sh + i * rest + k]) + 0.5) / 256.0 - 0.5) * 8.0;
            }
            g.sh.push(bands_);
        }
        g
    }

    #[test]
    fn what_is_written_is_read_again() {
        for degree in [0, 3] {
            let written = varied(700, degree);
            let mut file = Vec::new();
            write(&written, &["mine".into()], &mut file).unwrap();
            let order: Vec<usize> = along_curve(&written).into_iter().map(|i| i as usize).collect();
            assert_alike(&written.select(&order), &read(&file), [5e-3, 3e-3, 1e-5, 0.002, 0.01, 0.0157]);
        }
    }
}
