//! The pipeline file: the scenes, their parameters and their variants.
//!
//! ```toml
//! name = "reefs"
//! seed = 42
//! method = "3d-use"                          # the method that is trained
//! preset = "paper"                           # parameters of stages under a name, over the method's
//! [models]
//! dir = "models"
//! [calibrator]
//! pairs = { input = "uieb/raw-890", target = "uieb/reference-890" }
//! [defaults.reconstruct]                     # parameters of a stage, for all scenes
//! iterations = 15000
//! [[scene]]
//! name = "Panama"
//! capture = "captures/Panama"                # or `from = "dives/*"` in place of both: many scenes
//! reconstruct = { iterations = 20000 }       # for this scene only
//! [[variant]]                                # every scene in every variant; unchanged stages are shared
//! name = "mlp"
//! reconstruct = { medium = "mlp" }
//! ```
//!
//! A calibrator corrects the proposals (`targets.calibrated = true`) as soon as the file names pairs, a
//! calibrator or a parameter of its fit.
//!
//! Later entries of this list override earlier ones: a stage's defaults, the preset, the variant's preset,
//! `[defaults.<stage>]`, the scene's, the variant's, `--set`. Unknown keys and values of a wrong type are
//! errors; they give the line and column and name the most similar known key. Relative paths start at the
//! file's folder. A missing environment variable is an error only for the scenes that need it.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
use serde_json::{Map, Value};

use use3d_workflow::error::{Problem, nearest};
use use3d_workflow::graph::{External, Overrides};
use use3d_workflow::{Batch, BatchScene, ParameterError, Registry, Stage, Variant, canonical, read};

mod document;
mod downloads;
mod file;
mod parameters;
mod places;
mod presets;
mod scenes;
mod schema;
mod set;
mod shipped;

pub use document::ConfigError;
pub(crate) use document::join;
use document::{Document, unknown_key};
use downloads::Downloads;
use file::{Calibrator, PipelineFile, SceneEntry, VariantEntry};
pub use parameters::{Parameter, StageParameters, parameters};
pub use places::lacks_cameras;
use places::{
    calibrate_where_named, check_learning, check_pairs, expand, folder_in, home, key_of, learning,
    one_proposer_for_all, override_external,
};
pub use presets::{METHODS, preset_values, presets};
pub use schema::{schema, schema_text};
pub use shipped::{shipped, shipped_as, shipped_file, shipped_names};

/// Settings that the command line adds to a pipeline file.
#[derive(Clone, Debug, Default)]
pub struct LoadOptions {
    /// `KEY=VALUE` of `--set`, in order.
    pub sets: Vec<String>,
    /// `--cache` or USE3D_CACHE.
    pub cache: Option<PathBuf>,
    /// `--models` or USE3D_MODELS.
    pub models: Option<PathBuf>,
    /// The scenes to compute; all if the list is empty.
    pub scenes: Vec<String>,
    /// The two folders of pairs given by `--pairs INPUT TARGET`. They override the pairs of the file and a
    /// finished calibrator named there.
    pub pairs: Option<(PathBuf, PathBuf)>,
    /// A finished calibrator, `--calibrator`. It overrides the calibrators and the pairs of the file.
    pub calibrator: Option<PathBuf>,
}

/// A pipeline that is ready to be planned.
#[derive(Clone, Debug)]
pub struct Pipeline {
    /// The scenes, variants and parameters to compute.
    pub batch: Batch,
    /// The cache folder.
    pub cache: PathBuf,
    /// The environment variables that the file and `--set` name, as `${NAME}` in paths.
    pub variables: BTreeSet<String>,
    /// True if a scene that fails ends no other one, as with `--keep-going`.
    pub keep_going: bool,
}

/// Loads a pipeline file.
pub fn load(registry: &Registry, file: &Path, options: &LoadOptions) -> Result<Pipeline, ConfigError> {
    parse(registry, Document::read(file)?, file, options)
}

