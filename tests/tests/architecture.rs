//! Enforces the dependencies of the architecture: a crate may depend only on crates below it and only on
//! crates that it uses, and heavy or delicate third-party crates stay in the crates that own them. The tests
//! read `cargo metadata`, so a forbidden dependency fails here at once. Every crate has a tier, and uses no
//! higher one. A type's name belongs to at most two files of the workspace. Inside a crate, at most two files
//! use each other in a circle.

#[path = "architecture/circles.rs"]
mod circles;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

use circles::{Arrows, ModulePath};
use serde_json::Value;

/// The permitted direct dependencies of each crate. ARCHITECTURE.md draws the same picture.
const ALLOWED: &[(&str, &[&str])] = &[
    ("numerics", &[]),
    ("tensors", &[]),
    ("files", &[]),
    ("archive", &[]),
    ("ply", &[]),
    ("capture", &["numerics"]),
    ("golden", &["capture", "numerics"]),
    ("code", &[]),
    ("workflow", &["capture", "code", "files"]),
    ("cluster", &["workflow"]),
    ("store", &["workflow"]),
    ("io-image", &["capture", "files"]),
    ("survey", &["capture", "numerics", "ply"]),
    ("io-colmap", &["capture", "files", "io-image", "survey"]),
    ("io-metashape", &["capture", "survey"]),
    ("io-nerfstudio", &["capture", "numerics", "survey"]),
    ("io-opensfm", &["capture", "numerics", "survey"]),
    ("io-realityscan", &["capture", "numerics", "survey"]),
    ("overlay", &["capture", "io-image"]),
    (
        "import",
        &[
            "capture",
            "files",
            "numerics",
            "io-image",
            "overlay",
            "survey",
            "io-colmap",
            "io-metashape",
            "io-nerfstudio",
            "io-opensfm",
            "io-realityscan",
        ],
    ),
    // It reads a table of times with the reader of tables in `survey`.
    ("prepare", &["archive", "capture", "files", "numerics", "io-image", "overlay", "survey", "io-colmap"]),
    ("check", &["capture", "numerics", "io-image", "survey", "import"]),
    ("metrics", &["capture", "numerics"]),
    ("nets", &["capture", "numerics"]),
    // It writes faulty captures in the form of `transforms.json` too.
    ("synth", &["capture", "files", "numerics", "io-image", "io-colmap", "io-nerfstudio", "survey"]),
    ("splat", &["capture", "numerics", "ply"]),
    ("medium", &["capture", "numerics"]),
    ("water", &["capture", "numerics"]),
    ("ubaf", &["capture", "numerics", "tensors"]),
    ("atc", &["capture", "numerics", "tensors", "splat"]),
    ("training", &["files", "numerics"]),
    ("scene", &["capture", "files", "numerics", "tensors", "splat", "medium", "ubaf"]),
    ("render", &["capture", "numerics", "splat", "medium", "ubaf", "scene"]),
    ("photographs", &["capture", "numerics", "survey", "render"]),
    ("reconstruct", &["capture", "numerics", "splat", "medium", "metrics", "training", "scene"]),
    ("web", &["capture", "numerics", "io-image", "splat", "medium", "ubaf", "scene"]),
    ("viewer", &["capture", "files", "scene", "render", "web"]),
    ("enhance", &["capture", "numerics", "splat", "ubaf", "atc", "training", "scene"]),
    ("chart", &["numerics"]),
    ("judge", &["capture", "numerics", "import", "metrics", "nets", "synth", "render"]),
    ("report", &["capture", "numerics", "io-image", "metrics", "judge"]),
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
    ("config", &["archive", "workflow", "import", "prepare"]),
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
        if ["use3d", "pipeline", "stages", "lab", "tests"].contains(&name.as_str()) {
            continue; // the roof may use everything below it, as far as its tier allows
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

/// The tiers, the lowest first: a crate uses its own tier and lower ones.
const TIERS: [&str; 5] = ["method", "formats", "engine", "application", "lab"];

/// The ground of the tier `engine`, which crates of every tier may use: whole files, named tensors, digests,
/// the vertices of PLY files, and archives.
const GROUND: [&str; 5] = ["files", "tensors", "code", "ply", "archive"];

/// The arrows to a higher tier, each with its reason.
const UPWARD: &[(&str, &str, &str)] = &[
    ("photographs", "survey", "a photograph's pixels are found through the lens that took it"),
    ("judge", "synth", "scores read a capture's truth"),
    ("use3d", "synth", "the verbs `synth` and `demo` make captures"),
    ("use3d", "lab", "the verb `bench` prints what the lab measures; no other crate uses it"),
];

/// The tier of every package, from the table in ARCHITECTURE.md.
fn tiers() -> BTreeMap<String, usize> {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../ARCHITECTURE.md");
    let text = std::fs::read_to_string(path).expect("the architecture");
    let rows = text.lines().skip_while(|line| *line != "| crate | tier | task |").skip(2);
    let row = |line: &str| {
        let mut cells = line.split('|').map(str::trim).skip(1);
        let name = cells.next().unwrap_or_default().trim_matches('`').to_string();
        let tier = cells.next().unwrap_or_default();
        let place = TIERS.iter().position(|known| *known == tier);
        let place = place.unwrap_or_else(|| panic!("`{name}`: `{tier}` is none of the tiers {TIERS:?}"));
        (if name == "cli" { "use3d".into() } else { name }, place)
    };
    rows.take_while(|line| line.starts_with('|')).map(row).collect()
}

#[test]
fn no_tier_uses_a_higher_one() {
    let (tiers, all) = (tiers(), dependencies());
    // The package of these tests has no code, and no tier.
    let crates: BTreeSet<&String> = all.keys().filter(|name| *name != "tests").collect();
    assert_eq!(tiers.keys().collect::<BTreeSet<_>>(), crates, "ARCHITECTURE.md names every crate once");
    assert!(GROUND.iter().all(|name| TIERS[tiers[*name]] == "engine"));
    let mut upward = BTreeSet::new();
    for (name, deps) in all.iter().filter(|(name, _)| *name != "tests") {
        let up = |dep: &&String| tiers.get(*dep).is_some_and(|tier| *tier > tiers[name]);
        let up = deps.iter().filter(up).filter(|dep| !GROUND.contains(&dep.as_str()));
        upward.extend(up.map(|dep| (name.as_str(), dep.as_str())));
    }
    let listed: BTreeSet<(&str, &str)> = UPWARD.iter().map(|(from, to, _)| (*from, *to)).collect();
    assert_eq!(upward, listed, "an arrow to a higher tier needs a reason, and a reason needs an arrow");
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
        let (shipped, build) = (source(folder, &["src"]), source(folder, &["build.rs", "src"]));
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
    let repeated: Vec<_> = files
        .iter()
        .filter(|(name, places)| !CONVENTIONAL.contains(&name.as_str()) && places.len() > 2)
        .collect();
    assert!(repeated.is_empty(), "rename these types so that at most two files share a name: {repeated:#?}");
}

/// The name and the folder `src` of every package.
fn sources() -> Vec<(String, PathBuf)> {
    let packages = metadata()["packages"].as_array().expect("packages").clone();
    let source = |package: &Value| {
        let name = package["name"].as_str().expect("a name");
        let manifest = PathBuf::from(package["manifest_path"].as_str().expect("a path"));
        let name = name.strip_prefix("use3d-").unwrap_or(name).to_string();
        (name, manifest.parent().expect("a folder").join("src"))
    };
    packages.iter().map(source).filter(|(_, folder)| folder.is_dir()).collect()
}

fn file_name(path: &ModulePath) -> String {
    if path.is_empty() { "(root)".to_string() } else { path.join("/") }
}

/// A reader of one file of a circle must read all of its files.
#[test]
fn no_more_than_two_files_of_a_crate_use_each_other_in_a_circle() {
    let (mut found, mut arrows) = (Vec::new(), 0);
    for (name, folder) in sources() {
        let uses = Arrows::of(&folder);
        arrows += uses.uses.values().map(BTreeSet::len).sum::<usize>();
        for circle in uses.circles(3) {
            let inside = |path: &&ModulePath| circle.contains(path);
            let lines = circle.iter().map(|path| {
                let to: Vec<String> = uses.uses[*path].iter().filter(inside).map(file_name).collect();
                format!("{} → {}", file_name(path), to.join(", "))
            });
            found.push(format!("{name}: {} files: {}", circle.len(), lines.collect::<Vec<_>>().join("; ")));
        }
    }
    assert!(arrows > 1500, "a reader that finds little proves little: {arrows} arrows");
    assert!(found.is_empty(), "move what several files need into a file of its own: {found:#?}");
}

/// The rooms of crates that have some: a room uses only the rooms before it. Files outside the rooms use no
/// room, except the root.
const ROOMS: &[(&str, &[&str])] = &[("workflow", &["cache", "share", "stage", "plan", "run"])];

#[test]
fn arrows_between_rooms_point_one_way() {
    let folders: BTreeMap<String, PathBuf> = sources().into_iter().collect();
    for (name, rooms) in ROOMS {
        let uses = Arrows::of(&folders[*name]).uses;
        let room = |path: &ModulePath| rooms.iter().position(|room| path.first().is_some_and(|p| p == room));
        for number in 0..rooms.len() {
            assert!(
                uses.keys().any(|path| room(path) == Some(number)),
                "`{name}` has no `{}`",
                rooms[number]
            );
        }
        for (from, to) in uses.iter().flat_map(|(from, all)| all.iter().map(move |to| (from, to))) {
            let wrong = !from.is_empty() && room(to) > room(from);
            assert!(!wrong, "`{name}`: {} must not use {}", file_name(from), file_name(to));
        }
    }
}
