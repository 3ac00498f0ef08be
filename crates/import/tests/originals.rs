//! The photographs of a capture as they came: kept by an import, by an import of an import, and refused if
//! their file is damaged.

use std::path::{Path, PathBuf};

use glam::{DMat3, DVec3};
use use3d_capture::{Camera, FileName, Image, Map, Pose};
use use3d_import::*;
use use3d_io_colmap::*;
use use3d_io_image::{image_info, write_png_map, write_png8};
use use3d_survey::Lens;

const POINT: [f64; 3] = [0.4, 0.3, 5.0];

fn pose(i: usize) -> Pose {
    let turn = DMat3::from_axis_angle(DVec3::new(0.1, 1.0, 0.2).normalize(), 0.03 * i as f64);
    Pose::from_center(turn, DVec3::new(0.3 * i as f64, 0.1 * (i % 3) as f64, -0.1 * i as f64))
}

/// A radial camera, a fisheye, and a pinhole whose files have half the size of the model's.
fn cameras() -> Vec<ModelCamera> {
    let camera = |id, model, width, height, parameters: &[f64]| ModelCamera {
        id,
        model,
        width,
        height,
        parameters: parameters.to_vec(),
    };
    vec![
        camera(4, LensModel::Radial, 120, 80, &[100.0, 61.0, 39.0, 0.21, 0.2]),
        camera(2, LensModel::OpenCvFisheye, 96, 72, &[55.0, 56.0, 48.5, 35.0, -0.03, 0.01, 0.0, 0.0]),
        camera(7, LensModel::Pinhole, 160, 120, &[130.0, 131.0, 80.0, 61.0]),
    ]
}

/// The file of each view, relative to the image folder, with the index of its camera and its size.
const FILES: [(&str, usize, (usize, usize)); 6] = [
    ("left/IMG_1.JPG", 0, (120, 80)),
    ("left/IMG_2.jpg", 0, (120, 80)),
    ("right/IMG_1.JPG", 1, (96, 72)),
    ("right/b.png", 1, (96, 72)),
    ("small.png", 2, (80, 60)),
    ("top.png", 2, (80, 60)),
];

/// A JPEG with the EXIF orientation "turned by 90 degrees".
fn turned_jpeg(path: &Path, (width, height): (usize, usize), blue: u8) {
    let picture =
        image::RgbImage::from_fn(width as u32, height as u32, |x, y| image::Rgb([x as u8, y as u8, blue]));
    let mut bytes = std::io::Cursor::new(Vec::new());
    picture.write_to(&mut bytes, image::ImageFormat::Jpeg).unwrap();
    let mut bytes = bytes.into_inner();
    let mut exif =
        b"\xff\xe1\x00\x22Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0".to_vec();
    exif.extend([0; 4]);
    bytes.splice(2..2, exif);
    std::fs::write(path, bytes).unwrap();
}

/// A capture with sub-folders, three cameras, a mask, an image without a camera and a model's image without
/// a file.
fn capture(dir: &Path) {
    let keypoint = |i: usize, camera: usize| {
        let at = pose(i).rotation * DVec3::from_array(POINT) + pose(i).translation;
        let camera = &cameras()[camera];
        let lens = camera.model.lens(&camera.parameters).unwrap();
        let (x, y) = lens.project(at.x / at.z, at.y / at.z);
        Keypoint { x, y, point: 5 }
    };
    // One name in the model has another extension than its file.
    let name = |file: &str| FileName::new(&file.replace("top.png", "top.jpg")).unwrap();
    let mut images: Vec<ModelImage> = Vec::new();
    for (i, (file, camera, size)) in FILES.into_iter().enumerate() {
        let path = dir.join("images").join(file);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        if file.ends_with("png") {
            write_png8(&path, &Image::filled(size.0, size.1, 0.1 * i as f32).to_8bit()).unwrap();
        } else {
            turned_jpeg(&path, size, 40 * i as u8);
        }
        let image = ModelImage::at(i as u32 + 1, name(file), cameras()[camera].id, &pose(i));
        images.push(ModelImage { keypoints: vec![keypoint(i, camera)], ..image });
    }
    images.push(ModelImage::at(20, name("gone.png"), 4, &pose(9)));
    write_png8(&dir.join("images/left/spare.png"), &Image::filled(33, 22, 0.5).to_8bit()).unwrap();
    write_png_map(&dir.join("masks/right/b.png"), &Map::filled(96, 72, 1.0)).unwrap();
    let track = (0..FILES.len()).map(|i| (i as u32 + 1, 0)).collect();
    let point = ModelPoint { id: 5, position: POINT, color: [1, 2, 3], error: 0.1, track };
    let model = Model { cameras: cameras(), images, points: vec![point] };
    write_model_binary(&dir.join("sparse/0"), &model).unwrap();
}

