//! Exports written here with known truth, one small file per pitfall, and files that mean harm.

use std::fmt::Write;
use std::path::Path;

use glam::{DMat3, DVec3};
use use3d_golden::mutated;
use use3d_io_metashape::{add_points, is_cameras_file, parse, read};
use use3d_numerics::math;
use use3d_survey::{EarthPlace, ReadError, Survey, World, ply};

/// A lens in Metashape's terms.
#[derive(Clone, Copy, Default)]
struct Brown {
    f: f64,
    cx: f64,
    cy: f64,
    b: [f64; 2],
    k: [f64; 4],
    p: [f64; 4],
    fisheye: Fisheye,
}

#[derive(Clone, Copy, Default, PartialEq)]
enum Fisheye {
    #[default]
    No,
    Equidistant,
    Equisolid,
}

const SIZE: (f64, f64) = (1000.0, 700.0);

/// The pixel of a point by the manual's formulas, written down a second time on purpose.
fn manual(lens: &Brown, to_world: &DMat3, center: DVec3, point: DVec3) -> (f64, f64) {
    let local = DVec3::new(
        to_world.x_axis.dot(point - center),
        to_world.y_axis.dot(point - center),
        to_world.z_axis.dot(point - center),
    );
    let (mut x, mut y) = (local.x / local.z, local.y / local.z);
    let r0 = (x * x + y * y).sqrt();
    let theta = math::atan2(math::hypot(local.x, local.y), local.z);
    let bent = match lens.fisheye {
        Fisheye::No => r0,
        Fisheye::Equidistant => theta,
        Fisheye::Equisolid => 2.0 * math::sin(theta / 2.0),
    };
    if r0 > 0.0 {
        (x, y) = (x / r0 * bent, y / r0 * bent);
    }
    let r = (x * x + y * y).sqrt();
    let [k1, k2, k3, k4] = lens.k;
    let [p1, p2, p3, p4] = lens.p;
    let power = |n| math::powi(r, n);
    let radial = 1.0 + k1 * power(2) + k2 * power(4) + k3 * power(6) + k4 * power(8);
    let growth = 1.0 + p3 * power(2) + p4 * power(4);
    let xd = x * radial + (p1 * (power(2) + 2.0 * x * x) + 2.0 * p2 * x * y) * growth;
    let yd = y * radial + (p2 * (power(2) + 2.0 * y * y) + 2.0 * p1 * x * y) * growth;
    let u = SIZE.0 * 0.5 + lens.cx + xd * lens.f + xd * lens.b[0] + yd * lens.b[1];
    let v = SIZE.1 * 0.5 + lens.cy + yd * lens.f;
    (u, v)
}

fn calibration(lens: &Brown, class: &str) -> String {
    let kind = match lens.fisheye {
        Fisheye::No => "frame",
        Fisheye::Equidistant => "equidistant_fisheye",
        Fisheye::Equisolid => "equisolid_fisheye",
    };
    let Brown { f, cx, cy, b: [b1, b2], k: [k1, k2, k3, k4], p: [p1, p2, p3, p4], .. } = lens;
    let mut out = format!(
        "<calibration type=\"{kind}\" class=\"{class}\"><resolution width=\"{}\" height=\"{}\"/><f>{f}</f>",
        SIZE.0, SIZE.1
    );
    // Metashape leaves out what is 0.
    let named = [
        ("cx", cx),
        ("cy", cy),
        ("b1", b1),
        ("b2", b2),
        ("k1", k1),
        ("k2", k2),
        ("k3", k3),
        ("k4", k4),
        ("p1", p1),
        ("p2", p2),
        ("p3", p3),
        ("p4", p4),
    ];
    for (name, value) in named {
        if *value != 0.0 {
            write!(out, "<{name}>{value}</{name}>").unwrap();
        }
    }
    out + "</calibration>"
}

