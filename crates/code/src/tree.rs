//! Reads a workspace's sources into a table of code digests. The build script runs this on its own source
//! tree; tests run it on copies of a tree.
//!
//! Each crate has a digest of its tokens: every `.rs` below `src/` and the build script count by their
//! tokens, other files below `src/` and `templates/` by their bytes, Markdown excepted. It also has a digest
//! of its dependency tables with the features they request, the crates of the workspace it depends on, and
//! name, version and checksum (from git: commit) of every third-party crate that it uses, directly or not. A
//! dependency by path outside `crates/` is refused, because no digest would cover its code.
//!
//! One crate also has these data per file, with the files and crates that each file uses, because its stages
//! do not use all of its files.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::{Path, PathBuf};

use proc_macro2::LexError;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value, json};
use walkdir::WalkDir;

use crate::digest::{Digest, Encoder};
use crate::tokens::{module_files, tokens_of};
use crate::uses::{modules, uses_of};

/// A part of a source tree whose code cannot be digested.
#[derive(Debug, thiserror::Error)]
pub enum TreeError {
    /// A file or folder cannot be read.
    #[error("{}: {}", .0.display(), .1)]
    Read(PathBuf, #[source] io::Error),
    /// A folder cannot be listed.
    #[error(transparent)]
    Walk(#[from] walkdir::Error),
    /// A manifest or the lock file is not TOML of the expected form.
    #[error("{}: {}", .0.display(), .1)]
    Toml(PathBuf, #[source] Box<toml::de::Error>),
    /// A source is not Rust, in the words of the compiler's lexer.
    #[error("{}: {}", .0.display(), .1)]
    Rust(PathBuf, String),
    /// A package outside `crates/`, which no digest would cover.
    #[error(
        "Cargo.lock: `{0}` comes from a path outside crates/, so its code is in no stage's digest; move it \
         below crates/, or use a registry or git"
    )]
    Outside(String),
}

const CONTEXT: &str = "use3d 2026 code digest v1";
const DEPENDENCY_TABLES: [&str; 2] = ["dependencies", "build-dependencies"];

/// The table of the workspace at `root`, as JSON:
/// `crates.<package>.{tokens, manifest, workspace, third_party}`, and
/// `files.<path>.{tokens, uses, workspace, third_party}` for the files of the crate in folder
/// `crates/<by_file>`.
///
/// # Errors
/// A source or manifest cannot be read, or a dependency comes from a path outside `crates/`.
pub fn read(root: &Path, by_file: &str) -> Result<Value, TreeError> {
    let workspace: Value = parse_toml(&root.join("Cargo.toml"))?;
    let inherited = workspace.pointer("/workspace/dependencies").cloned().unwrap_or_default();
    let lock: Lock = parse_toml(&root.join("Cargo.lock"))?;
    let mut crates = Map::new();
    let mut files = Map::new();
    let mut manifests = BTreeMap::new();
    for folder in crate_folders(root)? {
        let manifest: Value = parse_toml(&folder.join("Cargo.toml"))?;
        if let Some(name) = manifest.pointer("/package/name").and_then(Value::as_str) {
            manifests.insert(name.to_string(), (folder, manifest));
        }
    }
    for (name, (folder, manifest)) in &manifests {
        let ours = |n: &String| manifests.contains_key(n);
        let dependencies = dependency_tables(manifest, &inherited);
        let names: BTreeSet<String> = dependencies.values().flat_map(|t| t.keys().cloned()).collect();
        let sources = source_digests(folder)?;
        let mut tokens = Encoder::new(CONTEXT);
        for (path, digest) in &sources {
            tokens.text(path).bytes(digest.as_bytes());
        }
        if folder.file_name().is_some_and(|n| n == by_file) {
            let specs: Map<String, Value> =
                dependencies.values().flatten().map(|(n, s)| (n.clone(), s.clone())).collect();
            for (path, digest) in &sources {
                files.insert(path.clone(), file_entry(folder, path, digest, &sources, &specs, &ours, &lock)?);
            }
        }
        let features = manifest.get("features").cloned().unwrap_or_default();
        let edition = manifest.pointer("/package/edition").cloned().unwrap_or_default();
        let tables = json!([dependencies, features, edition]).to_string();
        let third_party = lock.closure(names.iter().filter(|n| !ours(n)).map(String::as_str))?;
        crates.insert(
            name.clone(),
            json!({
                "tokens": tokens.finish(),
                "manifest": Encoder::new(CONTEXT).text(&tables).finish(),
                "workspace": names.iter().filter(|n| ours(n)).collect::<Vec<_>>(),
                "third_party": third_party,
            }),
        );
    }
    Ok(json!({ "crates": crates, "files": files }))
}

/// The entry of one file of the crate whose files have digests of their own.
fn file_entry(
    folder: &Path,
    path: &str,
    digest: &Digest,
    sources: &BTreeMap<String, Digest>,
    dependencies: &Map<String, Value>,
    ours: &dyn Fn(&String) -> bool,
    lock: &Lock,
) -> Result<Value, TreeError> {
    const TEMPLATES: &str = "templates/";
    let mut tokens = Encoder::new(CONTEXT);
    tokens.bytes(digest.as_bytes());
    let (mut used, mut crates) = (BTreeSet::new(), Vec::new());
    if path.starts_with("src/") && path.ends_with(".rs") {
        let file = folder.join(path);
        let uses = uses_of(&text_of(&file)?).map_err(|e| TreeError::Rust(file, e.to_string()))?;
        used = uses.files(path, &modules(sources.keys()));
        crates = uses.crates(dependencies.keys());
        // Files that the compiler includes are named by literals, relative to the templates or to the source.
        let beside = path.rsplit_once('/').map_or("", |(parent, _)| parent);
        for literal in &uses.literals {
            let named = [format!("{TEMPLATES}{literal}"), format!("{beside}/{literal}")];
            used.extend(named.into_iter().filter(|name| name != path && sources.contains_key(name)));
        }
    } else if path.starts_with(TEMPLATES) {
        // Templates include each other by name.
        used.extend(sources.keys().filter(|other| other.starts_with(TEMPLATES) && *other != path).cloned());
    }
    // The requested features of a dependency may change its results.
    for name in &crates {
        tokens.text(&json!([name, dependencies.get(name.as_str())]).to_string());
    }
    let third_party = lock.closure(crates.iter().filter(|n| !ours(n)).map(|n| n.as_str()))?;
    Ok(json!({
        "tokens": tokens.finish(),
        "uses": used,
        "workspace": crates.iter().filter(|n| ours(n)).collect::<Vec<_>>(),
        "third_party": third_party,
    }))
}

/// The folders with a crate, directly below `crates/`.
///
/// # Errors
/// The folder cannot be read.
pub fn crate_folders(root: &Path) -> Result<Vec<PathBuf>, TreeError> {
    let crates = root.join("crates");
    let entries = std::fs::read_dir(&crates).map_err(|e| TreeError::Read(crates, e))?;
    let mut folders: Vec<PathBuf> =
        entries.filter_map(Result::ok).map(|e| e.path()).filter(|p| p.join("Cargo.toml").is_file()).collect();
    folders.sort();
    Ok(folders)
}

fn text_of(path: &Path) -> Result<String, TreeError> {
    std::fs::read_to_string(path).map_err(|e| TreeError::Read(path.to_path_buf(), e))
}

fn parse_toml<T: DeserializeOwned>(path: &Path) -> Result<T, TreeError> {
    toml::from_str(&text_of(path)?).map_err(|e| TreeError::Toml(path.to_path_buf(), Box::new(e)))
}

/// Digest of every source file of a crate by its path with `/`, without test-only files.
fn source_digests(folder: &Path) -> Result<BTreeMap<String, Digest>, TreeError> {
    let mut sources = BTreeMap::new();
    let mut test_only = BTreeSet::new();
    let starts = [folder.join("src"), folder.join("templates"), folder.join("build.rs")];
    for entry in starts.iter().filter(|p| p.exists()).flat_map(WalkDir::new) {
        let entry = entry?;
        let path = entry.path();
        if !path.is_file() || path.extension().is_some_and(|e| e == "md") {
            continue;
        }
        let content = if path.extension().is_some_and(|e| e == "rs") {
            let rust = |e: LexError| TreeError::Rust(path.to_path_buf(), e.to_string());
            let tokens = tokens_of(&text_of(path)?).map_err(rust)?;
            test_only.extend(tokens.test_modules.iter().flat_map(|m| module_files(path, m)));
            tokens.bytes
        } else {
            std::fs::read(path).map_err(|e| TreeError::Read(path.to_path_buf(), e))?
        };
        sources.insert(path.to_path_buf(), Encoder::new(CONTEXT).bytes(&content).finish());
    }
    // `#[cfg(test)] mod tests;` may name `tests.rs` or `tests/mod.rs`, which may have files of its own below.
    let folder_below = |file: &PathBuf| match file.ends_with("mod.rs") {
        true => file.parent().unwrap_or(file).to_path_buf(),
        false => file.with_extension(""),
    };
    let test_folders: Vec<PathBuf> =
        test_only.iter().filter(|p| sources.contains_key(*p)).map(folder_below).collect();
    let relative = |path: &Path| {
        let parts = path.strip_prefix(folder).unwrap_or(path).components();
        parts.map(|c| c.as_os_str().to_string_lossy().into_owned()).collect::<Vec<_>>().join("/")
    };
    Ok(sources
        .into_iter()
        .filter(|(path, _)| !test_only.contains(path) && !test_folders.iter().any(|f| path.starts_with(f)))
        .map(|(path, digest)| (relative(&path), digest))
        .collect())
}

/// The dependency tables that affect the compiled library, with `workspace = true` replaced by the
/// workspace's entry.
fn dependency_tables(manifest: &Value, inherited: &Value) -> BTreeMap<String, Map<String, Value>> {
    let mut tables = BTreeMap::new();
    let mut add = |prefix: &str, holder: &Value| {
        for kind in DEPENDENCY_TABLES {
            if let Some(table) = holder.get(kind).and_then(Value::as_object) {
                let resolved =
                    table.iter().map(|(name, spec)| (name.clone(), resolve(name, spec, inherited)));
                tables.insert(format!("{prefix}{kind}"), resolved.collect());
            }
        }
    };
    add("", manifest);
    for (target, holder) in manifest.get("target").and_then(Value::as_object).into_iter().flatten() {
        add(&format!("{target}."), holder);
    }
    tables
}

fn resolve(name: &str, spec: &Value, inherited: &Value) -> Value {
    let table = |value: &Value| match value {
        Value::Object(fields) => fields.clone(),
        version => Map::from_iter([("version".to_string(), version.clone())]),
    };
    let mut own = table(spec);
    if own.remove("workspace").is_some() {
        let mut base = inherited.get(name).map(table).unwrap_or_default();
        let mut features: BTreeSet<String> = BTreeSet::new();
        for list in [base.remove("features"), own.remove("features")].into_iter().flatten() {
            features
                .extend(list.as_array().into_iter().flatten().filter_map(|f| f.as_str().map(String::from)));
        }
        base.extend(own);
        base.insert("features".to_string(), json!(features));
        own = base;
    }
    own.remove("path");
    Value::Object(own)
}

/// The lock file: the versions of the third-party crates of this tree.
#[derive(Default, Deserialize)]
#[serde(default)]
struct Lock {
    package: Vec<Package>,
}

#[derive(Default, Deserialize)]
#[serde(default)]
struct Package {
    name: String,
    version: String,
    source: Option<String>,
    checksum: Option<String>,
    dependencies: Vec<String>,
}

impl Package {
    /// The origin that determines its contents: the start of the checksum, or the git address with the
    /// commit; `None` for a path.
    fn origin(&self) -> Option<String> {
        let source = self.source.as_ref()?;
        Some(self.checksum.as_ref().map_or_else(|| source.clone(), |sum| sum.chars().take(16).collect()))
    }
}

impl Lock {
    /// Name → "version origin" of everything reachable from the named packages; several versions of one name
    /// are all listed.
    fn closure<'a>(
        &self,
        names: impl Iterator<Item = &'a str>,
    ) -> Result<BTreeMap<String, String>, TreeError> {
        let mut open: Vec<String> = names.map(String::from).collect();
        let mut seen = BTreeSet::new();
        while let Some(entry) = open.pop() {
            let mut parts = entry.split(' ');
            let (name, version) = (parts.next().unwrap_or_default(), parts.next());
            let fits = |p: &&Package| p.name == name && version.is_none_or(|v| p.version == v);
            for (index, package) in self.package.iter().enumerate().filter(|(_, p)| fits(p)) {
                if seen.insert(index) {
                    open.extend(package.dependencies.iter().cloned());
                }
            }
        }
        let mut closure: BTreeMap<String, Vec<String>> = BTreeMap::new();
        for package in seen.into_iter().map(|i| &self.package[i]) {
            let origin = package.origin().ok_or_else(|| TreeError::Outside(package.name.clone()))?;
            let entry = format!("{} {origin}", package.version);
            closure.entry(package.name.clone()).or_default().push(entry);
        }
        Ok(closure.into_iter().map(|(name, versions)| (name, versions.join(", "))).collect())
    }
}
