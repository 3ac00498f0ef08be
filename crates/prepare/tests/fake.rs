//! Preparations with a script in the place of `colmap`: what fails, and what is kept for the next attempt.
#![cfg(unix)]

mod common;

use std::path::{Path, PathBuf};

use common::place::{Place, SCRIPT, name};
use common::{Attempt, attempt};
use use3d_capture::{FileName, Raster};
use use3d_prepare::{CAPTURE, Finder, Grade, PREPARED, PrepareError, PrepareParams, Programs};

const ALL: [&str; 3] = ["feature_extractor", "exhaustive_matcher", "mapper"];

#[test]
fn a_capture_is_made_and_its_record_says_of_what() {
    let place = Place::new();
    place.found(0, 0..10, 0.5);
    let Attempt { done, work, .. } = place.attempt(&PrepareParams::default());
    let verdict = done.unwrap().verdict;
    assert_eq!((verdict.grade, verdict.registered, verdict.groups.len()), (Grade::Good, 10, 0));
    assert!(verdict.words[0].contains("10 of 10 images"), "{}", verdict.words[0]);
    assert_eq!(place.calls(), ALL);
    let capture = work.join(CAPTURE);
    assert!(capture.join("images/p_03.png").is_file() && capture.join("sparse/0/points3D.bin").is_file());
    let record: serde_json::Value =
        serde_json::from_slice(&std::fs::read(capture.join(PREPARED)).unwrap()).unwrap();
    assert_eq!(record["programs"][0]["version"], "9.9");
    let command = record["commands"]["features"][0].to_string();
    // Only options that the program's help lists are given, and no path of this machine is kept.
    for part in ["--ImageReader.camera_model", "RADIAL", "--SiftExtraction.use_gpu"] {
        assert!(command.contains(part), "{command}");
    }
    assert!(!command.contains("random_seed") && !command.contains("photos"), "{command}");
}

#[test]
fn a_failing_step_names_its_log_and_finished_steps_are_kept() {
    let place = Place::new();
    place.found(0, 0..10, 0.5);
    for (step, words) in
        [("feature_extractor", "features"), ("exhaustive_matcher", "matches"), ("mapper", "cameras")]
    {
        std::fs::write(place.at(&format!("fail-{step}")), "").unwrap();
        let Attempt { done, work, .. } = place.attempt(&PrepareParams::default());
        let message = done.unwrap_err().to_string();
        for part in [words, "failed", "the disk is on fire", "code 3", "log.txt"] {
            assert!(message.contains(part), "{step}: {message}");
        }
        assert!(std::fs::read_to_string(work.join("log.txt")).unwrap().contains("on fire"));
        assert_eq!(place.calls().last().unwrap(), step);
        std::fs::remove_file(place.at(&format!("fail-{step}"))).unwrap();
    }
    // Only the step that failed last is left to do.
    let Attempt { done, notes, .. } = place.attempt(&PrepareParams::default());
    done.unwrap();
    assert_eq!(place.calls(), ["mapper"]);
    assert_eq!(notes.iter().filter(|n| n.contains("kept from the last attempt")).count(), 3, "{notes:?}");
    // Another choice repeats the steps after it.
    let more = PrepareParams { features: Some(5000), ..PrepareParams::default() };
    place.attempt(&more).done.unwrap();
    assert_eq!(place.calls(), ALL);
    let other = PrepareParams { matching: use3d_prepare::Matching::Sequential, ..more };
    place.attempt(&other).done.unwrap();
    assert_eq!(place.calls(), ["sequential_matcher", "mapper"]);
}