fn sensor(id: u32, calibrations: &str) -> String {
    format!(
        "<sensor id=\"{id}\" label=\"housing {id}\" type=\"frame\"><resolution width=\"{}\" height=\"{}\"/>\
         <property name=\"layer_index\" value=\"0\"/><bands><band label=\"Red\"/></bands>{calibrations}\
         <covariance><params>f</params><coeffs>3.99e+000</coeffs></covariance></sensor>",
        SIZE.0, SIZE.1
    )
}

fn transform(to_world: &DMat3, center: DVec3) -> String {
    let r = to_world.transpose().to_cols_array_2d();
    let row = |i: usize, c: f64| format!("{} {} {} {}", r[i][0], r[i][1], r[i][2], c);
    let rows = [row(0, center.x), row(1, center.y), row(2, center.z)];
    format!("<transform>{} 0 0 0 1</transform>", rows.join(" "))
}

/// Camera `i` of a swim along x that looks at the bottom.
fn at(i: u32) -> (DMat3, DVec3) {
    let i = f64::from(i);
    let turn = DMat3::from_axis_angle(DVec3::new(1.0, 0.2 * i, 0.3).normalize(), 2.8 + 0.05 * i);
    (turn, DVec3::new(0.4 * i, 0.1 * (i % 3.0), 2.0))
}

fn camera(i: u32, sensor: u32, label: &str, more: &str) -> String {
    let (to_world, center) = at(i);
    format!(
        "<camera id=\"{i}\" sensor_id=\"{sensor}\" label=\"{label}\"{more}>{}<orientation>1</orientation></camera>",
        transform(&to_world, center)
    )
}

fn document(sensors: &str, cameras: &str, rest: &str) -> String {
    format!(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<document version=\"2.0.0\"><chunk label=\"Chunk 1\" enabled=\"true\">\
         <sensors next_id=\"9\">{sensors}</sensors><cameras next_id=\"99\" next_group_id=\"2\">{cameras}</cameras>{rest}</chunk></document>"
    )
}

const PLAIN: Brown =
    Brown { f: 800.0, cx: 0.0, cy: 0.0, b: [0.0; 2], k: [0.0; 4], p: [0.0; 4], fisheye: Fisheye::No };

fn simple(cameras: &str, rest: &str) -> String {
    document(&sensor(0, &calibration(&PLAIN, "adjusted")), cameras, rest)
}

fn take(text: &str) -> Result<Survey, ReadError> {
    parse(text.as_bytes(), Path::new("dive/cameras.xml"))
}

fn complaint(text: &str) -> String {
    let said = take(text).unwrap_err().to_string();
    assert!(said.contains("dive/cameras.xml"), "{said}");
    said
}

fn world_point(k: u32) -> DVec3 {
    let k = f64::from(k);
    DVec3::new(0.11 * k - 0.8, math::sin(3.0 * k) * 0.5, 0.2 * math::cos(5.0 * k))
}

/// Compares every camera with the manual's formulas, over points in front of it.
fn agree(survey: &Survey, lenses: &[Brown]) -> usize {
    let mut compared = 0;
    for image in &survey.images {
        let (to_world, center) = at(image.id);
        for k in 0..20 {
            let point = world_point(k);
            let Some((x, y)) = survey.project(image, point.to_array()) else { continue };
            let (u, v) = manual(&lenses[image.camera as usize], &to_world, center, point);
            assert!(math::hypot(x - u, y - v) < 1e-6, "camera {}: {x} {y}, truth {u} {v}", image.id);
            compared += 1;
        }
    }
    compared
}

fn lenses() -> [Brown; 3] {
    let brown = Brown {
        f: 812.5,
        cx: 11.7,
        cy: -27.75,
        b: [0.53, -3.1],
        k: [-0.092, -0.076, 0.116, -0.076],
        p: [-0.0031, 0.0016, 0.2, -0.1],
        fisheye: Fisheye::No,
    };
    let equidistant =
        Brown { f: 480.0, p: [0.001, -0.002, 0.0, 0.0], fisheye: Fisheye::Equidistant, ..brown };
    [brown, equidistant, Brown { f: 500.0, fisheye: Fisheye::Equisolid, ..equidistant }]
}