/// The whole pipeline with default parameters on one capture folder.
pub fn for_capture(
    registry: &Registry,
    folder: &Path,
    options: &LoadOptions,
) -> Result<Pipeline, ConfigError> {
    let whole = std::fs::canonicalize(folder)
        .map_err(|e| ConfigError::plain(format!("cannot open the capture {}: {e}", folder.display())))?;
    if !whole.is_dir() {
        return Err(ConfigError::plain(format!(
            "{} is neither a pipeline file (.toml) nor a capture folder",
            folder.display()
        )));
    }
    let name = whole.file_name().map_or_else(|| "capture".into(), |n| n.to_string_lossy());
    // The name is used for folders and is printed, so it gets no control characters; a pipeline file could
    // not contain them either.
    let name = name.replace(char::is_control, "_");
    let mut scene = BatchScene { name: name.clone(), ..BatchScene::default() };
    scene.name_external("capture", Ok(whole), "the command line");
    let batch = Batch { name, seed: file::default_seed(), scenes: vec![scene], ..Batch::default() };
    finish(registry, batch, None, None, options)
}

/// A pipeline with default parameters and without captures, for the stages that are made once for all scenes.
pub fn without_captures(registry: &Registry, options: &LoadOptions) -> Result<Pipeline, ConfigError> {
    let batch = Batch { name: "shared".into(), seed: file::default_seed(), ..Batch::default() };
    finish(registry, batch, None, None, options)
}

/// Loads a pipeline from its text, as if it stood in `file`.
pub fn from_text(
    registry: &Registry,
    text: &str,
    file: &Path,
    options: &LoadOptions,
) -> Result<Pipeline, ConfigError> {
    parse(registry, Document::parse(file, text.to_string())?, file, options)
}

