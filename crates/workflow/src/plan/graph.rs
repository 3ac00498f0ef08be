//! The static graph of a batch: every stage of every scene and variant, with its parameters and the sources
//! of its inputs.
//!
//! Variants that change nothing up to a stage share that stage's node. Such nodes are found before any
//! content is read, by an identity made of stage, parameters, seed and the identities of the inputs. They
//! point to the first node with the same identity.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::PathBuf;
use std::sync::Arc;

use serde_json::{Map, Value};

use crate::cache::{canonical, joined};
use crate::error::{BuildError, ParameterError};
use crate::plan::layers;
use crate::stage::definition::{Scope, Source, Stage};
pub use crate::stage::inputs::External;
use crate::stage::inputs::Named;
use crate::stage::parameters::{AllParameters, Parameters};
use crate::stage::registry::Registry;
use use3d_code::digest::{Digest, Encoder};

/// Parameters given for stages, by stage; a parameter that is not given has the stage's default. A key may
/// also be that of a [`Switch`](crate::Switch), with `true` or `false`.
pub type Overrides = Map<String, Value>;

/// The work of a batch: scenes × stages × variants.
#[derive(Clone, Debug, Default)]
pub struct Batch {
    /// The pipeline's name, for records and logs.
    pub name: String,
    /// The seed.
    pub seed: u64,
    /// Parameters for all scenes. They win only over the stages' own defaults.
    pub preset: Overrides,
    /// The preset's name, for messages only; empty for none.
    pub preset_name: String,
    /// Parameters for all scenes.
    pub defaults: Overrides,
    /// Parameters that win over everything: those of the command line.
    pub forced: Overrides,
    /// Finished results of stages from outside, by the role in which stages read them. They are read in place
    /// of the stages' own results; `None` is read as an absent optional input.
    pub given: BTreeMap<&'static str, Option<PathBuf>>,
    /// Files and folders for all scenes, by name.
    pub externals: BTreeMap<String, External>,
    /// The places where the user named them, by name: `` `calibrator.file` in reefs.toml ``. For messages
    /// only.
    pub named: BTreeMap<String, String>,
    /// The scenes.
    pub scenes: Vec<BatchScene>,
    /// The variants; an empty list means one variant without a name.
    pub variants: Vec<Variant>,
}

/// One scene of a batch.
#[derive(Clone, Debug, Default)]
pub struct BatchScene {
    /// Its name, unique in the batch.
    pub name: String,
    /// The group in whose mean the scene counts.
    pub group: String,
    /// Its files and folders, by name.
    pub externals: BTreeMap<String, External>,
    /// The places where the user named them, by name. For messages only.
    pub named: BTreeMap<String, String>,
    /// Parameters for this scene only.
    pub overrides: Overrides,
    /// Parameters for this scene only that win over all others.
    pub forced: Overrides,
}

impl BatchScene {
    /// Names a file or folder of this scene; `by` is the place where the user named it, for messages.
    pub fn name_external(&mut self, name: &str, place: External, by: impl Into<String>) {
        self.externals.insert(name.to_string(), place);
        self.named.insert(name.to_string(), by.into());
    }
}

/// A named set of changes; every scene of its groups is computed with it.
#[derive(Clone, Debug, Default)]
pub struct Variant {
    /// Its name, unique in the batch.
    pub name: String,
    /// The groups of the scenes that are computed with it; an empty list means every scene.
    pub groups: Vec<String>,
    /// The variant's own seed.
    pub seed: Option<u64>,
    /// The preset used in place of the batch's.
    pub preset: Option<Overrides>,
    /// The preset's name, for messages only.
    pub preset_name: Option<String>,
    /// Its files and folders, by name; they win over a scene's.
    pub externals: BTreeMap<String, External>,
    /// The places where the user named them, by name. For messages only.
    pub named: BTreeMap<String, String>,
    /// Parameters for this variant only.
    pub overrides: Overrides,
    /// Parameters for this variant only that win over all but a scene's forced ones.
    pub forced: Overrides,
}

impl Variant {
    /// Names a file or folder of this variant; `by` is the place where the user named it, for messages.
    pub fn name_external(&mut self, name: &str, place: External, by: impl Into<String>) {
        self.externals.insert(name.to_string(), place);
        self.named.insert(name.to_string(), by.into());
    }
}

