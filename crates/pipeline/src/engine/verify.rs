//! Checking the cache: every byte against its digest, and a sample computed again.

use std::sync::Arc;

use serde::Serialize;

use super::Engine;
use super::cache::{Artifact, Cache, Lookup, first_difference};
use super::digest::Encoder;
use super::error::EngineError;
use super::events::{Event, Listener};
use super::graph::Graph;
use super::manifest::content_digest;
use super::plan::State;
use super::resolve::Outcome;
use super::run::RunOptions;

/// Something that is not as it was written, or does not come out the same.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Problem {
    /// The artifact: stage, and what it was made for.
    pub name: String,
    /// What is wrong.
    pub what: String,
}

/// What a verification found.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Verification {
    /// Artifacts that were looked at.
    pub artifacts: usize,
    /// Bytes that were read.
    pub bytes: u64,
    /// Stages that were computed again; none when that was not asked for.
    pub recomputed: Option<usize>,
    /// What is wrong.
    pub problems: Vec<Problem>,
    /// Damaged artifacts that were moved aside.
    pub repaired: usize,
}

impl Cache {
    /// Reads every artifact and compares it with its manifest; with `repair`, moves damaged ones aside.
    pub fn verify_all(&self, repair: bool) -> Verification {
        let mut found = Verification::default();
        for (stage, key, _) in self.artifacts() {
            found.artifacts += 1;
            let mut name = format!("{stage} {}", key.short());
            let wrong = match self.lookup(&stage, &key) {
                Ok(Lookup::Whole(artifact)) => {
                    name = format!("{stage} of {}", artifact.manifest.made_for);
                    found.bytes += artifact.manifest.bytes();
                    self.verify(&artifact, true).err()
                }
                Ok(Lookup::Damaged(reason)) => Some(reason),
                Ok(Lookup::Missing) => None,
                Err(error) => Some(error.to_string()),
            };
            let Some(what) = wrong else { continue };
            if repair && self.set_aside(&stage, &key).is_ok() {
                found.repaired += 1;
            }
            found.problems.push(Problem { name, what });
        }
        found
    }
}

impl Engine {
    /// Computes a share of the cached stages of `graph` again, in a scratch folder and from the cached inputs, and compares. The
    /// choice follows from the keys, so that it is the same everywhere; at least one stage is computed.
    pub fn verify_sample(
        &self,
        graph: &Graph,
        share: f64,
        options: &RunOptions,
        listener: &Arc<dyn Listener>,
    ) -> Result<Verification, EngineError> {
        let plan = self.plan(graph, None);
        let outcomes = self.outcomes(&plan);
        let mut found = Verification { recomputed: Some(0), ..Verification::default() };
        let mut chosen: Vec<(f64, usize)> = Vec::new();
        for (i, node) in plan.nodes.iter().enumerate() {
            if let (State::Cached, None, Some(key)) = (&node.state, &node.shared_with, node.key) {
                let draw = Encoder::new("use3d 2026 verification sample v1")
                    .bytes(key.as_bytes())
                    .finish()
                    .fraction();
                chosen.push((draw, i));
            }
        }
        chosen.sort_by(|a, b| a.0.total_cmp(&b.0));
        let count = chosen.iter().filter(|(draw, _)| *draw < share).count().max(1);
        for (_, i) in chosen.into_iter().take(count) {
            if options.stop.load(std::sync::atomic::Ordering::Relaxed) {
                break;
            }
            let planned = &plan.nodes[i];
            let label = graph.nodes[i].label();
            let Some(key) = planned.key else { continue };
            let Ok(Lookup::Whole(artifact)) = self.cache.lookup(planned.stage, &key) else { continue };
            if let Err(what) = self.cache.verify(&artifact, false) {
                found.problems.push(Problem { name: label, what });
                continue;
            }
            listener.event(&Event::Note { label: &label, text: "computing it again to compare" });
            found.artifacts += 1;
            let wrong = self.recompute(graph, i, &outcomes, &artifact, options, listener)?;
            found.recomputed = found.recomputed.map(|n| n + 1);
            found.bytes += artifact.manifest.bytes();
            found.problems.extend(wrong.map(|what| Problem { name: label, what }));
        }
        Ok(found)
    }

    fn recompute(
        &self,
        graph: &Graph,
        node: usize,
        outcomes: &[Outcome],
        artifact: &Artifact,
        options: &RunOptions,
        listener: &Arc<dyn Listener>,
    ) -> Result<Option<String>, EngineError> {
        let scratch = self.cache.scratch()?;
        let result = self.run_again(graph, node, outcomes, &scratch, options, listener);
        let _ = std::fs::remove_dir_all(&scratch);
        Ok(match result? {
            Err(error) => Some(format!("cannot be computed again: {error}")),
            Ok(files) if content_digest(&files) == artifact.manifest.content => None,
            Ok(files) => Some(format!(
                "determinism alarm: computed again, {} comes out different",
                first_difference(&artifact.manifest.files, &files)
            )),
        })
    }
}