fn params() -> ImportParams {
    ImportParams { max_side: 48, ..ImportParams::default() }
}

fn prepared(from: &Path, params: &ImportParams, out: &Path) -> Imported {
    prepare(&import(from, params).unwrap(), out, 2, &|_, _| true).unwrap()
}

/// A capture and its import, with the originals read back.
fn example() -> (tempfile::TempDir, PathBuf, Originals) {
    let dir = tempfile::tempdir().unwrap();
    capture(&dir.path().join("dive"));
    let out = dir.path().join("out");
    prepared(&dir.path().join("dive"), &params(), &out);
    let originals = Originals::read(&out).unwrap().expect("an import writes them");
    (dir, out, originals)
}

#[test]
fn an_import_keeps_files_sizes_and_distorted_lenses() {
    let (dir, out, originals) = example();
    assert_eq!((originals.image_folder.as_str(), originals.gains), ("images", None));
    assert_eq!(originals.missing, ["gone.png"]);
    let loaded = load_prepared(&out).unwrap().capture;
    assert_eq!(originals.photographs.len(), FILES.len());
    for (i, (original, (file, camera, (width, height)))) in
        originals.photographs.iter().zip(FILES).enumerate()
    {
        let view = &loaded.views[i];
        assert_eq!((&original.name, original.relative.as_str()), (&view.name, file));
        assert_eq!(original.file, format!("images/{file}"));
        assert_eq!(
            Camera { intrinsics: original.camera, pose: original.pose },
            view.camera,
            "to the last bit"
        );
        let info = image_info(&dir.path().join("dive").join(&original.file)).unwrap();
        assert_eq!((original.width, original.height), (width, height));
        assert_eq!((original.width, original.height), (info.width, info.height), "as stored, not turned");
        let model = &cameras()[camera];
        let lens: Lens = model.model.lens(&model.parameters).unwrap();
        let scale = width as f64 / model.width as f64;
        assert_eq!(original.lens, lens.scaled(scale, scale));
        assert_eq!(original.mask, file == "right/b.png");
        assert_eq!((original.held_out, original.train), (i == 0, i != 0));
        // The point lands where the model's own image has it.
        let at = loaded.frame.apply(DVec3::from_array(POINT));
        let at = original.pose.rotation * at + original.pose.translation;
        let (x, y) = original.lens.project(at.x / at.z, at.y / at.z);
        let seen = import(&dir.path().join("dive"), &params()).unwrap().model.images[i].keypoints[0];
        assert!((x - scale * seen.x).abs() < 1e-9 && (y - scale * seen.y).abs() < 1e-9, "{file}: {x} {y}");
    }
    assert!(loaded.views[4].camera.intrinsics.width <= 48, "the training is smaller");
    let folders = dir.path().to_str().unwrap();
    assert!(!std::fs::read_to_string(out.join(Originals::FILE)).unwrap().contains(folders));
}

#[test]
fn images_without_a_camera_are_those_of_today() {
    let (dir, _, originals) = example();
    let dive = dir.path().join("dive");
    assert_eq!(originals.without_camera(&dive).unwrap(), ["left/spare.png"]);
    write_png8(&dive.join("images/new.png"), &Image::filled(9, 9, 0.5).to_8bit()).unwrap();
    std::fs::write(dive.join("images/.hidden.png"), b"x").unwrap();
    assert_eq!(originals.without_camera(&dive).unwrap(), ["left/spare.png", "new.png"]);
    let said = originals.without_camera(&dir.path().join("none")).unwrap_err().to_string();
    assert!(said.contains("none/images") && said.contains("give the capture"), "{said}");
}

