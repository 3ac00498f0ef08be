//! Builds the scene after a refinement on the device: rows of parameters and moments move to their new
//! positions.
//!
//! The loop gives the origin of every Gaussian ([`Origin`]). Four bytes per Gaussian are copied to the
//! device, together with the shapes of children, which the processor draws as for every engine. Nothing
//! else is copied between the two. An array is gathered into a new one and then freed, so that for a moment
//! the largest array exists twice: 192 bytes per Gaussian.

use use3d_reconstruct::density::{Draws, Origin};
use use3d_splat::Gaussians;
use use3d_training::EngineError;

use crate::buffer::Array;
use crate::chunks::Piece;
use crate::device::Gpu;
use crate::kernel::{Access, Constant, Kernel, Spec, U32S, submit};
use crate::rows::{COLORS, Float4, GEOMETRY};
use crate::scene::{DeviceScene, Parameters};

/// The bit of an origin that marks a twin or a child.
const BORN: u32 = 1 << 31;
/// The type of an array in the kernel.
const WORDS: &str = "array<vec4<u32>>";
/// The part that one dispatch gathers: the first Gaussian of the new buffer and the number of Gaussians in
/// it, the same of the old buffer, and the number of rows of four per Gaussian. If `inherited` is 1, twins
/// and children copy their source; otherwise they get zeros.
const PART: &str = "struct Part { first: u32, count: u32, source: u32, sources: u32, width: u32, inherited: u32, pad0: u32, pad1: u32 }";

/// The kernel of this module.
pub(crate) fn gather() -> Spec {
    Spec {
        name: "rebuild",
        threads: 256,
        bindings: vec![
            (Access::Uniform, "part", "Part"),
            (Access::Read, "origins", U32S),
            (Access::Read, "old", WORDS),
            (Access::Write, "made", WORDS),
        ],
        constants: vec![("BORN", Constant::Count(BORN))],
        parts: vec![PART, include_str!("rebuild/gather.wgsl")],
    }
}

/// The kernel.
#[derive(Debug)]
pub(crate) struct RebuildKernel {
    gather: Kernel,
    part: Array<[u32; 8]>,
}

impl RebuildKernel {
    pub(crate) fn new(gpu: &Gpu) -> Result<Self, EngineError> {
        Ok(Self {
            gather: Kernel::new(gpu, &gather())?,
            part: Array::uniform(gpu, "part of a rebuilt scene")?,
        })
    }

