//! Reading and writing COLMAP's files, and malicious files.

use std::path::Path;

use proptest::prelude::*;
use use3d_capture::FileName;
use use3d_io_colmap::*;

/// A small model with every kind of content: two cameras, ids out of order, an image without keypoints,
/// keypoints and points without tracks.
fn example() -> Model {
    let keypoint = |x: f64, y: f64, point: u64| Keypoint { x, y, point };
    Model {
        cameras: vec![
            ModelCamera {
                id: 7,
                model: LensModel::OpenCv,
                width: 640,
                height: 480,
                parameters: vec![500.1, 501.2, 320.3, 240.4, -0.1, 0.01, 1e-4, -2e-5],
            },
            ModelCamera {
                id: 2,
                model: LensModel::SimplePinhole,
                width: 32,
                height: 24,
                parameters: vec![30.0, 16.0, 12.0],
            },
        ],
        images: vec![
            ModelImage {
                id: 900,
                quaternion: [0.5, -0.5, 0.5, 0.5],
                translation: [0.1, -2e-17, 3e20],
                camera: 7,
                name: name("left side/b 1.png"),
                keypoints: vec![keypoint(1.5, 2.25, 33), keypoint(7.0, 8.0, Keypoint::NONE)],
            },
            ModelImage {
                id: 4,
                quaternion: [1.0, 0.0, 0.0, 0.1],
                translation: [0.0; 3],
                camera: 2,
                name: name("a.png"),
                keypoints: vec![],
            },
        ],
        points: vec![
            ModelPoint {
                id: 33,
                position: [1.0 / 3.0, -2.0, 5e-300],
                color: [255, 0, 17],
                error: 0.75,
                track: vec![(900, 0)],
            },
            ModelPoint { id: 12, position: [0.0; 3], color: [1, 2, 3], error: -1.0, track: vec![] },
        ],
    }
}

#[test]
fn binary_and_text_hold_the_same_to_the_last_bit() {
    let dir = tempfile::tempdir().unwrap();
    let (binary, text) = (dir.path().join("b"), dir.path().join("t"));
    let model = example();
    write_model_binary(&binary, &model).unwrap();
    write_model_text(&text, &model).unwrap();
    assert_eq!(ModelForm::of(&binary), Some(ModelForm::Binary));
    assert_eq!(ModelForm::of(&text), Some(ModelForm::Text));
    assert_eq!(read_model(&binary).unwrap(), model);
    assert_eq!(read_model(&text).unwrap(), model);
    // Text with the other kind of line ends, tabs, comments and blank lines between records.
    let images = std::fs::read_to_string(text.join("images.txt")).unwrap();
    let odd = images.replace('\n', "\r\n").replace("900 0.5", "\r\n# a remark\r\n900\t0.5");
    std::fs::write(text.join("images.txt"), odd).unwrap();
    assert_eq!(read_model(&text).unwrap(), model);
}

#[test]
fn the_binary_layout_is_colmaps() {
    let dir = tempfile::tempdir().unwrap();
    write_model_binary(dir.path(), &example()).unwrap();
    let cameras = std::fs::read(dir.path().join("cameras.bin")).unwrap();
    assert_eq!(cameras[..8], 2u64.to_le_bytes());
    assert_eq!(cameras[8..12], 7u32.to_le_bytes());
    assert_eq!(cameras[12..16], 4i32.to_le_bytes(), "OPENCV is model 4");
    assert_eq!(cameras[16..24], 640u64.to_le_bytes());
    assert_eq!(cameras[32..40], 500.1f64.to_le_bytes());
    let images = std::fs::read(dir.path().join("images.bin")).unwrap();
    assert_eq!(images[8..12], 900u32.to_le_bytes());
    assert_eq!(images[12..20], 0.5f64.to_le_bytes());
    assert_eq!(images[72..90], *b"left side/b 1.png\0");
    assert_eq!(images[90..98], 2u64.to_le_bytes());
    assert_eq!(images[98 + 40..98 + 48], (-1i64).to_le_bytes());
    let points = std::fs::read(dir.path().join("points3D.bin")).unwrap();
    assert_eq!(points[8..16], 33u64.to_le_bytes());
    assert_eq!(points[40..43], [255, 0, 17]);
}

