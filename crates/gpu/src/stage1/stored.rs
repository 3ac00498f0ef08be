//! A view at full size in its stored form, 8 or 16 bits per value, and the floats that a step reads of it.
//!
//! A photograph of 8 bits takes a quarter of the memory of its floats, so four times as many views stay on
//! the device. A step's first kernel makes the floats of its view; kernels of the loss read these.

use bytemuck::{Pod, Zeroable};
use use3d_capture::Pixels;
use use3d_reconstruct::TrainingView;
use use3d_training::EngineError;

use crate::buffer::Array;
use crate::device::Gpu;
use crate::kernel::{Access, Kernel, Spec, U32S, bound, write};

/// The positions of the parts of a view, in words; the photograph is first, and 0 means that there is no
/// such part.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
struct Sections {
    pixels: u32,
    /// 1 if the photograph has 16 bits.
    deep: u32,
    alpha: u32,
    mask: u32,
    prior: u32,
    pad: [u32; 3],
}

fn unpack() -> Spec {
    Spec {
        name: "unpack",
        threads: 256,
        bindings: vec![
            (Access::Uniform, "sections", "Sections"),
            (Access::Read, "stored", U32S),
            write("photograph"),
            write("alpha"),
            write("mask"),
            write("prior"),
        ],
        constants: vec![],
        parts: vec![
            "struct Sections { pixels: u32, deep: u32, alpha: u32, mask: u32, prior: u32, pad0: u32, pad1: u32, pad2: u32 }",
            include_str!("unpack.wgsl"),
        ],
    }
}

/// All kernels of this module.
pub(crate) fn specs() -> Vec<Spec> {
    vec![unpack()]
}

/// A view on the device in its stored form.
#[derive(Debug)]
pub(super) struct StoredView {
    at: Array<Sections>,
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
        let (width, height) = view.pixels().size();
        let mut words = Vec::new();
        let deep = match view.pixels() {
            Pixels::Eight(raster) => {
                append(&mut words, raster.data());
                0
            }
            Pixels::Sixteen(raster) => {
                append_shorts(&mut words, raster.data());
                1
            }
        };
        let mut map = |map: Option<&_>| {
            map.map_or(0, |map: &use3d_capture::Raster<u8, 1>| append(&mut words, map.data()))
        };
        let (alpha, mask) = (map(view.alpha()), map(view.mask()));
        let prior = view.prior().map_or(0, |prior| append_shorts(&mut words, prior.data()));
        let sections = Sections { pixels: (width * height) as u32, deep, alpha, mask, prior, pad: [0; 3] };
        let at = Array::uniform(gpu, "parts of a view")?;
        at.write(gpu, 0, &[sections]);
        Ok(Self { at, sections, words: Array::from(gpu, "a stored view", &words)? })
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
    pub(super) photograph: Array<f32>,
    alpha: Array<f32>,
    mask: Array<f32>,
    prior: Array<f32>,
}

/// The floats of a view that kernels of the loss read.
#[derive(Clone, Copy, Debug)]
pub(super) struct Floats<'a> {
    pub(super) photograph: &'a Array<f32>,
    pub(super) alpha: Option<&'a Array<f32>>,
    pub(super) mask: Option<&'a Array<f32>>,
    pub(super) prior: Option<&'a Array<f32>>,
}

impl Unpacked {
    pub(super) fn new(gpu: &Gpu) -> Result<Self, EngineError> {
        Ok(Self {
            kernel: Kernel::new(gpu, &unpack())?,
            photograph: Array::new(gpu, "photograph of a step", 1)?,
            alpha: Array::new(gpu, "opacity of a step's photograph", 1)?,
            mask: Array::new(gpu, "mask of a step", 1)?,
            prior: Array::new(gpu, "depth prior of a step", 1)?,
        })
    }

    /// Makes room for the floats of a view.
    pub(super) fn grow(&mut self, gpu: &Gpu, view: &StoredView) -> Result<(), EngineError> {
        let Sections { pixels, alpha, mask, prior, .. } = view.sections;
        let pixels = pixels as usize;
        self.photograph.grow(gpu, 3 * pixels)?;
        for (array, section) in [(&mut self.alpha, alpha), (&mut self.mask, mask), (&mut self.prior, prior)] {
            array.grow(gpu, if section == 0 { 1 } else { pixels })?;
        }
        Ok(())
    }

    /// Records the computation of a view's floats, after [`Unpacked::grow`].
    pub(super) fn record(&self, pass: &mut wgpu::ComputePass<'_>, view: &StoredView) {
        let grid = self.kernel.grid(view.sections.pixels as usize);
        let Self { photograph, alpha, mask, prior, .. } = self;
        self.kernel.dispatch(pass, grid, bound![view.at, view.words, *photograph, *alpha, *mask, *prior]);
    }

    /// The floats of a view, after they are computed.
    pub(super) fn floats(&self, view: &StoredView) -> Floats<'_> {
        let Sections { alpha, mask, prior, .. } = view.sections;
        let part = |section: u32, array| (section != 0).then_some(array);
        Floats {
            photograph: &self.photograph,
            alpha: part(alpha, &self.alpha),
            mask: part(mask, &self.mask),
            prior: part(prior, &self.prior),
        }
    }

    /// Number of bytes on the device.
    pub(super) fn size(&self) -> usize {
        [&self.photograph, &self.alpha, &self.mask, &self.prior].map(Array::size).iter().sum()
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use use3d_capture::{FileName, Map, Raster, View};
    use use3d_reconstruct::{LoadedView, Target};

    use super::*;
    use crate::kernel::submit;
    use crate::testing::{camera, software};

    /// Every value that a photograph, a mask, an opacity and a prior can have, with sizes that do not fill
    /// the last word.
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
            alpha: map(&|k| (k % 256) as f32 / 255.0),
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
    fn stored_views_become_the_processors_floats_to_the_bit() {
        let Some(gpu) = software() else { return };
        let mut unpacked = Unpacked::new(&gpu).unwrap();
        for (deep, parts) in [(false, true), (true, true), (true, false), (false, false)] {
            let view = view(deep, parts);
            let mut target = Target::default();
            view.target(1, &mut target);
            let stored = StoredView::new(&gpu, &view).unwrap();
            assert!(stored.size() <= view.memory() + 64, "{} of {}", stored.size(), view.memory());
            unpacked.grow(&gpu, &stored).unwrap();
            unpacked.photograph.poison(&gpu);
            submit(&gpu, "unpack", |pass| unpacked.record(pass, &stored)).unwrap();
            let floats = unpacked.floats(&stored);
            let bits = |values: &[f32]| values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
            let same = |array: &Array<f32>, expected: &[f32]| {
                bits(&array.read(&gpu, expected.len()).unwrap()) == bits(expected)
            };
            assert!(same(floats.photograph, target.image.data()), "{deep} {parts}");
            for (what, found, expected) in [
                ("alpha", floats.alpha, &target.alpha),
                ("mask", floats.mask, &target.mask),
                ("prior", floats.prior, &target.prior),
            ] {
                assert_eq!((found.is_some(), expected.is_some()), (parts, parts), "{what}");
                if let (Some(found), Some(expected)) = (found, expected) {
                    assert!(same(found, expected.data()), "{what}, {deep}");
                }
            }
        }
    }
}
