//! The folder of the work: what is planted there is refused, and what was damaged there is made again.
#![cfg(unix)]

mod common;

use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

use common::place::{Place, SCRIPT};
use common::{Attempt, attempt_until};
use use3d_prepare::{CAPTURE, Finder, PrepareError, PrepareParams, Programs, discard, work_folder};

/// The text of a file outside the folder of the work, which must stay.
const PRECIOUS: &str = "precious";

fn refused(place: &Place) -> String {
    let work = work_folder(&place.at("reef"));
    let error = place.attempt(&PrepareParams::default()).done.unwrap_err();
    assert!(matches!(error, PrepareError::Foreign { .. }), "{error}");
    assert_eq!(discard(&work).unwrap_err().to_string(), error.to_string());
    let message = error.to_string();
    assert!(message.starts_with(&work.display().to_string()) && message.contains("move this"), "{message}");
    message
}

/// A place where an attempt has failed at its mapper.
fn interrupted() -> (Place, PathBuf) {
    let place = Place::new();
    place.found(0, 0..10, 0.5);
    std::fs::write(place.at("fail-mapper"), "").unwrap();
    let Attempt { done, work, .. } = place.attempt(&PrepareParams::default());
    assert!(matches!(done, Err(PrepareError::Step { .. })));
    std::fs::remove_file(place.at("fail-mapper")).unwrap();
    place.calls();
    (place, work)
}

#[test]
fn a_folder_that_this_program_did_not_make_is_refused_and_kept() {
    let place = Place::new();
    place.found(0, 0..10, 0.5);
    let work = work_folder(&place.at("reef"));
    std::fs::write(place.at("victim"), PRECIOUS).unwrap();
    std::fs::create_dir(&work).unwrap();
    symlink("../victim", work.join("lock")).unwrap();
    assert!(refused(&place).contains("was not made by this version"));
    assert_eq!(std::fs::read_to_string(place.at("victim")).unwrap(), PRECIOUS);
    std::fs::remove_dir_all(&work).unwrap();

    let mine = place.at("elsewhere/capture/images/mine.jpg");
    std::fs::create_dir_all(mine.parent().unwrap()).unwrap();
    std::fs::write(&mine, PRECIOUS).unwrap();
    symlink("elsewhere", &work).unwrap();
    assert!(refused(&place).contains("this is a link"));
    std::fs::remove_file(&work).unwrap();
    std::fs::rename(place.at("elsewhere"), &work).unwrap();
    assert!(refused(&place).contains("was not made by this version"));
    assert_eq!(std::fs::read_to_string(work.join("capture/images/mine.jpg")).unwrap(), PRECIOUS);
    std::fs::remove_dir_all(&work).unwrap();
    assert!(place.calls().is_empty());

    // An empty folder is nobody's work.
    std::fs::create_dir(&work).unwrap();
    place.attempt(&PrepareParams::default()).done.unwrap();
    discard(&work).unwrap();
    assert!(!work.exists());
    discard(&work).unwrap();
}

#[test]
fn links_in_the_folder_are_not_written_through() {
    let (place, work) = interrupted();
    let victim = place.at("victim");
    std::fs::write(&victim, PRECIOUS).unwrap();
    for name in ["log.txt", "state.json", "group-0.txt", "filter.txt", "capture/images/new.png", "models/0"] {
        let path = work.join(name);
        let _ = std::fs::remove_file(&path);
        symlink(&victim, &path).unwrap();
        assert!(refused(&place).contains(name), "{name}");
        std::fs::remove_file(&path).unwrap();
        std::fs::hard_link(&victim, &path).unwrap();
        assert!(refused(&place).contains(name), "{name}");
        std::fs::remove_file(&path).unwrap();
        assert_eq!(std::fs::read_to_string(&victim).unwrap(), PRECIOUS);
    }
    place.attempt(&PrepareParams::default()).done.unwrap();
}

#[cfg(target_os = "linux")]
#[test]
fn the_folder_of_another_user_is_refused() {
    let (place, work) = interrupted();
    // Only root may give files away.
    if std::os::unix::fs::chown(&work, Some(65_534), None).is_ok() {
        assert!(refused(&place).contains("belongs to another user"));
    }
}