#[test]
fn photographs_beside_the_model_have_no_masks_among_them() {
    let dir = tempfile::tempdir().unwrap();
    capture(dir.path());
    for entry in std::fs::read_dir(dir.path().join("images")).unwrap() {
        let entry = entry.unwrap();
        std::fs::rename(entry.path(), dir.path().join(entry.file_name())).unwrap();
    }
    let given = ImportParams { image_dir: Some(".".into()), ..params() };
    let originals = Originals::of(&import(dir.path(), &given).unwrap());
    assert_eq!(originals.photographs[0].file, "left/IMG_1.JPG");
    assert_eq!(originals.without_camera(dir.path()).unwrap(), ["left/spare.png"]);
}

#[cfg(unix)]
#[test]
fn links_are_reached_by_the_path_of_the_users_folder() {
    let dir = tempfile::tempdir().unwrap();
    let (dive, elsewhere) = (dir.path().join("dive"), dir.path().join("disk"));
    capture(&dive);
    std::fs::rename(dive.join("images"), &elsewhere).unwrap();
    std::os::unix::fs::symlink(&elsewhere, dive.join("images")).unwrap();
    std::fs::rename(elsewhere.join("small.png"), dir.path().join("digest")).unwrap();
    std::os::unix::fs::symlink(dir.path().join("digest"), elsewhere.join("small.png")).unwrap();
    std::fs::rename(elsewhere.join("top.png"), elsewhere.join("left/real.png")).unwrap();
    std::os::unix::fs::symlink(elsewhere.join("left/real.png"), elsewhere.join("top.png")).unwrap();
    prepared(&dive, &params(), &dir.path().join("out"));
    let originals = Originals::read(&dir.path().join("out")).unwrap().unwrap();
    let files: Vec<&str> = originals.photographs.iter().map(|o| o.file.as_str()).collect();
    assert_eq!(files, FILES.map(|(file, ..)| format!("images/{file}")));
    assert_eq!(originals.without_camera(&dive).unwrap(), ["left/spare.png"]);
    let given = ImportParams { image_dir: Some("../disk".into()), ..params() };
    let originals = Originals::of(&import(&dive, &given).unwrap());
    assert_eq!(originals.photographs[0].file, "../disk/left/IMG_1.JPG");
}

#[test]
fn an_import_of_an_import_passes_the_first_ones_photographs_on() {
    let (dir, out, originals) = example();
    let again = dir.path().join("again");
    let imported = prepared(&out, &ImportParams::default(), &again);
    assert_eq!(Originals::read(&again).unwrap().as_ref(), Some(&originals));
    assert_eq!(Originals::of(&imported), originals);
    let bytes = |folder: &Path| std::fs::read(folder.join(Originals::FILE)).unwrap();
    assert_eq!(bytes(&out), bytes(&again));
    // A scene folder gets the same bytes.
    let scene = dir.path().join("scene");
    std::fs::create_dir(&scene).unwrap();
    Originals::hand_on(&again, &scene).unwrap();
    assert_eq!(bytes(&scene), bytes(&out));
}

#[test]
fn gains_are_kept_and_an_older_import_is_its_own_source() {
    let dir = tempfile::tempdir().unwrap();
    capture(&dir.path().join("dive"));
    let out = dir.path().join("out");
    let balanced = ImportParams { white_balance: WhiteBalance::SetPercentile, ..params() };
    let report = prepared(&dir.path().join("dive"), &balanced, &out).report;
    let originals = Originals::read(&out).unwrap().unwrap();
    assert!(originals.gains.is_some() && originals.gains == report.white_balance);
    std::fs::remove_file(out.join(Originals::FILE)).unwrap();
    assert_eq!(Originals::read(&out).unwrap(), None);
    Originals::hand_on(&out, dir.path()).unwrap();
    assert!(!dir.path().join(Originals::FILE).exists(), "nothing is there to hand on");
    let older = Originals::of(&load_prepared(&out).unwrap());
    let first = &older.photographs[0];
    assert_eq!((first.file.as_str(), older.gains), ("images/left/IMG_1.png", None));
    assert!(first.lens.is_pinhole() && first.lens.intrinsics(first.width, first.height) == first.camera);
}

