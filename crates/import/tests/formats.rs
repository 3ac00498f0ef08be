//! Captures of other programs, through the whole import: dots of known places are painted into photographs of
//! bent lenses and must come out where the pinholes see them.

use std::path::Path;

use glam::{DMat3, DVec3};
use use3d_capture::{Camera, FileName, Image, Map, Pose};
use use3d_import::*;
use use3d_io_image::{write_png, write_png_map};
use use3d_numerics::math;
use use3d_survey::{
    Distortion, ImageFiles, Lens, PosedImage, Projection, Survey, SurveyCamera, SurveyPoint, ply,
};

const SIZE: (usize, usize) = (480, 360);
const VIEWS: u32 = 4;

fn pose(i: u32) -> Pose {
    let i = f64::from(i);
    let turn = DMat3::from_axis_angle(DVec3::new(0.2, 1.0, 0.1).normalize(), 0.05 * i - 0.1);
    Pose::from_center(turn, DVec3::new(0.3 * i - 0.5, 0.05 * i, -3.0))
}

/// Dots on a slightly curved floor, far enough apart for one blob each.
fn dots() -> Vec<DVec3> {
    let grid = (-2..=2).flat_map(|row| (-3..=3).map(move |column| (f64::from(row), f64::from(column))));
    grid.map(|(row, column)| DVec3::new(0.31 * column, 0.3 * row, 0.04 * (row * column))).collect()
}

/// A photograph with a soft dot of two pixels' radius around each place.
fn photograph(places: &[(f64, f64)]) -> Image {
    let mut image = Image::filled(SIZE.0, SIZE.1, 0.1);
    for &(u, v) in places {
        for y in (v as i64 - 12).max(0)..(v as i64 + 13).min(SIZE.1 as i64) {
            for x in (u as i64 - 12).max(0)..(u as i64 + 13).min(SIZE.0 as i64) {
                let (dx, dy) = (x as f64 + 0.5 - u, y as f64 + 0.5 - v);
                let light = 0.1 + 0.8 * math::exp(-(dx * dx + dy * dy) / 8.0) as f32;
                let old = image.pixel(x as usize, y as usize)[0];
                image.set_pixel(x as usize, y as usize, [old.max(light); 3]);
            }
        }
    }
    image
}

/// The centre of the light around a place; `None` too near the border.
fn found(image: &Image, x: f64, y: f64) -> Option<(f64, f64)> {
    let (cx, cy) = (x as i64, y as i64);
    let reach = 9;
    if cx < reach || cy < reach || cx + reach >= image.width() as i64 || cy + reach >= image.height() as i64 {
        return None;
    }
    let (mut sum, mut sx, mut sy) = (0.0, 0.0, 0.0);
    for row in cy - reach..=cy + reach {
        for column in cx - reach..=cx + reach {
            let light = f64::from(image.pixel(column as usize, row as usize)[1]) - 0.1;
            let light = if light > 0.02 { light } else { 0.0 };
            sum += light;
            sx += light * (column as f64 + 0.5);
            sy += light * (row as f64 + 0.5);
        }
    }
    (sum > 1.0).then(|| (sx / sum, sy / sum))
}

/// Prepares a capture and compares every dot with the place where its pinhole sees it.
fn hold_to_a_tenth_of_a_pixel(imported: &Imported, out: &Path) -> Imported {
    assert!(imported.needs_preparation());
    prepare(imported, out, 1, &|_, _| true).unwrap();
    let prepared = load_prepared(out).unwrap();
    let (mut worst, mut compared) = (0.0f64, 0);
    for view in &prepared.capture.views {
        let image = load_pixels(view).unwrap().to_image();
        let Camera { intrinsics, .. } = view.camera;
        assert_eq!((image.width(), image.height()), (intrinsics.width, intrinsics.height));
        for dot in dots() {
            let Some((place, _)) = view.camera.project(prepared.capture.frame.apply(dot)) else { continue };
            let Some((x, y)) = found(&image, place.x, place.y) else { continue };
            worst = worst.max(math::hypot(x - place.x, y - place.y));
            compared += 1;
        }
    }
    assert!(compared > 80 && worst < 0.1, "{compared} dots, off by up to {worst} px");
    prepared
}

