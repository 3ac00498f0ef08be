//! Capture folders made by the tests: every place where a capture may be, everything that may be missing, and
//! the results of the preparation.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use glam::{DMat3, DVec3};
use use3d_capture::{FileName, Image, Image8, Intrinsics, Map, Pixels, Pose};
use use3d_import::*;
use use3d_io_colmap::*;
use use3d_io_image::*;
use use3d_numerics::math;

const SIZE: (usize, usize) = (120, 80);

fn pose(i: usize) -> Pose {
    let turn = DMat3::from_axis_angle(DVec3::new(0.1, 1.0, 0.2).normalize(), 0.1 * i as f64);
    Pose::from_center(turn, DVec3::new(i as f64, 0.3 * (i % 3) as f64, -0.1 * i as f64))
}

fn picture(width: usize, height: usize, phase: f32) -> Image8 {
    let mut image = Image::new(width, height);
    for y in 0..height {
        for x in 0..width {
            let (u, v) = (x as f32 / width as f32, y as f32 / height as f32);
            image.set_pixel(
                x,
                y,
                [0.6 * u, 0.5 + 0.3 * math::sin(6.0 * v + phase), 0.4 + 0.2 * math::cos(9.0 * (u + v))],
            );
        }
    }
    image.to_8bit()
}

fn pinhole(id: u32) -> ModelCamera {
    let k = Intrinsics { width: SIZE.0, height: SIZE.1, fx: 100.0, fy: 101.0, cx: 61.0, cy: 39.0 };
    ModelCamera::pinhole(id, &k)
}

fn model(camera: ModelCamera, names: &[String]) -> Model {
    let images = names.iter().enumerate();
    let keypoints =
        vec![Keypoint { x: 30.0, y: 20.0, point: 5 }, Keypoint { x: 60.5, y: 44.0, point: Keypoint::NONE }];
    Model {
        images: images
            .map(|(i, name)| ModelImage {
                keypoints: keypoints.clone(),
                ..ModelImage::at(100 - i as u32, FileName::new(name).unwrap(), camera.id, &pose(i))
            })
            .collect(),
        cameras: vec![camera],
        points: vec![ModelPoint {
            id: 5,
            position: [0.2, 0.3, 4.0],
            color: [9, 8, 7],
            error: f64::NAN,
            track: (0..names.len()).map(|i| (100 - i as u32, 0)).collect(),
        }],
    }
}

/// A capture of `n` pictures in `images/`, with a model in `sparse/0`.
struct Fixture {
    dir: tempfile::TempDir,
    names: Vec<String>,
}

impl Fixture {
    fn new(n: usize, camera: ModelCamera) -> Self {
        let names: Vec<String> = (0..n).map(|i| format!("dive {}/f{i:02}.png", i % 2)).collect();
        let fixture = Self { dir: tempfile::tempdir().unwrap(), names };
        write_model_binary(&fixture.path("sparse/0"), &model(camera, &fixture.names)).unwrap();
        for (i, name) in fixture.names.iter().enumerate() {
            write_png8(&fixture.path("images").join(name), &picture(SIZE.0, SIZE.1, i as f32)).unwrap();
        }
        fixture
    }

    fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    fn import(&self, params: &ImportParams) -> Result<Imported, ImportError> {
        import(self.dir.path(), params)
    }

    fn complaint(&self, params: &ImportParams) -> String {
        self.import(params).unwrap_err().to_string()
    }
}

fn prepare_all(imported: &Imported, out: &Path) -> Imported {
    prepare(imported, out, 2, &|_, _| true).unwrap()
}

#[test]
fn a_plain_capture_needs_nothing_and_is_copied_byte_for_byte() {
    let fixture = Fixture::new(10, pinhole(3));
    let imported = fixture.import(&ImportParams::default()).unwrap();
    assert!(!imported.needs_preparation());
    let views = &imported.capture.views;
    assert!(views.windows(2).all(|w| w[0].name < w[1].name));
    assert_eq!(imported.capture.split.test, [0, 8]);
    assert_eq!(imported.capture.points[0].error, -1.0, "an error that is not a number is unknown");
    assert_eq!(imported.capture.points[0].track_length, 10);

    let out = fixture.path("out");
    let prepared = prepare_all(&imported, &out);
    for (a, b) in views.iter().zip(&prepared.capture.views) {
        assert_eq!(std::fs::read(&a.image).unwrap(), std::fs::read(&b.image).unwrap());
        assert_eq!((a.camera, &a.name), (b.camera, &b.name), "cameras to the last bit");
    }
    let loaded = load_prepared(&out).unwrap();
    assert_eq!(loaded.capture.views, prepared.capture.views);
    assert_eq!(loaded.capture.points, imported.capture.points);
    assert_eq!(loaded.capture.split, imported.capture.split);
    assert_eq!(loaded.capture.frame, imported.capture.frame);
    // The name is that of the folder, at any place; the stored files do not contain the old name.
    assert_eq!(
        (loaded.report.name.as_str(), prepared.report.name.as_str()),
        ("out", imported.report.name.as_str())
    );
    assert_eq!(ImportReport { name: "out".into(), ..prepared.report.clone() }, loaded.report);
    let stored = std::fs::read_to_string(out.join("capture.json")).unwrap();
    assert!(!stored.contains(&format!("\"name\": \"{}\"", imported.report.name)), "{stored}");
    // The folder is a capture for this program and, without the manifest, for any other.
    assert_eq!(import(&out, &ImportParams::default()).unwrap().capture.views, prepared.capture.views);
    std::fs::remove_file(out.join("capture.json")).unwrap();
    let again = import(&out, &ImportParams::default()).unwrap();
    for (a, b) in again.capture.views.iter().zip(&prepared.capture.views) {
        assert_eq!((a.camera, &a.name), (b.camera, &b.name));
    }
}

