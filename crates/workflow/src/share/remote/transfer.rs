//! Sends one artifact to a store, or fetches it.

use std::collections::{BTreeSet, HashMap};
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use super::receive::{Receiver, Sender, wrong_names};
use super::{Remote, RemoteError, Shelf, blob, manifest};
use crate::cache::artifacts::{Artifact, Cache, Published, first_difference};
use crate::cache::files;
use crate::cache::key::Key;
use crate::cache::lock;
use crate::cache::manifest::{FileRecord, Manifest};
use use3d_code::digest::Digest;

/// Number of attempts for an operation that may succeed when it is repeated.
const TRIES: u32 = 4;
/// The usual first pause between two attempts.
const PAUSE: Duration = Duration::from_millis(500);
/// Most files of one artifact in transfer at the same time.
const FILES_AT_ONCE: usize = 4;
/// Most artifacts in transfer at the same time, which makes 32 requests.
pub(crate) const ARTIFACTS_AT_ONCE: usize = 8;
/// The largest size of a manifest in bytes.
const LARGEST_MANIFEST: u64 = 64 << 20;
/// The number of failed artifacts in a row after which a run continues without the store.
const ENOUGH: u32 = 3;

/// A store, with pauses between attempts and a count of failures.
pub struct RemoteStore {
    pub(super) remote: Arc<dyn Remote>,
    /// True if nothing may be sent.
    pub(crate) read_only: bool,
    /// The first pause between two attempts; each pause is four times the one before.
    pub pause: Duration,
    /// Number of artifacts in a row that failed.
    failures: AtomicU32,
    /// Keys whose artifact in the store was unusable; runs compute them.
    distrusted: Mutex<BTreeSet<Key>>,
    /// The files that were looked for or sent, each true once it was checked. Artifacts that share a file
    /// wait for each other, so the file is sent and checked once.
    in_hand: Mutex<HashMap<Digest, Arc<Mutex<bool>>>>,
}

/// Result of fetching an artifact.
#[derive(Debug)]
pub enum Fetched {
    /// The store does not have it.
    Missing,
    /// It is in the cache now.
    Now(Arc<Artifact>),
    /// Another artifact of the same key was in the cache first, and stays: its stage is not deterministic.
    /// The text is the file in which they differ.
    Differs(Arc<Artifact>, String),
}

/// Result of sending an artifact.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Sent {
    /// The store has it now.
    Now,
    /// The store had it already.
    Already,
    /// The store has another artifact of the same key, which stays: its stage is not deterministic. The text
    /// is the file in which they differ.
    Differs(String),
}

impl RemoteStore {
    /// A store with the usual pauses.
    pub fn new(remote: Arc<dyn Remote>) -> Self {
        Self {
            remote,
            read_only: false,
            pause: PAUSE,
            failures: AtomicU32::new(0),
            distrusted: Mutex::default(),
            in_hand: Mutex::default(),
        }
    }

    /// Returns the same store for reading only.
    #[must_use]
    pub fn read_only(self) -> Self {
        Self { read_only: true, ..self }
    }

    /// Its address, for display.
    pub fn place(&self) -> String {
        self.remote.place()
    }

    fn wrong(&self, name: &str, reason: String) -> RemoteError {
        RemoteError::Wrong { place: self.place(), name: name.to_string(), reason }
    }

