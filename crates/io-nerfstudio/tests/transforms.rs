//! There and back, one scene in every format, and files that mean harm.

use std::fmt::Write;
use std::path::Path;

use glam::{DMat3, DVec3};
use use3d_capture::{FileName, Pose};
use use3d_golden::mutated;
use use3d_io_colmap::{LensModel, Model, ModelCamera};
use use3d_io_nerfstudio::{Transforms, export, parse, read};
use use3d_numerics::math;
use use3d_survey::{ImageFiles, Lens, PosedImage, ReadError, Survey, SurveyCamera, SurveyPoint};

const PATH: &str = "dive/transforms.json";

fn name(text: &str) -> FileName {
    FileName::new(text).unwrap()
}

fn take(text: &str) -> Result<Transforms, ReadError> {
    parse(text.as_bytes(), Path::new(PATH))
}

fn complaint(text: &str) -> String {
    let said = take(text).unwrap_err().to_string();
    assert!(said.contains(PATH), "{said}");
    said
}

fn pose(i: u32) -> Pose {
    let i = f64::from(i);
    let turn = DMat3::from_axis_angle(DVec3::new(0.3, 1.0, -0.2 * i).normalize(), 0.2 * i - 0.4);
    Pose::from_center(turn, DVec3::new(0.7 * i, -0.2, 0.1 * i * i))
}

/// Two cameras, a plain and a fisheye one, five images, points, masks and a depth map.
fn survey() -> Survey {
    let lens = |model: LensModel, parameters: &[f64]| model.lens(parameters).unwrap();
    let camera = |id, model: LensModel, parameters: &[f64]| SurveyCamera {
        id,
        model: model.name().into(),
        label: None,
        width: 1000,
        height: 700,
        lens: lens(model, parameters),
    };
    let opencv = [812.5, 810.25, 503.0, 347.5, -0.15, 0.05, 0.004, -0.003];
    let fisheye = [500.0, 510.0, 498.0, 352.0, -0.03, 0.012, -0.004, 0.0006];
    let mut out = Survey {
        cameras: vec![camera(1, LensModel::OpenCv, &opencv), camera(2, LensModel::OpenCvFisheye, &fisheye)],
        images: (0..5)
            .map(|i| PosedImage::at(10 + i, name(&format!("left/f{i}.jpg")), 1 + i % 2, &pose(i)))
            .collect(),
        points: (0..30)
            .map(|k| SurveyPoint {
                id: k + 1,
                position: [0.1 * k as f64 - 1.0, 0.05 * k as f64, 3.0 + 0.02 * (k * k) as f64],
                color: [k as u8, 100, 200],
                error: -1.0,
                track: vec![],
            })
            .collect(),
        ..Survey::default()
    };
    out.files.insert(11, ImageFiles { mask: Some(name("masks/f1.png")), depth: Some(name("d/f1.exr")) });
    out
}

/// The largest distance between the pixels of two surveys' images, by name, over the first one's points.
fn apart(a: &Survey, b: &Survey) -> f64 {
    let (mut worst, mut compared) = (0.0f64, 0);
    assert_eq!(a.images.len(), b.images.len());
    for (one, other) in a.images.iter().zip(&b.images) {
        for point in &a.points {
            let Some((x, y)) = a.project(one, point.position) else { continue };
            let (u, v) = b.project(other, point.position).unwrap();
            worst = worst.max(((x - u) * (x - u) + (y - v) * (y - v)).sqrt());
            compared += 1;
        }
    }
    assert!(compared > 60, "{compared}");
    worst
}

#[test]
fn a_survey_comes_back() {
    let before = survey();
    let written = export(&before, "images").unwrap();
    let mut after = take(&written.transforms).unwrap();
    assert_eq!(after.points, Some(name("sparse_pc.ply")));
    after.add_points(written.points.unwrap().as_bytes(), Path::new("dive/sparse_pc.ply")).unwrap();
    let after = after.survey;
    assert!(apart(&before, &after) < 1e-9);
    for (a, b) in before.points.iter().zip(&after.points) {
        assert!((DVec3::from_array(a.position) - DVec3::from_array(b.position)).length() < 1e-12);
        assert_eq!(a.color, b.color);
    }
    assert_eq!(after.files, before.files);
    assert_eq!((after.images[1].id, after.images[1].name.as_str()), (11, "images/left/f1.jpg"));
    assert_eq!(
        after.cameras.iter().map(|c| c.lens).collect::<Vec<_>>(),
        before.cameras.iter().map(|c| c.lens).collect::<Vec<_>>()
    );
    // With one camera the lens stands at the top, and nowhere else.
    let mut one = before;
    one.retain_images(|image| image.camera == 1);
    one.cameras.truncate(1);
    let text = export(&one, "").unwrap().transforms;
    assert_eq!(text.matches("fl_x").count(), 1);
    assert_eq!(take(&text).unwrap().survey.images[0].name, "left/f0.jpg");
}

