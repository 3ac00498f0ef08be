//! All of a pipeline's artifacts to a store, or from it.

use std::collections::BTreeSet;
use std::fmt;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use serde::Serialize;

use super::super::Builder;
use super::super::cache::Lookup;
use super::super::events::{Event, Listener};
use super::super::graph::Graph;
use super::super::key::Key;
use super::super::lease::RunLease;
use super::super::machine;
use super::super::manifest::Manifest;
use super::super::plan::{Plan, State};
use super::super::verify::Problem;
use super::transfer::{ARTIFACTS_AT_ONCE, each};
use super::{Fetched, RemoteError, RemoteStore, Sent, Shelf};

/// What was sent or fetched.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Transferred {
    /// Artifacts that were sent or fetched.
    pub moved: usize,
    /// Their bytes.
    pub bytes: u64,
    /// Artifacts that were on the other side already.
    pub already: usize,
    /// Artifacts that are not there to be sent or fetched, and those that wait for them.
    pub missing: usize,
    /// What is not as it should be.
    pub problems: Vec<Problem>,
    /// Whether it was asked to stop before it was done.
    pub interrupted: bool,
}

impl Transferred {
    /// Counts an artifact, and tells how far it is.
    fn note(&mut self, manifest: &Manifest, done: &str, pace: &Pace, listener: &Arc<dyn Listener>) {
        self.moved += 1;
        self.bytes += manifest.bytes();
        let (label, bytes) = (manifest.made_for.to_string(), machine::bytes(manifest.bytes()));
        let (stage, key) = (&manifest.ingredients.stage, manifest.key.short());
        let text = format!("{done} {stage} {key}, {bytes} ({})", pace.words(self.moved, self.bytes));
        listener.event(&Event::Note { label: &label, text: &text });
    }

    fn differs(&mut self, stage: &str, key: &Key, file: &str) {
        let what = format!(
            "determinism alarm: the store and the cache have other bytes of {file} for one key; both stay as they are"
        );
        self.problems.push(Problem { name: format!("{stage} {}", key.short()), what });
    }

    /// Takes an error that concerns one artifact alone, and gives one back that ends it all.
    fn settle(&mut self, stage: &str, key: &Key, error: RemoteError) -> Result<(), RemoteError> {
        match error {
            RemoteError::Wrong { .. } | RemoteError::Damaged(_) => {
                self.problems
                    .push(Problem { name: format!("{stage} {}", key.short()), what: error.to_string() });
                Ok(())
            }
            RemoteError::Stopped => {
                self.interrupted = true;
                Ok(())
            }
            other => Err(other),
        }
    }
}

impl fmt::Display for Transferred {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let artifacts = |n: usize| if n == 1 { "1 artifact".to_string() } else { format!("{n} artifacts") };
        write!(f, "{} ({}) moved, ", artifacts(self.moved), machine::bytes(self.bytes))?;
        writeln!(f, "{} there already, {} missing", self.already, self.missing)?;
        self.problems.iter().try_for_each(|p| writeln!(f, "{}: {}", p.name, p.what))
    }
}

/// A node of a plan that counts: its stage, its key where it has one, whether its artifact is there. Nodes
/// that share an artifact are one.
fn listed(plan: &Plan) -> Vec<(&'static str, Option<Key>, bool)> {
    let mut seen = BTreeSet::new();
    let nodes = plan.nodes.iter().filter(|n| n.shared_with.is_none() && n.state != State::Unwanted);
    let nodes = nodes.filter(|n| n.key.is_none_or(|key| seen.insert(key)));
    nodes.map(|n| (n.stage, n.key, n.state == State::Cached)).collect()
}

/// How far a transfer is, and how fast.
struct Pace {
    start: Instant,
    /// Artifacts to move, as far as that is known.
    total: usize,
}

