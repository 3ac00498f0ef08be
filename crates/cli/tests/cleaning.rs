//! Tests that `gc` cleans the cache that the pipelines to keep name, and reports if that is not enough; and
//! that a plan names every stage once.

mod tiny;

use std::path::Path;
use std::process::Output;

fn use3d(dir: &Path, arguments: &[&str]) -> (Option<i32>, String) {
    let mut command = tiny::command();
    command.args(arguments).current_dir(dir).env("HOME", dir.join("home"));
    command.env_remove("USE3D_REMOTE").env_remove("XDG_CACHE_HOME");
    let Output { status, stdout, stderr } = command.output().expect("the command starts");
    (status.code(), format!("{}{}", String::from_utf8_lossy(&stdout), String::from_utf8_lossy(&stderr)))
}

#[test]
fn the_cache_of_the_pipelines_to_keep_is_the_one_that_is_cleaned() {
    let dir = tempfile::tempdir().expect("a folder");
    let dir = dir.path();
    tiny::capture(&dir.join("cap").to_string_lossy());
    for name in ["one", "two"] {
        let text = format!(
            "name = \"{name}\"\ncache = \"of-{name}\"\n[[scene]]\nname = \"cap\"\ncapture = \"cap\"\n"
        );
        std::fs::write(dir.join(format!("{name}.toml")), text).expect("written");
    }
    let (code, said) = use3d(dir, &["run", "one.toml", "--until", "import", "--cache-only"]);
    assert_eq!(code, Some(0), "{said}");
    let leftover = dir.join("of-one/v1/damaged/import-of-old");
    std::fs::create_dir_all(&leftover).expect("a folder");
    std::fs::write(leftover.join("file"), [0; 100]).expect("written");

    let (code, said) = use3d(dir, &["gc", "--max-bytes", "1kB", "--keep", "one.toml"]);
    assert!(code == Some(0) && said.contains("import-of-old") && !leftover.exists(), "{said}");
    assert!(said.contains("more than the 1.0 kB of --max-bytes"), "{said}");
    let (code, said) = use3d(dir, &["plan", "one.toml"]);
    assert!(code == Some(0) && said.contains("1 kept from before"), "what is kept was removed: {said}");

    let two = ["gc", "--older-than", "1d", "--keep", "one.toml", "--keep", "two.toml"];
    let (code, said) = use3d(dir, &two);
    assert!(code == Some(2) && said.contains("of-two") && said.contains("of-one"), "{said}");
    let (code, said) = use3d(dir, &[&two[..], &["--cache", "of-one"]].concat());
    assert!(code == Some(0), "{said}");
    assert!(!dir.join("home").exists(), "a cache that nobody named");

    for verb in [&["gc", "--max-bytes", "1kB"][..], &["verify"]] {
        let (code, said) = use3d(dir, &[verb, &["--cache", "of-onne"]].concat());
        assert!(code == Some(2) && said.contains("--cache of-onne: there is no such folder"), "{said}");
        assert!(!dir.join("of-onne").exists(), "a mistyped folder was made");
    }

    // Stage 1 is two inputs of the scores: the scene, and the geometry with which variants are compared.
    let (_, said) = use3d(dir, &["plan", "one.toml"]);
    let scores = said.lines().find(|line| line.contains("cap · evaluate: ")).expect("a line");
    assert_eq!(scores.matches("reconstruct").count(), 1, "{scores}");
    // The report waits for an artifact of every scene.
    let report = said.lines().find(|line| line.contains(" report: ")).expect("a line");
    assert!(report.contains(" more") && report.matches(',').count() == 3, "{report}");
    let (_, said) = use3d(dir, &["graph", "one.toml"]);
    let mut arrows: Vec<&str> = said.lines().filter(|line| line.contains("-->")).collect();
    let all = arrows.len();
    arrows.sort_unstable();
    arrows.dedup();
    assert!(all > 5 && arrows.len() == all, "{said}");
}

/// A nightly `gc` that cannot remove anything ends with an error code.
#[cfg(unix)]
#[test]
fn what_cannot_be_removed_ends_with_a_failure() {
    use std::os::unix::fs::PermissionsExt;

    let dir = tempfile::tempdir().expect("a folder");
    let damaged = dir.path().join("cache/v1/damaged");
    std::fs::create_dir_all(damaged.join("import-of-old")).expect("a folder");
    let allow = |mode| std::fs::set_permissions(&damaged, PermissionsExt::from_mode(mode)).expect("allowed");
    allow(0o500);
    let free = std::fs::write(damaged.join("probe"), "").is_ok();
    let (code, said) = use3d(dir.path(), &["gc", "--cache", "cache", "--max-bytes", "0"]);
    allow(0o700);
    if free {
        return; // this user has every right
    }
    assert!(code == Some(1) && said.contains("could not be removed"), "{said}");
    assert!(said.contains("cannot remove import-of-old") && !said.contains("--out"), "{said}");
}

/// An empty environment variable counts as unset, because scripts set variables that may be empty.
#[test]
fn a_variable_that_is_set_to_nothing_is_not_set() {
    let dir = tempfile::tempdir().expect("a folder");
    for variable in ["USE3D_CACHE", "USE3D_MODELS", "USE3D_THREADS", "USE3D_REMOTE"] {
        let mut command = tiny::command();
        command.args(["models", "--json"]).current_dir(dir.path()).env(variable, "");
        let output = command.output().expect("the command starts");
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!said.contains("a value is required"), "{variable}: {said}");
        let mut command = tiny::command();
        command.args(["verify", "--cache", "nowhere"]).current_dir(dir.path()).env(variable, "");
        let output = command.output().expect("the command starts");
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(said.contains("--cache nowhere: there is no such folder"), "{variable}: {said}");
    }
}

/// A cache in a capture folder and a results folder in a cache are refused.
#[test]
fn a_cache_is_in_no_capture_and_no_result_in_a_cache() {
    let dir = tempfile::tempdir().expect("a folder");
    tiny::capture(&dir.path().join("cap").to_string_lossy());
    for (arguments, words) in [
        (["--cache", "cap/cache", "--out", "out"], "would lie in the capture"),
        (["--cache", "cap", "--out", "out"], "would lie in the capture"),
        (["--cache", "cache", "--out", "cache"], "would lie in the cache"),
        (["--cache", "cache", "--out", "cap/../cache/v1/artifacts/out"], "would lie in the cache"),
    ] {
        let (code, said) = use3d(dir.path(), &[&["run", "cap"], &arguments[..]].concat());
        assert!(code == Some(2) && said.contains(words), "{arguments:?}: {said}");
    }
    assert!(!dir.path().join("cap/cache").exists() && !dir.path().join("cap/v1").exists());
}

/// A signal ends a command that keeps no partial result, and its unfinished folder is removed.
#[cfg(unix)]
#[test]
fn a_signal_ends_the_making_of_a_capture_and_nothing_is_left() {
    let dir = tempfile::tempdir().expect("a folder");
    let mut command = tiny::command();
    command.args(["-q", "synth", "capture", "--out", "cap", "--views", "20", "--size", "480x320"]);
    let mut child = command.current_dir(dir.path()).spawn().expect("the command starts");
    let entries = || std::fs::read_dir(dir.path()).expect("a folder").count();
    // The unfinished folder shows that the command has begun.
    while entries() == 0 {
        assert!(child.try_wait().expect("a state").is_none(), "it ended before it began");
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    std::process::Command::new("kill").args(["-INT", &child.id().to_string()]).status().expect("a signal");
    assert_eq!(child.wait().expect("it ends").code(), Some(130));
    assert_eq!(entries(), 0, "nothing is left");
}
