//! Sends all of a pipeline's artifacts to a store, or fetches them from it.

use std::collections::BTreeSet;
use std::fmt;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use serde::Serialize;

use super::super::Builder;
use super::super::cache::Lookup;
use super::super::events::{Event, Listener};
use super::super::graph::Graph;
use super::super::key::Key;
use super::super::machine;
use super::super::manifest::Manifest;
use super::super::plan::{Plan, State};
use super::super::verify::Problem;
use super::{Fetched, RemoteError, RemoteStore, Sent};

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
    fn note(&mut self, manifest: &Manifest, done: &str, listener: &Arc<dyn Listener>) {
        self.moved += 1;
        self.bytes += manifest.bytes();
        let (label, bytes) = (manifest.made_for.to_string(), machine::bytes(manifest.bytes()));
        let text = format!("{done} {} {}, {bytes}", manifest.ingredients.stage, manifest.key.short());
        listener.event(&Event::Note { label: &label, text: &text });
    }

    fn differs(&mut self, stage: &str, key: &Key, file: &str) {
        let what = format!(
            "determinism alarm: the store and the cache have other bytes of {file} for one key; both are kept"
        );
        self.problems.push(Problem { name: format!("{stage} {}", key.short()), what });
    }

    /// Stores an error that concerns one artifact alone, and returns any other error.
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

/// The nodes of a plan that count: stage, key if it is known, and true if the artifact exists. Nodes that
/// share an artifact count once.
fn listed(plan: &Plan) -> Vec<(&'static str, Option<Key>, bool)> {
    let mut seen = BTreeSet::new();
    let nodes = plan.nodes.iter().filter(|n| n.shared_with.is_none() && n.state != State::Unwanted);
    let nodes = nodes.filter(|n| n.key.is_none_or(|key| seen.insert(key)));
    nodes.map(|n| (n.stage, n.key, n.state == State::Cached)).collect()
}

impl Builder {
    /// Sends all cached artifacts of a graph. `check` reads the objects in the store, and replaces those that
    /// do not match.
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
        let mut done = Transferred::default();
        for (stage, key, is_there) in listed(&self.plan(graph, None)) {
            let found = match key.filter(|_| is_there) {
                Some(key) => self.cache.lookup(stage, &key)?,
                None => Lookup::Missing,
            };
            let Lookup::Whole(artifact) = found else {
                done.missing += 1;
                continue;
            };
            match store.send(&self.cache, &artifact, check, stop) {
                Ok(Sent::Now) => done.note(&artifact.manifest, "sent", listener),
                Ok(Sent::Already) => done.already += 1,
                Ok(Sent::Differs(file)) => done.differs(stage, &artifact.manifest.key, &file),
                Err(error) => done.settle(stage, &artifact.manifest.key, error)?,
            }
            if done.interrupted {
                break;
            }
        }
        Ok(done)
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
        let mut done = Transferred::default();
        let mut asked = BTreeSet::new();
        loop {
            let (before, nodes) = (done.moved, listed(&self.plan(graph, None)));
            let there = nodes.iter().filter(|(_, _, is_there)| *is_there).count();
            (done.missing, done.already) = (nodes.len() - there, there.saturating_sub(before));
            for (stage, key, _) in nodes.into_iter().filter(|(_, _, is_there)| !is_there) {
                let Some(key) = key.filter(|key| asked.insert(*key)) else { continue };
                match store.fetch(&self.cache, stage, &key, stop) {
                    Ok(Fetched::Now(artifact)) => done.note(&artifact.manifest, "fetched", listener),
                    Ok(Fetched::Missing) => {}
                    Ok(Fetched::Differs(_, file)) => done.differs(stage, &key, &file),
                    Err(error) => done.settle(stage, &key, error)?,
                }
                if done.interrupted {
                    return Ok(done);
                }
            }
            if done.moved == before {
                return Ok(done);
            }
        }
    }
}
