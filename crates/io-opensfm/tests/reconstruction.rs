//! One scene as COLMAP's and as OpenSfM's model, and files that mean harm.

use std::fmt::Write;
use std::path::Path;

use glam::{DMat3, DQuat, DVec3};
use use3d_capture::{FileName, Pose};
use use3d_golden::mutated;
use use3d_io_colmap::{LensModel, Model, ModelCamera};
use use3d_io_opensfm::{add_tracks, parse};
use use3d_survey::{Keypoint, PosedImage, Projection, ReadError, Survey, SurveyPoint};

const PATH: &str = "reef/reconstruction.json";
const SIZE: (usize, usize) = (1000, 700);

fn take(text: &str) -> Result<Survey, ReadError> {
    parse(text.as_bytes(), Path::new(PATH))
}

fn pose(i: u32) -> Pose {
    let i = f64::from(i);
    let turn = DMat3::from_axis_angle(DVec3::new(0.3, 1.0, -0.2 * i).normalize(), 0.2 * i - 0.4);
    Pose::from_center(turn, DVec3::new(0.7 * i, -0.2, 0.1 * i * i))
}

fn dots() -> Vec<DVec3> {
    (0..30).map(f64::from).map(|k| DVec3::new(0.1 * k - 1.0, 0.05 * k, 3.0 + 0.02 * k * k)).collect()
}

/// A COLMAP model with one camera, five images, points and tracks.
fn colmap(model: LensModel, parameters: &[f64]) -> Survey {
    let mut images: Vec<PosedImage> = (0..5)
        .map(|i| PosedImage::at(1 + i, FileName::new(&format!("f{i}.jpg")).unwrap(), 1, &pose(i)))
        .collect();
    let lens = model.lens(parameters).unwrap();
    let mut points = Vec::new();
    for (id, dot) in (1u64..).zip(dots()) {
        let mut track = Vec::new();
        for image in &mut images {
            let pose = image.pose();
            let at = pose.rotation * dot + pose.translation;
            if at.z > 0.1 {
                let (x, y) = lens.project(at.x / at.z, at.y / at.z);
                track.push((image.id, image.keypoints.len() as u32));
                image.keypoints.push(Keypoint { x, y, point: id });
            }
        }
        let color = [id as u8, 100, 200];
        points.push(SurveyPoint { id, position: dot.to_array(), color, error: -1.0, track });
    }
    let camera = ModelCamera { id: 1, model, width: SIZE.0, height: SIZE.1, parameters: parameters.to_vec() };
    Model { cameras: vec![camera], images, points }.into_survey(Path::new("sparse/0")).unwrap()
}

/// The same as OpenSfM writes it: the files of the reconstruction and of the tracks.
fn opensfm(survey: &Survey, camera: &str) -> (String, String) {
    let longer = SIZE.0.max(SIZE.1) as f64;
    let (mut shots, mut points) = (Vec::new(), Vec::new());
    let mut tracks = String::from("OPENSFM_TRACKS_VERSION_v1\n");
    for image in &survey.images {
        let pose = image.pose();
        let (axis, angle) = DQuat::from_mat3(&pose.rotation).to_axis_angle();
        let (r, t) = ((axis * angle).to_array(), pose.translation.to_array());
        shots.push(format!(
            r#""{}": {{"orientation": 1, "camera": "v2 gopro", "rotation": {r:?}, "translation": {t:?}, "scale": 1.0}}"#,
            image.name
        ));
        for (feature, k) in image.keypoints.iter().enumerate() {
            let x = (k.x - 0.5 * SIZE.0 as f64) / longer;
            let y = (k.y - 0.5 * SIZE.1 as f64) / longer;
            let (name, point) = (&image.name, k.point);
            writeln!(tracks, "{name}\t{point}\t{feature}\t{x}\t{y}\t0.002\t1\t2\t3").unwrap();
        }
    }
    for p in &survey.points {
        let color = p.color.map(f64::from);
        points.push(format!(r#""{}": {{"color": {color:?}, "coordinates": {:?}}}"#, p.id, p.position));
    }
    let text = format!(
        r#"[{{"cameras": {{"v2 gopro": {camera}, "unused": {{"projection_type": "spherical"}}}},
        "shots": {{{}}}, "points": {{{}}}, "reference_lla": {{"latitude": 0.0, "longitude": 0.0, "altitude": 0.0}}}},
        {{"cameras": {{}}, "shots": {{"x.jpg": {{}}}}, "points": {{}}}}]"#,
        shots.join(", "),
        points.join(", ")
    );
    (text, tracks)
}

