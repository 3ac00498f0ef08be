//! All of a pipeline's artifacts to a store, or from it.

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
    fn note(&mut self, manifest: &Manifest, done: &str, listener: &Arc<dyn Listener>) {
        self.moved += 1;
        self.bytes += manifest.bytes();
        let (label, bytes) = (manifest.made_for.to_string(), machine::bytes(manifest.bytes()));
        let text = format!("{done} {} {}, {bytes}", manifest.ingredients.stage, manifest.key.short());
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

impl Builder {
    /// Sends everything that the cache has of a graph. `check` reads back what the store has, and
    /// replaces what is not as it should be.
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