#[test]
fn a_file_that_was_damaged_between_two_attempts_is_made_again() {
    let steps: [(&str, &[&str]); 4] = [
        ("capture/images/p_04.png", &["feature_extractor", "exhaustive_matcher", "mapper"]),
        ("features.db", &["feature_extractor", "exhaustive_matcher", "mapper"]),
        ("matches.db", &["exhaustive_matcher", "mapper"]),
        ("models/0/points3D.bin", &["mapper"]),
    ];
    let (place, work) = interrupted();
    place.attempt(&PrepareParams::default()).done.unwrap();
    assert_eq!(place.calls(), ["mapper"], "matches are kept, although the mapper writes into its database");
    for (name, expected) in steps {
        for damage in [&b""[..], b"something else"] {
            std::fs::write(work.join(name), damage).unwrap();
            let Attempt { done, notes, .. } = place.attempt(&PrepareParams::default());
            done.unwrap();
            assert_eq!(place.calls(), expected, "{name}");
            assert!(notes.iter().any(|note| note.contains("changed since the last attempt")), "{notes:?}");
            let same = |of: &str| std::fs::read(place.at(of)).unwrap();
            assert_eq!(same("photos/p_04.png"), std::fs::read(work.join("capture/images/p_04.png")).unwrap());
        }
    }
}

#[test]
fn a_step_that_ends_while_the_user_stops_is_kept() {
    let place = Place::new();
    place.found(0, 0..10, 0.5);
    let programs = Programs { colmap: place.at("colmap"), finder: Finder::Colmap, ..Programs::default() };
    let (inputs, params) = ([place.at("photos")], PrepareParams::default());
    let stopped = attempt_until(&inputs, &params, &programs, &place.at("reef"), Some("features: found"));
    assert!(matches!(stopped.done, Err(PrepareError::Interrupted)), "{:?}", stopped.done);
    assert_eq!(place.calls(), ["feature_extractor"]);
    place.attempt(&params).done.unwrap();
    assert_eq!(place.calls(), ["exhaustive_matcher", "mapper"]);
}

#[test]
fn a_model_that_cannot_be_read_is_made_again() {
    let place = Place::new();
    place.found(0, 0..10, 0.5);
    let points = place.at("models/0/points3D.bin");
    let whole = std::fs::read(&points).unwrap();
    std::fs::write(&points, &whole[..whole.len() / 2]).unwrap();
    let message = place.attempt(&PrepareParams::default()).done.unwrap_err().to_string();
    for part in ["cameras failed", "cannot be read", "run the same command again", ".reef.preparing"] {
        assert!(message.contains(part), "{message}");
    }
    std::fs::write(&points, whole).unwrap();
    place.calls();
    place.attempt(&PrepareParams::default()).done.unwrap();
    assert_eq!(place.calls(), ["mapper"]);
}

#[test]
fn a_database_without_its_end_is_no_finished_step() {
    let place = Place::new();
    place.found(0, 0..10, 0.5);
    // The head of a database of ten pages of 4096 bytes, written whole.
    let mut head = [0u8; 100];
    head[..16].copy_from_slice(b"SQLite format 3\0");
    head[16] = 16;
    (head[27], head[31], head[95]) = (7, 10, 7);
    std::fs::write(place.at("head"), head).unwrap();
    for (script, whole) in [
        (r#"head -c 40960 /dev/zero | cat "$here/head" - | head -c 40960 > features.db"#, true),
        (r#"head -c 30000 /dev/zero | cat "$here/head" - > features.db"#, false),
        (": > features.db", false),
    ] {
        std::fs::write(place.at("colmap"), SCRIPT.replace("echo features > features.db", script)).unwrap();
        let params = PrepareParams { features: Some(200 + script.len()), ..PrepareParams::default() };
        let message = place.attempt(&params).done.map_or_else(|error| error.to_string(), |_| String::new());
        assert_eq!(!message.contains("wrote only a part of features.db"), whole, "{message}");
    }
}

#[test]
fn files_that_no_step_made_are_not_delivered() {
    let (place, work) = interrupted();
    for name in ["images/of-another-attempt.png", "sparse/7/points3D.bin", "masks/old.png"] {
        let path = work.join(CAPTURE).join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, "old").unwrap();
    }
    place.attempt(&PrepareParams::default()).done.unwrap();
    let there = |name: &str| Path::new(&work).join(CAPTURE).join(name).exists();
    assert!(!there("images/of-another-attempt.png") && !there("sparse/7") && !there("masks/old.png"));
    assert!(there("images/p_04.png") && there("sparse/0/points3D.bin"));
}