#[test]
fn colmap_and_opensfm_describe_one_scene_by_the_same_cameras() {
    let s = 1000.0;
    // Focal lengths and the middle of the image in shares of the longer side.
    let brown = r#"{"projection_type": "brown", "width": 1000, "height": 700, "focal_x": 0.8125, "focal_y": 0.81025,
        "c_x": 0.003, "c_y": -0.0025, "k1": -0.15, "k2": 0.05, "k3": 0.0, "p1": 0.004, "p2": -0.003}"#;
    let fisheye = r#"{"projection_type": "fisheye_opencv", "width": 1000, "height": 700, "focal_x": 0.5, "focal_y": 0.51,
        "c_x": -0.002, "c_y": 0.002, "k1": -0.03, "k2": 0.012, "k3": -0.004, "k4": 0.0006}"#;
    let plain = r#"{"projection_type": "perspective", "width": 1000, "height": 700, "focal": 0.85, "k1": -0.1, "k2": 0.02}"#;
    for (model, parameters, camera) in [
        (LensModel::OpenCv, vec![812.5, 810.25, 503.0, 347.5, -0.15, 0.05, 0.004, -0.003], brown),
        (LensModel::OpenCvFisheye, vec![500.0, 510.0, 498.0, 352.0, -0.03, 0.012, -0.004, 0.0006], fisheye),
        (LensModel::Radial, vec![0.85 * s, 500.0, 350.0, -0.1, 0.02], plain),
    ] {
        let one = colmap(model, &parameters);
        let (text, tracks) = opensfm(&one, camera);
        let mut other = take(&text).unwrap();
        add_tracks(&mut other, tracks.as_bytes(), Path::new("reef/tracks.csv")).unwrap();
        assert_eq!((other.cameras.len(), other.images.len(), other.world.is_some()), (1, 5, false));
        let (a, b) = (&one.cameras[0], &other.cameras[0]);
        assert_eq!((a.width, a.height, a.lens.projection), (b.width, b.height, b.lens.projection));
        let mut compared = 0;
        for (a, b) in one.images.iter().zip(&other.images) {
            assert_eq!((a.id, &a.name), (b.id, &b.name));
            let (p, q) = (a.pose(), b.pose());
            assert!((p.center() - q.center()).length() < 1e-9);
            let turned = (p.rotation - q.rotation).to_cols_array();
            assert!(turned.iter().all(|v| v.abs() < 1e-9), "{turned:?}");
            for dot in dots() {
                let Some((x, y)) = one.project(a, dot.to_array()) else { continue };
                let (u, v) = other.project(b, dot.to_array()).unwrap();
                assert!((x - u).abs() < 1e-6 && (y - v).abs() < 1e-6, "{x} {y}, {u} {v}");
                compared += 1;
            }
            for (k, l) in a.keypoints.iter().zip(&b.keypoints) {
                assert!((k.x - l.x).abs() < 1e-9 && (k.y - l.y).abs() < 1e-9 && k.point == l.point);
            }
        }
        assert!(compared > 60, "{compared}");
        assert_eq!(one.points, other.points);
        assert!(other.notes[0].contains("reconstruction 1 is not used (1 shots)"), "{:?}", other.notes);
    }
}

/// A file of two shots, as text to be changed.
fn small() -> String {
    String::from(
        r#"[{"cameras": {"c": {"projection_type": "fisheye", "width": 64, "height": 48, "focal": 0.5, "k1": 0.1}},
        "shots": {"a.jpg": {"camera": "c", "rotation": [0, 0, 0], "translation": [1, 2, 3]},
        "b.jpg": {"camera": "c", "rotation": [0, 0, 1.5707963267948966], "translation": [0, 0, 0]}},
        "points": {"7": {"coordinates": [1, 2, 3], "color": [1, 2, 300]}},
        "reference_lla": {"latitude": 12.1, "longitude": -68.9, "altitude": 3.0}}]"#,
    )
}

