//! Tests of real captures, if `USE3D_DATA` names the folder with them. The tests print if they run.

use std::path::PathBuf;

use use3d_import::*;
use use3d_io_colmap::*;

fn data() -> Option<PathBuf> {
    let dir = std::env::var_os("USE3D_DATA").map(PathBuf::from);
    match &dir {
        Some(dir) => eprintln!("USE3D_DATA = {}: testing the real captures there", dir.display()),
        None => eprintln!("USE3D_DATA is not set: the real captures are not tested"),
    }
    dir
}

#[test]
fn real_captures_import_and_load() {
    let Some(data) = data() else { return };
    // Folder, number of views, number of points, and true if the points have tracks.
    let captures = [
        ("reef_deepreefmap", 48, 20_091, true),
        ("vent_sucre", 36, 12_632, true),
        ("fern", 20, 10_091, false),
    ];
    for (name, views, points, tracks) in captures {
        let imported = import(&data.join(name), &ImportParams::default()).unwrap();
        eprint!("{}", imported.report);
        let capture = &imported.capture;
        assert_eq!((capture.views.len(), capture.points.len()), (views, points));
        assert_eq!(capture.points.iter().any(|p| p.track_length > 0), tracks);
        assert!(!imported.needs_preparation() && imported.report.missing.is_empty());
        assert_eq!(capture.split.test.len(), views.div_ceil(8));
        let view = &capture.views[views / 2];
        let pixels = load_pixels(view).unwrap();
        assert_eq!(pixels.size(), (view.camera.intrinsics.width, view.camera.intrinsics.height));
        assert!(load_mask(view).unwrap().is_none() && load_depth_prior(view).unwrap().is_none());
        // Points project into the pictures that saw them.
        let inside = |p: &use3d_capture::SparsePoint| {
            let k = &view.camera.intrinsics;
            let seen = view.camera.project(p.position);
            seen.is_some_and(|(p, _)| {
                (0.0..k.width as f64).contains(&p.x) && (0.0..k.height as f64).contains(&p.y)
            })
        };
        assert!(capture.points.iter().filter(|p| inside(p)).count() > points / 20);
    }
}

#[test]
fn real_half_size_folder_scales_the_intrinsics() {
    let Some(data) = data() else { return };
    let dir = data.join("reef_deepreefmap");
    let full = import(&dir, &ImportParams::default()).unwrap();
    let params = ImportParams { image_dir: Some("images_2".into()), ..ImportParams::default() };
    let half = import(&dir, &params).unwrap();
    eprint!("{}", half.report);
    let (a, b) = (&full.capture.views[3].camera.intrinsics, &half.capture.views[3].camera.intrinsics);
    assert_eq!(*b, a.downscaled(2));
    assert!(!half.needs_preparation());
    load_pixels(&half.capture.views[3]).unwrap();
}

#[test]
fn real_models_without_images() {
    let Some(data) = data() else { return };
    let dir = data.join("multicam_model");
    let message = import(&dir, &ImportParams::default()).unwrap_err().to_string();
    assert!(message.contains("image folder") && message.contains("image_dir"), "{message}");
    eprintln!("{message}");
    let binary = read_model(&dir.join("sparse/0")).unwrap();
    let text = read_model(&dir.join("sparse_txt")).unwrap();
    assert_eq!((binary.cameras.len(), binary.images.len(), binary.points.len()), (23, 23, 1443));
    for b in &binary.images {
        let t = text.images.iter().find(|t| t.id == b.id).unwrap();
        assert_eq!((t.camera, &t.name, t.keypoints.len()), (b.camera, &b.name, b.keypoints.len()));
        assert!((t.pose().translation - b.pose().translation).length() < 1e-12);
    }
    let distorted = read_model(&dir.join("sparse_distorted/0")).unwrap();
    assert!(distorted.cameras.iter().all(|c| c.model == LensModel::SimpleRadial));
    let cameras = read_cameras(&dir.join("sparse_distorted/0")).unwrap();
    assert_eq!(cameras.len(), 23);
    let listed = read_cameras(&data.join("garden_points/cameras.json")).unwrap();
    assert_eq!((listed.len(), listed[0].1.intrinsics.width), (3, 648));
}