#[test]
fn captures_may_live_in_many_places() {
    let fixture = Fixture::new(4, pinhole(1));
    for (images, sparse, text) in [
        ("images_wb", "sparse", false),
        ("Images_wb", "colmap/sparse/0", true),
        ("input", "sparse/1", true),
        ("images", ".", false),
    ] {
        let dir = tempfile::tempdir().unwrap();
        let model = read_model(&fixture.path("sparse/0")).unwrap();
        let place = dir.path().join(sparse);
        if text { write_model_text(&place, &model) } else { write_model_binary(&place, &model) }.unwrap();
        for name in &fixture.names {
            let to = dir.path().join(images).join(name);
            std::fs::create_dir_all(to.parent().unwrap()).unwrap();
            std::fs::copy(fixture.path("images").join(name), to).unwrap();
        }
        let imported = import(dir.path(), &ImportParams::default()).unwrap();
        assert_eq!((imported.report.image_folder.as_str(), imported.report.model.as_str()), (images, sparse));
    }
}

#[test]
fn the_largest_model_and_the_fullest_folder_win_and_the_report_says_so() {
    let fixture = Fixture::new(6, pinhole(1));
    let whole = read_model(&fixture.path("sparse/0")).unwrap();
    let mut small = whole.clone();
    small.images.truncate(2);
    write_model_binary(&fixture.path("sparse/0"), &small).unwrap();
    write_model_text(&fixture.path("sparse/1"), &whole).unwrap();
    std::fs::create_dir_all(fixture.path("images_wb/dive 0")).unwrap();
    std::fs::copy(
        fixture.path("images").join(&fixture.names[0]),
        fixture.path("images_wb").join(&fixture.names[0]),
    )
    .unwrap();
    let report = fixture.import(&ImportParams::default()).unwrap().report;
    assert_eq!((report.model.as_str(), report.views), ("sparse/1", 6));
    let said = report.to_string();
    assert!(said.contains("sparse/0 (2 images)") && said.contains("not used: images_wb"), "{said}");
    let params = ImportParams { model_dir: Some("sparse/0".into()), ..ImportParams::default() };
    let report = fixture.import(&params).unwrap().report;
    assert_eq!((report.views, report.extra.len()), (2, 4), "unregistered images are extra");
}

#[test]
fn missing_images_are_skipped_and_said() {
    let fixture = Fixture::new(9, pinhole(1));
    let before = fixture.import(&ImportParams::default()).unwrap();
    std::fs::remove_file(fixture.path("images").join(&fixture.names[4])).unwrap();
    std::fs::write(fixture.path("images/stranger.jpg"), b"").unwrap();
    let imported = fixture.import(&ImportParams::default()).unwrap();
    assert_eq!(imported.report.missing, [fixture.names[4].clone()]);
    assert_eq!(imported.report.extra, ["stranger.jpg"]);
    assert!(imported.report.to_string().contains("f04.png"));
    assert_eq!(imported.capture.views.len(), 8);
    assert_eq!(imported.capture.points[0].track_length, 8);
    assert_eq!(imported.capture.frame, before.capture.frame, "the frame is that of all registered images");
    // The prepared model is consistent.
    let prepared = prepare_all(&imported, &fixture.path("out"));
    let kept: Vec<u32> = prepared.model.images.iter().map(|i| i.id).collect();
    assert!(prepared.model.points[0].track.iter().all(|(id, _)| kept.contains(id)));
    for name in &fixture.names {
        let _ = std::fs::remove_file(fixture.path("images").join(name));
    }
    assert!(fixture.complaint(&ImportParams::default()).contains("none of the model's images"));
}

