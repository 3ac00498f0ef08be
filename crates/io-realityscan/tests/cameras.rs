//! The table and the XMP files against formulas that are written down here a second time, faults by name, and
//! files that mean harm.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use glam::{DMat3, DVec3};
use use3d_capture::{FileName, Pose};
use use3d_golden::mutated;
use use3d_io_realityscan::*;
use use3d_numerics::math;
use use3d_survey::{ReadError, Survey, SurveyPoint, ply};

const TABLE: &str = "reef/cameras.csv";
const FOLDER: &str = "reef/images";
const HEADER: &str = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2";

fn name(text: &str) -> FileName {
    FileName::new(text).unwrap()
}

fn table(text: &str) -> Result<Registration, ReadError> {
    parse_table(text.as_bytes(), Path::new(TABLE))
}

/// An XMP file as RealityScan writes it, with changes.
fn xmp(pose: &Pose, changes: &[(&str, &str)]) -> String {
    let r = pose.rotation.transpose().to_cols_array().map(|v| v.to_string()).join(" ");
    let c = pose.center().to_array().map(|v| v.to_string()).join(" ");
    let mut text = format!(
        r#"<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
        <rdf:Description xcr:Version="3" xcr:PosePrior="initial" xcr:Coordinates="absolute" xcr:DistortionModel="brown4t2"
        xcr:FocalLength35mm="27" xcr:Skew="0" xcr:AspectRatio="1" xcr:PrincipalPointU="0.01" xcr:PrincipalPointV="-0.02"
        xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#"><xcr:Rotation>{r}</xcr:Rotation><xcr:Position>{c}</xcr:Position>
        <xcr:DistortionCoeficients>-0.1 0.05 -0.02 0.01 0.003 -0.002</xcr:DistortionCoeficients></rdf:Description></rdf:RDF></x:xmpmeta>"#
    );
    for (from, to) in changes {
        assert!(text.contains(from), "{from}");
        text = text.replace(from, to);
    }
    text
}

fn sidecars(texts: &[String]) -> Vec<Sidecar> {
    let sidecar = |(i, text): (usize, &String)| Sidecar {
        name: name(&format!("IMG_{i}")),
        path: PathBuf::from(format!("{FOLDER}/IMG_{i}.xmp")),
        bytes: text.clone().into_bytes(),
    };
    texts.iter().enumerate().map(sidecar).collect()
}

fn scan(texts: &[String]) -> Result<Registration, ReadError> {
    parse_sidecars(&sidecars(texts), Path::new(FOLDER))
}

fn sizes(registration: &Registration, size: (usize, usize)) -> BTreeMap<FileName, (usize, usize)> {
    registration.shots.iter().map(|shot| (shot.name.clone(), size)).collect()
}

fn survey(registration: Registration) -> Survey {
    let sizes = sizes(&registration, (480, 360));
    registration.into_survey(&sizes, Path::new(TABLE)).unwrap()
}

/// The pixel of a point in a camera with a lens of 27 mm that looks along `forward` with `down` below,
/// computed by hand.
fn manual(right: DVec3, down: DVec3, forward: DVec3, centre: DVec3, point: DVec3) -> (f64, f64) {
    let local = point - centre;
    let (u, v) = (local.dot(right) / local.dot(forward), local.dot(down) / local.dot(forward));
    let r2 = u * u + v * v;
    let radial = 1.0 - 0.1 * r2 + 0.05 * r2 * r2 - 0.02 * r2 * r2 * r2 + 0.01 * r2 * r2 * r2 * r2;
    let (t1, t2) = (0.003, -0.002);
    let x = u * radial + t1 * (r2 + 2.0 * u * u) + 2.0 * t2 * u * v;
    let y = v * radial + t2 * (r2 + 2.0 * v * v) + 2.0 * t1 * u * v;
    let f = 27.0 / 36.0 * 480.0;
    (240.0 + 0.01 * 480.0 + f * x, 180.0 - 0.02 * 480.0 + f * y)
}

