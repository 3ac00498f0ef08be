//! Captures that cannot be read, and their messages: the missing file, the content found instead, and the
//! next step.

use std::path::Path;

use use3d_capture::{FileName, Image, Intrinsics, Pose};
use use3d_import::*;
use use3d_io_colmap::*;
use use3d_io_image::write_png;

const NAMES: [&str; 3] = ["a.png", "b.png", "c.png"];

fn model() -> Model {
    let k = Intrinsics { width: 24, height: 16, fx: 20.0, fy: 20.0, cx: 12.0, cy: 8.0 };
    let at = |i: usize| Pose { translation: [i as f64, 0.0, 4.0].into(), ..Pose::IDENTITY };
    Model {
        cameras: vec![ModelCamera::pinhole(1, &k)],
        images: NAMES
            .iter()
            .enumerate()
            .map(|(i, n)| ModelImage::at(i as u32 + 1, FileName::new(n).unwrap(), 1, &at(i)))
            .collect(),
        points: vec![ModelPoint {
            id: 7,
            position: [0.0, 0.0, 1.0],
            color: [9; 3],
            error: 0.5,
            track: vec![(1, 0)],
        }],
    }
}

/// The import's error for a capture of three pictures after a change.
fn complaint(change: impl FnOnce(&Path)) -> String {
    let dir = tempfile::tempdir().unwrap();
    write_model_binary(&dir.path().join("sparse/0"), &model()).unwrap();
    for name in NAMES {
        write_png(&dir.path().join("images").join(name), &Image::filled(24, 16, 0.5)).unwrap();
    }
    change(dir.path());
    import(dir.path(), &ImportParams::default()).map(|i| i.report.to_string()).unwrap_err().to_string()
}

#[test]
fn what_lies_there_instead_of_a_model_is_said_with_the_next_step() {
    let without = |dir: &Path| std::fs::remove_dir_all(dir.join("sparse")).unwrap();
    type Change = fn(&Path);
    let cases: [(&str, Change); 11] = [
        ("no cameras file of Metashape", |d| std::fs::write(d.join("notes.xml"), "<html/>").unwrap()),
        ("Internal/External camera parameters", |d| std::fs::write(d.join("reef.RCPROJ"), "x").unwrap()),
        ("use3d prepare FILM", |d| std::fs::write(d.join("Dive.MP4"), "x").unwrap()),
        ("use3d prepare FILM", |d| std::fs::write(d.join("00001.MTS"), "x").unwrap()),
        ("this is a scene", |d| {
            std::fs::write(d.join("scene.json"), "{}").unwrap();
            std::fs::write(d.join("gaussians.ply"), "ply").unwrap();
        }),
        ("these are the results of a run; give the capture that they were made from", |d| {
            std::fs::remove_dir_all(d.join("images")).unwrap();
            std::fs::create_dir(d.join("runs")).unwrap();
            std::fs::write(d.join("runs/0001.json"), "{}").unwrap();
            std::fs::write(d.join("report.html"), "<html/>").unwrap();
        }),
        ("--set model_dir=DIR", |_| ()),
        ("--set import.model_dir=DIR", |_| ()),
        ("use3d prepare", |_| ()),
        ("the folder is empty", |d| std::fs::remove_dir_all(d.join("images")).unwrap()),
        ("folders in it have one (east, west)", |d| {
            for name in ["west", "east"] {
                write_model_binary(&d.join(name).join("sparse/0"), &model()).unwrap();
            }
        }),
    ];
    for (expected, change) in cases {
        let said = complaint(|dir| {
            without(dir);
            change(dir);
        });
        assert!(said.contains("no camera positions found") && said.contains(expected), "{said}");
    }
    // A file of another format is a model, and what is wrong with it is said by its field.
    for (file, text, expected) in [
        ("transforms.json", "{}", "`frames` is missing"),
        ("cameras.xml", "<document version=\"9\"/>", "`version` is \"9\""),
        ("reef.csv", "#name,x,y,alt,heading,pitch,roll,f\na.png,0,0,0,0,0,0,0", "`f` is 0"),
    ] {
        let said = complaint(|dir| {
            without(dir);
            std::fs::write(dir.join(file), text).unwrap();
        });
        assert!(said.contains(file) && said.contains(expected), "{said}");
    }
    let dir = tempfile::tempdir().unwrap();
    write_model_binary(&dir.path().join("sparse/0"), &model()).unwrap();
    let images = dir.path().join("images");
    std::fs::create_dir(&images).unwrap();
    let said = import(&images, &ImportParams::default()).unwrap_err().to_string();
    assert!(said.contains("the parent folder contains a model"), "{said}");
}