    /// Fills the new buffers of an array from its old ones, `floats` per Gaussian, and waits for the
    /// result.
    fn fill(
        &self,
        gpu: &Gpu,
        origins: &Array<u32>,
        [old, made]: [&[Piece<'_>]; 2],
        floats: usize,
        inherited: bool,
    ) -> Result<(), EngineError> {
        for &(to, first, count) in made {
            for &(from, source, sources) in old {
                let width = floats / 4;
                let part = [first, count, source, sources, width, inherited.into(), 0, 0];
                self.part.write(gpu, 0, &[part.map(|v| v as u32)]);
                let buffers = vec![self.part.raw().clone(), origins.raw().clone(), from.clone(), to.clone()];
                submit(gpu, "rebuild", |pass| self.gather.record(pass, count * width, buffers))?;
            }
        }
        gpu.wait()
    }
}

impl Parameters {
    /// Moves the rows of `n` Gaussians to their new positions in `to`.
    fn rebuild(
        &mut self,
        gpu: &Gpu,
        kernel: &RebuildKernel,
        origins: &Array<u32>,
        [n, to]: [usize; 2],
        inherited: bool,
    ) -> Result<(), EngineError> {
        let geometry: Array<Float4> = self.geometry.another(gpu, GEOMETRY * to)?;
        let (old, made) = ([(self.geometry.raw(), 0, n)], [(geometry.raw(), 0, to)]);
        kernel.fill(gpu, origins, [&old, &made], 4 * GEOMETRY, inherited)?;
        self.geometry.let_go(gpu);
        self.geometry = geometry;
        let colors = self.colors.another(gpu, to)?;
        let (old, made) = (self.colors.pieces(n), colors.pieces(to));
        kernel.fill(gpu, origins, [&old, &made], COLORS, inherited)?;
        self.colors.let_go(gpu);
        self.colors = colors;
        Ok(())
    }
}

impl DeviceScene {
    /// Builds the scene that these rows describe and resets its statistics. Each row must come from an
    /// existing Gaussian. `shapes` are its Gaussians without their colours.
    pub(crate) fn rebuild(
        &mut self,
        gpu: &Gpu,
        kernel: &RebuildKernel,
        shapes: &Gaussians,
        rows: &[Origin],
        draws: &Draws,
    ) -> Result<(), EngineError> {
        Self::refuse_more(gpu, rows.len())?;
        let origin =
            |row: &Origin| row.source() as u32 | if matches!(row, Origin::Kept(_)) { 0 } else { BORN };
        let origins: Vec<u32> = rows.iter().map(origin).collect();
        let origins = Array::from(gpu, "origins of a rebuilt scene", &origins)?;
        let counts = [self.count, rows.len()];
        self.values.rebuild(gpu, kernel, &origins, counts, true)?;
        self.first.rebuild(gpu, kernel, &origins, counts, false)?;
        self.second.rebuild(gpu, kernel, &origins, counts, false)?;
        self.count = rows.len();
        // Children come last in the plan; the rows between them are written unchanged.
        if let Some(first) = rows.iter().position(|row| matches!(row, Origin::Child(..))) {
            let shape = |row: &Origin| {
                let i = row.source();
                let (mean, log_scales, opacity_logit) = match *row {
                    Origin::Child(parent, child) => {
                        let child = draws.child(shapes, parent, child);
                        (child.mean, child.log_scales, child.opacity_logit)
                    }
                    Origin::Kept(i) | Origin::Twin(i) => {
                        (shapes.means[i], shapes.log_scales[i], shapes.opacity_logits[i])
                    }
                };
                Parameters::rows(mean, log_scales, shapes.quaternions[i], opacity_logit)
            };
            let rows: Vec<Float4> = rows[first..].iter().flat_map(shape).collect();
            self.values.geometry.write(gpu, GEOMETRY * first, &rows);
        }
        self.statistics.grow(gpu, self.count)?;
        self.forget_statistics(gpu);
        gpu.check()
    }
}

#[cfg(test)]
mod tests {
    use use3d_numerics::random::{Purpose, Stream};
    use use3d_reconstruct::density::{Children, rebuilt};
    use use3d_reconstruct::engine::{Moments, Statistics};

    use super::*;
    use crate::test_support::{cloud, software};

    /// Rows of every kind in any order, fewer and more than before, in one buffer and in several.
    #[test]
    fn a_rebuilt_scene_is_the_processors_to_the_bit() {
        let Some(gpu) = software() else { return };
        let stream = Stream::new(8, Purpose::new("rows of a rebuilt scene"), 0);
        for (gpu, chunks) in [(gpu.clone(), 1), (gpu.binding(900_000), 2)] {
            let kernel = RebuildKernel::new(&gpu).unwrap();
            let mut scene = DeviceScene::new(&gpu).unwrap();
            let n = 5000;
            let mut gaussians = cloud(n, -2.0, 0.5);
            let mut moments = Moments { first: cloud(n, -3.0, 0.1), second: cloud(n, -4.0, 0.2) };
            // A number that no arithmetic would preserve.
            moments.first.opacity_logits[7] = f32::from_bits(1);
            let statistics = Statistics { norms: vec![1.0; n], renders: vec![2; n], radii: Vec::new() };
            scene.write(&gpu, &gaussians, &moments, &statistics).unwrap();
            assert_eq!(scene.first.colors.over(n).count(), chunks);
            let mut draw = 0;
            for (to, split) in [(7000, Children::Drawn), (300, Children::LongAxis), (0, Children::Drawn)] {
                let draws = Draws { split, seed: 4, step: 300, shrink: 1.6 };
                let from = gaussians.len();
                let rows: Vec<Origin> = (0..to)
                    .map(|row| {
                        draw += 1;
                        let source = (stream.uniform(draw) * from as f64) as usize;
                        match row % 5 {
                            0 | 1 => Origin::Kept(source),
                            2 => Origin::Twin(source),
                            k => Origin::Child(source, k - 3),
                        }
                    })
                    .chain((to > 0).then_some(Origin::Kept(7)))
                    .collect();
                let shapes = scene.shapes(&gpu).unwrap();
                let before = gpu.held();
                gpu.peak();
                scene.rebuild(&gpu, &kernel, &shapes, &rows, &draws).unwrap();
                gaussians = rebuilt(&gaussians, &rows, &draws);
                moments = moments.rebuilt(&rows);
                assert!(scene.gaussians(&gpu).unwrap() == gaussians, "{to}");
                assert!(scene.moments(&gpu).unwrap() == moments, "{to}");
                assert!(scene.statistics(&gpu).unwrap() == Statistics::new(rows.len()));
                let beside = gpu.peak() - before.max(gpu.held());
                let fewer = rows.len().min(from) as u64;
                let most = 192 * fewer + 4 * rows.len() as u64 + 1000;
                assert!((48 * fewer..=most).contains(&beside), "{beside} bytes for {to}");
            }
            assert!(moments.first.is_empty());
        }
    }
}
