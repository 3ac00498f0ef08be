//! Metres from tables beside the photographs, on a project of known truth.

use std::fmt::Write;
use std::path::Path;

use glam::{DMat3, DVec3};
use use3d_capture::{FileName, Image, Pose};
use use3d_import::*;
use use3d_io_colmap::{LensModel, Model, ModelCamera, write_model_binary};
use use3d_io_image::write_png;
use use3d_survey::{Lens, PosedImage};

const METRES: f64 = 0.7312;
const SIZE: (usize, usize) = (1600, 1200);
const VIEWS: u32 = 8;

/// Cameras on a swim past the origin, at changing heights.
fn pose(i: u32) -> Pose {
    let t = f64::from(i);
    let centre = DVec3::new(0.5 * t - 1.7, 0.6 * f64::from(i % 3) - 0.5, -3.0 + 0.06 * (t - 3.5) * (t - 3.5));
    Pose::look_at(centre, DVec3::new(0.1 * t - 0.4, 0.0, 0.2), DVec3::NEG_Y)
}

fn lens() -> Lens {
    LensModel::OpenCv.lens(&[1300.0, 1310.0, 805.0, 597.0, -0.08, 0.02, 0.001, -0.002]).unwrap()
}

/// The pixel of a point in a view.
fn pixel(view: u32, point: DVec3) -> (f64, f64) {
    let pose = pose(view);
    let at = pose.rotation * point + pose.translation;
    lens().project(at.x / at.z, at.y / at.z)
}

/// A COLMAP capture whose photographs have `1 / shrink` of the size in the model.
fn project(dir: &Path, shrink: usize) {
    let parameters = vec![1300.0, 1310.0, 805.0, 597.0, -0.08, 0.02, 0.001, -0.002];
    let camera = ModelCamera { id: 1, model: LensModel::OpenCv, width: SIZE.0, height: SIZE.1, parameters };
    let name = |i: u32| FileName::new(&format!("dive/IMG_{i:04}.png")).unwrap();
    let images = (0..VIEWS).map(|i| PosedImage::at(i + 1, name(i), 1, &pose(i))).collect();
    let model = Model { cameras: vec![camera], images, points: Vec::new() };
    std::fs::create_dir_all(dir.join("sparse/0")).unwrap();
    write_model_binary(&dir.join("sparse/0"), &model).unwrap();
    let grey = Image::filled(SIZE.0 / shrink, SIZE.1 / shrink, 0.4);
    for i in 0..VIEWS {
        write_png(&dir.join("images").join(name(i).as_str()), &grey).unwrap();
    }
}

/// Rows of a table of lengths: both ends of a ruler, as whole pixels of the photographs.
fn lengths(ends: [DVec3; 2], views: &[u32], shrink: f64, metres: f64) -> String {
    let mut table = String::from("length,metres,image,x1,y1,x2,y2\n");
    for &view in views {
        let [(x1, y1), (x2, y2)] =
            ends.map(|end| pixel(view, end)).map(|(x, y)| ((x / shrink).round(), (y / shrink).round()));
        writeln!(table, "ruler,{metres},IMG_{view:04}.png,{x1},{y1},{x2},{y2}").unwrap();
    }
    table
}

const ENDS: [DVec3; 2] = [DVec3::new(-0.55, 0.1, 0.1), DVec3::new(0.6, -0.2, 0.3)];

fn read(dir: &Path) -> Result<Imported, ImportError> {
    import(dir, &ImportParams::default())
}