#[test]
fn a_lens_that_the_path_does_not_determine_is_asked_for() {
    let calls = || {
        let [features, matches, mapper] = ALL;
        [features, matches, mapper, mapper]
    };
    // A rare lens gives way to a usual one that fits as well.
    let place = Place::new();
    place.found_straight("models", 5.0, 0.5);
    place.found_straight("models-usual-lens", 13.6, 0.55);
    let Attempt { done, work, .. } = place.attempt(&PrepareParams::default());
    let verdict = done.unwrap().verdict;
    assert_eq!((verdict.grade, place.calls()), (Grade::Usable, calls().map(String::from).to_vec()));
    let words = &verdict.words[1];
    for part in ["of 5 pixels was found", "a usual one of 14 pixels is used", "--calibration F,8,6"] {
        assert!(words.contains(part), "{words}");
    }
    let focal = |work: &Path| {
        let model = use3d_io_colmap::read_model(&work.join(CAPTURE).join("sparse/0")).unwrap();
        model.cameras[0].parameters[0]
    };
    assert_eq!(focal(&work), 13.6);
    // One that fits worse is not taken.
    let place = Place::new();
    place.found_straight("models", 5.0, 0.5);
    place.found_straight("models-usual-lens", 13.6, 2.0);
    let Attempt { done, work, .. } = place.attempt(&PrepareParams::default());
    let verdict = done.unwrap().verdict;
    assert!(verdict.words[1].contains("of 5 pixels was found, and the shape"), "{:?}", verdict.words);
    assert_eq!(focal(&work), 5.0);
    // A usual lens stays, and the user is asked; a lens that was given is right.
    let place = Place::new();
    place.found_straight("models", 13.0, 0.5);
    let verdict = place.attempt(&PrepareParams::default()).done.unwrap().verdict;
    assert!(verdict.focal_error.unwrap() > 0.1 && verdict.words[1].contains("13 pixels"), "{verdict:?}");
    assert_eq!(place.calls(), ALL);
}

#[test]
fn few_images_and_several_groups_are_said_in_words() {
    let place = Place::new();
    // The smaller group comes first, and one of its images is also in the larger one.
    place.found(0, 7..10, 0.4);
    place.found(1, 0..8, 2.0);
    let Attempt { done, work, .. } = place.attempt(&PrepareParams::default());
    let verdict = done.unwrap().verdict;
    assert_eq!((verdict.grade, verdict.registered, &verdict.groups[..]), (Grade::Usable, 8, &[2][..]));
    let words = verdict.words.join("\n");
    for part in ["8 of 10 images have a place (80 %)", "2 images", "--features 6000", "1.5 pixels", "--lens"]
    {
        assert!(words.contains(part), "{part}: {words}");
    }
    let largest = use3d_io_colmap::read_model(&work.join(CAPTURE).join("sparse/0")).unwrap();
    assert_eq!(largest.images.len(), 8);

    let place = Place::new();
    place.found(0, 0..4, 0.4);
    let verdict = place.attempt(&PrepareParams::default()).done.unwrap().verdict;
    assert_eq!(verdict.grade, Grade::Poor);
    assert!(verdict.words.iter().any(|w| w.contains("More than a third")), "{:?}", verdict.words);
    assert_eq!(verdict.missing.len(), 6);
    let named = "No place was found for p_04.png, p_05.png, p_06.png, p_07.png, p_08.png, p_09.png.";
    assert_eq!(verdict.words[1], named);
    let place = Place::new();
    place.found(0, 0..9, 0.4);
    let verdict = place.attempt(&PrepareParams::default()).done.unwrap().verdict;
    assert_eq!((verdict.grade, &*verdict.words[1]), (Grade::Good, "No place was found for p_09.png."));
    let place = Place::new();
    place.found(0, 0..3, 0.4);
    let verdict = place.attempt(&PrepareParams::default()).done.unwrap().verdict;
    assert!(verdict.words[1].ends_with("p_08.png and 1 more."), "{}", verdict.words[1]);
}

