//! Compares projection, lists, compositor and update with the processor's, on the same inputs.

use use3d_capture::{Camera, Image, Lattice, Map, MediumMaps};
use use3d_reconstruct::engine::{GradientScale, Moments, Statistics, StepRates};
use use3d_splat::{
    Colors, GaussianGradients, Gaussians, Gradients, Options, Prepared, Rasterizer, RenderGradients,
    Rendered, ViewOf,
};

use crate::buffer::Array;
use crate::constants::{StepConstants, counts};
use crate::device::Gpu;
use crate::kernel::submit;
use crate::lists::Lists;
use crate::raster::{DeviceCompositor, Outputs, kept};
use crate::rows::Float4;
use crate::scene::{DeviceScene, Parameters};
use crate::test_support::{camera, cloud, elsewhere, relative, software, water};
use crate::update::{COLOR_PULL, UpdateKernels};
use crate::variant::Variant;

const RATES: StepRates = StepRates {
    means: 1e-3,
    sh_constant: 2e-3,
    sh_directional: 3e-3,
    opacity: 4e-3,
    scales: 5e-3,
    quaternions: 6e-3,
    medium_constant: 0.0,
    medium_directional: 0.0,
    medium_network: 0.0,
};

/// The buffers and kernels for one view, outside an engine.
struct ViewKernels {
    gpu: Gpu,
    update: UpdateKernels,
}

/// The device's results for a view: picture and gradients.
struct ViewResult {
    image: Vec<f32>,
    depth: Vec<f32>,
    accumulation: Vec<f32>,
    /// `Σ w e_b`, `Σ w z c e_a`, `Σ w z e_b`.
    along: [Vec<f32>; 3],
    /// First moments after one step from zero: a tenth of the gradients.
    first: Gaussians,
    moved: Gaussians,
    statistics: Statistics,
    entries: usize,
    visible: Vec<usize>,
}

/// A view and the gradients of its loss.
struct Case {
    gaussians: Gaussians,
    camera: Camera,
    lattice: Lattice,
    degree: usize,
    water: Option<MediumMaps>,
    image: Image,
    depth: Map,
    depth_gradient: bool,
}

impl Case {
    fn new(gaussians: Gaussians, width: usize, height: usize, wet: bool) -> Self {
        // Mostly of one sign, like those of a loss, because sums that cancel would test little.
        let wave = |i: usize, f: f32| ((i as f32 * f).fract() - 0.2) * 2e-3;
        let image = (0..3 * width * height).map(|i| wave(i, 0.618_034)).collect();
        let depth = (0..width * height).map(|i| wave(i, 0.414_213)).collect();
        Self {
            gaussians,
            camera: camera(width, height),
            lattice: Lattice::size(width, height),
            degree: 3,
            water: wet.then(|| water(width, height)),
            image: Image::from_planes(width, height, image).unwrap(),
            depth: Map::from_planes(width, height, depth).unwrap(),
            depth_gradient: true,
        }
    }

    /// The length of a pixel's ray at z = 1; pixel numbers continue over the channels.
    fn ray(&self, i: usize) -> f64 {
        let i = i % self.depth.pixels();
        let (x, y) = (i % self.lattice.width(), i / self.lattice.width());
        self.camera.ray(self.lattice.columns()[x].into(), self.lattice.rows()[y].into()).length()
    }

    fn cpu(&self) -> (Prepared, Rendered, GaussianGradients, MediumMaps) {
        let mut prepared = Prepared::new();
        let colors = Colors::Sh { degree: self.degree };
        prepared.prepare(&self.gaussians, &self.camera, &self.lattice, colors);
        let (mut rasterizer, mut rendered) = (Rasterizer::new(), Rendered::new());
        let options = Options { depth_gradient: self.depth_gradient, ..Options::default() };
        rasterizer.forward(&prepared, self.water.as_ref(), &options, &mut rendered);
        let d_rendered =
            RenderGradients { image: &self.image, depth: Some(&self.depth), accumulation: None, clear: None };
        let (mut gradients, mut maps) = (GaussianGradients::default(), MediumMaps::zeros(0, 0));
        rasterizer.backward(
            &prepared,
            ViewOf { gaussians: &self.gaussians, camera: &self.camera },
            self.water.as_ref(),
            &options,
            &d_rendered,
            Gradients { gaussians: &mut gradients, medium: Some(&mut maps) },
        );
        (prepared, rendered, gradients, maps)
    }
}