#[test]
fn two_points_marked_in_photographs_give_metres_to_half_a_percent() {
    let length = (ENDS[0] - ENDS[1]).length() * METRES;
    for shrink in [1, 2] {
        let dir = tempfile::tempdir().unwrap();
        project(dir.path(), shrink);
        assert!(read(dir.path()).unwrap().model.world.is_none());
        let table = lengths(ENDS, &[1, 3, 6], shrink as f64, length);
        std::fs::write(dir.path().join("lengths.csv"), table).unwrap();
        let imported = read(dir.path()).unwrap();
        let world = imported.model.world.clone().unwrap();
        let off = world.metres_per_unit / METRES - 1.0;
        println!("photographs of {} pixels: off by {:.3} %", SIZE.0 / shrink, 100.0 * off);
        assert!(off.abs() < 0.005, "{off}");
        let said = imported.report.to_string();
        assert!(said.contains("1 unit of the model is 0.73") && said.contains("lengths.csv"), "{said}");
        // The table is part of the capture's content, and its metres stay with the prepared capture.
        assert!(imported.model_files.iter().any(|f| f == Path::new("lengths.csv")));
        let out = dir.path().join("out");
        prepare(&imported, &out, 1, &|_, _| true).unwrap();
        assert_eq!(load_prepared(&out).unwrap().model.world, Some(world.clone()));
        assert_eq!(prepared_world(&out).unwrap(), Some(world));
    }
}

#[test]
fn positions_of_the_size_of_utm_survive_to_the_millimetre() {
    let dir = tempfile::tempdir().unwrap();
    project(dir.path(), 8);
    let turn = DMat3::from_axis_angle(DVec3::new(0.2, 0.9, -0.3).normalize(), 1.9);
    let truth = |i: u32| METRES * (turn * pose(i).center()) + DVec3::new(512_345.678, 4_256_836.521, -12.345);
    // Semicolons, other columns, and a photograph without a camera.
    let mut table = String::from("\u{feff}Image;time;X;Y;Z\n\nIMG_9999.png;0;1;2;3\n");
    for i in 0..VIEWS {
        let at = truth(i);
        writeln!(table, "IMG_{i:04};{i};{:.3};{:.3};{:.3}", at.x, at.y, at.z).unwrap();
    }
    std::fs::write(dir.path().join("positions.csv"), table).unwrap();
    let imported = read(dir.path()).unwrap();
    let said = imported.report.to_string();
    assert!(said.contains("8 positions in positions.csv") && said.contains("1 others"), "{said}");
    let out = dir.path().join("out");
    prepare(&imported, &out, 1, &|_, _| true).unwrap();
    let world = prepared_world(&out).unwrap().unwrap();
    for i in 0..VIEWS {
        let found = DVec3::from_array(world.apply(pose(i).center().to_array()));
        assert!((found - truth(i)).length() < 0.001, "{found} {}", truth(i));
    }
}

#[test]
fn a_log_of_depths_gives_metres_and_says_how_certain_they_are() {
    let dir = tempfile::tempdir().unwrap();
    project(dir.path(), 8);
    let down = DVec3::new(0.05, 0.99, 0.1).normalize();
    let table = |step: f64, depth: &dyn Fn(u32) -> f64| {
        let mut text = String::from("image,depth\n");
        for i in 0..VIEWS {
            writeln!(text, "dive/IMG_{i:04}.png,{}", (depth(i) / step).round() * step).unwrap();
        }
        text
    };
    let true_depth = |i: u32| METRES * down.dot(pose(i).center()) + 8.0;
    std::fs::write(dir.path().join("depths.csv"), table(0.01, &true_depth)).unwrap();
    let imported = read(dir.path()).unwrap();
    let world = imported.model.world.clone().unwrap();
    assert!((world.metres_per_unit / METRES - 1.0).abs() < 0.03, "{}", world.metres_per_unit);
    assert!(imported.report.to_string().contains("one standard error\n"), "{}", imported.report);
    // Rows of photographs without a camera are counted.
    let more = table(0.01, &true_depth) + "IMG_9998.png,8.1\nIMG_9999.png,8.2\n";
    std::fs::write(dir.path().join("depths.csv"), more).unwrap();
    let said = read(dir.path()).unwrap().report.to_string();
    assert!(said.contains("one standard error, 2 others have no camera"), "{said}");
    // A gauge that moves by whole metres does not determine them, and nothing is claimed.
    std::fs::write(dir.path().join("depths.csv"), table(1.0, &true_depth)).unwrap();
    let imported = read(dir.path()).unwrap();
    assert!(imported.model.world.is_none());
    assert!(imported.report.to_string().contains("does not give the metres"), "{}", imported.report);
    // A measured length comes first, and the difference is said.
    std::fs::write(dir.path().join("depths.csv"), table(0.01, &true_depth)).unwrap();
    let length = 1.1 * METRES * (ENDS[0] - ENDS[1]).length();
    std::fs::write(dir.path().join("lengths.csv"), lengths(ENDS, &[0, 4], 8.0, length)).unwrap();
    let imported = read(dir.path()).unwrap();
    assert!(imported.model.world.as_ref().unwrap().source.contains("lengths.csv"));
    assert!(imported.report.to_string().contains("the latter is used"), "{}", imported.report);
}

