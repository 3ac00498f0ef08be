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
        assert!(read(dir.path()).unwrap().model().world.is_none());
        let table = lengths(ENDS, &[1, 3, 6], shrink as f64, length);
        std::fs::write(dir.path().join("lengths.csv"), table).unwrap();
        let imported = read(dir.path()).unwrap();
        let world = imported.model().world.clone().unwrap();
        let off = world.metres_per_unit / METRES - 1.0;
        println!("photographs of {} pixels: off by {:.3} %", SIZE.0 / shrink, 100.0 * off);
        assert!(off.abs() < 0.005, "{off}");
        let said = imported.report.to_string();
        assert!(said.contains("1 unit of the model is 0.73") && said.contains("lengths.csv"), "{said}");
        // The table is part of the capture's content, and its metres stay with the prepared capture.
        assert!(imported.model_files().iter().any(|f| f == Path::new("lengths.csv")));
        let out = dir.path().join("out");
        prepare(&imported, &out, 1, &|_, _| true).unwrap();
        assert_eq!(load_prepared(&out).unwrap().model().world, Some(world.clone()));
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
    let world = imported.model().world.clone().unwrap();
    assert!((world.metres_per_unit / METRES - 1.0).abs() < 0.03, "{}", world.metres_per_unit);
    assert!(imported.report.to_string().contains("one standard error"), "{}", imported.report);
    // A gauge that moves by whole metres does not determine them, and nothing is claimed.
    std::fs::write(dir.path().join("depths.csv"), table(1.0, &true_depth)).unwrap();
    let imported = read(dir.path()).unwrap();
    assert!(imported.model().world.is_none());
    assert!(imported.report.to_string().contains("does not give the metres"), "{}", imported.report);
    // A measured length comes first, and the difference is said.
    std::fs::write(dir.path().join("depths.csv"), table(0.01, &true_depth)).unwrap();
    let length = 1.1 * METRES * (ENDS[0] - ENDS[1]).length();
    std::fs::write(dir.path().join("lengths.csv"), lengths(ENDS, &[0, 4], 8.0, length)).unwrap();
    let imported = read(dir.path()).unwrap();
    assert!(imported.model().world.as_ref().unwrap().source.contains("lengths.csv"));
    assert!(imported.report.to_string().contains("the latter is used"), "{}", imported.report);
}

#[test]
fn tables_that_are_wrong_say_the_line_and_what_is_expected() {
    let dir = tempfile::tempdir().unwrap();
    project(dir.path(), 8);
    let header = "length,metres,image,x1,y1,x2,y2\n";
    for (file, text, expected) in [
        ("lengths.csv", "length,metres,image,x1,y1,x2\n", "line 1: there is no column `y2`"),
        ("lengths.csv", &format!("{header}a,0,IMG_0001.png,1,2,3,4\n"), "line 2: `metres` is 0"),
        ("lengths.csv", &format!("{header}a,1,IMG_0099.png,1,2,3,4\n"), "dive/IMG_0000.png"),
        ("lengths.csv", &format!("{header}a,1,IMG_0001.png,1,2,3\n"), "`y2` is empty"),
        ("lengths.csv", &format!("{header}a,1,IMG_0001.png,1,2,3,NaN\n"), "`y2` is \"NaN\""),
        (
            "lengths.csv",
            &format!("{header}a,1,IMG_0001.png,1,2,3,4\n\na,2,IMG_0002.png,1,2,3,4\n"),
            "line 4: `metres` is 2, and 1",
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
    assert!(imported.model().world.is_none());
    assert!(imported.report.to_string().contains("two photographs at least"), "{}", imported.report);
}