impl Batch {
    /// Names a file or folder for all scenes; `by` is the place where the user named it, for messages.
    pub fn name_external(&mut self, name: &str, place: External, by: impl Into<String>) {
        self.externals.insert(name.to_string(), place);
        self.named.insert(name.to_string(), by.into());
    }

    /// Keeps only the named scenes.
    pub fn keep_scenes(&mut self, names: &[String]) -> Result<(), BuildError> {
        for name in names {
            if !self.scenes.iter().any(|s| &s.name == name) {
                return Err(BuildError::unknown("scene", name, self.scenes.iter().map(|s| s.name.as_str())));
            }
        }
        self.scenes.retain(|s| names.contains(&s.name));
        Ok(())
    }
}

/// The source of a node's input.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum InputSource {
    Node(usize),
    /// A file or folder from outside. A large batch has many inputs from nodes, so this one is apart.
    External(Box<Outside>),
}

/// An input from outside, and the place where the user named it; empty for none.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Outside {
    pub(crate) place: External,
    pub(crate) named: String,
}

impl InputSource {
    fn outside(place: External, named: impl Into<String>) -> Self {
        Self::External(Box::new(Outside { place, named: named.into() }))
    }
}

#[derive(Clone, Debug)]
pub(crate) struct NodeInput {
    pub(crate) role: &'static str,
    pub(crate) from: InputSource,
    /// The input's place in the stage's list.
    pub(crate) index: usize,
    /// The group of its scene, for the artifact of a scene that a stage over the whole batch reads.
    pub(crate) group: Option<Arc<str>>,
}

/// The scene, its group and the variant of an input of a stage over the whole batch.
#[derive(Clone, Debug, Default)]
pub(crate) struct InputCell {
    pub(crate) scene: String,
    pub(crate) group: String,
    pub(crate) variant: String,
}

/// The settings of a scene in a variant: the parameters of all stages, and the files from outside.
#[derive(Debug)]
pub(crate) struct Place {
    pub(crate) all: Arc<AllParameters>,
    pub(crate) named: Arc<Named>,
}

/// One stage of one scene and variant.
#[derive(Clone, Debug)]
pub struct Node {
    pub(crate) stage: usize,
    /// The stage's name.
    pub stage_name: &'static str,
    /// The scene's name; empty for a stage over all scenes.
    pub scene: String,
    /// The variant's name; empty where there are none.
    pub variant: String,
    /// The folder of its result among a scene's results; `None` for a result that stays in the cache.
    pub delivered: Option<&'static str>,
    /// Its parameters, defaults filled in. Nodes with equal parameters share them.
    pub parameters: Parameters,
    /// The name of the preset below its parameters; empty for none. For people only.
    pub preset: String,
    /// The seed of its random draws; `None` for a stage without random draws.
    pub seed: Option<u64>,
    pub(crate) place: Arc<Place>,
    pub(crate) inputs: Vec<NodeInput>,
    pub(crate) identity: Digest,
    /// The first node with the same work, if this is not the first.
    pub same_as: Option<usize>,
}

impl NodeInput {
    /// The scene that it belongs to, for a stage over the whole batch; else empty.
    pub(crate) fn cell(&self, nodes: &[Node]) -> InputCell {
        let (Some(group), Some(node)) = (&self.group, self.node()) else { return InputCell::default() };
        let Node { scene, variant, .. } = &nodes[node];
        InputCell { scene: scene.clone(), group: group.to_string(), variant: variant.clone() }
    }

    /// The node whose artifact it is; `None` for an input from outside.
    pub(crate) fn node(&self) -> Option<usize> {
        match self.from {
            InputSource::Node(node) => Some(node),
            InputSource::External(_) => None,
        }
    }
}

impl Node {
    /// Scene, variant and stage, for display.
    pub fn label(&self) -> String {
        joined(&[&self.scene, &self.variant, self.stage_name], " · ")
    }
}

/// A scene and a variant; the variant is empty where there are none.
pub type SceneVariant = (String, String);

/// The name of a scene in a variant, as `--only` takes it.
pub fn cell_name(scene: &str, variant: &str) -> String {
    if variant.is_empty() { scene.to_string() } else { format!("{scene}@{variant}") }
}