#[test]
fn tables_that_contradict_the_cameras_give_no_metres_and_name_the_photograph() {
    let dir = tempfile::tempdir().unwrap();
    project(dir.path(), 8);
    let refused = |file: &str, text: String, parts: &[&str]| {
        std::fs::write(dir.path().join(file), text).unwrap();
        let imported = read(dir.path()).unwrap();
        let said = imported.report.to_string();
        assert!(imported.model.world.is_none(), "{said}");
        assert!(parts.iter().all(|part| said.contains(part)), "{said}");
        std::fs::remove_file(dir.path().join(file)).unwrap();
    };
    let length = METRES * (ENDS[0] - ENDS[1]).length();
    // The ends are swapped in one photograph.
    let swapped = lengths([ENDS[1], ENDS[0]], &[3], 8.0, length);
    let swapped = lengths(ENDS, &[1, 6], 8.0, length) + swapped.split_once('\n').unwrap().1;
    refused("lengths.csv", swapped, &["lengths.csv does not give", "pixels away", "swapped"]);
    // One of two lengths is ten times too long.
    let other = lengths(ENDS, &[1, 3, 6], 8.0, 10.0 * length).replace("ruler", "frame");
    let both = lengths(ENDS, &[1, 3, 6], 8.0, length) + other.split_once('\n').unwrap().1;
    refused("lengths.csv", both, &["lengths disagree"]);
    // Many positions are wrong, or two axes are exchanged.
    let positions = |change: &dyn Fn(u32, DVec3) -> DVec3| {
        let mut table = String::from("image,x,y,z\n");
        for i in 0..VIEWS {
            let at = change(i, METRES * pose(i).center());
            writeln!(table, "IMG_{i:04},{},{},{}", at.x, at.y, at.z).unwrap();
        }
        table
    };
    let wrong = positions(&|i, at| at + if i > 4 { DVec3::X * f64::from(i) } else { DVec3::ZERO });
    refused("positions.csv", wrong, &["positions.csv does not give", "farthest off"]);
    let exchanged = positions(&|_, at| DVec3::new(at.y, at.x, at.z));
    refused("positions.csv", exchanged, &["mirror image", "exchanged"]);
    // One wrong position is left out and named.
    let one = positions(&|i, at| at + if i == 5 { DVec3::X * 5.0 } else { DVec3::ZERO });
    std::fs::write(dir.path().join("positions.csv"), one).unwrap();
    let imported = read(dir.path()).unwrap();
    assert!(imported.report.faults[0].contains("IMG_0005"), "{}", imported.report);
    let found = imported.model.world.unwrap().metres_per_unit;
    assert!((found / METRES - 1.0).abs() < 1e-6, "{found}");
    std::fs::remove_file(dir.path().join("positions.csv")).unwrap();
    // Tables that are not read are named.
    refused("Lengths.xlsx", "x".into(), &["Lengths.xlsx is not read", "called lengths.csv"]);
    refused("images/depths.csv", "image,depth\n".into(), &["depths.csv is not read", "capture's folder"]);
}

#[test]
fn negative_depths_are_metres_below_the_surface() {
    let dir = tempfile::tempdir().unwrap();
    project(dir.path(), 8);
    let down = DVec3::new(0.05, 0.99, 0.1).normalize();
    let mut table = String::from("image,depth\n");
    for i in 0..VIEWS {
        writeln!(table, "IMG_{i:04},{:.2}", -(METRES * down.dot(pose(i).center()) + 8.0)).unwrap();
    }
    std::fs::write(dir.path().join("depths.csv"), table).unwrap();
    let imported = read(dir.path()).unwrap();
    assert!(imported.report.to_string().contains("depths in depths.csv are negative"), "{}", imported.report);
    let world = imported.model.world.unwrap();
    let height = |i: u32| world.apply(pose(i).center().to_array())[2];
    assert!((0..VIEWS).all(|i| height(i) < 0.0), "the cameras are below the surface");
}