#[cfg(unix)]
#[test]
fn folders_that_may_not_be_read_are_not_called_empty() {
    use std::os::unix::fs::PermissionsExt;
    for place in ["", "sparse", "sparse/0", "images"] {
        let dir = tempfile::tempdir().unwrap();
        write_model_binary(&dir.path().join("sparse/0"), &model()).unwrap();
        for name in NAMES {
            write_png(&dir.path().join("images").join(name), &Image::filled(24, 16, 0.5)).unwrap();
        }
        let folder = if place.is_empty() { dir.path().to_path_buf() } else { dir.path().join(place) };
        let rights = |mode| std::fs::set_permissions(&folder, std::fs::Permissions::from_mode(mode)).unwrap();
        rights(0o000);
        // The system's administrator may read every folder.
        let free = std::fs::read_dir(&folder).is_ok();
        let imported = import(dir.path(), &ImportParams::default());
        rights(0o755);
        if free {
            return;
        }
        let said = imported.map(|i| i.report.to_string()).unwrap_err().to_string();
        let expected = format!("{}: you have no right to read this folder", folder.display());
        assert!(said.starts_with(&expected), "{said}");
    }
}

#[test]
fn a_model_that_lacks_a_file_or_is_cut_short_is_said_by_file() {
    let said = complaint(|dir| std::fs::remove_file(dir.join("sparse/0/points3D.bin")).unwrap());
    assert!(said.contains("lacks points3D.bin") && said.contains("sparse/0"), "{said}");
    for bytes in [&b""[..], b"abc"] {
        let said = complaint(|dir| std::fs::write(dir.join("sparse/0/images.bin"), bytes).unwrap());
        let length = format!("the file has {} bytes", bytes.len());
        assert!(said.contains("images.bin") && said.contains(&length), "{said}");
    }
}

#[test]
fn images_that_are_not_read_are_said_by_their_format() {
    for format in ["webp", "gpr"] {
        let said = complaint(|dir| {
            for name in NAMES {
                let from = dir.join("images").join(name);
                std::fs::rename(&from, from.with_extension(format)).unwrap();
            }
        });
        let part = format!("{} images are not read", format.to_uppercase());
        assert!(said.contains(&part) && said.contains("a.png"), "{said}");
    }
}

#[cfg(unix)]
#[test]
fn linked_images_are_followed_and_the_files_behind_them_stay_as_they_are() {
    let dir = tempfile::tempdir().unwrap();
    let (store, capture) = (dir.path().join("store"), dir.path().join("capture"));
    write_model_binary(&capture.join("sparse/0"), &model()).unwrap();
    std::fs::create_dir_all(capture.join("images")).unwrap();
    for (i, name) in NAMES.iter().enumerate() {
        let file = store.join(format!("{i}0af3.png"));
        write_png(&file, &Image::filled(24, 16, 0.5)).unwrap();
        std::os::unix::fs::symlink(&file, capture.join("images").join(name)).unwrap();
    }
    let before = std::fs::read(store.join("00af3.png")).unwrap();
    let imported = import(&capture, &ImportParams::default()).unwrap();
    assert_eq!(imported.report.views, 3);
    assert!(imported.report.extra.is_empty(), "{:?}", imported.report.extra);
    let out = dir.path().join("out");
    let prepared = prepare(&imported, &out, 1, &|_, _| true).unwrap();
    for view in &prepared.capture.views {
        assert!(std::fs::symlink_metadata(&view.image).unwrap().is_file(), "a copy, not a link");
    }
    assert_eq!(std::fs::read(store.join("00af3.png")).unwrap(), before);
}

