//! A stage as data: its name, its code, its inputs, and the pure function that fills its folder.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use schemars::{JsonSchema, Schema, SchemaGenerator};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

use crate::cache::canonical;
use crate::cache::content::Choice;
use crate::cache::key::DeviceClass;
use crate::error::{ParameterError, StageError};
use crate::stage::agree::{Agreement, AlikeFiles, Figure};
use crate::stage::context::StageContext;
use crate::stage::device::{AskedDevice, Device};
use crate::stage::expected::{Expect, Expected};
use crate::stage::inputs::{Named, StageInput};
use crate::stage::parameters::{AllParameters, Parameters};
use crate::stage::require::{Checks, Lacking, Requires};

/// The set over which a stage is made once.
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

/// The source of an input.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Source {
    /// The artifact of a stage.
    Stage(&'static str),
    /// The artifact of a stage for the same scene in the batch's reference variant: the first one whose
    /// parameters fulfil the condition given with [`Stage::reference_input`]. So all variants are compared
    /// with the same artifact.
    Reference(&'static str),
    /// A file or folder named by the pipeline: `capture`, `models`, `pairs.input`, …
    External(&'static str),
}

/// Chooses the files of an external input that a stage reads, relative to the input's path, from the
/// parameters.
pub type Select = Arc<dyn Fn(&Parameters, &Path) -> Result<Choice, StageError> + Send + Sync>;

/// A condition on the parameters of all stages: true if an artifact is read.
pub(super) type Needed = Arc<dyn Fn(&AllParameters) -> bool + Send + Sync>;

/// One input.
#[derive(Clone)]
pub struct Input {
    /// The role of the input; unique in the stage.
    pub role: &'static str,
    /// The source of the input.
    pub source: Source,
    /// True if the stage also runs without it: the pipeline names none, or the stage that makes it is not
    /// requested. An input that is named but does not exist is an error and is never left out.
    pub optional: bool,
    /// The rule by which files count; `None` counts every file that is not hidden.
    pub select: Option<Select>,
    /// A file or folder that is read in place of the stage's artifact where the pipeline names it.
    pub instead: Option<&'static str>,
    /// The condition on the parameters for reading the stage's artifact; `None` reads it always.
    pub needed: Option<Needed>,
}

/// Reads parameters and fills in their defaults, or returns the problem with them.
type Read = Arc<dyn Fn(&Value) -> Result<Parameters, ParameterError> + Send + Sync>;
type Condition = Arc<dyn Fn(&AllParameters, &Named) -> bool + Send + Sync>;
/// Returns true if the other variants are compared with a variant of these parameters.
type IsReference = Arc<dyn Fn(&AllParameters) -> bool + Send + Sync>;
/// Bytes of memory, from the parameters and from the inputs that exist.
type Memory = Arc<dyn Fn(&Parameters, &[StageInput]) -> Option<u64> + Send + Sync>;
/// Programs of others with their versions, from the parameters.
type MadeWith = Arc<dyn Fn(&Parameters) -> String + Send + Sync>;
type Run = Arc<dyn Fn(&StageContext, &Parameters) -> Result<(), StageError> + Send + Sync>;

/// A stage; the first page of this crate has an example.
#[derive(Clone)]
pub struct Stage {
    pub(crate) name: &'static str,
    /// The stage whose parameters it takes, if it has none of its own.
    pub(crate) parameters_of: Option<&'static str>,
    /// Its description, one line.
    pub about: &'static str,
    pub(crate) version: u32,
    pub(crate) scope: Scope,
    pub(crate) crates: &'static [&'static str],
    /// Files and folders of the crate that holds the stages; `None` is the file of its name.
    pub(crate) sources: Option<&'static [&'static str]>,
    /// Its inputs.
    pub inputs: Vec<Input>,
    /// True if the pipeline's seed is part of its key.
    pub seeded: bool,
    pub(crate) length_like: &'static [&'static str],
    pub(crate) without_effect: &'static [&'static str],
    pub(crate) promises: &'static [&'static str],
    /// The device that it may compute on besides the processor.
    pub device: Option<Device>,
    /// The rule by which its artifacts of two classes of arithmetic agree; `None` promises the same bytes
    /// everywhere.
    pub agreement: Option<Agreement>,
    /// True if two runs on one machine may give other bytes.
    pub varies: bool,
    /// The programs of others that it starts.
    pub(crate) made_with: Option<MadeWith>,
    /// The folder of its result among a scene's results; `None` for a result that stays in the cache.
    pub delivered: Option<&'static str>,
    /// Its usual cost: a fixed part, and a part for each unit of its length.
    usual_cost: [f64; 2],
    pub(crate) cores: usize,
    pub(crate) memory: u64,
    pub(crate) memory_of: Option<Memory>,
    pub(crate) expect: Option<Expect>,
    pub(crate) condition: Option<Condition>,
    pub(crate) requires: Option<Requires>,
    pub(crate) reference: Option<IsReference>,
    pub(crate) read: Read,
    pub(crate) schema: fn(&mut SchemaGenerator) -> Schema,
    pub(crate) run: Run,
}

