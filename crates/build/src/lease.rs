//! Who computes what now: one small file per key, so that two processes rarely do the same work at the same
//! time; and one per run with everything it has decided on, which cleaning up leaves alone.
//!
//! Leases only save time. Results are right without them, because publishing is atomic and the first wins; so
//! a lease that cannot be written is no error, one whose holder is gone is taken over, and nobody ever has to
//! remove one by hand. A holder on this machine is asked for by process id and start time. One on another
//! machine writes its [pulse](super::pulse) every few seconds, and whoever waits for it looks whether the
//! file *changes*, by his own steady clock: what the clocks of two machines say is never compared. A lease
//! that goes says that its artifact is there; who gives up leaves his lease behind with a pulse that says so.

use std::collections::{BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, SystemTime};

use serde::{Deserialize, Serialize};

use super::cache::Cache;
use super::digest::Digest;
use super::files::{self, Files};
use super::key::Key;
use super::machine::ProcessId;
use super::node::Node;
use super::pulse::{self, Beat, Progress};
use super::task::{Killed, Task};

/// How often a holder renews.
pub(crate) const HEARTBEAT: Duration = Duration::from_secs(10);
/// How long a lease of another machine may stay as it is before its holder counts as gone: many times the
/// heartbeat, and more than the minute for which a network file system may show what was.
const EXPIRY: Duration = Duration::from_secs(110);
/// How long until a scheduler is asked whether the holder's task is over: longer than a heartbeat.
const ASKING: Duration = Duration::from_secs(12);
/// How long a run waits for what others compute before it leaves that to them: longer than a holder that is
/// gone is waited for.
pub const PATIENCE: Duration = Duration::from_secs(150);
/// The same for a file that does not say whose it is: being written at this moment, or left half-written by a
/// crash.
const HALF: Duration = Duration::from_secs(5);
/// Who looks only once cannot see a lease change. One so far from what the file system calls now is of a
/// holder that is gone.
const LONG_GONE: Duration = Duration::from_secs(86_400);

#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Holder {
    process: ProcessId,
    host: String,
    token: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    task: Option<Task>,
    /// Keys, of artifacts and of checkpoints, that the holder reads or goes on from: cleaning up leaves
    /// them.
    pub(crate) reads: Vec<Key>,
}

impl Holder {
    fn of(node: &Node, reads: Vec<Key>) -> Self {
        Self {
            process: node.process.clone(),
            host: node.host.clone(),
            token: files::unique(),
            task: node.task.clone(),
            reads,
        }
    }

    /// The line that a lease begins with; its pulse follows.
    fn line(&self) -> Vec<u8> {
        let mut line = serde_json::to_vec(self).unwrap_or_default();
        line.push(b'\n');
        line
    }

    /// Of a lease's bytes, with its pulse where it has one.
    fn parse(bytes: &[u8]) -> Option<(Self, Option<Beat>)> {
        let end = bytes.iter().position(|b| *b == b'\n').unwrap_or(bytes.len());
        let holder = serde_json::from_slice(&bytes[..end]).ok()?;
        Some((holder, bytes.get(end + 1..).and_then(pulse::parse)))
    }
}

/// What this process has seen of leases, and since when.
#[derive(Debug, Default)]
pub(crate) struct Watch {
    seen: Mutex<HashMap<PathBuf, Seen>>,
    /// Keys that another machine was seen to compute.
    elsewhere: Mutex<BTreeSet<Key>>,
}

#[derive(Debug)]
struct Seen {
    bytes: Vec<u8>,
    modified: Option<SystemTime>,
    since: Duration,
}

/// What a lease is.
#[derive(Debug)]
enum Judged {
    Absent,
    /// Somebody's, in words; the holder where it can be read.
    Live(String, Option<Holder>),
    /// Of a holder that is gone or has given up; its bytes.
    Dead(Vec<u8>),
}

impl Watch {
    /// How long the file has been seen as it is.
    fn unchanged(&self, path: &Path, bytes: &[u8], modified: Option<SystemTime>, now: Duration) -> Duration {
        let mut seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        match seen.get(path) {
            Some(s) if s.bytes == bytes && s.modified == modified => now.saturating_sub(s.since),
            _ => {
                seen.insert(path.to_path_buf(), Seen { bytes: bytes.to_vec(), modified, since: now });
                Duration::ZERO
            }
        }
    }

