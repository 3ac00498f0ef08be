//! The observations of leases by one process.
//!
//! A process sees that another machine's process is alive when the file of its lease changes. So the process
//! keeps the last content of every lease that it has read, and the time of the last change by its own clock.

use std::collections::{BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::{Duration, SystemTime};

use crate::cache::key::Key;
use crate::cache::lock;

/// The lease files that this process has observed, each with the time of its last change.
#[derive(Debug, Default)]
pub(crate) struct Watch {
    seen: Mutex<HashMap<PathBuf, ObservedLease>>,
    /// Keys that another machine was observed to compute.
    elsewhere: Mutex<BTreeSet<Key>>,
}

#[derive(Debug)]
struct ObservedLease {
    bytes: Vec<u8>,
    modified: Option<SystemTime>,
    since: Duration,
}

impl Watch {
    /// The time for which the file has been observed without a change.
    pub(crate) fn unchanged(
        &self,
        path: &Path,
        bytes: &[u8],
        modified: Option<SystemTime>,
        now: Duration,
    ) -> Duration {
        let mut seen = lock(&self.seen);
        match seen.get(path) {
            Some(s) if s.bytes == bytes && s.modified == modified => now.saturating_sub(s.since),
            _ => {
                let observed = ObservedLease { bytes: bytes.to_vec(), modified, since: now };
                seen.insert(path.to_path_buf(), observed);
                Duration::ZERO
            }
        }
    }

    pub(crate) fn forget(&self, path: &Path) {
        lock(&self.seen).remove(path);
    }

    pub(crate) fn note_elsewhere(&self, key: &Key) {
        lock(&self.elsewhere).insert(*key);
    }

    /// Returns true if another machine was observed to compute the key, and forgets it.
    pub(crate) fn was_elsewhere(&self, key: &Key) -> bool {
        lock(&self.elsewhere).remove(key)
    }
}