#[test]
fn a_project_of_known_truth_agrees_to_a_millionth_of_a_pixel() {
    let lenses = lenses();
    // The initial calibration comes first in some files, and is another one.
    let sensors: String = lenses
        .iter()
        .enumerate()
        .map(|(i, lens)| {
            let initial = calibration(&Brown { f: 700.0, ..PLAIN }, "initial");
            sensor(i as u32, &(initial + &calibration(lens, "adjusted")))
        })
        .collect();
    let cameras: String = (0..12).map(|i| camera(i, i % 3, &format!("IMG_{i:04}"), "")).collect();
    let survey = take(&document(&sensors, &cameras, "")).unwrap();
    assert_eq!((survey.cameras.len(), survey.images.len()), (3, 12));
    assert_eq!(survey.cameras[2].model, "equisolid_fisheye");
    assert_eq!(survey.cameras[1].label.as_deref(), Some("housing 1"));
    assert!(agree(&survey, &lenses) > 150);
    assert_eq!((survey.world, survey.notes.len()), (None, 0));
}

#[test]
fn calibrations_of_photoscan_before_1_2_have_their_own_terms() {
    let old = "<calibration type=\"frame\"><resolution width=\"1000\" height=\"700\"/><fx>800</fx><fy>810</fy>\
        <cx>503</cx><cy>347</cy><skew>2</skew><k1>-0.1</k1><p1>0.003</p1><p2>-0.002</p2></calibration>";
    let text = document(&sensor(0, old), &camera(0, 0, "a.jpg", ""), "").replace("2.0.0", "1.1.0");
    let lens = take(&text).unwrap().cameras[0].lens;
    let (u, v): (f64, f64) = (0.3, -0.2);
    let (r2, (p1, p2)) = (0.13, (0.003, -0.002));
    let x = u * (1.0 - 0.1 * r2) + p2 * (r2 + 2.0 * u * u) + 2.0 * p1 * u * v;
    let y = v * (1.0 - 0.1 * r2) + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * u * v;
    let (px, py) = lens.project(u, v);
    assert!((px - (503.0 + 800.0 * x + 2.0 * y)).abs() < 1e-9 && (py - (347.0 + 810.0 * y)).abs() < 1e-9);
}

#[test]
fn the_initial_calibration_counts_only_where_it_is_fixed() {
    let initial = calibration(&Brown { f: 700.0, ..PLAIN }, "initial");
    let text = document(&sensor(0, &initial), &camera(0, 0, "a", ""), "");
    let said = complaint(&text);
    assert!(said.contains("housing 0") && said.contains("initial") && said.contains("Align"), "{said}");
    let fixed = format!("<property name=\"fixed\" value=\"true\"/>{initial}");
    let survey = take(&document(&sensor(0, &fixed), &camera(0, 0, "a", ""), "")).unwrap();
    assert_eq!(survey.cameras[0].lens.focal, [700.0; 2]);
}

#[test]
fn calibrations_that_are_not_understood_are_refused() {
    for (from, to, expected) in [
        ("type=\"frame\" class", "type=\"spherical\" class", "perspective images"),
        ("<f>800</f>", "", "no focal length"),
        ("<f>800</f>", "<f>-800</f>", "above 0"),
        ("<f>800</f>", "<f>wide</f>", "finite numbers"),
        ("<f>800</f>", "<f>nan</f>", "finite numbers"),
        ("<f>800</f>", "<f>800</f><k7>0.5</k7>", "<k7> is not known"),
        ("width=\"1000\"", "width=\"0\"", "0x700"),
        ("width=\"1000\"", "width=\"99999999999999999999\"", "expected a number"),
    ] {
        let text = simple(&camera(0, 0, "a", ""), "").replace(from, to);
        let said = complaint(&text);
        assert!(said.contains(expected), "{said} lacks {expected}");
    }
    // An unused sensor harms nobody.
    let sensors = sensor(0, &calibration(&PLAIN, "adjusted")) + &sensor(1, "");
    assert_eq!(take(&document(&sensors, &camera(0, 0, "a", ""), "")).unwrap().cameras.len(), 1);
    let said = complaint(&simple(&camera(0, 4, "a", ""), ""));
    assert!(said.contains("sensor 4"), "{said}");
}

