//! Tests of the photographs that a user gets back: full size, under their names, through their lens; resumed,
//! never overwritten; other developments, films, and wrong inputs.

mod tiny;

use std::path::Path;
use std::process::{Command, Output};

use tiny::{Place, command};
use use3d_io_image::{Photograph, Samples};

fn expect(place: &Place, code: i32, arguments: &[&str]) -> String {
    let Output { status, stdout, stderr } =
        command().args(arguments).current_dir(place.dir.path()).output().expect("the command starts");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    let told = text(&stdout) + &text(&stderr);
    assert_eq!(status.code(), Some(code), "use3d {arguments:?}\n{told}");
    told
}

fn files(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> = std::fs::read_dir(folder)
        .unwrap_or_else(|e| panic!("{}: {e}", folder.display()))
        .map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned())
        .filter(|name| !name.starts_with('.') && name.ends_with(".png"))
        .collect();
    names.sort();
    names
}

/// The mean difference of two 8-bit photographs, in steps of 255.
fn apart(a: &Path, b: &Path) -> f64 {
    let read = |path: &Path| match Photograph::read(path).unwrap().pixels {
        Samples::Eight(pixels) => pixels,
        Samples::Sixteen(pixels) => pixels.into_iter().map(|v| (v >> 8) as u8).collect(),
        Samples::Float(_) => panic!("{}: floats", path.display()),
    };
    let (a, b) = (read(a), read(b));
    assert_eq!(a.len(), b.len());
    a.iter().zip(&b).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / a.len() as f64
}

/// A place with a capture and its results, and all of its photographs from the run.
fn results() -> Place {
    let place = Place::new();
    let mut arguments =
        vec!["run", "tiny", "--cache", "cache", "-o", "out", "--iterations", "40", "--photographs"];
    let sets: Vec<String> = tiny::TINY[1..].iter().map(ToString::to_string).collect();
    arguments.extend(sets.iter().flat_map(|set| ["--set", set]));
    let told = expect(&place, 0, &arguments);
    assert!(told.contains("photographs written"), "{told}");
    place
}

