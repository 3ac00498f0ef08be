//! SPZ, versions 3 and 4: about a tenth of a PLY, read by phones and web viewers.
//!
//! Six arrays: positions as 24-bit fixed point, opacities, colours `255 (0.15 f + ½)`, sizes `16 (ln σ +
//! 10)`, rotations as two bits for the largest component and ten for each other one (sign and magnitude over
//! `√½`), harmonics `128 f + 128` rounded to 5 bits in degree 1 and to 4 above. Coordinates: right, up, back,
//! so y is up.
//!
//! * Version 3 is one gzip stream: `NGSP`, version, count (u32); degree, fractional bits, flags, 0 (u8); the
//!   arrays.
//! * Version 4: `NGSP`, version, count (u32); degree, fractional bits, flags, streams (u8); the offset of the
//!   table (u32); 12 zeros; the table: compressed and plain size of every array (u64 each); the arrays, each
//!   a zstd frame.
//!
//! Every viewer with SPZ reads version 3, but not every one reads 4 yet.

use std::io::{self, Write};

use flate2::{Compression, write::GzEncoder};
use ruzstd::encoding::{CompressionLevel, compress_to_vec};
use use3d_numerics::spherical_harmonics::bands;
use use3d_splat::Gaussians;

use super::{largest, normalised, opacity, write_words};

/// The version of the format that is written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Version {
    /// One gzip stream.
    #[default]
    Three,
    /// A zstd frame per array.
    Four,
}

const MAGIC: u32 = 0x5053_474E;
/// Largest number of fractional bits; large scenes get fewer.
const FRACTION: u32 = 12;
/// Number of bits that are dropped from harmonics: in degree 1, and above.
const DROPPED: [u32; 2] = [3, 4];

/// Bytes of version 4's header without its table.
const HEAD: u32 = 32;

/// Writes Gaussians whose y points up.
///
/// # Errors
/// Returns the errors of the writer, and an error for more than 2³² Gaussians or a position beyond 2²³ units,
/// the limits of the format.
pub fn write(gaussians: &Gaussians, version: Version, writer: impl Write) -> io::Result<()> {
    let g = gaussians;
    let count = u32::try_from(g.len()).map_err(|_| io::Error::other("too many Gaussians for an SPZ file"))?;
    let fraction = fraction(g).ok_or_else(|| {
        io::Error::other(format!(
            "a Gaussian lies {} units away: too far for an SPZ file; export a PLY, or crop the scene",
            reach(g)
        ))
    })?;
    let arrays = arrays(g, fraction);
    let shape = [g.sh_degree as u8, fraction as u8, 0];
    match version {
        Version::Three => gzipped(count, shape, &arrays, writer),
        Version::Four => framed(count, shape, &arrays, writer),
    }
}

/// The step of positions in the file, units; `None` if a position does not fit.
pub fn step(gaussians: &Gaussians) -> Option<f64> {
    Some(1.0 / f64::from(1u32 << fraction(gaussians)?))
}

/// The largest coordinate.
fn reach(g: &Gaussians) -> f32 {
    g.means.as_flattened().iter().fold(0.0f32, |m, v| m.max(v.abs()))
}

/// The number of fractional bits with which every position fits.
fn fraction(g: &Gaussians) -> Option<u32> {
    let reach = reach(g);
    (0..=FRACTION).rev().find(|bits| reach * (1u32 << bits) as f32 <= 8_388_607.0)
}

fn gzipped(count: u32, shape: [u8; 3], arrays: &[Vec<u8>], writer: impl Write) -> io::Result<()> {
    let mut out = GzEncoder::new(writer, Compression::default());
    write_words(&mut out, &[MAGIC, 3, count])?;
    out.write_all(&shape)?;
    out.write_all(&[0])?;
    arrays.iter().try_for_each(|array| out.write_all(array))?;
    out.finish()?.flush()
}

fn framed(count: u32, shape: [u8; 3], arrays: &[Vec<u8>], mut out: impl Write) -> io::Result<()> {
    write_words(&mut out, &[MAGIC, 4, count])?;
    out.write_all(&shape)?;
    out.write_all(&[arrays.len() as u8])?;
    write_words(&mut out, &[HEAD, 0, 0, 0])?;
    let frames: Vec<Vec<u8>> =
        arrays.iter().map(|array| compress_to_vec(array.as_slice(), CompressionLevel::Fastest)).collect();
    for (frame, array) in frames.iter().zip(arrays) {
        out.write_all(&(frame.len() as u64).to_le_bytes())?;
        out.write_all(&(array.len() as u64).to_le_bytes())?;
    }
    frames.iter().try_for_each(|frame| out.write_all(frame))?;
    out.flush()
}

