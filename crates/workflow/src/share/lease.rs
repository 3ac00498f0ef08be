//! Leases: one small file per key that is being computed, so that two processes rarely do the same work at
//! the same time. Each run also has one lease with all the keys it needs, which cleaning up leaves alone.
//!
//! Leases only save time. Results are right without them, because publishing is atomic and the first process
//! wins. So a lease that cannot be written is no error, a lease whose holder has ended is taken over, and
//! nobody ever has to remove one by hand. A holder on this machine is checked by process id and start time. A
//! holder on another machine writes its [pulse](crate::share::pulse) every few seconds. A process that waits
//! for it checks by its own steady clock that the file *changes*; the clocks of two machines are never
//! compared.
//! Removing a lease announces its artifact. A holder that gives up keeps the file and marks it abandoned.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, SystemTime};

use serde::{Deserialize, Serialize};

use crate::cache::artifacts::Cache;
use crate::cache::files::{self, Files};
use crate::cache::key::Key;
use crate::cache::lock;
use crate::cache::machine::ProcessId;
use crate::cache::node::Node;
use crate::cache::task::ClusterTask;
use crate::share::killed::Killed;
use crate::share::pulse::{self, Beat, Progress};
use use3d_code::digest::Digest;

/// Time between two renewals by a holder.
pub(crate) const HEARTBEAT: Duration = Duration::from_secs(10);
/// The time for which a lease of another machine may stay unchanged before its holder counts as ended: many
/// times the heartbeat, and more than the minute for which a network file system may show old content. With
/// two times [`LONGEST_PAUSE`], it is less than two minutes.
const EXPIRY: Duration = Duration::from_secs(100);
/// The longest time between two requests for a lease that another process holds.
const LONGEST_PAUSE: Duration = Duration::from_secs(5);
/// The time after which a scheduler is asked if the holder's task is over: longer than a heartbeat.
const ASKING: Duration = Duration::from_secs(12);
/// The time for which a run waits for the work of other processes before it leaves that work to them. It is
/// longer than the time after which a lease expires, so the work of a killed process is taken over.
pub const PATIENCE: Duration = Duration::from_secs(150);
/// The same limit for a file without a readable holder: it is being written at this moment, or a crash left
/// it unfinished.
pub(super) const HALF: Duration = Duration::from_secs(5);
/// A single look cannot see a lease change, so a lease that is older than this, by the time of the file
/// system, counts as abandoned.
const LONG_GONE: Duration = Duration::from_secs(86_400);

#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Holder {
    process: ProcessId,
    host: String,
    token: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    task: Option<ClusterTask>,
    /// Keys of the artifacts and checkpoints that the holder reads or resumes from; cleaning up leaves them.
    pub(crate) reads: Vec<Key>,
}

impl Holder {
    pub(super) fn of(node: &Node, reads: Vec<Key>) -> Self {
        Self {
            process: node.process.clone(),
            host: node.host.clone(),
            token: files::unique(),
            task: node.task.clone(),
            reads,
        }
    }

    /// The first line of a lease; its pulse follows.
    pub(super) fn line(&self) -> Vec<u8> {
        let mut line = serde_json::to_vec(self).unwrap_or_default();
        line.push(b'\n');
        line
    }

    /// Parses a lease's bytes: the holder, and the pulse if there is one.
    pub(super) fn parse(bytes: &[u8]) -> Option<(Self, Option<Beat>)> {
        let end = bytes.iter().position(|b| *b == b'\n').unwrap_or(bytes.len());
        let holder = serde_json::from_slice(&bytes[..end]).ok()?;
        Some((holder, bytes.get(end + 1..).and_then(pulse::parse)))
    }

    /// True if it is this process.
    pub(super) fn is(&self, node: &Node) -> bool {
        self.process == node.process && self.host == node.host
    }

    /// Its name, for display.
    pub(super) fn name(&self) -> String {
        format!("process {} on {}", self.process.pid, self.host)
    }

    /// The time for which its lease may stay unchanged before it counts as ended, if it has been `unchanged`
    /// until now.
    pub(super) fn may_rest(&self, node: &Node, unchanged: Duration) -> Duration {
        match (node.is_alive(&self.process), &self.task) {
            (Some(true), _) => Duration::MAX,
            (Some(false), _) => Duration::ZERO,
            (None, Some(task)) if node.has_followed(task) => Duration::ZERO,
            // A living holder has renewed its lease meanwhile.
            (None, Some(task)) if unchanged >= ASKING && node.is_over(task) => Duration::ZERO,
            (None, _) => EXPIRY,
        }
    }
}

