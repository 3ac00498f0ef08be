//! A view in its stored form, 8 or 16 bits per value, and the floats that a step reads of it.
//!
//! A photograph of 8 bits takes a quarter of the memory of its floats, so four times as many views stay on
//! the device. A step's first kernel makes the floats of its view, as means over the boxes of a smaller size
//! if the step has one; kernels of the loss read these. The floats have the processor's bits. Exceptions are
//! priors at smaller sizes and divisors above 16, with errors of some 1e-7.

use bytemuck::{Pod, Zeroable};
use use3d_capture::Pixels;
use use3d_reconstruct::TrainingView;
use use3d_training::EngineError;

use crate::buffer::Array;
use crate::device::{Gpu, NAME};
use crate::kernel::{Access, Kernel, Spec, U32S, bound, write};

/// Largest divisor on software adapters: llvmpipe ends the loops of a thread after 65,535 rounds without an
/// error.
const MOST_ON_SOFTWARE: usize = 64;

/// The positions of the parts of a view, in words; the photograph is first, and 0 means that there is no
/// such part.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
struct Sections {
    /// 1 if the photograph has 16 bits.
    deep: u32,
    mask: u32,
    prior: u32,
    pad: u32,
}

/// A view at the size of a step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
struct StepView {
    sections: Sections,
    /// Pixels of the stored view, and of one of its rows.
    stored_pixels: u32,
    stored_columns: u32,
    /// Pixels of the step's view, and of one of its rows.
    pixels: u32,
    columns: u32,
    /// Sides of the boxes in stored pixels.
    divisor: u32,
    /// The factors from a box's sum of 8 and of 16 bits to its mean, at most 1.
    from_bytes: f32,
    from_shorts: f32,
    pad: u32,
}

/// The kernel of this module.
pub(crate) fn unpack() -> Spec {
    Spec {
        name: "unpack",
        threads: 256,
        bindings: vec![
            (Access::Uniform, "view", "StepView"),
            (Access::Read, "stored", U32S),
            write("photograph"),
            write("mask"),
            write("prior"),
        ],
        constants: vec![],
        parts: vec![
            "struct Sections { deep: u32, mask: u32, prior: u32, pad: u32 }\n\
             struct StepView { sections: Sections, stored_pixels: u32, stored_columns: u32, pixels: u32, \
             columns: u32, divisor: u32, from_bytes: f32, from_shorts: f32, pad: u32 }\n",
            include_str!("unpack.wgsl"),
        ],
    }
}

/// A view on the device in its stored form.
#[derive(Debug)]
pub(super) struct StoredView {
    width_and_height: (usize, usize),
    sections: Sections,
    words: Array<u32>,
}

/// Appends a part's bytes as words, the last one padded; returns the position of the part.
fn append(words: &mut Vec<u32>, bytes: &[u8]) -> u32 {
    let first = words.len() as u32;
    let (whole, rest) = bytes.as_chunks::<4>();
    words.extend(whole.iter().map(|four| u32::from_le_bytes(*four)));
    if !rest.is_empty() {
        let mut four = [0; 4];
        four[..rest.len()].copy_from_slice(rest);
        words.push(u32::from_le_bytes(four));
    }
    first
}

/// Appends a part's 16-bit values as words; returns the position of the part.
fn append_shorts(words: &mut Vec<u32>, values: &[u16]) -> u32 {
    let first = words.len() as u32;
    let low_and_high = |pair: &[u16]| u32::from(pair[0]) | pair.get(1).map_or(0, |v| u32::from(*v) << 16);
    words.extend(values.chunks(2).map(low_and_high));
    first
}

impl StoredView {
    /// Copies a view to the device.
    pub(super) fn new(gpu: &Gpu, view: &TrainingView) -> Result<Self, EngineError> {
        let width_and_height = view.pixels.size();
        let mut words = Vec::new();
        match &view.pixels {
            Pixels::Eight(raster) => append(&mut words, raster.data()),
            Pixels::Sixteen(raster) => append_shorts(&mut words, raster.data()),
        };
        let deep = u32::from(matches!(view.pixels, Pixels::Sixteen(_)));
        let mask = view.mask.as_ref().map_or(0, |mask| append(&mut words, mask.data()));
        let prior = view.prior.as_ref().map_or(0, |prior| append_shorts(&mut words, prior.data()));
        let sections = Sections { deep, mask, prior, pad: 0 };
        Ok(Self { width_and_height, sections, words: Array::from(gpu, "a stored view", &words)? })
    }

