//! Files and folders that a pipeline names: the key that names each input, and the notation of paths.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use serde_json::{Map, Value};
use use3d_workflow::graph::{External, Overrides};
use use3d_workflow::{Batch, Registry, Scope, Source, Stage};

use super::document::ConfigError;
use super::downloads;

/// The stage whose parameters decide about proposals for the whole pipeline.
const TARGETS: &str = "targets";

/// The external inputs that apply to all scenes, each with the key of the pipeline file that names it.
const KEYS: [(&str, &str); 4] = [
    ("models", "models.dir"),
    ("pairs.input", "calibrator.pairs.input"),
    ("pairs.target", "calibrator.pairs.target"),
    ("calibrator", "calibrator.file"),
];

/// True if a target is a film, or a folder with films or photographs and no sign of their cameras.
pub fn lacks_cameras(target: &Path) -> bool {
    if target.is_dir() {
        return use3d_import::holds_no_model(target) && use3d_prepare::holds_inputs(target);
    }
    target.is_file() && use3d_prepare::is_film(target)
}

/// The key that names an external input.
pub(super) fn key_of(external: &str) -> &str {
    KEYS.iter().find(|(name, _)| *name == external).map_or(external, |(_, key)| key)
}

/// The external input that a key names for all scenes.
pub(super) fn external_of(key: &str) -> Option<&'static str> {
    KEYS.iter().find(|(_, known)| *known == key).map(|(name, _)| *name)
}

/// Sets an external input for all scenes. A finished calibrator replaces pairs, and a folder of pairs
/// replaces a finished calibrator: the last setting counts.
pub(super) fn override_external(batch: &mut Batch, external: &str, place: External, by: &str) {
    let others: &[&str] = match external {
        "calibrator" => &["pairs.input", "pairs.target"],
        "pairs.input" | "pairs.target" => &["calibrator"],
        _ => &[],
    };
    // A calibrator given on the command line for all scenes also replaces the own calibrators of scenes and
    // variants.
    let own = ["calibrator"].into_iter().filter(|name| *name == external);
    for name in others.iter().copied().chain(own) {
        batch.externals.remove(name);
        batch.scenes.iter_mut().for_each(|scene| {
            scene.externals.remove(name);
        });
        batch.variants.iter_mut().for_each(|variant| {
            variant.externals.remove(name);
        });
    }
    batch.name_external(external, place, by);
}

/// Sets `targets.calibrated` to true where pairs, a calibrator or a parameter of its fit is given, unless
/// `targets.calibrated` itself is given.
///
/// The value goes into the weakest layer, so that every setting of a file or a command overrides it.
pub(super) fn calibrate_where_named(batch: &mut Batch, registry: &Registry) {
    let learning = learning(registry);
    let learns = |overrides: &Overrides| learns(overrides, &learning);
    if of_targets(&batch.defaults, "calibrated").is_some() {
        return;
    }
    let everywhere = ["pairs.input", "calibrator"].iter().any(|name| batch.externals.contains_key(*name))
        || learns(&batch.defaults)
        || learns(&batch.forced);
    let preset = batch.preset.clone();
    if everywhere {
        set_calibrated(&mut batch.preset);
    }
    for scene in &mut batch.scenes {
        let own =
            scene.externals.contains_key("calibrator") || learns(&scene.overrides) || learns(&scene.forced);
        if own && of_targets(&preset, "calibrated").is_none() {
            set_calibrated(&mut scene.overrides);
        }
    }
    for variant in &mut batch.variants {
        let own = variant.externals.contains_key("calibrator")
            || learns(&variant.overrides)
            || learns(&variant.forced);
        if everywhere || own {
            set_calibrated(variant.preset.get_or_insert_with(|| preset.clone()));
        }
    }
}

/// The stages that are left out where the pipeline names a finished calibrator.
pub(super) fn learning(registry: &Registry) -> Vec<&'static str> {
    let inputs = registry.stages().iter().flat_map(|stage| &stage.inputs);
    let replaced = inputs.filter(|input| input.instead == Some("calibrator"));
    let maker =
        replaced.filter_map(|input| if let Source::Stage(maker) = input.source { Some(maker) } else { None });
    maker.take(1).flat_map(|maker| registry.upstream(maker)).map(Stage::name).collect()
}

/// True if parameters of the stages that learn a calibrator are given.
fn learns(overrides: &Overrides, learning: &[&str]) -> bool {
    let given = |stage: &str| overrides.get(stage).and_then(Value::as_object).is_some_and(|p| !p.is_empty());
    learning.iter().any(|stage| given(stage))
}

/// The value that is given for a parameter of the targets.
fn of_targets<'o>(overrides: &'o Overrides, parameter: &str) -> Option<&'o Value> {
    overrides.get(TARGETS)?.get(parameter)
}

/// Sets `targets.calibrated = true` if it has no value yet.
fn set_calibrated(overrides: &mut Overrides) {
    let targets = overrides.entry(TARGETS).or_insert_with(|| Value::Object(Map::new()));
    if let Some(targets) = targets.as_object_mut() {
        targets.entry("calibrated").or_insert(Value::Bool(true));
    }
}

