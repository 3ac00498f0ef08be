//! Enforces the dependencies of the architecture: a crate may depend only on crates below it and only on
//! crates that it uses, and heavy or delicate third-party crates stay in the crates that own them. The tests
//! read `cargo metadata`, so a forbidden dependency fails here at once.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;

/// The permitted direct dependencies of each crate. ARCHITECTURE.md draws the same picture.
const ALLOWED: &[(&str, &[&str])] = &[
    ("numerics", &[]),
    ("tensors", &[]),
    ("capture", &["numerics"]),
    ("golden", &["capture"]),
    ("build", &["capture"]),
    ("cluster", &["build"]),
    ("store", &["build"]),
    ("io-image", &["capture"]),
    ("survey", &["capture", "numerics"]),
    ("io-colmap", &["capture", "io-image", "survey"]),
    ("io-metashape", &["capture", "survey"]),
    ("io-nerfstudio", &["capture", "numerics", "survey"]),
    ("import", &["capture", "numerics", "io-image", "survey", "io-colmap", "io-metashape", "io-nerfstudio"]),
    ("prepare", &["capture", "io-image", "io-colmap"]),
    ("check", &["capture", "numerics", "io-image", "import"]),
    ("metrics", &["capture", "numerics"]),
    ("nets", &["capture", "numerics"]),
    ("synth", &["capture", "numerics", "io-image", "io-colmap"]),
    ("splat", &["capture", "numerics"]),
    ("medium", &["capture", "numerics"]),
    ("water", &["capture", "numerics"]),
    ("ubaf", &["capture", "numerics", "tensors"]),
    ("atc", &["capture", "numerics", "tensors", "splat"]),
    ("training", &["numerics"]),
    ("scene", &["capture", "numerics", "tensors", "splat", "medium", "ubaf"]),
    ("render", &["capture", "numerics", "splat", "medium", "ubaf", "scene"]),
    ("reconstruct", &["capture", "numerics", "splat", "medium", "metrics", "training", "scene"]),
    ("web", &["capture", "numerics", "io-image", "splat", "medium", "ubaf", "scene"]),
    ("viewer", &["capture", "scene", "render", "web"]),
    ("enhance", &["capture", "numerics", "splat", "ubaf", "atc", "training", "scene"]),
    (
        "gpu",
        &[
            "capture",
            "numerics",
            "splat",
            "medium",
            "metrics",
            "ubaf",
            "atc",
            "training",
            "scene",
            "reconstruct",
            "enhance",
        ],
    ),
];

/// Crates that may use these heavy or delicate third-party crates.
const RESERVED: &[(&str, &[&str])] = &[
    ("libm", &["numerics"]),
    ("pytorch-reader", &["nets"]),
    ("roxmltree", &["io-metashape"]),
    ("bincode", &["training"]),
    ("wgpu", &["gpu"]),
    ("jpeg-encoder", &["viewer"]),
    ("object_store", &["store"]),
    ("tokio", &["store"]),
    ("clap", &["use3d"]),
    ("indicatif", &["use3d"]),
];

