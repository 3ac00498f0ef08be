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
use std::path::{Path, PathBuf};

use serde_json::{Map, Value, json};
use walkdir::WalkDir;

use crate::tokens::{module_files, tokens_of};
use crate::uses::{modules, uses_of};

const CONTEXT: &str = "use3d 2026 code digest v1";
const DEPENDENCY_TABLES: [&str; 2] = ["dependencies", "build-dependencies"];

/// The table of the workspace at `root`, as JSON:
/// `crates.<package>.{tokens, manifest, workspace, third_party}`, and
/// `files.<path>.{tokens, uses, workspace, third_party}` for the files of the crate in folder
/// `crates/<by_file>`.
///
/// # Errors
/// A source or manifest cannot be read, or a dependency comes from a path outside `crates/`.
pub fn read(root: &Path, by_file: &str) -> Result<Value, String> {
    let workspace = parse_toml(&root.join("Cargo.toml"))?;
    let inherited = workspace.pointer("/workspace/dependencies").cloned().unwrap_or_default();
    let lock = Lock::read(&root.join("Cargo.lock"))?;
    let mut crates = Map::new();
    let mut files = Map::new();
    let mut manifests = BTreeMap::new();
    for folder in crate_folders(root)? {
        let manifest = parse_toml(&folder.join("Cargo.toml"))?;
        if let Some(name) = manifest.pointer("/package/name").and_then(Value::as_str) {
            manifests.insert(name.to_string(), (folder, manifest));
        }
    }
    for (name, (folder, manifest)) in &manifests {
        let ours = |n: &String| manifests.contains_key(n);
        let dependencies = dependency_tables(manifest, &inherited);
        let names: BTreeSet<String> = dependencies.values().flat_map(|t| t.keys().cloned()).collect();
        let sources = source_digests(folder)?;
        let mut tokens = blake3::Hasher::new_derive_key(CONTEXT);
        for (path, digest) in &sources {
            field(&mut tokens, path.as_bytes());
            field(&mut tokens, digest.as_bytes());
        }
        if folder.file_name().is_some_and(|n| n == by_file) {
            let specs: Map<String, Value> =
                dependencies.values().flatten().map(|(n, s)| (n.clone(), s.clone())).collect();
            for (path, digest) in &sources {
                files.insert(path.clone(), file_entry(folder, path, digest, &sources, &specs, &ours, &lock)?);
            }
        }
        let mut tables = blake3::Hasher::new_derive_key(CONTEXT);
        let features = manifest.get("features").cloned().unwrap_or_default();
        let edition = manifest.pointer("/package/edition").cloned().unwrap_or_default();
        field(&mut tables, json!([dependencies, features, edition]).to_string().as_bytes());
        let third_party = lock.closure(names.iter().filter(|n| !ours(n)).map(String::as_str))?;
        crates.insert(
            name.clone(),
            json!({
                "tokens": tokens.finalize().to_hex().as_str(),
                "manifest": tables.finalize().to_hex().as_str(),
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
    digest: &blake3::Hash,
    sources: &BTreeMap<String, blake3::Hash>,
    dependencies: &Map<String, Value>,
    ours: &dyn Fn(&String) -> bool,
    lock: &Lock,
) -> Result<Value, String> {
    const TEMPLATES: &str = "templates/";
    let mut tokens = blake3::Hasher::new_derive_key(CONTEXT);
    field(&mut tokens, digest.as_bytes());
    let (mut used, mut crates) = (BTreeSet::new(), Vec::new());
    if path.starts_with("src/") && path.ends_with(".rs") {
        let file = folder.join(path);
        let text = std::fs::read_to_string(&file).map_err(|e| format!("{}: {e}", file.display()))?;
        let uses = uses_of(&text).map_err(|e| format!("{}: {e}", file.display()))?;
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
        field(&mut tokens, json!([name, dependencies.get(name.as_str())]).to_string().as_bytes());
    }
    let third_party = lock.closure(crates.iter().filter(|n| !ours(n)).map(|n| n.as_str()))?;
    Ok(json!({
        "tokens": tokens.finalize().to_hex().as_str(),
        "uses": used,
        "workspace": crates.iter().filter(|n| ours(n)).collect::<Vec<_>>(),
        "third_party": third_party,
    }))
}

/// The folders with a crate, directly below `crates/`.
///
/// # Errors
/// The folder cannot be read.
pub fn crate_folders(root: &Path) -> Result<Vec<PathBuf>, String> {
    let crates = root.join("crates");
    let entries = std::fs::read_dir(&crates).map_err(|e| format!("{}: {e}", crates.display()))?;
    let mut folders: Vec<PathBuf> =
        entries.filter_map(Result::ok).map(|e| e.path()).filter(|p| p.join("Cargo.toml").is_file()).collect();
    folders.sort();
    Ok(folders)
}

fn field(hasher: &mut blake3::Hasher, bytes: &[u8]) {
    hasher.update(&(bytes.len() as u64).to_le_bytes());
    hasher.update(bytes);
}

fn parse_toml(path: &Path) -> Result<Value, String> {
    let text = std::fs::read_to_string(path).map_err(|e| format!("{}: {e}", path.display()))?;
    toml::from_str(&text).map_err(|e| format!("{}: {e}", path.display()))
}

/// Digest of every source file of a crate by its path with `/`, without test-only files.
fn source_digests(folder: &Path) -> Result<BTreeMap<String, blake3::Hash>, String> {
    let mut sources = BTreeMap::new();
    let mut test_only = BTreeSet::new();
    let starts = [folder.join("src"), folder.join("templates"), folder.join("build.rs")];
    for entry in starts.iter().filter(|p| p.exists()).flat_map(WalkDir::new) {
        let entry = entry.map_err(|e| e.to_string())?;
        let path = entry.path();
        if !path.is_file() || path.extension().is_some_and(|e| e == "md") {
            continue;
        }
        let content = std::fs::read(path).map_err(|e| format!("{}: {e}", path.display()))?;
        let mut hasher = blake3::Hasher::new_derive_key(CONTEXT);
        if path.extension().is_some_and(|e| e == "rs") {
            let text = String::from_utf8(content).map_err(|e| format!("{}: {e}", path.display()))?;
            let tokens = tokens_of(&text).map_err(|e| format!("{}: {e}", path.display()))?;
            test_only.extend(tokens.test_modules.iter().flat_map(|m| module_files(path, m)));
            field(&mut hasher, &tokens.bytes);
        } else {
            field(&mut hasher, &content);
        }
        sources.insert(path.to_path_buf(), hasher.finalize());
    }
    // `#[cfg(test)] mod tests;` may name `tests.rs` or `tests/mod.rs`, which may have files of its own below.
    let test_folders: Vec<PathBuf> =
        test_only
            .iter()
            .filter(|p| sources.contains_key(*p))
            .map(|p| {
                if p.ends_with("mod.rs") {
                    p.parent().unwrap_or(p).to_path_buf()
                } else {
                    p.with_extension("")
                }
            })
            .collect();
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
struct Lock {
    packages: Vec<Package>,
}

struct Package {
    name: String,
    version: String,
    /// The origin that determines its contents: the start of the checksum, or the git address with the
    /// commit; `None` for a path.
    origin: Option<String>,
    dependencies: Vec<String>,
}

impl Lock {
    fn read(path: &Path) -> Result<Self, String> {
        let lock = parse_toml(path)?;
        let text = |p: &Value, key: &str| p.get(key).and_then(Value::as_str).unwrap_or_default().to_string();
        let packages = lock.get("package").and_then(Value::as_array).into_iter().flatten().map(|p| Package {
            name: text(p, "name"),
            version: text(p, "version"),
            origin: p.get("source").and_then(Value::as_str).map(|source| match p.get("checksum") {
                Some(_) => text(p, "checksum").chars().take(16).collect(),
                None => source.to_string(),
            }),
            dependencies: p
                .get("dependencies")
                .and_then(Value::as_array)
                .into_iter()
                .flatten()
                .filter_map(|d| d.as_str().map(String::from))
                .collect(),
        });
        Ok(Self { packages: packages.collect() })
    }

    /// Name → "version origin" of everything reachable from the named packages; several versions of one name
    /// are all listed.
    fn closure<'a>(&self, names: impl Iterator<Item = &'a str>) -> Result<BTreeMap<String, String>, String> {
        let mut open: Vec<String> = names.map(String::from).collect();
        let mut seen = BTreeSet::new();
        while let Some(entry) = open.pop() {
            let mut parts = entry.split(' ');
            let (name, version) = (parts.next().unwrap_or_default(), parts.next());
            let fits = |p: &&Package| p.name == name && version.is_none_or(|v| p.version == v);
            for (index, package) in self.packages.iter().enumerate().filter(|(_, p)| fits(p)) {
                if seen.insert(index) {
                    open.extend(package.dependencies.iter().cloned());
                }
            }
        }
        let mut closure: BTreeMap<String, Vec<String>> = BTreeMap::new();
        for package in seen.into_iter().map(|i| &self.packages[i]) {
            let origin = package.origin.as_ref().ok_or_else(|| {
                format!(
                    "Cargo.lock: `{}` comes from a path outside crates/, so its code is in no stage's \
                     digest; move it below crates/, or use a registry or git",
                    package.name
                )
            })?;
            let entry = format!("{} {origin}", package.version);
            closure.entry(package.name.clone()).or_default().push(entry);
        }
        Ok(closure.into_iter().map(|(name, versions)| (name, versions.join(", "))).collect())
    }
}