#[test]
fn turns_lenses_and_the_place_on_earth_are_read_as_they_are_meant() {
    let survey = take(&small()).unwrap();
    let [a, b] = [0, 1].map(|i| survey.images[i].pose());
    assert!((a.translation - DVec3::new(1.0, 2.0, 3.0)).length() < 1e-15);
    assert!((b.rotation * DVec3::X - DVec3::Y).length() < 1e-12, "a quarter turn about z takes x to y");
    let camera = &survey.cameras[0];
    assert_eq!((camera.lens.focal, camera.lens.principal), ([32.0, 32.0], [32.0, 24.0]));
    assert_eq!((camera.lens.projection, camera.model.as_str()), (Projection::Equidistant, "fisheye"));
    assert_eq!((survey.points[0].id, survey.points[0].color), (7, [1, 2, 255]));
    let world = survey.world.unwrap();
    assert!(world.metres_per_unit == 1.0 && world.source.contains("latitude 12.1000000"), "{world:?}");
}

#[test]
fn faults_are_named() {
    for (from, to, expected) in [
        ("fisheye", "spherical", "camera c: `projection_type` is spherical"),
        ("\"width\": 64", "\"width\": 64.5", "whole number"),
        ("\"width\": 64, ", "", "`width` is missing"),
        ("\"height\": 48", "\"height\": 4000000000", "its size is 64x4000000000"),
        ("\"focal\": 0.5", "\"focal\": -1", "above 0"),
        ("\"focal\": 0.5, ", "", "`focal` is missing"),
        ("\"focal\": 0.5", "\"focal\": \"long\"", "finite number"),
        ("\"k1\": 0.1", "\"p1\": 0.1", "fisheye"),
        ("\"k1\": 0.1", "\"k6\": 0.1", "`k6`"),
        ("\"rotation\": [0, 0, 0]", "\"rotation\": [0, 0]", "shot a.jpg: `rotation`"),
        ("\"translation\": [1, 2, 3]", "\"translation\": [1, 2, null]", "`translation`"),
        ("\"camera\": \"c\", \"rotation\": [0, 0, 0]", "\"rotation\": [0, 0, 0]", "`camera` is missing"),
        ("\"camera\": \"c\", \"rotation\": [0, 0, 0]", "\"camera\": \"d\"", "`camera` is d"),
        ("a.jpg", "../a.jpg", "shot ../a.jpg"),
        ("\"coordinates\": [1, 2, 3]", "\"coordinates\": [1, 2]", "no reconstruction of OpenSfM"),
        ("\"coordinates\": [1, 2, 3]", "\"coordinates\": [1, 2, 3e40]", "point 7"),
        ("{\"7\": ", "{\"p7\": ", "point p7: its id is no whole number"),
        ("{\"7\": ", "{\"07\": {\"coordinates\": [0, 0, 1]}, \"7\": ", "point 7: the id 7 occurs twice"),
        ("[{\"cameras\"", "{\"cameras\"", "no reconstruction of OpenSfM"),
    ] {
        let text = small().replacen(from, to, 1);
        assert_ne!(text, small(), "{from}");
        let said = take(&text).unwrap_err().to_string();
        assert!(said.contains(PATH) && said.contains(expected), "{to}: {said}");
    }
    assert!(take("[]").unwrap_err().to_string().contains("no shots"));
    let mut survey = take(&small()).unwrap();
    let path = Path::new("reef/tracks.csv");
    for bad in ["a.jpg\t7\t0\t0.1", "a.jpg\tx\t0\t0.1\t0.2", "a.jpg,7,0,0.1,0.2", "a.jpg\t7\t0\tNaN\t0.2"] {
        let said = add_tracks(&mut survey, bad.as_bytes(), path).unwrap_err().to_string();
        assert!(said.contains("line 1") && said.contains("create_tracks"), "{said}");
    }
    // Images and points that are not there are no errors: OpenSfM writes the tracks of all pictures.
    add_tracks(&mut survey, b"c.jpg\t7\t0\t0.1\t0.2\na.jpg\t8\t0\t0\t0\na.jpg\t7\t4\t0.25\t-0.25\n", path)
        .unwrap();
    assert_eq!(survey.points[0].track, [(1, 0)]);
    assert_eq!((survey.images[0].keypoints[0].x, survey.images[0].keypoints[0].y), (48.0, 8.0));
}

#[test]
fn mutated_files_never_panic() {
    let seed = small().into_bytes();
    let mut read = 0;
    for round in 0..20_000 {
        let bytes = mutated(&seed, b"0123456789.-e,[]{}\"", round);
        if let Ok(mut survey) = parse(&bytes, Path::new("mutated.json")) {
            read += 1;
            let _ = add_tracks(&mut survey, &bytes, Path::new("mutated.csv"));
        }
    }
    assert!(read > 100, "only {read} of the mutated files were read: the seed is too brittle");
}
