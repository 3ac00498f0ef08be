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
    assert!(code == Some(0) && said.contains("1 cached"), "what is kept was removed: {said}");

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