/// The nodes, ordered so that inputs come before the nodes that read them.
#[derive(Clone, Debug)]
pub struct Graph {
    /// The pipeline's name.
    pub name: String,
    /// The nodes.
    pub nodes: Vec<Node>,
}

impl Graph {
    /// Builds the graph of `batch` over the stages of `registry`. Fails on parameters that a stage refuses
    /// and on unknown stages.
    pub fn new(registry: &Registry, batch: &Batch) -> Result<Self, BuildError> {
        layers::check_names(registry, batch)?;
        let unnamed = [Variant::default()];
        let variants = if batch.variants.is_empty() { &unnamed[..] } else { &batch.variants };
        // A list that grows copies itself, and needs three times its memory meanwhile.
        let in_cells = registry.stages().iter().filter(|stage| stage.scope == Scope::Scene).count();
        let most = batch.scenes.len().saturating_mul(variants.len()).saturating_mul(in_cells);
        let mut builder = GraphBuilder {
            registry,
            batch,
            nodes: Vec::with_capacity(most.saturating_add(registry.stages().len())),
            place: HashMap::new(),
            first: HashMap::new(),
            named: Arc::default(),
            merged: HashMap::new(),
        };
        // Scene by scene, so that results come early; shared stages first, stages over all scenes last.
        for variant in variants {
            builder.add(None, variant, None, Scope::Shared)?;
        }
        for scene in &batch.scenes {
            let own = layers::of_scene(variants, scene);
            let reference = builder.reference(scene, &own)?;
            for variant in layers::ordered(&own, reference) {
                builder.add(Some(scene), variant, reference, Scope::Scene)?;
            }
        }
        builder.add_batch_stages(variants)?;
        Ok(Self { name: batch.name.clone(), nodes: builder.nodes })
    }

    /// Returns a digest for each scene and variant, and one under empty names for the stages that all scenes
    /// share. It covers the stages up to there with their code, the parameters that count, the names of the
    /// chosen devices, seeds and inputs, and no other scene. Two processes with the same digest compute the
    /// same keys on like machines.
    pub fn parts(&self, registry: &Registry) -> BTreeMap<SceneVariant, Digest> {
        let code = |place: usize| {
            let mut encoder = Encoder::new("use3d 2026 stage code v1");
            for (name, digest) in &registry.code(place).ours {
                encoder.text(name).bytes(digest.as_bytes());
            }
            encoder.finish()
        };
        let code: Vec<Digest> = (0..registry.stages().len()).map(code).collect();
        let mut nodes: Vec<Digest> = Vec::with_capacity(self.nodes.len());
        let mut parts: BTreeMap<SceneVariant, Encoder> = BTreeMap::new();
        for node in &self.nodes {
            let mut encoder = Encoder::new("use3d 2026 node v1");
            encoder.text(node.stage_name).bytes(code[node.stage].as_bytes());
            let stage = &registry.stages()[node.stage];
            canonical::encode(&stage.key_parameters(&node.parameters), &mut encoder);
            if let Some(device) =
                stage.device.as_ref().and_then(|device| node.parameters.json().get(device.parameter))
            {
                canonical::encode(device, &mut encoder);
            }
            encoder.number(u64::from(node.seed.is_some())).number(node.seed.unwrap_or(0));
            for input in &node.inputs {
                match &input.from {
                    // A stage over the whole batch reads whatever scenes there are.
                    InputSource::Node(_) if stage.scope == Scope::Batch => continue,
                    InputSource::Node(node) => encoder.bytes(nodes[*node].as_bytes()),
                    InputSource::External(outside) => match &outside.place {
                        Ok(path) => encoder.text(&path.to_string_lossy()),
                        Err(reason) => encoder.text(reason),
                    },
                };
                encoder.text(input.role);
            }
            let digest = encoder.finish();
            let variant = if node.scene.is_empty() { "" } else { &node.variant };
            let part = parts.entry((node.scene.clone(), variant.to_string()));
            let part = part.or_insert_with(|| Encoder::new("use3d 2026 part of a batch v1"));
            part.text(node.stage_name).text(&node.variant).bytes(digest.as_bytes());
            nodes.push(digest);
        }
        parts.into_iter().map(|(cell, part)| (cell, part.finish())).collect()
    }

