//! Captures through distorting lenses: photographs, model and truth agree to a tenth of a pixel, and an
//! import straightens them to the pictures of a pinhole.

use std::path::Path;

use glam::{DVec2, DVec3};
use use3d_capture::{Camera, Image};
use use3d_import::{ImportParams, Originals, import, prepare};
use use3d_io_colmap::{LensModel, Model, read_model};
use use3d_io_image::{read_image, read_map};
use use3d_numerics::math;
use use3d_survey::Lens;
use use3d_synth::{CaptureParams, Location, Optics, write_capture};

const BENT: [(Optics, LensModel); 3] = [
    (Optics::Radial, LensModel::Radial),
    (Optics::OpenCv, LensModel::OpenCv),
    (Optics::Fisheye, LensModel::OpenCvFisheye),
];

fn params(lens: Optics) -> CaptureParams {
    CaptureParams {
        lens,
        place: Location::Pool,
        views: 4,
        width: 240,
        height: 160,
        points: 600,
        noise: 0.0,
        depth_priors: false,
        ..CaptureParams::default()
    }
}

fn capture(lens: Optics) -> (tempfile::TempDir, Model, Lens) {
    let dir = tempfile::tempdir().unwrap();
    write_capture(&params(lens), &dir.path().join("dive"), &mut |_, _| {}).unwrap();
    let model = read_model(&dir.path().join("dive/sparse/0")).unwrap();
    let lens = model.cameras[0].lens().unwrap();
    (dir, model, lens)
}

/// The value of a channel at a place, bilinear; `None` near the border.
fn at(image: &Image, p: DVec2) -> Option<f64> {
    let (x, y) = (p.x - 0.5, p.y - 0.5);
    let (w, h) = (image.width() as f64, image.height() as f64);
    if !(x >= 1.0 && y >= 1.0 && x < w - 2.0 && y < h - 2.0) {
        return None;
    }
    let (x0, y0) = (x as usize, y as usize);
    let (fx, fy) = (x - x0 as f64, y - y0 as f64);
    let v = |x: usize, y: usize| f64::from(image.pixel(x, y)[1]);
    let row = |y: usize| (1.0 - fx) * v(x0, y) + fx * v(x0 + 1, y);
    Some((1.0 - fy) * row(y0) + fy * row(y0 + 1))
}

/// The shift in pixels by which one picture differs from another, by least squares over the pixels of a
/// region; `place` gives the position in `other` of each pixel. With it, the number of pixels and the PSNR.
fn shift(
    image: &Image,
    other: &Image,
    inside: impl Fn(usize, usize) -> bool,
    place: impl Fn(DVec2) -> Option<DVec2>,
) -> (DVec2, usize, f64) {
    let (mut a, mut b, mut count, mut squares) = ([0.0; 3], [0.0; 2], 0, 0.0);
    for y in 1..image.height() - 1 {
        for x in 1..image.width() - 1 {
            let here = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
            let value = |d: DVec2| place(here + d).and_then(|p| at(other, p));
            let around = [DVec2::X, DVec2::NEG_X, DVec2::Y, DVec2::NEG_Y].map(value);
            let (true, Some(there), [Some(e), Some(w), Some(s), Some(n)]) =
                (inside(x, y), value(DVec2::ZERO), around)
            else {
                continue;
            };
            let (gx, gy, r) = (0.5 * (e - w), 0.5 * (s - n), f64::from(image.pixel(x, y)[1]) - there);
            a = [a[0] + gx * gx, a[1] + gx * gy, a[2] + gy * gy];
            b = [b[0] + gx * r, b[1] + gy * r];
            (count, squares) = (count + 1, squares + r * r);
        }
    }
    let det = a[0] * a[2] - a[1] * a[1];
    let d = DVec2::new(a[2] * b[0] - a[1] * b[1], a[0] * b[1] - a[1] * b[0]) / det;
    (d, count, -10.0 * math::ln(squares / count as f64) / math::ln(10.0))
}

/// The straight clean picture of a view, and the pinhole that took it.
fn straight(dive: &Path, name: &str) -> Image {
    read_image(&dive.join("truth/pinhole").join(name)).unwrap()
}