impl ViewKernels {
    /// One bench for each variant of the software adapter; none without the adapter.
    fn each() -> Vec<Self> {
        Self::of(|gpu| gpu.variants())
    }

    fn of(variants: impl Fn(&Gpu) -> Vec<Variant>) -> Vec<Self> {
        let Some(gpu) = software() else { return Vec::new() };
        let with = |variant| {
            let gpu = gpu.clone().with(variant);
            Self { update: UpdateKernels::new(&gpu).unwrap(), gpu }
        };
        variants(&gpu).into_iter().map(with).collect()
    }

    /// Draws and differentiates with every buffer poisoned, with room for `room` entries, and more if they
    /// do not suffice.
    fn draw(&self, case: &Case, room: usize) -> ViewResult {
        let (gpu, n) = (&self.gpu, case.gaussians.len());
        let mut scene = DeviceScene::new(gpu).unwrap();
        let (moments, statistics) = (Moments::new(&case.gaussians), Statistics::new(n));
        scene.write(gpu, &case.gaussians, &moments, &statistics).unwrap();
        let (mut lists, mut planes) = (Lists::new(gpu).unwrap(), DeviceCompositor::new(gpu).unwrap());
        lists.grow(gpu, room).unwrap();
        let degree = case.degree.min(case.gaussians.sh_degree);
        let mut constants = StepConstants::on(&case.camera, &case.lattice, n, degree, lists.capacity());
        let pixels = constants.pixels();
        constants.flags = [u32::from(case.water.is_some()), u32::from(case.depth_gradient), 1, 0];
        constants.set_rates(0, &RATES);
        constants.screen = [constants.size[0] as f32 * 0.5, constants.size[1] as f32 * 0.5, 0.0, 0.0];
        lists.prepare(gpu, &constants, &case.lattice).unwrap();
        planes.grow(gpu, pixels, Outputs::Training).unwrap();
        let records = Array::<Float4>::new(gpu, "records", 3 * lists.capacity()).unwrap();
        lists.poison(gpu);
        planes.poison(gpu);
        records.poison(gpu);
        let counts = Array::from(gpu, "counts", &[0u32; counts::WORDS]).unwrap();
        let uniform = Array::uniform(gpu, "constants").unwrap();
        uniform.write(gpu, 0, &[constants]);
        let ends = Array::<[u32; 4]>::new(gpu, "ends", 4).unwrap();
        let color_pull = Array::<f32>::new(gpu, "gradients of colours", COLOR_PULL * n).unwrap();
        color_pull.poison(gpu);
        let image = Array::from(gpu, "image slopes", case.image.data()).unwrap();
        let depth = Array::from(gpu, "depth slopes", case.depth.data()).unwrap();
        let maps = case
            .water
            .as_ref()
            .map(|maps| Array::from(gpu, "water", &exponents(maps, case).concat()).unwrap());
        let water = maps.as_ref();
        submit(gpu, "view", |pass| {
            let tiles = constants.tiles();
            lists.record(pass, &uniform, n, tiles, &scene.values, &counts, Some(&records));
            let drawn = lists.drawn();
            planes.record_forward(pass, &uniform, tiles, &drawn, water, Outputs::Training);
            planes.record_backward(pass, &uniform, tiles, &drawn, water, &image, &depth, &records);
            self.update.record(pass, &uniform, &counts, &lists, &records, &color_pull, &scene);
            self.update.record_finish(pass, &uniform, &counts, &ends);
        })
        .unwrap();
        let told = counts.read(gpu, counts::WORDS).unwrap();
        if told[counts::STOP] == counts::OVERFLOW {
            assert!(scene.gaussians(gpu).unwrap() == case.gaussians, "an overflow changed something");
            assert!(told[counts::MOST] as usize > room);
            return self.draw(case, told[counts::MOST] as usize);
        }
        assert_eq!(told[counts::STOP], 0, "not finite: {:b}", told[counts::BAD]);
        let of = |array: &Array<f32>, n: usize| array.read(gpu, n).unwrap();
        let values = planes.kept.read(gpu, kept::TRAINING * pixels).unwrap();
        let part = |first: usize, count: usize| -> Vec<f32> {
            values[first * pixels..(first + count) * pixels].iter().map(|v| f32::from_bits(*v)).collect()
        };
        let order = lists.visible(gpu, n);
        ViewResult {
            image: of(&planes.image, 3 * pixels),
            depth: of(&planes.depth, pixels),
            accumulation: part(kept::ACCUMULATION, 1),
            along: kept::SUMS.map(|first| part(first, 3)),
            first: scene.moments(gpu).unwrap().first,
            moved: scene.gaussians(gpu).unwrap(),
            statistics: scene.statistics(gpu).unwrap(),
            entries: told[counts::ENTRIES] as usize,
            visible: order,
        }
    }
}

