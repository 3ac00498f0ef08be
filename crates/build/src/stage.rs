//! A stage as data: what it is called, what it is made of, what it reads, and the pure function that fills
//! its folder.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use schemars::{JsonSchema, Schema, SchemaGenerator};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value};

use super::agree::{Agreement, AlikeFiles, Figure};
use super::canonical;
use super::context::{StageContext, StageInput};
use super::error::{ParameterError, StageError};
use super::graph::External;
use super::key::DeviceClass;
use super::require::{Lacking, Requires};

/// Over what a stage is made once.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Scope {
    /// Once per scene (and variant).
    Scene,
    /// Once for all scenes, e.g. the calibrator.
    Shared,
    /// Once, from the artifacts of all scenes and variants, e.g. the report.
    Batch,
}

/// Where an input comes from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Source {
    /// The artifact of a stage.
    Stage(&'static str),
    /// The artifact of a stage for the same scene in the batch's reference variant: the first one whose
    /// parameters fulfil the condition given with [`Stage::reference_input`]. What variants are compared
    /// by is then the same for all of them.
    Reference(&'static str),
    /// A file or folder named by the pipeline: `capture`, `models`, `pairs.input`, …
    External(&'static str),
}

/// Chooses the files of an external input that a stage reads, relative to the input's path, from the
/// parameters.
pub type Select = Arc<dyn Fn(&Value, &Path) -> Result<Vec<PathBuf>, String> + Send + Sync>;

/// Whether an artifact is read, from the parameters of all stages.
pub(super) type Needed = Arc<dyn Fn(&AllParameters) -> bool + Send + Sync>;

/// One input.
#[derive(Clone)]
pub struct Input {
    /// What the stage uses it for; unique in the stage.
    pub role: &'static str,
    /// Where it comes from.
    pub source: Source,
    /// Whether the stage also runs without it: the pipeline names none, or the stage that makes it is not
    /// asked for. One that is named and not there is an error, never left out.
    pub optional: bool,
    /// Which files count; `None` counts every file that is not hidden.
    pub select: Option<Select>,
    /// A file or folder that is read in place of the stage's artifact where the pipeline names it.
    pub instead: Option<&'static str>,
    /// For which parameters the stage's artifact is read at all; `None`: for all.
    pub needed: Option<Needed>,
}

/// What the pipeline names outside itself, for [`Stage::when_named`]: for one scene, or, for a stage that is
/// made once, for all of them.
#[derive(Clone, Debug, Default)]
pub struct Named {
    places: std::collections::BTreeMap<String, (External, String)>,
}

impl Named {
    /// From names, places (or why they cannot be said), and where the user named them.
    pub(crate) fn new(places: impl IntoIterator<Item = (String, (External, String))>) -> Self {
        Self { places: places.into_iter().collect() }
    }

    /// Whether it is named, there or not.
    pub fn has(&self, name: &str) -> bool {
        self.places.contains_key(name)
    }

    /// Where it is, if it is named and that can be said.
    pub fn path(&self, name: &str) -> Option<&Path> {
        self.places.get(name)?.0.as_deref().ok()
    }

    /// Why it cannot be said where it is, if it is named and that is so (a variable that is not set).
    pub fn problem(&self, name: &str) -> Option<&str> {
        self.places.get(name)?.0.as_ref().err().map(String::as_str)
    }

    /// The place where the user named it, for messages; empty if it is not named.
    pub fn by(&self, name: &str) -> &str {
        self.places.get(name).map_or("", |(_, by)| by)
    }
}

/// The parameters of all stages of one scene and variant, by stage, for [`Stage::when`].
pub type AllParameters = Map<String, Value>;

/// Parameters in, parameters with defaults filled in out, or what is wrong with them.
type Canonicalise = Arc<dyn Fn(&Value) -> Result<Value, ParameterError> + Send + Sync>;
type Condition = Arc<dyn Fn(&AllParameters, &Named) -> bool + Send + Sync>;
/// Whether a variant with these parameters is what others are compared by.
type IsReference = Arc<dyn Fn(&AllParameters) -> bool + Send + Sync>;
/// Bytes of memory, from the parameters and from those inputs that are there.
type Memory = Arc<dyn Fn(&Value, &[StageInput]) -> Option<u64> + Send + Sync>;
/// The device that the stage computes on, from its parameters.
type Device = Arc<dyn Fn(&Value) -> Option<DeviceClass> + Send + Sync>;
type Run = Arc<dyn Fn(&StageContext, &Value) -> Result<(), StageError> + Send + Sync>;

/// A stage; see the [module documentation](super) for an example.
#[derive(Clone)]
pub struct Stage {
    pub(crate) name: &'static str,
    pub(crate) about: &'static str,
    pub(crate) version: u32,
    pub(crate) scope: Scope,
    pub(crate) crates: &'static [&'static str],
    pub(crate) sources: &'static [&'static str],
    pub(crate) inputs: Vec<Input>,
    pub(crate) seeded: bool,
    pub(crate) length_like: &'static [&'static str],
    pub(crate) without_effect: &'static [&'static str],
    pub(crate) device: Option<Device>,
    pub(crate) agreement: Option<Agreement>,
    pub(crate) cores: usize,
    pub(crate) memory: u64,
    pub(crate) memory_of: Option<Memory>,
    pub(crate) condition: Option<Condition>,
    pub(crate) requires: Option<Requires>,
    pub(crate) reference: Option<IsReference>,
    pub(crate) canonicalise: Canonicalise,
    pub(crate) schema: fn(&mut SchemaGenerator) -> Schema,
    pub(crate) run: Run,
}

