//! One artifact to a store, or from it.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use super::super::cache::{Artifact, Cache, Published, first_difference};
use super::super::error::FileError;
use super::super::files;
use super::super::key::Key;
use super::super::manifest::{FileRecord, Manifest};
use super::receive::{Receiver, Sender, wrong_names};
use super::{Remote, RemoteError, Shelf, blob, manifest};

/// How often something is tried that may work the next time.
const TRIES: u32 = 4;
/// The first pause between two tries; each is four times the one before.
const PAUSE: Duration = Duration::from_millis(500);
/// Files of an artifact on their way at the same time.
const FILES_AT_ONCE: usize = 4;
/// Artifacts on their way at the same time, where many are sent or fetched: 32 requests in all.
pub(super) const ARTIFACTS_AT_ONCE: usize = 8;
/// A manifest is never larger, bytes.
const LARGEST_MANIFEST: u64 = 64 << 20;
/// So many artifacts in a row that a store would not give or take, and a run goes on without it.
const ENOUGH: u32 = 3;

/// A store, and how it is used.
pub struct RemoteStore {
    pub(super) remote: Arc<dyn Remote>,
    /// Nothing is sent.
    read_only: bool,
    pause: Duration,
    /// Artifacts in a row that it failed at.
    failures: AtomicU32,
    /// Keys whose artifact was of no use: they are computed.
    distrusted: Mutex<BTreeSet<Key>>,
}

/// What became of an artifact that a store was asked for.
#[derive(Debug)]
pub enum Fetched {
    /// It is not there.
    Missing,
    /// It is in the cache now.
    Now(Arc<Artifact>),
    /// Another one of the same key was in the cache first, and stays: its stage is not
    /// deterministic. The file they differ in.
    Differs(Arc<Artifact>, String),
}

/// What became of an artifact that was sent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Sent {
    /// It is there now.
    Now,
    /// It was there.
    Already,
    /// Another one of the same key is there, and stays: its stage is not
    /// deterministic. The file they differ in.
    Differs(String),
}

impl RemoteStore {
    /// A store as it is used.
    pub fn new(remote: Arc<dyn Remote>) -> Self {
        Self {
            remote,
            read_only: false,
            pause: PAUSE,
            failures: AtomicU32::new(0),
            distrusted: Mutex::default(),
        }
    }

    /// The same with another first pause between tries, for tests.
    #[must_use]
    pub fn with_pause(self, pause: Duration) -> Self {
        Self { pause, ..self }
    }

    /// The same, to which nothing is sent.
    #[must_use]
    pub fn read_only(self) -> Self {
        Self { read_only: true, ..self }
    }

    /// Whether what is computed is sent to it.
    pub(crate) fn takes(&self) -> bool {
        !self.read_only
    }

    /// Where it is, for people.
    pub fn place(&self) -> String {
        self.remote.place()
    }

    /// Whether it can be written to, gives back what it was given, and lets a name be created only once.
    ///
    /// # Errors
    /// A store that does not, in words that say what to do.
    pub fn probe(&self, stop: &AtomicBool) -> Result<(), RemoteError> {
        self.patiently(stop, || {
            // Of its own at every try: the answer to an earlier one may have been lost.
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
            // What stays behind is a few bytes.
            let _ = self.remote.remove(&name);
            let (again, there) = (again?, there?);
            if again || found == b"again" {
                let reason = "it lets a name be created twice (it takes no notice of `If-None-Match: *`), so that two machines could \
                    replace each other's artifacts; take a store that refuses, or a folder that all machines see";
                return Err(refused("rely on", reason));
            }
            if there && found != bytes {
                // Nobody wrote these: they were changed on the way, and may be right the next time.
                let reason = "comes back with other bytes than were written".to_string();
                return Err(RemoteError::Wrong { place: self.place(), name: name.clone(), reason });
            }
            // A client that asks again by itself when an answer is lost is told that the name
            // is there: by its own first try.
            if !(first || there) {
                return Err(refused("create", "it says that a new name is there already"));
            }
            if there { Ok(()) } else { Err(refused("read", "what was just written is not there")) }
        })
    }

    /// Whether a run should still ask; it stops after some failures in a row.
    pub(crate) fn is_worth_asking(&self) -> bool {
        self.failures.load(Ordering::Relaxed) < ENOUGH
    }

    /// Counts a failure; whether it was one too many.
    pub(crate) fn failed(&self) -> bool {
        self.failures.fetch_add(1, Ordering::Relaxed) + 1 == ENOUGH
    }

    pub(crate) fn worked(&self) {
        self.failures.store(0, Ordering::Relaxed);
    }

    /// Tries until it works, will not, or was tried often enough.
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