#[test]
fn names_that_leave_the_folder_are_refused() {
    let fixture = Fixture::new(3, pinhole(1));
    let model = read_model(&fixture.path("sparse/0")).unwrap();
    write_model_binary(&fixture.path("binary"), &model).unwrap();
    write_model_text(&fixture.path("text"), &model).unwrap();
    let long = "x".repeat(300);
    for evil in ["../../etc/passwd", "/etc/passwd", "a/../../x.png", "..\\x.png", "a\u{1b}[2J.png", &long] {
        for form in ["binary/images.bin", "text/images.txt"] {
            let honest = std::fs::read(fixture.path(form)).unwrap();
            let at = honest.windows(7).position(|w| w == b"f01.png").unwrap();
            let forged = [&honest[..at], evil.as_bytes(), &honest[at + 7..]].concat();
            std::fs::write(fixture.path(form), forged).unwrap();
            let dir = form.split('/').next().map(String::from);
            let message = fixture.complaint(&ImportParams { model_dir: dir, ..ImportParams::default() });
            assert!(message.contains("the name \"") && message.contains("images."), "{evil}: {message}");
            assert!(!message.contains('\u{1b}'), "{message}");
            std::fs::write(fixture.path(form), honest).unwrap();
        }
    }
}

#[test]
fn what_cannot_be_imported_is_explained() {
    let fixture = Fixture::new(3, pinhole(1));
    let complaint = |p: ImportParams| fixture.complaint(&p);
    let base = ImportParams::default;
    let message = complaint(ImportParams { image_dir: Some("photos".into()), ..base() });
    let missing = fixture.path("photos").display().to_string();
    assert!(
        message.contains("image_dir") && message.contains(&format!("{missing} is not there")),
        "{message}"
    );
    for place in ["x", "images"] {
        let message = complaint(ImportParams { model_dir: Some(place.into()), ..base() });
        let named =
            format!("names {}, which is no model of COLMAP, Metashape", fixture.path(place).display());
        assert!(message.contains("`model_dir`") && message.contains(&named), "{message}");
    }
    std::fs::create_dir(fixture.path("half")).unwrap();
    std::fs::write(fixture.path("half/images.bin"), b"").unwrap();
    let message = complaint(ImportParams { model_dir: Some("half".into()), ..base() });
    assert!(message.contains("half") && message.contains("lacks cameras.bin"), "{message}");
    assert!(complaint(ImportParams { mask_dir: Some("m".into()), ..base() }).contains("mask_dir"));
    assert!(complaint(ImportParams { downscale: 0, ..base() }).contains("downscale"));
    let message = complaint(ImportParams { downscale: 8, ..base() });
    assert!(
        message.contains("`downscale`: divided by 8, the longer side of ") && message.contains("15 pixels")
    );
    assert!(
        complaint(ImportParams { split: SplitParams { every: 1, ..SplitParams::default() }, ..base() })
            .contains("no training views")
    );
    write_png8(&fixture.path("images").join(&fixture.names[1]), &picture(111, 70, 0.0)).unwrap();
    let message = complaint(base());
    assert!(
        message.contains("111 x 70") && message.contains("120 x 80") && message.contains("image_dir"),
        "{message}"
    );
    std::fs::write(fixture.path("images").join(&fixture.names[1]), b"junk").unwrap();
    let report = fixture.import(&base()).expect("the others are used").report;
    assert!(report.to_string().contains("f01.png") && report.views == 2, "{report}");
    assert!(import(&fixture.path("nowhere"), &base()).unwrap_err().to_string().contains("no such folder"));
    let refused = import(&fixture.path("images"), &base()).unwrap_err().to_string();
    assert!(refused.contains("no camera positions found"), "{refused}");
}

#[test]
fn smaller_image_folders_scale_the_intrinsics() {
    let fixture = Fixture::new(3, pinhole(1));
    for name in &fixture.names {
        write_png8(&fixture.path("images_4").join(name), &picture(SIZE.0 / 4, SIZE.1 / 4, 0.0)).unwrap();
    }
    let params = ImportParams { image_dir: Some("images_4".into()), ..ImportParams::default() };
    let imported = fixture.import(&params).unwrap();
    let k = imported.capture.views[0].camera.intrinsics;
    assert_eq!((k.width, k.height, k.fx, k.fy, k.cx, k.cy), (30, 20, 25.0, 25.25, 15.25, 9.75));
    assert!(!imported.needs_preparation());
    assert!(imported.report.to_string().contains("files 30x20 (intrinsics scaled)"));
}

