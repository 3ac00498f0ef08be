//! The file that is written beside every artifact: its origin and its list of files.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::cache::joined;
use crate::cache::key::{Ingredients, Key};
use crate::cache::machine::{self, Machine};
use use3d_code::digest::{Digest, Encoder};

/// The manifest's file name; no payload file of an artifact has it.
pub const MANIFEST: &str = "manifest.json";
pub(crate) const FORMAT: &str = "use3d artifact";
const CONTEXT: &str = "use3d 2026 artifact content v1";

/// A file of an artifact.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FileRecord {
    /// Its path in the artifact, `/` between folders.
    pub path: String,
    /// Its size, bytes.
    pub size: u64,
    /// The digest of its bytes.
    pub digest: Digest,
}

/// Measurements of a stage that do not follow from its inputs, such as times, by name. They are kept in the
/// manifest beside the duration, and are no part of the artifact or its digest.
pub type Notes = BTreeMap<String, serde_json::Value>;

/// The node for which an artifact was made first. Not part of any key.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct MadeFor {
    /// The pipeline.
    pub pipeline: String,
    /// The scene; empty for stages over all scenes.
    pub scene: String,
    /// The variant; empty where there are none.
    pub variant: String,
}

impl std::fmt::Display for MadeFor {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&joined(&[&self.pipeline, &self.scene, &self.variant], " · "))
    }
}

/// `manifest.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// Always "use3d artifact".
    pub format: String,
    /// Schema number of this file.
    pub schema: u32,
    /// The artifact's key.
    pub key: Key,
    /// The ingredients of the key.
    pub ingredients: Ingredients,
    /// The digest of all files together.
    pub content: Digest,
    /// The files, sorted by path.
    pub files: Vec<FileRecord>,
    /// The program's version.
    pub tool: String,
    /// Time when it was finished (UTC).
    pub finished: String,
    /// Duration in seconds.
    pub seconds: f64,
    /// Seconds of the processor that its threads used; 0 where unknown.
    #[serde(default)]
    pub processor_seconds: f64,
    /// Share of the work that was found in checkpoints.
    #[serde(default)]
    pub resumed: f64,
    /// Number of its threads.
    pub threads: usize,
    /// The most memory that the process held meanwhile, in bytes; 0 where unknown.
    pub peak_memory: u64,
    /// The machine that made it.
    pub machine: Machine,
    /// The node that it was made for.
    pub made_for: MadeFor,
    /// Measurements of the stage that do not follow from its inputs.
    #[serde(default, skip_serializing_if = "Notes::is_empty")]
    pub notes: Notes,
}

/// Duration, machine load and origin of an artifact: the part of a manifest that does not determine the
/// content.
#[derive(Clone, Debug, Default)]
pub(crate) struct Circumstances {
    pub(crate) seconds: f64,
    pub(crate) processor_seconds: f64,
    pub(crate) resumed: f64,
    pub(crate) threads: usize,
    pub(crate) peak_memory: u64,
    pub(crate) made_for: MadeFor,
    pub(crate) notes: Notes,
}

/// A manifest that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ManifestError {
    /// It is not a manifest.
    #[error("{MANIFEST} is damaged: {0}")]
    Damaged(#[from] serde_json::Error),
    /// It has this format and version instead.
    #[error("{MANIFEST} has format `{0}` {1}")]
    Format(String, u32),
    /// Its key or its content has another digest.
    #[error("{MANIFEST} does not fit its own digests")]
    Digests,
}

impl Manifest {
    pub(crate) fn new(ingredients: Ingredients, files: Vec<FileRecord>, how: Circumstances) -> Self {
        Self {
            format: FORMAT.to_string(),
            schema: 1,
            key: ingredients.key(),
            ingredients,
            content: content_digest(&files),
            files,
            tool: format!("use3d {}", env!("CARGO_PKG_VERSION")),
            finished: machine::utc(machine::now()),
            seconds: how.seconds,
            processor_seconds: how.processor_seconds,
            resumed: how.resumed,
            threads: how.threads,
            peak_memory: how.peak_memory,
            machine: Machine::this(),
            made_for: how.made_for,
            notes: how.notes,
        }
    }

