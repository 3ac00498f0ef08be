//! The page's textures of a scene: 48 or 52 bytes of geometry and up to 47 of harmonics per Gaussian.
//!
//! ```text
//! geometry   centre 3 × f32 · grade (last bias) f16 · 0 u16
//!            quaternion wxyz 4 × i16, unit · log σ 3 × u16 in [−18, 6] · opacity u16 in [0, 1]
//!            harmonics of degree 0, RGB f16 · log-gain RGB f16 · bias RG f16
//!            the photographs' evidence 4 × u8, if there is any
//! harmonics  (bands − 1) × RGB signed bytes · their largest magnitude f16, the value of the byte 127
//! ```
//!
//! All values are little-endian. The first bytes of all records come first, then all second bytes, and so on:
//! such planes of similar bytes compress better. Each section is compressed by gzip, which browsers can
//! decompress themselves.

use std::io::Write;

use flate2::{Compression, write::GzEncoder};
use half::f16;
use rayon::prelude::*;
use use3d_numerics::math;
use use3d_numerics::spherical_harmonics::bands;
use use3d_scene::Scene;
use use3d_ubaf::OUTPUTS;

use crate::evidence::Evidence;

/// Bytes of geometry per Gaussian, without the evidence.
const GEOMETRY: usize = 48;
/// Range of the logarithms of sizes: scene units from 1.5e-8 to 403.
const LOG_SIZES: [f32; 2] = [-18.0, 6.0];
/// Gaussians per parallel task.
const CHUNK: usize = 8192;

/// Bytes of harmonics per Gaussian: none at degree 0.
pub(crate) const fn harmonic_bytes(degree: usize) -> usize {
    if degree == 0 { 0 } else { 3 * (bands(degree) - 1) + 2 }
}

/// The geometry of the Gaussians in the order of `order`.
pub(crate) fn geometry(
    scene: &Scene,
    grades: Option<&[[f32; OUTPUTS]]>,
    evidence: Option<&Evidence>,
    order: &[u32],
) -> Vec<u8> {
    let g = &scene.gaussians;
    let stride = GEOMETRY + if evidence.is_some() { 4 } else { 0 };
    planes(order, stride, |i, out| {
        let grade = grades.map_or([0.0; OUTPUTS], |grades| grades[i]);
        let mut words = [0u16; GEOMETRY / 2];
        for axis in 0..3 {
            let bits = g.means[i][axis].to_bits();
            (words[2 * axis], words[2 * axis + 1]) = (bits as u16, (bits >> 16) as u16);
        }
        let half = |v: f32| f16::from_f32(v).to_bits();
        words[6] = half(grade[5]);
        let q = g.quaternions[i];
        let norm = q.iter().map(|v| v * v).sum::<f32>().sqrt().max(f32::MIN_POSITIVE);
        for (word, v) in words[8..12].iter_mut().zip(q) {
            *word = (v / norm * 32767.0).round() as i16 as u16;
        }
        let [low, high] = LOG_SIZES;
        for (word, v) in words[12..15].iter_mut().zip(g.log_scales[i]) {
            *word = ((v.clamp(low, high) - low) / (high - low) * 65535.0).round() as u16;
        }
        words[15] = (65535.0 / (1.0 + math::exp(-g.opacity_logits[i]))).round() as u16;
        let tail = g.sh[i][0].into_iter().chain(grade);
        for (word, v) in words[16..24].iter_mut().zip(tail) {
            *word = half(v);
        }
        for (bytes, word) in out.chunks_exact_mut(2).zip(words) {
            bytes.copy_from_slice(&word.to_le_bytes());
        }
        if let Some(evidence) = evidence {
            out[GEOMETRY..].copy_from_slice(&evidence.bytes[i]);
        }
    })
}