#[test]
fn resizing_moves_pixels_masks_depths_and_keypoints_together() {
    let fixture = Fixture::new(3, pinhole(1));
    let name = &fixture.names[0];
    // The first image has a mask with COLMAP's naming; its right half is ignored. It also has a depth prior
    // of half the size: a ramp with an unknown top.
    let mut mask = Map::new(SIZE.0, SIZE.1);
    let mut depth = Map::new(SIZE.0 / 2, SIZE.1 / 2);
    for y in 0..SIZE.1 {
        for x in 0..SIZE.0 {
            mask.set_pixel(x, y, [f32::from(x < SIZE.0 / 2)]);
        }
    }
    for y in 4..SIZE.1 / 2 {
        for x in 0..SIZE.0 / 2 {
            depth.set_pixel(x, y, [0.2 + 0.01 * x as f32]);
        }
    }
    write_png_map(&fixture.path("masks").join(format!("{name}.png")), &mask).unwrap();
    write_exr_map(&fixture.path("depths").join(name.replace(".png", ".exr")), &depth, "Z").unwrap();
    let params = ImportParams { size: Some(ImageSize { width: 40, height: 40 }), ..ImportParams::default() };
    let imported = fixture.import(&params).unwrap();
    assert!(imported.needs_preparation());
    assert_eq!((imported.report.masks, imported.report.depth_priors), (1, 1));
    let k = imported.capture.views[0].camera.intrinsics;
    // The scale is 1/2, then 10 columns are cut off on either side.
    assert_eq!((k.width, k.height, k.fx, k.cx, k.cy), (40, 40, 50.0, 20.5, 19.5));
    assert!(load_pixels(&imported.capture.views[0]).unwrap_err().to_string().contains("prepared"));

    let prepared = prepare_all(&imported, &fixture.path("out"));
    let view = &prepared.capture.views[0];
    let Pixels::Eight(pixels) = load_pixels(view).unwrap() else { panic!("8-bit stays 8-bit") };
    let source = picture(SIZE.0, SIZE.1, 0.0);
    let expected = (0..2)
        .flat_map(|dy| (0..2).map(move |dx| (dx, dy)))
        .map(|(dx, dy)| f32::from(source.pixel(20 + 2 * 7 + dx, 2 * 9 + dy)[1]))
        .sum::<f32>()
        / 4.0;
    assert_eq!(pixels.pixel(7, 9)[1], (expected + 0.5).floor() as u8);
    let mask = load_mask(view).unwrap().unwrap();
    assert_eq!((mask.pixel(19, 5), mask.pixel(20, 5)), ([1.0], [0.0]));
    let depth = load_depth_prior(view).unwrap().unwrap();
    assert_eq!(depth.pixel(5, 3), [0.0]);
    assert!((depth.pixel(5, 30)[0] - (0.2 + 0.01 * 15.0)).abs() < 1e-6, "{:?}", depth.pixel(5, 30));
    assert!(load_mask(&prepared.capture.views[1]).unwrap().is_none());
    let keypoint = prepared.model.images[0].keypoints[0];
    assert_eq!((keypoint.x, keypoint.y, keypoint.point), (30.0 / 2.0 - 10.0, 10.0, 5));
    // The result in memory equals the one from disk.
    let direct = imported.view(0).unwrap();
    assert_eq!(direct.pixels, Pixels::Eight(pixels));
    assert_eq!(direct.depth_prior.unwrap(), depth);
}

#[test]
fn tracks_are_pixels_of_the_views_before_and_after_preparation() {
    let fixture = Fixture::new(3, pinhole(1));
    // The track names an image and a keypoint that do not exist, and an image that is missing on this disk.
    let mut model = model(pinhole(1), &fixture.names);
    model.points[0].track.extend([(7, 0), (99, 17)]);
    write_model_binary(&fixture.path("sparse/0"), &model).unwrap();
    std::fs::remove_file(fixture.path("images").join(&fixture.names[1])).unwrap();
    let params = ImportParams { size: Some(ImageSize { width: 40, height: 40 }), ..ImportParams::default() };
    let imported = fixture.import(&params).unwrap();
    let [track] = &imported.tracks()[..] else { panic!("one point, one track") };
    assert_eq!(track.position, imported.capture.points[0].position);
    let seen: Vec<_> = track.sightings.iter().map(|s| (s.view, s.x, s.y)).collect();
    assert_eq!(seen, [(0, 5.0, 10.0), (1, 5.0, 10.0)], "scaled by 1/2, ten columns cut");
    assert_eq!(imported.tracks(), prepare_all(&imported, &fixture.path("out")).tracks());
    assert_eq!(imported.tracks(), load_prepared(&fixture.path("out")).unwrap().tracks());
}