#[test]
fn no_cameras_are_an_error_with_remedies() {
    let place = Place::new();
    let error = place.attempt(&PrepareParams::default()).done.unwrap_err();
    assert!(matches!(error, PrepareError::NoCameras { images: 10, .. }), "{error}");
    assert!(error.to_string().contains("--features 6000"), "{error}");
    let fisheye = PrepareParams { lens: "OPENCV_FISHEYE".into(), ..PrepareParams::default() };
    let error = place.attempt(&fisheye).done.unwrap_err();
    assert!(error.to_string().contains("leave out --lens OPENCV_FISHEYE"), "{error}");
    place.attempt(&PrepareParams::default()).done.unwrap_err();
    place.calls();
    // The next attempt maps again.
    place.found(0, 0..10, 0.5);
    place.attempt(&PrepareParams::default()).done.unwrap();
    assert_eq!(place.calls(), ["mapper"]);
}

#[test]
fn a_finished_capture_is_known_again_and_changed_photographs_are_noticed() {
    let place = Place::new();
    place.found(0, 0..10, 0.5);
    let first = place.attempt(&PrepareParams::default());
    assert!(first.done.is_ok() && !first.reusable);
    std::fs::rename(first.work.join(CAPTURE), place.at("reef")).unwrap();
    // The folder of the work has its images no more, so they are copied again.
    let again = place.attempt(&PrepareParams::default());
    assert!(again.done.is_ok() && again.reusable);
    assert!(!again.notes.iter().any(|note| note.starts_with("images: kept")), "{:?}", again.notes);
    assert!(again.work.join(CAPTURE).join("images/p_03.png").is_file());
    std::fs::create_dir(place.at("photos/masks")).unwrap();
    let more = PrepareParams { features: Some(5000), ..PrepareParams::default() };
    assert!(!place.attempt(&more).reusable);
    let image = Raster::<u8, 3>::filled(16, 12, 255);
    use3d_io_image::write_png8(&place.at("photos/p_03.png"), &image).unwrap();
    assert!(!place.attempt(&PrepareParams::default()).reusable);
}

#[test]
fn masks_beside_the_photographs_count_and_are_copied() {
    let place = Place::new();
    place.found(0, 0..10, 0.5);
    std::fs::create_dir(place.at("swim")).unwrap();
    std::fs::rename(place.at("photos"), place.at("swim/images")).unwrap();
    std::fs::create_dir(place.at("swim/masks")).unwrap();
    let mask = |level| {
        let image = Raster::<u8, 3>::filled(16, 12, level);
        use3d_io_image::write_png8(&place.at("swim/masks/p_03.png"), &image).unwrap();
    };
    mask(0);
    let programs = Programs { colmap: place.at("colmap"), finder: Finder::Colmap, ..Programs::default() };
    let prepare = || attempt(&[place.at("swim")], &PrepareParams::default(), &programs, &place.at("reef"));
    let first = prepare();
    first.done.unwrap();
    assert!(first.work.join(CAPTURE).join("masks/p_03.png").is_file());
    std::fs::rename(first.work.join(CAPTURE), place.at("reef")).unwrap();
    mask(255);
    assert!(!prepare().reusable);
}

#[test]
fn masks_of_several_inputs_are_not_copied_and_the_remarks_say_so() {
    let place = Place::new();
    std::fs::create_dir_all(place.at("photos/masks")).unwrap();
    let below = |folder: &str, i| (i, FileName::new(&format!("{folder}/{}", name(i))).unwrap());
    place.found_as(0, (0..10).map(|i| below("photos", i)), 0.5);
    std::fs::create_dir(place.at("more")).unwrap();
    std::fs::copy(place.at("photos/p_00.png"), place.at("more/p_00.png")).unwrap();
    let programs = Programs { colmap: place.at("colmap"), finder: Finder::Colmap, ..Programs::default() };
    let inputs = [place.at("photos"), place.at("more")];
    let Attempt { done, work, .. } =
        attempt(&inputs, &PrepareParams::default(), &programs, &place.at("reef"));
    let remarks = done.unwrap().remarks.join("\n");
    let masks = place.at("photos/masks").display().to_string();
    assert!(remarks.contains(&format!("not copied: {masks}.")), "{remarks}");
    assert!(!work.join(CAPTURE).join("masks").exists());
}