impl Stage {
    /// A stage of `scope` with parameters `P`, which fills its folder with `run`.
    ///
    /// `P`'s default values are the stage's; unknown fields are refused if `P` has `deny_unknown_fields`, as
    /// it should.
    pub fn new<P>(
        name: &'static str,
        scope: Scope,
        run: impl Fn(&StageContext, &P) -> Result<(), StageError> + Send + Sync + 'static,
    ) -> Self
    where
        P: Serialize + DeserializeOwned + JsonSchema + Send + Sync + 'static,
    {
        Self {
            name,
            parameters_of: None,
            about: "",
            version: 1,
            scope,
            crates: &[],
            sources: None,
            inputs: Vec::new(),
            seeded: false,
            length_like: &[],
            without_effect: &[],
            promises: &[],
            device: None,
            agreement: None,
            varies: false,
            made_with: None,
            delivered: None,
            usual_cost: [0.3, 0.0],
            cores: 0,
            memory: 0,
            memory_of: None,
            expect: None,
            condition: None,
            requires: None,
            reference: None,
            read: Arc::new(Parameters::read::<P>),
            schema: |generator| generator.subschema_for::<P>(),
            run: Arc::new(move |context, parameters| {
                run(context, parameters.of().ok_or_else(|| StageError::message(OTHER_TYPE))?)
            }),
        }
    }

    /// Takes the parameters of another stage, of which its type `P` reads some. Only these are part of its
    /// key. It has no parameters of its own, so nobody sets any by its name.
    #[must_use]
    pub fn with_parameters_of(self, stage: &'static str) -> Self {
        Self { parameters_of: Some(stage), ..self }
    }

