//! Who computes what now: one small file per key, so that two processes rarely do the same work at the same
//! time; and one per run with everything it has decided on, which cleaning up leaves alone.
//!
//! Leases only save time. Results are right without them, because publishing is atomic and the first wins; so
//! a lease that cannot be written is no error, one whose holder is gone is taken over, and nobody ever has to
//! remove one by hand. A holder on this machine is asked for by process id and start time. One on another
//! machine renews its lease every few seconds, and whoever waits for it looks whether the file *changes*, by
//! his own steady clock: what the clocks of two machines say, or one that was set back, is never compared.

use std::collections::{BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use serde::{Deserialize, Serialize};

use super::cache::Cache;
use super::digest::Digest;
use super::files::{self, Files};
use super::key::Key;
use super::machine::{Machine, ProcessId};

/// How often a holder renews.
pub(crate) const HEARTBEAT: Duration = Duration::from_secs(10);
/// How long a lease of another machine may stay as it is before its holder counts as gone.
const EXPIRY: Duration = Duration::from_secs(90);
/// The same for a file that does not say whose it is: being written at this moment, or left half-written by a
/// crash.
const HALF: Duration = Duration::from_secs(2);
/// Who looks only once cannot see a lease change. So far from the present it is of a holder that is gone.
const LONG_GONE: Duration = Duration::from_secs(86_400);

#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Holder {
    process: ProcessId,
    host: String,
    token: String,
    /// Keys, of artifacts and of checkpoints, that the holder reads or goes on from: cleaning up leaves
    /// them.
    pub(crate) reads: Vec<Key>,
}

impl Holder {
    fn this(reads: Vec<Key>) -> Self {
        Self { process: ProcessId::this(), host: Machine::this().host, token: files::unique(), reads }
    }
}

/// What this process has seen of leases, and since when.
#[derive(Debug, Default)]
pub(crate) struct Watch {
    seen: Mutex<HashMap<PathBuf, Seen>>,
}

#[derive(Debug)]
struct Seen {
    bytes: Vec<u8>,
    modified: Option<SystemTime>,
    since: Instant,
}

/// What a lease is.
#[derive(Debug)]
enum Judged {
    Absent,
    /// Somebody's, in words; the holder where it can be read.
    Live(String, Option<Holder>),
    /// Of a holder that is gone; its bytes.
    Dead(Vec<u8>),
}

impl Watch {
    /// How long the file has been seen as it is.
    fn unchanged(&self, path: &Path, bytes: &[u8], modified: Option<SystemTime>, now: Instant) -> Duration {
        let mut seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        match seen.get(path) {
            Some(s) if s.bytes == bytes && s.modified == modified => now.saturating_duration_since(s.since),
            _ => {
                seen.insert(path.to_path_buf(), Seen { bytes: bytes.to_vec(), modified, since: now });
                Duration::ZERO
            }
        }
    }

    fn judge(&self, path: &Path, now: Instant) -> Judged {
        let bytes = match std::fs::read(path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
                self.seen.lock().unwrap_or_else(PoisonError::into_inner).remove(path);
                return Judged::Absent;
            }
            // Not ours to read: as if it did not say whose it is.
            Err(_) => Vec::new(),
        };
        let modified = std::fs::metadata(path).and_then(|m| m.modified()).ok();
        let unchanged = self.unchanged(path, &bytes, modified, now);
        let (limit, name, holder) = match serde_json::from_slice::<Holder>(&bytes) {
            Ok(holder) => {
                let name = format!("process {} on {}", holder.process.pid, holder.host);
                let limit = match holder.process.is_alive() {
                    Some(true) => Duration::MAX,
                    Some(false) => Duration::ZERO,
                    None => EXPIRY,
                };
                (limit, name, Some(holder))
            }
            Err(_) => (HALF, "another process on this cache".to_string(), None),
        };
        if unchanged < limit { Judged::Live(name, holder) } else { Judged::Dead(bytes) }
    }
}