/// Metashape's formulas, written down here a second time.
fn metashape_pixel(pose: &Pose, dot: DVec3, fisheye: bool) -> (f64, f64) {
    let local = pose.rotation * dot + pose.translation;
    let (mut x, mut y) = (local.x / local.z, local.y / local.z);
    if fisheye {
        let r = math::hypot(x, y);
        let theta = math::atan(r);
        if r > 0.0 {
            (x, y) = (x / r * theta, y / r * theta);
        }
    }
    let r2 = x * x + y * y;
    let radial = 1.0 - 0.12 * r2 + 0.05 * r2 * r2 - 0.02 * r2 * r2 * r2 + 0.01 * r2 * r2 * r2 * r2;
    let (p1, p2) = (0.004, -0.003);
    let xd = x * radial + p1 * (r2 + 2.0 * x * x) + 2.0 * p2 * x * y;
    let yd = y * radial + p2 * (r2 + 2.0 * y * y) + 2.0 * p1 * x * y;
    (240.0 + 5.5 + xd * 400.0 + xd * 3.0 + yd * -2.5, 180.0 - 4.25 + yd * 400.0)
}

/// A Metashape export: two sensors, groups, labels without extension, points in the world's metres.
fn metashape(dir: &Path) {
    let sensor = |id: u32, kind: &str| {
        format!(
            "<sensor id=\"{id}\" label=\"housing\" type=\"{kind}\"><resolution width=\"480\" height=\"360\"/>\
             <calibration type=\"{kind}\" class=\"initial\"><resolution width=\"480\" height=\"360\"/><f>300</f></calibration>\
             <calibration type=\"{kind}\" class=\"adjusted\"><resolution width=\"480\" height=\"360\"/><f>400</f><cx>5.5</cx>\
             <cy>-4.25</cy><b1>3</b1><b2>-2.5</b2><k1>-0.12</k1><k2>0.05</k2><k3>-0.02</k3><k4>0.01</k4><p1>0.004</p1>\
             <p2>-0.003</p2></calibration></sensor>"
        )
    };
    let mut cameras = String::new();
    for i in 0..VIEWS {
        let p = pose(i);
        let (r, c) = (p.rotation.to_cols_array_2d(), p.center());
        let row = |k: usize| format!("{} {} {} {}", r[k][0], r[k][1], r[k][2], c[k]);
        let (a, b, d) = (row(0), row(1), row(2));
        cameras += &format!(
            "<group label=\"dive {i}\"><camera id=\"{i}\" sensor_id=\"{}\" component_id=\"0\" label=\"GOPR{i}\"><transform>{a} {b} {d} \
             0 0 0 1</transform></camera></group>",
            i % 2
        );
        let places: Vec<_> = dots().iter().map(|dot| metashape_pixel(&p, *dot, i % 2 == 1)).collect();
        write_png(&dir.join(format!("photos/GOPR{i}.png")), &photograph(&places)).unwrap();
    }
    cameras += "<camera id=\"90\" sensor_id=\"0\" label=\"GOPR90\"/>";
    let xml = format!(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?><document version=\"2.0.0\"><chunk label=\"reef\" enabled=\"true\"><sensors>{}{}</sensors>\
         <components><component id=\"0\"><transform><rotation>0 -1 0 1 0 0 0 0 1</rotation><translation>-2499366.4 -4256836.5 4029217.9</translation>\
         <scale>2.5</scale></transform></component></components><cameras>{cameras}</cameras></chunk></document>",
        sensor(0, "frame"),
        sensor(1, "equidistant_fisheye")
    );
    std::fs::write(dir.join("cameras.xml"), xml).unwrap();
    let points = dots().into_iter().map(|d| SurveyPoint {
        id: 1,
        position: [-2499366.4 - 2.5 * d.y, -4256836.5 + 2.5 * d.x, 4029217.9 + 2.5 * d.z],
        color: [1, 2, 3],
        error: -1.0,
        track: vec![],
    });
    std::fs::write(dir.join("points.ply"), ply::write(&points.collect::<Vec<_>>())).unwrap();
}