impl Stage {
    /// A stage of `scope` with parameters `P`, which fills its folder with `run`.
    ///
    /// `P`'s default values are the stage's; unknown fields are refused when `P` says `deny_unknown_fields`,
    /// as it should.
    pub fn new<P>(
        name: &'static str,
        scope: Scope,
        run: impl Fn(&StageContext, &P) -> Result<(), StageError> + Send + Sync + 'static,
    ) -> Self
    where
        P: Serialize + DeserializeOwned + JsonSchema + 'static,
    {
        Self {
            name,
            about: "",
            version: 1,
            scope,
            crates: &[],
            sources: &[],
            inputs: Vec::new(),
            seeded: false,
            length_like: &[],
            without_effect: &[],
            device: None,
            agreement: None,
            cores: 0,
            memory: 0,
            memory_of: None,
            condition: None,
            requires: None,
            reference: None,
            canonicalise: Arc::new(canonicalise::<P>),
            schema: |generator| generator.subschema_for::<P>(),
            run: Arc::new(move |context, value| {
                let parameters: P = serde_path_to_error::deserialize(value).map_err(StageError::failed)?;
                run(context, &parameters)
            }),
        }
    }

    /// One line about it.
    #[must_use]
    pub fn about(mut self, about: &'static str) -> Self {
        self.about = about;
        self
    }

    /// Schema number of its artifact; raise it when the files change their meaning without a change of code.
    #[must_use]
    pub fn version(mut self, version: u32) -> Self {
        self.version = version;
        self
    }