/// A lease that this process holds; given back when dropped.
pub(crate) struct Lease {
    path: PathBuf,
    bytes: Vec<u8>,
}

/// What came of asking.
pub(crate) enum Asked {
    /// It is ours (or leases do not work here, which is as good).
    Granted(Option<Lease>),
    /// Somebody else computes this key: who, in words.
    Held(String),
}

impl Lease {
    /// Asks for the lease of `key`.
    pub(crate) fn ask(cache: &Cache, key: &Key, reads: &[Key]) -> Asked {
        Self::ask_at(cache, key, reads, Instant::now())
    }

    fn ask_at(cache: &Cache, key: &Key, reads: &[Key], now: Instant) -> Asked {
        let path = folder(cache).join(key.to_string());
        let bytes = serde_json::to_vec(&Holder::this(reads.to_vec())).unwrap_or_default();
        match create(cache.files(), &path, &bytes) {
            Created::Taken => match cache.leases().judge(&path, now) {
                Judged::Live(name, _) => Asked::Held(name),
                Judged::Absent => Asked::Held("a process that has just ended".to_string()),
                Judged::Dead(dead) => take_over(cache, &path, &dead, &bytes, now),
            },
            Created::Done => Asked::Granted(Some(Self { path, bytes })),
            Created::Impossible => Asked::Granted(None),
        }
    }

    /// Shows that the holder is alive.
    pub(crate) fn renew(&self) {
        let _ = touch(&self.path);
    }
}

impl Drop for Lease {
    fn drop(&mut self) {
        give_back(&self.path, &self.bytes);
    }
}

/// What a run has decided on, protected until it ends: the artifacts it has found or made and will read, and
/// the checkpoints it goes on from.
pub(crate) struct RunLease {
    cache: Cache,
    path: PathBuf,
    holder: Holder,
    bytes: Vec<u8>,
    keys: BTreeSet<Key>,
    changed: bool,
    renewed: Instant,
}

impl RunLease {
    /// Of nothing yet.
    pub(crate) fn new(cache: &Cache) -> Self {
        let holder = Holder::this(Vec::new());
        let path = folder(cache).join(format!("run-{}", holder.token));
        Self {
            cache: cache.clone(),
            path,
            holder,
            bytes: Vec::new(),
            keys: BTreeSet::new(),
            changed: false,
            renewed: Instant::now(),
        }
    }

    /// Adds keys; others see them after [`show`](Self::show).
    pub(crate) fn extend(&mut self, keys: impl IntoIterator<Item = Key>) {
        for key in keys {
            self.changed |= self.keys.insert(key);
        }
    }

    /// Lets others see what was added, and that this process is alive.
    pub(crate) fn show(&mut self) {
        if !self.changed && self.renewed.elapsed() < HEARTBEAT {
            return;
        }
        self.renewed = Instant::now();
        // A lease that somebody removed is written again.
        if !self.changed && touch(&self.path).is_ok() {
            return;
        }
        self.holder.reads = self.keys.iter().copied().collect();
        self.bytes = serde_json::to_vec(&self.holder).unwrap_or_default();
        self.changed = put(self.cache.files(), &self.path, &self.bytes).is_err();
    }
}

impl std::fmt::Debug for RunLease {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("RunLease").field("path", &self.path).field("keys", &self.keys.len()).finish()
    }
}

impl Drop for RunLease {
    fn drop(&mut self) {
        give_back(&self.path, &self.bytes);
    }
}

fn folder(cache: &Cache) -> PathBuf {
    cache.root().join("leases")
}

fn touch(path: &Path) -> std::io::Result<()> {
    std::fs::File::options().write(true).open(path).and_then(|f| f.set_modified(SystemTime::now()))
}

/// Only one's own: it may have been taken over while this process was stopped.
fn give_back(path: &Path, bytes: &[u8]) {
    if std::fs::read(path).is_ok_and(|found| found == bytes) {
        let _ = std::fs::remove_file(path);
    }
}