#[test]
fn dots_come_out_of_a_metashape_export_where_they_are_and_in_metres() {
    let dir = tempfile::tempdir().unwrap();
    metashape(dir.path());
    check_layout(dir.path()).unwrap();
    let imported = import(dir.path(), &ImportParams::default()).unwrap();
    let report = &imported.report;
    assert_eq!((report.model.as_str(), report.image_folder.as_str()), ("cameras.xml", "photos"));
    assert_eq!((report.views, report.points, report.missing.len()), (4, 35, 0));
    assert_eq!(imported.model_files, [Path::new("cameras.xml"), Path::new("points.ply")]);
    let said = report.to_string();
    for expected in [
        "Agisoft XML",
        "GOPR90",
        "1 unit of the model is 2.500000 m",
        "equidistant_fisheye",
        "unit of the model",
    ] {
        assert!(said.contains(expected), "{said} lacks {expected}");
    }
    // The points came back from the earth's frame.
    for (point, dot) in imported.model.points.iter().zip(dots()) {
        assert!((DVec3::from_array(point.position) - dot).length() < 1e-8);
    }
    let prepared = hold_to_a_tenth_of_a_pixel(&imported, &dir.path().join("out"));
    assert_eq!(prepared.model.world, imported.model.world);
    assert_eq!(prepared.model.world.as_ref().unwrap().metres_per_unit, 2.5);
    assert_eq!(prepared.capture.views[2].name, "GOPR2.png");
    // The cameras alone, for drawing, are the same.
    let cameras = read_cameras(dir.path()).unwrap();
    assert_eq!((cameras.len(), cameras[0].1.intrinsics), (4, imported.capture.views[0].camera.intrinsics));
    // The model may be named.
    let params = ImportParams { model_dir: Some("cameras.xml".into()), ..ImportParams::default() };
    assert_eq!(import(dir.path(), &params).unwrap().capture.views, imported.capture.views);
}

#[test]
fn a_metashape_export_that_lacks_something_says_what() {
    let dir = tempfile::tempdir().unwrap();
    metashape(dir.path());
    let run = || import(dir.path(), &ImportParams::default());
    std::fs::remove_file(dir.path().join("photos/GOPR2.png")).unwrap();
    assert_eq!(run().unwrap().report.missing, ["GOPR2"]);
    std::fs::remove_file(dir.path().join("points.ply")).unwrap();
    assert!(run().unwrap().report.to_string().contains("no points: export the tie points"));
    for name in ["dense.ply", "mesh.ply"] {
        std::fs::write(dir.path().join(name), "ply\n").unwrap();
    }
    assert!(run().unwrap().report.to_string().contains("dense.ply, mesh.ply"));
    std::fs::create_dir(dir.path().join("again")).unwrap();
    std::fs::copy(dir.path().join("photos/GOPR1.png"), dir.path().join("again/GOPR1.png")).unwrap();
    // The folder with more of the photographs is taken, so that one copy harms nobody.
    assert_eq!(run().unwrap().report.image_folder, "photos");
    std::fs::remove_dir_all(dir.path().join("photos")).unwrap();
    std::fs::remove_dir_all(dir.path().join("again")).unwrap();
    let said = run().unwrap_err().to_string();
    assert!(said.contains("GOPR0") && said.contains("image_dir"), "{said}");
    let xml = std::fs::read_to_string(dir.path().join("cameras.xml")).unwrap();
    std::fs::write(dir.path().join("cameras.xml"), xml.replace("<scale>2.5", "<scale>0")).unwrap();
    let said = run().unwrap_err().to_string();
    assert!(said.contains("cameras.xml") && said.contains("Reference > Update"), "{said}");
    std::fs::remove_file(dir.path().join("cameras.xml")).unwrap();
    std::fs::write(dir.path().join("project.psx"), "").unwrap();
    assert!(run().unwrap_err().to_string().contains("Export Cameras, format Agisoft XML"));
}

