//! Draws pictures of a scene: the kernels of stage 1 without training.
//!
//! A [`Drawing`] holds a scene's Gaussians on the device. Colours are the scene's harmonics, or given by
//! the caller per Gaussian and view. The water is given as maps, as for the processor's compositor. The
//! picture equals that of `use3d_splat::Rasterizer`.

use use3d_capture::{Camera, Formation, Image, Lattice, Map, MediumMaps};
use use3d_splat::{Gaussians, Layers, Rendered};
use use3d_training::EngineError;

use crate::buffer::{Array, read_together};
use crate::chunks::Chunked;
use crate::device::{Gpu, NAME};
use crate::drawn::DrawnScene;
use crate::raster::{DeviceCompositor, Outputs, WATER_PLANES, kept};

/// A view to draw.
#[derive(Clone, Copy, Debug)]
pub struct DrawnView<'a> {
    /// The camera, in the Gaussians' frame.
    pub camera: &'a Camera,
    /// The pixels of it to draw.
    pub lattice: &'a Lattice,
    /// One colour per Gaussian, used unchanged; `None` for their own harmonics.
    pub colors: Option<&'a [[f32; 3]]>,
    /// The water on the lattice; `None` if there is none.
    pub medium: Option<&'a MediumMaps>,
    /// True if the image's parts are requested.
    pub layers: bool,
}

/// Gaussians on a device, ready to be drawn.
#[derive(Debug)]
pub struct Drawing {
    scene: DrawnScene,
    sh_degree: usize,
    /// Colours of a view that the caller gives.
    given: Chunked,
    compositor: DeviceCompositor,
    /// `c_m`, and `k` of attenuation and backscatter.
    water: Array<f32>,
}

impl Drawing {
    /// Copies the Gaussians to a device.
    ///
    /// # Errors
    /// There are more of them than it can hold, or the driver failed.
    pub fn new(gpu: &Gpu, gaussians: &Gaussians) -> Result<Self, EngineError> {
        Ok(Self {
            scene: DrawnScene::new(gpu, gaussians, "counts of a picture")?,
            sh_degree: gaussians.sh_degree,
            given: Chunked::new(gpu, "colours of a view", 3, 1)?,
            compositor: DeviceCompositor::new(gpu)?,
            water: Array::new(gpu, "the water of a picture", 1)?,
        })
    }

    /// Draws a view into `out`, whose former contents do not matter.
    ///
    /// # Errors
    /// The number of colours or of the maps' pixels is wrong, or the driver failed.
    pub fn draw(&mut self, view: &DrawnView<'_>, out: &mut Rendered) -> Result<(), EngineError> {
        let pixels = view.lattice.width() * view.lattice.height();
        let refused = |what: String| Err(EngineError::Request { engine: NAME, what });
        if let Some(colors) = view.colors
            && colors.len() != self.scene.count
        {
            return refused(format!("{} colours of {} Gaussians", colors.len(), self.scene.count));
        }
        if view.medium.is_some_and(|maps| maps.formation != Formation::PerGaussian) {
            return refused("water that is laid over finished images is drawn on the processor alone".into());
        }
        if let Some(maps) = view.medium
            && maps.color.pixels() != pixels
        {
            return refused(format!("water of {} pixels for a view of {pixels}", maps.color.pixels()));
        }
        if let Some(maps) = view.medium {
            self.write_water(view, maps)?;
        }
        let Self { scene, given, compositor, water, .. } = self;
        if let Some(colors) = view.colors {
            given.grow(&scene.gpu, scene.count)?;
            given.write(&scene.gpu, colors.as_flattened());
            std::mem::swap(given, &mut scene.parameters.colors);
        }
        let degree = view.colors.is_none().then_some(self.sh_degree);
        let water = view.medium.map(|_| &*water);
        let outputs = if view.layers { Outputs::Layers } else { Outputs::Picture };
        let drawn = scene.draw(compositor, (view.camera, view.lattice), degree, water, None, outputs);
        if view.colors.is_some() {
            std::mem::swap(given, &mut scene.parameters.colors);
        }
        drawn?;
        self.read(view, out)
    }