#[test]
fn descriptions_of_one_scene_in_every_format_give_the_same_cameras() {
    let whole = survey();
    let opencv = [812.5, 810.25, 503.0, 347.5, -0.15, 0.05, 0.004, -0.003];
    let model = Model {
        cameras: vec![ModelCamera {
            id: 1,
            model: LensModel::OpenCv,
            width: 1000,
            height: 700,
            parameters: opencv.to_vec(),
        }],
        images: whole.images.iter().map(|i| PosedImage { camera: 1, ..i.clone() }).collect(),
        points: whole.points.clone(),
    };
    let colmap = model.clone().into_survey(Path::new("sparse/0")).unwrap();

    // Metashape's f is fy, b1 is fx - fy, the principal point counts from the middle, p1 and p2 change
    // places.
    let [fx, fy, cx, cy, k1, k2, p1, p2] = opencv;
    let mut cameras = String::new();
    for image in &whole.images {
        let pose = image.pose();
        let (r, c) = (pose.rotation.to_cols_array_2d(), pose.center());
        let row = |i: usize| format!("{} {} {} {}", r[i][0], r[i][1], r[i][2], c[i]);
        let id = image.id;
        write!(
            cameras,
            "<camera id=\"{id}\" sensor_id=\"0\" label=\"left/f{}\"><transform>{} {} {} 0 0 0 1</transform></camera>",
            id - 10,
            row(0),
            row(1),
            row(2)
        )
        .unwrap();
    }
    let xml = format!(
        "<document version=\"2.1.0\"><chunk><sensors><sensor id=\"0\" type=\"frame\"><calibration class=\"adjusted\">\
         <resolution width=\"1000\" height=\"700\"/><f>{fy}</f><cx>{}</cx><cy>{}</cy><b1>{}</b1><k1>{k1}</k1><k2>{k2}</k2>\
         <p1>{p2}</p1><p2>{p1}</p2></calibration></sensor></sensors><cameras>{cameras}</cameras></chunk></document>",
        cx - 500.0,
        cy - 350.0,
        fx - fy
    );
    let metashape = use3d_io_metashape::parse(xml.as_bytes(), Path::new("cameras.xml")).unwrap();
    assert!(apart(&colmap, &metashape) < 1e-6);

    // As ns-process-data writes it: y and z of the camera reversed, then z made up.
    let mut frames = Vec::new();
    for image in &whole.images {
        let pose = image.pose();
        let (r, c) = (pose.rotation.to_cols_array_2d(), pose.center().to_array());
        let gl: Vec<[f64; 4]> = (0..3).map(|i| [r[i][0], -r[i][1], -r[i][2], c[i]]).collect();
        let up = [gl[0], gl[2], gl[1].map(|v| -v)];
        let path = image.name.as_str();
        frames.push(
            serde_json::json!({"file_path": path, "transform_matrix": [up[0], up[1], up[2], [0, 0, 0, 1]]}),
        );
    }
    let json = serde_json::json!({
        "w": 1000, "h": 700.0, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "k1": k1, "k2": k2, "p1": p1, "p2": p2,
        "camera_model": "OPENCV", "frames": frames,
        "applied_transform": [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]],
    });
    let nerfstudio = take(&json.to_string()).unwrap().survey;
    assert!(apart(&colmap, &nerfstudio) < 1e-6);
    assert_eq!(nerfstudio.images[4].id, 5, "counted where COLMAP's ids are not there");

    // OpenSfM: shares of the longer side, from the middle, and an axis times an angle.
    let shots = whole.images.iter().map(|image| {
        let pose = image.pose();
        let (axis, angle) = glam::DQuat::from_mat3(&pose.rotation).to_axis_angle();
        let (rotation, translation) = ((axis * angle).to_array(), pose.translation.to_array());
        let shot = serde_json::json!({"camera": "c", "rotation": rotation, "translation": translation});
        (image.name.to_string(), shot)
    });
    let shots: serde_json::Map<String, serde_json::Value> = shots.collect();
    let camera = serde_json::json!({
        "projection_type": "brown", "width": 1000, "height": 700, "focal_x": fx / 1000.0, "focal_y": fy / 1000.0,
        "c_x": (cx - 500.0) / 1000.0, "c_y": (cy - 350.0) / 1000.0, "k1": k1, "k2": k2, "k3": 0.0, "p1": p1, "p2": p2,
    });
    let json = serde_json::json!([{"cameras": {"c": camera}, "shots": shots}]);
    let opensfm =
        use3d_io_opensfm::parse(json.to_string().as_bytes(), Path::new("reconstruction.json")).unwrap();
    assert!(apart(&colmap, &opensfm) < 1e-6);

    // RealityScan has one focal length: the scene again, with fy = fx.
    let square = Model {
        cameras: vec![ModelCamera {
            parameters: [fx, fx, cx, cy, k1, k2, p1, p2].to_vec(),
            ..model.cameras[0].clone()
        }],
        ..model
    };
    let square = square.into_survey(Path::new("sparse/0")).unwrap();
    let (mut table, mut sidecars) =
        (String::from("#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n"), Vec::new());
    let (f, px, py) = (fx / 1000.0 * 36.0, (cx - 500.0) / 1000.0, (cy - 350.0) / 1000.0);
    for image in &whole.images {
        let (pose, name) = (image.pose(), image.name.as_str());
        let c = pose.center();
        // The camera's axes in the world, with y up and z backward, are Rz(-heading) Rx(pitch) Ry(roll).
        let [right, down, ahead] = pose.rotation.transpose().to_cols_array_2d();
        let pitch = math::atan2(-down[2], math::hypot(right[2], ahead[2]));
        let heading = -math::atan2(down[0], -down[1]);
        let roll = math::atan2(-right[2], -ahead[2]);
        let [heading, pitch, roll] = [heading, pitch, roll].map(f64::to_degrees);
        writeln!(
            table,
            "{name},{},{},{},{heading},{pitch},{roll},{f},{px},{py},{k1},{k2},0,0,{p2},{p1}",
            c.x, c.y, c.z
        )
        .unwrap();
        let rows = pose.rotation.transpose().to_cols_array().map(|v| v.to_string()).join(" ");
        let text = format!(
            "<rdf:Description xmlns:rdf=\"http://www.w3.org/1999/02/22-rdf-syntax-ns#\" \
             xmlns:xcr=\"http://www.capturingreality.com/ns/xcr/1.1#\" xcr:Version=\"3\" xcr:DistortionModel=\"brown3t2\" \
             xcr:FocalLength35mm=\"{f}\" xcr:PrincipalPointU=\"{px}\" xcr:PrincipalPointV=\"{py}\" \
             xcr:DistortionCoeficients=\"{k1} {k2} 0 0 {p2} {p1}\"><xcr:Rotation>{rows}</xcr:Rotation>\
             <xcr:Position>{} {} {}</xcr:Position></rdf:Description>",
            c.x, c.y, c.z
        );
        let (name, path) = (image.name.clone(), "a.xmp".into());
        sidecars.push(use3d_io_realityscan::Sidecar { name, path, bytes: text.into_bytes() });
    }
    let by_table = use3d_io_realityscan::parse_table(table.as_bytes(), Path::new("cameras.csv")).unwrap();
    let by_xmp = use3d_io_realityscan::parse_sidecars(&sidecars, Path::new("images")).unwrap();
    for registration in [by_table, by_xmp] {
        let sizes = whole.images.iter().map(|image| (image.name.clone(), (1000, 700))).collect();
        let realityscan = registration.into_survey(&sizes, Path::new("cameras.csv")).unwrap();
        assert!(apart(&square, &realityscan) < 1e-6);
    }
}