fn name(text: &str) -> FileName {
    FileName::new(text).unwrap()
}

/// The message for a model with one error.
fn complaint(change: impl FnOnce(&mut Model)) -> String {
    let dir = tempfile::tempdir().unwrap();
    let mut model = example();
    change(&mut model);
    write_model_binary(dir.path(), &model).unwrap();
    read_model(dir.path()).unwrap_err().to_string()
}

#[test]
fn what_is_wrong_is_named() {
    type Change = fn(&mut Model);
    let cases: [(Change, &str); 12] = [
        (|m| m.cameras[1].id = 7, "camera 7: its id occurs twice"),
        (|m| m.cameras[0].width = 0, "0x480"),
        (|m| m.cameras[0].height = 1 << 40, "camera 7"),
        (|m| m.cameras[0].parameters[4] = f64::NAN, "parameter 4 is NaN"),
        (|m| m.cameras[1].parameters[0] = -30.0, "focal length"),
        (|m| m.images[1].camera = 99, "camera 99, which is not there"),
        (|m| m.images[1].id = 900, "its id occurs twice"),
        (|m| m.images[1].name = name("left side/b 1.png"), "its name occurs twice"),
        (|m| m.images[0].quaternion = [0.0; 4], "quaternion"),
        (|m| m.images[0].quaternion[2] = f64::NAN, "quaternion"),
        (|m| m.images[0].translation[1] = f64::INFINITY, "image 900 (left side/b 1.png): its translation"),
        (|m| m.points[0].position[0] = f64::NAN, "point 33"),
    ];
    for (change, expected) in cases {
        let message = complaint(change);
        assert!(message.contains(expected), "{message:?} lacks {expected:?}");
    }
}

#[test]
fn camera_models_that_are_no_lenses_are_named() {
    let path = Path::new("cameras.bin");
    let mut bytes = 1u64.to_le_bytes().to_vec();
    bytes.extend(1u32.to_le_bytes());
    bytes.extend(17i32.to_le_bytes());
    bytes.resize(200, 0);
    let message = binary::cameras(&bytes, path).unwrap_err().to_string();
    assert!(
        message.contains("EQUIRECTANGULAR (id 17)") && message.contains("perspective images"),
        "{message}"
    );
    bytes[12..16].copy_from_slice(&18i32.to_le_bytes());
    let message = binary::cameras(&bytes, path).unwrap_err().to_string();
    assert!(message.contains("id 18") && message.contains("image_undistorter"), "{message}");
    // Found by fuzzing: an id next to the smallest number caused an overflow.
    bytes[12..16].copy_from_slice(&(i32::MIN + 1).to_le_bytes());
    let message = binary::cameras(&bytes, path).unwrap_err().to_string();
    assert!(message.contains("damaged"), "{message}");
    let message = text::cameras(b"1 EQUIRECTANGULAR 20 10 20 10", path).unwrap_err().to_string();
    assert!(message.contains("EQUIRECTANGULAR") && message.contains("perspective images"), "{message}");
    let message = text::cameras(b"1 NONSENSE 10 10 1", path).unwrap_err().to_string();
    assert!(message.contains("NONSENSE") && message.contains("OPENCV_FISHEYE"), "{message}");
    let read = text::cameras(b"1 DIVISION 10 10 1 1 1 1 1", path).unwrap();
    assert_eq!((read[0].model, read[0].parameters.len()), (LensModel::Division, 5));
}

#[test]
fn counts_of_2_to_the_60_are_lies() {
    let path = Path::new("x.bin");
    let lie = (1u64 << 60).to_le_bytes();
    type Parse = fn(&[u8], &Path) -> Result<(), ModelError>;
    let parsers: [Parse; 3] = [
        |b, p| binary::cameras(b, p).map(|_| ()),
        |b, p| binary::images(b, p).map(|_| ()),
        |b, p| binary::points(b, p).map(|_| ()),
    ];
    for parse in parsers {
        let message = parse(&lie, path).unwrap_err().to_string();
        assert!(message.contains("1152921504606846976") && message.contains("x.bin"), "{message}");
    }
    // A false count inside a record: the keypoints of the first image.
    let dir = tempfile::tempdir().unwrap();
    write_model_binary(dir.path(), &example()).unwrap();
    let mut images = std::fs::read(dir.path().join("images.bin")).unwrap();
    images[90..98].copy_from_slice(&lie);
    let message = binary::images(&images, path).unwrap_err().to_string();
    assert!(message.contains("keypoints") && message.contains("image record 0"), "{message}");
    let mut points = std::fs::read(dir.path().join("points3D.bin")).unwrap();
    points[51..59].copy_from_slice(&lie);
    assert!(binary::points(&points, path).unwrap_err().to_string().contains("observations"));
}