    /// The manifest that the store has for a key, where it has one.
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
            let found = Manifest::parse(&to.into_inner(), *key).and_then(|manifest| {
                if manifest.ingredients.stage != stage {
                    return Err(format!("is of the stage {}", manifest.ingredients.stage));
                }
                wrong_names(&manifest).map_or(Ok(manifest), Err)
            });
            let wrong = |reason| RemoteError::Wrong { place: self.place(), name: name.clone(), reason };
            found.map(Some).map_err(wrong)
        })
    }

    /// Asks the store no more for a key: what it gave was of no use.
    pub(crate) fn distrust(&self, key: &Key) {
        self.distrusted.lock().unwrap_or_else(PoisonError::into_inner).insert(*key);
    }

    /// Brings a key's artifact into the cache, if the store has it.
    ///
    /// # Errors
    /// A store that does not answer, or what is there is not what it should be; a file that cannot be written
    /// here. The cache is as it was.
    pub fn fetch(
        &self,
        cache: &Cache,
        stage: &str,
        key: &Key,
        stop: &AtomicBool,
    ) -> Result<Fetched, RemoteError> {
        if self.distrusted.lock().unwrap_or_else(PoisonError::into_inner).contains(key) {
            return Ok(Fetched::Missing);
        }
        let Some(manifest) = self.manifest(stage, key, stop)? else { return Ok(Fetched::Missing) };
        if let Some(reason) = cache.unkept(&manifest) {
            return Err(RemoteError::Wrong {
                place: self.place(),
                name: super::manifest(stage, key),
                reason,
            });
        }
        let scratch = cache.scratch()?;
        let fetched = self.fetch_into(&scratch.join("artifact"), cache, manifest, stop);
        // What cannot be removed now is swept by a later run.
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
        self.patiently(stop, || {
            let to = BufWriter::new(files::at(path, "create", File::create(path))?);
            let mut to = Receiver::new(to, file.size, stop);
            let got = self.remote.get(&blob(&file.digest), &mut to);
            let reason = match got {
                Ok(false) => Some("is missing, though its artifact's manifest is there".to_string()),
                Ok(true) => to.wrong(file),
                Err(RemoteError::Local(_)) if to.overfull => to.wrong(file),
                Err(RemoteError::Local(source)) => {
                    return Err(FileError { path: path.to_path_buf(), doing: "write", source }.into());
                }
                Err(error) => return Err(error),
            };
            if let Some(reason) = reason {
                return Err(RemoteError::Wrong { place: self.place(), name: blob(&file.digest), reason });
            }
            Ok(files::at(path, "write", to.into_inner().flush())?)
        })
    }

    /// Sends an artifact to the store, its manifest last. `check` reads back what is there already, and
    /// replaces what is not as it should be.
    ///
    /// # Errors
    /// A store that does not answer or take it; an artifact that is damaged here.
    pub fn send(
        &self,
        cache: &Cache,
        artifact: &Artifact,
        check: bool,
        stop: &AtomicBool,
    ) -> Result<Sent, RemoteError> {
        self.send_beside(cache, artifact, None, check, stop)
    }

    /// As [`send`](Self::send), to a store that was listed: what the list has is not asked for again.
    pub(super) fn send_beside(
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
            // Nobody can use what is there, and nobody who asks will take it.
            Ok(Some(theirs)) if cache.unkept(&theirs).is_some() => {
                self.remote.remove(&manifest(stage, &ours.key))?;
                false
            }
            Ok(Some(theirs)) if theirs.content != ours.content => {
                return Ok(Sent::Differs(first_difference(&theirs.files, &ours.files)));
            }
            Ok(Some(_)) if !check => return Ok(Sent::Already),
            Ok(found) => found.is_some(),
            // Nobody can use what is there.
            Err(RemoteError::Wrong { .. }) => {
                self.remote.remove(&manifest(stage, &ours.key))?;
                false
            }
            Err(error) => return Err(error),
        };
        cache.verify(artifact, false).map_err(RemoteError::Damaged)?;
        let replaced = AtomicUsize::new(0);
        each(&ours.files, FILES_AT_ONCE, |file| {
            let listed = !check && shelf.is_some_and(|shelf| shelf.has_file(&file.digest, file.size));
            if !listed && !self.has(file, check, stop)? {
                self.send_file(&artifact.path.join(&file.path), file, stop)?;
                replaced.fetch_add(1, Ordering::Relaxed);
            }
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
        // Somebody was first, or the answer to the first try was lost.
        Ok(match self.manifest(stage, &ours.key, stop)? {
            Some(theirs) if theirs.content != ours.content => {
                Sent::Differs(first_difference(&theirs.files, &ours.files))
            }
            _ => Sent::Now,
        })
    }

    /// Whether the store has a file, by its size, or by its bytes.
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

/// Does something for every item, a few at a time; ends at the first error. On threads of its own: those that
/// compute must not wait for a network.
pub(super) fn each<T: Sync>(
    items: &[T],
    at_once: usize,
    work: impl Fn(&T) -> Result<(), RemoteError> + Sync,
) -> Result<(), RemoteError> {
    let next = AtomicUsize::new(0);
    let failed: Mutex<Option<RemoteError>> = Mutex::default();
    let failure = || failed.lock().unwrap_or_else(PoisonError::into_inner);
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