    /// Returns the groups of the scenes that have one, as the stages over the whole batch see them.
    pub fn groups(&self) -> BTreeMap<&str, &str> {
        let inputs = self.nodes.iter().filter(|node| node.scene.is_empty()).flat_map(|node| &node.inputs);
        let named = inputs.filter_map(|input| Some((input.node()?, input.group.as_deref()?)));
        let named = named.filter(|(_, group)| !group.is_empty());
        named.map(|(node, group)| (self.nodes[node].scene.as_str(), group)).collect()
    }

    /// Finds the node of a stage in a scene (empty for stages over all scenes) and variant (empty for the
    /// first).
    pub fn find(&self, scene: &str, variant: &str, stage: &str) -> Option<usize> {
        let fits = |n: &Node| n.stage_name == stage && (n.scene.is_empty() || n.scene == scene);
        self.nodes
            .iter()
            .position(|n| fits(n) && (variant.is_empty() || n.variant == variant || n.variant.is_empty()))
    }

    /// Marks the named stages and all their inputs; `None` marks everything.
    pub fn wanted(&self, until: Option<&[String]>) -> Vec<bool> {
        self.wanted_of(until, None)
    }

    /// Like [`wanted`](Self::wanted), but marks stages only in these scenes and variants, and all their
    /// inputs.
    pub fn wanted_of(&self, until: Option<&[String]>, only: Option<&[SceneVariant]>) -> Vec<bool> {
        if until.is_none() && only.is_none() {
            return vec![true; self.nodes.len()];
        }
        let cells: Option<BTreeSet<(&str, &str)>> =
            only.map(|cells| cells.iter().map(|(s, v)| (s.as_str(), v.as_str())).collect());
        let asked = |n: &Node| {
            until.is_none_or(|stages| stages.iter().any(|s| s == n.stage_name))
                && cells.as_ref().is_none_or(|cells| cells.contains(&(n.scene.as_str(), n.variant.as_str())))
        };
        let mut wanted: Vec<bool> = self.nodes.iter().map(asked).collect();
        for i in (0..self.nodes.len()).rev().filter(|i| wanted[*i]).collect::<Vec<_>>() {
            let mut open = vec![i];
            while let Some(node) = open.pop() {
                wanted[node] = true;
                open.extend(self.parents(node).filter(|p| !wanted[*p]).collect::<Vec<_>>());
            }
        }
        wanted
    }

    /// The nodes that must finish before a node can, each once. For a node that repeats the work of another,
    /// this is that node alone.
    pub(crate) fn needs(&self, node: usize) -> Vec<usize> {
        let of = &self.nodes[node];
        let mut needs = match of.same_as {
            Some(first) => vec![first],
            None => of.inputs.iter().filter_map(NodeInput::node).collect(),
        };
        needs.sort_unstable();
        needs.dedup();
        needs
    }

    /// The nodes whose artifacts a node reads, and for a node that repeats the work of another, also that
    /// node.
    pub(crate) fn parents(&self, node: usize) -> impl Iterator<Item = usize> + '_ {
        let node = &self.nodes[node];
        node.inputs.iter().filter_map(NodeInput::node).chain(node.same_as)
    }
}

struct GraphBuilder<'a> {
    registry: &'a Registry,
    batch: &'a Batch,
    nodes: Vec<Node>,
    place: HashMap<(String, String, &'static str), usize>,
    first: HashMap<Digest, usize>,
    /// The files of the scene and variant before, which most variants of a scene share.
    named: Arc<Named>,
    /// Merged parameters, by the settings of a scene and the name of a variant.
    merged: HashMap<(Option<String>, String), Arc<Merged>>,
}

/// Parameters of all stages for a scene and variant.
struct Merged {
    all: Arc<AllParameters>,
    /// The parameters of each stage, which nodes share, and their digests.
    each: BTreeMap<&'static str, (Parameters, Digest)>,
}