/// A file of two frames, as text to be changed.
fn small() -> String {
    String::from(
        r#"{"camera_model": "OPENCV", "w": 64, "h": 48, "fl_x": 50, "fl_y": 51, "cx": 32, "cy": 24, "k1": 0.1,
        "frames": [
          {"file_path": "./images/a.png", "transform_matrix": [[1,0,0,1],[0,1,0,2],[0,0,1,3],[0,0,0,1]]},
          {"file_path": "images/b.png", "transform_matrix": [[0,-1,0,4],[1,0,0,5],[0,0,1,6],[0,0,0,1]], "k1": null}]}"#,
    )
}

#[test]
fn axes_frame_and_lens_are_read_as_they_are_meant() {
    let survey = take(&small()).unwrap().survey;
    let first = survey.images[0].pose();
    // Looking along -z of the world, with y up.
    assert!((first.center() - DVec3::new(1.0, 2.0, 3.0)).length() < 1e-12);
    assert!((first.rotation.transpose() * DVec3::Z - DVec3::NEG_Z).length() < 1e-12);
    assert!((first.rotation.transpose() * DVec3::Y - DVec3::NEG_Y).length() < 1e-12);
    assert_eq!((survey.images[0].name.as_str(), survey.cameras.len()), ("images/a.png", 2));
    // applied_scale is undone after applied_transform.
    let moved = small().replacen(
        '{',
        r#"{"applied_scale": 2, "applied_transform": [[0,-1,0,10],[1,0,0,0],[0,0,1,0]], "#,
        1,
    );
    let center = take(&moved).unwrap().survey.images[0].pose().center();
    let back = DMat3::from_cols(DVec3::Y, DVec3::NEG_X, DVec3::Z) * center + DVec3::new(10.0, 0.0, 0.0);
    assert!((2.0 * back - DVec3::new(1.0, 2.0, 3.0)).length() < 1e-12);
    // Intrinsics by frame, by angle, and by default.
    let angle = small().replace(
        "\"fl_x\": 50, \"fl_y\": 51, \"cx\": 32, \"cy\": 24",
        "\"camera_angle_x\": 1.5707963267948966",
    );
    let lens = take(&angle).unwrap().survey.cameras[0].lens;
    assert!((lens.focal[0] - 32.0).abs() < 1e-9 && lens.focal[0] == lens.focal[1]);
    assert_eq!(lens.principal, [32.0, 24.0]);
    let own =
        small().replace("\"file_path\": \"images/b.png\"", "\"file_path\": \"images/b.png\", \"fl_x\": 99");
    assert_eq!(take(&own).unwrap().survey.cameras[1].lens.focal, [99.0, 51.0]);
    // A lens with all its terms: k3 and k4 are polynomial.
    let bent = small().replace(
        "\"k1\": 0.1",
        "\"k1\": 0.1, \"k2\": 0.2, \"k3\": 0.3, \"k4\": 0.4, \"p1\": 0.01, \"p2\": 0.02",
    );
    let (x, y) = take(&bent).unwrap().survey.cameras[0].lens.project(0.5, 0.0);
    let radial = 1.0 + 0.1 * 0.25 + 0.2 * 0.0625 + 0.3 * 0.015625 + 0.4 * 0.00390625;
    assert!((x - (32.0 + 50.0 * (0.5 * radial + 0.02 * 0.75))).abs() < 1e-12, "{x}");
    assert!((y - (24.0 + 51.0 * 0.01 * 0.25)).abs() < 1e-12, "{y}");
    for fisheye in
        [small().replace("OPENCV", "OPENCV_FISHEYE"), small().replacen('{', "{\"is_fisheye\": true, ", 1)]
    {
        let camera = &take(&fisheye).unwrap().survey.cameras[0];
        let (theta, model) = (math::atan(0.5f64), camera.model.as_str());
        let x = 32.0 + 50.0 * theta * (1.0 + 0.1 * theta * theta);
        assert!((camera.lens.project(0.5, 0.0).0 - x).abs() < 1e-9 && model == "OPENCV_FISHEYE");
    }
}

