//! Code digests on copies of a tree: comments change nothing, tokens only the stages that contain them.

use std::fs;
use std::path::Path;

use use3d_code::digest::Digest;
use use3d_code::{CodeError, CodeRules, CodeTable};

const RULES: CodeRules = CodeRules {
    by_file: "pipeline",
    not_followed: &["src/config/"],
    crates_not_followed: &["use3d-workflow"],
};

/// The digest of the code of a stage that depends on some crates.
fn code_digest_of(root: &Path, crates: &[&str]) -> Result<Digest, CodeError> {
    Ok(CodeTable::of_tree(root, RULES)?.stage(crates, &[])?.digest())
}

fn write(root: &Path, path: &str, text: &str) {
    let path = root.join(path);
    fs::create_dir_all(path.parent().expect("a folder")).expect("folder");
    fs::write(path, text).expect("file");
}

/// A small workspace: enhance → ubaf → numerics, splat → numerics; and the pipeline crate.
fn tree(root: &Path) {
    write(
        root,
        "Cargo.toml",
        "[workspace]\nmembers = [\"crates/*\"]\n[workspace.dependencies]\nuse3d-numerics = { path = \"crates/numerics\" }\n\
         use3d-ubaf = { path = \"crates/ubaf\" }\nrayon = \"1.12.0\"\nglam = { version = \"0.34\", features = [\"serde\"] }\n",
    );
    let package = |name: &str, dependencies: &str| {
        let folder = name.strip_prefix("use3d-").expect("a prefix");
        let text =
            format!("[package]\nname = \"{name}\"\nedition = \"2024\"\n[dependencies]\n{dependencies}");
        write(root, &format!("crates/{folder}/Cargo.toml"), &text);
    };
    package("use3d-numerics", "glam.workspace = true\n");
    package("use3d-ubaf", "use3d-numerics.workspace = true\nrayon.workspace = true\n");
    package("use3d-splat", "use3d-numerics.workspace = true\n");
    package("use3d-enhance", "use3d-ubaf.workspace = true\n");
    package("use3d-workflow", "");
    package(
        "use3d-pipeline",
        "use3d-enhance = { path = \"../enhance\" }\nuse3d-workflow = { path = \"../workflow\" }\n",
    );
    for name in ["numerics", "splat", "enhance", "workflow"] {
        write(
            root,
            &format!("crates/{name}/src/lib.rs"),
            &format!("//! Docs.\npub fn {name}() -> f32 {{ 1.0 }}\n"),
        );
    }
    write(
        root,
        "crates/ubaf/src/lib.rs",
        "//! Field.\nmod field;\n#[cfg(test)]\nmod tests;\npub fn ubaf(x: f32) -> f32 { field::twice(x) }\n",
    );
    write(root, "crates/ubaf/src/field.rs", "pub(crate) fn twice(x: f32) -> f32 { 2.0 * x }\n");
    write(root, "crates/ubaf/src/tests.rs", "#[test] fn t() {}\n");
    write(root, "crates/pipeline/src/stages/enhance.rs", "pub fn stage() {}\n");
    write(
        root,
        "crates/pipeline/src/stages/report.rs",
        "use crate::config::read; pub fn stage() { use3d_workflow::workflow(); read() }\n",
    );
    write(root, "crates/pipeline/src/config/mod.rs", "pub fn read() {}\n");
    let package = |name: &str, version: &str, dependencies: &str| {
        format!(
            "[[package]]\nname = \"{name}\"\nversion = \"{version}\"\nsource = \"registry+x\"\nchecksum = \"{name}\"\n\
             dependencies = [{dependencies}]\n"
        )
    };
    let mut lock = "version = 4\n".to_string();
    for name in ["numerics", "ubaf", "splat", "enhance", "pipeline", "workflow"] {
        lock.push_str(&format!("[[package]]\nname = \"use3d-{name}\"\nversion = \"0.1.0\"\n"));
    }
    lock.push_str(&package("glam", "0.34.2", "\"serde\""));
    lock.push_str(&package("serde", "1.0.229", ""));
    lock.push_str(&package("rayon", "1.12.0", "\"either\""));
    lock.push_str(&package("either", "1.15.0", ""));
    write(root, "Cargo.lock", &lock);
}

