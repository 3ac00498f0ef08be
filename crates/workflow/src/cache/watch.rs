//! The observations of leases by one process.
//!
//! A process sees that another machine's process is alive when the file of its lease changes. So the process
//! keeps the last content of every lease that it has read, and the time of the last change by its own clock.

use std::collections::{BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, SystemTime};

use crate::cache::key::Key;

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
        let mut seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        match seen.get(path) {
            Some(s) if s.bytes == bytes && s.modified == modified => now.saturating_sub(s.since),
            _ => {
                seen.insert(
                    path.to_path_buf(),
                    ObservedLease { bytes: bytes.to_vec(), modified, since: now },
                );
                Duration::ZERO
            }
        }
    }

    pub(crate) fn forget(&self, path: &Path) {
        self.seen.lock().unwrap_or_else(PoisonError::into_inner).remove(path);
    }

    pub(crate) fn note_elsewhere(&self, key: &Key) {
        self.elsewhere.lock().unwrap_or_else(PoisonError::into_inner).insert(*key);
    }

    /// Returns true if another machine was observed to compute the key, and forgets it.
    pub(crate) fn was_elsewhere(&self, key: &Key) -> bool {
        self.elsewhere.lock().unwrap_or_else(PoisonError::into_inner).remove(key)
    }
}
