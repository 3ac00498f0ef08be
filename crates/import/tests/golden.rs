//! The small golden scene, with its model as text and as binary files.

use std::path::{Path, PathBuf};

use serde_json::Value;
use use3d_capture::Frame;
use use3d_import::*;
use use3d_io_colmap::*;
use use3d_io_image::read_image;

fn scene() -> PathBuf {
    use3d_golden::root().join("scene-mini")
}

fn truth() -> Value {
    let path = scene().join("scene.json");
    let text = std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    serde_json::from_slice(&text).unwrap()
}

fn params(form: &str) -> ImportParams {
    ImportParams { model_dir: Some(format!("sparse/{form}")), normalise: false, ..ImportParams::default() }
}

#[test]
fn golden_scene_imports_identically_from_text_and_binary() {
    let truth = truth();
    let expected = truth["views"].as_array().unwrap();
    let mut both = Vec::new();
    for form in ["text", "binary"] {
        let imported = import(&scene(), &params(form)).unwrap();
        assert!(!imported.needs_preparation());
        assert_eq!(imported.report.model_form, form);
        assert_eq!(imported.capture.frame, Frame::IDENTITY);
        let views = &imported.capture.views;
        assert_eq!(views.len(), expected.len());
        assert!(views.windows(2).all(|w| w[0].name < w[1].name), "views are in file-name order");
        for entry in expected {
            let name = entry["name"].as_str().unwrap();
            let view = views.iter().find(|v| v.name == name).unwrap();
            assert_eq!(u64::from(view.id), entry["image_id"].as_u64().unwrap());
            let k = &view.camera.intrinsics;
            for (field, value) in [("fx", k.fx), ("fy", k.fy), ("cx", k.cx), ("cy", k.cy)] {
                assert_eq!(entry[field].as_f64().unwrap(), value, "{name} {field}: intrinsics exactly");
            }
            assert_eq!(entry["width"].as_u64().unwrap(), k.width as u64);
            assert_eq!(entry["height"].as_u64().unwrap(), k.height as u64);
            let pose = &view.camera.pose;
            for row in 0..3 {
                for column in 0..3 {
                    let e = entry["R_cw"][row][column].as_f64().unwrap();
                    assert!((pose.rotation.col(column)[row] - e).abs() < 1e-12, "{name} R");
                }
                assert!(
                    (pose.translation[row] - entry["t_cw"][row].as_f64().unwrap()).abs() < 1e-12,
                    "{name} t"
                );
                assert!(
                    (pose.center()[row] - entry["center"][row].as_f64().unwrap()).abs() < 1e-12,
                    "{name} centre"
                );
            }
            let observed = imported.model.images.iter().find(|i| i.name == name).unwrap();
            let count = observed.keypoints.iter().filter(|k| k.point != Keypoint::NONE).count();
            assert!(truth["observations"][name].as_u64().unwrap() as usize >= count);
        }
        both.push(imported);
    }
    let (text, binary) = (&both[0], &both[1]);
    assert_eq!(text.model, binary.model);
    assert_eq!(text.capture.views, binary.capture.views);
    assert_eq!(text.capture.points, binary.capture.points);
    assert_eq!(text.capture.split.test, [0, 8]);
}

#[test]
fn golden_scene_is_found_without_being_told_where() {
    let imported = import(&scene(), &ImportParams::default()).unwrap();
    assert_eq!((imported.report.model.as_str(), imported.report.views), ("sparse/binary", 12));
    assert!(imported.report.to_string().contains("sparse/text"));
    let largest =
        imported.capture.views.iter().fold(0.0f64, |m, v| m.max(v.camera.pose.center().abs().max_element()));
    assert!((largest - 1.0).abs() < 1e-9);
}

#[test]
fn golden_models_survive_rewriting() {
    let dir = tempfile::tempdir().unwrap();
    for form in ["text", "binary"] {
        let model = read_model(&scene().join("sparse").join(form)).unwrap();
        write_model_binary(&dir.path().join("b"), &model).unwrap();
        write_model_text(&dir.path().join("t"), &model).unwrap();
        assert_eq!(read_model(&dir.path().join("b")).unwrap(), model);
        assert_eq!(read_model(&dir.path().join("t")).unwrap(), model);
    }
    let original = std::fs::read(scene().join("sparse/binary/images.bin")).unwrap();
    assert_eq!(std::fs::read(dir.path().join("b/images.bin")).unwrap(), original, "byte for byte");
}

#[test]
fn golden_exr_and_png_show_the_same() {
    let mut compared = 0;
    for entry in truth()["views"].as_array().unwrap() {
        let name = entry["name"].as_str().unwrap();
        let stem = Path::new(name).file_stem().unwrap().to_str().unwrap();
        let exr = read_image(&scene().join("exr").join(format!("{stem}.exr"))).unwrap();
        let png = read_image(&scene().join("images").join(name)).unwrap();
        for (a, b) in exr.data().iter().zip(png.data()) {
            assert!((a.clamp(0.0, 1.0) - b).abs() <= 0.5 / 255.0 + 1e-6, "{name}");
        }
        compared += 1;
    }
    assert!(compared > 0);
}

#[test]
fn golden_cameras_are_read_alone() {
    let from_model = read_cameras(&scene().join("sparse/text")).unwrap();
    let from_capture = read_cameras(&scene()).unwrap();
    assert_eq!(from_model, from_capture);
    let imported = import(&scene(), &params("text")).unwrap();
    for ((name, camera), view) in from_model.iter().zip(&imported.capture.views) {
        assert_eq!(name, &view.name);
        assert_eq!(camera.intrinsics, view.camera.intrinsics);
    }
}