#[test]
fn pictures_are_bent_as_the_model_says_to_a_tenth_of_a_pixel() {
    for (optics, expected) in BENT {
        let (dir, model, lens) = capture(optics);
        let dive = dir.path().join("dive");
        assert_eq!((model.cameras.len(), model.cameras[0].model), (1, expected));
        let k = lens.intrinsics(240, 160);
        let to_pinhole =
            |p: DVec2| lens.unproject(p.x, p.y).map(|(u, v)| DVec2::new(u * k.fx + k.cx, v * k.fy + k.cy));
        let moved = to_pinhole(DVec2::new(12.0, 12.0)).unwrap().distance(DVec2::new(12.0, 12.0));
        assert!(moved > 4.0, "{optics:?} moves a corner by {moved} px only");
        for image in &model.images {
            let bent = read_image(&dive.join("truth/clean").join(image.name.as_str())).unwrap();
            let pinhole = straight(&dive, &image.name);
            let (d, count, psnr) = shift(&bent, &pinhole, |_, _| true, to_pinhole);
            assert!(d.length() < 0.1 && psnr > 24.0 && count > 10_000, "{optics:?}: {d} {psnr} {count}");
            // Each quarter on its own: a wrong bend would pull them apart.
            for (right, low) in [(false, false), (true, false), (false, true), (true, true)] {
                let quarter = |x: usize, y: usize| (x >= 120) == right && (y >= 80) == low;
                let (d, ..) = shift(&bent, &pinhole, quarter, to_pinhole);
                assert!(d.length() < 0.1, "{optics:?}, right {right}, low {low}: {d}");
            }
        }
    }
}

#[test]
fn keypoints_and_depths_are_those_of_distorted_pixels() {
    for (optics, _) in BENT {
        let (dir, model, lens) = capture(optics);
        let dive = dir.path().join("dive");
        assert!(model.points.len() > 100, "{optics:?}: {} points", model.points.len());
        let project = |image: usize, p: DVec3| {
            let pose = model.images[image].pose();
            let local = pose.rotation * p + pose.translation;
            (DVec2::from(lens.project(local.x / local.z, local.y / local.z)), local.z)
        };
        let (mut sum, mut count, mut large) = (DVec2::ZERO, 0, 0);
        for point in &model.points {
            for &(id, number) in &point.track {
                let image = model.images.iter().position(|i| i.id == id).unwrap();
                let found = model.images[image].keypoints[number as usize];
                let (expected, _) = project(image, DVec3::from_array(point.position));
                let off = DVec2::new(found.x, found.y) - expected;
                large += usize::from(off.length() > 3.0);
                (sum, count) = (sum + off, count + 1);
            }
        }
        let mean = sum / f64::from(count);
        assert!(mean.length() < 0.1 && large < count as usize / 50, "{optics:?}: {mean}, {large} of {count}");
        // A surface point of one view has the depth that the next one sees there.
        let depths: Vec<_> = model
            .images
            .iter()
            .map(|i| read_map(&dive.join("truth/depth").join(i.name.replace("png", "exr"))).unwrap())
            .collect();
        let (mut agree, mut tested) = (0, 0);
        for y in (0..160).step_by(3) {
            for x in (0..240).step_by(3) {
                let z = f64::from(depths[0].pixel(x, y)[0]);
                let (u, v) = lens.unproject(x as f64 + 0.5, y as f64 + 0.5).expect("every pixel has a ray");
                let pose = model.images[0].pose();
                let world = pose.rotation.transpose() * (z * DVec3::new(u, v, 1.0) - pose.translation);
                let (pixel, depth) = project(1, world);
                if z > 0.0 && pixel.cmpge(DVec2::ZERO).all() && pixel.x < 240.0 && pixel.y < 160.0 {
                    let seen = f64::from(depths[1].pixel(pixel.x as usize, pixel.y as usize)[0]);
                    (agree, tested) = (agree + usize::from((seen / depth - 1.0).abs() < 0.03), tested + 1);
                }
            }
        }
        assert!(tested > 1000 && agree as f64 > 0.93 * tested as f64, "{optics:?}: {agree} of {tested}");
    }
}

#[test]
fn an_import_straightens_them_to_the_pinholes_truth() {
    for (optics, _) in BENT {
        let (dir, _, lens) = capture(optics);
        let dive = dir.path().join("dive");
        let params = ImportParams { image_dir: Some("truth/clean".into()), ..ImportParams::default() };
        let imported = import(&dive, &params).unwrap();
        assert!(imported.needs_preparation());
        let before = lens.intrinsics(240, 160);
        for (i, view) in imported.capture.views.iter().enumerate() {
            let image = imported.view(i).unwrap().pixels.to_image();
            let pinhole = straight(&dive, &view.name);
            let Camera { intrinsics: k, .. } = view.camera;
            let place = |p: DVec2| Some(p + DVec2::new(before.cx - k.cx, before.cy - k.cy));
            assert!((k.fx - before.fx).abs() < 1e-9 && (k.fy - before.fy).abs() < 1e-9);
            let (d, count, psnr) = shift(&image, &pinhole, |_, _| true, place);
            assert!(d.length() < 0.1 && psnr > 24.0 && count > 10_000, "{optics:?}: {d} {psnr} {count}");
        }
        let originals = Originals::of(&prepare(&imported, &dir.path().join("out"), 1, &|_, _| true).unwrap());
        assert!(originals.photographs.iter().all(|o| o.lens == lens && (o.width, o.height) == (240, 160)));
    }
}