fn metadata() -> Value {
    let output = Command::new(env!("CARGO"))
        .args(["metadata", "--format-version", "1", "--no-deps", "--offline"])
        .current_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
        .output()
        .expect("cargo metadata runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).expect("cargo metadata prints JSON")
}

/// Package name (without `use3d-`) to its normal and build dependencies.
fn dependencies() -> BTreeMap<String, Vec<String>> {
    let short = |name: &Value| {
        let name = name.as_str().expect("a name");
        name.strip_prefix("use3d-").unwrap_or(name).to_string()
    };
    metadata()["packages"]
        .as_array()
        .expect("packages")
        .iter()
        .map(|package| {
            let deps = package["dependencies"].as_array().expect("dependencies").iter();
            (
                short(&package["name"]),
                deps.filter(|d| d["kind"] != "dev").map(|d| short(&d["name"])).collect(),
            )
        })
        .collect()
}

#[test]
fn arrows_point_down() {
    let all = dependencies();
    for (name, deps) in &all {
        if ["use3d", "pipeline", "tests"].contains(&name.as_str()) {
            continue; // the roof may use everything below it
        }
        let allowed = ALLOWED.iter().find(|(n, _)| n == name);
        let (_, allowed) =
            allowed.unwrap_or_else(|| panic!("crate `{name}` is not in the architecture's table"));
        for dep in deps.iter().filter(|d| all.contains_key(*d)) {
            assert!(allowed.contains(&dep.as_str()), "`{name}` must not depend on `{dep}`");
        }
    }
    for (name, allowed) in ALLOWED {
        let Some(deps) = all.get(*name) else {
            panic!("the architecture's table names `{name}`, which does not exist")
        };
        for other in *allowed {
            let there = deps.iter().any(|dep| dep == other);
            assert!(there, "the architecture's table draws `{name}` → `{other}`, which no manifest has");
        }
    }
}

#[test]
fn heavy_crates_stay_where_they_belong() {
    for (name, deps) in dependencies() {
        for (reserved, owners) in RESERVED {
            assert!(
                !deps.iter().any(|d| d == reserved) || owners.contains(&name.as_str()),
                "`{name}` must not depend on `{reserved}`; only {owners:?} may"
            );
        }
    }
}

#[test]
fn every_crate_inherits_the_workspace_lints() {
    for package in metadata()["packages"].as_array().expect("packages") {
        let path = package["manifest_path"].as_str().expect("a path");
        let text = std::fs::read_to_string(path).expect("a manifest");
        assert!(text.contains("[lints]\nworkspace = true"), "{path} does not inherit the workspace lints");
    }
}

/// Rust text below `paths` of a crate, without comments.
fn source(folder: &Path, paths: &[&str]) -> String {
    let mut open: Vec<PathBuf> = paths.iter().map(|p| folder.join(p)).collect();
    let mut text = String::new();
    while let Some(path) = open.pop() {
        if path.is_dir() {
            open.extend(std::fs::read_dir(&path).expect("a folder").map(|e| e.expect("an entry").path()));
        } else if path.extension().is_some_and(|e| e == "rs") && path.exists() {
            let file = std::fs::read_to_string(&path).expect("a source file");
            file.lines().filter(|l| !l.trim_start().starts_with("//")).for_each(|l| {
                text.push_str(l);
                text.push('\n');
            });
        }
    }
    text
}

/// True if a text uses an item of a crate, as `name::…` or `use name`: a variable may have the same name.
fn names(text: &str, name: &str) -> bool {
    let part = |c: Option<char>| c.is_some_and(|c| c.is_alphanumeric() || c == '_');
    text.match_indices(name).any(|(at, _)| {
        let (before, after) = (&text[..at], &text[at + name.len()..]);
        let whole = !part(before.chars().next_back()) && !part(after.chars().next());
        whole && (after.starts_with("::") || before.ends_with("use "))
    })
}

/// An unused dependency costs build time. Here it also costs more: it is an ingredient of the keys of cached
/// results.
#[test]
fn every_declared_dependency_is_used() {
    let mut unused = Vec::new();
    for package in metadata()["packages"].as_array().expect("packages") {
        let manifest = PathBuf::from(package["manifest_path"].as_str().expect("a path"));
        let folder = manifest.parent().expect("a folder");
        let everywhere = source(folder, &["src", "tests", "examples", "benches"]);
        let (shipped, mut build) = (source(folder, &["src"]), source(folder, &["build.rs", "src"]));
        // A build script may take modules of another crate by their path.
        let taken: Vec<String> = build
            .split("#[path = \"")
            .skip(1)
            .filter_map(|rest| Some(rest.split('"').next()?.into()))
            .collect();
        build += &source(folder, &taken.iter().map(String::as_str).collect::<Vec<_>>());
        for dependency in package["dependencies"].as_array().expect("dependencies") {
            let name = dependency["rename"].as_str().or(dependency["name"].as_str()).expect("a name");
            let text = match dependency["kind"].as_str() {
                Some("dev") => &everywhere,
                Some("build") => &build,
                _ => &shipped,
            };
            if !names(text, &name.replace('-', "_")) {
                unused.push(format!("{}: {name}", manifest.display()));
            }
        }
    }
    assert!(unused.is_empty(), "remove from Cargo.toml what nothing names: {unused:#?}");
}