    /// Writes the water in the form that the kernels read: `e = 2^(−k z)`.
    fn write_water(&mut self, view: &DrawnView<'_>, maps: &MediumMaps) -> Result<(), EngineError> {
        let lengths = ray_lengths(view.camera, view.lattice);
        let k = |map: &Image| -> Vec<f32> {
            let each = map.data().iter().zip(lengths.iter().cycle());
            each.map(|(beta, length)| beta * (length * std::f32::consts::LOG2_E)).collect()
        };
        let (gpu, color) = (&self.scene.gpu, maps.color.data());
        self.water.grow(gpu, WATER_PLANES / 3 * color.len())?;
        self.water.write(gpu, 0, color);
        self.water.write(gpu, color.len(), &k(&maps.attenuation));
        self.water.write(gpu, 2 * color.len(), &k(&maps.backscatter));
        Ok(())
    }

    /// Copies the result to main memory.
    fn read(&self, view: &DrawnView<'_>, out: &mut Rendered) -> Result<(), EngineError> {
        let (width, height) = (view.lattice.width(), view.lattice.height());
        let n = width * height;
        let DeviceCompositor { image, depth, kept: values, .. } = &self.compositor;
        let planes = if view.layers { kept::LAYERS } else { kept::PICTURE };
        let wanted = [(image.raw(), 3 * n), (depth.raw(), n), (values.raw(), planes * n)];
        let [image, depth, values] = read_together(&self.scene.gpu, wanted)?;
        let floats = |words: Vec<u32>| bytemuck::cast_vec::<u32, f32>(words);
        let picture =
            |words| Image::from_planes(width, height, floats(words)).unwrap_or_else(|| Image::new(0, 0));
        let map = |words| Map::from_planes(width, height, floats(words)).unwrap_or_else(|| Map::new(0, 0));
        let part = |first: usize, planes: usize| {
            values.get(first * n..(first + planes) * n).map(<[u32]>::to_vec).unwrap_or_default()
        };
        out.image = picture(image);
        out.depth = map(depth);
        out.accumulation = map(part(kept::ACCUMULATION, 1));
        out.layers = view.layers.then(|| {
            let [object, clear, far] = kept::SUMS.map(|first| picture(part(first, 3)));
            // `image = object + medium + far`; zero if there is no water.
            let mut medium = Image::new(width, height);
            if view.medium.is_some() {
                let parts = object.data().iter().zip(far.data());
                let each = medium.data_mut().iter_mut().zip(out.image.data()).zip(parts);
                each.for_each(|((medium, image), (object, far))| *medium = (image - object) - far);
            }
            let lengths = ray_lengths(view.camera, view.lattice);
            let away = out.depth.data().iter().zip(&lengths).map(|(depth, length)| depth * length);
            let distance = Map::from_planes(width, height, away.collect()).unwrap_or_else(|| Map::new(0, 0));
            Layers { object, medium, far, clear, distance }
        });
        Ok(())
    }
}

/// The lengths of the rays at z = 1 through a lattice's pixels.
pub(crate) fn ray_lengths(camera: &Camera, lattice: &Lattice) -> Vec<f32> {
    let lens = &camera.intrinsics;
    let squared = |at: &f32, centre: f64, focal: f64| {
        let slope = (f64::from(*at) - centre) / focal;
        slope * slope
    };
    let across: Vec<f64> = lattice.columns().iter().map(|x| squared(x, lens.cx, lens.fx)).collect();
    let down = lattice.rows().iter().map(|y| squared(y, lens.cy, lens.fy));
    down.flat_map(|down| across.iter().map(move |across| (1.0 + across + down).sqrt() as f32)).collect()
}

#[cfg(test)]
mod tests {
    use use3d_splat::{Colors, Options, Prepared, Rasterizer};

    use super::*;
    use crate::test_support::{camera, cloud, software, water};
    use crate::twins::compare_pictures;

