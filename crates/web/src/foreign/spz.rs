//! SPZ, version 3: about a tenth of a PLY, read by phones and web viewers.
//!
//! A gzip stream of a 16-byte head (`NGSP`, version, count, degree, fractional bits, flags) and six arrays: positions as 24-bit fixed point,
//! opacities, colours `255 (0.15 f + ½)`, sizes `16 (ln σ + 10)`, turns as two bits for the largest component and ten for each other one (sign and
//! magnitude over `√½`), harmonics `128 f + 128` rounded to 5 bits in degree 1 and to 4 above. Coordinates: right, up, back, so y is up.

use std::io::{self, Write};

use flate2::{Compression, write::GzEncoder};
use use3d_numerics::spherical_harmonics::bands;
use use3d_splat::Gaussians;

use super::{largest, normalised, opacity};

const MAGIC: u32 = 0x5053_474E;
/// Most bits behind the point; fewer where the scene is large.
const FRACTION: u32 = 12;
/// Bits that are dropped of harmonics: degree 1, and above.
const DROPPED: [u32; 2] = [3, 4];

/// Writes Gaussians whose y points up.
///
/// # Errors
/// Those of the writer; a scene with more than 2³² Gaussians or a position beyond 2²³ units, which the format cannot hold.
pub fn write(gaussians: &Gaussians, writer: impl Write) -> io::Result<()> {
    let g = gaussians;
    let count = u32::try_from(g.len()).map_err(|_| io::Error::other("too many Gaussians for an SPZ file"))?;
    let reach = g.means.as_flattened().iter().fold(0.0f32, |m, v| m.max(v.abs()));
    let fits = |bits: &u32| reach * (1u32 << bits) as f32 <= 8_388_607.0;
    let fraction = (0..=FRACTION).rev().find(fits).ok_or_else(|| {
        io::Error::other(format!(
            "a Gaussian lies {reach} units away: too far for an SPZ file; export a PLY, or crop the scene"
        ))
    })?;
    let mut out = GzEncoder::new(writer, Compression::default());
    for word in [MAGIC, 3, count] {
        out.write_all(&word.to_le_bytes())?;
    }
    out.write_all(&[g.sh_degree as u8, fraction as u8, 0, 0])?;
    for v in g.means.as_flattened() {
        let fixed = (v * (1u32 << fraction) as f32).round() as i32;
        out.write_all(&fixed.to_le_bytes()[..3])?;
    }
    let byte = |v: f32| v.round().clamp(0.0, 255.0) as u8;
    let bytes: Vec<u8> = g.opacity_logits.iter().map(|&v| byte(255.0 * opacity(v))).collect();
    out.write_all(&bytes)?;
    let bytes: Vec<u8> = g.sh.iter().flat_map(|sh| sh[0]).map(|v| byte(255.0 * (0.15 * v + 0.5))).collect();
    out.write_all(&bytes)?;
    let bytes: Vec<u8> = g.log_scales.as_flattened().iter().map(|v| byte(16.0 * (v + 10.0))).collect();
    out.write_all(&bytes)?;
    for &q in &g.quaternions {
        out.write_all(&turn(q).to_le_bytes())?;
    }
    for sh in &g.sh {
        for (k, band) in sh.iter().enumerate().take(bands(g.sh_degree)).skip(1) {
            let dropped = DROPPED[usize::from(k > 3)];
            out.write_all(&band.map(|v| harmonic(v, dropped)))?;
        }
    }
    out.finish()?.flush()
}

/// `128 f + 128` as the nearest multiple of `2^dropped`.
fn harmonic(v: f32, dropped: u32) -> u8 {
    let step = (1u32 << dropped) as f32;
    (((128.0 * v + 128.0) / step).round() * step).clamp(0.0, 255.0) as u8
}

