//! Who computes what now: one small file per key, so that two processes rarely do the same work at the same time.
//!
//! Leases only save time. Results are right without them, because publishing is atomic and the first wins; so a lease
//! that cannot be written is no error, one whose holder is gone is taken over, and nobody ever has to remove one by hand. A
//! holder on this machine is asked for by process id and start time; one on another machine must have renewed its
//! lease within a minute and a half.

use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::cache::Cache;
use super::files::{self, Files};
use super::key::Key;
use super::machine::{Machine, ProcessId};

/// How often a holder renews.
pub(crate) const HEARTBEAT: Duration = Duration::from_secs(10);
const EXPIRY: Duration = Duration::from_secs(90);

#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Holder {
    process: ProcessId,
    host: String,
    token: String,
    /// Artifacts the holder reads: cleaning up leaves them.
    pub(crate) reads: Vec<Key>,
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
        let path = cache.root().join("leases").join(key.to_string());
        let holder = Holder {
            process: ProcessId::this(),
            host: Machine::this().host,
            token: files::unique(),
            reads: reads.to_vec(),
        };
        let bytes = serde_json::to_vec(&holder).unwrap_or_default();
        let files = cache.files();
        match files.create_new(&path, &bytes) {
            Ok(()) => Asked::Granted(Some(Self { path, bytes })),
            Err(e) if e.kind() == std::io::ErrorKind::AlreadyExists => match live_holder(&path) {
                Some(other) => Asked::Held(format!("process {} on {}", other.process.pid, other.host)),
                None => Asked::Granted(take_over(files, path, bytes)),
            },
            Err(_) => Asked::Granted(None),
        }
    }

    /// Shows that the holder is alive.
    pub(crate) fn renew(&self) {
        let now = std::time::SystemTime::now();
        let _ = std::fs::File::options().write(true).open(&self.path).and_then(|f| f.set_modified(now));
    }
}

impl Drop for Lease {
    fn drop(&mut self) {
        // Only one's own: it may have been taken over while this process was stopped.
        if std::fs::read(&self.path).is_ok_and(|bytes| bytes == self.bytes) {
            let _ = std::fs::remove_file(&self.path);
        }
    }
}

/// Puts our name over that of a holder who is gone. Two processes may do so at once; then both compute, and the first
/// result counts.
fn take_over(files: &dyn Files, path: PathBuf, bytes: Vec<u8>) -> Option<Lease> {
    files::write_atomic(files, &path, &bytes).ok()?;
    Some(Lease { path, bytes })
}

fn live_holder(path: &Path) -> Option<Holder> {
    let age = std::fs::metadata(path).and_then(|m| m.modified()).ok()?.elapsed().unwrap_or_default();
    let bytes = std::fs::read(path).ok()?;
    match serde_json::from_slice::<Holder>(&bytes) {
        Ok(holder) => match holder.process.is_alive() {
            Some(alive) => alive.then_some(holder),
            None => (age < EXPIRY).then_some(holder),
        },
        // Being written at this moment, or left half-written by a crash.
        Err(_) => (age < Duration::from_secs(2)).then(|| Holder {
            process: ProcessId { place: String::new(), pid: 0, started: 0 },
            host: "this cache".to_string(),
            token: String::new(),
            reads: Vec::new(),
        }),
    }
}

/// Everything that running processes compute or read now; leases of processes that are gone are removed.
pub(crate) fn in_use(cache: &Cache) -> Vec<Key> {
    let mut keys = Vec::new();
    let entries = std::fs::read_dir(cache.root().join("leases")).into_iter().flatten().filter_map(Result::ok);
    for path in entries.map(|e| e.path()) {
        match live_holder(&path) {
            Some(holder) => {
                let key: Option<Key> = path.file_name().and_then(|n| n.to_str()).and_then(|n| n.parse().ok());
                keys.extend(key);
                keys.extend(holder.reads);
            }
            None => {
                let _ = std::fs::remove_file(&path);
            }
        }
    }
    keys
}