    /// Checks that the store can be written to, returns the bytes that were written, and lets a name be
    /// created only once.
    ///
    /// # Errors
    /// A store that fails one of these checks; the message says what to do.
    pub fn probe(&self, stop: &AtomicBool) -> Result<(), RemoteError> {
        self.patiently(stop, || {
            // Every attempt has a name of its own: the reply to an earlier one may have been lost.
            let name = format!("v1/probe/{}", files::unique());
            let bytes = name.as_bytes();
            let refused = |doing, reason: &str| RemoteError::Refused {
                place: self.place(),
                doing,
                name: name.clone(),
                reason: reason.to_string(),
                passing: false,
            };
            let first = self.remote.create(&name, bytes)?;
            let again = self.remote.create(&name, b"again");
            let mut found = Vec::new();
            let there = self.remote.get(&name, &mut found);
            // If the removal fails, only a few bytes stay behind.
            let _ = self.remote.remove(&name);
            let (again, there) = (again?, there?);
            if again || found == b"again" {
                let reason = "it lets a name be created twice (it ignores `If-None-Match: *`), so two \
                     machines could replace each other's artifacts; use a store that refuses this, or a \
                     folder that all machines can reach";
                return Err(refused("rely on", reason));
            }
            if there && found != bytes {
                // Nobody wrote these bytes: they were changed in the transfer, and may be right the next
                // time.
                return Err(self.wrong(&name, "comes back with other bytes than were written".to_string()));
            }
            // A client that repeats a request by itself after a lost reply gets the error that the name
            // exists: its own first request created it.
            if !(first || there) {
                return Err(refused("create", "it reports that a new name exists already"));
            }
            if there { Ok(()) } else { Err(refused("read", "what was just written is not there")) }
        })
    }

    /// Returns true if a run should still use the store; it stops after some failures in a row.
    pub(crate) fn is_worth_asking(&self) -> bool {
        self.failures.load(Ordering::Relaxed) < ENOUGH
    }

    /// Counts a failure; returns true if it reached the limit.
    pub(crate) fn failed(&self) -> bool {
        self.failures.fetch_add(1, Ordering::Relaxed) + 1 == ENOUGH
    }

    pub(crate) fn worked(&self) {
        self.failures.store(0, Ordering::Relaxed);
    }

    /// Repeats `attempt` until it succeeds, fails for good, or was tried often enough.
    pub(super) fn patiently<T>(
        &self,
        stop: &AtomicBool,
        mut attempt: impl FnMut() -> Result<T, RemoteError>,
    ) -> Result<T, RemoteError> {
        const SLICE: Duration = Duration::from_millis(50);
        let mut pause = self.pause;
        let mut tries = 1;
        loop {
            if stop.load(Ordering::Relaxed) {
                return Err(RemoteError::Stopped);
            }
            match attempt() {
                Err(_) if stop.load(Ordering::Relaxed) => return Err(RemoteError::Stopped),
                Err(error) if error.passes() && tries < TRIES => tracing::debug!("{error}; trying again"),
                done => return done,
            }
            let mut left = pause;
            while !left.is_zero() && !stop.load(Ordering::Relaxed) {
                let slice = left.min(SLICE);
                std::thread::sleep(slice);
                left -= slice;
            }
            pause *= 4;
            tries += 1;
        }
    }

    /// The store's manifest for a key, if there is one.
    pub(super) fn manifest(
        &self,
        stage: &str,
        key: &Key,
        stop: &AtomicBool,
    ) -> Result<Option<Manifest>, RemoteError> {
        let name = manifest(stage, key);
        self.patiently(stop, || {
            let mut to = Receiver::new(Vec::new(), LARGEST_MANIFEST, stop);
            if !self.remote.get(&name, &mut to)? {
                return Ok(None);
            }
            let found = Manifest::parse(&to.into_inner(), *key).map_err(|e| e.to_string());
            let found = found.and_then(|manifest| {
                if manifest.ingredients.stage != stage {
                    return Err(format!("is of the stage {}", manifest.ingredients.stage));
                }
                wrong_names(&manifest).map_or(Ok(manifest), Err)
            });
            found.map(Some).map_err(|reason| self.wrong(&name, reason))
        })
    }

    /// Makes sure that the store is not asked for this key again, because its artifact was unusable.
    pub(crate) fn distrust(&self, key: &Key) {
        lock(&self.distrusted).insert(*key);
    }

