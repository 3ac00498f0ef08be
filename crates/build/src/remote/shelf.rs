//! The list of a store's objects: two or three requests instead of one for every artifact.

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

/// The age in seconds before a file without a manifest is removed. A transfer sends the files first and the
/// manifest last, so a young file may belong to a transfer in progress.
const BEING_SENT: Duration = Duration::from_secs(86_400);

/// The objects of a store at the time of the list.
#[derive(Clone, Debug, Default)]
pub struct Shelf {
    /// The times of the manifests, by stage and key.
    artifacts: BTreeMap<(String, Key), SystemTime>,
    /// The sizes of the files, by digest.
    files: HashMap<Digest, (u64, SystemTime)>,
    /// The total size of all manifests in bytes.
    manifests: u64,
}

impl Shelf {
    /// Returns true if there is an artifact of a key.
    pub fn has(&self, stage: &str, key: &Key) -> bool {
        self.artifacts.contains_key(&(stage.to_string(), *key))
    }

    /// Returns true if there is a file with this digest.
    pub(crate) fn has_file(&self, digest: &Digest, size: u64) -> bool {
        self.files.get(digest).is_some_and(|(known, _)| *known == size)
    }

    /// The number of artifacts of each stage.
    pub fn stages(&self) -> BTreeMap<&str, usize> {
        let mut stages = BTreeMap::new();
        self.artifacts.keys().for_each(|(stage, _)| *stages.entry(stage.as_str()).or_default() += 1);
        stages
    }

    /// The number of files, and their bytes with those of the manifests.
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

/// The items that a cleaning of a store removed or would remove.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Swept {
    /// The number of artifacts.
    pub artifacts: usize,
    /// The number of files that belong to no artifact any more.
    pub files: usize,
    /// The size of the files in bytes.
    pub bytes: u64,
    /// The number of artifacts that stay.
    pub left: usize,
    /// True if nothing was removed.
    pub dry_run: bool,
    /// True if it was stopped before the end.
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
    /// Lists the store.
    ///
    /// # Errors
    /// The store does not answer, or permits no list.
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

    /// Removes artifacts that were sent longer than `older_than` ago and are not among those to keep, and
    /// then the files of no artifact. Manifests are removed first, so the files of every manifest exist at
    /// all times.
    ///
    /// # Errors
    /// The store does not answer, or permits no removal.
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
        // The manifests that stay name the files that stay. An unreadable manifest names no usable file.
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