#[test]
fn tables_that_are_wrong_say_the_line_and_what_is_expected() {
    let dir = tempfile::tempdir().unwrap();
    project(dir.path(), 8);
    let header = "length,metres,image,x1,y1,x2,y2\n";
    for (file, text, expected) in [
        ("lengths.csv", "# reef\n\nlength,metres,image,x1,y1,x2\n", "line 3: there is no column `y2`"),
        ("lengths.csv", &format!("{header}a,0,IMG_0001.png,1,2,3,4\n"), "line 2: `metres` is 0"),
        ("lengths.csv", &format!("{header}a,1,IMG_0099.png,1,2,3,4\n"), "dive/IMG_0000.png"),
        ("lengths.csv", &format!("{header}a,1,IMG_0001.png,1,2,3\n"), "`y2` is empty"),
        ("lengths.csv", &format!("{header}a,1,IMG_0001.png,1,2,3,NaN\n"), "`y2` is \"NaN\""),
        (
            "lengths.csv",
            &format!("{header}a,1,IMG_0001.png,1,2,3,4\n\n,,,,,,\na,2,IMG_0002.png,1,2,3,4\n"),
            "line 5: `metres` is 2, and 1",
        ),
        ("positions.csv", "image,x,y,z\nIMG_0001.png,1,2,three\n", "`z` is \"three\""),
        ("depths.csv", "photo,depth\n", "no column `image`"),
        ("depths.csv", "", "no column `image`"),
    ] {
        let path = dir.path().join(file);
        std::fs::write(&path, text).unwrap();
        let said = read(dir.path()).unwrap_err().to_string();
        assert!(said.contains(file) && said.contains(expected), "{said} lacks {expected}");
        std::fs::remove_file(&path).unwrap();
    }
    // One photograph determines no place.
    std::fs::write(dir.path().join("lengths.csv"), format!("{header}a,1,IMG_0001.png,10,20,30,40\n"))
        .unwrap();
    let imported = read(dir.path()).unwrap();
    assert!(imported.model.world.is_none());
    assert!(imported.report.to_string().contains("two photographs at least"), "{}", imported.report);
}

/// A JPEG with the EXIF data of a GPS position.
fn photograph_at(latitude: f64, longitude: f64, altitude: Option<f64>) -> Vec<u8> {
    let ratio = |value: f64, under: u32| {
        [((value * f64::from(under)).round() as u32).to_be_bytes(), under.to_be_bytes()].concat()
    };
    let degrees = |value: f64| {
        let (whole, minutes) = (value.abs().floor(), value.abs().fract() * 60.0);
        [ratio(whole, 1), ratio(minutes.floor(), 1), ratio(minutes.fract() * 60.0, 1_000_000)].concat()
    };
    let entry = |tag: u16, kind: u16, count: u32, value: [u8; 4]| {
        [&tag.to_be_bytes()[..], &kind.to_be_bytes(), &count.to_be_bytes(), &value].concat()
    };
    let letter = |text: &[u8; 1]| [text[0], 0, 0, 0];
    // The first directory is at 8 with one entry, that of the position at 26 with five, its numbers at 92.
    let body = [
        b"MM\0*\0\0\0\x08\0\x01".to_vec(),
        entry(0x8825, 4, 1, 26u32.to_be_bytes()),
        vec![0; 4],
        vec![0, 5],
        entry(1, 2, 2, letter(if latitude < 0.0 { b"S" } else { b"N" })),
        entry(2, 5, 3, 92u32.to_be_bytes()),
        entry(3, 2, 2, letter(if longitude < 0.0 { b"W" } else { b"E" })),
        entry(4, 5, 3, 116u32.to_be_bytes()),
        // Without an altitude, the fifth entry has a tag that means nothing here.
        entry(if altitude.is_some() { 6 } else { 0x77 }, 5, 1, 140u32.to_be_bytes()),
        vec![0; 4],
        degrees(latitude),
        degrees(longitude),
        ratio(altitude.unwrap_or(0.0), 1000),
    ]
    .concat();
    let mut bytes = Vec::new();
    image::RgbImage::from_pixel(SIZE.0 as u32 / 8, SIZE.1 as u32 / 8, image::Rgb([90, 90, 90]))
        .write_to(&mut std::io::Cursor::new(&mut bytes), image::ImageFormat::Jpeg)
        .unwrap();
    let length = (body.len() as u16 + 8).to_be_bytes();
    let segment = [&b"\xFF\xE1"[..], &length, b"Exif\0\0", &body].concat();
    [&bytes[..2], &segment, &bytes[2..]].concat()
}