    /// Fetches a key's artifact into the cache, if the store has it.
    ///
    /// # Errors
    /// A store that does not answer, an artifact that does not match its digests, or a file that cannot be
    /// written here. The cache is then unchanged.
    pub fn fetch(
        &self,
        cache: &Cache,
        stage: &str,
        key: &Key,
        stop: &AtomicBool,
    ) -> Result<Fetched, RemoteError> {
        if lock(&self.distrusted).contains(key) {
            return Ok(Fetched::Missing);
        }
        let Some(manifest) = self.manifest(stage, key, stop)? else { return Ok(Fetched::Missing) };
        if let Some(reason) = cache.unkept(&manifest) {
            return Err(self.wrong(&super::manifest(stage, key), reason));
        }
        let scratch = cache.scratch()?;
        let fetched = self.fetch_into(&scratch.join("artifact"), cache, manifest, stop);
        // If it cannot be removed now, a later run removes it.
        let _ = cache.files().remove_dir_all(&scratch);
        fetched
    }

    fn fetch_into(
        &self,
        folder: &Path,
        cache: &Cache,
        manifest: Manifest,
        stop: &AtomicBool,
    ) -> Result<Fetched, RemoteError> {
        files::at(folder, "create", cache.files().create_dir_all(folder))?;
        each(&manifest.files, FILES_AT_ONCE, |file| {
            self.fetch_file(&folder.join(&file.path), cache, file, stop)
        })?;
        Ok(match cache.adopt(folder, manifest)? {
            Published::Now(artifact) | Published::Already(artifact) => Fetched::Now(Arc::new(artifact)),
            Published::Differs(artifact, file) => Fetched::Differs(Arc::new(artifact), file),
        })
    }

    fn fetch_file(
        &self,
        path: &Path,
        cache: &Cache,
        file: &FileRecord,
        stop: &AtomicBool,
    ) -> Result<(), RemoteError> {
        if let Some(parent) = path.parent() {
            files::at(parent, "create", cache.files().create_dir_all(parent))?;
        }
        if cache.share_bytes(path, file) {
            return Ok(());
        }
        self.patiently(stop, || {
            let to = BufWriter::new(files::at(path, "create", File::create(path))?);
            let mut to = Receiver::new(to, file.size, stop);
            let got = self.remote.get(&blob(&file.digest), &mut to);
            let reason = match got {
                Ok(false) => Some("is missing, though its artifact's manifest is there".to_string()),
                Ok(true) => to.wrong(file),
                Err(RemoteError::Local(_)) if to.overfull => to.wrong(file),
                Err(RemoteError::Local(source)) => {
                    return files::at(path, "write", Err(source)).map_err(RemoteError::File);
                }
                Err(error) => return Err(error),
            };
            if let Some(reason) = reason {
                return Err(self.wrong(&blob(&file.digest), reason));
            }
            Ok(files::at(path, "write", to.into_inner().flush())?)
        })
    }

