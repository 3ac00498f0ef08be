//! Sends all of a pipeline's artifacts to a store, or fetches them from it.

use std::collections::BTreeSet;
use std::fmt;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use serde::Serialize;

use crate::cache::artifacts::Lookup;
use crate::cache::key::Key;
use crate::cache::lock;
use crate::cache::machine;
use crate::cache::manifest::Manifest;
use crate::plan::builder::Builder;
use crate::plan::graph::Graph;
use crate::plan::planning::{Plan, State};
use crate::run::verify::Problem;
use crate::share::lease::RunLease;
use crate::share::remote::transfer::{ARTIFACTS_AT_ONCE, each};
use crate::share::remote::{Fetched, RemoteError, RemoteStore, Sent, Shelf};
use crate::stage::events::{Event, Listener};

/// Report of sending or fetching.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Transferred {
    /// Number of artifacts that were sent or fetched.
    pub moved: usize,
    /// Their bytes.
    pub bytes: u64,
    /// Number of artifacts that were on the other side already.
    pub already: usize,
    /// Number of artifacts that do not exist on the sending side, and of those that depend on them.
    pub missing: usize,
    /// The problems found.
    pub problems: Vec<Problem>,
    /// True if it was stopped before the end.
    pub interrupted: bool,
}

impl Transferred {
    /// Counts an artifact and reports the progress.
    fn note(&mut self, manifest: &Manifest, done: &str, pace: &Rate, listener: &Arc<dyn Listener>) {
        self.moved += 1;
        self.bytes += manifest.bytes();
        let (label, bytes) = (manifest.made_for.to_string(), machine::bytes(manifest.bytes()));
        let (stage, key) = (&manifest.ingredients.stage, manifest.key.short());
        let text = format!("{done} {stage} {key}, {bytes} ({})", pace.words(self.moved, self.bytes));
        listener.event(&Event::Note { label: &label, text: &text });
    }

    fn differs(&mut self, stage: &str, key: &Key, file: &str) {
        let what = format!(
            "determinism alarm: the store and the cache have other bytes of {file} for one key; both are kept"
        );
        self.add_problem(stage, key, what);
    }

    fn add_problem(&mut self, stage: &str, key: &Key, what: String) {
        self.problems.push(Problem { name: format!("{stage} {}", key.short()), what });
    }

    /// Stores an error that concerns one artifact alone, and returns any other error.
    fn settle(&mut self, stage: &str, key: &Key, error: RemoteError) -> Result<(), RemoteError> {
        match error {
            RemoteError::Wrong { .. } => {
                let mend = "`use3d push --check` from a cache that has this artifact mends the store";
                self.add_problem(stage, key, format!("{error}; {mend}"));
            }
            RemoteError::Damaged(_) => self.add_problem(stage, key, error.to_string()),
            RemoteError::Stopped => self.interrupted = true,
            other => return Err(other),
        }
        Ok(())
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

/// The nodes of a plan that count: stage, key if it is known, and true if the artifact exists. Nodes that
/// share an artifact count once.
fn listed(plan: &Plan) -> Vec<(&'static str, Option<Key>, bool)> {
    let mut seen = BTreeSet::new();
    let nodes = plan.nodes.iter().filter(|n| n.shared_with.is_none() && n.state != State::Unwanted);
    let nodes = nodes.filter(|n| n.key.is_none_or(|key| seen.insert(key)));
    nodes.map(|n| (n.stage, n.key, n.state == State::Cached)).collect()
}

/// The progress and the rate of a transfer.
struct Rate {
    start: Instant,
    /// The number of artifacts to move, as far as it is known.
    total: usize,
}

impl Rate {
    fn words(&self, moved: usize, bytes: u64) -> String {
        let rate = bytes as f64 / self.start.elapsed().as_secs_f64().max(1e-3);
        format!("{moved} of {}, {}/s", self.total.max(moved), machine::bytes(rate as u64))
    }
}

impl Builder {
    /// True if a stage may give other bytes on every run, so that two results of one key are no alarm.
    fn varies(&self, stage: &str) -> bool {
        self.registry.stage(stage).is_ok_and(|stage| stage.varies)
    }

    /// Sends all cached artifacts of a graph. A list of the store shows which ones it already has. `check`
    /// reads the objects in the store, and replaces those that do not match.
    ///
    /// # Errors
    /// A store that does not answer or refuses the data.
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
                    done.already += 1;
                }
                Some(key) => to_send.push((stage, key)),
            }
        }
        let pace = Rate { start: Instant::now(), total: to_send.len() };
        let done = Mutex::new(done);
        each(&to_send, ARTIFACTS_AT_ONCE, |(stage, key)| {
            if lock(&done).interrupted {
                return Ok(());
            }
            let Lookup::Whole(artifact) = self.cache.lookup(stage, key)? else {
                lock(&done).missing += 1;
                return Ok(());
            };
            let sent = store.send(&self.cache, &artifact, shelf.as_ref(), check, stop);
            let mut done = lock(&done);
            match sent {
                Ok(Sent::Now) => done.note(&artifact.manifest, "sent", &pace, listener),
                Ok(Sent::Already) => done.already += 1,
                Ok(Sent::Differs(_)) if self.varies(stage) => done.already += 1,
                Ok(Sent::Differs(file)) => done.differs(stage, key, &file),
                Err(error) => done.settle(stage, key, error)?,
            }
            Ok(())
        })?;
        Ok(done.into_inner().unwrap_or_else(PoisonError::into_inner))
    }

    /// Fetches all artifacts of a graph that the store has and the cache lacks. A node whose key depends on
    /// missing inputs is fetched after its inputs.
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
        // A lease protects the fetched artifacts from a cleaning until all are fetched.
        let mut lease = RunLease::new(&self.cache);
        let mut pace = Rate { start: Instant::now(), total: 0 };
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
                    Ok(Fetched::Differs(..)) if self.varies(stage) => done.already += 1,
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

/// Lists a store; `None` if it permits no list. Such a store is asked for every artifact.
fn listing(store: &RemoteStore, stop: &AtomicBool) -> Result<Option<Shelf>, RemoteError> {
    match store.shelf(stop) {
        Ok(shelf) => Ok(Some(shelf)),
        Err(RemoteError::Stopped) => Ok(None),
        Err(error @ RemoteError::Refused { passing: false, .. }) => {
            tracing::debug!("{error}; asking for every artifact");
            Ok(None)
        }
        Err(error) => Err(error),
    }
}