#[test]
fn a_file_that_is_cut_off_is_said_with_the_next_step() {
    let path = Path::new("cameras.bin");
    let of = |count: u64, bytes: usize| {
        let file = [&count.to_le_bytes()[..], &vec![0; bytes][..]].concat();
        binary::cameras(&file, path).unwrap_err().to_string()
    };
    assert_eq!(
        of(1, 32),
        "cameras.bin: header, byte 8: the file is cut off: it announces 1 camera, but its data is enough \
         for 0; copy it again, or export the model again with COLMAP"
    );
    assert!(of(3, 2 * 48).contains("announces 3 cameras, but its data is enough for 2"), "{}", of(3, 96));
    let message = binary::cameras(&[1, 0, 0], path).unwrap_err().to_string();
    assert!(
        message.contains("the file is cut off: the next number has 8 bytes, but 3 bytes are left"),
        "{message}"
    );
}

#[test]
fn every_truncation_is_an_error_and_so_is_a_tail() {
    let dir = tempfile::tempdir().unwrap();
    write_model_binary(dir.path(), &example()).unwrap();
    let read = |name: &str| std::fs::read(dir.path().join(name)).unwrap();
    let path = Path::new("x.bin");
    let (cameras, images, points) = (read("cameras.bin"), read("images.bin"), read("points3D.bin"));
    for cut in 0..cameras.len() {
        assert!(binary::cameras(&cameras[..cut], path).is_err());
    }
    for cut in 0..images.len() {
        assert!(binary::images(&images[..cut], path).is_err());
    }
    for cut in 0..points.len() {
        assert!(binary::points(&points[..cut], path).is_err());
    }
    let tail = [points, vec![0]].concat();
    assert!(binary::points(&tail, path).unwrap_err().to_string().contains("1 bytes are left"));
}

#[test]
fn text_errors_name_the_line() {
    let path = Path::new("t.txt");
    let message = text::cameras(b"# x\n1 PINHOLE 10 ten 1 1 1 1\n", path).unwrap_err().to_string();
    assert!(message.contains("line 2") && message.contains("`ten` is not a valid height"), "{message}");
    let message = text::cameras(b"1 PINHOLE 10 10 1 1 1\n", path).unwrap_err().to_string();
    assert!(message.contains("3 parameters; PINHOLE has 4"), "{message}");
    let message = text::images(b"1 1 0 0 0 0 0 0 1\n\n", path).unwrap_err().to_string();
    assert!(message.contains("name"), "{message}");
    let message = text::images(b"1 1 0 0 0 0 0 0 1 a.png\n1.0 2.0\n", path).unwrap_err().to_string();
    assert!(message.contains("line 2") && message.contains("point id"), "{message}");
    let twice = b"1 1 0 0 0 0 0 0 1 a.png\n\n2 1 0 0 0 0 0 1 1 a.png\n\n";
    let message = text::images(twice, path).unwrap_err().to_string();
    assert!(message.contains("line 3") && message.contains("its name occurs twice (a.png)"), "{message}");
    let message = text::points(b"1 0 0 0 256 0 0 0\n", path).unwrap_err().to_string();
    assert!(message.contains("256"), "{message}");
    let message = text::points(b"\xff\xfe", path).unwrap_err().to_string();
    assert!(message.contains("UTF-8"), "{message}");
    assert!(matches!(read_model(Path::new("/nowhere")), Err(ModelError::NotFound { .. })));
}