#[test]
fn the_enabled_chunk_with_the_most_cameras_is_read() {
    let chunk = |label: &str, enabled: &str, n: u32| {
        let cameras: String = (0..n).map(|i| camera(i, 0, &format!("{label}{i}"), "")).collect();
        let whole = simple(&cameras, "");
        let (a, b) = (whole.find("<chunk").unwrap(), whole.find("</document>").unwrap());
        whole[a..b].replace("Chunk 1", label).replace("enabled=\"true\"", &format!("enabled=\"{enabled}\""))
    };
    let chunks = [chunk("east", "1", 2), chunk("old", "0", 5), chunk("west", "true", 3)].concat();
    let survey = take(&format!("<document version=\"1.5.0\">{chunks}</document>")).unwrap();
    assert_eq!(survey.images[2].name, "west2");
    let notes = survey.notes.join("; ");
    assert!(notes.contains("chunk east is not used (2") && notes.contains("chunk old"), "{notes}");
}

#[test]
fn the_component_with_the_most_cameras_is_read_and_its_transform_gives_metres() {
    let component = |id: u32, scale: f64, ids: &str| {
        format!(
            "<component id=\"{id}\"><transform><rotation locked=\"true\">0 -1 0 1 0 0 0 0 1</rotation>\
             <translation locked=\"true\">{id}00 0 0</translation><scale locked=\"true\">{scale}</scale></transform>\
             <partition><camera_ids>{ids}</camera_ids></partition></component>"
        )
    };
    let components = component(3, 2.0, "") + &component(5, 12.5, "1 2 3");
    let rest = format!("<components next_id=\"6\" active_id=\"3\">{components}</components>");
    // Two by their attribute, three by the component's list.
    let cameras: String = (0..5)
        .map(|i| camera(i, 0, &format!("c{i}"), if i == 0 || i == 4 { " component_id=\"3\"" } else { "" }))
        .collect();
    let survey = take(&simple(&cameras, &rest)).unwrap();
    assert_eq!(survey.images.iter().map(|i| i.id).collect::<Vec<_>>(), [1, 2, 3]);
    assert!(survey.notes.join("; ").contains("2 cameras belong to other components"));
    let world = survey.world.unwrap();
    assert_eq!((world.metres_per_unit, world.source.as_str()), (12.5, "Metashape chunk transform"));
    // The translation is not divided by the scale.
    let there = world.apply([1.0, 2.0, 3.0]);
    assert!(there.iter().zip([500.0 - 25.0, 12.5, 37.5]).all(|(a, b)| (a - b).abs() < 1e-9), "{there:?}");
}