#[test]
fn photographs_come_back_under_their_names_and_nothing_is_lost() {
    let place = results();
    let at = |name: &str| place.dir.path().join(name);
    let names = files(&at("tiny/images"));
    assert_eq!(files(&at("out/tiny/photographs")), names);
    // The run again: nothing is made twice.
    let photographs = ["photographs", "out", "-o", "own"];
    expect(&place, 0, &photographs);
    assert_eq!(files(&at("own")), names);
    let table = std::fs::read_to_string(at("own/photographs.csv")).unwrap();
    assert_eq!(table.lines().count(), 1 + names.len(), "{table}");
    let first = &names[0];
    assert_eq!(apart(&at("own").join(first), &at("out/tiny/photographs").join(first)), 0.0);
    assert!(apart(&at("own").join(first), &at("tiny/images").join(first)) > 1.0, "it is enhanced");
    let told = expect(&place, 0, &photographs);
    assert!(told.contains("0 photographs written") && told.contains("finished before"), "{told}");

    // A result that its user changed is not replaced.
    std::fs::copy(at("tiny/images").join(first), at("own").join(first)).unwrap();
    let told = expect(&place, 2, &photographs);
    assert!(told.contains(first) && told.contains("not a finished result"), "{told}");

    // Other settings, files of others, and the originals themselves are refused; `--force` replaces results.
    let told = expect(&place, 2, &["photographs", "out", "-o", "own", "--strength", "0.5"]);
    assert!(told.contains("--force"), "{told}");
    let told = expect(&place, 2, &["photographs", "out", "-o", "tiny/images"]);
    assert!(told.contains("original photograph"), "{told}");
    std::fs::create_dir(at("taken")).unwrap();
    std::fs::copy(at("tiny/images").join(first), at("taken").join(first)).unwrap();
    let told = expect(&place, 2, &["photographs", "out", "-o", "taken"]);
    assert!(told.contains("not a finished result"), "{told}");
    expect(&place, 0, &["photographs", "out", "-o", "own", "--strength", "0.5", "--force"]);

    // A photograph without a camera comes out by the mean, and a missing one is named.
    std::fs::copy(at("tiny/images").join(first), at("tiny/images/stray.png")).unwrap();
    std::fs::rename(at("tiny/images").join(&names[1]), at("away.png")).unwrap();
    let told = expect(&place, 0, &["photographs", "out", "-o", "more", "--unknown", "masks"]);
    assert!(told.contains("without a camera") && told.contains(&names[1]), "{told}");
    assert!(at("more/stray.png").is_file() && !at("more").join(&names[1]).exists());
    let (mask, own) = (at("masks").join(first), at("more").join(first));
    let size = |path: &Path| Photograph::read(path).map(|p| (p.width, p.height)).unwrap();
    assert_eq!(size(&mask), size(&own));
    std::fs::rename(at("away.png"), at("tiny/images").join(&names[1])).unwrap();

    // Masks never replace a file of somebody, and never stand among photographs. They are made later, too.
    for folder in ["tiny/images", "tiny/images/masks", "more"] {
        let told = expect(&place, 2, &["photographs", "out", "-o", "more", "--unknown", folder, "--force"]);
        assert!(told.contains("among the photographs"), "{told}");
    }
    let told = expect(&place, 2, &["photographs", "out", "-o", "more", "--unknown", "taken"]);
    assert!(told.contains("taken") && told.contains("--force"), "{told}");
    assert_eq!(apart(&at("taken").join(first), &at("tiny/images").join(first)), 0.0);
    let told = expect(&place, 0, &["photographs", "out", "-o", "more", "--unknown", "later"]);
    assert_eq!(files(&at("later")), names, "{told}");
    let told = expect(&place, 0, &["photographs", "out", "-o", "more", "--unknown", "later"]);
    assert!(told.contains("0 photographs written"), "{told}");

    // A table of somebody and the results of other files stay; a refused command leaves nothing behind.
    std::fs::create_dir(at("survey")).unwrap();
    std::fs::write(at("survey/photographs.csv"), "mine").unwrap();
    let told = expect(&place, 2, &["photographs", "out", "-o", "survey"]);
    assert!(told.contains("photographs.csv") && told.contains("--force"), "{told}");
    assert_eq!(std::fs::read_dir(at("survey")).unwrap().count(), 1);
    let told = expect(&place, 2, &["photographs", "out", "-o", "more", "--images", "taken"]);
    assert!(told.contains("other files"), "{told}");
    let told = expect(&place, 2, &["photographs", "out", "-o", "survey/photographs.csv"]);
    assert!(told.contains("this is a file"), "{told}");

    // A photograph of another size is refused, and those before it stay.
    let mut other = Photograph::read(&at("tiny/images").join(&names[2])).unwrap();
    let Samples::Eight(pixels) = &other.pixels else { panic!("8 bits") };
    let (half, width) = (other.height / 2, other.width);
    let cut = Samples::Eight(pixels[..3 * width * half].to_vec());
    other = other.with_pixels((width, half), cut, None);
    std::fs::create_dir(at("cut")).unwrap();
    for name in &names {
        std::fs::copy(at("tiny/images").join(name), at("cut").join(name)).unwrap();
    }
    other.write(&at("cut").join(&names[2]), "test", "cut").unwrap();
    let told = expect(&place, 2, &["photographs", "out", "--images", "cut", "-o", "fromcut"]);
    assert!(told.contains(&names[2]) && told.contains("pixels"), "{told}");
}