    /// Number of bytes on the device.
    pub(super) fn size(&self) -> usize {
        self.words.size()
    }
}

/// The floats of one view at a time.
#[derive(Debug)]
pub(super) struct Unpacked {
    kernel: Kernel,
    step_view: Array<StepView>,
    pixels: usize,
    pub(super) photograph: Array<f32>,
    mask: Array<f32>,
    prior: Array<f32>,
}

/// The floats of a view that kernels of the loss read.
#[derive(Clone, Copy, Debug)]
pub(super) struct Floats<'a> {
    pub(super) photograph: &'a Array<f32>,
    pub(super) mask: Option<&'a Array<f32>>,
    pub(super) prior: Option<&'a Array<f32>>,
}

impl Unpacked {
    pub(super) fn new(gpu: &Gpu) -> Result<Self, EngineError> {
        Ok(Self {
            kernel: Kernel::new(gpu, &unpack())?,
            step_view: Array::uniform(gpu, "a view at the size of a step")?,
            pixels: 0,
            photograph: Array::new(gpu, "photograph of a step", 1)?,
            mask: Array::new(gpu, "mask of a step", 1)?,
            prior: Array::new(gpu, "depth prior of a step", 1)?,
        })
    }

    /// Makes room for the floats of a view whose size is divided by `divisor` (at most its shorter side).
    /// Refuses a divisor that a software adapter may not sum.
    pub(super) fn prepare(
        &mut self,
        gpu: &Gpu,
        view: &StoredView,
        divisor: usize,
    ) -> Result<(), EngineError> {
        let (width, height) = view.width_and_height;
        if divisor > MOST_ON_SOFTWARE && gpu.adapter.is_software() {
            let what = format!(
                "software adapters end long loops, so views are divided by at most {MOST_ON_SOFTWARE} there, not \
                 by {divisor}; use the engine cpu"
            );
            return Err(EngineError::Request { engine: NAME, what });
        }
        let (columns, rows) = (width / divisor, height / divisor);
        let pixels = columns * rows;
        let Sections { mask, prior, .. } = view.sections;
        self.photograph.grow(gpu, 3 * pixels)?;
        for (array, section) in [(&mut self.mask, mask), (&mut self.prior, prior)] {
            array.grow(gpu, if section == 0 { 1 } else { pixels })?;
        }
        // Rounded as on the processor.
        let of_box = (divisor * divisor) as f32;
        let step_view = StepView {
            sections: view.sections,
            stored_pixels: (width * height) as u32,
            stored_columns: width as u32,
            pixels: pixels as u32,
            columns: columns as u32,
            divisor: divisor as u32,
            from_bytes: 1.0 / (255.0 * of_box),
            from_shorts: 1.0 / (65535.0 * of_box),
            pad: 0,
        };
        self.step_view.write(gpu, 0, &[step_view]);
        self.pixels = pixels;
        Ok(())
    }

    /// Records the computation of a view's floats, after [`Unpacked::prepare`].
    pub(super) fn record(&self, pass: &mut wgpu::ComputePass<'_>, view: &StoredView) {
        let Self { photograph, mask, prior, .. } = self;
        let buffers = bound![self.step_view, view.words, *photograph, *mask, *prior];
        self.kernel.record(pass, self.pixels, buffers);
    }