/// State of a lease.
#[derive(Debug)]
enum Judged {
    Absent,
    /// Another process holds it: its name, and the holder if it can be read.
    Live(String, Option<Box<Holder>>),
    /// The holder has ended or given up; the bytes of the lease.
    Dead(Vec<u8>),
}

fn judge(cache: &Cache, path: &Path, now: Duration) -> Judged {
    let (watch, node) = (&cache.leases, &cache.node);
    let bytes = match cache.files().read(path) {
        Ok(bytes) => bytes,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
            watch.forget(path);
            return Judged::Absent;
        }
        // An unreadable file counts as a file without a holder.
        Err(_) => Vec::new(),
    };
    let unchanged = watch.unchanged(path, &bytes, modified(path), now);
    let (limit, name, holder) = match Holder::parse(&bytes) {
        Some((_, Some(beat))) if beat.left => return Judged::Dead(bytes),
        Some((holder, _)) => {
            let (limit, name) = (holder.may_rest(node, unchanged), holder.name());
            (limit, name, Some(Box::new(holder)))
        }
        None => (HALF, "another process on this cache".to_string(), None),
    };
    if unchanged < limit { Judged::Live(name, holder) } else { Judged::Dead(bytes) }
}

/// A lease that this process holds. Dropping it marks it as abandoned.
pub(crate) struct Lease {
    cache: Cache,
    path: PathBuf,
    line: Vec<u8>,
    beat: Mutex<Beat>,
    since: Duration,
    /// Another machine computed this key and its lease was removed: the artifact may exist but not be visible
    /// yet.
    pub(crate) followed: bool,
}

/// Result of requesting a lease.
pub(crate) enum LeaseRequest {
    /// This process has the lease, or leases do not work here (`None`), which is as good.
    Granted(Option<Box<Lease>>),
    /// Another process computes this key; the text names it.
    Held(String),
}

impl Lease {
    /// Requests the lease of `key`.
    pub(crate) fn ask(cache: &Cache, key: &Key, reads: &[Key]) -> LeaseRequest {
        Self::ask_at(cache, key, reads, cache.node.clock.now())
    }

    fn ask_at(cache: &Cache, key: &Key, reads: &[Key], now: Duration) -> LeaseRequest {
        let path = folder(cache).join(key.to_string());
        let line = Holder::of(&cache.node, reads.to_vec()).line();
        let bytes = [&line[..], &pulse::line(&Beat::default())].concat();
        let (created, followed) = match create(cache.files(), &path, &bytes) {
            Created::Done => (Created::Done, cache.leases.was_elsewhere(key)),
            Created::Impossible => (Created::Impossible, false),
            Created::Taken => match judge(cache, &path, now) {
                Judged::Live(name, holder) => {
                    if holder.is_some_and(|h| cache.node.is_alive(&h.process).is_none()) {
                        cache.leases.note_elsewhere(key);
                    }
                    return LeaseRequest::Held(name);
                }
                Judged::Absent => return LeaseRequest::Held("a process that has just ended".to_string()),
                Judged::Dead(dead) => {
                    cache.leases.was_elsewhere(key);
                    (take_over(cache, &path, &bytes, &dead, now), false)
                }
            },
        };
        match created {
            Created::Done => {
                let (cache, beat) = (cache.clone(), Mutex::default());
                LeaseRequest::Granted(Some(Box::new(Self { cache, path, line, beat, since: now, followed })))
            }
            Created::Impossible => LeaseRequest::Granted(None),
            Created::Taken => LeaseRequest::Held("another process on this cache".to_string()),
        }
    }

    /// Returns true if the file is this lease's: another process may have taken it over while this one was
    /// suspended.
    fn is_ours(&self) -> bool {
        self.cache.files().read(&self.path).is_ok_and(|found| found.starts_with(&self.line))
    }

    /// Writes a new pulse: the holder is alive, and this is its progress.
    pub(crate) fn renew(&self, progress: &Progress) {
        let mut beat = lock(&self.beat);
        beat.number += 1;
        beat.seconds = self.cache.node.clock.now().saturating_sub(self.since).as_secs();
        progress.read(&mut beat);
        if self.is_ours() {
            let _ = self.cache.files().overwrite(&self.path, self.line.len() as u64, &pulse::line(&beat));
        }
    }