/// The water in the form that the kernels read.
fn exponents(maps: &MediumMaps, case: &Case) -> [Vec<f32>; 3] {
    let ray = |i: usize| case.ray(i);
    let k = |map: &Image| {
        let each = map.data().iter().enumerate();
        each.map(|(i, b)| (f64::from(*b) * ray(i) * std::f64::consts::LOG2_E) as f32).collect()
    };
    [maps.color.data().to_vec(), k(&maps.attenuation), k(&maps.backscatter)]
}

/// Compares the device's view with the processor's.
fn agree(bench: &ViewKernels, case: &Case, room: usize, what: &str) -> ViewResult {
    let what = &format!("{what}, {}", bench.gpu.variant);
    let drawn = bench.draw(case, room);
    let (prepared, rendered, gradients, maps) = case.cpu();
    let close = |name: &str, a: &[f32], b: &[f32], bar: f64| {
        let error = relative(a, b);
        assert!(error <= bar, "{what}: {name} off by {error:.1e}");
    };
    let cpu: Vec<usize> = prepared.visible().collect();
    let swapped = drawn.visible.iter().zip(&cpu).filter(|(a, b)| a != b).count();
    assert!(
        drawn.visible.len().abs_diff(cpu.len()) <= cpu.len() / 1000 && swapped <= cpu.len() / 100,
        "{what}: {} visible, {} on the processor, {swapped} in another place",
        drawn.visible.len(),
        cpu.len(),
    );
    assert!(drawn.entries.abs_diff(prepared.entries()) <= prepared.entries() / 500, "{what}");
    close("image", &drawn.image, rendered.image.data(), 1e-5);
    close("depth", &drawn.depth, rendered.depth.data(), 1e-5);
    close("accumulation", &drawn.accumulation, rendered.accumulation.data(), 1e-5);
    if let Some(water) = &case.water {
        let g = case.image.data();
        let ray = |i: usize| case.ray(i) as f32;
        let [veil, object, veiled] = &drawn.along;
        let of = |f: &dyn Fn(usize) -> f32| (0..g.len()).map(f).collect::<Vec<f32>>();
        close("slope of water's colour", &of(&|i| g[i] * (1.0 - veil[i])), maps.color.data(), 1e-5);
        let backscatter = of(&|i| g[i] * water.color.data()[i] * veiled[i] * ray(i));
        close("slope of backscatter", &backscatter, maps.backscatter.data(), 1e-5);
        let attenuation = of(&|i| -g[i] * object[i] * ray(i));
        close("slope of attenuation", &attenuation, maps.attenuation.data(), 1e-5);
    }
    let tenth = |values: &[f32]| values.iter().map(|v| (1.0 - 0.9f32) * v).collect::<Vec<_>>();
    let f = &drawn.first;
    close("means", f.means.as_flattened(), &tenth(gradients.means.as_flattened()), 1e-5);
    close("log scales", f.log_scales.as_flattened(), &tenth(gradients.log_scales.as_flattened()), 1e-5);
    close("quaternions", f.quaternions.as_flattened(), &tenth(gradients.quaternions.as_flattened()), 1e-5);
    close("opacities", &f.opacity_logits, &tenth(&gradients.opacity_logits), 1e-5);
    let colors = gradients.sh.as_flattened().as_flattened();
    close("colours", f.sh.as_flattened().as_flattened(), &tenth(colors), 1e-5);
    let mut statistics = Statistics::new(case.gaussians.len());
    let (w, h) = (case.lattice.width(), case.lattice.height());
    let scale = GradientScale { reference_pixels: 0, exponent: 0.5, signed: false, both: false };
    statistics.gather(&gradients, w, h, &scale, 1.0);
    close("statistics", &drawn.statistics.norms, &statistics.norms, 1e-5);
    let renders = drawn.statistics.renders.iter().zip(&statistics.renders).filter(|(a, b)| a != b).count();
    assert!(renders <= case.gaussians.len() / 1000, "{what}: {renders}");
    drawn
}