/// The harmonics of degree 1 to `degree`, which is at least 1.
pub(crate) fn harmonics(scene: &Scene, degree: usize, order: &[u32]) -> Vec<u8> {
    let stored = harmonic_bytes(degree);
    planes(order, stored, |i, out| {
        let coefficients = scene.gaussians.sh[i][1..bands(degree)].as_flattened();
        let largest = coefficients.iter().fold(0.0f32, |m, v| m.max(v.abs()));
        // The scale is rounded up to the next half float, so that no byte overflows.
        let mut scale = f16::from_f32(largest.min(60000.0));
        if scale.to_f32() < largest {
            scale = f16::from_bits(scale.to_bits() + 1);
        }
        let to_byte = if largest > 0.0 { 127.0 / scale.to_f32() } else { 0.0 };
        for (byte, v) in out.iter_mut().zip(coefficients) {
            *byte = (v * to_byte).round().clamp(-127.0, 127.0) as i8 as u8;
        }
        out[stored - 2..].copy_from_slice(&scale.to_le_bytes());
    })
}

/// Rearranges records of `stride` bytes as planes.
fn planes(order: &[u32], stride: usize, fill: impl Fn(usize, &mut [u8]) + Sync) -> Vec<u8> {
    let mut records = vec![0u8; order.len() * stride];
    records.par_chunks_mut(CHUNK * stride).zip(order.par_chunks(CHUNK)).for_each(|(records, order)| {
        for (record, &i) in records.chunks_exact_mut(stride).zip(order) {
            fill(i as usize, record);
        }
    });
    let mut out = vec![0u8; records.len()];
    out.par_chunks_mut(order.len().max(1)).enumerate().for_each(|(k, plane)| {
        for (byte, record) in plane.iter_mut().zip(records.chunks_exact(stride)) {
            *byte = record[k];
        }
    });
    out
}

/// A section compressed by gzip.
pub(crate) fn packed(bytes: &[u8]) -> std::io::Result<Vec<u8>> {
    let mut encoder = GzEncoder::new(Vec::with_capacity(bytes.len() / 2), Compression::new(5));
    encoder.write_all(bytes)?;
    encoder.finish()
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_capture::Frame;
    use use3d_medium::MediumModel;
    use use3d_splat::Gaussians;

    #[test]
    fn a_gaussian_is_where_the_shaders_look_for_it() {
        let mut sh = [[0.0; 3]; 16];
        sh[0] = [1.0, -0.5, 0.25];
        sh[3][1] = 0.75;
        sh[15][2] = -1.5;
        let scene = Scene {
            gaussians: Gaussians {
                sh_degree: 3,
                means: vec![[0.0; 3], [1.0, -2.0, 0.5]],
                log_scales: vec![[-6.0; 3], [-18.0, 6.0, -6.0]],
                quaternions: vec![[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, -2.0]],
                opacity_logits: vec![0.0, 100.0],
                sh: vec![[[0.0; 3]; 16], sh],
            },
            frame: Frame::IDENTITY,
            medium: MediumModel::None,
            medium_degree: 0,
            enhancement: None,
        };
        let grades = vec![[0.0; 6], [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]];
        let planes = geometry(&scene, Some(&grades), None, &[0, 1]);
        let record: Vec<u8> = (0..GEOMETRY).map(|k| planes[2 * k + 1]).collect();
        let word = |k: usize| u16::from_le_bytes([record[2 * k], record[2 * k + 1]]);
        let half = |k: usize| f16::from_bits(word(k)).to_f32();
        assert_eq!(f32::from_bits(u32::from(word(2)) | u32::from(word(3)) << 16), -2.0);
        assert_eq!((word(11) as i16, word(12), word(13), word(15)), (-32767, 0, 65535, 65535));
        assert_eq!(
            [half(6), half(16), half(17), half(19), half(22), half(23)],
            [6.0, 1.0, -0.5, 1.0, 4.0, 5.0]
        );
        for degree in 1..=3 {
            let planes = harmonics(&scene, degree, &[0, 1]);
            let stored = harmonic_bytes(degree);
            assert_eq!(planes.len(), 2 * stored);
            let record: Vec<u8> = (0..stored).map(|k| planes[2 * k + 1]).collect();
            let scale = f16::from_le_bytes([record[stored - 2], record[stored - 1]]).to_f32();
            let value = |k: usize| f32::from(record[k] as i8) / 127.0 * scale;
            assert!((value(7) - 0.75).abs() < 0.01, "{}", value(7));
            if degree == 3 {
                assert_eq!((scale, value(44)), (1.5, -1.5));
            }
        }
    }
}