    /// The floats of a view, after they are computed.
    pub(super) fn floats(&self, view: &StoredView) -> Floats<'_> {
        let Sections { mask, prior, .. } = view.sections;
        let part = |section: u32, array| (section != 0).then_some(array);
        Floats { photograph: &self.photograph, mask: part(mask, &self.mask), prior: part(prior, &self.prior) }
    }

    /// Number of bytes on the device.
    pub(super) fn size(&self) -> usize {
        [&self.photograph, &self.mask, &self.prior].map(Array::size).iter().sum()
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use use3d_capture::{FileName, Map, Raster, View};
    use use3d_reconstruct::{LoadedView, Target};

    use super::*;
    use crate::kernel::submit;
    use crate::test_support::{camera, software};

    /// Every value that a photograph, a mask and a prior can have, with sizes that do not fill the last word.
    fn view(deep: bool, parts: bool) -> TrainingView {
        let (width, height) = (255, 259);
        let n = width * height;
        let byte = |k: usize| (k * 7 % 256) as u8;
        let pixels = if deep {
            let short = |k: usize| (k % 65_536) as u16;
            Pixels::Sixteen(Raster::from_planes(width, height, (0..3 * n).map(short).collect()).unwrap())
        } else {
            Pixels::Eight(Raster::from_planes(width, height, (0..3 * n).map(byte).collect()).unwrap())
        };
        let map = |f: &dyn Fn(usize) -> f32| {
            parts.then(|| Map::from_planes(width, height, (0..n).map(f).collect()).unwrap())
        };
        let loaded = LoadedView {
            pixels,
            mask: map(&|k| (k / 256 % 256).max(k % 251) as f32 / 255.0),
            depth_prior: map(&|k| (k % 65_536) as f32),
        };
        let view = View {
            name: FileName::new("a.png").unwrap(),
            id: 1,
            image: PathBuf::new(),
            mask: None,
            depth_prior: None,
            camera: camera(width, height),
        };
        TrainingView::new(&view, loaded).unwrap().0
    }

    #[test]
    fn stored_views_become_the_processors_floats_at_every_size() {
        let Some(gpu) = software() else { return };
        let mut unpacked = Unpacked::new(&gpu).unwrap();
        let stored = StoredView::new(&gpu, &view(false, true)).unwrap();
        let refused = unpacked.prepare(&gpu, &stored, 65).unwrap_err().to_string();
        assert!(refused.contains("at most 64") && refused.contains("not by 65"), "{refused}");
        for (deep, parts) in [(false, true), (true, true), (true, false), (false, false)] {
            let view = view(deep, parts);
            let stored = StoredView::new(&gpu, &view).unwrap();
            assert!(stored.size() <= view.memory() + 64, "{} of {}", stored.size(), view.memory());
            let mut target = Target::default();
            for divisor in [1, 2, 3, 16, 64] {
                view.target(divisor, &mut target);
                unpacked.prepare(&gpu, &stored, divisor).unwrap();
                for array in [&unpacked.photograph, &unpacked.mask, &unpacked.prior] {
                    array.poison(&gpu);
                }
                submit(&gpu, "unpack", |pass| unpacked.record(pass, &stored)).unwrap();
                let floats = unpacked.floats(&stored);
                let compare =
                    |what: &str, array: &Array<f32>, expected: &[f32], to_the_bit: &dyn Fn(usize) -> bool| {
                        let found = array.read(&gpu, expected.len()).unwrap();
                        for (i, (a, b)) in found.iter().zip(expected).enumerate() {
                            let near = !to_the_bit(i) && (a - b).abs() <= 3e-7 * b;
                            assert!(
                                near || a.to_bits() == b.to_bits(),
                                "{what}, {deep} {parts} {divisor}: {a} {b}"
                            );
                        }
                    };
                // The mean over a part of a box is a quotient; that over the whole box is none.
                let (columns, pixels) = (target.image.width(), target.image.pixels());
                let whole_box = |i: usize| {
                    let (x, y) = (i % pixels % columns * divisor, i % pixels / columns * divisor);
                    let counts = |k| {
                        view.mask.as_ref().is_none_or(|m| m.pixel(x + k % divisor, y + k / divisor) == [255])
                    };
                    (0..divisor * divisor).all(counts)
                };
                let sums = |i: usize| divisor <= 16 && whole_box(i);
                compare("photograph", floats.photograph, target.image.data(), &sums);
                for (what, found, expected, to_the_bit) in [
                    ("mask", floats.mask, &target.mask, divisor <= 16),
                    ("prior", floats.prior, &target.prior, divisor == 1),
                ] {
                    assert_eq!((found.is_some(), expected.is_some()), (parts, parts), "{what}");
                    if let (Some(found), Some(expected)) = (found, expected) {
                        compare(what, found, expected.data(), &|_| to_the_bit);
                    }
                }
            }
        }
    }
}
