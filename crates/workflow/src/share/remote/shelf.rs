//! The list of a store's objects: two or three requests instead of one for every artifact.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::fmt;
use std::sync::atomic::AtomicBool;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, SystemTime};

use serde::Serialize;
use use3d_capture::name::shown;

use super::transfer::each;
use super::{CLAIMS, RemoteError, RemoteStore, manifest};
use crate::cache::key::Key;
use crate::cache::lock;
use crate::cache::machine;
use crate::cache::manifest::Manifest;
use use3d_code::digest::Digest;

/// The age before a file without a manifest is removed; a cleaning of younger artifacts waits an hour. A
/// transfer sends the files first and the manifest last, so a young file may belong to a transfer in
/// progress.
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
            // The name comes from the store.
            writeln!(f, "{:<12} {count}", shown(stage))?;
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
    /// then the files of no artifact. Manifests are removed first. Before the files, the store is listed
    /// again, and files of artifacts that were sent meanwhile stay.
    ///
    /// Limit: an artifact that is sent between that list and the removal of a file may use the file again
    /// and lose it. A run that fetches such an artifact finds the loss and computes it.
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
        let left: Vec<&(String, Key)> = left.into_iter().map(|(artifact, _)| artifact).collect();
        let named = self.named_by(&left, stop)?;
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
        let gone_now = Mutex::new(Swept::default());
        let remove = |name: String| self.patiently(stop, || self.remote.remove(&name));
        let all = || -> Result<(), RemoteError> {
            each(&gone, 32, |((stage, key), _)| {
                remove(manifest(stage, key))?;
                lock(&gone_now).artifacts += 1;
                Ok(())
            })?;
            let now = self.shelf(stop)?;
            // Also an artifact that was just removed may have been sent again.
            let stayed: BTreeSet<&(String, Key)> = left.iter().copied().collect();
            let new: Vec<_> = now.artifacts.keys().filter(|artifact| !stayed.contains(artifact)).collect();
            let used_again = self.named_by(&new, stop)?;
            let files: Vec<_> = files.iter().filter(|(digest, _)| !used_again.contains(*digest)).collect();
            let claims = self.patiently(stop, || self.remote.list(CLAIMS))?.into_iter();
            // The processes of old claims have ended.
            claims
                .filter(|claim| age(&claim.written) > BEING_SENT)
                .try_for_each(|claim| remove(claim.name))?;
            each(&files, 32, |(digest, (size, _))| {
                remove(super::blob(digest))?;
                let mut gone_now = lock(&gone_now);
                gone_now.files += 1;
                gone_now.bytes += size;
                Ok(())
            })
        };
        let interrupted = match all() {
            Err(RemoteError::Stopped) => true,
            removed => removed.map(|()| false)?,
        };
        let gone_now = gone_now.into_inner().unwrap_or_else(PoisonError::into_inner);
        Ok(Swept { left: shelf.artifacts.len() - gone_now.artifacts, interrupted, ..gone_now })
    }

    /// The files that the manifests of some artifacts name. An unreadable manifest names no usable file.
    fn named_by(
        &self,
        artifacts: &[&(String, Key)],
        stop: &AtomicBool,
    ) -> Result<BTreeSet<Digest>, RemoteError> {
        let named: Mutex<BTreeSet<Digest>> = Mutex::default();
        each(artifacts, 32, |(stage, key)| match self.manifest(stage, key, stop) {
            Ok(Some(Manifest { files, .. })) => {
                lock(&named).extend(files.iter().map(|f| f.digest));
                Ok(())
            }
            Ok(None) | Err(RemoteError::Wrong { .. }) => Ok(()),
            Err(error) => Err(error),
        })?;
        Ok(named.into_inner().unwrap_or_else(PoisonError::into_inner))
    }
}