/// Refuses command-line settings for learning a calibrator when a finished one is used everywhere.
pub(super) fn check_learning(batch: &Batch, registry: &Registry) -> Result<(), ConfigError> {
    if !batch.externals.contains_key("calibrator") {
        return Ok(());
    }
    let by = batch.named.get("calibrator").map_or("", String::as_str);
    for stage in learning(registry) {
        let Some(Value::Object(given)) = batch.forced.get(stage) else { continue };
        // `calibrator.proposer` also sets the proposer of the targets.
        let of_both = of_targets(&batch.forced, "proposer").is_some();
        if let Some(name) = given.keys().find(|name| !(of_both && *name == "proposer")) {
            return Err(ConfigError::plain(format!(
                "--set {stage}.{name}: {by} names a finished calibrator: nothing is learnt, so this has no effect; leave one of them out"
            )));
        }
    }
    Ok(())
}

/// Applies the 2D enhancer of the targets also to the pairs, to the comparison that reconstructs from
/// proposals, and to the reference rows, unless these have a setting of their own in the same layer. So one
/// setting changes the 2D enhancer of a whole pipeline.
pub(super) fn one_proposer_for_all(batch: &mut Batch, registry: &Registry) {
    let has_proposer = |stage: &&Stage| {
        let defaults = stage.parameters(&Value::Object(Map::new()));
        stage.name() != TARGETS && defaults.is_ok_and(|own| own.json().get("proposer").is_some())
    };
    let following: Vec<&Stage> = registry.sections().filter(has_proposer).collect();
    let all: Vec<&str> = following.iter().map(|stage| stage.name()).collect();
    // Pairs are shared by all scenes.
    let of_scenes = following.iter().filter(|stage| stage.scope() == Scope::Scene);
    let of_scenes: Vec<&str> = of_scenes.map(|stage| stage.name()).collect();
    let follow = |layer: &mut Overrides, stages: &[&str]| {
        let given = of_targets(layer, "proposer").cloned();
        let Some(proposer) = given else { return };
        for stage in stages {
            let parameters = layer.entry(*stage).or_insert_with(|| Value::Object(Map::new()));
            if let Some(parameters) = parameters.as_object_mut() {
                parameters.entry("proposer").or_insert_with(|| proposer.clone());
            }
        }
    };
    follow(&mut batch.defaults, &all);
    follow(&mut batch.forced, &all);
    for variant in &mut batch.variants {
        follow(&mut variant.overrides, &all);
        follow(&mut variant.forced, &all);
    }
    for scene in &mut batch.scenes {
        follow(&mut scene.overrides, &of_scenes);
        follow(&mut scene.forced, &of_scenes);
    }
}

/// Refuses one of the two folders of pairs without the other.
pub(super) fn check_pairs(batch: &Batch) -> Result<(), ConfigError> {
    for (given, missing) in [("pairs.input", "pairs.target"), ("pairs.target", "pairs.input")] {
        if batch.externals.contains_key(given) && !batch.externals.contains_key(missing) {
            return Err(ConfigError::plain(format!(
                "`{}` needs `{}` beside it: pairs are two folders with equal file stems",
                key_of(given),
                key_of(missing)
            )));
        }
    }
    Ok(())
}

/// The folder that an environment variable names.
pub(super) fn folder_in(variable: &str) -> Option<PathBuf> {
    std::env::var_os(variable).filter(|v| !v.is_empty()).map(PathBuf::from)
}

/// The home folder.
pub(super) fn home() -> Option<PathBuf> {
    ["HOME", "USERPROFILE"].into_iter().find_map(folder_in)
}

/// The environment variables that the texts of a document or of the command line refer to.
pub(super) fn variables(value: &Value) -> BTreeSet<String> {
    match value {
        Value::String(text) => {
            let names = text.split("${").skip(1).filter_map(|rest| rest.split_once('}'));
            names.map(|(name, _)| name.to_string()).collect()
        }
        Value::Array(items) => items.iter().flat_map(variables).collect(),
        Value::Object(fields) => fields.values().flat_map(variables).collect(),
        _ => BTreeSet::new(),
    }
}

/// Expands a path of the file: `${NAME}` is an environment variable, `~` is the home folder, and relative
/// paths start at `folder`.
pub(super) fn expand(text: &str, folder: &Path) -> External {
    let mut out = String::new();
    let mut rest = text;
    while let Some(start) = rest.find("${") {
        out.push_str(&rest[..start]);
        let end = rest[start..].find('}').ok_or_else(|| format!("`{text}`: `${{` without `}}`"))? + start;
        let name = &rest[start + 2..end];
        let value = std::env::var(name).ok().filter(|v| !v.is_empty());
        let value = value.or_else(|| downloads::pairs(name, folder));
        out.push_str(&value.ok_or_else(|| {
            format!(
                "the environment variable {name} is not set; set it to the folder that `{text}` starts with"
            )
        })?);
        rest = &rest[end + 1..];
    }
    out.push_str(rest);
    let path = match out.strip_prefix("~/") {
        Some(below) => home().ok_or_else(|| format!("`{text}`: there is no home folder"))?.join(below),
        None => PathBuf::from(out),
    };
    Ok(folder.join(path))
}