/// A nerfstudio folder: a plain and a fisheye camera, a mask, points.
fn nerfstudio(dir: &Path) {
    let camera = |id, projection, numerator, tangential| SurveyCamera {
        id,
        model: String::new(),
        label: None,
        width: SIZE.0,
        height: SIZE.1,
        lens: Lens {
            projection,
            distortion: Distortion { numerator, tangential, ..Distortion::default() },
            ..Lens::pinhole([400.0, 405.0], [245.5, 175.75])
        },
    };
    let mut survey = Survey {
        cameras: vec![
            camera(1, Projection::Perspective, [-0.15, 0.05, 0.0, 0.0, 0.0, 0.0], [0.004, -0.003]),
            camera(2, Projection::Equidistant, [-0.05, 0.01, -0.004, 0.0, 0.0, 0.0], [0.0; 2]),
        ],
        points: (0u64..)
            .zip(dots())
            .map(|(i, dot)| SurveyPoint {
                id: i + 1,
                position: dot.to_array(),
                color: [7; 3],
                error: -1.0,
                track: vec![],
            })
            .collect(),
        ..Survey::default()
    };
    for i in 0..VIEWS {
        let name = format!("dive/f{i}.png");
        survey.images.push(PosedImage::at(i + 1, FileName::new(&name).unwrap(), 1 + i % 2, &pose(i)));
        let image = survey.images.last().unwrap();
        let places: Vec<_> =
            dots().iter().map(|dot| survey.project(image, dot.to_array()).unwrap()).collect();
        write_png(&dir.join("images").join(&name), &photograph(&places)).unwrap();
    }
    let files = ImageFiles {
        mask: Some(FileName::new("people/f0.png").unwrap()),
        depth: Some(FileName::new("d.png").unwrap()),
    };
    survey.files.insert(1, files);
    let mut mask = Map::new(SIZE.0, SIZE.1);
    mask.data_mut().iter_mut().for_each(|v| *v = 1.0);
    write_png_map(&dir.join("people/f0.png"), &mask).unwrap();
    let written = use3d_io_nerfstudio::export(&survey, "images").unwrap();
    std::fs::write(dir.join("transforms.json"), written.transforms).unwrap();
    std::fs::write(dir.join("sparse_pc.ply"), written.points.unwrap()).unwrap();
}

#[test]
fn dots_come_out_of_a_nerfstudio_folder_where_they_are() {
    let dir = tempfile::tempdir().unwrap();
    nerfstudio(dir.path());
    let imported = import(dir.path(), &ImportParams::default()).unwrap();
    let report = &imported.report;
    assert_eq!((report.model.as_str(), report.image_folder.as_str()), ("transforms.json", "images/dive"));
    assert_eq!((report.views, report.points, report.masks), (4, 35, 1));
    let files: Vec<&Path> = ["transforms.json", "sparse_pc.ply", "people/f0.png"].map(Path::new).to_vec();
    assert_eq!(imported.model_files, files);
    assert!(report.to_string().contains("depth_file_path are not used"));
    let prepared = hold_to_a_tenth_of_a_pixel(&imported, &dir.path().join("out"));
    assert!(load_mask(&prepared.capture.views[0]).unwrap().is_some());
    assert_eq!(prepared.capture.views[0].name, "f0.png");
    std::fs::remove_file(dir.path().join("sparse_pc.ply")).unwrap();
    let said = import(dir.path(), &ImportParams::default()).unwrap().report.to_string();
    assert!(said.contains("sparse_pc.ply is not there"), "{said}");
}