#[test]
fn another_development_is_matched_and_other_pictures_are_refused() {
    let place = results();
    let at = |name: &str| place.dir.path().join(name);
    let names = files(&at("tiny/images"));
    std::fs::create_dir(at("raw")).unwrap();
    std::fs::create_dir(at("strange")).unwrap();
    for (i, name) in names.iter().enumerate() {
        let mut photograph = Photograph::read(&at("tiny/images").join(name)).unwrap();
        let Samples::Eight(pixels) = &mut photograph.pixels else { panic!("8 bits") };
        // Darker, and with a stronger blue.
        for pixel in pixels.chunks_exact_mut(3) {
            let bent = |v: u8, gain: f32| {
                ((f32::from(v) / 255.0) * (f32::from(v) / 255.0) * gain * 255.0).min(255.0) as u8
            };
            pixel.copy_from_slice(&[bent(pixel[0], 1.0), bent(pixel[1], 0.9), bent(pixel[2], 1.2)]);
        }
        photograph.write(&at("raw").join(name), "test", "developed").unwrap();
        let Samples::Eight(pixels) = &mut photograph.pixels else { panic!("8 bits") };
        for (k, value) in pixels.iter_mut().enumerate() {
            *value = if (k / 60 + i).is_multiple_of(2) { 250 } else { 5 };
        }
        photograph.write(&at("strange").join(name), "test", "strange").unwrap();
    }
    let told = expect(&place, 0, &["photographs", "out", "--images", "raw", "-o", "fromraw"]);
    assert!(told.contains("developed in another way"), "{told}");
    let own = at("out/tiny/photographs").join(&names[0]);
    let before = apart(&at("raw").join(&names[0]), &at("tiny/images").join(&names[0]));
    let after = apart(&at("fromraw").join(&names[0]), &own);
    assert!(after < 0.4 * before, "{before} {after}");
    let told = expect(&place, 2, &["photographs", "out", "--images", "strange", "-o", "fromstrange"]);
    assert!(told.contains("do not show what their cameras see"), "{told}");
    assert!(files(&at("fromstrange")).is_empty());
}

#[test]
fn a_film_comes_back_as_a_film() {
    let ffmpeg = |arguments: &[&str], folder: &Path| {
        let done = Command::new("ffmpeg").args(arguments).current_dir(folder).output();
        done.is_ok_and(|done| done.status.success())
    };
    if Command::new("ffmpeg").arg("-version").output().is_err() {
        println!("not run: there is no ffmpeg");
        return;
    }
    let place = results();
    let at = |name: &str| place.dir.path().join(name);
    let names = files(&at("tiny/images"));
    // The photographs in their order, as a film with a second between them.
    std::fs::create_dir(at("frames")).unwrap();
    for (i, name) in names.iter().enumerate() {
        std::fs::copy(at("tiny/images").join(name), at("frames").join(format!("{i:03}.png"))).unwrap();
    }
    let made = ["-v", "error", "-framerate", "2", "-i", "frames/%03d.png", "-pix_fmt", "yuv420p", "dive.mp4"];
    assert!(ffmpeg(&made, place.dir.path()));
    let told = expect(&place, 2, &["photographs", "out", "--film", "dive.mp4", "--video", "new.mp4"]);
    assert!(told.contains("times.csv"), "{told}");
    let lines = names.iter().enumerate().step_by(2).map(|(i, n)| format!("{n},{}\n", 0.5 * i as f64));
    std::fs::write(at("tiny/times.csv"), "photograph,seconds\n".to_string() + &lines.collect::<String>())
        .unwrap();
    let told = expect(&place, 0, &["photographs", "out", "--film", "dive.mp4", "--video", "new.mp4"]);
    assert!(told.contains(&format!("{} frames written", names.len())), "{told}");
    assert!(ffmpeg(&["-v", "error", "-i", "new.mp4", "-f", "null", "-"], place.dir.path()));
    // An existing film stays, and the film itself is no place for the new one.
    let told = expect(&place, 2, &["photographs", "out", "--film", "dive.mp4", "--video", "new.mp4"]);
    assert!(told.contains("--force"), "{told}");
    expect(&place, 2, &["photographs", "out", "--film", "dive.mp4", "--video", "dive.mp4"]);
}
