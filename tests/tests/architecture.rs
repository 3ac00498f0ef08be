//! Enforces the dependencies of the architecture: a crate may depend only on crates below it and only on
//! crates that it uses, and heavy or delicate third-party crates stay in the crates that own them. The tests
//! read `cargo metadata`, so a forbidden dependency fails here at once. A type's name belongs to at most two
//! files of the workspace.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;

/// The permitted direct dependencies of each crate. ARCHITECTURE.md draws the same picture.
const ALLOWED: &[(&str, &[&str])] = &[
    ("numerics", &[]),
    ("tensors", &[]),
    ("files", &[]),
    ("capture", &["numerics"]),
    ("golden", &["capture", "numerics"]),
    ("build", &["capture", "files"]),
    ("cluster", &["build"]),
    ("store", &["build"]),
    ("io-image", &["capture", "files"]),
    ("survey", &["capture", "numerics"]),
    ("io-colmap", &["capture", "files", "io-image", "survey"]),
    ("io-metashape", &["capture", "survey"]),
    ("io-nerfstudio", &["capture", "numerics", "survey"]),
    ("io-opensfm", &["capture", "numerics", "survey"]),
    ("io-realityscan", &["capture", "numerics", "survey"]),
    (
        "import",
        &[
            "capture",
            "files",
            "numerics",
            "io-image",
            "survey",
            "io-colmap",
            "io-metashape",
            "io-nerfstudio",
            "io-opensfm",
            "io-realityscan",
        ],
    ),
    ("prepare", &["capture", "files", "numerics", "io-image", "io-colmap"]),
    ("check", &["capture", "numerics", "io-image", "import"]),
    ("metrics", &["capture", "numerics"]),
    ("nets", &["capture", "numerics"]),
    ("synth", &["capture", "files", "numerics", "io-image", "io-colmap"]),
    ("splat", &["capture", "numerics"]),
    ("medium", &["capture", "numerics"]),
    ("water", &["capture", "numerics"]),
    ("ubaf", &["capture", "numerics", "tensors"]),
    ("atc", &["capture", "numerics", "tensors", "splat"]),
    ("training", &["files", "numerics"]),
    ("scene", &["capture", "files", "numerics", "tensors", "splat", "medium", "ubaf"]),
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
    ("roxmltree", &["io-metashape", "io-realityscan"]),
    ("bincode", &["training"]),
    ("wgpu", &["gpu"]),
    ("ash", &["gpu"]),
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

/// Names that any number of files may define, because Rust programs use them by convention: a module's alias
/// of `Result`, a module's `Error`, and the parameters of a stage.
const CONVENTIONAL: &[&str] = &["Result", "Error", "Params"];

/// Names that more than two files still define, with the number of files. Their types are left to rename. The
/// list only shrinks: nothing is added to it, and a name leaves it when at most two files define it.
const LEFT_TO_RENAME: &[(&str, usize)] =
    &[("Folder", 3), ("Made", 3), ("Node", 3), ("Record", 3), ("Row", 3), ("Seen", 4)];

/// The name of the type that a line defines. An indented `type` is an item of a trait or of its
/// implementation, so it defines no type.
fn defined_type(line: &str) -> Option<&str> {
    let item = line.trim_start();
    let item = match item.strip_prefix("pub") {
        Some(rest) if rest.starts_with('(') => rest.split_once(") ")?.1,
        Some(rest) => rest.trim_start(),
        None => item,
    };
    let item = item.strip_prefix("unsafe ").unwrap_or(item);
    let (keyword, rest) = item.split_once(' ')?;
    let defines = match keyword {
        "struct" | "enum" | "trait" | "union" => true,
        "type" => !line.starts_with(char::is_whitespace),
        _ => false,
    };
    let end = rest.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(rest.len());
    (defines && end > 0).then(|| &rest[..end])
}

#[test]
fn a_definition_of_a_type_is_recognised() {
    assert_eq!(defined_type("pub struct Scene {"), Some("Scene"));
    assert_eq!(defined_type("    pub(in crate::plan) enum Step<'a> {"), Some("Step"));
    assert_eq!(defined_type("struct Film(PathBuf);"), Some("Film"));
    assert_eq!(defined_type("pub unsafe trait Pod: Copy {"), Some("Pod"));
    assert_eq!(defined_type("pub(crate) type Rows = Vec<f32>;"), Some("Rows"));
    for other in ["    type Item = u32;", "let structure = 1;", "fn struct_of() {}", "public struct X", ""] {
        assert_eq!(defined_type(other), None, "{other}");
    }
}

/// Files below `folder` whose names end in `.rs`.
fn rust_files(folder: &Path) -> Vec<PathBuf> {
    let (mut open, mut files) = (vec![folder.to_path_buf()], Vec::new());
    while let Some(path) = open.pop() {
        if path.is_dir() {
            open.extend(std::fs::read_dir(&path).expect("a folder").map(|e| e.expect("an entry").path()));
        } else if path.extension().is_some_and(|e| e == "rs") {
            files.push(path);
        }
    }
    files
}

/// A reader who meets a type's name should know which type it is.
#[test]
fn a_type_name_stands_in_at_most_two_files() {
    let mut files: BTreeMap<String, BTreeSet<PathBuf>> = BTreeMap::new();
    for package in metadata()["packages"].as_array().expect("packages") {
        let manifest = PathBuf::from(package["manifest_path"].as_str().expect("a path"));
        let sources = manifest.parent().expect("a folder").join("src");
        for path in rust_files(&sources) {
            let text = std::fs::read_to_string(&path).expect("a source file");
            for name in text.lines().filter_map(defined_type) {
                files.entry(name.to_string()).or_default().insert(path.clone());
            }
        }
    }
    assert!(files.len() > 1000, "{} names of types were found", files.len());
    let allowed = |name: &str| LEFT_TO_RENAME.iter().find(|(left, _)| *left == name).map_or(2, |(_, n)| *n);
    let repeated: Vec<_> = files
        .iter()
        .filter(|(name, places)| !CONVENTIONAL.contains(&name.as_str()) && places.len() > allowed(name))
        .collect();
    assert!(repeated.is_empty(), "rename these types so that at most two files share a name: {repeated:#?}");
    for (name, number) in LEFT_TO_RENAME {
        let found = files.get(*name).map_or(0, BTreeSet::len);
        assert!(
            found >= *number,
            "{found} files define `{name}`: LEFT_TO_RENAME must say so, or drop the name if at most two do"
        );
    }
}