#[test]
fn heading_pitch_and_roll_turn_the_camera_as_they_should() {
    // Heading, pitch and roll, and then the directions of right, down and forward: x is east, y north, z up.
    let cases = [
        ([0.0, 0.0, 0.0], [DVec3::X, DVec3::NEG_Y, DVec3::NEG_Z]),
        ([0.0, 90.0, 0.0], [DVec3::X, DVec3::NEG_Z, DVec3::Y]),
        ([90.0, 90.0, 0.0], [DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X]),
        ([180.0, 90.0, 0.0], [DVec3::NEG_X, DVec3::NEG_Z, DVec3::NEG_Y]),
        // It hangs to the right side: its right is down.
        ([0.0, 0.0, 90.0], [DVec3::NEG_Z, DVec3::NEG_Y, DVec3::NEG_X]),
    ];
    for ([heading, pitch, roll], [right, down, forward]) in cases {
        let row =
            format!("a.jpg,1,2,3,{heading},{pitch},{roll},27,0.01,-0.02,-0.1,0.05,-0.02,0.01,0.003,-0.002");
        let survey = survey(table(&format!("{HEADER}\n{row}\n")).unwrap());
        for i in 0..6 {
            let i = f64::from(i);
            let centre = DVec3::new(1.0, 2.0, 3.0);
            let point = centre + 4.0 * forward + (0.3 * i - 1.0) * right + (0.8 - 0.3 * i) * down;
            let (x, y) = survey.project(&survey.images[0], point.to_array()).unwrap();
            let (u, v) = manual(right, down, forward, centre, point);
            assert!(math::hypot(x - u, y - v) < 1e-9, "{heading} {pitch} {roll}: {x} {y}, {u} {v}");
        }
    }
}

#[test]
fn xmp_files_and_the_table_describe_one_scene_by_the_same_cameras() {
    let (mut text, mut files) = (String::from("#cameras 5\n") + HEADER + "\n", Vec::new());
    for i in 0..5 {
        let (heading, pitch, roll) = (70.0 * f64::from(i), 80.0 - 11.0 * f64::from(i), 9.0 * f64::from(i));
        text += &format!(
            "\"C:\\dive\\IMG_{i}.jpg\",{i},{},5.5,{heading},{pitch},{roll},27,1e-002,-2E-2,-0.1,0.05,-0.02,0.01,0.003,-0.002\n",
            0.5 * f64::from(i)
        );
    }
    let by_table = table(&text).unwrap();
    for shot in &by_table.shots {
        files.push(xmp(&shot.pose, &[]));
    }
    assert_eq!(by_table.shots[3].name, "dive/IMG_3.jpg");
    let (by_table, by_xmp) = (survey(by_table), survey(scan(&files).unwrap()));
    assert_eq!((by_table.cameras.len(), by_xmp.cameras.len()), (1, 1), "one lens, one camera");
    assert_eq!(by_table.cameras[0].model, "brown4t2");
    assert_eq!(by_xmp.images[3].name, "IMG_3");
    for (a, b) in by_table.images.iter().zip(&by_xmp.images) {
        let point = a.pose().center() + a.pose().rotation.transpose() * DVec3::new(0.4, -0.3, 2.0);
        let (one, other) = (by_table.project(a, point.to_array()), by_xmp.project(b, point.to_array()));
        let ((x, y), (u, v)) = (one.unwrap(), other.unwrap());
        assert!(math::hypot(x - u, y - v) < 1e-9);
    }
    // The newer version renamed columns; other tables separate by semicolons.
    let renamed = text.replace("heading", "yaw").replace("f,px,py", "f_35mm,px_norm,py_norm");
    let other = renamed.replace(',', ";").replace("#cameras 5\n", "\u{feff}\n");
    for other in [renamed, other] {
        assert_eq!(survey(table(&other).unwrap()).images, by_table.images);
    }
}

#[test]
fn photographs_of_other_sizes_have_other_cameras_and_missing_ones_are_kept_by_name() {
    let text = format!("{HEADER}\na.jpg,0,0,0,0,0,0,36\nb.jpg,1,0,0,0,0,0,36\nc.jpg,2,0,0,0,0,0,36\n");
    // Columns that a line lacks are an error only if the header has them.
    let said = table(&text).unwrap_err().to_string();
    assert!(said.contains("line 2") && said.contains("`px` is \"\""), "{said}");
    let text = text.replace(",px,py,k1,k2,k3,k4,t1,t2", "");
    let registration = table(&text).unwrap();
    let sizes = BTreeMap::from([(name("a.jpg"), (400, 300)), (name("b.jpg"), (300, 400))]);
    let survey = registration.clone().into_survey(&sizes, Path::new(TABLE)).unwrap();
    assert_eq!(survey.images.len(), 3, "the import names the one that is missing");
    assert_eq!(survey.cameras.len(), 2);
    assert_eq!(
        (survey.cameras[1].lens.focal, survey.cameras[1].lens.principal),
        ([400.0; 2], [150.0, 200.0])
    );
    assert_eq!(survey.cameras[0].model, "perspective");
    let said = registration.into_survey(&BTreeMap::new(), Path::new(TABLE)).unwrap_err().to_string();
    assert!(said.contains("none of its 3 photographs (a.jpg, …)"), "{said}");
}