/// The largest component's place among xyzw, then sign and nine bits of magnitude of the others.
fn turn(q: [f32; 4]) -> u32 {
    let [w, x, y, z] = normalised(q);
    let q = [x, y, z, w];
    let top = largest(&q);
    let flip = q[top] < 0.0;
    (0..4).filter(|&i| i != top).fold(top as u32, |word, i| {
        let magnitude = (511.0 * q[i].abs() * std::f32::consts::SQRT_2).round().min(511.0) as u32;
        (word << 10) | (u32::from((q[i] < 0.0) != flip) << 9) | magnitude
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::foreign::tests::{assert_alike, varied};
    use std::io::Read;
    use use3d_numerics::math;

    fn read(file: &[u8]) -> Gaussians {
        let mut bytes = Vec::new();
        flate2::read::GzDecoder::new(file).read_to_end(&mut bytes).unwrap();
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
        assert_eq!((&bytes[..4], word(4)), (&b"NGSP"[..], 3));
        let (n, degree, fraction) = (word(8) as usize, bytes[12] as usize, bytes[13]);
        let mut rest = &bytes[16..];
        let mut take = |count: usize| {
            let (head, tail) = rest.split_at(count);
            rest = tail;
            head
        };
        let mut g = Gaussians::empty(degree);
        let fixed =
            |b: &[u8]| (i32::from_le_bytes([0, b[0], b[1], b[2]]) >> 8) as f32 / f32::from(1u16 << fraction);
        g.means = take(9 * n).chunks_exact(9).map(|b| std::array::from_fn(|k| fixed(&b[3 * k..]))).collect();
        let logit = |b: &u8| (f32::from(*b) / 255.0).clamp(1e-6, 1.0 - 1e-6);
        g.opacity_logits = take(n).iter().map(logit).map(|a| math::ln(a / (1.0 - a))).collect();
        g.sh = take(3 * n)
            .chunks_exact(3)
            .map(|b| {
                let mut sh = [[0.0; 3]; 16];
                sh[0] = std::array::from_fn(|c| (f32::from(b[c]) / 255.0 - 0.5) / 0.15);
                sh
            })
            .collect();
        let sizes = take(3 * n).chunks_exact(3);
        g.log_scales = sizes.map(|b| std::array::from_fn(|k| f32::from(b[k]) / 16.0 - 10.0)).collect();
        for b in take(4 * n).chunks_exact(4) {
            let mut word = u32::from_le_bytes(b.try_into().unwrap());
            let top = (word >> 30) as usize;
            let mut q = [0.0f32; 4];
            for i in (0..4).rev().filter(|&i| i != top) {
                let magnitude = (word & 511) as f32 / 511.0 * std::f32::consts::FRAC_1_SQRT_2;
                q[i] = if word >> 9 & 1 == 1 { -magnitude } else { magnitude };
                word >>= 10;
            }
            q[top] = (1.0 - q.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
            g.quaternions.push([q[3], q[0], q[1], q[2]]);
        }
        for sh in &mut g.sh {
            for band in &mut sh[1..bands(degree)] {
                let b = take(3);
                *band = std::array::from_fn(|c| (f32::from(b[c]) - 128.0) / 128.0);
            }
        }
        assert!(rest.is_empty());
        g
    }

    #[test]
    fn what_is_written_is_read_again() {
        for degree in [0, 1, 3] {
            let written = varied(400, degree);
            let mut file = Vec::new();
            write(&written, &mut file).unwrap();
            assert_alike(&written, &read(&file), [1.3e-4, 0.032, 1e-5, 0.002, 0.0135, 0.0626]);
        }
    }

    #[test]
    fn large_scenes_have_fewer_bits_behind_the_point_and_boundless_ones_are_refused() {
        let mut far = varied(10, 0);
        far.means[3] = [5000.0, 0.0, -1.0];
        let mut file = Vec::new();
        write(&far, &mut file).unwrap();
        assert!((read(&file).means[3][0] - 5000.0).abs() < 1e-2);
        far.means[3] = [1e9, 0.0, 0.0];
        assert!(write(&far, Vec::new()).unwrap_err().to_string().contains("too far"));
    }
}
