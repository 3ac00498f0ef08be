//! Checking the cache: every byte against its digest, and a sample computed again.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use serde::Serialize;

use super::Engine;
use super::cache::{Artifact, Cache, Lookup, first_difference};
use super::digest::Encoder;
use super::error::{EngineError, FileError, StageError};
use super::events::{Event, Listener};
use super::files;
use super::graph::Graph;
use super::lease::RunLease;
use super::manifest::{MANIFEST, content_digest};
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
    /// Damaged artifacts, and files that did not belong into an artifact, that were moved aside.
    pub repaired: usize,
    /// Whether it was asked to stop before it was done.
    pub interrupted: bool,
}

impl Cache {
    /// Reads every artifact and compares it with its manifest; with `repair`, moves damaged ones aside, and files that somebody
    /// put into a whole one.
    pub fn verify_all(&self, repair: bool) -> Verification {
        let mut found = Verification::default();
        for (stage, key, _) in self.artifacts() {
            found.artifacts += 1;
            let mut name = format!("{stage} {}", key.short());
            let wrong = match self.lookup(&stage, &key) {
                Ok(Lookup::Whole(artifact)) => {
                    name = format!("{stage} of {}", artifact.manifest.made_for);
                    found.bytes += artifact.manifest.bytes();
                    let wrong = self.verify(&artifact, true).err();
                    if wrong.is_none() {
                        self.look_for_strangers(&artifact, &name, repair, &mut found);
                    }
                    wrong
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

    /// Names what lies in an artifact's folder without being in its manifest: whoever reads the folder might take it for a
    /// part of the result.
    fn look_for_strangers(&self, artifact: &Artifact, name: &str, repair: bool, found: &mut Verification) {
        let listed: BTreeSet<&str> = artifact.manifest.files.iter().map(|f| f.path.as_str()).collect();
        for entry in
            walkdir::WalkDir::new(&artifact.path).sort_by_file_name().into_iter().filter_map(Result::ok)
        {
            let relative = entry.path().strip_prefix(&artifact.path).unwrap_or(entry.path());
            let path = files::relative_name(relative);
            let ours = path.as_deref().is_some_and(|p| p == MANIFEST || listed.contains(p));
            if entry.file_type().is_dir() || ours {
                continue;
            }
            let shown = relative.display();
            let what = if repair && self.set_file_aside(artifact, entry.path()).is_ok() {
                found.repaired += 1;
                format!("{shown} does not belong there; it was moved aside")
            } else {
                format!("{shown} does not belong there")
            };
            found.problems.push(Problem { name: name.to_string(), what });
        }
    }

    fn set_file_aside(&self, artifact: &Artifact, file: &Path) -> Result<(), FileError> {
        let stage = &artifact.manifest.ingredients.stage;
        let folder = self.root().join("damaged").join(format!(
            "{stage}-{}-{}",
            artifact.manifest.key.short(),
            files::unique()
        ));
        files::at(&folder, "create", self.files().create_dir_all(&folder))?;
        let to = folder.join(file.file_name().unwrap_or_default());
        files::at(file, "move aside", self.files().rename(file, &to))
    }
}

/// What came of computing an artifact again.
enum Again {
    Same,
    /// In words.
    Wrong(String),
    /// It was asked to stop.
    Stopped,
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
        // What is read here is needed until it is compared.
        let mut lease = RunLease::new(&self.cache);
        lease.extend(plan.nodes.iter().filter_map(|n| n.key));
        for (_, i) in chosen.into_iter().take(count) {
            if options.stop.load(Ordering::Relaxed) {
                found.interrupted = true;
                break;
            }
            lease.show();
            let planned = &plan.nodes[i];
            let label = graph.nodes[i].label();
            let Some(key) = planned.key else { continue };
            let Ok(Lookup::Whole(artifact)) = self.cache.lookup(planned.stage, &key) else { continue };
            if let Err(what) = self.cache.verify(&artifact, false) {
                found.problems.push(Problem { name: label, what });
                continue;
            }
            listener.event(&Event::Note { label: &label, text: "computing it again to compare" });
            match self.recompute(graph, i, &outcomes, &artifact, options, listener)? {
                Again::Same => {}
                Again::Wrong(what) => found.problems.push(Problem { name: label, what }),
                // This says nothing about the artifact.
                Again::Stopped => {
                    found.interrupted = true;
                    break;
                }
            }
            found.artifacts += 1;
            found.recomputed = found.recomputed.map(|n| n + 1);
            found.bytes += artifact.manifest.bytes();
        }
        Ok(found)
    }

    /// Makes an artifact again and compares.
    fn recompute(
        &self,
        graph: &Graph,
        node: usize,
        outcomes: &[Outcome],
        artifact: &Artifact,
        options: &RunOptions,
        listener: &Arc<dyn Listener>,
    ) -> Result<Again, EngineError> {
        let scratch = self.cache.scratch()?;
        let result = self.run_again(graph, node, outcomes, &scratch, options, listener);
        let _ = std::fs::remove_dir_all(&scratch);
        Ok(match result? {
            Err(StageError::Cancelled) => Again::Stopped,
            // Some stages say in their own words that they were asked to stop.
            Err(_) if options.stop.load(Ordering::Relaxed) => Again::Stopped,
            Err(error) => Again::Wrong(format!("cannot be computed again: {error}")),
            Ok(files) if content_digest(&files) == artifact.manifest.content => Again::Same,
            Ok(files) => Again::Wrong(format!(
                "determinism alarm: computed again, {} comes out different",
                first_difference(&artifact.manifest.files, &files)
            )),
        })
    }
}
