//! The linear attribute splat `S_v` and its adjoint: `(S_v x)(p) = Σ_i w_i(p) x_i`,
//! `(S_vᵀ y)_i = Σ_p w_i(p) y(p)`.
//!
//! The weights are the compositor's, `w = T α`, without water. `S_v` is the forward pass with values
//! instead of colours, and `S_vᵀ` is the gradient of that pass with respect to colours: three channels at a
//! time, for any number of channels. The processor's versions are
//! `use3d_splat::Rasterizer::{splat, splat_adjoint}`.

use use3d_capture::{Camera, Lattice};
use use3d_splat::Gaussians;
use use3d_training::EngineError;

use crate::buffer::Array;
use crate::constants::{CONSTANTS, CONSTANTS_BINDING};
use crate::device::{Gpu, NAME};
use crate::drawn::DrawnScene;
use crate::kernel::{Access, Binding, Kernel, ROWS, Spec, bound, read, submit, write};
use crate::raster::{DeviceCompositor, Outputs};
use crate::rows::Float4;
use crate::stage2::colors_backward;

/// Number of threads of the kernels over Gaussians.
const THREADS: u32 = 256;
/// Number of channels in one pass.
const TOGETHER: usize = 3;
/// The number of channels in a pass; the rest is 0.
const PART: Binding = (Access::Uniform, "part", "vec4<u32>");

fn spec(name: &'static str, bindings: &[Binding], body: &'static str) -> Spec {
    Spec {
        name,
        threads: THREADS,
        bindings: [&[CONSTANTS_BINDING, PART], bindings].concat(),
        constants: vec![],
        parts: vec![CONSTANTS, body],
    }
}

fn tint() -> Spec {
    let bindings = [read("values"), (Access::Write, "splats", ROWS)];
    spec("values as colours", &bindings, include_str!("linear/tint.wgsl"))
}

fn gather() -> Spec {
    let bindings =
        [(Access::Read, "runs", "array<vec2<u32>>"), (Access::Read, "records", ROWS), write("sums")];
    spec("sums of records", &bindings, include_str!("linear/gather.wgsl"))
}

/// All kernels of this module.
pub(crate) fn specs() -> [Spec; 2] {
    [tint(), gather()]
}

/// A group of three channels, or fewer at the end.
#[derive(Debug)]
struct LinearBuffers {
    at: Array<[u32; 4]>,
    /// Number of channels.
    channels: usize,
    /// `[3][height][width]`.
    planes: Array<f32>,
    /// `[N][channels]`: the values to splat, or the sums of the adjoint.
    values: Array<f32>,
}

/// Gaussians on a device, and one view of them at a time.
#[derive(Debug)]
pub struct LinearSplat {
    scene: DrawnScene,
    compositor: DeviceCompositor,
    tint: Kernel,
    adjoint: Kernel,
    gather: Kernel,
    tiles: usize,
    pixels: usize,
    parts: Vec<LinearBuffers>,
    records: Array<Float4>,
    /// A buffer that is bound instead of the absent water.
    nothing: Array<f32>,
}

impl LinearSplat {
    /// Copies the Gaussians to a device. Their colours do not matter.
    ///
    /// # Errors
    /// There are more of them than it can hold, or the driver failed.
    pub fn new(gpu: &Gpu, gaussians: &Gaussians) -> Result<Self, EngineError> {
        Ok(Self {
            scene: DrawnScene::new(gpu, gaussians, "counts of a view")?,
            compositor: DeviceCompositor::new(gpu)?,
            tint: Kernel::new(gpu, &tint())?,
            adjoint: Kernel::new(gpu, &colors_backward(false))?,
            gather: Kernel::new(gpu, &gather())?,
            tiles: 0,
            pixels: 0,
            parts: Vec::new(),
            records: Array::new(gpu, "records", 1)?,
            nothing: Array::new(gpu, "no water", 1)?,
        })
    }

    /// Prepares a view, to which the next calls apply.
    ///
    /// # Errors
    /// The driver failed.
    pub fn view(&mut self, camera: &Camera, lattice: &Lattice) -> Result<(), EngineError> {
        self.pixels = lattice.width() * lattice.height();
        let (records, outputs) = (Some(&mut self.records), Outputs::Training);
        // The forward pass finds the entry at which each pixel stops.
        let constants =
            self.scene.draw(&mut self.compositor, (camera, lattice), Some(0), None, records, outputs)?;
        self.tiles = constants.tiles();
        Ok(())
    }