#[test]
fn a_folder_with_two_formats_is_read_as_colmaps() {
    let dir = tempfile::tempdir().unwrap();
    nerfstudio(dir.path());
    let imported = import(dir.path(), &ImportParams::default()).unwrap();
    let out = dir.path().join("out");
    prepare(&imported, &out, 1, &|_, _| true).unwrap();
    // The prepared folder without its manifest is a COLMAP capture; a transforms.json beside it changes
    // nothing.
    std::fs::remove_file(out.join("capture.json")).unwrap();
    std::fs::copy(dir.path().join("transforms.json"), out.join("transforms.json")).unwrap();
    let report = import(&out, &ImportParams::default()).unwrap().report;
    assert_eq!(
        (report.model.as_str(), report.other_models),
        ("sparse/0", vec!["transforms.json (nerfstudio)".into()])
    );
}

/// A project of WebODM: the reconstruction in `opensfm/`, the photographs beside it.
fn webodm(dir: &Path) {
    let lens = Lens {
        distortion: Distortion { numerator: [-0.1, 0.03, 0.0, 0.0, 0.0, 0.0], ..Distortion::default() },
        ..Lens::pinhole([400.0, 400.0], [240.0, 180.0])
    };
    let (mut shots, mut tracks) = (Vec::new(), String::from("OPENSFM_TRACKS_VERSION_v2\n"));
    for i in 0..VIEWS {
        let p = pose(i);
        let (axis, angle) = glam::DQuat::from_mat3(&p.rotation).to_axis_angle();
        let (r, t) = ((axis * angle).to_array(), p.translation.to_array());
        shots.push(format!(
            r#""f{i}.png": {{"camera": "v2 gopro", "rotation": {r:?}, "translation": {t:?}, "gps_dop": 5.0}}"#
        ));
        let places: Vec<(f64, f64)> = dots()
            .iter()
            .map(|dot| p.rotation * *dot + p.translation)
            .map(|at| lens.project(at.x / at.z, at.y / at.z))
            .collect();
        for (track, (x, y)) in places.iter().enumerate() {
            let (x, y) = ((x - 240.0) / 480.0, (y - 180.0) / 480.0);
            tracks += &format!("f{i}.png\t{track}\t{track}\t{x}\t{y}\t0.001\t9\t9\t9\t-1\t-1\n");
        }
        write_png(&dir.join(format!("images/f{i}.png")), &photograph(&places)).unwrap();
    }
    let points = dots().into_iter().enumerate().map(|(i, dot)| {
        format!(r#""{i}": {{"color": [9.0, 9.0, 9.0], "coordinates": {:?}}}"#, dot.to_array())
    });
    let points = points.collect::<Vec<_>>().join(", ");
    let text = format!(
        r#"[{{"cameras": {{"v2 gopro": {{"projection_type": "perspective", "width": 480, "height": 360,
        "focal": {}, "k1": -0.1, "k2": 0.03}}}}, "shots": {{{}}}, "points": {{{points}}},
        "reference_lla": {{"latitude": 12.1, "longitude": -68.9, "altitude": 0.0}}}}]"#,
        400.0 / 480.0,
        shots.join(", ")
    );
    std::fs::create_dir(dir.join("opensfm")).unwrap();
    std::fs::write(dir.join("opensfm/reconstruction.json"), text).unwrap();
    std::fs::write(dir.join("opensfm/tracks.csv"), tracks).unwrap();
}

