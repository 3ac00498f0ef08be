//! Compares kernels with the corresponding functions of the processor, on the same inputs.
//!
//! The tests compare them with their bounds over many sizes. The check at the start and the benchmark run
//! some of them on the present adapter, so that a driver that computes wrongly is found before a training.

mod field;
mod guards;
mod losses;
mod pictures;
mod scene;
mod steps;
mod water;

use use3d_numerics::random::{Purpose, Stream};
use use3d_training::EngineError;

use crate::device::Gpu;
use crate::stage1::Stage1;

#[cfg(test)]
pub(crate) use field::{Waves, groups, moved};
pub use field::{failed, field};
pub use guards::guards;
pub use losses::{LossCase, losses};
#[cfg(test)]
pub(crate) use pictures::compare as compare_pictures;
pub use pictures::pictures;
pub use scene::{SceneSize, targets};
pub use steps::{large_step, step};
pub use water::{WaterCase, water};

/// The agreement of a kernel's results with the processor's.
#[derive(Clone, Debug, PartialEq)]
pub struct Agreement {
    /// The compared quantity.
    pub what: String,
    /// Norm of the difference divided by the norm of the processor's result; infinite if a value is not
    /// finite.
    pub error: f64,
    /// The largest allowed error.
    pub bar: f64,
    /// A digest of the device's bits.
    pub digest: [u8; 32],
}

impl Agreement {
    /// Compares two arrays, relative to the norm of `ours`.
    fn of(what: impl Into<String>, device: &[f32], ours: &[f32], bar: f64) -> Self {
        let mut sums = [0.0f64; 2];
        let mut finite = device.len() == ours.len();
        for (d, o) in device.iter().zip(ours) {
            finite &= d.is_finite() && o.is_finite();
            let (d, o) = (f64::from(*d), f64::from(*o));
            sums[0] += (d - o) * (d - o);
            sums[1] += o * o;
        }
        // Two arrays of zeros agree.
        let error = match (finite, sums) {
            (false, _) => f64::INFINITY,
            (_, [0.0, _]) => 0.0,
            (_, [difference, own]) => difference.sqrt() / own.sqrt().max(f64::MIN_POSITIVE),
        };
        let digest = *blake3::hash(bytemuck::cast_slice(device)).as_bytes();
        Self { what: what.into(), error, bar, digest }
    }

    /// Compares two numbers by absolute difference.
    fn of_values(what: impl Into<String>, device: f64, ours: f64, bar: f64) -> Self {
        let error = (device - ours).abs();
        let error = if error.is_finite() { error } else { f64::INFINITY };
        let digest = *blake3::hash(&device.to_le_bytes()).as_bytes();
        Self { what: what.into(), error, bar, digest }
    }

    /// True if the error is allowed.
    pub fn holds(&self) -> bool {
        self.error <= self.bar
    }
}

/// Runs every twin at a small size, a picture, a whole step of each stage, and a step at a size at which
/// every loop of the kernels runs more than once; also feeds values that are not finite. This is the check at
/// the start.
pub fn small(gpu: &Gpu) -> Result<Vec<Agreement>, EngineError> {
    let mut all =
        losses(gpu, &LossCase { width: 61, height: 47, seed: 1, mask: true, prior: true, gains: true })?;
    all.extend(water(gpu, &WaterCase { width: 61, height: 47, seed: 1, anchors: 8, top_k: 4, degree: 3 })?);
    let scene = SceneSize { width: 48, height: 32, gaussians: 150, views: 1, seed: 1 };
    all.extend(step(&mut Stage1::new(gpu)?, &scene)?);
    all.extend(guards(&mut Stage1::new(gpu)?, &scene)?);
    all.extend(large_step(&mut Stage1::new(gpu)?, &LARGE, CROWD)?);
    all.extend(pictures(gpu, &scene)?);
    all.extend(field(gpu, &scene)?);
    Ok(all)
}

/// A scene with more than 256 tiles, whose numbers have two digits for the order by tile.
const LARGE: SceneSize = SceneSize { width: 272, height: 256, gaussians: 700, views: 1, seed: 2 };
/// Number of Gaussians behind one another: more than one round of every kernel that composes a tile.
const CROWD: usize = 330;

/// Uniform random draws for a twin.
fn draws(what: &'static str, seed: u64) -> Stream {
    Stream::new(seed, Purpose::new(what), 0)
}

/// The contents of buffers before a kernel writes them: NaN, so that a read before the first write is
/// detected.
fn poison(items: usize) -> Vec<f32> {
    vec![f32::from_bits(0x7fc0_dead); items]
}
