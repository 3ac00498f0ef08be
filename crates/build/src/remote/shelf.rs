//! What a store holds, as a list of it tells: two or three requests instead of one for every artifact.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::fmt;
use std::sync::Mutex;
use std::sync::PoisonError;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, SystemTime};

use serde::Serialize;

use super::super::digest::Digest;
use super::super::key::Key;
use super::super::machine;
use super::super::manifest::Manifest;
use super::transfer::each;
use super::{RemoteError, RemoteStore, manifest};

/// A file of an artifact that no manifest names is left alone for so long: whoever sends an artifact sends its
/// manifest last.
const BEING_SENT: Duration = Duration::from_secs(86_400);

/// What a store held when it was listed.
#[derive(Clone, Debug, Default)]
pub struct Shelf {
    /// Artifacts by stage and key, and when their manifests were written.
    artifacts: BTreeMap<(String, Key), SystemTime>,
    /// Files by digest, with their sizes.
    files: HashMap<Digest, (u64, SystemTime)>,
    /// Bytes of all manifests.
    manifests: u64,
}

impl Shelf {
    /// Whether there is an artifact of a key.
    pub fn has(&self, stage: &str, key: &Key) -> bool {
        self.artifacts.contains_key(&(stage.to_string(), *key))
    }

    /// Whether there is a file of these bytes.
    pub(crate) fn has_file(&self, digest: &Digest, size: u64) -> bool {
        self.files.get(digest).is_some_and(|(known, _)| *known == size)
    }

    /// How many artifacts there are of each stage.
    pub fn stages(&self) -> BTreeMap<&str, usize> {
        let mut stages = BTreeMap::new();
        self.artifacts.keys().for_each(|(stage, _)| *stages.entry(stage.as_str()).or_default() += 1);
        stages
    }

    /// How many files there are, and their bytes with those of the manifests.
    pub fn size(&self) -> (usize, u64) {
        (self.files.len(), self.manifests + self.files.values().map(|(size, _)| size).sum::<u64>())
    }
}

impl fmt::Display for Shelf {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (stage, count) in self.stages() {
            writeln!(f, "{stage:<12} {count}")?;
        }
        let (files, bytes) = self.size();
        writeln!(f, "{} artifacts, {files} files, {}", self.artifacts.len(), machine::bytes(bytes))
    }
}

/// What cleaning up a store removed, or would remove.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Swept {
    /// Artifacts.
    pub artifacts: usize,
    /// Files that no artifact has any more.
    pub files: usize,
    /// Their bytes.
    pub bytes: u64,
    /// Artifacts that are left.
    pub left: usize,
    /// Whether nothing was touched.
    pub dry_run: bool,
    /// Whether it was asked to stop before it was done.
    pub interrupted: bool,
}

impl fmt::Display for Swept {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let verb = if self.dry_run { "would remove" } else { "removed" };
        let Self { artifacts, files, bytes, left, .. } = self;
        writeln!(
            f,
            "{verb} {artifacts} artifacts and {files} files, {}; {left} artifacts left",
            machine::bytes(*bytes)
        )
    }
}

impl RemoteStore {
    /// What the store holds.
    ///
    /// # Errors
    /// A store that does not answer, or lets nobody list it.
    pub fn shelf(&self, stop: &AtomicBool) -> Result<Shelf, RemoteError> {
        let mut shelf = Shelf::default();
        for object in self.patiently(stop, || self.remote.list("v1/artifacts/"))? {
            let parts = object.name.strip_prefix("v1/artifacts/").and_then(|rest| rest.split_once('/'));
            let Some((stage, file)) = parts else { continue };
            if let Some(Ok(key)) = file.strip_suffix(".json").map(str::parse) {
                shelf.artifacts.insert((stage.to_string(), key), object.written);
                shelf.manifests += object.size;
            }
        }
        for object in self.patiently(stop, || self.remote.list("v1/blobs/"))? {
            if let Some(Ok(digest)) = object.name.strip_prefix("v1/blobs/").map(str::parse) {
                shelf.files.insert(digest, (object.size, object.written));
            }
        }
        Ok(shelf)
    }

    /// Removes artifacts that were sent longer than `older_than` ago and are not to be kept, and then the files
    /// that no artifact has. Manifests go first: at every moment, what a manifest names is there.
    ///
    /// # Errors
    /// A store that does not answer or does not let anybody remove.
    pub fn sweep(
        &self,
        older_than: Duration,
        keep: &BTreeSet<Key>,
        dry_run: bool,
        stop: &AtomicBool,
    ) -> Result<Swept, RemoteError> {
        let shelf = self.shelf(stop)?;
        let now = SystemTime::now();
        let age = |written: &SystemTime| now.duration_since(*written).unwrap_or_default();
        let goes = |key: &Key, written: &SystemTime| !keep.contains(key) && age(written) > older_than;
        let (gone, left): (Vec<_>, Vec<_>) =
            shelf.artifacts.iter().partition(|((_, key), written)| goes(key, written));
        // What stays names the files that stay. One that cannot be read names nothing that anybody could use.
        let named: Mutex<BTreeSet<Digest>> = Mutex::default();
        each(&left, 32, |((stage, key), _)| match self.manifest(stage, key, stop) {
            Ok(Some(Manifest { files, .. })) => {
                named.lock().unwrap_or_else(PoisonError::into_inner).extend(files.iter().map(|f| f.digest));
                Ok(())
            }
            Ok(None) | Err(RemoteError::Wrong { .. }) => Ok(()),
            Err(error) => Err(error),
        })?;
        let named = named.into_inner().unwrap_or_else(PoisonError::into_inner);
        let unnamed = |(digest, (_, written)): &(&Digest, &(u64, SystemTime))| {
            !named.contains(*digest) && age(written) > BEING_SENT.min(older_than.max(BEING_SENT / 24))
        };
        let files: Vec<_> = shelf.files.iter().filter(unnamed).collect();
        let swept = Swept {
            artifacts: gone.len(),
            files: files.len(),
            bytes: files.iter().map(|(_, (size, _))| size).sum(),
            left: left.len(),
            dry_run,
            interrupted: false,
        };
        if dry_run {
            return Ok(swept);
        }
        let remove = |name: String| self.patiently(stop, || self.remote.remove(&name));
        let removed = each(&gone, 32, |((stage, key), _)| remove(manifest(stage, key)))
            .and_then(|()| each(&files, 32, |(digest, _)| remove(super::blob(digest))));
        match removed {
            Err(RemoteError::Stopped) => Ok(Swept { interrupted: true, ..swept }),
            removed => removed.map(|()| swept),
        }
    }
}