#[test]
fn what_is_wrong_is_named() {
    for (from, to, expected) in [
        ("\"frames\"", "\"views\"", "`frames` is missing"),
        ("\"w\": 64, ", "", "`w` is missing"),
        ("\"w\": 64", "\"w\": 0", "`w` is 0"),
        ("\"w\": 64", "\"w\": 64.5", "whole number"),
        ("\"w\": 64", "\"w\": 1e30", "whole number"),
        ("\"h\": 48", "\"h\": 4000000000", "its size is 64x4000000000"),
        ("\"fl_x\": 50, \"fl_y\": 51, ", "", "fl_x"),
        ("\"fl_x\": 50", "\"fl_x\": -50", "above 0"),
        ("\"fl_x\": 50", "\"fl_x\": \"wide\"", "finite number"),
        ("\"k1\": 0.1", "\"k5\": 0.1", "`k5`"),
        ("OPENCV", "EQUIRECTANGULAR", "EQUIRECTANGULAR"),
        ("\"OPENCV\"", "7", "`camera_model` is 7"),
        ("OPENCV\"", "OPENCV_FISHEYE\", \"p1\": 0.1", "fisheye"),
        ("./images/a.png", "../images/a.png", "frame 0 (../images/a.png): `file_path`"),
        ("./images/a.png", "/images/a.png", "absolute"),
        ("./images/a.png", "images/b.png", "name occurs twice"),
        ("\"file_path\": \"images/b.png\", ", "", "frame 1: `file_path` is missing"),
        ("\"file_path\": \"images/b.png\"", "\"file_path\": 3", "expected a path"),
        ("[0,-1,0,4]", "[0,-1,0]", "frame 1 (images/b.png): `transform_matrix`"),
        ("[0,-1,0,4]", "[0,-1,0,null]", "finite numbers"),
        (
            "[[1,0,0,1],[0,1,0,2],[0,0,1,3],[0,0,0,1]]",
            "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[1,2,3,1]]",
            "frame 0 (./images/a.png): the last row of `transform_matrix` is [1.0, 2.0, 3.0, 1.0]; expected 0, 0, 0, 1",
        ),
        ("[0,-1,0,4]", "[0,1,0,4]", "mirrors the axes"),
        ("[0,-1,0,4]", "[0,-2,0,4]", "off orthonormal"),
        ("[0,-1,0,4]", "[0,-1,0,1e300]", "translation"),
        ("\"transform_matrix\": [[0", "\"matrix\": [[0", "`transform_matrix` is missing"),
        ("\"k1\": 0.1", "\"applied_scale\": 0", "`applied_scale` is 0"),
        ("\"k1\": 0.1", "\"applied_transform\": [[0,0,0,0],[0,0,0,0],[0,0,0,0]]", "`applied_transform`"),
        ("\"k1\": 0.1", "\"ply_file_path\": \"../x.ply\"", "`ply_file_path`"),
    ] {
        let text = small().replacen(from, to, 1);
        assert!(text != small(), "{from}");
        let said = complaint(&text);
        assert!(said.contains(expected), "{said} lacks {expected}");
    }
    for (text, expected) in [
        ("", "cut short"),
        ("[]", "expected an object"),
        ("{\"frames\": []}", "is empty"),
        ("{\"frames\": 3}", "no list"),
        ("{\"frames\": [3]}", "frame 0 is no object"),
    ] {
        let said = complaint(text);
        assert!(said.contains(expected), "{said} lacks {expected}");
    }
    assert!(complaint(&"[".repeat(100_000)).contains("damaged"));
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("transforms.json");
    assert!(read(&path, &|_| None).unwrap_err().to_string().contains("cannot be read"));
    std::fs::write(&path, small().replacen('{', "{\"train_filenames\": [\"images/a.png\"], ", 1)).unwrap();
    let mut found = read(&path, &|_| None).unwrap();
    assert!(found.survey.notes.join("").contains("train_list.txt"));
    let said = found.add_points(b"ply\n", Path::new("p.ply")).unwrap_err().to_string();
    assert!(said.contains("p.ply"), "{said}");
}