    /// Parses and checks what can be checked without the files.
    ///
    /// # Errors
    /// Another format, another key, or digests that do not match.
    pub fn parse(bytes: &[u8], key: Key) -> Result<Self, ManifestError> {
        let manifest: Self = serde_json::from_slice(bytes)?;
        if manifest.format != FORMAT || manifest.schema != 1 {
            return Err(ManifestError::Format(manifest.format, manifest.schema));
        }
        let (keys, content) = ([manifest.key, manifest.ingredients.key()], content_digest(&manifest.files));
        if keys != [key; 2] || manifest.content != content {
            return Err(ManifestError::Digests);
        }
        Ok(manifest)
    }

    /// Bytes in all files together. A manifest from elsewhere may announce any sizes.
    pub fn bytes(&self) -> u64 {
        self.files.iter().fold(0, |sum, file| sum.saturating_add(file.size))
    }

    /// The duration of the stage without checkpoints to start from, in seconds.
    pub fn full_seconds(&self) -> f64 {
        self.whole(self.seconds)
    }

    /// The seconds of the processor without checkpoints to start from; `None` where unknown.
    pub fn full_processor_seconds(&self) -> Option<f64> {
        (self.processor_seconds > 0.0).then(|| self.whole(self.processor_seconds))
    }

    fn whole(&self, seconds: f64) -> f64 {
        seconds / (1.0 - self.resumed.clamp(0.0, 0.95))
    }
}

/// The digest of an artifact's payload, which is the [`content`](Manifest::content) of its manifest.
pub fn content_digest(files: &[FileRecord]) -> Digest {
    let mut encoder = Encoder::new(CONTEXT);
    encoder.number(files.len() as u64);
    for file in files {
        encoder.text(&file.path).number(file.size).bytes(file.digest.as_bytes());
    }
    encoder.finish()
}

/// Returns the first promise that no file of these names keeps.
pub(crate) fn unkept<'n>(
    promises: &[&'static str],
    names: &(impl Iterator<Item = &'n str> + Clone),
) -> Option<&'static str> {
    let keeps = |promise: &str, name: &str| {
        name == promise || promise.ends_with('/') && name.starts_with(promise) && name.len() > promise.len()
    };
    promises.iter().copied().find(|promise| !names.clone().any(|name| keeps(promise, name)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn manifest() -> Manifest {
        let ingredients: Ingredients = serde_json::from_value(serde_json::json!({
            "stage": "import", "version": 1, "code": {}, "third_party": {}, "parameters": {"size": 0.1},
            "seed": null, "numeric_class": "x", "inputs": []
        }))
        .expect("ingredients");
        let file = FileRecord { path: "a".to_string(), size: 1, digest: Digest::of(b"a") };
        Manifest::new(ingredients, vec![file], Circumstances::default())
    }

    #[test]
    fn seconds_are_those_of_a_stage_without_checkpoints() {
        let resumed = Manifest { seconds: 3.0, processor_seconds: 4.0, resumed: 0.5, ..manifest() };
        assert_eq!((resumed.full_seconds(), resumed.full_processor_seconds()), (6.0, Some(8.0)));
        assert_eq!(manifest().full_processor_seconds(), None, "an older program did not count them");
    }

    #[test]
    fn a_manifest_that_lies_is_refused() {
        let manifest = manifest();
        let bytes = serde_json::to_vec(&manifest).expect("json");
        assert_eq!(Manifest::parse(&bytes, manifest.key).expect("whole"), manifest);
        assert!(Manifest::parse(&bytes, Digest::of(b"other")).is_err());
        assert!(Manifest::parse(&bytes[..bytes.len() - 3], manifest.key).is_err());
        for edit in [
            |m: &mut Manifest| m.files[0].size = 2,
            |m: &mut Manifest| m.ingredients.version = 2,
            |m: &mut Manifest| m.format = "other".to_string(),
        ] {
            let mut wrong = manifest.clone();
            edit(&mut wrong);
            assert!(Manifest::parse(&serde_json::to_vec(&wrong).expect("json"), manifest.key).is_err());
        }
    }
}