    /// `S_v`: splats `values` (`[N][channels]`, in the order of the Gaussians) into `out`
    /// (`[channels][height][width]`).
    ///
    /// # Errors
    /// A length does not match, or the driver failed.
    pub fn splat(&mut self, channels: usize, values: &[f32], out: &mut [f32]) -> Result<(), EngineError> {
        self.check(channels, values.len(), out.len())?;
        self.prepare(channels)?;
        for (part, first) in self.parts.iter().zip((0..channels).step_by(TOGETHER)) {
            let rows = values.chunks_exact(channels);
            let own: Vec<f32> = rows.flat_map(|row| &row[first..first + part.channels]).copied().collect();
            part.values.write(&self.scene.gpu, 0, &own);
        }
        let Self { scene, compositor, parts, .. } = self;
        let DrawnScene { gpu, count, lists, constants, .. } = scene;
        submit(gpu, "linear splat", |pass| {
            for part in &mut *parts {
                let buffers = bound![*constants, part.at, part.values, lists.splats];
                self.tint.record(pass, *count, buffers);
                std::mem::swap(&mut compositor.image, &mut part.planes);
                let outputs = Outputs::Picture;
                compositor.record_forward(pass, constants, self.tiles, &lists.drawn(), None, outputs);
                std::mem::swap(&mut compositor.image, &mut part.planes);
            }
        })?;
        for (part, out) in parts.iter().zip(out.chunks_mut((TOGETHER * self.pixels).max(1))) {
            out.copy_from_slice(&part.planes.read(gpu, out.len())?);
        }
        Ok(())
    }

    /// `S_vᵀ`: lifts `planes` (`[channels][height][width]`) to the Gaussians, into `out` (`[N][channels]`);
    /// zero for Gaussians that are not visible.
    ///
    /// # Errors
    /// A length does not match, or the driver failed.
    pub fn adjoint(&mut self, channels: usize, planes: &[f32], out: &mut [f32]) -> Result<(), EngineError> {
        self.check(channels, out.len(), planes.len())?;
        self.prepare(channels)?;
        for (part, planes) in self.parts.iter().zip(planes.chunks((TOGETHER * self.pixels).max(1))) {
            part.planes.write(&self.scene.gpu, 0, planes);
        }
        let DrawnScene { gpu, count, lists, constants, .. } = &self.scene;
        submit(gpu, "adjoint of the linear splat", |pass| {
            for part in &self.parts {
                let mut buffers = lists.drawn().buffers(constants);
                buffers.extend(bound![self.nothing, self.compositor.kept, part.planes, self.records]);
                self.adjoint.record_groups(pass, self.tiles, buffers);
                let buffers = bound![*constants, part.at, lists.runs, self.records, part.values];
                self.gather.record(pass, *count, buffers);
            }
        })?;
        for (part, first) in self.parts.iter().zip((0..channels).step_by(TOGETHER)) {
            let own = part.values.read(gpu, part.channels * count)?;
            for (row, own) in out.chunks_exact_mut(channels).zip(own.chunks_exact(part.channels)) {
                row[first..first + part.channels].copy_from_slice(own);
            }
        }
        Ok(())
    }

    /// Returns an error unless there is one value per channel and Gaussian, and one per channel and pixel.
    fn check(&self, channels: usize, values: usize, planes: usize) -> Result<(), EngineError> {
        let refuse = |what: String| Err(EngineError::Request { engine: NAME, what });
        let (count, pixels) = (self.scene.count, self.pixels);
        if values != channels * count {
            return refuse(format!("{values} values of {channels} channels for {count} Gaussians"));
        }
        if planes != channels * pixels {
            return refuse(format!("{planes} values of {channels} channels for a view of {pixels}"));
        }
        Ok(())
    }

