//! The code that a stage depends on, as digests.
//!
//! A stage's artifact is stale when the code that made it changed, and only then. The table built here has a
//! digest of the *tokens* of every crate of the workspace, and one of every file of the crate that holds the
//! stages. A stage names the file that holds it; the rest follows from the sources: the files of that crate
//! that this file uses directly or through others, the crates that any of them names with all their
//! dependencies, and the locked third-party crates. So a change in one method's crate makes only those stages
//! stale that use it, and a change of a comment makes none stale.
//!
//! The parts that [`CodeRules`] leaves out do not count, nor does the inline module [`DEFINITION`] of a
//! stage's file: they choose a stage's inputs and parameters and provide its folder, but they write no byte
//! in the folder.
//!
//! A build script makes the table of its own source tree with [`tree::read`], and the program reads it with
//! [`CodeTable::stored`]. The [`digest`]s are those of everything else that is digested, too.
//!
//! Known limits: the compiler's version and its flags do not count (numbers are IEEE arithmetic in a fixed
//! order), nor do features switched on only by other crates of the build.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use serde::Deserialize;

pub mod digest;
mod tokens;
pub mod tree;
mod uses;

use digest::{Digest, Encoder};

/// The name of the inline module in a stage's file that says what the stage reads, when it runs and what it
/// needs. All of that is in its key already: as its inputs and its parameters.
pub const DEFINITION: &str = "definition";

/// The rules by which a workspace's code is assigned to stages.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CodeRules {
    /// The folder below `crates/` of the crate that holds the stages: its files have digests of their own.
    pub by_file: &'static str,
    /// Files and folders (`src/config/`) of that crate that write no byte of an artifact: if a stage uses
    /// them, they do not count.
    pub not_followed: &'static [&'static str],
    /// Crates that write no byte of an artifact, such as the build system: if a file of that crate uses them,
    /// they do not count.
    pub crates_not_followed: &'static [&'static str],
}

/// Digests of the workspace's code; see the module.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
pub struct CodeTable {
    #[serde(skip)]
    rules: CodeRules,
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

/// The digests of the code of one stage.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct StageCode {
    /// Token digest of every crate (`use3d-splat`), of its dependency tables (`use3d-splat/Cargo.toml`) and
    /// of single files (`src/stages/import.rs`).
    pub ours: BTreeMap<String, Digest>,
    /// Version and checksum of every third-party crate that it uses, directly or not.
    pub third_party: BTreeMap<String, String>,
}

/// A source tree whose code cannot be digested, or a stage that names code that does not exist.
#[derive(Debug, thiserror::Error)]
pub enum CodeError {
    /// The tree could not be read.
    #[error("cannot digest the source tree: {0}")]
    Tree(#[from] tree::TreeError),
    /// The table that was stored is not one.
    #[error("cannot digest the source tree: {0}")]
    Stored(#[from] serde_json::Error),
    /// There is no such crate.
    #[error("no crate `{name}` in the workspace; there are: {known}")]
    NoCrate {
        /// The name that was given.
        name: String,
        /// The crates of the workspace.
        known: String,
    },
    /// There is no such file.
    #[error("no source file or folder `{path}` in crates/{by_file}; give a path like `src/stages/import.rs`")]
    NoFile {
        /// The path that was given.
        path: String,
        /// The crate whose files have digests of their own.
        by_file: &'static str,
    },
}

impl CodeTable {
    /// Parses the table that a build script wrote about its own source tree.
    ///
    /// # Errors
    /// The text is not such a table.
    pub fn stored(text: &str, rules: CodeRules) -> Result<Self, CodeError> {
        let table: Self = serde_json::from_str(text)?;
        Ok(Self { rules, ..table })
    }

    /// The table of the workspace at `root` (a folder with `Cargo.toml`, `Cargo.lock` and `crates/`).
    ///
    /// # Errors
    /// The source tree cannot be read.
    pub fn of_tree(root: &Path, rules: CodeRules) -> Result<Self, CodeError> {
        Self::stored(&tree::read(root, rules.by_file)?.to_string(), rules)
    }

    /// The names of the crates.
    pub fn crates(&self) -> impl Iterator<Item = &str> {
        self.crates.keys().map(String::as_str)
    }

    /// The files that have digests of their own.
    pub fn files(&self) -> impl Iterator<Item = &str> {
        self.files.keys().map(String::as_str)
    }

    /// The code of a stage that depends on `crates` (with all their dependencies) and on `sources`, with
    /// everything that these use. The sources are files or folders of the crate that holds the stages, such
    /// as `src/stages/import.rs` or `src/report`.
    ///
    /// # Errors
    /// The code does not exist.
    pub fn stage(&self, crates: &[&str], sources: &[&str]) -> Result<StageCode, CodeError> {
        let CodeRules { by_file, not_followed, crates_not_followed } = self.rules;
        let no_file = |path: &str| CodeError::NoFile { path: path.to_string(), by_file };
        let mut code = StageCode::default();
        let mut open: Vec<&str> = crates.to_vec();
        let mut files: Vec<&str> = Vec::new();
        for source in sources {
            let folder = format!("{}/", source.trim_end_matches('/'));
            let before = files.len();
            files.extend(self.files().filter(|path| path == source || path.starts_with(&folder)));
            if files.len() == before {
                return Err(no_file(source));
            }
        }
        while let Some(path) = files.pop() {
            let Some(file) = self.files.get(path) else { return Err(no_file(path)) };
            if code.ours.insert(path.to_string(), file.tokens).is_some() {
                continue;
            }
            unite(&mut code.third_party, &file.third_party);
            let counts = |name: &&str| !crates_not_followed.contains(name);
            open.extend(file.workspace.iter().map(String::as_str).filter(counts));
            let followed = |path: &&str| !not_followed.iter().any(|left| path.starts_with(left));
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

/// Merges versions of third-party crates; several versions of one crate are all listed.
fn unite(all: &mut BTreeMap<String, String>, more: &BTreeMap<String, String>) {
    for (name, versions) in more {
        let entry = all.entry(name.clone()).or_default();
        let mut union: BTreeSet<&str> = entry.split(", ").filter(|v| !v.is_empty()).collect();
        union.extend(versions.split(", "));
        *entry = union.into_iter().collect::<Vec<_>>().join(", ");
    }
}

impl StageCode {
    /// One digest for all of the code.
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