enum Created {
    Done,
    Taken,
    Impossible,
}

fn create(files: &dyn Files, path: &Path, bytes: &[u8]) -> Created {
    match files.create_new(path, bytes) {
        Ok(()) => Created::Done,
        Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => Created::Taken,
        Err(_) => Created::Impossible,
    }
}

/// Puts our lease in the place of that of a holder who is gone. Of several processes that do so at once one
/// gets it: who first claims these very bytes.
fn take_over(cache: &Cache, path: &Path, dead: &[u8], bytes: &[u8], now: Instant) -> Asked {
    let another = || Asked::Held("another process on this cache".to_string());
    let files = cache.files();
    let mut name = path.file_name().unwrap_or_default().to_os_string();
    name.push(format!("{}claim-{}", files::SIBLING, Digest::of(dead).short()));
    let claim = path.with_file_name(name);
    match create(files, &claim, &[]) {
        Created::Done => {}
        Created::Taken => {
            let modified = std::fs::metadata(&claim).and_then(|m| m.modified()).ok();
            if cache.leases().unchanged(&claim, &[], modified, now) >= HALF {
                // Whoever claimed it was killed before he was done.
                let _ = files.remove_file(&claim);
            }
            return another();
        }
        Created::Impossible => return Asked::Granted(None),
    }
    let asked = if std::fs::read(path).is_ok_and(|found| found == dead) {
        let lease = Lease { path: path.to_path_buf(), bytes: bytes.to_vec() };
        Asked::Granted(put(files, path, bytes).is_ok().then_some(lease))
    } else {
        another()
    };
    let _ = files.remove_file(&claim);
    asked
}

/// Writes a lease whole, over what is there. Not synced: after a power cut nobody holds it.
fn put(files: &dyn Files, path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let mut name = path.file_name().unwrap_or_default().to_os_string();
    name.push(format!("{}{}", files::SIBLING, files::unique()));
    let sibling = path.with_file_name(name);
    let written = files.create_new(&sibling, bytes).and_then(|()| files.rename(&sibling, path));
    if written.is_err() {
        let _ = files.remove_file(&sibling);
    }
    written
}

/// Everything that running processes compute, read or go on from now; leases of processes that are gone are
/// removed.
pub(crate) fn in_use(cache: &Cache) -> BTreeSet<Key> {
    let mut keys = BTreeSet::new();
    let entries = std::fs::read_dir(folder(cache)).into_iter().flatten().filter_map(Result::ok);
    for entry in entries {
        let (path, name) = (entry.path(), entry.file_name());
        if name.to_string_lossy().contains(files::SIBLING) {
            continue;
        }
        let modified = entry.metadata().and_then(|m| m.modified());
        let far = modified.is_ok_and(|at| {
            let now = SystemTime::now();
            now.duration_since(at).or_else(|_| at.duration_since(now)).is_ok_and(|d| d > LONG_GONE)
        });
        match cache.leases().judge(&path, Instant::now()) {
            Judged::Live(_, holder)
                if !far || holder.as_ref().is_some_and(|h| h.process.is_alive() == Some(true)) =>
            {
                keys.extend(name.to_str().and_then(|n| n.parse::<Key>().ok()));
                keys.extend(holder.into_iter().flat_map(|h| h.reads));
            }
            Judged::Absent => {}
            Judged::Live(..) | Judged::Dead(_) => {
                let _ = std::fs::remove_file(&path);
            }
        }
    }
    keys
}

#[cfg(test)]
mod tests {
    use super::*;

    fn foreign() -> Vec<u8> {
        let process = ProcessId { place: "elsewhere".to_string(), pid: 7, started: 1 };
        let host = "elsewhere".to_string();
        serde_json::to_vec(&Holder { process, host, token: String::new(), reads: Vec::new() }).unwrap()
    }

    fn granted(asked: &Asked) -> bool {
        matches!(asked, Asked::Granted(Some(_)))
    }