#[test]
fn dots_come_out_of_a_webodm_project_where_they_are_with_their_tracks() {
    let dir = tempfile::tempdir().unwrap();
    webodm(dir.path());
    let imported = import(dir.path(), &ImportParams::default()).unwrap();
    let report = &imported.report;
    assert_eq!(
        (report.model.as_str(), report.image_folder.as_str()),
        ("opensfm/reconstruction.json", "images")
    );
    assert_eq!((report.views, report.points, report.missing.len()), (4, 35, 0));
    let files = ["opensfm/reconstruction.json", "opensfm/tracks.csv"].map(Path::new);
    assert_eq!(imported.model_files, files);
    assert!(report.to_string().contains("metres east, north and up of latitude 12.1"), "{report}");
    assert!(imported.tracks().iter().all(|track| track.sightings.len() == VIEWS as usize));
    let prepared = hold_to_a_tenth_of_a_pixel(&imported, &dir.path().join("out"));
    for track in prepared.tracks() {
        for seen in track.sightings {
            let (place, _) = prepared.capture.views[seen.view].camera.project(track.position).unwrap();
            assert!(math::hypot(place.x - seen.x, place.y - seen.y) < 1e-6);
        }
    }
    // The file may be named, and results without the reconstruction are told from it.
    let params = ImportParams { model_dir: Some("opensfm".into()), ..ImportParams::default() };
    assert_eq!(import(dir.path(), &params).unwrap().capture.views, imported.capture.views);
    std::fs::remove_dir_all(dir.path().join("opensfm")).unwrap();
    for name in ["cameras.json", "images.json"] {
        std::fs::write(dir.path().join(name), "{}").unwrap();
    }
    let said = import(dir.path(), &ImportParams::default()).unwrap_err().to_string();
    assert!(said.contains("opensfm/tracks.csv"), "{said}");
}

/// RealityScan's formulas, written down here a second time: `t1` goes with `r² + 2 u²`.
fn realityscan_pixel(pose: &Pose, dot: DVec3) -> (f64, f64) {
    let at = pose.rotation * dot + pose.translation;
    let (u, v) = (at.x / at.z, at.y / at.z);
    let r2 = u * u + v * v;
    let radial = 1.0 - 0.12 * r2 + 0.05 * r2 * r2;
    let x = u * radial + 0.004 * (r2 + 2.0 * u * u) - 2.0 * 0.003 * u * v;
    let y = v * radial - 0.003 * (r2 + 2.0 * v * v) + 2.0 * 0.004 * u * v;
    (240.0 + 0.0125 * 480.0 + 400.0 * x, 180.0 - 0.01 * 480.0 + 400.0 * y)
}

/// A RealityScan export with its points: the table, or XMP files beside the photographs.
fn realityscan(dir: &Path, xmp: bool) {
    let mut table = String::from("#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n");
    for i in 0..VIEWS {
        let p = pose(i);
        let places: Vec<_> = dots().iter().map(|dot| realityscan_pixel(&p, *dot)).collect();
        write_png(&dir.join(format!("images/dive/IMG_{i}.png")), &photograph(&places)).unwrap();
        let (c, [right, down, ahead]) = (p.center(), p.rotation.transpose().to_cols_array_2d());
        // The axes with y up and z backward are Rz(-heading) Rx(pitch) Ry(roll).
        let pitch = math::atan2(-down[2], math::hypot(right[2], ahead[2]));
        let angles = [-math::atan2(down[0], -down[1]), pitch, math::atan2(-right[2], -ahead[2])];
        let [heading, pitch, roll] = angles.map(f64::to_degrees);
        table += &format!(
            "IMG_{i}.png,{},{},{},{heading},{pitch},{roll},30,0.0125,-0.01,-0.12,0.05,0,0,0.004,-0.003\n",
            c.x, c.y, c.z
        );
        let rows = p.rotation.transpose().to_cols_array().map(|v| v.to_string()).join(" ");
        let text = format!(
            "<x:xmpmeta xmlns:x=\"adobe:ns:meta/\"><rdf:RDF xmlns:rdf=\"http://www.w3.org/1999/02/22-rdf-syntax-ns#\">\
             <rdf:Description xmlns:xcr=\"http://www.capturingreality.com/ns/xcr/1.1#\" xcr:Version=\"3\" \
             xcr:Coordinates=\"absolute\" xcr:DistortionModel=\"brown3t2\" xcr:FocalLength35mm=\"30\" \
             xcr:PrincipalPointU=\"0.0125\" xcr:PrincipalPointV=\"-0.01\"><xcr:Rotation>{rows}</xcr:Rotation>\
             <xcr:Position>{} {} {}</xcr:Position><xcr:DistortionCoeficients>-0.12 0.05 0 0 0.004 -0.003\
             </xcr:DistortionCoeficients></rdf:Description></rdf:RDF></x:xmpmeta>",
            c.x, c.y, c.z
        );
        if xmp {
            std::fs::write(dir.join(format!("images/dive/IMG_{i}.xmp")), text).unwrap();
        }
    }
    if !xmp {
        std::fs::write(dir.join("reef.csv"), table).unwrap();
    }
    let point = |d: DVec3| SurveyPoint {
        id: 1,
        position: d.to_array(),
        color: [1, 2, 3],
        error: -1.0,
        track: vec![],
    };
    std::fs::write(dir.join("points.ply"), ply::write(&dots().into_iter().map(point).collect::<Vec<_>>()))
        .unwrap();
}