#[test]
fn a_token_reaches_exactly_the_stages_that_contain_it() {
    let dir = tempfile::tempdir().expect("folder");
    let root = dir.path();
    tree(root);
    let digests = || {
        let table = CodeTable::of_tree(root, RULES).expect("digests");
        let stage = |crates: &[&str], files: &[&str]| table.stage(crates, files).expect("code").digest();
        [
            stage(&["use3d-splat"], &[]),
            stage(&["use3d-ubaf"], &[]),
            stage(&["use3d-enhance"], &["src/stages/enhance.rs"]),
            stage(&["use3d-splat"], &["src/stages"]),
        ]
    };
    let base = digests();
    let edit = |path: &str, from: &str, to: &str| {
        let text = fs::read_to_string(root.join(path)).expect("text");
        assert!(text.contains(from), "{path}: {from}");
        fs::write(root.join(path), text.replace(from, to)).expect("file");
    };
    let changed = |what: &str| {
        let now = digests();
        let list: Vec<usize> = (0..4).filter(|i| now[*i] != base[*i]).collect();
        println!("{what}: {list:?}");
        list
    };
    let none: Vec<usize> = Vec::new();
    for (path, from, to, expected) in [
        ("crates/ubaf/src/field.rs", "2.0 * x", "2.0 * x // twice\n", &none),
        ("crates/ubaf/src/field.rs", "pub(crate)", "/// Twice.\npub(crate)", &none),
        ("crates/ubaf/src/field.rs", "{ 2.0 * x }", "{\n    2.0   *x\n}", &none),
        ("crates/ubaf/src/tests.rs", "fn t() {}", "fn t() { assert!(true) }", &none),
        ("crates/pipeline/src/config/mod.rs", "read()", "take()", &none),
        ("crates/workflow/src/lib.rs", "workflow()", "work()", &none),
        ("crates/ubaf/src/field.rs", "2.0 * x", "x + x", &vec![1, 2]),
        ("crates/ubaf/src/lib.rs", "field::twice(x)", "field::twice(x + 1.0)", &vec![1, 2]),
        ("crates/numerics/src/lib.rs", "1.0", "1.5", &vec![0, 1, 2, 3]),
        ("crates/pipeline/src/stages/enhance.rs", "stage()", "stage2()", &vec![2, 3]),
        ("crates/pipeline/src/stages/report.rs", "stage()", "stage2()", &vec![3]),
        ("Cargo.lock", "1.15.0", "1.15.1", &vec![1, 2]),
        ("Cargo.lock", "1.0.229", "1.0.230", &vec![0, 1, 2, 3]),
        ("Cargo.toml", "features = [\"serde\"]", "features = [\"serde\", \"mint\"]", &vec![0, 1, 2, 3]),
        ("crates/ubaf/Cargo.toml", "edition = \"2024\"", "edition = \"2021\"", &vec![1, 2]),
    ] {
        edit(path, from, to);
        assert_eq!(&changed(&format!("{path}: {from} → {to}")), expected);
        edit(path, to, from);
        assert_eq!(changed("undone"), none);
    }
    // Moving the whole tree changes nothing.
    let other = tempfile::tempdir().expect("folder");
    tree(other.path());
    let of = |root: &Path| code_digest_of(root, &["use3d-enhance"]).expect("digest");
    assert_eq!(of(root), of(other.path()));
    let missing = code_digest_of(root, &["use3d-absent"]).expect_err("absent").to_string();
    assert!(missing.contains("use3d-ubaf"), "{missing}");
}

#[test]
fn a_patched_dependency_counts_by_its_commit_and_from_a_path_is_refused() {
    let dir = tempfile::tempdir().expect("folder");
    let root = dir.path();
    tree(root);
    let lock = fs::read_to_string(root.join("Cargo.lock")).expect("lock");
    let from_registry = "source = \"registry+x\"\nchecksum = \"either\"\n";
    assert!(lock.contains(from_registry), "{lock}");
    let with = |source: &str| {
        write(root, "Cargo.lock", &lock.replace(from_registry, source));
        code_digest_of(root, &["use3d-ubaf"])
    };
    let digests: Vec<_> =
        [from_registry, "source = \"git+https://x/either#1a\"\n", "source = \"git+https://x/either#2b\"\n"]
            .map(|source| with(source).expect("digest"))
            .into();
    assert!(digests[0] != digests[1] && digests[1] != digests[2], "{digests:?}");
    let message = with("").expect_err("a path").to_string();
    assert!(message.contains("`either` comes from a path outside crates/"), "{message}");
}