impl GraphBuilder<'_> {
    /// Parameters of every stage for a scene and variant. The layers are preset, defaults, scene, variant and
    /// command line, and then the forced parameters of the variant and of the scene; later layers win. Scenes
    /// with the same settings share them.
    fn parameters(
        &mut self,
        scene: Option<&BatchScene>,
        variant: &Variant,
    ) -> Result<Arc<Merged>, BuildError> {
        let own = scene.map(|s| serde_json::to_string(&(&s.overrides, &s.forced)).unwrap_or_default());
        let key = (own, variant.name.clone());
        if let Some(known) = self.merged.get(&key) {
            return Ok(known.clone());
        }
        let all = self.merge(scene, variant)?;
        let digested = |(stage, parameters): (&&'static str, &Parameters)| {
            let mut encoder = Encoder::new("use3d 2026 node parameters v1");
            let digest = canonical::encode(parameters.json(), &mut encoder).finish();
            (*stage, (parameters.clone(), digest))
        };
        let each = all.by_stage.iter().map(digested).collect();
        let merged = Arc::new(Merged { all: Arc::new(all), each });
        self.merged.insert(key, merged.clone());
        Ok(merged)
    }

    fn merge(&self, scene: Option<&BatchScene>, variant: &Variant) -> Result<AllParameters, BuildError> {
        let off = layers::left_out(self.registry, self.batch, scene, variant);
        let mut all = AllParameters { off, ..AllParameters::default() };
        for stage in self.registry.stages() {
            let scene = scene.filter(|_| stage.scope == Scope::Scene);
            let variant = Some(variant).filter(|_| stage.scope != Scope::Batch);
            let mut given = Value::Object(Map::new());
            for layer in layers::of(self.batch, scene, variant, stage.section()) {
                canonical::merge(&mut given, layer);
            }
            let parameters = stage.parameters(&given).map_err(|error| BuildError::Parameters {
                place: place_label(scene, variant, stage.name),
                error: error.into(),
            })?;
            all.by_stage.insert(stage.name, parameters);
        }
        Ok(all)
    }

    /// The external files named for a scene in a variant: those of the variant win over those of the scene,
    /// and these over those of the batch.
    fn given(&self, scene: Option<&BatchScene>, variant: &Variant) -> Named {
        let maps = [
            Some((&self.batch.externals, &self.batch.named)),
            scene.map(|scene| (&scene.externals, &scene.named)),
            Some((&variant.externals, &variant.named)),
        ];
        let mut places = BTreeMap::new();
        for (externals, named) in maps.into_iter().flatten() {
            let by = |name: &String| named.get(name).cloned().unwrap_or_default();
            places.extend(externals.iter().map(|(name, place)| (name.clone(), (place.clone(), by(name)))));
        }
        Named { places }
    }

    /// Like [`given`](Self::given). Without a scene, the files that every scene names count, too.
    fn named(&self, scene: Option<&BatchScene>, variant: &Variant) -> Named {
        match (scene, self.batch.scenes.split_first()) {
            (None, Some((first, others))) => {
                let mut everywhere = first.clone();
                everywhere.externals.retain(|name, _| others.iter().all(|s| s.externals.contains_key(name)));
                self.given(Some(&everywhere), variant)
            }
            _ => self.given(scene, variant),
        }
    }

    /// A scene's reference variant: the first that meets the condition of a stage.
    fn reference<'v>(
        &mut self,
        scene: &BatchScene,
        of: &[&'v Variant],
    ) -> Result<Option<&'v Variant>, BuildError> {
        let fulfils = self.registry.stages().iter().find_map(|s| s.reference.as_ref());
        for variant in of.iter().filter(|_| fulfils.is_some()) {
            let all = &self.parameters(Some(scene), variant)?.all;
            if fulfils.is_some_and(|fulfils| fulfils(all)) {
                return Ok(Some(variant));
            }
        }
        Ok(None)
    }

    /// The stages that are left out for a scene in a variant; without a scene, those that are left out for
    /// all of them.
    fn left_out(
        &mut self,
        scene: Option<&BatchScene>,
        variant: &Variant,
    ) -> Result<BTreeSet<&'static str>, BuildError> {
        let (own, batch) = (self.parameters(scene, variant)?.all.off.clone(), self.batch);
        if scene.is_some() || self.registry.switches().is_empty() {
            return Ok(own);
        }
        let mut everywhere: Option<BTreeSet<&'static str>> = None;
        for scene in batch.scenes.iter().filter(|scene| layers::is_of(variant, scene)) {
            let off = &self.parameters(Some(scene), variant)?.all.off;
            everywhere = Some(everywhere.map_or_else(|| off.clone(), |all| &all & off));
        }
        Ok(everywhere.unwrap_or(own))
    }

    fn add(
        &mut self,
        scene: Option<&BatchScene>,
        variant: &Variant,
        reference: Option<&Variant>,
        scope: Scope,
    ) -> Result<(), BuildError> {
        let merged = self.parameters(scene, variant)?;
        let own = self.named(scene, variant);
        if own != *self.named {
            self.named = Arc::new(own);
        }
        let place = Arc::new(Place { all: merged.all.clone(), named: self.named.clone() });
        let (all, named): (&AllParameters, &Named) = (&place.all, &place.named);
        let (given, scene_name) = (self.given(scene, variant), scene.map_or("", |s| s.name.as_str()));
        let (registry, off) = (self.registry, self.left_out(scene, variant)?);
        let runs = |stage: &Stage| stage.scope == scope && !off.contains(stage.name);
        for (index, stage) in registry.stages().iter().enumerate().filter(|(_, s)| runs(s)) {
            if stage.condition.as_ref().is_some_and(|asked| !asked(all, named)) {
                continue;
            }
            let mut inputs = Vec::new();
            for (i, input) in stage.inputs.iter().enumerate() {
                // The external file to read: the input's own, or the one that replaces an artifact.
                let external = match input.source {
                    Source::External(name) => Some(name),
                    Source::Stage(_) | Source::Reference(_) => input.instead,
                };
                let made = |scene_name: &str, variant: &Variant, stage: &'static str| {
                    let node = self.place.get(&(scene_name.to_string(), variant.name.clone(), stage))?;
                    Some(InputSource::Node(*node))
                };
                let results = self.batch.given.get(input.role).filter(|_| external.is_none());
                if let Some(given) = results {
                    let given = given.clone().map(|path| InputSource::outside(Ok(path), "the command line"));
                    inputs.extend(given.map(|from| NodeInput {
                        role: input.role,
                        from,
                        index: i,
                        group: None,
                    }));
                    continue;
                }
                let found = match (external.and_then(|name| given.places.get(name)), &input.source) {
                    (Some((place, by)), _) => Some(InputSource::outside(place.clone(), by)),
                    (None, Source::External(_)) => None,
                    _ if input.needed.as_ref().is_some_and(|needed| !needed(all)) => continue,
                    (None, Source::Reference(stage)) => reference.and_then(|r| made(scene_name, r, stage)),
                    (None, Source::Stage(stage)) => {
                        made(scene_name, variant, stage).or_else(|| made("", variant, stage))
                    }
                };
                let from = match (found, input.optional) {
                    (Some(found), _) => found,
                    (None, true) => continue,
                    (None, false) => missing(&input.source),
                };
                inputs.push(NodeInput { role: input.role, from, index: i, group: None });
            }
            let seed = stage.seeded.then(|| variant.seed.unwrap_or(self.batch.seed));
            let name = variant.preset_name.as_ref().unwrap_or(&self.batch.preset_name).clone();
            let cell = (scene_name.to_string(), variant.name.clone(), place.clone());
            self.push(index, cell, (&merged, name), seed, inputs);
        }
        Ok(())
    }

    fn add_batch_stages(&mut self, variants: &[Variant]) -> Result<(), BuildError> {
        let merged = self.parameters(None, &Variant::default())?;
        let named = Arc::new(self.named(None, &Variant::default()));
        let place = Arc::new(Place { all: merged.all.clone(), named });
        let (all, named): (&AllParameters, &Named) = (&place.all, &place.named);
        let given = self.given(None, &Variant::default());
        let registry = self.registry;
        let groups: HashMap<&str, Arc<str>> =
            self.batch.scenes.iter().map(|s| (s.name.as_str(), Arc::from(s.group.as_str()))).collect();
        for (index, stage) in registry.stages().iter().enumerate().filter(|(_, s)| s.scope == Scope::Batch) {
            let changes =
                |v: &&Variant| v.overrides.contains_key(stage.name) || v.forced.contains_key(stage.name);
            if let Some(variant) = variants.iter().find(changes) {
                let message =
                    format!("`{0}` is made once for all variants; set it in [defaults.{0}]", stage.name);
                let error = ParameterError::new(stage.name, message);
                return Err(BuildError::Parameters {
                    place: format!("variant {}", variant.name),
                    error: error.into(),
                });
            }
            if stage.condition.as_ref().is_some_and(|asked| !asked(all, named)) {
                continue;
            }
            let mut inputs = Vec::new();
            for (i, input) in stage.inputs.iter().enumerate() {
                let (external, maker) = match input.source {
                    Source::External(name) => (Some(name), None),
                    Source::Stage(maker) | Source::Reference(maker) => (input.instead, Some(maker)),
                };
                let found = match external.and_then(|name| given.places.get(name)) {
                    Some((place, by)) => Some(InputSource::outside(place.clone(), by)),
                    None if maker.is_none() && !input.optional => Some(missing(&input.source)),
                    None => None,
                };
                let make = |from, group| NodeInput { role: input.role, from, index: i, group };
                inputs.extend(found.map(|from| make(from, None)));
                // A stage over all variants reads the artifacts of all of them.
                for (n, node) in self.nodes.iter().enumerate().filter(|(_, n)| maker == Some(n.stage_name)) {
                    let group = groups.get(node.scene.as_str()).cloned().unwrap_or_default();
                    inputs.push(make(InputSource::Node(n), Some(group)));
                }
            }
            let seed = stage.seeded.then_some(self.batch.seed);
            let cell = (String::new(), String::new(), place.clone());
            self.push(index, cell, (&merged, self.batch.preset_name.clone()), seed, inputs);
        }
        Ok(())
    }

    fn push(
        &mut self,
        stage: usize,
        (scene, variant, place): (String, String, Arc<Place>),
        (merged, preset): (&Merged, String),
        seed: Option<u64>,
        mut inputs: Vec<NodeInput>,
    ) {
        // A large batch has many lists, and each has grown to twice its needs.
        inputs.shrink_to_fit();
        let name = self.registry.stages()[stage].name;
        let mut identity = Encoder::new("use3d 2026 node identity v1");
        let (parameters, digest) = &merged.each[name];
        identity.text(name).bytes(digest.as_bytes());
        identity.number(u64::from(seed.is_some())).number(seed.unwrap_or(0));
        for input in &inputs {
            let cell = input.cell(&self.nodes);
            identity.text(input.role).text(&cell.scene).text(&cell.variant);
            match &input.from {
                InputSource::Node(node) => identity.bytes(self.nodes[*node].identity.as_bytes()),
                InputSource::External(outside) => match &outside.place {
                    Ok(path) => identity.text(&path.to_string_lossy()),
                    // A missing file of one scene is not the same input as a missing file of another scene.
                    Err(reason) => identity.text(reason).text(&scene),
                },
            };
        }
        let identity = identity.finish();
        let id = self.nodes.len();
        let same_as = self.first.get(&identity).copied();
        self.first.entry(identity).or_insert(id);
        self.place.insert((scene.clone(), variant.clone(), name), id);
        self.nodes.push(Node {
            stage,
            stage_name: name,
            delivered: self.registry.stages()[stage].delivered,
            scene,
            variant,
            parameters: parameters.clone(),
            preset,
            seed,
            place,
            inputs,
            identity,
            same_as,
        });
    }
}

/// The source of an input that is needed and cannot be found.
fn missing(source: &Source) -> InputSource {
    let reason = match source {
        Source::External(name) => format!("the pipeline does not say where `{name}` is"),
        Source::Stage(name) | Source::Reference(name) => {
            format!("it needs the stage `{name}`, which these parameters switch off")
        }
    };
    InputSource::outside(Err(reason), "")
}

fn place_label(scene: Option<&BatchScene>, variant: Option<&Variant>, stage: &str) -> String {
    let scene = scene.map(|s| format!("scene {}, ", s.name)).unwrap_or_default();
    let variant = variant.filter(|v| !v.name.is_empty()).map(|v| format!("variant {}, ", v.name));
    format!("{scene}{}stage {stage}", variant.unwrap_or_default())
}