#[test]
fn a_file_that_two_images_of_the_model_name_stands_once() {
    let dir = tempfile::tempdir().unwrap();
    capture(dir.path());
    let mut model = read_model(&dir.path().join("sparse/0")).unwrap();
    let twin = model.images.iter().find(|i| i.name == "small.png").unwrap().clone();
    model.images.push(ModelImage { id: 30, name: FileName::new("small.tif").unwrap(), ..twin });
    write_model_binary(&dir.path().join("sparse/0"), &model).unwrap();
    prepared(dir.path(), &params(), &dir.path().join("out"));
    let originals = Originals::read(&dir.path().join("out")).unwrap().unwrap();
    assert_eq!(originals.photographs.iter().filter(|o| o.relative == "small.png").count(), 1);
    assert_eq!(originals.photographs.len(), FILES.len());
}

#[test]
fn damaged_originals_are_refused_with_file_and_field() {
    let (_dir, out, _) = example();
    let path = out.join(Originals::FILE);
    let good = std::fs::read_to_string(&path).unwrap();
    for (from, to, expected) in [
        ("\"version\": 1", "\"version\": 7", "version 7"),
        ("3d-use originals", "something", "expected \"3d-use originals\""),
        ("\"image_folder\": \"images\"", "\"image_folder\": \"\"", "`image_folder`"),
        ("\"gains\": null", "\"gains\": [1.0, -1.0, 1.0]", "`gains`"),
        ("\"width\": 120", "\"width\": 0", "`lenses[0]`: the size"),
        ("\"width\": 120", "\"width\": 9000000000", "`lenses[0]`: the size"),
        ("\"width\": 120", "\"breadth\": 120", "`lenses[0].breadth`"),
        ("\"principal\": [", "\"principle\": [", "`lenses[0].lens.principle`"),
        ("100.0,\n          100.0", "100.0,\n          -100.0", "`lenses[0]`: `lens`: camera fy"),
        ("100.0,\n          100.0", "100.0,\n          null", "`lenses[0].lens.focal[1]`"),
        ("0.21,", "-40000.0,", "`lenses[0]`: `lens`: no ray"),
        ("\"equidistant\"", "\"wide\"", "`lenses[1].lens.projection"),
        ("\"relative\": \"left/IMG_1.JPG\"", "\"relative\": \"../IMG_1.JPG\"", "`photographs[0].relative`"),
        ("\"relative\": \"left/IMG_1.JPG\"", "\"relative\": \"left/IMG_2.jpg\"", "`photographs[1].relative`"),
        ("\"name\": \"left/IMG_2.png\"", "\"name\": \"left/IMG_1.png\"", "`photographs[1].name`"),
        ("\"name\": \"left/IMG_2.png\"", "\"name\": \"left/IMG_9.png\"", "no view of capture.json"),
        ("\"lens\": 1", "\"lens\": 11", "`photographs[2].lens`: there is no lens 11"),
        ("\"rotation\": [", "\"rotation\": [7,", "`photographs[0].rotation"),
        ("\"held_out\": true", "\"held_out\": 3", "`photographs[0].held_out`"),
        ("\"missing\": [", "\"missing\": [4,", "`missing[0]`"),
    ] {
        assert!(good.contains(from), "{from} in {good}");
        std::fs::write(&path, good.replacen(from, to, 1)).unwrap();
        let said = load_prepared(&out).unwrap_err().to_string();
        assert!(said.contains("originals.json: ") && said.contains(expected), "{from} → {to}: {said}");
        assert!(said.ends_with("import the capture again"), "{said}");
    }
    let elsewhere = good.replacen("\"translation\": [", "\"translation\": [0.5, 0.5, 0.5], \"unused\": [", 1);
    std::fs::write(&path, elsewhere).unwrap();
    assert!(load_prepared(&out).unwrap_err().to_string().contains("`photographs[0].unused`"));
    std::fs::write(&path, &good[..good.len() / 2]).unwrap();
    assert!(Originals::read(&out).unwrap_err().to_string().contains("originals.json"));
    std::fs::write(&path, &good).unwrap();
    let capture = std::fs::read_to_string(out.join("capture.json")).unwrap();
    std::fs::write(out.join("capture.json"), capture.replacen("\"cx\": ", "\"cx\": 1", 1)).unwrap();
    let said = load_prepared(&out).unwrap_err().to_string();
    assert!(said.contains("is not that of capture.json"), "{said}");
}