/// Positions, opacities, colours, sizes, rotations and harmonics; degree 0 has no harmonics.
fn arrays(g: &Gaussians, fraction: u32) -> Vec<Vec<u8>> {
    let byte = |v: f32| v.round().clamp(0.0, 255.0) as u8;
    let fixed = |v: &f32| ((v * (1u32 << fraction) as f32).round() as i32).to_le_bytes();
    let mut arrays: Vec<Vec<u8>> = vec![
        g.means.as_flattened().iter().flat_map(|v| fixed(v).into_iter().take(3)).collect(),
        g.opacity_logits.iter().map(|&v| byte(255.0 * opacity(v))).collect(),
        g.sh.iter().flat_map(|sh| sh[0]).map(|v| byte(255.0 * (0.15 * v + 0.5))).collect(),
        g.log_scales.as_flattened().iter().map(|v| byte(16.0 * (v + 10.0))).collect(),
        g.quaternions.iter().flat_map(|&q| turn(q).to_le_bytes()).collect(),
    ];
    if g.sh_degree > 0 {
        let mut harmonics = Vec::with_capacity(3 * bands(g.sh_degree) * g.len());
        for sh in &g.sh {
            for (k, band) in sh.iter().enumerate().take(bands(g.sh_degree)).skip(1) {
                let dropped = DROPPED[usize::from(k > 3)];
                harmonics.extend(band.map(|v| harmonic(v, dropped)));
            }
        }
        arrays.push(harmonics);
    }
    arrays
}

/// `128 f + 128` as the nearest multiple of `2^dropped`.
fn harmonic(v: f32, dropped: u32) -> u8 {
    let step = (1u32 << dropped) as f32;
    (((128.0 * v + 128.0) / step).round() * step).clamp(0.0, 255.0) as u8
}

/// The index of the largest component among xyzw, then the sign and nine bits of magnitude of the others.
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

    /// The content of a file of version 4, in the form of a version 3 file before compression.
    fn unframed(file: &[u8]) -> Vec<u8> {
        let word = |at: usize| u32::from_le_bytes(file[at..at + 4].try_into().unwrap()) as usize;
        let long = |at: usize| u64::from_le_bytes(file[at..at + 8].try_into().unwrap()) as usize;
        assert_eq!((word(4), word(16), &file[20..32]), (4, 32, &[0; 12][..]));
        let streams = usize::from(file[15]);
        let (mut plain, mut at) = (file[..16].to_vec(), 32 + 16 * streams);
        for row in (0..streams).map(|k| 32 + 16 * k) {
            let mut array = Vec::new();
            let mut frame = &file[at..at + long(row)];
            let mut decoder = ruzstd::decoding::StreamingDecoder::new(&mut frame).unwrap();
            decoder.read_to_end(&mut array).unwrap();
            assert_eq!(array.len(), long(row + 8));
            plain.extend(array);
            at += long(row);
        }
        assert_eq!(at, file.len());
        plain
    }

    fn read(file: &[u8]) -> Gaussians {
        let bytes = if file.starts_with(b"NGSP") {
            unframed(file)
        } else {
            let mut bytes = Vec::new();
            flate2::read::GzDecoder::new(file).read_to_end(&mut bytes).unwrap();
            bytes
        };
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
        assert!(bytes.starts_with(b"NGSP") && [3, 4].contains(&word(4)));
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
        for (degree, version) in [
            (0, Version::Three),
            (1, Version::Three),
            (3, Version::Three),
            (0, Version::Four),
            (3, Version::Four),
        ] {
            let written = varied(400, degree);
            let mut file = Vec::new();
            write(&written, version, &mut file).unwrap();
            assert_eq!(file.starts_with(b"NGSP"), version == Version::Four);
            assert_alike(&written, &read(&file), [1.3e-4, 0.032, 1e-5, 0.002, 0.0135, 0.0626]);
        }
    }

    #[test]
    fn large_scenes_have_fewer_bits_behind_the_point_and_boundless_ones_are_refused() {
        let mut far = varied(10, 0);
        far.means[3] = [5000.0, 0.0, -1.0];
        let mut file = Vec::new();
        write(&far, Version::Three, &mut file).unwrap();
        assert!((read(&file).means[3][0] - 5000.0).abs() < 1e-2);
        far.means[3] = [1e9, 0.0, 0.0];
        assert!(write(&far, Version::Three, Vec::new()).unwrap_err().to_string().contains("too far"));
    }
}