fn parse(
    registry: &Registry,
    document: Document,
    file: &Path,
    options: &LoadOptions,
) -> Result<Pipeline, ConfigError> {
    let folder = file.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let reader = Reader { registry, document, downloads: Downloads::default() };
    let mut top = reader.document.value.as_object().cloned().unwrap_or_default();
    let mut batch = Batch::default();
    let mut take = |name: &str| top.remove(name).unwrap_or(Value::Null);
    let (defaults, scenes, variants) = (take("defaults"), take("scene"), take("variant"));
    batch.defaults = reader.stages("defaults", reader.table("defaults", defaults)?)?;
    if let Some(calibrator) = top.get_mut("calibrator") {
        reader.finished(calibrator, &batch.defaults)?;
        reader.shorthands("calibrator", "calibrator", calibrator, &mut batch.defaults)?;
    }
    if let Some(models) = top.get_mut("models") {
        reader.shorthands("models", "models", models, &mut batch.defaults)?;
    }
    let mut top = Value::Object(top);
    reader.switches("", &mut top, &mut batch.defaults)?;
    reader.shorthands("", "", &mut top, &mut batch.defaults)?;
    let more: Vec<&str> = ["defaults", "scene", "variant"].into_iter().chain(reader.switch_words()).collect();
    let own: PipelineFile = reader.typed("", &top, &more)?;
    reader.name("name", &own.name)?;
    batch.name = own.name;
    batch.seed = own.seed;
    let (name, values) = reader.preset("", &own.method, &own.preset)?.unwrap_or_default();
    (batch.preset_name, batch.preset) = (name, values);
    let said = |key: &str| format!("`{key}` in {}", file.display());
    reader.calibrator(&own.calibrator, folder, &said, &mut batch)?;
    let scenes = reader.list("scene", scenes)?;
    let mut downloaded = false;
    let by_hand = scenes.iter().filter_map(|scene| Some(scene.get("name")?.as_str()?.to_string())).collect();
    for (i, entry) in scenes.into_iter().enumerate() {
        let base = format!("scene[{i}]");
        let (rest, mut overrides) = reader.entry(&base, "scene", entry)?;
        let entry: SceneEntry = reader.typed(&base, &rest, &reader.words("scene"))?;
        if let (Some(recipe), Some(name)) = (entry.download, &entry.name) {
            downloads::choose(recipe, name, &mut overrides);
            downloaded = true;
        }
        for NamedPlace { name, is_footage, place } in reader.scenes_of(&base, &entry, folder, &by_hand)? {
            reader.scene_name(&base, (&name, &place), &batch.scenes)?;
            let external = if is_footage { "footage" } else { "capture" };
            let key = match (&entry.from, &entry.download) {
                (Some(_), _) => "from",
                (_, Some(_)) => "download",
                _ => external,
            };
            let said = |key: &str| format!("`{key}` of scene {name} in {}", file.display());
            let (name, group, overrides) = (name.clone(), entry.group.clone(), overrides.clone());
            let mut scene = BatchScene { name, group, overrides, ..BatchScene::default() };
            scene.name_external(external, place, said(key));
            if let Some(own) = &entry.calibrator {
                scene.name_external("calibrator", expand(&own.file, folder), said(key_of("calibrator")));
            }
            batch.scenes.push(scene);
        }
    }
    if batch.scenes.is_empty() {
        let hint =
            "the pipeline has no scene; add one:\n[[scene]]\nname = \"reef\"\ncapture = \"path/to/reef\"";
        return Err(reader.document.error("", hint));
    }
    for (i, entry) in reader.list("variant", variants)?.into_iter().enumerate() {
        let base = format!("variant[{i}]");
        let (rest, overrides) = reader.entry(&base, "variant", entry)?;
        let entry: VariantEntry = reader.typed(&base, &rest, &reader.words("variant"))?;
        reader.unique(&base, &entry.name, batch.variants.iter().map(|v| &v.name))?;
        let said = |key: &str| format!("`{key}` of variant {} in {}", entry.name, file.display());
        if let Some(unknown) =
            entry.groups.iter().find(|group| !batch.scenes.iter().any(|s| s.group == **group))
        {
            let groups = batch.scenes.iter().map(|s| s.group.as_str());
            let message = format!("no scene has the group `{unknown}`{}", did_you_mean(unknown, groups));
            return Err(reader.document.error(&join(&base, "groups"), message));
        }
        let (name, groups) = (entry.name.clone(), entry.groups);
        let mut variant = Variant { name, groups, seed: entry.seed, overrides, ..Variant::default() };
        (variant.preset_name, variant.preset) = reader.preset(&base, &entry.method, &entry.preset)?.unzip();
        if let Some(own) = &entry.calibrator {
            variant.name_external("calibrator", expand(&own.file, folder), said(key_of("calibrator")));
        }
        batch.variants.push(variant);
    }
    let models = own.models.dir.map(|dir| (expand(&dir, folder), said(key_of("models"))));
    let cache = own.cache.map(|text| expand(&text, folder));
    let variables = places::variables(&reader.document.value);
    let mut pipeline = finish(registry, batch, cache, models, options)?;
    pipeline.variables.extend(variables);
    if downloaded {
        pipeline.variables.extend(downloads::variables());
    }
    pipeline.keep_going = own.keep_going;
    Ok(pipeline)
}

/// The common end of loading a file and loading a single capture: applies the command line, and sets the
/// cache, the models and the choice of scenes.
fn finish(
    registry: &Registry,
    mut batch: Batch,
    cache: Option<External>,
    models: Option<(External, String)>,
    options: &LoadOptions,
) -> Result<Pipeline, ConfigError> {
    if let Some((place, by)) = models {
        batch.name_external("models", place, by);
    }
    for setting in &options.sets {
        set::apply(registry, &mut batch, setting)?;
    }
    if !options.scenes.is_empty() {
        batch.keep_scenes(&options.scenes).map_err(|e| ConfigError::plain(e.to_string()))?;
    }
    if let Some((input, target)) = &options.pairs {
        override_external(&mut batch, "pairs.input", Ok(input.clone()), "--pairs");
        override_external(&mut batch, "pairs.target", Ok(target.clone()), "--pairs");
    }
    if let Some(file) = &options.calibrator {
        override_external(&mut batch, "calibrator", Ok(file.clone()), "--calibrator");
    }
    presets::compose(&mut batch);
    check_pairs(&batch)?;
    check_learning(&batch, registry)?;
    calibrate_where_named(&mut batch, registry);
    one_proposer_for_all(&mut batch, registry);
    if let Some(models) = &options.models {
        batch.name_external("models", Ok(models.clone()), "--models or USE3D_MODELS");
    } else if !batch.externals.contains_key("models") && Path::new("models").is_dir() {
        batch.name_external("models", Ok(PathBuf::from("models")), "the folder `models` here");
    }
    let cache = match (&options.cache, cache) {
        (Some(path), _) => path.clone(),
        (None, Some(place)) => place.map_err(|e| ConfigError::plain(format!("`cache`: {e}")))?,
        (None, None) => default_cache()?,
    };
    let sets = options.sets.iter().map(|set| Value::String(set.clone())).collect();
    let variables = places::variables(&Value::Array(sets));
    Ok(Pipeline { batch, cache, variables, keep_going: false })
}