/// Any finite number, of any size.
fn number() -> impl Strategy<Value = f64> {
    prop_oneof![any::<f64>().prop_filter("finite", |v| v.is_finite()), -1e3f64..1e3]
}

fn any_model() -> impl Strategy<Value = Model> {
    let camera =
        (0..LensModel::ALL.len(), 1usize..5000, 1usize..5000, prop::collection::vec(0.1f64..1e4, 16));
    let keypoints =
        prop::collection::vec((number(), number(), prop_oneof![Just(u64::MAX), 0u64..1 << 40]), 0..5);
    let image =
        (prop::array::uniform4(0.1f64..1.0), prop::array::uniform3(number()), "[a-z ]{0,6}[a-z]", keypoints);
    let point = (
        prop::array::uniform3(number()),
        any::<[u8; 3]>(),
        number(),
        prop::collection::vec(any::<(u32, u32)>(), 0..4),
    );
    (
        prop::collection::vec(camera, 1..4),
        prop::collection::vec(image, 0..5),
        prop::collection::vec(point, 0..5),
    )
        .prop_map(|(cameras, images, points)| Model {
            cameras: cameras
                .into_iter()
                .enumerate()
                .map(|(i, (model, width, height, parameters))| {
                    let model = LensModel::ALL[model];
                    ModelCamera {
                        id: 50 - i as u32,
                        model,
                        width,
                        height,
                        parameters: parameters[..model.parameter_count()].to_vec(),
                    }
                })
                .collect(),
            images: images
                .into_iter()
                .enumerate()
                .map(|(i, (quaternion, translation, name, keypoints))| ModelImage {
                    id: 10 + 3 * i as u32,
                    quaternion,
                    translation,
                    camera: 50,
                    name: FileName::new(&format!("{i}{}.png", name.trim())).unwrap(),
                    keypoints: keypoints.into_iter().map(|(x, y, point)| Keypoint { x, y, point }).collect(),
                })
                .collect(),
            points: points
                .into_iter()
                .enumerate()
                .map(|(i, (position, color, error, track))| ModelPoint {
                    id: i as u64 * 7,
                    position,
                    color,
                    error,
                    track,
                })
                .collect(),
        })
}

/// Feeds bytes to every parser; none may panic.
fn parse_all(bytes: &[u8]) {
    let path = Path::new("mutated");
    let _ = binary::cameras(bytes, path);
    let _ = binary::images(bytes, path);
    let _ = binary::points(bytes, path);
    let _ = text::cameras(bytes, path);
    let _ = text::images(bytes, path);
    let _ = text::points(bytes, path);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, rng_seed: proptest::test_runner::RngSeed::Fixed(11), ..ProptestConfig::default() })]

    #[test]
    fn any_model_survives_both_forms(model in any_model()) {
        let dir = tempfile::tempdir().unwrap();
        write_model_binary(dir.path(), &model).unwrap();
        prop_assert_eq!(&read_model_as(dir.path(), ModelForm::Binary).unwrap(), &model);
        write_model_text(dir.path(), &model).unwrap();
        prop_assert_eq!(&read_model_as(dir.path(), ModelForm::Text).unwrap(), &model);
    }

    /// A mutated file gives a model or an error; what was read can be checked and written.
    #[test]
    fn mutated_files_never_panic(file in 0usize..6, edits in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..10), cut in any::<prop::sample::Index>(), truncate in any::<bool>()) {
        thread_local!(static SEEDS: Vec<Vec<u8>> = {
            let dir = tempfile::tempdir().unwrap();
            write_model_binary(dir.path(), &example()).unwrap();
            write_model_text(dir.path(), &example()).unwrap();
            ["cameras.bin", "images.bin", "points3D.bin", "cameras.txt", "images.txt", "points3D.txt"].map(|n| std::fs::read(dir.path().join(n)).unwrap()).to_vec()
        });
        let mut bytes = SEEDS.with(|s| s[file].clone());
        for (at, value) in edits {
            let at = at.index(bytes.len());
            bytes[at] = value;
        }
        if truncate {
            bytes.truncate(cut.index(bytes.len()));
        }
        parse_all(&bytes);
    }

    #[test]
    fn noise_never_panics(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        parse_all(&bytes);
    }
}
