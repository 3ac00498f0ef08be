//! Every fault changes the files that it says, more so the stronger it is, and the same ones every time.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use use3d_io_colmap::Model;
use use3d_io_image::{read_exif, read_map};

use super::*;
use crate::{CaptureParams, write_capture};

const SEED: u64 = 7;

/// A sound capture.
fn sound(dir: &Path) -> PathBuf {
    let out = dir.join("sound");
    let params = CaptureParams {
        seed: SEED,
        views: 12,
        width: 96,
        height: 64,
        points: 700,
        detail: 0.12,
        ..CaptureParams::default()
    };
    write_capture(&params, &out, &mut |_, _| ()).unwrap();
    out
}

fn files(root: &Path) -> BTreeMap<String, Vec<u8>> {
    let (mut out, mut open) = (BTreeMap::new(), vec![root.to_path_buf()]);
    while let Some(dir) = open.pop() {
        for path in std::fs::read_dir(&dir).unwrap().map(|entry| entry.unwrap().path()) {
            if path.is_dir() {
                open.push(path);
            } else {
                let below = path.strip_prefix(root).unwrap().to_str().unwrap().replace('\\', "/");
                out.insert(below, std::fs::read(&path).unwrap());
            }
        }
    }
    out
}

/// A copy of a capture with a fault in it.
fn spoilt(sound: &BTreeMap<String, Vec<u8>>, out: &Path, fault: ChosenFault) -> BTreeMap<String, Vec<u8>> {
    for (name, bytes) in sound {
        let path = out.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, bytes).unwrap();
    }
    fault.spoil(out, SEED).unwrap();
    files(out)
}

/// The beginnings of the names of files, one of which a fault of this kind adds, changes or removes.
fn touched(carrier: &str) -> &'static [&'static str] {
    match carrier {
        "model" | "lens" => &["sparse/"],
        "photographs" | "files" => &["images/"],
        "names" => &["sparse/", "images/"],
        "masks" => &["mask", "Masks/", "images/"],
        "depth" => &["depth/"],
        "positions" => &["positions.csv", "images/"],
        "transforms" => &["transforms"],
        _ => panic!("{carrier}: no kind of file"),
    }
}

/// A number that grows with the difference between two models.
fn model_difference(a: &Model, b: &Model) -> f64 {
    fn sum<'a>(a: impl IntoIterator<Item = &'a f64>, b: impl IntoIterator<Item = &'a f64>) -> f64 {
        a.into_iter().zip(b).map(|(a, b)| (a - b).abs().min(1e9)).sum()
    }
    let count = |a: usize, b: usize| 1000.0 * a.abs_diff(b) as f64;
    let mut all = count(a.images.len(), b.images.len()) + count(a.points.len(), b.points.len());
    all += a.cameras.iter().zip(&b.cameras).map(|(a, b)| sum(&a.parameters, &b.parameters)).sum::<f64>();
    for (a, b) in a.images.iter().zip(&b.images) {
        all += sum(&a.translation, &b.translation) + sum(&a.quaternion, &b.quaternion);
        all += f64::from(u8::from(a.name != b.name));
        all += count(a.keypoints.len(), b.keypoints.len());
        if a.keypoints.len() == b.keypoints.len() {
            let moved = a.keypoints.iter().zip(&b.keypoints);
            all += moved.map(|(a, b)| (a.x - b.x).abs() + (a.y - b.y).abs()).sum::<f64>();
        }
    }
    let places: BTreeMap<u64, _> = a.points.iter().map(|point| (point.id, point.position)).collect();
    let moved = b.points.iter().filter_map(|point| Some((places.get(&point.id)?, point.position)));
    all + moved.map(|(a, b)| sum(a, &b)).sum::<f64>()
}

/// A number that grows with the difference between two captures.
fn difference(a: &Path, b: &Path) -> f64 {
    let mut all = 0.0;
    let place =
        |path: &str| Some((path.rsplit('/').next()?.rsplit_once('.')?.0.to_string(), path.to_string()));
    let list = |root: &Path, folder: &str| -> BTreeMap<String, String> {
        files(root).keys().filter(|name| name.starts_with(folder)).filter_map(|name| place(name)).collect()
    };
    for folder in ["images/", "depth/"] {
        let (of_a, of_b) = (list(a, folder), list(b, folder));
        all += 300.0 * of_a.len().abs_diff(of_b.len()) as f64;
        for (stem, path) in &of_b {
            let Some(original) = of_a.get(stem) else { continue };
            let read = |path: PathBuf| {
                read_map(&path).or_else(|_| {
                    use3d_io_image::read_image(&path).map(|image| {
                        let (w, h) = (image.width(), image.height());
                        use3d_capture::Map::from_planes(w, h * 3, image.into_data()).unwrap()
                    })
                })
            };
            let (one, other) = (read(a.join(original)).unwrap(), read(b.join(path)).unwrap());
            let pixels = one.data().iter().zip(other.data());
            all += 100.0 * one.pixels().abs_diff(other.pixels()) as f64;
            all += pixels.map(|(a, b)| f64::from((a - b).abs())).sum::<f64>();
        }
    }
    let sparse = use3d_io_colmap::read_model(&a.join("sparse/0")).unwrap();
    let centers: BTreeMap<&str, glam::DVec3> =
        sparse.images.iter().map(|image| (image.name.stem(), image.pose().center())).collect();
    if let Ok(model) = use3d_io_colmap::read_model(&b.join("sparse/0")) {
        all += model_difference(&sparse, &model);
    }
    if let Ok(bytes) = std::fs::read(b.join("sparse_pc.ply")) {
        let points = use3d_survey::ply::points(&bytes, b).unwrap();
        all += points.iter().flat_map(|point| point.position).map(f64::abs).sum::<f64>();
    }
    for row in std::fs::read_to_string(b.join("positions.csv")).unwrap_or_default().lines().skip(1) {
        let (name, numbers) = row.split_once(',').unwrap();
        let numbers: Vec<f64> = numbers.split(',').map(|n| n.parse().unwrap()).collect();
        all += centers[use3d_capture::stem(name)].distance(glam::DVec3::from_slice(&numbers));
    }
    for (stem, path) in list(b, "images/") {
        if let Some(gps) = read_exif(&b.join(path)).unwrap().gps {
            let at = measures::position(gps.latitude, gps.longitude, gps.altitude.unwrap());
            all += centers[stem.as_str()].distance(at);
        }
    }
    all
}

