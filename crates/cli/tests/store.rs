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
    assert!(code == Some(0) && said.contains(" 0 stages done,"), "{said}");
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

#[test]
fn a_store_is_listed_cleaned_up_and_only_read() {
    let many = Many::new(&["s1".to_string()]);
    let store = many.at("store").to_string_lossy().into_owned();
    let command = |verb: &str, cache: &str, words: &[&str]| {
        let mut command = many.command(&[verb], cache);
        command.args(["--remote", &store]).args(words);
        ended(command)
    };
    let of_store = |words: &[&str]| {
        let mut command = tiny::command();
        command.arg("store").args(words).args(["--remote", &store]);
        ended(command)
    };
    let (code, said) = of_store(&["ls"]);
    assert!(code == Some(1) && said.contains("there is no such folder"), "{said}");
    // Nothing is sent to a store that is only read; a store without an artifact is no failure of the run.
    fs::create_dir(&store).expect("folder");
    let (code, said) = command("run", "first", &["--cache-only", "--remote-read-only"]);
    assert!(code == Some(0) && !said.contains("--remote"), "{said}");
    assert!(tiny::files(store.as_ref()).is_empty());
    // An artifact that neither side has is missing: that fails a user who needs all of them.
    fs::remove_dir_all(many.at("first/v1/artifacts/report")).expect("removed");
    let (code, said) = command("push", "first", &["--all-or-fail"]);
    assert!(
        code == Some(1) && said.contains("1 artifact is missing, and --all-or-fail asks for all"),
        "{said}"
    );
    let (code, said) = command("pull", "second", &["--all-or-fail"]);
    assert!(code == Some(1) && said.contains("1 artifact is missing"), "{said}");
    assert_eq!(command("pull", "second", &[]).0, Some(0));
    let there = tiny::files(store.as_ref());
    let (code, said) = command("run", "third", &["--cache-only", "--remote-read-only"]);
    assert!(code == Some(0) && said.contains(" 1 stage done,"), "{said}");
    assert!(tiny::files(store.as_ref()) == there, "nothing was sent");

    let (code, said) = of_store(&["ls"]);
    assert!(code == Some(0) && said.contains("reconstruct  1\n") && said.contains(" artifacts, "), "{said}");
    let (_, said) = of_store(&["ls", "--json"]);
    let list: serde_json::Value = serde_json::from_str(&said).expect("JSON");
    assert_eq!(list["stages"]["reconstruct"], 1);
    // Young files stay, and so does what a pipeline uses.
    let (code, said) = of_store(&["gc", "--older-than", "1d"]);
    assert!(code == Some(0) && said.starts_with("removed 0 artifacts and 0 files"), "{said}");
    let (code, said) = of_store(&["gc", "--older-than", "1s", "--dry-run", "--json"]);
    let would: serde_json::Value = serde_json::from_str(&said).expect("JSON");
    assert!(code == Some(0) && would["dry_run"] == true, "{said}");
    let keep = many.at("many.toml").to_string_lossy().into_owned();
    let cache = many.at("nowhere").to_string_lossy().into_owned();
    let (code, said) = of_store(&["gc", "--older-than", "1s", "--keep", &keep, "--cache", &cache]);
    assert!(code == Some(2) && said.contains("are not in the cache"), "{said}");
    // A pipeline whose captures are elsewhere has unknown artifacts, and not none.
    fs::rename(many.at("s1"), many.at("elsewhere")).expect("renamed");
    let cache = many.at("first").to_string_lossy().into_owned();
    let (code, said) = of_store(&["gc", "--older-than", "1s", "--keep", &keep, "--cache", &cache]);
    assert!(code == Some(2) && said.contains("inputs are not on this machine"), "{said}");
    assert!(tiny::files(store.as_ref()) == there);
}