    /// Compares every array of both drawings.
    fn agree(what: &str, found: &Rendered, expected: &Rendered) {
        assert_eq!(found.layers.is_some(), expected.layers.is_some(), "{what}");
        for agreement in compare_pictures(found, expected) {
            assert!(agreement.holds(), "{what}: {agreement:?}");
        }
    }

    /// More Gaussians than one binding can hold the colours of, with their own colours and with given ones.
    #[test]
    fn gaussians_in_several_chunks_are_drawn_as_in_one() {
        let Some(gpu) = software() else { return };
        let (gaussians, camera, lattice) = (cloud(3000, -3.5, 0.5), camera(61, 47), Lattice::size(61, 47));
        let given: Vec<[f32; 3]> =
            (0..3000).map(|i| [0.01 * (i % 90) as f32, 0.4, 0.3 - 0.005 * (i % 70) as f32]).collect();
        let draw = |gpu: &Gpu| {
            let mut drawing = Drawing::new(gpu, &gaussians).unwrap();
            [None, Some(&given[..]), None].map(|colors| {
                let view =
                    DrawnView { camera: &camera, lattice: &lattice, colors, medium: None, layers: false };
                let mut out = Rendered::new();
                drawing.draw(&view, &mut out).unwrap();
                (out.image.data().to_vec(), out.depth.data().to_vec())
            })
        };
        // 1,365 Gaussians per chunk.
        let tight = gpu.clone().binding(262_144);
        assert_eq!(tight.gaussians_of_chunk(), 1365);
        let (one, several) = (draw(&gpu), draw(&tight));
        assert!(one == several && one[0] == one[2] && one[0] != one[1]);
    }

    #[test]
    fn pictures_are_those_of_the_processor() {
        let Some(gpu) = software() else { return };
        for n in [0usize, 1, 900] {
            let gaussians = cloud(n, -2.5, 0.5);
            let given: Vec<[f32; 3]> =
                (0..n).map(|i| [0.01 * (i % 90) as f32, 0.4, 0.3 - 0.005 * (i % 70) as f32]).collect();
            let mut drawing = Drawing::new(&gpu, &gaussians).unwrap();
            drawing.compositor.grow(&gpu, 61 * 47, Outputs::Layers).unwrap();
            drawing.compositor.poison(&gpu);
            let some = Lattice::subset(&[0, 3, 4, 17, 40], &[2, 5, 31]).unwrap();
            let (mut found, mut expected) = (Rendered::new(), Rendered::new());
            let (mut prepared, mut rasterizer) = (Prepared::new(), Rasterizer::new());
            for (lattice, colors, wet, layers) in [
                (Lattice::size(61, 47), None, true, true),
                (Lattice::size(61, 47), Some(&given[..]), true, false),
                (some, Some(&given[..]), false, true),
                (Lattice::size(33, 70), None, false, false),
            ] {
                let camera = camera(61, 47);
                let maps = wet.then(|| water(lattice.width(), lattice.height()));
                let own = colors.map_or(Colors::Sh { degree: 3 }, Colors::Given);
                prepared.prepare(&gaussians, &camera, &lattice, own);
                let options = Options { layers, ..Options::default() };
                rasterizer.forward(&prepared, maps.as_ref(), &options, &mut expected);
                let view =
                    DrawnView { camera: &camera, lattice: &lattice, colors, medium: maps.as_ref(), layers };
                drawing.draw(&view, &mut found).unwrap();
                agree(&format!("{n}, given {}, water {wet}", colors.is_some()), &found, &expected);
            }
            let lattice = Lattice::size(4, 4);
            let camera = camera(4, 4);
            let maps = water(5, 4);
            let mut wrong = DrawnView {
                camera: &camera,
                lattice: &lattice,
                colors: None,
                medium: Some(&maps),
                layers: false,
            };
            let said = drawing.draw(&wrong, &mut found).unwrap_err().to_string();
            assert!(said.contains("20 pixels") && said.contains("16"), "{said}");
            (wrong.medium, wrong.colors) = (None, Some(&[[0.0; 3]; 2][..]));
            let said = drawing.draw(&wrong, &mut found).unwrap_err().to_string();
            assert!(said.contains("2 colours"), "{said}");
        }
    }
}