#[test]
fn every_fault_changes_what_it_says_and_more_so_the_stronger_it_is() {
    let dir = tempfile::tempdir().unwrap();
    let root = sound(dir.path());
    let before = files(&root);
    let wrong = |fault: &'static CaptureFault| -> Result<(), String> {
        let good =
            |good: bool, words: String| if good { Ok(()) } else { Err(format!("{}: {words}", fault.name)) };
        let levels = if fault.strengths.is_some() { 3 } else { 1 };
        let mut amounts = Vec::new();
        for level in 0..levels {
            let out = dir.path().join(format!("{}-{level}", fault.name));
            let after = spoilt(&before, &out, fault.at(level));
            let names: BTreeSet<&String> = before.keys().chain(after.keys()).collect();
            let changed = names.into_iter().filter(|name| before.get(*name) != after.get(*name));
            let changed: Vec<&String> = changed.collect();
            let (name, own) = (fault.name, touched(fault.carrier));
            good(changed.iter().any(|n| own.iter().any(|own| n.starts_with(own))), format!("{changed:?}"))?;
            good(!changed.iter().any(|name| name.starts_with("truth/")), format!("{changed:?}"))?;
            if levels > 1 {
                amounts.push(difference(&root, &out));
            }
            if level == levels - 1 {
                let again = spoilt(&before, &dir.path().join(format!("{name}-again")), fault.at(level));
                good(after == again, "it differs from one time to the next".into())?;
            }
        }
        good(amounts.is_sorted_by(|a, b| a < b), format!("{amounts:?}"))
    };
    let wrong: Vec<String> = FAULTS.par_iter().filter_map(|fault| wrong(fault).err()).collect();
    assert!(wrong.is_empty(), "\n{}", wrong.join("\n"));
}

#[test]
fn a_fault_has_a_name_of_its_own_and_a_strength_that_it_knows() {
    let names: BTreeSet<&str> = FAULTS.iter().map(|fault| fault.name).collect();
    assert!(names.len() == FAULTS.len() && names.len() >= 40, "{} of {}", names.len(), FAULTS.len());
    for fault in FAULTS {
        let good = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-';
        assert!(fault.name.chars().all(good), "{}", fault.name);
        let words = fault.wrong.split_whitespace().count();
        assert!(fault.wrong.ends_with('.') && words <= 25, "{}: {}", fault.name, fault.wrong);
    }
    let strength = |text: &str| text.parse::<ChosenFault>().map(|chosen| chosen.strength);
    assert_eq!(strength("poses-turned"), Ok(1.0));
    assert_eq!(strength("poses-turned:strong"), Ok(6.0));
    assert_eq!(strength("poses-turned:2.5"), Ok(2.5));
    let said = |text: &str| strength(text).unwrap_err().to_string();
    assert!(said("poses-turned:500").contains("from 0.06 to 12"), "{}", said("poses-turned:500"));
    assert!(said("red-blue:weak").contains("no strength"));
    assert!(said("list").contains("\n  stray-camera") && said("list").contains("weak 10, middle 1000"));
}

#[test]
fn a_fault_of_a_tiny_capture_is_no_panic() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("tiny");
    let params = CaptureParams {
        views: 2,
        width: 16,
        height: 17,
        points: 40,
        detail: 0.1,
        depth_priors: false,
        lens: crate::Optics::OpenCv,
        ..CaptureParams::default()
    };
    write_capture(&params, &root, &mut |_, _| ()).unwrap();
    let before = files(&root);
    FAULTS.par_iter().for_each(|fault| {
        spoilt(&before, &dir.path().join(fault.name), fault.at(2));
    });
}

/// The table of faults in the documents. `USE3D_UPDATE_SNAPSHOTS=1` writes it again.
#[test]
fn the_documents_list_every_fault() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/science/inputs.md");
    let mut table =
        String::from("| fault | file | wrong | weak, middle, strong | owed |\n|---|---|---|---|---|\n");
    for fault in FAULTS {
        let strengths = fault
            .strengths
            .map_or(String::new(), |Strengths { unit, values: [a, b, c] }| format!("{a}, {b}, {c} {unit}"));
        let (name, carrier, wrong, due) = (fault.name, fault.carrier, fault.wrong, fault.due.word());
        let _ = writeln!(table, "| `{name}` | {carrier} | {wrong} | {strengths} | {due} |");
    }
    let text = std::fs::read_to_string(&path).unwrap();
    let (head, rest) = text.split_once("| fault |").unwrap();
    let (_, tail) = rest.split_once("\n\n").unwrap();
    let expected = format!("{head}{table}\n{tail}");
    if std::env::var_os("USE3D_UPDATE_SNAPSHOTS").is_some() {
        return std::fs::write(&path, &expected).unwrap();
    }
    assert!(text == expected, "docs/science/inputs.md: run this test with USE3D_UPDATE_SNAPSHOTS=1");
}