#[test]
fn distorted_captures_come_out_as_pinholes_of_the_same_world() {
    let parameters = vec![100.0, 61.0, 39.0, -0.2, 0.05];
    let camera = ModelCamera {
        id: 9,
        model: LensModel::Radial,
        width: SIZE.0,
        height: SIZE.1,
        parameters: parameters.clone(),
    };
    let fixture = Fixture::new(4, camera);
    let imported = fixture.import(&ImportParams::default()).unwrap();
    assert!(imported.needs_preparation());
    let said = imported.report.to_string();
    assert!(said.contains("RADIAL") && said.contains("undistorted to"), "{said}");
    let prepared = prepare_all(&imported, &fixture.path("out"));
    let k = prepared.capture.views[0].camera.intrinsics;
    assert_eq!(load_pixels(&prepared.capture.views[0]).unwrap().size(), (k.width, k.height));
    let model = read_model(&fixture.path("out/sparse/0")).unwrap();
    assert_eq!(
        (model.cameras.len(), model.cameras[0].id, model.cameras[0].model),
        (1, 9, LensModel::Pinhole)
    );
    let lens = LensModel::Radial.lens(&parameters).unwrap();
    let (u, v) = lens.unproject(30.0, 20.0).unwrap();
    let keypoint = model.images[0].keypoints[0];
    assert!((keypoint.x - (u * k.fx + k.cx)).abs() < 1e-9 && (keypoint.y - (v * k.fy + k.cy)).abs() < 1e-9);
    let cameras = read_cameras(&fixture.path("out")).unwrap();
    assert_eq!(cameras[0].1.intrinsics, k);
    let straight = read_cameras(&fixture.path("sparse/0")).unwrap();
    assert_eq!(straight[0].1.intrinsics, k, "render's cameras are the prepared ones");
}

#[test]
fn preparation_does_not_depend_on_threads_and_can_be_stopped() {
    let camera = ModelCamera {
        id: 9,
        model: LensModel::SimpleRadial,
        width: SIZE.0,
        height: SIZE.1,
        parameters: vec![100.0, 60.0, 40.0, 0.1],
    };
    let fixture = Fixture::new(7, camera);
    let params =
        ImportParams { white_balance: WhiteBalance::SetPercentile, max_side: 64, ..ImportParams::default() };
    let imported = fixture.import(&params).unwrap();
    let stopped = fixture.path("stopped");
    let result = prepare(&imported, &stopped, 2, &|done, _| done < 9);
    assert!(matches!(result, Err(ImportError::Interrupted)));
    assert!(!is_prepared(&stopped));
    let mut folders = Vec::new();
    for threads in [1, 3, 8] {
        let out = fixture.path(&format!("out{threads}"));
        prepare(&imported, &out, threads, &|_, _| true).unwrap();
        let files: Vec<(PathBuf, Vec<u8>)> = walkdir::WalkDir::new(&out)
            .sort_by_file_name()
            .into_iter()
            .map(Result::unwrap)
            .filter(|e| e.file_type().is_file())
            .map(|e| (e.path().strip_prefix(&out).unwrap().to_path_buf(), std::fs::read(e.path()).unwrap()))
            .collect();
        assert!(files.len() >= 11);
        folders.push(files);
    }
    assert_eq!(folders[0], folders[1]);
    assert_eq!(folders[0], folders[2]);
    let prepared = load_prepared(&fixture.path("out1")).unwrap();
    let gains = prepared.report.white_balance.unwrap();
    assert!(gains[0] > 1.5 && gains[0] < 1.8, "red reaches 0.6: {gains:?}");
    assert_eq!(prepared.capture.views[0].camera.intrinsics.width, 64);
}

#[test]
fn alpha_is_a_mask_and_multiplies_mask_files() {
    let fixture = Fixture::new(3, pinhole(1));
    let mut rgba = image::RgbaImage::from_pixel(SIZE.0 as u32, SIZE.1 as u32, image::Rgba([9, 8, 7, 255]));
    rgba.put_pixel(3, 2, image::Rgba([9, 8, 7, 0]));
    rgba.save(fixture.path("images").join(&fixture.names[0])).unwrap();
    let imported = fixture.import(&ImportParams::default()).unwrap();
    assert_eq!(imported.report.alpha_masks, 1);
    let mask = load_mask(&imported.capture.views[0]).unwrap().unwrap();
    assert_eq!((mask.pixel(3, 2), mask.pixel(4, 2)), ([0.0], [1.0]));
    let mut file = Map::filled(SIZE.0, SIZE.1, 1.0);
    file.set_pixel(4, 2, [0.0]);
    write_png_map(&fixture.path("masks").join(&fixture.names[0]), &file).unwrap();
    for params in [
        ImportParams::default(),
        ImportParams { size: Some(ImageSize { width: 240, height: 160 }), ..ImportParams::default() },
    ] {
        let imported = fixture.import(&params).unwrap();
        let prepared =
            prepare_all(&imported, &fixture.path(if imported.needs_preparation() { "big" } else { "same" }));
        let mask = load_mask(&prepared.capture.views[0]).unwrap().unwrap();
        let at = |x: usize, y: usize| {
            if imported.needs_preparation() { mask.pixel(2 * x, 2 * y)[0] } else { mask.pixel(x, y)[0] }
        };
        // After enlarging by two, the weight of the nearest source pixel is at least 9/16.
        assert!(at(3, 2) < 0.5 && at(4, 2) < 0.5 && at(8, 2) == 1.0);
    }
}