#[test]
fn the_world_is_read_in_every_spelling() {
    let cameras = camera(0, 0, "a", "");
    let local = |unit: &str| {
        format!(
            "<reference>LOCAL_CS[\"Local\",LOCAL_DATUM[\"x\",0],UNIT[{unit},AUTHORITY[\"EPSG\",\"9001\"]]]</reference>"
        )
    };
    let scaled = "<transform><rotation>1 0 0 0 1 0 0 0 1</rotation><translation>1 2 3</translation><scale>4</scale></transform>";
    let matrix = "<transform>0 -4 0 1 4 0 0 2 0 0 4 3 0 0 0 1</transform>";
    let earth = "<reference>GEOGCS[\"WGS 84\",UNIT[\"degree\",0.0174532925199433]]</reference>";
    for (rest, metres, at) in [
        (scaled.to_string(), 4.0, [1.0, 2.0, 3.0]),
        (format!("{scaled}{}", local("\"metre\",1")), 4.0, [1.0, 2.0, 3.0]),
        (format!("{scaled}{}", local("\"millimetre\",0.001")), 0.004, [0.001, 0.002, 0.003]),
        (format!("{matrix}{}", local("\"metre\",1")), 4.0, [1.0, 2.0, 3.0]),
        (format!("{scaled}{earth}"), 4.0, [1.0, 2.0, 3.0]),
    ] {
        let world = take(&simple(&cameras, &rest)).unwrap().world.unwrap();
        assert!((world.metres_per_unit - metres).abs() < 1e-12, "{rest}");
        let origin = world.apply([0.0; 3]);
        assert!(origin.iter().zip(at).all(|(a, b)| (a - b).abs() < 1e-12), "{rest}: {origin:?}");
    }
    // Without a transform, or with one that has no scale, the unit is unknown.
    for rest in [local("\"metre\",1"), "<transform><rotation>1 0 0 0 1 0 0 0 1</rotation></transform>".into()]
    {
        assert_eq!(take(&simple(&cameras, &rest)).unwrap().world, None);
    }
    let one = scaled.replace("<scale>4", "<scale>1");
    let engineering = "<reference>ENGCRS[\"Local\",EDATUM[\"x\"],LENGTHUNIT[\"metre\",1]]</reference>";
    for (reference, local) in
        [("", true), (local("\"metre\",1").as_str(), true), (engineering, true), (earth, false)]
    {
        let notes = take(&simple(&cameras, &format!("{one}{reference}"))).unwrap().notes.join("");
        assert_eq!(notes.contains("exactly 1"), local, "{reference}: {notes}");
    }
    for (from, to, expected) in [
        ("<scale>4</scale>", "<scale>0</scale>", "its <scale> is 0; expected above 0"),
        ("<scale>4</scale>", "<scale>-2</scale>", "Reference > Update"),
        ("1 0 0 0 1 0 0 0 1", "1 0 0 0 1 0 0 0 -1", "mirrored"),
        ("1 0 0 0 1 0 0 0 1", "1 0 0 0 1 0 0 0 2", "off orthonormal"),
        ("1 0 0 0 1 0 0 0 1", "1 0 0", "it has 3 numbers; expected 9"),
    ] {
        let said = complaint(&simple(&cameras, &scaled.replace(from, to)));
        assert!(said.contains(expected), "{said} lacks {expected}");
    }
    let said = complaint(&simple(&cameras, &matrix.replace('4', "0")));
    assert!(said.contains("<scale>"), "{said}");
    // Transposed, the matrix has its translation in the last row.
    let said = complaint(&simple(&cameras, "<transform>0 4 0 0 -4 0 0 0 0 0 4 0 1 2 3 1</transform>"));
    assert!(said.contains("the last row of its <transform> is [1.0, 2.0, 3.0, 1.0]"), "{said}");
}

#[test]
fn groups_disabled_and_unaligned_cameras() {
    let unaligned =
        "<camera id=\"8\" sensor_id=\"0\" label=\"lost\u{1b}[2J\"><orientation>1</orientation></camera>";
    let unaligned = unaligned.replace('\u{1b}', "&#9;");
    let slave = "<camera id=\"9\" sensor_id=\"0\" master_id=\"1\" label=\"band 2\"/>";
    let cameras = format!(
        "<group id=\"0\" label=\"dive 1\" type=\"folder\">{}<group id=\"1\" label=\"left\">{}</group></group>\
         <group id=\"2\" label=\"dive 2\">{}{}</group>{unaligned}{slave}<note>not a camera</note>{}",
        camera(0, 0, "IMG_1", ""),
        camera(1, 0, "IMG_2", ""),
        camera(2, 0, "IMG_2", ""),
        camera(3, 0, "IMG_3", " enabled=\"false\""),
        camera(4, 0, "IMG_4", " enabled=\"1\""),
    );
    let survey = take(&simple(&cameras, "")).unwrap();
    let names: Vec<&str> = survey.images.iter().map(|i| i.name.as_str()).collect();
    // Only names that repeat get the labels of their groups.
    assert_eq!(names, ["IMG_1", "dive 1/left/IMG_2", "dive 2/IMG_2", "IMG_4"]);
    let notes = survey.notes.join("; ");
    for expected in [
        "2 cameras are not aligned",
        "lost",
        "1 cameras are disabled",
        "IMG_3",
        "1 cameras without a pose of their own follow a master camera",
    ] {
        assert!(notes.contains(expected), "{notes} lacks {expected}");
    }
    let said = complaint(&simple(&(camera(0, 0, "IMG_2", "") + &camera(1, 0, "IMG_2", "")), ""));
    assert!(said.contains("two cameras are called IMG_2") && said.contains("groups"), "{said}");
}

