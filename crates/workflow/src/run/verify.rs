//! Checks the cache: compares every byte with its digest, and computes a sample again.
//!
//! An artifact that is computed again in its own class of arithmetic must have the same bytes, unless its
//! stage declares that its bytes vary. A cache may
//! also hold artifacts of another machine or another device; if a stage declares that its bytes differ
//! between classes, the figures that it names must agree.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use serde::Serialize;

use crate::cache::artifacts::{Artifact, Cache, Lookup, first_difference};
use crate::cache::files;
use crate::cache::key::Ingredients;
use crate::cache::manifest::{MANIFEST, Manifest, content_digest};
use crate::error::{BuildError, FileError, StageError};
use crate::plan::builder::Builder;
use crate::plan::graph::Graph;
use crate::plan::resolve::Outcome;
use crate::run::runner::RunOptions;
use crate::share::lease::RunLease;
use crate::stage::agree::{self, ArtifactFolder, Verdict};
use crate::stage::events::{Event, Listener};
use use3d_code::digest::Encoder;

/// An artifact that differs from its manifest, or that is not reproduced.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Problem {
    /// The artifact: its stage, and the node it was made for.
    pub name: String,
    /// The problem.
    pub what: String,
}

/// Report of a verification.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Verification {
    /// Number of artifacts checked.
    pub artifacts: usize,
    /// Number of bytes read.
    pub bytes: u64,
    /// The part of the pipeline that is cached and can be computed again; `None` when that was not requested.
    pub held: Option<Held>,
    /// Number of stages that were computed again; `None` when that was not requested.
    pub recomputed: Option<usize>,
    /// Number of those that were made in another class of arithmetic and agree by their figures, not to the
    /// byte.
    pub agreed: usize,
    /// Number of those whose bytes vary from run to run and that agree by their figures; not in `agreed`.
    pub varied: usize,
    /// Number of those that were made in another class and have none of the figures by which their stage
    /// compares; not in `agreed`.
    pub not_compared: usize,
    /// The problems found.
    pub problems: Vec<Problem>,
    /// Number of damaged artifacts, and of files that did not belong to an artifact, that were moved aside.
    pub repaired: usize,
    /// True if it was stopped before the end.
    pub interrupted: bool,
}

/// The part of a pipeline that a cache holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Held {
    /// Number of stages whose artifact is cached, in any class of arithmetic.
    pub cached: usize,
    /// Total number of stages, each counted once for every artifact that it makes.
    pub stages: usize,
}