    /// Removes the lease because the artifact exists: no process needs to wait any more.
    pub(crate) fn finish(mut self) {
        if self.is_ours() {
            let _ = self.cache.files().remove_file(&self.path);
        }
        self.line.clear();
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

/// The keys that a run needs, protected until it ends: the artifacts that it has found or made and will read,
/// and the checkpoints that it resumes from.
///
/// The keys are in a few files, each more than twice as large as the next. Added keys go into a small file,
/// and two files of about the same size are merged. So a key is written only a few times, however many there
/// are, and few files need renewal.
pub(crate) struct RunLease {
    cache: Cache,
    holder: Holder,
    parts: Vec<LeaseFile>,
    keys: BTreeSet<Key>,
    /// The keys that are not yet in a part.
    fresh: Vec<Key>,
    beat: Beat,
    renewed: Duration,
}

/// One file of a run's lease.
struct LeaseFile {
    path: PathBuf,
    line: Vec<u8>,
    keys: Vec<Key>,
}

/// The number of keys below which they are written again instead of kept in a file of their own.
const FEW_KEYS: usize = 64;

impl RunLease {
    /// A run's lease without keys.
    pub(crate) fn new(cache: &Cache) -> Self {
        Self {
            cache: cache.clone(),
            holder: Holder::of(&cache.node, Vec::new()),
            parts: Vec::new(),
            keys: BTreeSet::new(),
            fresh: Vec::new(),
            beat: Beat::default(),
            renewed: cache.node.clock.now(),
        }
    }

    /// Adds keys; other processes see them after [`show`](Self::show).
    pub(crate) fn extend(&mut self, keys: impl IntoIterator<Item = Key>) {
        for key in keys {
            if self.keys.insert(key) {
                self.fresh.push(key);
            }
        }
    }

    /// Publishes the added keys, and a pulse of this process.
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
        self.parts.push(LeaseFile { path, line, keys });
    }

    /// Writes the pulse if it is due, so that other processes see that this one is alive.
    pub(crate) fn keep_alive(&mut self) {
        let now = self.cache.node.clock.now();
        if now.saturating_sub(self.renewed) < HEARTBEAT {
            return;
        }
        self.renewed = now;
        self.beat.number += 1;
        let (files, beat) = (self.cache.files(), pulse::line(&self.beat));
        for part in &self.parts {
            // If another process removed the lease, it is written again.
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
        // A server whose first reply was lost may report that the file exists, although this call created it.
        Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => {
            let ours = !bytes.is_empty() && files.read(path).is_ok_and(|found| found == bytes);
            if ours { Created::Done } else { Created::Taken }
        }
        Err(_) => Created::Impossible,
    }
}

/// The beginning of a claim's name after the lease's. Its content is the name of its process.
pub(super) const CLAIM: &str = "claim-";

/// Replaces the lease of a holder that has ended by `bytes`. If several processes try at once, one succeeds:
/// the first that creates the claim file for these very bytes.
fn take_over(cache: &Cache, path: &Path, bytes: &[u8], dead: &[u8], now: Duration) -> Created {
    let files = cache.files();
    let claim = files::sibling(path, &format!("{CLAIM}{}", Digest::of(dead).short()));
    match create(files, &claim, files::unique().as_bytes()) {
        Created::Done => {}
        Created::Taken => {
            if cache.leases.unchanged(&claim, &[], modified(&claim), now) >= HALF {
                // The process that created the claim was killed before it finished.
                let _ = files.remove_file(&claim);
            }
            return Created::Taken;
        }
        Created::Impossible => return Created::Impossible,
    }
    let created = if files.read(path).is_ok_and(|found| found == dead) {
        match put(files, path, bytes) {
            Ok(()) => {
                note_how_it_ended(cache, path, dead);
                Created::Done
            }
            Err(_) => Created::Impossible,
        }
    } else {
        Created::Taken
    };
    let _ = files.remove_file(&claim);
    created
}

/// The time of a file's last change.
fn modified(path: &Path) -> Option<SystemTime> {
    std::fs::metadata(path).and_then(|found| found.modified()).ok()
}

/// Returns the end of a holder from its last lease; `None` if it gave up by itself.
fn killed(dead: &[u8]) -> Option<Killed> {
    let (holder, beat) = Holder::parse(dead)?;
    let beat = beat.unwrap_or_default();
    (!beat.left).then_some(Killed {
        host: holder.host,
        process: holder.process.pid,
        task: holder.task,
        seconds: beat.seconds,
        peak_memory: beat.memory << 20,
        times: 1,
    })
}

/// Notes for a key that the holder of this lease was killed, if it was.
fn note_how_it_ended(cache: &Cache, path: &Path, dead: &[u8]) {
    let key = path.file_name().and_then(|name| name.to_str()?.parse::<Key>().ok());
    if let (Some(key), Some(killed)) = (key, killed(dead)) {
        cache.note_killed(&key, killed);
    }
}

/// Writes a whole lease over the old file. It is not synced: after a power cut no process holds it.
fn put(files: &dyn Files, path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let sibling = files::sibling(path, &files::unique());
    let written =
        files::create_own(files, &sibling, bytes).and_then(|()| files::rename(files, &sibling, path));
    if written.is_err() {
        let _ = files.remove_file(&sibling);
    }
    written
}

/// The present time of the file system with the leases: the time it gives to a new file. Comparing two times
/// of one file system compares no two clocks.
fn file_time(cache: &Cache) -> Option<SystemTime> {
    let path = folder(cache).join(format!("now{}{}", files::SIBLING, files::unique()));
    files::create_own(cache.files(), &path, b"now").ok()?;
    let time = modified(&path);
    let _ = cache.files().remove_file(&path);
    time
}

/// Returns all keys that running processes compute, read or resume from; removes the leases of processes that
/// have ended.
pub(crate) fn in_use(cache: &Cache) -> BTreeSet<Key> {
    let mut keys = BTreeSet::new();
    let mut present = None;
    for entry in files::entries(&folder(cache)) {
        let (path, name) = (entry.path(), entry.file_name());
        if name.to_string_lossy().contains(files::SIBLING) {
            continue;
        }
        let live = match judge(cache, &path, cache.node.clock.now()) {
            Judged::Absent => continue,
            Judged::Dead(dead) => {
                note_how_it_ended(cache, &path, &dead);
                None
            }
            Judged::Live(_, Some(holder)) if cache.node.is_alive(&holder.process) == Some(true) => {
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

/// The process that computes a key now, from its lease.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Working {
    /// The machine.
    pub host: String,
    /// The process id there.
    pub process: u32,
    /// The time it has worked on the key, in seconds by its own clock, up to its last pulse.
    pub seconds: u64,
    /// The time since that pulse, in seconds by the clock of the file system.
    pub silent: u64,
    /// Work done.
    pub done: u64,
    /// Total work; 0 where the stage does not report it.
    pub total: u64,
    /// The unit of the work.
    pub unit: String,
    /// The scheduler's task of the holder, if there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub task: Option<ClusterTask>,
}

impl Cache {
    /// Returns the process that computes `key` now; `None` if none is known. A holder on another machine
    /// without a recent pulse is also returned; its `silent` is then large.
    pub fn working_on(&self, key: &Key) -> Option<Working> {
        let path = folder(self).join(key.to_string());
        let (holder, beat) = Holder::parse(&self.files().read(&path).ok()?)?;
        let beat = beat.unwrap_or_default();
        let alive = self.node.is_alive(&holder.process);
        if beat.left || alive == Some(false) {
            return None;
        }
        let silent = file_time(self).zip(modified(&path)).and_then(|(now, at)| now.duration_since(at).ok());
        let silent_long = silent.is_some_and(|silent| silent >= ASKING);
        if alive.is_none() && silent_long && holder.task.as_ref().is_some_and(|t| self.node.is_over(t)) {
            // The next holder notes the end; until then the lease itself shows it.
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

    /// Returns the process that was killed while it computed a key, from a note or from the lease it left.
    pub fn killed_at(&self, key: &Key) -> Option<Killed> {
        let left = || {
            let bytes = self.files().read(&folder(self).join(key.to_string())).ok()?;
            // The holder may still be at work.
            killed(&bytes).filter(|_| self.working_on(key).is_none())
        };
        match (self.killed(key), left()) {
            (Some(noted), Some(left)) => Some(Killed {
                peak_memory: noted.peak_memory.max(left.peak_memory),
                times: noted.times.saturating_add(1),
                ..left
            }),
            (noted, left) => noted.or(left),
        }
    }
}

/// The time to wait before the n-th new request for a lease that was held: doubled each time up to about five
/// seconds, and different for different processes.
pub(crate) fn back_off(times: u32, number: u64) -> Duration {
    let base = Duration::from_millis(50).saturating_mul(1 << times.min(8)).min(LONGEST_PAUSE);
    let share = (number.rotate_left(times.wrapping_mul(7)) % 256) as u32;
    base * (192 + share / 2) / 256
}

#[cfg(test)]
#[path = "lease/tests.rs"]
mod tests;