#[test]
fn dots_come_out_of_a_realityscan_export_where_they_are() {
    for xmp in [false, true] {
        let dir = tempfile::tempdir().unwrap();
        realityscan(dir.path(), xmp);
        check_layout(dir.path()).unwrap();
        let imported = import(dir.path(), &ImportParams::default()).unwrap();
        let report = &imported.report;
        let model = if xmp { "images" } else { "reef.csv" };
        assert_eq!((report.model.as_str(), report.image_folder.as_str()), (model, "images"));
        assert_eq!((report.views, report.points, report.missing.len()), (4, 35, 0), "{report}");
        let first = if xmp { "images/dive/IMG_0.xmp" } else { "reef.csv" };
        assert_eq!(imported.model_files[0], Path::new(first));
        assert_eq!(imported.model_files.last().unwrap(), Path::new("points.ply"));
        assert!(report.to_string().contains("brown3t2"), "{report}");
        let prepared = hold_to_a_tenth_of_a_pixel(&imported, &dir.path().join("out"));
        assert_eq!(prepared.capture.views[1].name, "dive/IMG_1.png");
        let params = ImportParams { model_dir: Some(model.into()), ..ImportParams::default() };
        assert_eq!(import(dir.path(), &params).unwrap().capture.views, imported.capture.views);
        // A photograph that is missing is named, and none at all is an error.
        std::fs::remove_file(dir.path().join("images/dive/IMG_2.png")).unwrap();
        let missing = import(dir.path(), &ImportParams::default()).unwrap().report.missing;
        assert_eq!(missing, [if xmp { "dive/IMG_2" } else { "IMG_2.png" }]);
        for i in [0, 1, 3] {
            std::fs::remove_file(dir.path().join(format!("images/dive/IMG_{i}.png"))).unwrap();
        }
        let said = import(dir.path(), &ImportParams::default()).unwrap_err().to_string();
        assert!(said.contains("none of its 4 photographs") && said.contains(model), "{said}");
    }
}

#[test]
fn files_whose_names_are_not_accepted_are_named_with_their_folder() {
    let refused = |dir: &Path, from: &str, to: &str| {
        std::fs::create_dir_all(dir.join(to).parent().unwrap()).unwrap();
        std::fs::rename(dir.join(from), dir.join(to)).unwrap();
        let said = import(dir, &ImportParams::default()).unwrap_err().to_string();
        for part in [dir.join(to).display().to_string().as_str(), "shorten it, and export the cameras again"]
        {
            assert!(said.contains(part), "{said} lacks {part}");
        }
    };
    // File systems take names that are longer than those of images may be.
    let (long, deep) = ("x".repeat(251), vec!["x".repeat(200); 5].join("/"));
    let dir = tempfile::tempdir().unwrap();
    realityscan(dir.path(), true);
    refused(dir.path(), "images/dive/IMG_1.xmp", &format!("images/dive/{long}.xmp"));
    let dir = tempfile::tempdir().unwrap();
    metashape(dir.path());
    refused(dir.path(), "photos/GOPR1.png", &format!("photos/{deep}/GOPR1.png"));
}
