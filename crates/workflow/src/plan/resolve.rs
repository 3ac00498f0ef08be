//! Computes the key of a node from its parameters and the artifacts of its inputs.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::cache::artifacts::Artifact;
use crate::cache::canonical;
use crate::cache::content::Content;
use crate::cache::key::{Ingredients, InputDigest, Key};
use crate::error::StageError;
use crate::plan::builder::Builder;
use crate::plan::graph::{Graph, InputCell, InputSource, Node, NodeInput};
use crate::stage::definition::Scope;
use crate::stage::inputs::StageInput;
use use3d_code::digest::{Digest, Encoder};

/// State of a node's artifact while a batch is planned or run.
#[derive(Clone, Debug)]
pub(crate) enum Outcome {
    /// Not decided yet.
    Open,
    /// The artifact exists.
    Ready(Arc<Artifact>),
    /// It cannot be made; the text names the cause.
    Unavailable(String),
}

/// The files of an external input that count; `None` for all of them.
type Selected = Option<Arc<[PathBuf]>>;

/// A node whose inputs all exist.
#[derive(Clone, Debug)]
pub(crate) struct Resolved {
    pub(crate) ingredients: Ingredients,
    pub(crate) key: Key,
    /// The key of its checkpoints, for a stage with checkpoints.
    pub(crate) checkpoints: Option<Key>,
    pub(crate) inputs: Vec<StageInput>,
    /// The artifacts among the inputs, with the nodes that made them.
    pub(crate) artifacts: Vec<(usize, Arc<Artifact>)>,
    /// The external inputs, with the files that count and the digest of their content.
    pub(crate) externals: Vec<(PathBuf, Selected, Digest)>,
    pub(crate) bytes: u64,
    /// The reason why this process cannot compute it.
    pub(crate) elsewhere: Option<String>,
}

/// The reason why a node has no key yet.
#[derive(Clone, Debug)]
pub(crate) enum Unresolved {
    /// These inputs are not made yet.
    Waiting(Vec<usize>),
    /// An input failed; the text is the label of the failed node.
    Blocked(String),
    /// An external input cannot be read, for this reason.
    Input(String),
    /// The class of the device that it asks for is not known, for this reason.
    Device(String),
}

impl Builder {
    /// The key of a node, if all of its inputs exist.
    pub(crate) fn resolve(
        &self,
        graph: &Graph,
        node: usize,
        outcomes: &[Outcome],
    ) -> Result<Resolved, Unresolved> {
        let node = &graph.nodes[node];
        let stage = &self.registry.stages()[node.stage];
        let gathers = stage.scope == Scope::Batch;
        let mut waiting = Vec::new();
        let mut missing = Vec::new();
        let (mut inputs, mut digests) = (Vec::<StageInput>::new(), Vec::new());
        let mut artifacts = Vec::new();
        let mut externals = Vec::new();
        let mut bytes = 0;
        for input in &node.inputs {
            let (digest, path) = match &input.from {
                InputSource::Node(parent) => match &outcomes[*parent] {
                    Outcome::Open => {
                        // One node may be several inputs: stage 1, for example, is both the scene and the
                        // geometry for comparison.
                        if !waiting.contains(parent) {
                            waiting.push(*parent);
                        }
                        continue;
                    }
                    Outcome::Unavailable(_) if gathers => {
                        missing.push(graph.nodes[*parent].label());
                        continue;
                    }
                    Outcome::Unavailable(whose) => return Err(Unresolved::Blocked(whose.clone())),
                    Outcome::Ready(artifact) => {
                        bytes += artifact.manifest.bytes();
                        artifacts.push((*parent, artifact.clone()));
                        (artifact.manifest.content, artifact.path.clone())
                    }
                },
                // An optional input need not be named; a named input must exist.
                InputSource::External(outside) => {
                    let path = outside.place.as_ref().map_err(|reason| input_error(input, reason))?;
                    let found = self.read(node, input, path);
                    let (select, content) =
                        found.map_err(|reason| input_error(input, &reason.to_string()))?;
                    bytes += content.bytes;
                    externals.push((path.clone(), select, content.digest));
                    (content.digest, path.clone())
                }
            };
            let InputCell { scene, group, variant } = input.cell(&graph.nodes);
            let role = input.role.to_string();
            inputs.push(StageInput { role, path, scene, group, variant });
            digests.push(digest);
        }
        if !waiting.is_empty() {
            return Err(Unresolved::Waiting(waiting));
        }
        if gathers && inputs.is_empty() && !missing.is_empty() {
            return Err(Unresolved::Blocked(format!("all of {}", missing.join(", "))));
        }
        let arithmetic = self.arithmetic(stage, &node.parameters).map_err(Unresolved::Device)?;
        let code = self.registry.code(node.stage);
        let digested = |(input, digest): (&StageInput, Digest)| {
            let StageInput { role, scene, group, variant, .. } = input.clone();
            InputDigest { role, scene, group, variant, digest }
        };
        let mut digests: Vec<InputDigest> = inputs.iter().zip(digests).map(digested).collect();
        digests.sort();
        let ingredients = Ingredients {
            stage: stage.name.to_string(),
            version: stage.version,
            code: code.ours.clone(),
            third_party: code.third_party.clone(),
            parameters: stage.key_parameters(&node.parameters),
            seed: node.seed,
            numeric_class: arithmetic.class,
            inputs: digests,
            missing,
        };
        let checkpoints =
            (!stage.length_like.is_empty()).then(|| ingredients.checkpoint_key(stage.length_like));
        let (key, elsewhere) = (ingredients.key(), arithmetic.elsewhere);
        Ok(Resolved { key, checkpoints, ingredients, inputs, artifacts, externals, bytes, elsewhere })
    }