#[test]
fn gps_positions_in_photographs_give_metres_if_they_are_far_enough_apart() {
    // A degree of latitude is 110.9 km there, and one of longitude 104.3 km.
    let (latitude, longitude) = (20.3, -86.9);
    for (reach, expected) in [(60.0, Ok(())), (0.5, Err("they would be off by"))] {
        let dir = tempfile::tempdir().unwrap();
        project(dir.path(), 8);
        let turn = DMat3::from_axis_angle(DVec3::new(0.2, 0.9, -0.3).normalize(), 1.9);
        for i in 0..VIEWS {
            // Receivers are off by some metres.
            let off =
                DVec3::new(f64::from(i % 3) - 1.0, f64::from(i * 5 % 4) - 1.5, f64::from(i * 3 % 5) - 2.0);
            let at = reach * (turn * pose(i).center()) + off;
            // A position without an altitude is left out where others have one.
            let altitude = (i != 2).then_some(100.0 + at.z);
            let bytes = photograph_at(latitude + at.y / 110_711.0, longitude + at.x / 104_474.0, altitude);
            let path = dir.path().join(format!("images/dive/IMG_{i:04}"));
            std::fs::remove_file(path.with_extension("png")).unwrap();
            std::fs::write(path.with_extension("jpg"), bytes).unwrap();
        }
        let imported = read(dir.path()).unwrap();
        let said = imported.report.to_string();
        match expected {
            Ok(()) => {
                let world = imported.model.world.clone().unwrap();
                assert!((world.metres_per_unit / reach - 1.0).abs() < 0.03, "{world:?}");
                assert!(
                    said.contains("GPS positions of 7 photographs fit") && said.contains("latitude 20.3"),
                    "{said}"
                );
            }
            Err(expected) => assert!(imported.model.world.is_none() && said.contains(expected), "{said}"),
        }
        // Positions without altitudes do not count.
        for i in 0..VIEWS {
            let path = dir.path().join(format!("images/dive/IMG_{i:04}.jpg"));
            std::fs::write(path, photograph_at(latitude, longitude + f64::from(i) * 0.001, None)).unwrap();
        }
        let flat = read(dir.path()).unwrap();
        assert!(flat.model.world.is_none() && flat.report.to_string().contains("have no altitude"));
        // A measured length comes first.
        let length = (ENDS[0] - ENDS[1]).length() * METRES;
        std::fs::write(
            dir.path().join("lengths.csv"),
            lengths(ENDS, &[1, 3, 6], 8.0, length).replace(".png", ""),
        )
        .unwrap();
        let world = read(dir.path()).unwrap().model.world.clone().unwrap();
        assert!(
            (world.metres_per_unit / METRES - 1.0).abs() < 0.02 && world.source.contains("lengths"),
            "{world:?}"
        );
    }
}