impl Cache {
    /// Reads every artifact and compares it with its manifest. `repair` moves aside damaged artifacts, and
    /// files that a whole artifact does not list.
    pub fn verify_all(&self, repair: bool) -> Verification {
        let mut found = Verification::default();
        for (stage, key, _) in self.artifacts() {
            found.artifacts += 1;
            let mut name = format!("{stage} {}", key.short());
            let wrong = match self.lookup(&stage, &key) {
                Ok(Lookup::Whole(artifact)) => {
                    name = format!("{stage} of {}", artifact.manifest.made_for);
                    found.bytes += artifact.manifest.bytes();
                    let wrong = self.verify(&artifact, true).err().map(|damaged| damaged.to_string());
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

    /// Reports files in an artifact's folder that its manifest does not list: a reader of the folder might
    /// take them for a part of the result.
    fn look_for_strangers(&self, artifact: &Artifact, name: &str, repair: bool, found: &mut Verification) {
        let listed: BTreeSet<&str> = artifact.manifest.files.iter().map(|f| f.path.as_str()).collect();
        let walk = walkdir::WalkDir::new(&artifact.path).sort_by_file_name();
        for entry in walk.into_iter().filter_map(Result::ok) {
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
        let Manifest { ingredients, key, .. } = &artifact.manifest;
        let folder = self.new_damaged(&ingredients.stage, key);
        files::at(&folder, "create", self.files().create_dir_all(&folder))?;
        let to = folder.join(file.file_name().unwrap_or_default());
        files::at(file, "move aside", files::rename(self.files(), file, &to))
    }
}

/// Result of computing an artifact again.
enum Again {
    Same,
    /// Made in another class of arithmetic: other bytes, figures within their tolerances.
    Agrees,
    /// Made by a stage whose bytes vary: figures within their tolerances.
    Varies,
    /// Made in another class of arithmetic, with nothing to compare; the text gives the reason.
    NotCompared(String),
    /// It differs; the text says how.
    Wrong(String),
    /// The run was stopped.
    Stopped,
}

impl Builder {
    /// Computes a share of the cached stages of `graph` again, in a scratch folder and from the cached
    /// inputs, and compares. The choice follows from the keys, so that it is the same everywhere; at least
    /// one stage is computed.
    pub fn verify_sample(
        &self,
        graph: &Graph,
        share: f64,
        options: &RunOptions,
        listener: &Arc<dyn Listener>,
    ) -> Result<Verification, BuildError> {
        let (cached, outcomes) = self.cached_in_any_class(graph);
        let stages = graph.nodes.iter().filter(|node| node.same_as.is_none()).count();
        let held = Some(Held { cached: cached.len(), stages });
        let mut found = Verification { held, recomputed: Some(0), ..Verification::default() };
        let draw = |made: &RecomputableArtifact| {
            let mut sample = Encoder::new("use3d 2026 verification sample v1");
            sample.bytes(made.artifact.manifest.key.as_bytes()).finish().fraction()
        };
        let mut chosen: Vec<_> = cached.into_iter().map(|made| (draw(&made), made)).collect();
        chosen.sort_by(|a, b| a.0.total_cmp(&b.0));
        let count = chosen.iter().filter(|(draw, _)| *draw < share).count().max(1);
        // The lease keeps the artifacts that are read here until they are compared.
        let mut lease = RunLease::new(&self.cache);
        let ready = |outcome: &Outcome| match outcome {
            Outcome::Ready(artifact) => Some(artifact.manifest.key),
            Outcome::Open | Outcome::Unavailable(_) => None,
        };
        lease.extend(outcomes.iter().filter_map(ready));
        for (_, made) in chosen.into_iter().take(count) {
            if options.stop.load(Ordering::Relaxed) {
                found.interrupted = true;
                break;
            }
            lease.show();
            let label = graph.nodes[made.node].label();
            if let Err(damaged) = self.cache.verify(&made.artifact, false) {
                found.problems.push(Problem { name: label, what: damaged.to_string() });
                continue;
            }
            let text = match made.in_another_class() {
                None => "computing it again to compare".to_string(),
                Some(class) => format!("made as {class}; computing it again as {} to compare", made.class),
            };
            listener.event(&Event::Note { label: &label, text: &text });
            match self.recompute(graph, &made, &outcomes, options, listener)? {
                Again::Same => {}
                Again::Agrees => found.agreed += 1,
                Again::Varies => found.varied += 1,
                Again::NotCompared(what) => {
                    listener.event(&Event::Note { label: &label, text: &what });
                    found.not_compared += 1;
                }
                Again::Wrong(what) => found.problems.push(Problem { name: label, what }),
                // An interruption proves nothing about the artifact.
                Again::Stopped => {
                    found.interrupted = true;
                    break;
                }
            }
            found.artifacts += 1;
            found.recomputed = found.recomputed.map(|n| n + 1);
            found.bytes += made.artifact.manifest.bytes();
        }
        Ok(found)
    }

    /// Finds the cached artifact of each node of a graph: that of this machine's class, else one of another
    /// class with the same ingredients. Later nodes then read the artifact found.
    fn cached_in_any_class(&self, graph: &Graph) -> (Vec<RecomputableArtifact>, Vec<Outcome>) {
        let mut outcomes = self.outcomes(&self.plan(graph, None));
        let mut cached = Vec::new();
        for (i, node) in graph.nodes.iter().enumerate() {
            if let Some(first) = node.same_as {
                outcomes[i] = outcomes[first].clone();
                continue;
            }
            if matches!(outcomes[i], Outcome::Unavailable(_)) {
                continue;
            }
            let Ok(resolved) = self.resolve(graph, i, &outcomes) else { continue };
            let artifact = match self.cache.lookup(node.stage_name, &resolved.key) {
                Ok(Lookup::Whole(artifact)) => Some(artifact),
                _ => self.cache.of_another_class(&resolved.ingredients),
            };
            let Some(artifact) = artifact else { continue };
            outcomes[i] = Outcome::Ready(artifact.clone());
            let class = resolved.ingredients.numeric_class;
            cached.push(RecomputableArtifact { node: i, class, artifact });
        }
        (cached, outcomes)
    }

    /// Makes an artifact again and compares.
    fn recompute(
        &self,
        graph: &Graph,
        made: &RecomputableArtifact,
        outcomes: &[Outcome],
        options: &RunOptions,
        listener: &Arc<dyn Listener>,
    ) -> Result<Again, BuildError> {
        let scratch = self.cache.scratch()?;
        let result = self.run_again(graph, made.node, outcomes, &scratch, options, listener);
        let again = result.map(|result| match result {
            Err(StageError::Cancelled) => Again::Stopped,
            // Some stages report a stop with an error of their own.
            Err(_) if options.stop.load(Ordering::Relaxed) => Again::Stopped,
            Err(error) => Again::Wrong(format!("cannot be computed again: {error}")),
            Ok(files) if content_digest(&files) == made.artifact.manifest.content => Again::Same,
            Ok(files) => {
                let stage = &self.registry.stages()[graph.nodes[made.node].stage];
                let agreement = stage.agreement;
                let different = first_difference(&made.artifact.manifest.files, &files);
                let as_what = match made.in_another_class() {
                    Some(class) => format!("made as {class} and computed again as {}", made.class),
                    None if stage.varies => "computed again".to_string(),
                    None => {
                        let what = format!("determinism alarm: computed again, {different} comes out different");
                        return Again::Wrong(what);
                    }
                };
                let Some(agreement) = agreement else {
                    return Again::Wrong(format!(
                        "determinism alarm: {as_what}, {different} comes out different, although the stage promises \
                         the same bytes everywhere"
                    ));
                };
                let folder = scratch.join("artifact");
                let before = ArtifactFolder { path: &made.artifact.path, files: &made.artifact.manifest.files };
                match agree::compare(&agreement, before, ArtifactFolder { path: &folder, files: &files }) {
                    Verdict::Agree if made.in_another_class().is_none() => Again::Varies,
                    Verdict::Agree => Again::Agrees,
                    Verdict::Apart(what) => Again::Wrong(format!("{as_what}, {what}")),
                    Verdict::NothingToCompare(what) => Again::NotCompared(format!("{as_what}: {what}")),
                }
            }
        });
        let _ = std::fs::remove_dir_all(&scratch);
        again
    }
}

/// An artifact that can be computed again.
struct RecomputableArtifact {
    node: usize,
    /// The class of arithmetic in which it would be made now.
    class: String,
    artifact: Arc<Artifact>,
}

impl RecomputableArtifact {
    /// The class of arithmetic in which it was made, if that is another one.
    fn in_another_class(&self) -> Option<&str> {
        let class = self.artifact.manifest.ingredients.numeric_class.as_str();
        (class != self.class).then_some(class)
    }
}

impl Cache {
    /// The first whole artifact, by key, with the same ingredients except for the class of arithmetic.
    fn of_another_class(&self, ingredients: &Ingredients) -> Option<Arc<Artifact>> {
        let keys = self.artifacts().into_iter().filter(|(stage, ..)| *stage == ingredients.stage);
        keys.into_iter().find_map(|(stage, key, _)| {
            let Ok(Lookup::Whole(artifact)) = self.lookup(&stage, &key) else { return None };
            let theirs = &artifact.manifest.ingredients;
            let same = Ingredients { numeric_class: theirs.numeric_class.clone(), ..ingredients.clone() };
            (*theirs == same).then_some(artifact)
        })
    }
}
