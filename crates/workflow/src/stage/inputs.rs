//! The things outside its parameters that a stage can depend on: the files that the pipeline names, and the
//! inputs that exist.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// A path outside the pipeline, or the reason why it is not known.
pub type External = Result<PathBuf, String>;

/// The files that the pipeline names outside itself, for [`Stage::when_named`](crate::Stage::when_named): for
/// one scene, or for all scenes in a stage that is made once.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Named {
    /// By name: the path (or the reason why it is not known), and the place where the user named it.
    pub(crate) places: BTreeMap<String, (External, String)>,
}

impl Named {
    /// Returns true if the name is given, even if the file does not exist.
    pub fn has(&self, name: &str) -> bool {
        self.places.contains_key(name)
    }

    /// The path, if the name is given and its path is known.
    pub fn path(&self, name: &str) -> Option<&Path> {
        self.places.get(name)?.0.as_deref().ok()
    }

    /// The reason why the path of a given name is not known (a variable that is not set).
    pub fn problem(&self, name: &str) -> Option<&str> {
        self.places.get(name)?.0.as_ref().err().map(String::as_str)
    }

    /// The place where the user named it, for messages; empty if it is not named.
    pub fn by(&self, name: &str) -> &str {
        self.places.get(name).map_or("", |(_, by)| by)
    }
}

/// One input of a stage.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct StageInput {
    /// The role of the input in the stage.
    pub role: String,
    /// The file or folder, which the stage must not change.
    pub path: PathBuf,
    /// The scene it comes from, in a stage over all scenes; else empty.
    pub scene: String,
    /// The scene's group, else empty.
    pub group: String,
    /// The variant it comes from, else empty.
    pub variant: String,
}