#[test]
fn masks_without_effect_and_views_without_a_mask_are_noted() {
    let fixture = Fixture::new(4, pinhole(1));
    let mask = |name: &str| {
        let white = Map::filled(SIZE.0, SIZE.1, 1.0);
        write_png_map(&fixture.path("masks").join(name), &white).unwrap();
    };
    let said = || fixture.import(&ImportParams::default()).unwrap().report.to_string();
    assert!(!said().contains("mask"), "{}", said());
    mask("fish.png");
    let text = said();
    for part in [
        "note: masks/ holds 1 file (fish.png), and it does not have the name of a photograph",
        "dive 0/f00.png",
    ] {
        assert!(text.contains(part), "{text} lacks {part}");
    }
    // A mask of a photograph without a camera has a right name.
    std::fs::remove_file(fixture.path("masks/fish.png")).unwrap();
    write_png8(&fixture.path("images/extra.png"), &picture(SIZE.0, SIZE.1, 0.0)).unwrap();
    mask("extra.png");
    assert!(!said().contains("mask"), "{}", said());
    fixture.names[1..].iter().for_each(|name| mask(name));
    let report = fixture.import(&ImportParams::default()).unwrap().report;
    assert_eq!((&report.unmasked, report.misnamed_masks()), (&vec![fixture.names[0].clone()], None));
    assert!(report.to_string().contains("note: 1 photograph has no mask: dive 0/f00.png\n"), "{report}");
    let stored = serde_json::to_string(&report).unwrap();
    assert!(!stored.contains("extra.png") && !stored.contains("unmasked"), "{stored}");
}

#[test]
fn priors_and_masks_of_another_shape_are_refused() {
    let fixture = Fixture::new(3, pinhole(1));
    write_png_map(&fixture.path("depth").join(&fixture.names[0]), &Map::filled(50, 50, 0.5)).unwrap();
    let imported = fixture.import(&ImportParams::default()).unwrap();
    let message = load_depth_prior(&imported.capture.views[0]).unwrap_err().to_string();
    assert!(message.contains("50 x 50") && message.contains("120 x 80"), "{message}");
    write_png_map16(&fixture.path("depth").join(&fixture.names[0]), &Map::filled(240, 160, 0.5)).unwrap();
    let depth = load_depth_prior(&imported.capture.views[0]).unwrap().unwrap();
    assert_eq!((depth.width(), depth.height()), SIZE);
    assert!((depth.pixel(7, 7)[0] - 0.5).abs() < 1e-4);
}

#[test]
fn damaged_masks_and_priors_are_named_by_the_import_though_their_bytes_are_only_copied() {
    for folder in ["depth", "masks"] {
        let fixture = Fixture::new(3, pinhole(1));
        let damaged = fixture.path(folder).join(&fixture.names[1]);
        write_png_map(&damaged, &Map::filled(SIZE.0, SIZE.1, 0.5)).unwrap();
        let imported = fixture.import(&ImportParams::default()).unwrap();
        assert!(!imported.needs_preparation());
        prepare_all(&imported, &fixture.path("whole"));
        let bytes = std::fs::read(&damaged).unwrap();
        std::fs::write(&damaged, &bytes[..bytes.len() / 2]).unwrap();
        let error = prepare(&imported, &fixture.path("out"), 2, &|_, _| true).unwrap_err().to_string();
        assert!(error.contains(damaged.to_str().unwrap()) && error.contains("damaged"), "{error}");
    }
}