#[test]
fn a_truncated_image_is_found_by_the_import_under_its_own_name() {
    let dir = tempfile::tempdir().unwrap();
    write_model_binary(&dir.path().join("sparse/0"), &model()).unwrap();
    for (i, name) in NAMES.iter().enumerate() {
        let path = dir.path().join("images").join(name);
        // The image is noise, so that the cut is within the pixels and not in a trailer.
        let mut image = Image::new(24, 16);
        for (k, v) in image.data_mut().iter_mut().enumerate() {
            *v = ((k * 7919 + i * 31) % 251) as f32 / 250.0;
        }
        write_png(&path, &image).unwrap();
    }
    let broken = dir.path().join("images/b.png");
    let bytes = std::fs::read(&broken).unwrap();
    std::fs::write(&broken, &bytes[..bytes.len() / 2]).unwrap();
    let imported = import(dir.path(), &ImportParams::default()).unwrap();
    let reason = imported.report.unusable.get("b.png").expect("the cut file is named");
    assert!(reason.contains("damaged"), "{reason}");
    assert_eq!(imported.report.views, NAMES.len() - 1);
}

#[test]
fn numbers_that_single_precision_cannot_hold_are_refused_by_field() {
    type Change = fn(&mut Model);
    let cases: [(&str, Change); 4] = [
        ("point 7: its position", |m| m.points[0].position[1] = 1e38),
        ("image 2 (b.png): its translation", |m| m.images[1].translation[0] = -1e20),
        ("camera 1: its focal length", |m| m.cameras[0].parameters[0] = 1e-300),
        ("camera 1: parameter 0", |m| m.cameras[0].parameters[0] = 1e200),
    ];
    for (expected, change) in cases {
        let mut changed = model();
        change(&mut changed);
        let said = complaint(|dir| write_model_binary(&dir.join("sparse/0"), &changed).unwrap());
        assert!(said.contains(expected), "{said} lacks {expected}");
    }
}

#[test]
fn normalising_a_tiny_swim_cannot_push_points_out_of_single_precision() {
    let mut changed = model();
    for image in &mut changed.images {
        image.translation.iter_mut().for_each(|v| *v *= 1e-11);
    }
    changed.points[0].position = [0.0, 1e6, 0.0];
    let said = complaint(|dir| write_model_binary(&dir.join("sparse/0"), &changed).unwrap());
    assert!(said.contains("point 7") && said.contains("normalise"), "{said}");
}

#[test]
fn cameras_of_a_text_file_need_names_of_their_own() {
    let dir = tempfile::tempdir().unwrap();
    write_model_text(dir.path(), &model()).unwrap();
    let path = dir.path().join("images.txt");
    assert_eq!(read_images_txt(&path).unwrap().len(), 3);
    let text = std::fs::read_to_string(&path).unwrap();
    std::fs::write(&path, text.replace("c.png", "a.png")).unwrap();
    let said = read_images_txt(&path).unwrap_err().to_string();
    // Two lines of comments come first, and each image has two lines.
    assert!(said.contains("images.txt: line 7: its name occurs twice (a.png)"), "{said}");
}

#[test]
fn lists_of_cameras_are_explained() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("scene.json");
    for (json, expected) in [
        ("{\"format\": \"3d-use scene\"}", "no list `cameras`"),
        ("7", "it is not a list"),
        ("[{\"width\": \"wide\"}]", "camera 0"),
        ("nonsense", "not JSON"),
        (
            "[\n\"a\",",
            "expected a COLMAP model folder, a capture folder, or a JSON list of cameras; this file is not \
             JSON (line 2)",
        ),
    ] {
        std::fs::write(&path, json).unwrap();
        let said = read_cameras(&path).unwrap_err().to_string();
        assert!(said.contains(expected) && said.contains("scene.json"), "{said}");
        assert!(!said.contains("untagged"), "{said}");
    }
}