#[test]
fn a_scale_bar_of_a_metashape_project_gives_metres_to_half_a_percent() {
    let dir = tempfile::tempdir().unwrap();
    let grey = Image::filled(SIZE.0 / 8, SIZE.1 / 8, 0.4);
    let (mut cameras, mut marks) = (String::new(), [String::new(), String::new()]);
    for i in 0..VIEWS {
        let p = pose(i);
        let (r, c) = (p.rotation.to_cols_array_2d(), p.center());
        let row = |k: usize| format!("{} {} {} {}", r[k][0], r[k][1], r[k][2], c[k]);
        let (a, b, d) = (row(0), row(1), row(2));
        write!(
            cameras,
            "<camera id=\"{i}\" sensor_id=\"0\" label=\"IMG_{i}\"><transform>{a} {b} {d} 0 0 0 1</transform></camera>"
        )
        .unwrap();
        write_png(&dir.path().join(format!("photos/IMG_{i}.png")), &grey).unwrap();
        // Marks are set to whole pixels.
        for (mark, end) in marks.iter_mut().zip(ENDS) {
            let (x, y) = pixel(i, end);
            write!(
                mark,
                "<location camera_id=\"{i}\" pinned=\"true\" x=\"{}\" y=\"{}\"/>",
                x.round(),
                y.round()
            )
            .unwrap();
        }
    }
    // Metashape's f is fy, b1 is fx - fy, the principal point counts from the middle, p1 and p2 change
    // places.
    let sensor = "<sensor id=\"0\" type=\"frame\"><resolution width=\"1600\" height=\"1200\"/><calibration type=\"frame\" \
                  class=\"adjusted\"><resolution width=\"1600\" height=\"1200\"/><f>1310</f><cx>5</cx><cy>-3</cy><b1>-10</b1>\
                  <k1>-0.08</k1><k2>0.02</k2><p1>-0.002</p1><p2>0.001</p2></calibration></sensor>";
    let length = (ENDS[0] - ENDS[1]).length() * METRES;
    let [one, two] = marks;
    let xml = format!(
        "<document version=\"2.0.0\"><chunk><sensors>{sensor}</sensors><cameras>{cameras}</cameras><markers><marker id=\"0\" \
         label=\"target 1\"/><marker id=\"1\" label=\"target 2\"/></markers><scalebars><scalebar id=\"0\" label=\"bar\">\
         <endpoint marker_id=\"0\"/><endpoint marker_id=\"1\"/><reference distance=\"{length}\" enabled=\"true\"/></scalebar>\
         </scalebars><frames><frame id=\"0\"><markers><marker marker_id=\"0\">{one}</marker><marker marker_id=\"1\">{two}</marker>\
         </markers></frame></frames></chunk></document>"
    );
    std::fs::write(dir.path().join("cameras.xml"), xml).unwrap();
    let imported = read(dir.path()).unwrap();
    let world = imported.model.world.clone().unwrap();
    let off = world.metres_per_unit / METRES - 1.0;
    println!("off by {:.3} %", 100.0 * off);
    assert!(off.abs() < 0.005 && world.source == "Metashape scale bars", "{world:?}");
    let out = dir.path().join("out");
    prepare(&imported, &out, 1, &|_, _| true).unwrap();
    assert_eq!(prepared_world(&out).unwrap(), Some(world));
}

#[test]
fn mutated_tables_never_panic() {
    let dir = tempfile::tempdir().unwrap();
    project(dir.path(), 8);
    let mut positions = String::from("image,x,y,z\n");
    let mut depths = String::from("image,depth\n");
    for i in 0..VIEWS {
        let at = METRES * pose(i).center();
        writeln!(positions, "IMG_{i:04}.png,{},{},{}", at.x, at.y, at.z).unwrap();
        writeln!(depths, "IMG_{i:04}.png,{}", 10.0 + at.y).unwrap();
    }
    let rulers = lengths([DVec3::ZERO, DVec3::X], &[1, 2, 3], 8.0, METRES);
    for (name, table) in [("positions.csv", positions), ("depths.csv", depths), ("lengths.csv", rulers)] {
        let path = dir.path().join(name);
        let (mut read_ones, rounds) = (0, 150);
        for round in 0..rounds {
            std::fs::write(&path, use3d_golden::mutated(table.as_bytes(), b",;\n\"-.e0", round)).unwrap();
            if let Ok(imported) = read(dir.path()) {
                read_ones += 1;
                let unit = imported.model.world.as_ref().map_or(1.0, |world| world.metres_per_unit);
                assert!(unit.is_finite() && unit > 0.0, "{name}, round {round}: {unit}");
            }
        }
        assert!(read_ones > 0 && read_ones < rounds, "{name}: {read_ones} of {rounds} are read");
        std::fs::remove_file(path).unwrap();
    }
}