impl Pace {
    fn words(&self, moved: usize, bytes: u64) -> String {
        let rate = bytes as f64 / self.start.elapsed().as_secs_f64().max(1e-3);
        format!("{moved} of {}, {}/s", self.total.max(moved), machine::bytes(rate as u64))
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Builder {
    /// Sends everything that the cache has of a graph. What the store has already is found in a list of it.
    /// `check` reads back what the store has, and replaces what is not as it should be.
    ///
    /// # Errors
    /// A store that does not answer or take it.
    pub fn push(
        &self,
        graph: &Graph,
        store: &RemoteStore,
        check: bool,
        stop: &AtomicBool,
        listener: &Arc<dyn Listener>,
    ) -> Result<Transferred, RemoteError> {
        let shelf = listing(store, stop)?;
        let mut done = Transferred::default();
        let mut to_send = Vec::new();
        for (stage, key, is_there) in listed(&self.plan(graph, None)) {
            match key.filter(|_| is_there) {
                None => done.missing += 1,
                Some(key) if !check && shelf.as_ref().is_some_and(|s| s.has(stage, &key)) => {
                    done.already += 1
                }
                Some(key) => to_send.push((stage, key)),
            }
        }
        let pace = Pace { start: Instant::now(), total: to_send.len() };
        let done = Mutex::new(done);
        each(&to_send, ARTIFACTS_AT_ONCE, |(stage, key)| {
            if lock(&done).interrupted {
                return Ok(());
            }
            let Lookup::Whole(artifact) = self.cache.lookup(stage, key)? else {
                lock(&done).missing += 1;
                return Ok(());
            };
            let sent = store.send_beside(&self.cache, &artifact, shelf.as_ref(), check, stop);
            let mut done = lock(&done);
            match sent {
                Ok(Sent::Now) => done.note(&artifact.manifest, "sent", &pace, listener),
                Ok(Sent::Already) => done.already += 1,
                Ok(Sent::Differs(file)) => done.differs(stage, key, &file),
                Err(error) => done.settle(stage, key, error)?,
            }
            Ok(())
        })?;
        Ok(done.into_inner().unwrap_or_else(PoisonError::into_inner))
    }

    /// Fetches everything that the store has of a graph and the cache has not. What has no key before its
    /// inputs are there is asked for when they are.
    ///
    /// # Errors
    /// A store that does not answer; a file that cannot be written.
    pub fn pull(
        &self,
        graph: &Graph,
        store: &RemoteStore,
        stop: &AtomicBool,
        listener: &Arc<dyn Listener>,
    ) -> Result<Transferred, RemoteError> {
        self.cache.sweep();
        let shelf = listing(store, stop)?;
        let done = Mutex::new(Transferred::default());
        let mut asked = BTreeSet::new();
        // What is fetched stays until all is: whoever cleans up meanwhile leaves it.
        let mut lease = RunLease::new(&self.cache);
        let mut pace = Pace { start: Instant::now(), total: 0 };
        loop {
            let (before, nodes) = (lock(&done).moved, listed(&self.plan(graph, None)));
            let there = nodes.iter().filter(|(_, _, is_there)| *is_there).count();
            {
                let mut done = lock(&done);
                (done.missing, done.already) = (nodes.len() - there, there.saturating_sub(before));
            }
            pace.total = nodes.len() - lock(&done).already;
            let has = |stage: &str, key: &Key| shelf.as_ref().is_none_or(|shelf| shelf.has(stage, key));
            let to_fetch: Vec<(&str, Key)> = nodes
                .into_iter()
                .filter(|(_, _, is_there)| !is_there)
                .filter_map(|(stage, key, _)| Some((stage, key?)))
                .filter(|(stage, key)| asked.insert(*key) && has(stage, key))
                .collect();
            lease.extend(to_fetch.iter().map(|(_, key)| *key));
            lease.show();
            each(&to_fetch, ARTIFACTS_AT_ONCE, |(stage, key)| {
                if lock(&done).interrupted {
                    return Ok(());
                }
                let fetched = store.fetch(&self.cache, stage, key, stop);
                let mut done = lock(&done);
                match fetched {
                    Ok(Fetched::Now(artifact)) => done.note(&artifact.manifest, "fetched", &pace, listener),
                    Ok(Fetched::Missing) => {}
                    Ok(Fetched::Differs(_, file)) => done.differs(stage, key, &file),
                    Err(error) => done.settle(stage, key, error)?,
                }
                Ok(())
            })?;
            let now = lock(&done);
            if now.interrupted || now.moved == before {
                return Ok(now.clone());
            }
        }
    }
}

/// What a store holds; `None` of one that lets nobody list it, which is asked for everything one by one.
fn listing(store: &RemoteStore, stop: &AtomicBool) -> Result<Option<Shelf>, RemoteError> {
    match store.shelf(stop) {
        Ok(shelf) => Ok(Some(shelf)),
        Err(RemoteError::Stopped) => Ok(None),
        Err(error @ RemoteError::Refused { passing: false, .. }) if !error.is_of_the_whole_store() => {
            tracing::debug!("{error}; asking for every artifact");
            Ok(None)
        }
        Err(error) => Err(error),
    }
}
