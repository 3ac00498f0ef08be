//! Tests `push`, `pull` and `run --remote` on a folder: results computed in one cache are fetched into
//! another to the byte, and problems of a store are reported.

mod many;
mod tiny;

use std::fs;
use std::process::Command;

use many::Many;

/// Exit code and output.
fn ended(mut command: Command) -> (Option<i32>, String) {
    let output = command.output().expect("the command starts");
    let said = [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
    (output.status.code(), said.concat())
}

#[test]
fn what_was_computed_in_one_cache_is_fetched_into_another() {
    let many = Many::new(&["s1".to_string()]);
    let store = many.at("store").to_string_lossy().into_owned();
    let command = |verb: &str, cache: &str, words: &[&str]| {
        let mut command = many.command(&[verb], cache);
        command.args(["--remote", &store]).args(words);
        command
    };
    let (code, said) = ended(command("run", "first", &["--cache-only"]));
    assert_eq!(code, Some(0), "{said}");
    let whole = many.artifacts("first");

    // The address of an empty folder, and one of no folder.
    fs::create_dir(many.at("empty")).expect("folder");
    for (address, code, words) in [
        ("empty", 0, "has none of the missing results; check the address"),
        ("nowhere", 1, "nowhere: there is no such folder"),
    ] {
        let mut pull = many.command(&["pull"], "second");
        pull.args(["--remote", address]);
        let (ended, said) = ended(pull);
        assert!(ended == Some(code) && said.contains(words), "{address}: {said}");
    }
    let (code, said) = ended(command("push", "empty", &[]));
    assert!(code == Some(0) && said.contains("empty has no results of this pipeline"), "{said}");
    let (code, said) = ended(command("pull", "second", &[]));
    assert!(!said.contains("check the address"), "{said}");
    assert!(code == Some(0) && said.contains(" 0 missing"), "{said}");
    assert!(many.artifacts("second") == whole);
    // Another machine's run also finds all of it, computes nothing, and delivers results.
    let (code, said) = ended(command("run", "third", &["--out", "out-third"]));
    assert!(code == Some(0) && said.contains(" 0 done,"), "{said}");
    assert!(many.artifacts("third") == whole && many.scores("out-third".as_ref()).len() == 1);

    // The store's disk rots: fetching detects it, and checking repairs it.
    let blobs = many.at("store/v1/blobs");
    let blob = fs::read_dir(&blobs).expect("blobs").flatten().map(|e| e.path());
    let blob = blob.max_by_key(|path| fs::metadata(path).map_or(0, |m| m.len())).expect("a blob");
    let right = fs::read(&blob).expect("read");
    let mut wrong = right.clone();
    wrong[right.len() / 2] ^= 1;
    fs::write(&blob, wrong).expect("written");
    let (code, said) = ended(command("pull", "fourth", &["--quiet"]));
    assert!(code == Some(1) && said.contains("has other bytes than its digest"), "{said}");
    let fetched = many.artifacts("fourth");
    assert!(
        fetched.len() < whole.len() && fetched.iter().all(|(path, bytes)| whole.get(path) == Some(bytes))
    );
    let (code, said) = ended(command("push", "first", &["--check"]));
    assert!(code == Some(0) && said.contains("1 artifact ("), "{said}");
    assert!(fs::read(&blob).expect("read") == right);
    let (code, said) = ended(command("pull", "fourth", &["--json"]));
    let report = said.lines().skip_while(|line| *line != "{").collect::<Vec<_>>();
    assert!(code == Some(0) && report.iter().any(|line| line.trim() == "\"missing\": 0,"), "{said}");
    assert!(many.artifacts("fourth") == whole);
}

#[test]
fn a_store_that_cannot_be_used_is_said_before_anything_is_computed() {
    let many = Many::new(&["s1".to_string()]);
    fs::write(many.at("file"), "no folder").expect("written");
    for (address, code, words) in [
        ("ftp://host/store", 2, "unknown kind of store"),
        ("s3://AKIA:secret@bucket", 2, "AWS_SECRET_ACCESS_KEY"),
        ("file/store", 1, "cannot write v1/probe"),
    ] {
        for verb in ["run", "push"] {
            let mut command = many.command(&[verb], "cache");
            command.args(["--remote", address]);
            let (ended, said) = ended(command);
            assert!(ended == Some(code) && said.contains(words), "{verb} {address}: {said}");
            assert!(!said.contains("secret@"), "{said}");
        }
    }
    assert_eq!(many.artifacts("cache").len(), 0);
}