    fn forget(&self, path: &Path) {
        self.seen.lock().unwrap_or_else(PoisonError::into_inner).remove(path);
    }

    fn note_elsewhere(&self, key: &Key) {
        self.elsewhere.lock().unwrap_or_else(PoisonError::into_inner).insert(*key);
    }

    /// Whether another machine was seen to compute the key; told once.
    fn was_elsewhere(&self, key: &Key) -> bool {
        self.elsewhere.lock().unwrap_or_else(PoisonError::into_inner).remove(key)
    }
}

fn judge(cache: &Cache, path: &Path, now: Duration) -> Judged {
    let (watch, node) = (cache.leases(), cache.node());
    let bytes = match cache.files().read(path) {
        Ok(bytes) => bytes,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
            watch.forget(path);
            return Judged::Absent;
        }
        // Not ours to read: as if it did not say whose it is.
        Err(_) => Vec::new(),
    };
    let modified = std::fs::metadata(path).and_then(|m| m.modified()).ok();
    let unchanged = watch.unchanged(path, &bytes, modified, now);
    let (limit, name, holder) = match Holder::parse(&bytes) {
        Some((_, Some(beat))) if beat.left => return Judged::Dead(bytes),
        Some((holder, _)) => {
            let name = format!("process {} on {}", holder.process.pid, holder.host);
            let limit = match (node.is_alive(&holder.process), &holder.task) {
                (Some(true), _) => Duration::MAX,
                (Some(false), _) => Duration::ZERO,
                (None, Some(task)) if node.has_followed(task) => Duration::ZERO,
                // One that lives has said so meanwhile.
                (None, Some(task)) if unchanged >= ASKING && node.is_over(task) => Duration::ZERO,
                (None, _) => EXPIRY,
            };
            (limit, name, Some(holder))
        }
        None => (HALF, "another process on this cache".to_string(), None),
    };
    if unchanged < limit { Judged::Live(name, holder) } else { Judged::Dead(bytes) }
}

/// A lease that this process holds. Dropped, it says that its holder gave up.
pub(crate) struct Lease {
    cache: Cache,
    path: PathBuf,
    line: Vec<u8>,
    beat: Mutex<Beat>,
    since: Duration,
    /// Another machine computed this key and its lease went: the artifact may be there and not be seen yet.
    pub(crate) followed: bool,
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
        Self::ask_at(cache, key, reads, cache.node().clock.now())
    }

    fn ask_at(cache: &Cache, key: &Key, reads: &[Key], now: Duration) -> Asked {
        let path = folder(cache).join(key.to_string());
        let mut lease = Self {
            cache: cache.clone(),
            path,
            line: Holder::of(cache.node(), reads.to_vec()).line(),
            beat: Mutex::new(Beat::default()),
            since: now,
            followed: false,
        };
        match create(cache.files(), &lease.path, &lease.bytes()) {
            Created::Done => {
                lease.followed = cache.leases().was_elsewhere(key);
                Asked::Granted(Some(lease))
            }
            Created::Impossible => Asked::Granted(lease.never_held()),
            Created::Taken => match judge(cache, &lease.path, now) {
                Judged::Live(name, holder) => {
                    if holder.is_some_and(|h| cache.node().is_alive(&h.process).is_none()) {
                        cache.leases().note_elsewhere(key);
                    }
                    lease.never_held();
                    Asked::Held(name)
                }
                Judged::Absent => {
                    lease.never_held();
                    Asked::Held("a process that has just ended".to_string())
                }
                Judged::Dead(dead) => {
                    cache.leases().was_elsewhere(key);
                    take_over(lease, &dead, now)
                }
            },
        }
    }

    /// The whole file.
    fn bytes(&self) -> Vec<u8> {
        let beat = self.beat.lock().unwrap_or_else(PoisonError::into_inner);
        [&self.line[..], &pulse::line(&beat)].concat()
    }

    /// Whether the file is this lease's: it may have been taken over while this process was stopped.
    fn is_ours(&self) -> bool {
        self.cache.files().read(&self.path).is_ok_and(|found| found.starts_with(&self.line))
    }

    /// Shows that the holder is alive, and how far it is.
    pub(crate) fn renew(&self, progress: &Progress) {
        let mut beat = self.beat.lock().unwrap_or_else(PoisonError::into_inner);
        beat.number += 1;
        beat.seconds = self.cache.node().clock.now().saturating_sub(self.since).as_secs();
        progress.read(&mut beat);
        if self.is_ours() {
            let _ = self.cache.files().overwrite(&self.path, self.line.len() as u64, &pulse::line(&beat));
        }
    }

    /// The artifact is there: nobody needs to wait any more.
    pub(crate) fn finish(mut self) {
        if self.is_ours() {
            let _ = self.cache.files().remove_file(&self.path);
        }
        self.line.clear();
    }

    /// It was never there: nothing is given back.
    fn never_held(mut self) -> Option<Self> {
        self.line.clear();
        None
    }
}