    /// Makes room for this number of channels of the view.
    fn prepare(&mut self, channels: usize) -> Result<(), EngineError> {
        let DrawnScene { gpu, count, .. } = &self.scene;
        let parts = channels.div_ceil(TOGETHER);
        self.parts.truncate(parts);
        while self.parts.len() < parts {
            let at = Array::uniform(gpu, "channels")?;
            let (planes, values) = (Array::new(gpu, "planes", 1)?, Array::new(gpu, "values", 1)?);
            self.parts.push(LinearBuffers { at, channels: 0, planes, values });
        }
        for (first, part) in (0..channels).step_by(TOGETHER).zip(&mut self.parts) {
            part.channels = TOGETHER.min(channels - first);
            part.at.write(gpu, 0, &[[part.channels as u32, 0, 0, 0]]);
            part.planes.grow(gpu, TOGETHER * self.pixels)?;
            part.values.grow(gpu, part.channels * count)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use use3d_numerics::random::{Purpose, Stream};
    use use3d_splat::{Colors, Prepared, Rasterizer};

    use super::*;
    use crate::test_support::{camera, cloud, relative, software};

    fn drawn(purpose: &'static str, count: usize) -> Vec<f32> {
        let stream = Stream::new(3, Purpose::new(purpose), 0);
        (0..count).map(|i| stream.normal(i as u64) as f32).collect()
    }

    #[test]
    fn splats_and_adjoints_are_those_of_the_processor_and_of_each_other() {
        let Some(gpu) = software() else { return };
        let some = Lattice::subset(&[0, 3, 4, 17, 40], &[2, 5, 31]).unwrap();
        for n in [0usize, 1, 900] {
            let gaussians = cloud(n, -2.5, 0.5);
            let mut linear = LinearSplat::new(&gpu, &gaussians).unwrap();
            let (mut prepared, mut rasterizer) = (Prepared::new(), Rasterizer::new());
            for (lattice, channels) in
                [(Lattice::size(61, 47), 7usize), (some.clone(), 2), (Lattice::size(33, 70), 3)]
            {
                let camera = camera(61, 47);
                let pixels = lattice.width() * lattice.height();
                prepared.prepare(&gaussians, &camera, &lattice, Colors::Sh { degree: 0 });
                linear.compositor.grow(&gpu, pixels, Outputs::Training).unwrap();
                linear.compositor.poison(&gpu);
                linear.records.poison(&gpu);
                linear.view(&camera, &lattice).unwrap();

                let (x, y) = (drawn("values", channels * n), drawn("planes", channels * pixels));
                let (mut found, mut expected) = (vec![f32::NAN; y.len()], vec![0.0; y.len()]);
                linear.splat(channels, &x, &mut found).unwrap();
                rasterizer.splat(&prepared, channels, &x, &mut expected);
                let error = relative(&found, &expected);
                assert!(error <= 1e-5, "{n} Gaussians, {channels} channels: splat off by {error:.1e}");

                let (mut lifted, mut expected) = (vec![f32::NAN; x.len()], vec![0.0; x.len()]);
                linear.adjoint(channels, &y, &mut lifted).unwrap();
                rasterizer.splat_adjoint(&prepared, channels, &y, &mut expected);
                let error = relative(&lifted, &expected);
                assert!(error <= 1e-5, "{n} Gaussians, {channels} channels: adjoint off by {error:.1e}");

                let dot = |a: &[f32], b: &[f32]| -> f64 {
                    a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
                };
                let (one, other) = (dot(&found, &y), dot(&x, &lifted));
                assert!((one - other).abs() <= 1e-4 * (1.0 + one.abs()), "⟨Sx, y⟩ {one}, ⟨x, Sᵀy⟩ {other}");
            }
        }
    }

    /// More Gaussians than one binding can hold the colours of, and more channels than one pass has.
    #[test]
    fn gaussians_in_several_chunks_are_splatted_as_in_one() {
        let Some(gpu) = software() else { return };
        let (gaussians, lattice, channels) = (cloud(3000, -3.5, 0.5), Lattice::size(33, 30), 14);
        let (x, y) = (drawn("values", channels * 3000), drawn("planes", channels * 990));
        let run = |gpu: &Gpu| {
            let mut linear = LinearSplat::new(gpu, &gaussians).unwrap();
            linear.view(&camera(33, 30), &lattice).unwrap();
            let (mut seen, mut lifted) = (vec![f32::NAN; y.len()], vec![f32::NAN; x.len()]);
            linear.splat(channels, &x, &mut seen).unwrap();
            linear.adjoint(channels, &y, &mut lifted).unwrap();
            (seen, lifted)
        };
        // 1,365 Gaussians per chunk.
        let tight = gpu.clone().binding(262_144);
        assert_eq!(tight.gaussians_of_chunk(), 1365);
        assert!(run(&gpu) == run(&tight));
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        let Some(gpu) = software() else { return };
        let mut linear = LinearSplat::new(&gpu, &cloud(2, -2.5, 0.5)).unwrap();
        linear.view(&camera(8, 8), &Lattice::size(8, 8)).unwrap();
        let said = linear.splat(2, &[0.0; 3], &mut [0.0; 128]).unwrap_err().to_string();
        assert!(said.contains("3 values of 2 channels for 2 Gaussians"), "{said}");
        let said = linear.adjoint(1, &[0.0; 60], &mut [0.0; 2]).unwrap_err().to_string();
        assert!(said.contains("60 values of 1 channels for a view of 64"), "{said}");
    }
}