#[test]
fn labels_may_be_paths_and_frames_may_name_the_photographs() {
    let cameras = camera(0, 0, "/home/me/dive/a.JPG", "")
        + &camera(1, 0, "C:\\dives\\b.tif", "")
        + &camera(2, 0, "T_S04920", "")
        + &camera(3, 0, "c", "");
    let frames = "<frames next_id=\"1\"><frame id=\"0\"><cameras><camera camera_id=\"3\"><photo path=\"../photos/c 3.jpg\"/>\
        </camera></cameras></frame></frames>";
    let survey = take(&simple(&cameras, frames)).unwrap();
    let names: Vec<&str> = survey.images.iter().map(|i| i.name.as_str()).collect();
    assert_eq!(names, ["home/me/dive/a.JPG", "dives/b.tif", "T_S04920", "photos/c 3.jpg"]);
    let said = complaint(&simple(&camera(0, 0, "", ""), ""));
    assert!(said.contains("rename the camera"), "{said}");
}

#[test]
fn scale_bars_give_metres_where_the_chunk_has_none() {
    let cameras: String = (0..4).map(|i| camera(i, 0, &format!("c{i}"), "")).collect();
    let (a, b) = (world_point(3), world_point(9));
    let marker = |id: u32, point: DVec3| {
        let places: String = (0..4)
            .map(|i| {
                let (to_world, center) = at(i);
                let (x, y) = manual(&PLAIN, &to_world, center, point);
                format!("<location camera_id=\"{i}\" pinned=\"true\" x=\"{x}\" y=\"{y}\"/>")
            })
            .collect();
        format!("<marker marker_id=\"{id}\">{places}<location camera_id=\"77\" x=\"1\" y=\"2\"/></marker>")
    };
    let length = 0.7 * (a - b).length();
    let rest = |more: &str| {
        format!(
            "<markers next_id=\"2\"><group label=\"bar\"><marker id=\"0\" label=\"target 1\"/></group><marker id=\"1\" label=\"target 2\">\
             <reference x=\"1\" y=\"2\" z=\"-5.5\" enabled=\"true\"/></marker></markers>\
             <scalebars next_id=\"1\"><scalebar id=\"0\" label=\"bar\"><endpoint marker_id=\"0\"/><endpoint marker_id=\"1\"/>\
             <reference d=\"{length}\" enabled=\"true\"/></scalebar></scalebars>\
             <frames><frame id=\"0\"><markers>{}{}</markers></frame></frames>{more}",
            marker(0, a),
            marker(1, b)
        )
    };
    let survey = take(&simple(&cameras, &rest(""))).unwrap();
    let world = survey.world.as_ref().unwrap();
    assert!((world.metres_per_unit - 0.7).abs() < 1e-9 && world.source == "Metashape scale bars");
    assert_eq!(survey.markers[1].reference, Some([1.0, 2.0, -5.5]));
    assert_eq!(survey.markers[0].marks.len(), 4, "a mark in an unknown camera is left out");
    // A transform goes before the bars; where they contradict each other a note says so.
    let scaled = "<transform><scale>0.5</scale></transform>";
    let survey = take(&simple(&cameras, &rest(scaled))).unwrap();
    assert_eq!(survey.world.unwrap().metres_per_unit, 0.5);
    assert!(survey.notes.join("").contains("by the scale bars one unit is 0.700000 m"), "{:?}", survey.notes);
    let bad = simple(&cameras, &rest("")).replace(&format!("d=\"{length}\""), "d=\"0\"");
    assert!(complaint(&bad).contains("metres above 0"));
}