impl Drop for Lease {
    fn drop(&mut self) {
        if self.line.is_empty() || !self.is_ours() {
            return;
        }
        let beat = self.beat.get_mut().unwrap_or_else(PoisonError::into_inner);
        beat.left = true;
        let files = self.cache.files();
        if files.overwrite(&self.path, self.line.len() as u64, &pulse::line(beat)).is_err() {
            let _ = files.remove_file(&self.path);
        }
    }
}

/// What a run has decided on, protected until it ends: the artifacts it has found or made and will read, and
/// the checkpoints it goes on from.
///
/// The keys lie in a few files, each more than twice as large as the next; what is added goes into a small one,
/// and files of one size become one. So a key is written a few times, however many there are, and there are
/// few files to renew.
pub(crate) struct RunLease {
    cache: Cache,
    holder: Holder,
    parts: Vec<Part>,
    keys: BTreeSet<Key>,
    /// Keys that are in no part yet.
    fresh: Vec<Key>,
    beat: Beat,
    renewed: Duration,
}

/// A file of a run's lease.
struct Part {
    path: PathBuf,
    line: Vec<u8>,
    keys: Vec<Key>,
}

/// Keys that are written again rather than kept in a file of their own.
const FEW_KEYS: usize = 64;

impl RunLease {
    /// Of nothing yet.
    pub(crate) fn new(cache: &Cache) -> Self {
        Self {
            cache: cache.clone(),
            holder: Holder::of(cache.node(), Vec::new()),
            parts: Vec::new(),
            keys: BTreeSet::new(),
            fresh: Vec::new(),
            beat: Beat::default(),
            renewed: cache.node().clock.now(),
        }
    }

    /// Adds keys; others see them after [`show`](Self::show).
    pub(crate) fn extend(&mut self, keys: impl IntoIterator<Item = Key>) {
        for key in keys {
            if self.keys.insert(key) {
                self.fresh.push(key);
            }
        }
    }

    /// Lets others see what was added, and that this process is alive.
    pub(crate) fn show(&mut self) {
        if !self.fresh.is_empty() {
            self.write_fresh();
        }
        self.keep_alive();
    }

    fn write_fresh(&mut self) {
        let mut keys = std::mem::take(&mut self.fresh);
        let new = keys.len();
        let mut kept = self.parts.len();
        while kept > 0 && self.parts[kept - 1].keys.len() <= FEW_KEYS.max(2 * keys.len()) {
            kept -= 1;
            keys.extend(&self.parts[kept].keys);
        }
        let path = match self.parts.get(kept) {
            Some(part) => part.path.clone(),
            None => folder(&self.cache).join(format!("run-{}", files::unique())),
        };
        self.holder.reads.clone_from(&keys);
        let line = self.holder.line();
        self.beat.number += 1;
        let files = self.cache.files();
        if put(files, &path, &[&line[..], &pulse::line(&self.beat)].concat()).is_err() {
            keys.truncate(new);
            self.fresh = keys;
            return;
        }
        for part in self.parts.drain(kept..).skip(1) {
            let _ = files.remove_file(&part.path);
        }
        self.parts.push(Part { path, line, keys });
    }

    /// Lets others see that this process is alive, where it has not for a while.
    pub(crate) fn keep_alive(&mut self) {
        let now = self.cache.node().clock.now();
        if now.saturating_sub(self.renewed) < HEARTBEAT {
            return;
        }
        self.renewed = now;
        self.beat.number += 1;
        let (files, beat) = (self.cache.files(), pulse::line(&self.beat));
        for part in &self.parts {
            // A lease that somebody removed is written again.
            if files.overwrite(&part.path, part.line.len() as u64, &beat).is_err() {
                let _ = put(files, &part.path, &[&part.line[..], &beat].concat());
            }
        }
    }
}