#[test]
fn stems_that_collide_and_cameras_of_two_sizes_are_kept_apart() {
    let fixture = Fixture::new(4, pinhole(1));
    let mut model = read_model(&fixture.path("sparse/0")).unwrap();
    model.images[0].name = FileName::new("a.png").unwrap();
    model.images[1].name = FileName::new("a.tif").unwrap();
    write_model_binary(&fixture.path("sparse/0"), &model).unwrap();
    write_png8(&fixture.path("images/a.png"), &picture(SIZE.0, SIZE.1, 0.0)).unwrap();
    write_png8(&fixture.path("images/a.tif"), &picture(SIZE.0 / 2, SIZE.1 / 2, 1.0)).unwrap();
    let imported = fixture.import(&ImportParams { downscale: 2, ..ImportParams::default() }).unwrap();
    assert_eq!(imported.report.cameras.len(), 2);
    let prepared = prepare_all(&imported, &fixture.path("out"));
    let names: Vec<&str> = prepared.capture.views.iter().map(|v| v.name.as_str()).collect();
    assert_eq!(names[..2], ["a.png", "a.tif.png"]);
    assert_eq!(prepared.model.cameras.len(), 2);
    let loaded = load_prepared(&fixture.path("out")).unwrap();
    assert_eq!(loaded.capture.views[1].camera.intrinsics.width, 30);
    for view in &loaded.capture.views {
        load_pixels(view).unwrap();
    }
}

#[test]
fn names_that_flatten_to_one_are_kept_apart() {
    let fixture = Fixture::new(3, pinhole(1));
    let mut model = read_model(&fixture.path("sparse/0")).unwrap();
    std::fs::create_dir_all(fixture.path("images/left")).unwrap();
    for (image, name) in model.images.iter_mut().zip(["left/1.png", "left_1.png", "right.png"]) {
        image.name = FileName::new(name).unwrap();
        write_png8(&fixture.path("images").join(name), &picture(SIZE.0, SIZE.1, 0.0)).unwrap();
    }
    write_model_binary(&fixture.path("sparse/0"), &model).unwrap();
    let prepared = prepare_all(&fixture.import(&ImportParams::default()).unwrap(), &fixture.path("out"));
    let flat: BTreeSet<String> = prepared.capture.views.iter().map(|v| v.flat_stem()).collect();
    assert_eq!(flat.len(), 3, "{flat:?}");
}

#[test]
fn names_as_long_as_names_may_be_are_imported() {
    let fixture = Fixture::new(3, pinhole(1));
    let mut model = read_model(&fixture.path("sparse/0")).unwrap();
    for (i, image) in model.images.iter_mut().enumerate() {
        let long = format!("{}{i}.png", "x".repeat(245));
        std::fs::rename(fixture.path("images").join(image.name.as_str()), fixture.path("images").join(&long))
            .unwrap();
        image.name = FileName::new(&long).unwrap();
    }
    write_model_binary(&fixture.path("sparse/0"), &model).unwrap();
    // The capture is copied once, and written with resized pixels once.
    for (out, downscale) in [("copied", 1), ("resized", 2)] {
        let params = ImportParams { downscale, ..ImportParams::default() };
        let prepared = prepare_all(&fixture.import(&params).unwrap(), &fixture.path(out));
        load_pixels(&prepared.capture.views[2]).unwrap();
    }
}

#[test]
fn damaged_prepared_captures_are_refused() {
    let fixture = Fixture::new(3, pinhole(1));
    let out = fixture.path("out");
    prepare_all(&fixture.import(&ImportParams::default()).unwrap(), &out);
    let manifest = std::fs::read_to_string(out.join("capture.json")).unwrap();
    let complaint = |text: &str| {
        std::fs::write(out.join("capture.json"), text).unwrap();
        load_prepared(&out).unwrap_err().to_string()
    };
    assert!(complaint(&manifest.replacen("\"version\": 1", "\"version\": 9", 1)).contains("version 9"));
    assert!(complaint(&manifest.replacen("images/", "images/../../", 1)).contains("leaves the folder"));
    assert!(
        complaint(&manifest.replacen("f00.png\",\n      \"mask", "f77.png\",\n      \"mask", 1))
            .contains("f77.png")
    );
    // A view's name becomes a path, and so do the names of its files.
    for evil in ["../../../outside.png", "/tmp/outside.png", "x/../../../outside.png"] {
        let message = complaint(&manifest.replacen(
            "\"name\": \"dive 1/f01.png\"",
            &format!("\"name\": \"{evil}\""),
            1,
        ));
        assert!(message.contains("outside.png") && message.contains("capture.json"), "{message}");
    }
    let twice =
        complaint(&manifest.replacen("\"name\": \"dive 1/f01.png\"", "\"name\": \"dive 0/f00.jpg\"", 1));
    assert!(twice.contains("f00.png and dive 0/f00.jpg"), "{twice}");
    assert!(complaint(&manifest[..manifest.len() / 2]).contains("capture.json"));
    assert!(complaint(&manifest.replacen("\"scale\": ", "\"scale\": -", 1)).contains("similarity"));
}