/// The place of the world on the earth in the test below.
const PLACE: EarthPlace = EarthPlace { latitude: 43.1, longitude: 5.9, altitude: -12.0 };

/// Longitude, latitude and altitude of a position from the earth's centre, by steps from [`PLACE`].
fn geographic(position: [f64; 3]) -> [f64; 3] {
    let mut place = PLACE;
    for _ in 0..20 {
        let off = DVec3::from_array(position) - place.position();
        let (lat, lon) = (place.latitude.to_radians(), place.longitude.to_radians());
        let east = DVec3::new(-math::sin(lon), math::cos(lon), 0.0);
        let up = DVec3::new(math::cos(lat) * math::cos(lon), math::cos(lat) * math::sin(lon), math::sin(lat));
        let radius = place.position().length();
        place.longitude += (off.dot(east) / (radius * math::cos(lat))).to_degrees();
        place.latitude += (off.dot(up.cross(east)) / radius).to_degrees();
        place.altitude += off.dot(up);
    }
    [place.longitude, place.latitude, place.altitude]
}

#[test]
fn points_are_taken_in_the_chunks_own_frame_and_in_the_worlds() {
    let cameras: String = (0..6).map(|i| camera(i, 0, &format!("c{i}"), "")).collect();
    let scaled = "<transform><rotation>0 -1 0 1 0 0 0 0 1</rotation><translation>500000 4000000 -12</translation><scale>3</scale></transform>";
    let mut survey = take(&simple(&cameras, scaled)).unwrap();
    let world = survey.world.clone().unwrap();
    let cloud = |at: &dyn Fn([f64; 3]) -> [f64; 3]| {
        let points = (0..40).map(|k| use3d_survey::SurveyPoint {
            id: 1,
            position: at((world_point(k % 20) * 0.4 + DVec3::new(0.8, 0.0, 0.0)).to_array()),
            color: [k as u8, 2, 3],
            error: -1.0,
            track: vec![],
        });
        ply::write(&points.collect::<Vec<_>>()).into_bytes()
    };
    let path = Path::new("dive/points.ply");
    add_points(&mut survey, &cloud(&|p| p), path).unwrap();
    let local = survey.points.clone();
    assert_eq!((local.len(), local[5].color), (40, [5, 2, 3]));
    add_points(&mut survey, &cloud(&|p| world.apply(p)), path).unwrap();
    for (a, b) in survey.points.iter().zip(&local) {
        assert!((DVec3::from_array(a.position) - DVec3::from_array(b.position)).length() < 1e-9);
    }
    // The world is on the earth: longitude, latitude and altitude are understood, and chunk coordinates are
    // not taken for those of the world, in which they would lie in the earth's centre.
    let kept = survey.world.clone();
    let turn = DMat3::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 1.1);
    let on_earth = World::of(0.8, &turn, PLACE.position(), "test".into());
    survey.world = Some(on_earth.clone());
    for text in [cloud(&|p| p), cloud(&|p| on_earth.apply(p)), cloud(&|p| geographic(on_earth.apply(p)))] {
        add_points(&mut survey, &text, path).unwrap();
        for (a, b) in survey.points.iter().zip(&local) {
            assert!((0..3).all(|k| (a.position[k] - b.position[k]).abs() < 1e-3), "{a:?} {b:?}");
        }
    }
    survey.world = kept;
    let said = add_points(&mut survey, &cloud(&|p| p.map(|v| v + 1e5)), path).unwrap_err().to_string();
    assert!(said.contains("points.ply") && said.contains("Local Coordinates"), "{said}");
    let said = add_points(&mut survey, b"solid", path).unwrap_err().to_string();
    assert!(said.contains("points.ply"), "{said}");
    add_points(&mut survey, ply::write(&[]).as_bytes(), path).unwrap();
    assert!(survey.notes.join("").contains("points is empty"));
}