/// The default cache folder: `$XDG_CACHE_HOME/use3d` or `~/.cache/use3d`.
pub fn default_cache() -> Result<PathBuf, ConfigError> {
    let base = folder_in("XDG_CACHE_HOME").or_else(|| home().map(|h| h.join(".cache")));
    base.map(|b| b.join("use3d")).ok_or_else(|| {
        ConfigError::plain("there is no home folder for the cache; name a folder with --cache or USE3D_CACHE")
    })
}

/// A scene's name with its capture or footage.
struct NamedPlace {
    name: String,
    is_footage: bool,
    place: External,
}

struct Reader<'r> {
    registry: &'r Registry,
    document: Document,
    downloads: Downloads,
}

impl Reader<'_> {
    fn table(&self, path: &str, value: Value) -> Result<Map<String, Value>, ConfigError> {
        match value {
            Value::Object(fields) => Ok(fields),
            Value::Null => Ok(Map::new()),
            _ => Err(self.document.error(path, format!("`{path}` is a table: write [{path}]"))),
        }
    }

    fn list(&self, path: &str, value: Value) -> Result<Vec<Value>, ConfigError> {
        match value {
            Value::Array(items) => Ok(items),
            Value::Null => Ok(Vec::new()),
            _ => Err(self.document.error(path, format!("`{path}` is a list of tables: write [[{path}]]"))),
        }
    }

    /// Tables of stage parameters, each checked by its stage.
    fn stages(&self, base: &str, tables: Map<String, Value>) -> Result<Overrides, ConfigError> {
        for (name, given) in &tables {
            let path = join(base, name);
            let Some(stage) = self.registry.sections().find(|stage| stage.name() == name) else {
                let known = self.registry.sections().map(Stage::name);
                return Err(self.document.key_error(&path, unknown_key(name, known)));
            };
            if !given.is_object() {
                return Err(self.document.error(&path, format!("the parameters of `{name}` are a table")));
            }
            stage.parameters(given).map_err(|e| self.document.parameter_error(&path, &e, &[]))?;
        }
        Ok(tables)
    }

    /// Moves the shorthand keys of a place from `value` to the parameters that they stand for.
    fn shorthands(
        &self,
        place: &str,
        base: &str,
        value: &mut Value,
        into: &mut Overrides,
    ) -> Result<(), ConfigError> {
        let Some(fields) = value.as_object_mut() else { return Ok(()) };
        let mut used = Vec::new();
        for short in self.registry.shorthands().iter().filter(|s| s.place == place) {
            let Some(given) = fields.get(short.key) else { continue };
            used.push(short.key);
            let given = set::nested(short.parameter, given.clone());
            let stage = self.registry.stage(short.stage).map_err(|e| ConfigError::plain(e.to_string()))?;
            stage.parameters(&given).map_err(|e| {
                let shown = ParameterError { path: String::new(), ..e };
                self.document.error(&join(base, short.key), format!("`{}`: {shown}", short.key))
            })?;
            merge_into(into, short.stage, &given, false);
        }
        fields.retain(|key, _| !used.contains(&key.as_str()));
        Ok(())
    }

    /// Moves the switches of a table to the parameters.
    fn switches(&self, base: &str, value: &mut Value, into: &mut Overrides) -> Result<(), ConfigError> {
        let Some(fields) = value.as_object_mut() else { return Ok(()) };
        for switch in self.registry.switches() {
            let Some(given) = fields.remove(switch.key) else { continue };
            if !given.is_boolean() {
                let message = format!("`{}` is {given}; expected true or false", switch.key);
                return Err(self.document.error(&join(base, switch.key), message));
            }
            into.insert(switch.key.to_string(), given);
        }
        Ok(())
    }

    /// A scene's or variant's table, split into its own keys and the parameters of stages.
    fn entry(&self, base: &str, place: &str, value: Value) -> Result<(Value, Overrides), ConfigError> {
        let fields = self.table(base, value)?;
        let is_stage = |name: &String| self.registry.stage(name).is_ok();
        let (stages, own): (Map<_, _>, Map<_, _>) = fields.into_iter().partition(|(name, _)| is_stage(name));
        let mut overrides = self.stages(base, stages)?;
        let mut own = Value::Object(own);
        self.switches(base, &mut own, &mut overrides)?;
        self.shorthands(place, base, &mut own, &mut overrides)?;
        Ok((own, overrides))
    }

    /// The key words that a place accepts in addition to its own keys.
    fn words(&self, place: &str) -> Vec<&'static str> {
        let stages = self.registry.sections().map(Stage::name);
        stages.chain(self.short_words(place)).chain(self.switch_words()).collect()
    }

    fn switch_words(&self) -> impl Iterator<Item = &'static str> {
        self.registry.switches().iter().map(|switch| switch.key)
    }

    fn typed<T: DeserializeOwned>(&self, base: &str, value: &Value, more: &[&str]) -> Result<T, ConfigError> {
        read(value).map_err(|error| {
            if let Problem::Missing(missing) = &error.problem {
                let place = match (base, error.path.as_str()) {
                    ("", "") => "the pipeline".to_string(),
                    (_, "") => format!("[[{}]]", stem(base)),
                    (_, table) => format!("`{table}`"),
                };
                return self.document.error(&join(base, &error.path), format!("{place} needs `{missing}`"));
            }
            let (unknown, known) = error.unknown_key().unzip();
            if let (Some(key @ ("preset" | "method")), true) = (unknown, base.starts_with("scene")) {
                let message = &format!(
                    "`{key}` belongs at the top of the file or in a [[variant]], not in a [[scene]]"
                );
                return self.document.key_error(&join(base, &error.path), message);
            }
            // Nested tables have key words of their own.
            let unknown = unknown.filter(|_| !error.path.contains('.'));
            let known = || more.iter().copied().chain(known.into_iter().flatten().map(String::as_str));
            if let Some((stage, name)) = unknown.and_then(|u| parameters::meant(self.registry, u, known())) {
                let place = match base {
                    "" => format!("[defaults.{stage}] {name} = …"),
                    _ => format!("{stage} = {{ {name} = … }}"),
                };
                let message =
                    format!("unknown key `{}`; did you mean `{place}`?", unknown.unwrap_or_default());
                return self.document.key_error(&join(base, &error.path), message);
            }
            let mut tables = ["calibrator", "models"].into_iter().filter(|_| base.is_empty());
            let inner =
                tables.find(|p| error.path.starts_with(&format!("{p}."))).map(|p| self.short_words(p));
            self.document.parameter_error(base, &error, inner.as_deref().unwrap_or(more))
        })
    }

    /// Refuses settings for learning a calibrator together with a finished one: they would have no effect.
    fn finished(&self, calibrator: &Value, defaults: &Overrides) -> Result<(), ConfigError> {
        if calibrator.get("file").is_none() {
            return Ok(());
        }
        if let Some(stage) = learning(self.registry).iter().find(|stage| defaults.contains_key(**stage)) {
            let message = format!(
                "`[calibrator] file` is a finished calibrator: nothing is learnt, so [defaults.{stage}] has no effect; leave one of them out"
            );
            return Err(self.document.key_error(&format!("defaults.{stage}"), message));
        }
        let short = || self.registry.shorthands().iter().filter(|s| s.place == "calibrator");
        let elsewhere =
            |key: &str| short().any(|s| s.key == key && !learning(self.registry).contains(&s.stage));
        let useless = short().map(|s| s.key).find(|key| calibrator.get(key).is_some() && !elsewhere(key));
        let Some(key) = useless else { return Ok(()) };
        let message = format!(
            "`file` is a finished calibrator: nothing is learnt, so `{key}` has no effect; leave one of them out"
        );
        Err(self.document.key_error(&format!("calibrator.{key}"), message))
    }

    fn short_words(&self, place: &str) -> Vec<&'static str> {
        self.registry.shorthands().iter().filter(|s| s.place == place).map(|s| s.key).collect()
    }

    fn calibrator(
        &self,
        given: &Calibrator,
        folder: &Path,
        said: &dyn Fn(&str) -> String,
        batch: &mut Batch,
    ) -> Result<(), ConfigError> {
        if given.pairs.is_some() && given.file.is_some() {
            let message =
                "`file` is a finished calibrator and `pairs` are for making one; give only one of them";
            return Err(self.document.key_error("calibrator.file", message));
        }
        let pairs = given.pairs.iter();
        let named = pairs.flat_map(|p| [("pairs.input", &p.input), ("pairs.target", &p.target)]);
        for (external, path) in named.chain(given.file.iter().map(|file| ("calibrator", file))) {
            let place = expand(path, folder).map(|place| match external {
                "calibrator" => place,
                _ => downloads::unpacked_or_not(place),
            });
            batch.name_external(external, place, said(key_of(external)));
        }
        Ok(())
    }

    /// Name and parameters of the method and the preset in the table at `base`.
    fn preset(
        &self,
        base: &str,
        method: &Option<String>,
        preset: &Option<String>,
    ) -> Result<Option<(String, Overrides)>, ConfigError> {
        let wrong = |key: &str, fault: &ConfigError| self.document.error(&join(base, key), fault.to_string());
        let mut name = preset.clone().unwrap_or_default();
        if let Some(method) = method {
            name = presets::with_method(&name, method).map_err(|fault| wrong("method", &fault))?;
        }
        if name.is_empty() {
            return Ok(None);
        }
        let values = preset_values(&name).map_err(|fault| wrong("preset", &fault))?;
        Ok(Some((name, values)))
    }

    fn name(&self, path: &str, name: &str) -> Result<(), ConfigError> {
        let bad = |c: char| c.is_control() || "/\\:*?\"<>|".contains(c);
        if !name.is_empty() && !name.starts_with('.') && !name.contains(bad) {
            return Ok(());
        }
        let message = format!(
            "`{name}` is also the name of a folder: use only letters, digits, spaces, `-`, `_` and inner `.`"
        );
        Err(self.document.error(path, message))
    }

    fn unique<'n>(
        &self,
        base: &str,
        name: &str,
        mut before: impl Iterator<Item = &'n String>,
    ) -> Result<(), ConfigError> {
        let path = join(base, "name");
        self.name(&path, name)?;
        if before.any(|other| other == name) {
            let message = format!("the name `{name}` is used twice; names must be unique");
            return Err(self.document.error(&path, message));
        }
        Ok(())
    }
}

fn stem(base: &str) -> &str {
    base.split('[').next().unwrap_or(base)
}

/// Merges parameters into those of a stage. With `wins`, the new values override the existing ones.
fn merge_into(into: &mut Overrides, stage: &str, given: &Value, wins: bool) {
    match into.get_mut(stage) {
        Some(there) if wins => canonical::merge(there, given),
        Some(there) => {
            let mut base = given.clone();
            canonical::merge(&mut base, there);
            *there = base;
        }
        None => {
            into.insert(stage.to_string(), given.clone());
        }
    }
}

/// A question that suggests the most similar of some names; empty if none is similar.
fn did_you_mean<'n>(wrong: &str, names: impl IntoIterator<Item = &'n str>) -> String {
    nearest(wrong, names).map(|n| format!("; did you mean `{n}`?")).unwrap_or_default()
}