    /// The files of an external input that count, and their content.
    fn read(&self, node: &Node, input: &NodeInput, path: &Path) -> Result<(Selected, Content), StageError> {
        if !path.exists() {
            let gone = format!("{} does not exist; correct the path or put the data there", path.display());
            return Err(StageError::message(gone));
        }
        let contents = &self.cache.contents;
        let select = match &self.registry.stages()[node.stage].inputs[input.index].select {
            None => None,
            Some(choose) => {
                let who = self.choice_digest(node, input);
                Some(contents.choice(who, path, || choose(&node.parameters, path))?)
            }
        };
        let content = contents.of(path, select.as_deref())?;
        Ok((select, content))
    }

    /// A digest of the code that chooses files and of its parameters.
    fn choice_digest(&self, node: &Node, input: &NodeInput) -> Digest {
        let mut who = Encoder::new("use3d 2026 choice of files v1");
        who.text(node.stage_name).text(input.role);
        for (name, digest) in &self.registry.code(node.stage).ours {
            who.text(name).bytes(digest.as_bytes());
        }
        canonical::encode(node.parameters.json(), &mut who).finish()
    }
}

/// The inputs of a node that exist already, for forecasts.
pub(crate) fn existing_inputs(graph: &Graph, node: usize, outcomes: &[Outcome]) -> Vec<StageInput> {
    let path = |input: &NodeInput| match &input.from {
        InputSource::Node(parent) => match &outcomes[*parent] {
            Outcome::Ready(artifact) => Some(artifact.path.clone()),
            Outcome::Open | Outcome::Unavailable(_) => None,
        },
        InputSource::External(outside) => outside.place.clone().ok().filter(|path| path.exists()),
    };
    let given = |input: &NodeInput| {
        let InputCell { scene, group, variant } = input.cell(&graph.nodes);
        Some(StageInput { role: input.role.to_string(), path: path(input)?, scene, group, variant })
    };
    graph.nodes[node].inputs.iter().filter_map(given).collect()
}

fn input_error(input: &NodeInput, reason: &str) -> Unresolved {
    let by = match &input.from {
        InputSource::External(outside) if !outside.named.is_empty() => {
            format!(", named by {}", outside.named)
        }
        _ => String::new(),
    };
    Unresolved::Input(format!("input `{}`{by}: {reason}", input.role))
}