    /// Sends an artifact to the store, its manifest last. The files in `shelf`, a list of the store, are not
    /// requested again. `check` reads the objects that exist, and replaces those that do not match.
    ///
    /// # Errors
    /// A store that does not answer or refuses the data; an artifact that is damaged here.
    pub fn send(
        &self,
        cache: &Cache,
        artifact: &Artifact,
        shelf: Option<&Shelf>,
        check: bool,
        stop: &AtomicBool,
    ) -> Result<Sent, RemoteError> {
        let ours = &artifact.manifest;
        let stage = ours.ingredients.stage.as_str();
        let there = match shelf {
            Some(shelf) if !check && !shelf.has(stage, &ours.key) => Ok(None),
            _ => self.manifest(stage, &ours.key, stop),
        };
        let there = match there {
            // The artifact in the store is unusable, and every run refuses it.
            Ok(Some(theirs)) if cache.unkept(&theirs).is_some() => {
                self.remote.remove(&manifest(stage, &ours.key))?;
                false
            }
            Ok(Some(theirs)) if theirs.content != ours.content => {
                return Ok(Sent::Differs(first_difference(&theirs.files, &ours.files)));
            }
            Ok(Some(_)) if !check => return Ok(Sent::Already),
            Ok(found) => found.is_some(),
            // The store's manifest is unusable, so it is removed.
            Err(RemoteError::Wrong { .. }) => {
                self.remote.remove(&manifest(stage, &ours.key))?;
                false
            }
            Err(error) => return Err(error),
        };
        cache.verify(artifact, false).map_err(|e| RemoteError::Damaged(e.to_string()))?;
        let replaced = AtomicUsize::new(0);
        each(&ours.files, FILES_AT_ONCE, |file| {
            if !check && shelf.is_some_and(|shelf| shelf.has_file(&file.digest, file.size)) {
                return Ok(());
            }
            let hand = lock(&self.in_hand).entry(file.digest).or_default().clone();
            let mut checked = lock(&hand);
            if *checked {
                return Ok(());
            }
            if !self.has(file, check, stop)? {
                self.send_file(&artifact.path.join(&file.path), file, stop)?;
                replaced.fetch_add(1, Ordering::Relaxed);
            }
            *checked = check;
            Ok(())
        })?;
        if there {
            return Ok(if replaced.into_inner() > 0 { Sent::Now } else { Sent::Already });
        }
        let name = manifest(stage, &ours.key);
        let bytes = serde_json::to_vec_pretty(ours).map_err(|e| RemoteError::Local(e.into()))?;
        if self.patiently(stop, || self.remote.create(&name, &bytes))? {
            return Ok(Sent::Now);
        }
        // Another process was first, or the reply to the first attempt was lost.
        Ok(match self.manifest(stage, &ours.key, stop)? {
            Some(theirs) if theirs.content != ours.content => {
                Sent::Differs(first_difference(&theirs.files, &ours.files))
            }
            _ => Sent::Now,
        })
    }

    /// Returns true if the store has a file, by its size, or by its bytes with `check`.
    fn has(&self, file: &FileRecord, check: bool, stop: &AtomicBool) -> Result<bool, RemoteError> {
        let name = blob(&file.digest);
        if self.patiently(stop, || self.remote.size(&name))? != Some(file.size) {
            return Ok(false);
        }
        if !check {
            return Ok(true);
        }
        self.patiently(stop, || {
            let mut to = Receiver::new(std::io::sink(), file.size, stop);
            match self.remote.get(&name, &mut to) {
                Ok(there) => Ok(there && to.wrong(file).is_none()),
                Err(RemoteError::Local(_)) if to.overfull => Ok(false),
                Err(error) => Err(error),
            }
        })
    }

    fn send_file(&self, path: &Path, file: &FileRecord, stop: &AtomicBool) -> Result<(), RemoteError> {
        self.patiently(stop, || {
            let mut from = Sender::new(files::at(path, "read", File::open(path))?, file, stop);
            match self.remote.put(&blob(&file.digest), &mut from, file.size) {
                Err(RemoteError::Local(error)) => Err(RemoteError::Damaged(error.to_string())),
                done => done,
            }
        })
    }
}

/// Calls `work` for every item, a few at a time, and stops at the first error. It uses threads of its own,
/// because computing threads must not wait for a network.
pub(crate) fn each<T: Sync>(
    items: &[T],
    at_once: usize,
    work: impl Fn(&T) -> Result<(), RemoteError> + Sync,
) -> Result<(), RemoteError> {
    let next = AtomicUsize::new(0);
    let failed: Mutex<Option<RemoteError>> = Mutex::default();
    let failure = || lock(&failed);
    std::thread::scope(|scope| {
        for _ in 0..at_once.min(items.len()) {
            scope.spawn(|| {
                while let Some(item) = items.get(next.fetch_add(1, Ordering::Relaxed)) {
                    if failure().is_some() {
                        return;
                    }
                    if let Err(error) = work(item) {
                        failure().get_or_insert(error);
                        return;
                    }
                }
            });
        }
    });
    failed.into_inner().unwrap_or_else(PoisonError::into_inner).map_or(Ok(()), Err)
}