    /// The name under which its parameters are set: its own, or that of another stage.
    pub fn section(&self) -> &'static str {
        self.parameters_of.unwrap_or(self.name)
    }

    /// Sets its description, one line.
    #[must_use]
    pub fn about(self, about: &'static str) -> Self {
        Self { about, ..self }
    }

    /// Sets the schema number of its artifact; raise it when the files change their meaning without a change
    /// of code.
    #[must_use]
    pub fn version(self, version: u32) -> Self {
        Self { version, ..self }
    }

    /// Sets its code: crates of the workspace (with all crates they depend on), and files or folders of the
    /// crate that holds the stages. Without this, its code is the file `src/NAME.rs` of that crate, if there
    /// is one, with everything that it uses.
    #[must_use]
    pub fn made_of(self, crates: &'static [&'static str], sources: &'static [&'static str]) -> Self {
        Self { crates, sources: Some(sources), ..self }
    }

    /// Reads the artifact of `stage` as `role`.
    #[must_use]
    pub fn input(self, role: &'static str, stage: &'static str) -> Self {
        self.with_input(role, Source::Stage(stage), false)
    }

    /// Like [`input`](Self::input), but only if that stage is requested.
    #[must_use]
    pub fn optional_input(self, role: &'static str, stage: &'static str) -> Self {
        self.with_input(role, Source::Stage(stage), true)
    }

    /// Reads, as `role`, the artifact that `stage` makes for the same scene in the reference variant, if
    /// there is one: the first variant whose parameters fulfil `is_reference`. It is an input like any other,
    /// so it is part of the key.
    #[must_use]
    pub fn reference_input(
        mut self,
        role: &'static str,
        stage: &'static str,
        is_reference: impl Fn(&AllParameters) -> bool + Send + Sync + 'static,
    ) -> Self {
        self.reference = Some(Arc::new(is_reference));
        self.with_input(role, Source::Reference(stage), true)
    }

    /// Reads a file or folder that the pipeline names `name` as `role`.
    #[must_use]
    pub fn external(self, role: &'static str, name: &'static str) -> Self {
        self.with_input(role, Source::External(name), false)
    }

    /// Like [`external`](Self::external), but only if the pipeline names it. If it is named and does not
    /// exist, the stage fails.
    #[must_use]
    pub fn optional_external(self, role: &'static str, name: &'static str) -> Self {
        self.with_input(role, Source::External(name), true)
    }

    fn with_input(mut self, role: &'static str, source: Source, optional: bool) -> Self {
        self.inputs.push(Input { role, source, optional, select: None, instead: None, needed: None });
        self
    }

    /// Changes the input added last.
    fn with_last(mut self, change: impl FnOnce(&mut Input)) -> Self {
        if let Some(input) = self.inputs.last_mut() {
            change(input);
        }
        self
    }

    /// Selects the files of the input added last that count, from the parameters (paths relative to the
    /// input; folders count with everything below). A path that does not exist is skipped.
    #[must_use]
    pub fn select<P: 'static>(
        self,
        choose: impl Fn(&P, &Path) -> Result<Vec<PathBuf>, StageError> + Send + Sync + 'static,
    ) -> Self {
        self.select_by(move |parameters, input| choose(parameters, input).map(Choice::from))
    }

    /// Like [`select`](Self::select), for slow choices: the choice is stored and used as long as its sources
    /// do not change.
    #[must_use]
    pub fn select_by<P: 'static>(
        self,
        choose: impl Fn(&P, &Path) -> Result<Choice, StageError> + Send + Sync + 'static,
    ) -> Self {
        let choose = move |parameters: &Parameters, input: &Path| {
            choose(parameters.of().ok_or_else(|| StageError::message(OTHER_TYPE))?, input)
        };
        self.with_last(|input| input.select = Some(Arc::new(choose)))
    }

    /// Replaces the input added last, an artifact, by the file or folder `name` where the pipeline names it;
    /// the stage that makes the artifact is then not needed for this input.
    #[must_use]
    pub fn or_external(self, name: &'static str) -> Self {
        self.with_last(|input| input.instead = Some(name))
    }

    /// Reads the input added last, an artifact, only if `needed` returns true for the parameters of all
    /// stages. A file that the pipeline names in its place is read in any case, so that the stage can report
    /// that it does not use it.
    #[must_use]
    pub fn only_when(self, needed: impl Fn(&AllParameters) -> bool + Send + Sync + 'static) -> Self {
        self.with_last(|input| input.needed = Some(Arc::new(needed)))
    }

    /// Declares random draws: the pipeline's seed becomes part of its key.
    #[must_use]
    pub fn seeded(self) -> Self {
        Self { seeded: true, ..self }
    }

    /// Declares a long stage with checkpoints; the parameters at these dotted paths only set the length of
    /// its work.
    #[must_use]
    pub fn resumable(self, length_like: &'static [&'static str]) -> Self {
        Self { length_like, ..self }
    }

    /// Declares parameters, by dotted path, that change the work but not one byte of the result, such as the
    /// steps between checkpoints or a cache's size. They are no part of its key.
    #[must_use]
    pub fn without_effect(self, parameters: &'static [&'static str]) -> Self {
        Self { without_effect: parameters, ..self }
    }

    /// Sets the files that every artifact of the stage has, whatever its parameters and inputs. A name with
    /// `/` at its end is a folder with at least one file. An artifact without one of them counts as damaged.
    #[must_use]
    pub fn promises(self, files: &'static [&'static str]) -> Self {
        Self { promises: files, ..self }
    }

    /// Sets the device it computes on with given parameters: the one that they ask for, `None` for the
    /// processor alone, and the class of the one that this machine has. The class is part of the stage's
    /// class of arithmetic, and so of its key. The parameter `name` chooses the device; it belongs among
    /// those [without effect](Self::without_effect).
    #[must_use]
    pub fn computes_on<P: 'static>(
        self,
        name: &'static str,
        asked: impl Fn(&P) -> Option<AskedDevice> + Send + Sync + 'static,
        here: impl Fn(&P) -> Result<Option<DeviceClass>, String> + Send + Sync + 'static,
    ) -> Self {
        let asked = move |parameters: &Parameters| asked(parameters.of()?);
        let here = move |parameters: &Parameters| parameters.of().map_or(Ok(None), &here);
        let device = Device { parameter: name, asked: Arc::new(asked), here: Arc::new(here) };
        Self { device: Some(device), ..self }
    }

    /// Declares that its bytes are the same within one class of arithmetic but not between two; between two,
    /// these figures of its artifact agree.
    #[must_use]
    pub fn agrees_across_classes(self, figures: &'static [Figure]) -> Self {
        Self { agreement: (!figures.is_empty()).then_some(Agreement::Figures(figures)), ..self }
    }

    /// Like [`Self::agrees_across_classes`], for a stage whose bytes are not even the same on every run of
    /// one machine. The first artifact of a key stays, and another one is no alarm.
    #[must_use]
    pub fn agrees_from_run_to_run(self, figures: &'static [Figure]) -> Self {
        Self { varies: true, ..self.agrees_across_classes(figures) }
    }

    /// Declares programs of others that it starts, with their versions. They are part of its class of
    /// arithmetic, and so of its key.
    #[must_use]
    pub fn made_with<P: 'static>(self, programs: impl Fn(&P) -> String + Send + Sync + 'static) -> Self {
        let programs = move |parameters: &Parameters| parameters.of().map(&programs).unwrap_or_default();
        Self { made_with: Some(Arc::new(programs)), ..self }
    }

    /// Like [`Self::agrees_across_classes`], for an artifact whose files of these kinds are alike between two
    /// classes of arithmetic, and all others equal.
    #[must_use]
    pub fn files_agree_across_classes(self, kinds: &'static [AlikeFiles]) -> Self {
        Self { agreement: (!kinds.is_empty()).then_some(Agreement::Files(kinds)), ..self }
    }

    /// Sets the resources it can use: at most `cores` (0: all cores of the machine), and about `memory`
    /// bytes.
    #[must_use]
    pub fn cost(self, cores: usize, memory: u64) -> Self {
        Self { cores, memory, ..self }
    }

    /// Sets an estimate of its memory in bytes, from its parameters and from those of its inputs that exist
    /// already (a plan knows some of them, a run all). Where the estimate is `None`, the memory of
    /// [`cost`](Self::cost) counts. It affects only which stages run at the same time, never a result.
    #[must_use]
    pub fn memory<P: 'static>(
        self,
        estimate: impl Fn(&P, &[StageInput]) -> Option<u64> + Send + Sync + 'static,
    ) -> Self {
        let estimate =
            move |parameters: &Parameters, inputs: &[StageInput]| estimate(parameters.of()?, inputs);
        Self { memory_of: Some(Arc::new(estimate)), ..self }
    }

    /// Sets an estimate of its time and disk where it never ran, for plans.
    #[must_use]
    pub fn expects(
        self,
        estimate: impl Fn(&AllParameters, &Named, &[StageInput]) -> Option<Expected> + Send + Sync + 'static,
    ) -> Self {
        Self { expect: Some(Arc::new(estimate)), ..self }
    }

    /// Sets the folder of its result among a scene's results.
    #[must_use]
    pub fn delivers(self, folder: &'static str) -> Self {
        Self { delivered: Some(folder), ..self }
    }

    /// Sets its usual cost, in any unit that all stages share: a fixed part, and a part for each unit of its
    /// length. It only serves to say how long a run will take.
    #[must_use]
    pub fn usually_costs(self, fixed: f64, of_a_step: f64) -> Self {
        Self { usual_cost: [fixed, of_a_step], ..self }
    }

    /// Requests it only if this condition on the parameters of all stages is true.
    #[must_use]
    pub fn when(self, condition: impl Fn(&AllParameters) -> bool + Send + Sync + 'static) -> Self {
        self.when_named(move |all, _| condition(all))
    }

    /// Like [`when`](Self::when), but the condition also depends on the files that the pipeline names outside
    /// itself. Their presence decides, when a pipeline is planned, if the stage is requested; the stage's
    /// result still follows from its inputs alone.
    #[must_use]
    pub fn when_named(
        self,
        condition: impl Fn(&AllParameters, &Named) -> bool + Send + Sync + 'static,
    ) -> Self {
        Self { condition: Some(Arc::new(condition)), ..self }
    }

    /// States its requirements from outside: `missing` lists the unmet ones, from the parameters of all
    /// stages and from the files that the pipeline names. It is called before anything runs and does not
    /// change any result. Checks that read much go through [`Checks`].
    #[must_use]
    pub fn requires(
        self,
        missing: impl Fn(&AllParameters, &Named, &Checks<'_>) -> Vec<Lacking> + Send + Sync + 'static,
    ) -> Self {
        Self { requires: Some(Arc::new(missing)), ..self }
    }

    /// Refuses parameters that parse but make no sense; the error names the field (dotted path) and the
    /// expected value.
    #[must_use]
    pub fn check<P: 'static>(
        mut self,
        check: impl Fn(&P) -> Result<(), (String, String)> + Send + Sync + 'static,
    ) -> Self {
        let read = self.read;
        self.read = Arc::new(move |given| {
            let parameters = read(given)?;
            let typed = parameters.of().ok_or_else(|| ParameterError::new("", OTHER_TYPE.to_string()))?;
            check(typed).map_err(|(path, message)| ParameterError::new(path, message))?;
            Ok(parameters)
        });
        self
    }

    /// Its name.
    pub fn name(&self) -> &'static str {
        self.name
    }

    /// The set over which it is made once.
    pub fn scope(&self) -> Scope {
        self.scope
    }

    /// The parameters that are part of the key: those with an effect on the result.
    pub fn key_parameters(&self, parameters: &Parameters) -> Value {
        let mut effective = Value::clone(parameters.json());
        self.without_effect.iter().for_each(|path| canonical::remove(&mut effective, path));
        effective
    }

    /// Its usual cost with these parameters, in the unit of [`Self::usually_costs`].
    pub fn usual_cost(&self, parameters: &Parameters) -> f64 {
        let [fixed, of_a_step] = self.usual_cost;
        fixed + of_a_step * self.length(parameters)
    }

    /// The product of the parameters that set the length of its work; 1 for a stage that has none.
    pub(crate) fn length(&self, parameters: &Parameters) -> f64 {
        let of = |path: &&str| canonical::at(parameters.json(), path).and_then(Value::as_f64);
        self.length_like.iter().filter_map(of).product()
    }

    /// The JSON schema of its parameters.
    pub fn schema(&self, generator: &mut SchemaGenerator) -> Schema {
        (self.schema)(generator)
    }

    /// Estimated memory with these parameters on these inputs, in bytes; `None` where these do not tell it.
    pub(crate) fn known_memory(&self, parameters: &Parameters, inputs: &[StageInput]) -> Option<u64> {
        self.memory_of.as_ref().and_then(|of| of(parameters, inputs)).filter(|bytes| *bytes > 0)
    }

    /// As [`Self::known_memory`]; the stage's usual memory where that is `None`.
    pub(crate) fn memory_on(&self, parameters: &Parameters, inputs: &[StageInput]) -> u64 {
        self.known_memory(parameters, inputs).unwrap_or(self.memory)
    }

    /// The given parameters with defaults filled in.
    ///
    /// # Errors
    /// A value has another type or is out of range, or the stage has no parameter of a name.
    pub fn parameters(&self, given: &Value) -> Result<Parameters, ParameterError> {
        (self.read)(given)
    }
}

impl std::fmt::Debug for Stage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Stage({})", self.name)
    }
}

/// The message for a function of a stage that was written for parameters of another type.
const OTHER_TYPE: &str =
    "a function of this stage is for parameters of another type; this is an error of the program";