#[test]
fn files_that_are_no_cameras_files_are_explained() {
    let good = simple(&camera(0, 0, "a", ""), "");
    take(&good).unwrap();
    for (text, expected) in [
        (String::new(), "damaged or cut short"),
        (good[..good.len() / 2].to_string(), "cut short"),
        ("<calibration><f>3</f></calibration>".into(), "<calibration>; expected <document>"),
        ("<document version=\"1.2.0\" path=\"{projectname}.files/project.zip\"/>".into(), "Export Cameras"),
        (good.replace("2.0.0", "3.1.0"), "`version` is \"3.1.0\""),
        (good.replace("2.0.0", "new"), "`version` is \"new\""),
        (good.replace("cameras", "views"), "no <cameras>"),
        (good.replace("<transform>", "<other>").replace("</transform>", "</other>"), "none of its 1 cameras"),
        (good.replace("sensor_id=\"0\"", ""), "`sensor_id` is missing"),
        (good.replace("<camera id=\"0\"", "<camera id=\"-1\""), "`id` is \"-1\""),
        (good.replace("0 0 0 1<", "0 0 0 2<"), "last row"),
        (good.replace(" 0 0 0 1<", "<"), "it has 12 numbers; expected 16"),
        (good.replace(" 0 0 0 1<", " 0 0 0 1 5<"), "more than 16"),
        ("<!DOCTYPE a [<!ENTITY b \"cc\">]><document version=\"1\">&b;</document>".into(), "damaged"),
    ] {
        let said = complaint(&text);
        assert!(said.contains(expected), "{said} lacks {expected}");
    }
    // Mirrored axes: one column of the rotation with the other sign.
    let (mut mirrored, center) = at(0);
    mirrored.x_axis = -mirrored.x_axis;
    let camera =
        format!("<camera id=\"0\" sensor_id=\"0\" label=\"a\">{}</camera>", transform(&mirrored, center));
    assert!(complaint(&simple(&camera, "")).contains("mirrored"));
    let said = parse(&[0xff, 0xfe, b'<'], Path::new("x.xml")).unwrap_err().to_string();
    assert!(said.contains("UTF-8"), "{said}");

    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("cameras.xml");
    assert!(read(&path).unwrap_err().to_string().contains("cannot be read"));
    assert!(!is_cameras_file(&path));
    std::fs::write(&path, format!("\u{feff}{good}")).unwrap();
    assert!(is_cameras_file(&path) && read(&path).is_ok(), "with a byte-order mark");
    std::fs::write(&path, "<html></html>").unwrap();
    assert!(!is_cameras_file(&path));
}

#[test]
fn deep_nesting_ends_in_an_error_or_a_survey() {
    let deep = "<group label=\"g\">".repeat(50_000);
    let text = simple(&(deep + &camera(0, 0, "a", "")), "");
    let _ = take(&text);
    let closed = format!("{}{}{}", "<group>".repeat(900), camera(0, 0, "a", ""), "</group>".repeat(900));
    let _ = take(&simple(&closed, ""));
}

#[test]
fn mutated_files_never_panic() {
    let cameras: String = (0..3).map(|i| camera(i, 0, &format!("c{i}"), " component_id=\"0\"")).collect();
    let rest = "<components><component id=\"0\"><transform><rotation>1 0 0 0 1 0 0 0 1</rotation><scale>2</scale></transform></component></components>\
        <markers><marker id=\"0\" label=\"m\"/></markers><scalebars><scalebar id=\"0\"><endpoint marker_id=\"0\"/><reference d=\"1\"/></scalebar></scalebars>\
        <frames><frame id=\"0\"><markers><marker marker_id=\"0\"><location camera_id=\"0\" x=\"5\" y=\"6\"/></marker></markers></frame></frames>";
    let seed = simple(&cameras, rest).into_bytes();
    let mut read = 0;
    for round in 0..4000 {
        let bytes = mutated(&seed, b"0123456789-.e <>/\"=", round);
        read += usize::from(parse(&bytes, Path::new("mutated.xml")).is_ok());
    }
    assert!(read > 100, "only {read} of the mutated files were read: the seed is too brittle");
}