impl std::fmt::Debug for RunLease {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("RunLease").field("parts", &self.parts.len()).field("keys", &self.keys.len()).finish()
    }
}

impl Drop for RunLease {
    fn drop(&mut self) {
        let files = self.cache.files();
        for part in &self.parts {
            if files.read(&part.path).is_ok_and(|found| found.starts_with(&part.line)) {
                let _ = files.remove_file(&part.path);
            }
        }
    }
}

fn folder(cache: &Cache) -> PathBuf {
    cache.root().join("leases")
}

enum Created {
    Done,
    Taken,
    Impossible,
}

fn create(files: &dyn Files, path: &Path, bytes: &[u8]) -> Created {
    match files.create_new(path, bytes) {
        Ok(()) => Created::Done,
        // A server whose first answer was lost says so of what it has just made for us.
        Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => {
            let ours = !bytes.is_empty() && files.read(path).is_ok_and(|found| found == bytes);
            if ours { Created::Done } else { Created::Taken }
        }
        Err(_) => Created::Impossible,
    }
}

/// Puts our lease in the place of that of a holder who is gone. Of several processes that do so at once one
/// gets it: who first claims these very bytes.
fn take_over(lease: Lease, dead: &[u8], now: Duration) -> Asked {
    let another = |lease: Lease| {
        lease.never_held();
        Asked::Held("another process on this cache".to_string())
    };
    let (cache, path) = (lease.cache.clone(), lease.path.clone());
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
            return another(lease);
        }
        Created::Impossible => return Asked::Granted(lease.never_held()),
    }
    let asked = if files.read(&path).is_ok_and(|found| found == dead) {
        match put(files, &path, &lease.bytes()) {
            Ok(()) => {
                note_how_it_ended(&cache, &path, dead);
                Asked::Granted(Some(lease))
            }
            Err(_) => Asked::Granted(lease.never_held()),
        }
    } else {
        another(lease)
    };
    let _ = files.remove_file(&claim);
    asked
}

/// What the lease of a holder who is gone says of how he ended; `None` where he gave up himself.
fn killed(dead: &[u8]) -> Option<Killed> {
    let (holder, beat) = Holder::parse(dead)?;
    let beat = beat.unwrap_or_default();
    (!beat.left).then(|| Killed {
        host: holder.host,
        process: holder.process.pid,
        task: holder.task,
        seconds: beat.seconds,
        peak_memory: beat.memory << 20,
        times: 1,
    })
}

/// Remembers of a key's lease whose holder is gone that he was killed, if he was.
fn note_how_it_ended(cache: &Cache, path: &Path, dead: &[u8]) {
    let key = path.file_name().and_then(|name| name.to_str()?.parse::<Key>().ok());
    if let (Some(key), Some(killed)) = (key, killed(dead)) {
        cache.note_killed(&key, killed);
    }
}

/// Writes a lease whole, over what is there. Not synced: after a power cut nobody holds it.
fn put(files: &dyn Files, path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let mut name = path.file_name().unwrap_or_default().to_os_string();
    name.push(format!("{}{}", files::SIBLING, files::unique()));
    let sibling = path.with_file_name(name);
    let written = create_own(files, &sibling, bytes).and_then(|()| files::rename(files, &sibling, path));
    if written.is_err() {
        let _ = files.remove_file(&sibling);
    }
    written
}

/// Creates a file under a name that nobody else has: where it is said to be there already, it is ours.
fn create_own(files: &dyn Files, path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    match files.create_new(path, bytes) {
        Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => Ok(()),
        other => other,
    }
}

/// What the file system with the leases calls now: the time it gives a new file. Comparing two of its times
/// compares no two clocks.
fn file_time(cache: &Cache) -> Option<SystemTime> {
    let path = folder(cache).join(format!("now{}{}", files::SIBLING, files::unique()));
    create_own(cache.files(), &path, b"now").ok()?;
    let time = std::fs::metadata(&path).and_then(|m| m.modified()).ok();
    let _ = cache.files().remove_file(&path);
    time
}

