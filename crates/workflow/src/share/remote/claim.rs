//! Claims of keys in a store, so that machines which share nothing but the store rarely do the same work.
//!
//! A claim is a small object that is created only once and removed when the artifact is there. It has the
//! content of a [lease](crate::share::lease), and its holder counts as ended in the same way. Like a lease it
//! only saves time: without claims, artifacts are computed twice, and the first ones stay.

use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use super::receive::Receiver;
use super::{CLAIMS, RemoteError, RemoteStore};
use crate::cache::artifacts::Cache;
use crate::cache::key::Key;
use crate::cache::lock;
use crate::cache::node::Clock;
use crate::share::lease::{HALF, Holder};
use crate::share::pulse::{self, Beat, Progress};

/// The largest size of a claim in bytes.
const LARGEST: u64 = 1 << 16;

/// A claim that this process holds. Dropping it removes it.
pub(crate) struct StoreClaim {
    store: Arc<RemoteStore>,
    name: String,
    line: Vec<u8>,
    beat: Mutex<Beat>,
    since: Duration,
}

/// Result of requesting a claim.
pub(crate) enum ClaimRequest {
    /// This process has the claim, or the store has none (`None`), which is as good.
    Granted(Option<StoreClaim>),
    /// Another process computes this key; the text names it.
    Held(String),
}

impl RemoteStore {
    /// Requests the claim of `key`. A store that fails or permits no claims is no hindrance.
    pub(crate) fn claim(self: &Arc<Self>, cache: &Cache, key: &Key, stop: &AtomicBool) -> ClaimRequest {
        let name = format!("{CLAIMS}{key}");
        let line = Holder::of(&cache.node, Vec::new()).line();
        self.claim_at(cache, name, line, stop).unwrap_or(ClaimRequest::Granted(None))
    }

    fn claim_at(
        self: &Arc<Self>,
        cache: &Cache,
        name: String,
        line: Vec<u8>,
        stop: &AtomicBool,
    ) -> Result<ClaimRequest, RemoteError> {
        let now = cache.node.clock.now();
        let bytes = claimed(&line, &Beat::default());
        if !self.remote.create(&name, &bytes)? {
            let mut found = Receiver::new(Vec::new(), LARGEST, stop);
            if !self.remote.get(&name, &mut found)? {
                return Ok(ClaimRequest::Held("a process that has just ended".to_string()));
            }
            let found = found.into_inner();
            // The reply to the request that created it may have been lost.
            if !found.starts_with(&line) {
                let unchanged = cache.leases.unchanged(Path::new(&name), &found, None, now);
                let (holder, limit) = match Holder::parse(&found) {
                    // It computes a key once at a time, so the removal of this claim has failed.
                    Some((holder, _)) if holder.is(&cache.node) => (holder.name(), Duration::ZERO),
                    Some((holder, _)) => (holder.name(), holder.may_rest(&cache.node, unchanged)),
                    None => ("another process with this store".to_string(), HALF),
                };
                if unchanged < limit {
                    return Ok(ClaimRequest::Held(holder));
                }
                // If two processes do this at once, both may compute the artifact.
                self.remote.remove(&name)?;
                if !self.remote.create(&name, &bytes)? {
                    return Ok(ClaimRequest::Held(holder));
                }
            }
        }
        let (store, beat) = (self.clone(), Mutex::default());
        Ok(ClaimRequest::Granted(Some(StoreClaim { store, name, line, beat, since: now })))
    }
}

/// The bytes of a claim.
fn claimed(line: &[u8], beat: &Beat) -> Vec<u8> {
    [line, &pulse::line(beat)].concat()
}

impl StoreClaim {
    /// Writes a new pulse, as for a lease.
    pub(crate) fn renew(&self, clock: &Clock, progress: &Progress) {
        let mut beat = lock(&self.beat);
        beat.number += 1;
        beat.seconds = clock.now().saturating_sub(self.since).as_secs();
        progress.read(&mut beat);
        let bytes = claimed(&self.line, &beat);
        if self.store.is_worth_asking() {
            let _ = self.store.remote.put(&self.name, &mut &bytes[..], bytes.len() as u64);
        }
    }
}

impl Drop for StoreClaim {
    fn drop(&mut self) {
        if self.store.is_worth_asking() {
            let _ = self.store.remote.remove(&self.name);
        }
    }
}
