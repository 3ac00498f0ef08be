//! What code a stage is made of.
//!
//! A stage's artifact is stale when the code that made it changed, and only then. The table built here gives every
//! crate of the workspace a digest of its *tokens*, and every file of this crate one of its own. A stage names the file that holds
//! it; everything else follows from the sources: the files of this crate that this one uses, and those use in turn, the crates
//! that any of them names with everything below those, and the locked third-party crates. So a change in `atc`
//! makes the targets and the second training stale and leaves the first alone, and a comment changes nothing anywhere.
//!
//! The [engine](super) and the pipeline file's reader are not followed: they choose a stage's inputs and parameters and give it a folder,
//! and not one byte in the folder is theirs.
//!
//! Known limits: the compiler's version and its flags do not count (numbers are IEEE arithmetic in a fixed order), nor
//! do features switched on only by other crates of the build.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::OnceLock;

use serde::Deserialize;
use serde_json::Value;

use super::digest::{Digest, Encoder};

mod tokens;
mod tree;
mod uses;

/// The folder below `crates/` whose files a stage may name one by one.
const BY_FILE: &str = "pipeline";

/// Modules of that crate that write no byte of an artifact: what a stage uses of them is not followed.
const NOT_FOLLOWED: [&str; 2] = ["src/engine/", "src/config/"];

/// A crate that is named under a condition and is not in this build.
const ABSENT: &[&str] = if cfg!(feature = "nets") { &[] } else { &["use3d-nets"] };

/// Digests of the workspace's code; see the module.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
pub struct CodeTable {
    crates: BTreeMap<String, CrateCode>,
    files: BTreeMap<String, FileCode>,
}

#[derive(Clone, Debug, PartialEq, Deserialize)]
struct CrateCode {
    tokens: Digest,
    manifest: Digest,
    workspace: Vec<String>,
    third_party: BTreeMap<String, String>,
}

#[derive(Clone, Debug, PartialEq, Deserialize)]
struct FileCode {
    tokens: Digest,
    uses: Vec<String>,
    workspace: Vec<String>,
    third_party: BTreeMap<String, String>,
}

/// The code one stage is made of, spelled out.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct StageCode {
    /// Token digest of every crate (`use3d-splat`), of its dependency tables (`use3d-splat/Cargo.toml`) and of single
    /// files (`src/stages/import.rs`).
    pub ours: BTreeMap<String, Digest>,
    /// Version and checksum of every third-party crate below.
    pub third_party: BTreeMap<String, String>,
}

/// A tree whose code cannot be digested, or a stage that names code that is not there.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CodeError {
    /// The tree could not be read.
    #[error("cannot digest the source tree: {0}")]
    Tree(String),
    /// No such crate.
    #[error("no crate `{name}` in the workspace; there are: {known}")]
    NoCrate {
        /// The name asked for.
        name: String,
        /// The crates there are.
        known: String,
    },
    /// No such file.
    #[error("no source file or folder `{0}` in crates/pipeline; give a path like `src/stages/import.rs`")]
    NoFile(String),
}

impl CodeTable {
    /// The table of the tree that this program was built from.
    pub fn built_in() -> &'static Self {
        static TABLE: OnceLock<CodeTable> = OnceLock::new();
        TABLE.get_or_init(|| {
            let text = include_str!(concat!(env!("OUT_DIR"), "/code.json"));
            serde_json::from_str(text).expect("the build script wrote this table")
        })
    }

    /// The table of the workspace at `root` (a folder with `Cargo.toml`, `Cargo.lock` and `crates/`).
    pub fn of_tree(root: &Path) -> Result<Self, CodeError> {
        let table: Value = tree::read(root, BY_FILE).map_err(CodeError::Tree)?;
        serde_json::from_value(table).map_err(|e| CodeError::Tree(e.to_string()))
    }

    /// The names of the crates.
    pub fn crates(&self) -> impl Iterator<Item = &str> {
        self.crates.keys().map(String::as_str)
    }

    /// The files of the pipeline crate that count one by one.
    pub fn files(&self) -> impl Iterator<Item = &str> {
        self.files.keys().map(String::as_str)
    }

    /// The code of a stage made of `crates` (with everything below them) and of `sources`, files or folders of the
    /// pipeline crate such as `src/stages/import.rs` or `src/report`, with everything that these use.
    pub fn stage(&self, crates: &[&str], sources: &[&str]) -> Result<StageCode, CodeError> {
        let mut code = StageCode::default();
        let mut open: Vec<&str> = crates.to_vec();
        let mut files: Vec<&str> = Vec::new();
        for source in sources {
            let folder = format!("{}/", source.trim_end_matches('/'));
            let before = files.len();
            files.extend(self.files().filter(|path| path == source || path.starts_with(&folder)));
            if files.len() == before {
                return Err(CodeError::NoFile((*source).to_string()));
            }
        }
        while let Some(path) = files.pop() {
            let Some(file) = self.files.get(path) else { return Err(CodeError::NoFile(path.to_string())) };
            if code.ours.insert(path.to_string(), file.tokens).is_some() {
                continue;
            }
            unite(&mut code.third_party, &file.third_party);
            open.extend(file.workspace.iter().map(String::as_str).filter(|name| !ABSENT.contains(name)));
            let followed = |path: &&str| !NOT_FOLLOWED.iter().any(|folder| path.starts_with(folder));
            files.extend(file.uses.iter().map(String::as_str).filter(followed));
        }
        let mut seen = BTreeSet::new();
        while let Some(name) = open.pop() {
            if !seen.insert(name) {
                continue;
            }
            let known = || self.crates().collect::<Vec<_>>().join(", ");
            let found = self.crates.get(name);
            let found = found.ok_or_else(|| CodeError::NoCrate { name: name.to_string(), known: known() })?;
            code.ours.insert(name.to_string(), found.tokens);
            code.ours.insert(format!("{name}/Cargo.toml"), found.manifest);
            unite(&mut code.third_party, &found.third_party);
            open.extend(found.workspace.iter().map(String::as_str));
        }
        Ok(code)
    }
}

/// Adds versions of third-party crates; several of one crate are listed all.
fn unite(all: &mut BTreeMap<String, String>, more: &BTreeMap<String, String>) {
    for (name, versions) in more {
        let entry = all.entry(name.clone()).or_default();
        let mut union: BTreeSet<&str> = entry.split(", ").filter(|v| !v.is_empty()).collect();
        union.extend(versions.split(", "));
        *entry = union.into_iter().collect::<Vec<_>>().join(", ");
    }
}

impl StageCode {
    /// One digest for all of it.
    pub fn digest(&self) -> Digest {
        let mut encoder = Encoder::new("use3d 2026 stage code v1");
        encoder.number(self.ours.len() as u64);
        for (name, digest) in &self.ours {
            encoder.text(name).bytes(digest.as_bytes());
        }
        for (name, version) in &self.third_party {
            encoder.text(name).text(version);
        }
        encoder.finish()
    }
}

/// The digest of the code of a stage made of `crates`, in the workspace at `root`.
pub fn code_digest_of(root: &Path, crates: &[&str]) -> Result<Digest, CodeError> {
    Ok(CodeTable::of_tree(root)?.stage(crates, &[])?.digest())
}