#[test]
fn points_must_lie_before_the_cameras() {
    let mut survey = survey(table(&format!("{HEADER}\na.jpg,0,0,5,0,0,0,27,0,0,0,0,0,0,0,0\n")).unwrap());
    let file = |up: f64| {
        let point = |i: i32| SurveyPoint {
            id: 1,
            position: [0.1 * f64::from(i), 0.0, up],
            color: [1, 2, 3],
            error: -1.0,
            track: vec![],
        };
        ply::write(&(0..9).map(point).collect::<Vec<_>>())
    };
    add_points(&mut survey, file(1.0).as_bytes(), Path::new("reef/points.ply")).unwrap();
    assert_eq!(survey.points.len(), 9);
    let said =
        add_points(&mut survey, file(9.0).as_bytes(), Path::new("reef/points.ply")).unwrap_err().to_string();
    assert!(said.contains("reef/points.ply") && said.contains("Grid plane"), "{said}");
}

#[test]
fn faults_of_tables_are_named() {
    let row = "a.jpg,1,2,3,10,20,30,27,0,0,0,0,0,0,0,0";
    let good = format!("{HEADER}\n{row}\n");
    for (from, to, expected) in [
        ("heading,", "", "no column `heading`"),
        (",f,", ",focal,", "no column `f`"),
        ("a.jpg,1,2", "a.jpg,1;2", "line 2"),
        ("1,2,3", "1,NaN,3", "`y` is \"NaN\""),
        ("30,27", "30,0", "`f` is 0"),
        ("30,27", "30,-27", "`f` is -27"),
        ("a.jpg,1", ",1", "line 2: `name` is \"\""),
        ("27,0,0,0,0,0,0,0,0", "27,0,0,0,0,0,0,0,x", "`t2` is \"x\""),
    ] {
        let text = good.replacen(from, to, 1);
        assert_ne!(text, good, "{from}");
        let said = table(&text).unwrap_err().to_string();
        assert!(said.contains(TABLE) && said.contains(expected), "{to}: {said}");
    }
    assert!(table("").unwrap_err().to_string().contains("empty"));
    assert!(table(HEADER).unwrap_err().to_string().contains("no cameras"));
    let at = |x: f64, y: f64, z: f64| format!("p{z}.jpg,{x},{y},{z},10,20,30,27,0,0,0,0,0,0,0,0\n");
    let degrees = [at(5.9, 43.1, 2.0), at(5.900_02, 43.100_04, 3.0), at(5.900_05, 43.100_01, 4.5)].concat();
    let said = table(&format!("{HEADER}\n{degrees}")).unwrap_err().to_string();
    assert!(said.contains("longitudes") && said.contains("Grid plane"), "{said}");
    let metres = [at(5.9, 43.1, 2.0), at(5.9, 43.1, 3.0), at(6.1, 43.2, 9.5)].concat();
    assert!(table(&format!("{HEADER}\n{metres}")).is_ok(), "a swim straight up");
    let twice = table(&format!("{good}{row}\n")).unwrap();
    let known = sizes(&twice, (480, 360));
    let said = twice.into_survey(&known, Path::new(TABLE)).unwrap_err().to_string();
    assert!(said.contains("its name occurs twice"), "{said}");
}