    #[test]
    fn a_lease_is_judged_by_whether_it_changes_and_not_by_its_time() {
        let dir = tempfile::tempdir().unwrap();
        let cache = Cache::open(dir.path(), false).unwrap();
        let start = Instant::now();
        let hour = Duration::from_secs(3600);
        for (i, (bytes, limit)) in [(foreign(), EXPIRY), (Vec::new(), HALF)].into_iter().enumerate() {
            for (j, future) in [true, false].into_iter().enumerate() {
                let key = Digest::of(&[i as u8, j as u8]);
                let path = folder(&cache).join(key.to_string());
                let write = |beats: u32| {
                    std::fs::write(&path, &bytes).unwrap();
                    let now = SystemTime::now() + Duration::from_secs(u64::from(beats));
                    let at = if future { now + hour } else { now - hour };
                    std::fs::File::options()
                        .write(true)
                        .open(&path)
                        .and_then(|f| f.set_modified(at))
                        .unwrap();
                };
                let ask = |after: Duration| Lease::ask_at(&cache, &key, &[], start + after);
                write(0);
                assert!(!granted(&ask(Duration::ZERO)), "it may be alive");
                // It changes: its holder lives, however wrong his clock is.
                for beat in 1..4 {
                    write(beat);
                    assert!(!granted(&ask(limit * beat)), "{i} {future} {beat}");
                }
                assert!(!granted(&ask(limit * 3 + limit / 2)));
                assert!(granted(&ask(limit * 4)), "it has not changed for long: {i} {future}");
                assert!(!path.exists(), "given back");
            }
        }
    }

    #[test]
    fn of_many_that_take_over_one_gets_it() {
        let dir = tempfile::tempdir().unwrap();
        let cache = Cache::open(dir.path(), false).unwrap();
        let key = Digest::of(b"key");
        let gone = ProcessId { started: ProcessId::this().started + 1, ..ProcessId::this() };
        if gone.is_alive() != Some(false) {
            return; // a system that does not tell
        }
        let dead = Holder { process: gone, ..Holder::this(Vec::new()) };
        for _ in 0..20 {
            let path = folder(&cache).join(key.to_string());
            std::fs::write(&path, serde_json::to_vec(&dead).unwrap()).unwrap();
            let asked: Vec<Asked> = std::thread::scope(|scope| {
                let all: Vec<_> = (0..4).map(|_| scope.spawn(|| Lease::ask(&cache, &key, &[]))).collect();
                all.into_iter().map(|one| one.join().unwrap()).collect()
            });
            assert!(asked.iter().filter(|a| granted(a)).count() <= 1);
            let later = Lease::ask(&cache, &key, &[]);
            assert_eq!(asked.iter().chain([&later]).filter(|a| granted(a)).count(), 1);
        }
        assert_eq!(std::fs::read_dir(folder(&cache)).unwrap().count(), 0);
    }

    #[test]
    fn a_run_protects_what_it_has_decided_on() {
        let dir = tempfile::tempdir().unwrap();
        let cache = Cache::open(dir.path(), false).unwrap();
        let mut run = RunLease::new(&cache);
        for (i, text) in ["a", "b"].into_iter().enumerate() {
            run.extend([Digest::of(text.as_bytes())]);
            run.show();
            assert_eq!(in_use(&cache).len(), i + 1);
        }
        drop(run);
        assert!(in_use(&cache).is_empty());
        // Of another machine, seen once: alive, unless it is from another day.
        let path = folder(&cache).join(Digest::of(b"c").to_string());
        std::fs::write(&path, foreign()).unwrap();
        assert_eq!(in_use(&cache).len(), 1);
        let long = SystemTime::now() + 2 * LONG_GONE;
        std::fs::File::options().write(true).open(&path).and_then(|f| f.set_modified(long)).unwrap();
        assert!(in_use(&cache).is_empty() && !path.exists());
    }
}