    /// What it is made of: crates of the workspace (with all below them), and files or folders of this crate.
    #[must_use]
    pub fn made_of(mut self, crates: &'static [&'static str], sources: &'static [&'static str]) -> Self {
        self.crates = crates;
        self.sources = sources;
        self
    }

    /// Reads the artifact of `stage` as `role`.
    #[must_use]
    pub fn input(self, role: &'static str, stage: &'static str) -> Self {
        self.with_input(Input {
            role,
            source: Source::Stage(stage),
            optional: false,
            select: None,
            instead: None,
            needed: None,
        })
    }

    /// As [`input`](Self::input), when that stage is asked for.
    #[must_use]
    pub fn optional_input(self, role: &'static str, stage: &'static str) -> Self {
        self.with_input(Input {
            role,
            source: Source::Stage(stage),
            optional: true,
            select: None,
            instead: None,
            needed: None,
        })
    }

    /// Reads, as `role`, the artifact that `stage` makes for the same scene in the reference variant, where
    /// there is one: the first variant for whose parameters `is_reference` holds. It is an input like any
    /// other, so it is part of the key.
    #[must_use]
    pub fn reference_input(
        mut self,
        role: &'static str,
        stage: &'static str,
        is_reference: impl Fn(&AllParameters) -> bool + Send + Sync + 'static,
    ) -> Self {
        self.reference = Some(Arc::new(is_reference));
        self.with_input(Input {
            role,
            source: Source::Reference(stage),
            optional: true,
            select: None,
            instead: None,
            needed: None,
        })
    }

    /// Reads a file or folder that the pipeline names `name` as `role`.
    #[must_use]
    pub fn external(self, role: &'static str, name: &'static str) -> Self {
        self.with_input(Input {
            role,
            source: Source::External(name),
            optional: false,
            select: None,
            instead: None,
            needed: None,
        })
    }

    /// As [`external`](Self::external), when the pipeline names it. Named and absent, it fails the stage.
    #[must_use]
    pub fn optional_external(self, role: &'static str, name: &'static str) -> Self {
        self.with_input(Input {
            role,
            source: Source::External(name),
            optional: true,
            select: None,
            instead: None,
            needed: None,
        })
    }

    /// Adds an input.
    #[must_use]
    pub fn with_input(mut self, input: Input) -> Self {
        self.inputs.push(input);
        self
    }

    /// Lets the parameters choose which files of the input added last count (paths relative to it; folders
    /// count with everything below). A path that does not exist is skipped.
    #[must_use]
    pub fn select(
        mut self,
        choose: impl Fn(&Value, &Path) -> Result<Vec<PathBuf>, String> + Send + Sync + 'static,
    ) -> Self {
        if let Some(input) = self.inputs.last_mut() {
            input.select = Some(Arc::new(choose));
        }
        self
    }

    /// The input added last, an artifact, is the file or folder `name` instead where the pipeline names that;
    /// the stage that makes the artifact is then not needed for it.
    #[must_use]
    pub fn or_external(mut self, name: &'static str) -> Self {
        if let Some(input) = self.inputs.last_mut() {
            input.instead = Some(name);
        }
        self
    }

    /// The input added last, an artifact, is read only where this holds for the parameters of all stages. A
    /// file that the pipeline names in its place is read in any case, so that the stage can say that it
    /// has no use for it.
    #[must_use]
    pub fn only_when(mut self, needed: impl Fn(&AllParameters) -> bool + Send + Sync + 'static) -> Self {
        if let Some(input) = self.inputs.last_mut() {
            input.needed = Some(Arc::new(needed));
        }
        self
    }

    /// It draws random numbers: the pipeline's seed is part of its key.
    #[must_use]
    pub fn seeded(mut self) -> Self {
        self.seeded = true;
        self
    }

    /// It is long and leaves checkpoints; the parameters at these dotted paths only say how far it goes.
    #[must_use]
    pub fn resumable(mut self, length_like: &'static [&'static str]) -> Self {
        self.length_like = length_like;
        self
    }

    /// The parameters at these dotted paths change how it works but not one byte of what comes out, such as
    /// the steps between checkpoints or a cache's size: they are no part of its key.
    #[must_use]
    pub fn without_effect(mut self, parameters: &'static [&'static str]) -> Self {
        self.without_effect = parameters;
        self
    }

    /// It computes on a device with these parameters, or on the processor alone (`None`): the device is part
    /// of its class of arithmetic, and so of its key.
    #[must_use]
    pub fn computes_on<P: DeserializeOwned + 'static>(
        mut self,
        device: impl Fn(&P) -> Option<DeviceClass> + Send + Sync + 'static,
    ) -> Self {
        self.device = Some(Arc::new(move |value| device(&serde_json::from_value(value.clone()).ok()?)));
        self
    }

    /// Its bytes are the same within one class of arithmetic, not between two: there, these figures of its
    /// artifact agree.
    #[must_use]
    pub fn agrees_across_classes(mut self, figures: &'static [Figure]) -> Self {
        self.agreement = (!figures.is_empty()).then_some(Agreement::Figures(figures));
        self
    }

    /// As [`Self::agrees_across_classes`], for an artifact whose files of these kinds are alike between two classes of
    /// arithmetic, and all others equal.
    #[must_use]
    pub fn files_agree_across_classes(mut self, kinds: &'static [AlikeFiles]) -> Self {
        self.agreement = (!kinds.is_empty()).then_some(Agreement::Files(kinds));
        self
    }

    /// What it can use: at most `cores` (0: as many as there are), and about `memory` bytes.
    #[must_use]
    pub fn cost(mut self, cores: usize, memory: u64) -> Self {
        self.cores = cores;
        self.memory = memory;
        self
    }

    /// About how many bytes of memory it takes on what it reads, from its parameters and from those of its
    /// inputs that are there already (a plan knows some of them, a run all). Where they do not say
    /// (`None`), it is what [`cost`](Self::cost) says. It decides what runs side by side, never what
    /// comes out.
    #[must_use]
    pub fn memory<P: DeserializeOwned + 'static>(
        mut self,
        estimate: impl Fn(&P, &[StageInput]) -> Option<u64> + Send + Sync + 'static,
    ) -> Self {
        self.memory_of = Some(Arc::new(move |value, inputs| {
            let parameters: P = serde_json::from_value(value.clone()).ok()?;
            estimate(&parameters, inputs)
        }));
        self
    }

    /// It is only asked for when this holds for the parameters of all stages.
    #[must_use]
    pub fn when(self, condition: impl Fn(&AllParameters) -> bool + Send + Sync + 'static) -> Self {
        self.when_named(move |all, _| condition(all))
    }

    /// As [`when`](Self::when), from what the pipeline names outside itself, too. What is there decides
    /// whether the stage is asked for when a pipeline is planned; what a stage computes still follows
    /// from its inputs alone.
    #[must_use]
    pub fn when_named(
        mut self,
        condition: impl Fn(&AllParameters, &Named) -> bool + Send + Sync + 'static,
    ) -> Self {
        self.condition = Some(Arc::new(condition));
        self
    }

    /// States what it needs from outside: what of that is missing, from the parameters of all stages and from
    /// what the pipeline names. Asked before anything runs; it changes nothing of what comes out.
    #[must_use]
    pub fn requires(
        mut self,
        missing: impl Fn(&AllParameters, &Named) -> Vec<Lacking> + Send + Sync + 'static,
    ) -> Self {
        self.requires = Some(Arc::new(missing));
        self
    }

    /// Refuses parameters that parse but make no sense; the error names the field (dotted path) and says what
    /// is expected.
    #[must_use]
    pub fn check<P: DeserializeOwned + 'static>(
        mut self,
        check: impl Fn(&P) -> Result<(), (String, String)> + Send + Sync + 'static,
    ) -> Self {
        let inner = self.canonicalise;
        self.canonicalise = Arc::new(move |value| {
            let value = inner(value)?;
            let parameters: P =
                serde_json::from_value(value.clone()).map_err(|e| ParameterError::from_serde(&e))?;
            check(&parameters).map_err(|(path, message)| ParameterError {
                path,
                message,
                unknown: None,
                known: vec![],
            })?;
            Ok(value)
        });
        self
    }

    /// How its artifacts of two classes of arithmetic agree; `None` promises the same bytes everywhere.
    pub fn agreement(&self) -> Option<Agreement> {
        self.agreement
    }

    /// Whether it may compute on another device than the processor.
    pub fn may_use_a_device(&self) -> bool {
        self.device.is_some()
    }

    /// Its name.
    pub fn name(&self) -> &'static str {
        self.name
    }

    /// One line about it.
    pub fn description(&self) -> &'static str {
        self.about
    }

    /// Over what it is made once.
    pub fn scope(&self) -> Scope {
        self.scope
    }

    /// Its inputs.
    pub fn inputs(&self) -> &[Input] {
        &self.inputs
    }

    /// The parameters that a key holds: those with an effect on what comes out.
    pub fn key_parameters(&self, parameters: &Value) -> Value {
        let mut effective = parameters.clone();
        self.without_effect.iter().for_each(|path| canonical::remove(&mut effective, path));
        effective
    }

    /// The JSON schema of its parameters.
    pub fn schema(&self, generator: &mut SchemaGenerator) -> Schema {
        (self.schema)(generator)
    }

    /// Its class of arithmetic with these parameters on a machine of class `machine`.
    pub fn numeric_class(&self, machine: &str, parameters: &Value) -> String {
        let device = self.device.as_ref().and_then(|device| device(parameters));
        device.map_or_else(|| machine.to_string(), |device| device.on(machine))
    }

    /// Whether the pipeline's seed is part of its key.
    pub fn is_seeded(&self) -> bool {
        self.seeded
    }

    /// About how much memory it takes with these parameters on these inputs, bytes; 0 where nobody knows.
    pub(crate) fn memory_on(&self, parameters: &Value, inputs: &[StageInput]) -> u64 {
        let known = self.memory_of.as_ref().and_then(|of| of(parameters, inputs));
        known.unwrap_or(self.memory)
    }

    /// The given parameters with defaults filled in.
    pub fn parameters(&self, given: &Value) -> Result<Value, ParameterError> {
        (self.canonicalise)(given)
    }
}

impl std::fmt::Debug for Stage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Stage({})", self.name)
    }
}

fn canonicalise<P: Serialize + DeserializeOwned>(given: &Value) -> Result<Value, ParameterError> {
    let parameters: P = serde_path_to_error::deserialize(given).map_err(|e| ParameterError::from_path(&e))?;
    serde_json::to_value(&parameters).map_err(|e| ParameterError::from_serde(&e))
}