#[test]
fn faults_of_xmp_files_are_named() {
    let pose = Pose::from_center(DMat3::IDENTITY, DVec3::new(1.0, 2.0, 3.0));
    let rotation = "<xcr:Rotation>1 0 0 0 1 0 0 0 1</xcr:Rotation>";
    for (from, to, expected) in [
        ("xcr:Version=\"3\"", "xcr:Version=\"7\"", "xcr:Version: it is 7"),
        ("\"brown4t2\"", "\"division\"", "xcr:DistortionModel: it is \"division\""),
        ("\"brown4t2\"", "\"rationalP2D1\"", "choose Brown3"),
        ("xcr:Skew=\"0\"", "xcr:Skew=\"0.1\"", "xcr:Skew: it is 0.1"),
        ("xcr:AspectRatio=\"1\"", "xcr:AspectRatio=\"0\"", "xcr:AspectRatio"),
        ("Length35mm=\"27\"", "Length35mm=\"0\"", "xcr:FocalLength35mm: it is 0"),
        ("Length35mm=\"27\"", "Length35mm=\"wide\"", "one finite number"),
        ("0.003 -0.002<", "0.003<", "6 finite numbers"),
        ("1 0 0 0 1 0 0 0 1", "2 0 0 0 2 0 0 0 2", "off orthonormal"),
        ("1 0 0 0 1 0 0 0 1", "1 0 0 0 1 0 0 0 -1", "mirrored"),
        ("1 0 0 0 1 0 0 0 1", "1 0 0 0 1 0 0 0", "9 finite numbers"),
        (">1 2 3<", ">1 2 inf<", "xcr:Position"),
        ("\"absolute\"", "\"rigid\"", "without rigs"),
        (rotation, "", "none of 1 XMP files has a pose"),
        ("</x:xmpmeta>", "", "damaged or cut short"),
        ("http://www.capturingreality.com/ns/xcr/1.1#", "urn:other", "none of 1 XMP files has a pose"),
    ] {
        let said = scan(&[xmp(&pose, &[(from, to)])]).unwrap_err().to_string();
        assert!(said.contains(FOLDER) && said.contains(expected), "{to}: {said}");
    }
    // A mixture of coordinates has no common frame; files without a pose are only counted.
    let other = xmp(&pose, &[("\"absolute\"", "\"relative\"")]);
    let said = scan(&[xmp(&pose, &[]), other.clone()]).unwrap_err().to_string();
    assert!(said.contains("1 absolute, 1 relative"), "{said}");
    let part = |id: &str| xmp(&pose, &[("xcr:Skew", &format!("xcr:ComponentId=\"{id}\" xcr:Skew"))]);
    let found = scan(&[xmp(&pose, &[(rotation, "")]), part("a"), part("b"), part("b")]).unwrap();
    assert_eq!((found.shots.len(), found.shots[0].name.as_str()), (2, "IMG_2"));
    assert!(found.notes.iter().any(|n| n.starts_with("1 XMP files have no pose")), "{:?}", found.notes);
    assert!(found.notes.iter().any(|n| n.starts_with("1 cameras belong to another")), "{:?}", found.notes);
    // Values may also be attributes.
    let inline =
        other.replace(rotation, "").replace("xcr:Skew", "xcr:Rotation=\"1 0 0 0 1 0 0 0 1\" xcr:Skew");
    assert_eq!(scan(&[inline]).unwrap().shots[0].pose, pose);
}

#[test]
fn mutated_files_never_panic() {
    let pose = Pose::from_center(DMat3::IDENTITY, DVec3::new(1.0, 2.0, 3.0));
    let rows = "a.jpg,1,2,3,10,20,30,27,0,0,0.1,0,0,0,0,0\nb.jpg,2,2,3,10,20,30,27,0,0,0.1,0,0,0,0,0\n";
    let seeds = [format!("{HEADER}\n{rows}").into_bytes(), xmp(&pose, &[]).into_bytes()];
    let mut read = [0, 0];
    for round in 0..20_000 {
        let bytes = mutated(&seeds[round % 2], b"0123456789.-e,;<>\"\n", round as u64);
        let found = match round % 2 {
            0 => parse_table(&bytes, Path::new(TABLE)),
            _ => {
                let sidecar = Sidecar { name: name("a"), path: PathBuf::from("a.xmp"), bytes };
                parse_sidecars(&[sidecar], Path::new(FOLDER))
            }
        };
        if let Ok(found) = found {
            let known = sizes(&found, (480, 360));
            if let Ok(survey) = found.into_survey(&known, Path::new(TABLE)) {
                survey.check(Path::new(TABLE), "").unwrap();
                read[round % 2] += 1;
            }
        }
    }
    assert!(read.iter().all(|n| *n > 300), "{read:?}: the seeds are too brittle");
}