/// Everything that running processes compute, read or go on from now; leases of processes that are gone are
/// removed.
pub(crate) fn in_use(cache: &Cache) -> BTreeSet<Key> {
    let mut keys = BTreeSet::new();
    let mut present = None;
    let entries = std::fs::read_dir(folder(cache)).into_iter().flatten().filter_map(Result::ok);
    for entry in entries {
        let (path, name) = (entry.path(), entry.file_name());
        if name.to_string_lossy().contains(files::SIBLING) {
            continue;
        }
        let live = match judge(cache, &path, cache.node().clock.now()) {
            Judged::Absent => continue,
            Judged::Dead(dead) => {
                note_how_it_ended(cache, &path, &dead);
                None
            }
            Judged::Live(_, Some(holder)) if cache.node().is_alive(&holder.process) == Some(true) => {
                Some(Some(holder))
            }
            Judged::Live(_, holder) => {
                let now = *present.get_or_insert_with(|| file_time(cache));
                let modified = entry.metadata().and_then(|m| m.modified());
                let far = modified.ok().zip(now).is_some_and(|(at, now)| {
                    now.duration_since(at).or_else(|_| at.duration_since(now)).is_ok_and(|d| d > LONG_GONE)
                });
                (!far).then_some(holder)
            }
        };
        match live {
            Some(holder) => {
                keys.extend(name.to_str().and_then(|n| n.parse::<Key>().ok()));
                keys.extend(holder.into_iter().flat_map(|h| h.reads));
            }
            None => drop(cache.files().remove_file(&path)),
        }
    }
    keys
}

/// Who computes a key now, as its lease tells.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Working {
    /// The machine.
    pub host: String,
    /// The process there.
    pub process: u32,
    /// How long it has worked on it by its own clock, seconds; known up to its last sign of life.
    pub seconds: u64,
    /// How long ago that was, seconds, by the clock of the file system.
    pub silent: u64,
    /// Work done.
    pub done: u64,
    /// Work in all; 0 where the stage does not say.
    pub total: u64,
    /// What is counted.
    pub unit: String,
    /// The scheduler's task, where it is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub task: Option<Task>,
}

impl Cache {
    /// Who computes `key` now; `None` where nobody is known to. A holder on another machine that has not been
    /// heard of for long is told as it is: its `silent` says so.
    pub fn working_on(&self, key: &Key) -> Option<Working> {
        let path = folder(self).join(key.to_string());
        let (holder, beat) = Holder::parse(&self.files().read(&path).ok()?)?;
        let beat = beat.unwrap_or_default();
        let alive = self.node().is_alive(&holder.process);
        if beat.left || alive == Some(false) {
            return None;
        }
        let modified = std::fs::metadata(&path).and_then(|m| m.modified()).ok();
        let silent = file_time(self).zip(modified).and_then(|(now, at)| now.duration_since(at).ok());
        let silent_long = silent.is_some_and(|silent| silent >= ASKING);
        if alive.is_none() && silent_long && holder.task.as_ref().is_some_and(|t| self.node().is_over(t)) {
            // Whoever takes it up notes how it ended; until then it is known from here.
            return None;
        }
        Some(Working {
            host: holder.host,
            process: holder.process.pid,
            seconds: beat.seconds,
            silent: silent.map_or(0, |d| d.as_secs()),
            done: beat.done,
            total: beat.total,
            unit: beat.unit,
            task: holder.task,
        })
    }
}

impl Cache {
    /// Who was killed while computing a key: as it was noted, or as his lease tells that he has left behind.
    pub fn killed_at(&self, key: &Key) -> Option<Killed> {
        let path = folder(self).join(key.to_string());
        let left = || -> Option<Killed> {
            let bytes = self.files().read(&path).ok()?;
            // Still at work, as far as anybody knows.
            if self.working_on(key).is_some() {
                return None;
            }
            killed(&bytes)
        };
        match (self.killed(key), left()) {
            (Some(noted), Some(left)) => Some(Killed {
                peak_memory: noted.peak_memory.max(left.peak_memory),
                times: noted.times + 1,
                ..left
            }),
            (noted, left) => noted.or(left),
        }
    }
}

/// How long to wait before a lease that was held is asked for again, the n-th time: doubled each time up to
/// ten seconds, and not the same for all processes.
pub(crate) fn back_off(times: u32, number: u64) -> Duration {
    let base = Duration::from_millis(50).saturating_mul(1 << times.min(8)).min(Duration::from_secs(10));
    let share = (number.rotate_left(times.wrapping_mul(7)) % 256) as u32;
    base * (192 + share / 2) / 256
}

#[cfg(test)]
#[path = "lease/tests.rs"]
mod tests;