#[test]
fn a_step_that_writes_nothing_and_a_lens_that_cannot_be_kept_are_errors() {
    let place = Place::new();
    place.found(0, 0..10, 0.5);
    let known = PrepareParams { calibration: vec![20.0, 8.0, 6.0, 0.0, 0.0], ..PrepareParams::default() };
    let said = place.attempt(&known).done.unwrap_err().to_string();
    assert!(said.starts_with("--calibration") && said.contains("ba_refine_focal_length"), "{said}");
    assert!(place.calls().is_empty());
    let repeatable = PrepareParams { repeatable: true, ..PrepareParams::default() };
    let said = place.attempt(&repeatable).done.unwrap_err().to_string();
    assert!(said.starts_with("--repeatable") && said.contains("pip install pycolmap"), "{said}");
    let silent = SCRIPT.replace("echo features > features.db", "true");
    std::fs::write(place.at("colmap"), silent).unwrap();
    let said = place.attempt(&PrepareParams::default()).done.unwrap_err().to_string();
    assert!(said.contains("features failed") && said.contains("did not write features.db"), "{said}");
}

#[test]
fn wrong_inputs_and_choices_are_refused_before_any_work() {
    let place = Place::new();
    place.found(0, 0..10, 0.5);
    let refused = |inputs: &[PathBuf], params: &PrepareParams| {
        let programs = Programs { colmap: place.at("colmap"), finder: Finder::Colmap, ..Programs::default() };
        attempt(inputs, params, &programs, &place.at("reef")).done.unwrap_err().to_string()
    };
    let usual = PrepareParams::default();
    let photos = [place.at("photos")];
    let with = |change: fn(&mut PrepareParams)| {
        let mut params = PrepareParams::default();
        change(&mut params);
        refused(&photos, &params)
    };
    assert!(with(|p| p.lens = "WIDE".into()).contains("--lens: WIDE is no lens model"));
    assert!(with(|p| p.calibration = vec![1.0]).contains("has 5 parameters"));
    assert!(
        with(|p| p.calibration = vec![20.0, 8.0, f64::NAN, 0.0, 0.0]).contains("--calibration: NaN is not")
    );
    assert!(
        with(|p| p.calibration = vec![-20.0, 8.0, 6.0, 0.0, 0.0])
            .contains("--calibration: the focal length -20 is")
    );
    assert!(with(|p| p.features = Some(3)).contains("--features: 3 is out of range; expected 100 to 100000"));
    let write = |name: &str, bytes: &[u8]| {
        std::fs::write(place.at(name), bytes).unwrap();
        place.at(name)
    };
    std::fs::create_dir(place.at("empty")).unwrap();
    std::fs::create_dir(place.at("one")).unwrap();
    std::fs::copy(place.at("photos/p_01.png"), place.at("one/p_01.png")).unwrap();
    let one = format!(
        "{}: it has 1 photograph; a scene needs at least 3 photographs, better 30 to 200",
        place.at("one").display()
    );
    assert_eq!(refused(&[place.at("one")], &usual), one);
    let two = [place.at("photos/p_01.png"), place.at("photos/p_02.png")];
    assert!(refused(&two, &usual).contains("2 photographs were given; a scene needs at least 3"));
    for (input, part) in [
        (place.at("nothing.mp4"), "no such file"),
        (place.at("empty"), "no films or photographs"),
        (write("a.heic", b"x"), "heif-convert"),
        (write("b.png", b"not a picture"), "b.png"),
        (place.at("photos/p_01.png"), "3 photographs"),
    ] {
        let message = refused(&[input], &usual);
        assert!(message.contains(part), "{message}");
    }
    assert!(
        refused(&[place.at("photos/p_01.png"), place.at("photos/p_01.png")], &usual).contains("same name")
    );
    assert!(!Path::new(&place.at("calls")).exists(), "no step was started");
}