#[test]
fn camera_lists_are_read_in_both_spellings() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("path.json");
    let write = |text: &str| std::fs::write(&path, text).unwrap();
    write(
        r#"{"width": 640, "height": 360, "cameras": [
        {"name": "a", "fx": 500, "fy": 501, "cx": 320, "cy": 180, "rotation": [0,-1,0, 1,0,0, 0,0,1], "translation": [1,2,3]},
        {"K": [[500,0,320],[0,501,180],[0,0,1]], "world_to_camera": [[0,-1,0,1],[1,0,0,2],[0,0,1,3],[0,0,0,1]]}]}"#,
    );
    let cameras = read_cameras(&path).unwrap();
    assert_eq!((cameras[0].0.as_str(), cameras[1].0.as_str()), ("a", "0001"));
    assert_eq!(cameras[0].1, cameras[1].1);
    assert_eq!(cameras[0].1.pose.rotation * DVec3::X, DVec3::Y);
    for (text, expected) in [
        ("[]", "no cameras"),
        ("{", "path.json"),
        (r#"[{"width": 4, "height": 3, "fx": 1, "fy": 1, "cx": 0}]"#, "`cy` is missing"),
        (r#"[{"width": 4, "height": 3, "fx": 1, "fy": 1, "cx": 0, "cy": 0}]"#, "no pose"),
        (
            r#"[{"width": 4, "height": 3, "fx": -1, "fy": 1, "cx": 0, "cy": 0, "rotation": [1,0,0,0,1,0,0,0,1], "translation": [0,0,0]}]"#,
            "fx",
        ),
        (
            r#"[{"width": 4, "height": 3, "fx": 1, "fy": 1, "cx": 0, "cy": 0, "rotation": [2,0,0,0,1,0,0,0,1], "translation": [0,0,0]}]"#,
            "orthonormal",
        ),
        (
            r#"[{"width": 4000000000, "height": 3000000000, "fx": 1, "fy": 1, "cx": 0, "cy": 0, "rotation": [1,0,0,0,1,0,0,0,1], "translation": [0,0,0]}]"#,
            "beyond",
        ),
    ] {
        write(text);
        let message = read_cameras(&path).unwrap_err().to_string();
        assert!(message.contains(expected), "{message}");
    }
    assert!(read_cameras(&dir.path().join("none")).is_err());
}

#[test]
fn the_full_size_of_a_scaled_import_is_that_of_its_files() {
    let camera = ModelCamera {
        model: LensModel::SimpleRadial,
        parameters: vec![100.0, 61.0, 39.0, 0.05],
        ..pinhole(3)
    };
    let fixture = Fixture::new(5, camera);
    let whole = import(fixture.dir.path(), &ImportParams::default()).unwrap();
    for params in [
        ImportParams { max_side: 50, ..ImportParams::default() },
        ImportParams { size: Some(ImageSize { width: 40, height: 40 }), ..ImportParams::default() },
        ImportParams { downscale: 3, ..ImportParams::default() },
    ] {
        let scaled = import(fixture.dir.path(), &params).unwrap();
        assert!(scaled.capture.views[0].camera != whole.capture.views[0].camera);
        let full = scaled.full_size();
        assert_eq!(full.capture.views, whole.capture.views);
        assert_eq!(full.tracks(), whole.tracks());
        assert_eq!(full.view(2).unwrap(), whole.view(2).unwrap());
    }
    assert_eq!(whole.full_size().capture.views, whole.capture.views);
}

/// A capture with valid numbers that no training can learn from gets a note and is not refused.
#[test]
fn a_capture_of_which_nothing_can_be_learnt_says_so() {
    let names: Vec<String> = (0..4).map(|i| format!("{i}.png")).collect();
    let dir = tempfile::tempdir().unwrap();
    for (name, phase) in names.iter().zip(0..) {
        write_png8(&dir.path().join("images").join(name), &picture(SIZE.0, SIZE.1, phase as f32)).unwrap();
    }
    let notes = |change: &dyn Fn(&mut Model)| {
        let mut model = model(pinhole(1), &names);
        change(&mut model);
        write_model_binary(&dir.path().join("sparse/0"), &model).unwrap();
        import(dir.path(), &ImportParams::default()).unwrap().report.notes.join("; ")
    };
    assert_eq!(notes(&|_| ()), "");
    let same = notes(&|model| {
        let first = model.images[0].pose();
        let (id, camera) = (100, model.cameras[0].id);
        model.images.iter_mut().for_each(|image| {
            *image = ModelImage {
                keypoints: image.keypoints.clone(),
                ..ModelImage::at(image.id, image.name.clone(), camera, &first)
            };
        });
        assert!(model.images.iter().any(|image| image.id == id));
    });
    assert!(same.contains("the same camera position"), "{same}");
    let behind = notes(&|model| model.points.iter_mut().for_each(|p| p.position = [0.2, 0.3, -400.0]));
    assert!(behind.contains("behind all cameras"), "{behind}");
}