#[test]
fn a_view_is_drawn_and_differentiated_as_on_the_processor() {
    for bench in ViewKernels::each() {
        views_agree(&bench);
    }
}

fn views_agree(bench: &ViewKernels) {
    for n in [0usize, 1, 255, 256, 257, 600] {
        for wet in [false, true] {
            // There is room for one entry at first: the overflow is reported, changes nothing, and is
            // corrected.
            agree(bench, &Case::new(cloud(n, -3.0, 0.5), 75, 58, wet), 1, &format!("{n}, water {wet}"));
        }
    }
    let mut dry_distance = Case::new(cloud(300, -3.0, 0.5), 40, 33, true);
    dry_distance.depth_gradient = false;
    dry_distance.degree = 1;
    agree(bench, &dry_distance, 1, "no gradient through distances");
    let mut sparse = Case::new(cloud(400, -2.0, 0.5), 33, 19, true);
    sparse.camera = camera(90, 70);
    let every = |n: usize, of: usize| (0..n).map(|i| 1 + i * of + i % 2).collect::<Vec<_>>();
    sparse.lattice = Lattice::subset(&every(33, 2), &every(19, 3)).unwrap();
    agree(bench, &sparse, 1, "some columns and rows");
}

#[test]
fn a_huge_one_needles_and_full_tiles_are_drawn_alike() {
    for bench in ViewKernels::each() {
        hard_cases_agree(&bench);
    }
}

fn hard_cases_agree(bench: &ViewKernels) {
    let mut huge = cloud(40, -3.5, 0.0);
    huge.means[7] = [0.0, 0.0, 4.0];
    huge.log_scales[7] = [2.0, 2.5, 1.0];
    agree(bench, &Case::new(huge, 70, 52, true), 1, "a huge one");
    // Gaussians ten thousand times as long as they are wide.
    let mut needles = cloud(60, -4.0, 2.0);
    for (i, scales) in needles.log_scales.iter_mut().enumerate() {
        *scales = [-1.5, -10.7, -10.7 + 0.1 * i as f32];
    }
    agree(bench, &Case::new(needles, 64, 48, false), 1, "needles");
    // Faint Gaussians, thousands per tile, so that no pixel stops early.
    let full = cloud(9000, -1.5, -4.5);
    let drawn = agree(bench, &Case::new(full, 16, 16, true), 1, "full tiles");
    assert!(drawn.entries > 4096, "{}", drawn.entries);
}

#[test]
fn the_same_view_is_the_same_bytes() {
    for bench in ViewKernels::each() {
        let case = Case::new(cloud(400, -3.0, 0.5), 61, 47, true);
        let (a, b) = (bench.draw(&case, 1 << 15), bench.draw(&case, 1));
        assert!(a.image == b.image && a.depth == b.depth && a.along == b.along);
        assert!(a.first == b.first && a.moved == b.moved && a.statistics == b.statistics);
        assert!(a.moved != case.gaussians);
    }
}

/// The test that [`subgroups_of_every_width_agree`] runs in processes of other widths.
#[test]
fn subgroups_of_this_width_agree() {
    for bench in ViewKernels::of(Gpu::trials) {
        agree(&bench, &Case::new(cloud(600, -2.5, 0.5), 75, 58, true), 1, "600");
        println!("\nagrees with {}.", bench.gpu.variant);
    }
}

#[test]
fn subgroups_of_every_width_agree() {
    if software().is_none() {
        return;
    }
    for width in [4, 8, 16] {
        let width_in_bits = (32 * width).to_string();
        let (well, text) = elsewhere("tests::subgroups_of_this_width_agree", "2", &width_in_bits);
        for pixels in ["", ", 1 pixel a thread", ", 4 pixels a thread"] {
            let told = format!("agrees with subgroups of {width}{pixels}.");
            assert!(well && text.contains(&told), "{width}: {text}");
        }
    }
}