#[test]
fn lenses_without_a_field_are_not_written() {
    type Change = fn(&mut Lens);
    let cases: [(Change, &str); 6] = [
        (|l| l.skew = 0.1, "skew"),
        (|l| l.distortion.denominator[0] = 0.1, "beyond k4"),
        (|l| l.distortion.numerator[4] = 0.1, "beyond k4"),
        (|l| l.distortion.prism[1] = 0.1, "prism"),
        (|l| l.projection = use3d_survey::Projection::Equisolid, "projection"),
        (|l| l.projection = use3d_survey::Projection::Equidistant, "fisheye with tangential"),
    ];
    for (change, expected) in cases {
        let mut bad = survey();
        change(&mut bad.cameras[0].lens);
        let said = export(&bad, "").unwrap_err().to_string();
        assert!(said.contains("camera 1") && said.contains(expected), "{said}");
    }
}

#[test]
fn mutated_files_never_panic() {
    let seeds = [small(), export(&survey(), "images").unwrap().transforms];
    let mut read = 0;
    for round in 0..4000 {
        let bytes = mutated(seeds[round % 2].as_bytes(), b"0123456789-.e{}[]\",:", round as u64);
        read += usize::from(parse(&bytes, Path::new("mutated.json")).is_ok());
    }
    assert!(read > 100, "only {read} of the mutated files were read: the seeds are too brittle");
}