/// More Gaussians than one round of the sums over their blocks: the runs of their entries follow one another
/// without gaps, and the lists of the tiles contain every entry once.
#[test]
fn the_entries_of_more_than_half_a_million_gaussians_are_numbered_without_gaps() {
    let Some(gpu) = software() else { return };
    let gpu = &gpu;
    let case = Case::new(cloud(720_000, -7.5, 4.0), 64, 48, false);
    let n = case.gaussians.len();
    let mut lists = Lists::new(gpu).unwrap();
    lists.grow(gpu, 1 << 21).unwrap();
    let constants = StepConstants::on(&case.camera, &case.lattice, n, case.degree, lists.capacity());
    lists.prepare(gpu, &constants, &case.lattice).unwrap();
    lists.poison(gpu);
    let scene = Parameters::of(gpu, &case.gaussians).unwrap();
    let counts = Array::from(gpu, "counts", &[0u32; counts::WORDS]).unwrap();
    let uniform = Array::uniform(gpu, "constants").unwrap();
    uniform.write(gpu, 0, &[constants]);
    let tiles = constants.tiles();
    submit(gpu, "lists", |pass| lists.record(pass, &uniform, n, tiles, &scene, &counts, None)).unwrap();
    let told = counts.read(gpu, counts::WORDS).unwrap();
    let entries = told[counts::ENTRIES];
    let mut prepared = Prepared::new();
    prepared.prepare(&case.gaussians, &case.camera, &case.lattice, Colors::Sh { degree: case.degree });
    let expected = prepared.entries();
    assert!(
        prepared.visible().count() > 524_288 && (entries as usize).abs_diff(expected) <= expected / 500,
        "{entries} {expected}"
    );
    let mut runs = lists.runs.read(gpu, n).unwrap();
    runs.sort_unstable();
    let mut next = 0;
    for [first, count] in runs {
        assert_eq!(first, next);
        next += count;
    }
    assert_eq!(next, entries);
    let mut listed = lists.entries().read(gpu, entries as usize).unwrap();
    listed.sort_unstable();
    assert!(listed.into_iter().eq(0..entries));
}

/// More entries than 32 bits can count are reported as too many.
#[test]
fn a_number_of_entries_that_32_bits_cannot_hold_is_too_many() {
    let Some(gpu) = software() else { return };
    let lists = Lists::new(&gpu).unwrap();
    // The sums wrap to a small number: 2^32 + 4.
    for (sums, most) in [(vec![0x8000_0000u32, 0x8000_0004], u32::MAX), (vec![0x7000_0000, 5], 0x7000_0005)] {
        let blocks = Array::from(&gpu, "partial sums", &sums).unwrap();
        let counts = Array::from(&gpu, "counts", &[0u32; counts::WORDS]).unwrap();
        let uniform = Array::uniform(&gpu, "constants").unwrap();
        let case = Case::new(cloud(1, 0.0, 0.0), 16, 16, false);
        let constants = StepConstants::on(&case.camera, &case.lattice, 4096, 3, 1000);
        uniform.write(&gpu, 0, &[constants]);
        submit(&gpu, "total", |pass| lists.record_total(pass, &uniform, &counts, &blocks)).unwrap();
        let told = counts.read(&gpu, counts::WORDS).unwrap();
        assert_eq!((told[counts::STOP], told[counts::MOST]), (counts::OVERFLOW, most));
    }
}

/// A kernel that runs with another width than it was compiled for writes NaN, which stops the training.
#[test]
fn a_kernel_of_another_width_is_noticed() {
    let Some(gpu) = software() else { return };
    let scene = crate::twins::SceneSize { width: 48, height: 32, gaussians: 150, views: 1, seed: 1 };
    let wrong = gpu.clone().of_width_in_tests(if gpu.width == Some(16) { 32 } else { 16 });
    let mut engine = crate::stage1::Stage1::new(&wrong).unwrap();
    let found = crate::twins::step(&mut engine, &scene);
    assert!(found.is_err() || found.unwrap().iter().any(|agreement| !agreement.holds()));
}
