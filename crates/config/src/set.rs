//! Applies the option `--set KEY=VALUE`.

use std::path::Path;

use serde_json::{Map, Value};
use use3d_workflow::error::Problem;
use use3d_workflow::graph::Overrides;
use use3d_workflow::{Batch, ParameterError, Registry, Source, Stage};

use super::document::{ConfigError, loose_value};
use super::parameters::homes;
use super::places::{expand, external_of, key_of, override_external};
use super::presets::{with_method, with_preset};
use super::{did_you_mean, merge_into, preset_values};

/// A value from the command line in the type that a stage's parameter expects. For example, TOML reads
/// `size=640` and `size=0x0` as numbers, but the stage expects text.
fn typed(stage: &Stage, key: &str, value: &Value, text: &str) -> Result<Value, ParameterError> {
    let first = nested(key, value.clone());
    let Err(error) = stage.parameters(&first) else { return Ok(first) };
    if value.is_string() || error.problem != Problem::NoText {
        return Err(error);
    }
    let second = nested(key, Value::String(text.to_string()));
    stage.parameters(&second).map(|_| second)
}

/// Applies one setting: `seed=7`, `method=3dgs`, `preset=paper`, `stage2=false`,
/// `reconstruct.iterations=3000`,
/// `calibrator.proposer=fusion`, `scene.Panama.reconstruct.iterations=3000`, `variant.mlp.enhance.steps=10`.
pub(super) fn apply(registry: &Registry, batch: &mut Batch, setting: &str) -> Result<(), ConfigError> {
    let (key, text, value) = split(setting)?;
    let wrong = |fault: ConfigError| ConfigError::plain(format!("--set {setting}: {fault}"));
    // Paths on the command line are relative to the current folder.
    let path = || expand(&value.as_str().map_or_else(|| value.to_string(), String::from), Path::new(""));
    let by = format!("--set {key}");
    if let Some(external) = external_of(key) {
        override_external(batch, external, path(), &by);
        return Ok(());
    }
    // A preset lies over the method that is there, and a method below the preset.
    let preset = |key: &str, before: &str| {
        let given = value.as_str().unwrap_or(text);
        let name = match key {
            "method" => with_method(before, given).map_err(wrong)?,
            _ => with_preset(before, given),
        };
        preset_values(&name).map(|values| (name, values)).map_err(wrong)
    };
    let set = |top: &str, key: &str, into: &mut Overrides| {
        place(registry, top, key, (&value, text), into).map_err(wrong)
    };
    if let Some(rest) = key.strip_prefix("scene.") {
        let (index, rest) = named("scene", rest, batch.scenes.iter().map(|s| &*s.name)).map_err(wrong)?;
        let scene = &mut batch.scenes[index];
        if let Some(external) = ["capture", "footage", "calibrator"].into_iter().find(|e| key_of(e) == rest) {
            // A scene has cameras, or it has none yet.
            if external != "calibrator" {
                ["capture", "footage"].iter().for_each(|name| drop(scene.externals.remove(*name)));
            }
            scene.name_external(external, path(), by);
            return Ok(());
        }
        return set("scene", rest, &mut scene.forced);
    }
    if let Some(rest) = key.strip_prefix("variant.") {
        let (index, rest) = named("variant", rest, batch.variants.iter().map(|v| &*v.name)).map_err(wrong)?;
        let variant = &mut batch.variants[index];
        if rest == "preset" || rest == "method" {
            let (name, values) = preset(rest, variant.preset_name.as_deref().unwrap_or_default())?;
            (variant.preset_name, variant.preset) = (Some(name), Some(values));
            return Ok(());
        }
        if rest == key_of("calibrator") {
            variant.name_external("calibrator", path(), by);
            return Ok(());
        }
        return set("variant", rest, &mut variant.forced);
    }
    if key == "preset" || key == "method" {
        (batch.preset_name, batch.preset) = preset(key, &batch.preset_name)?;
        return Ok(());
    }
    if key == "seed" {
        let seed =
            value.as_u64().ok_or_else(|| wrong(ConfigError::plain("the seed is a whole number, 0 or more")));
        batch.seed = seed?;
        return Ok(());
    }
    let key = key.strip_prefix("defaults.").unwrap_or(key);
    let (top, rest) = key.split_once('.').unwrap_or(("", key));
    let is_short = |top: &str| registry.shorthands().iter().any(|s| s.place == top && s.key == rest);
    if is_short(top) {
        return set(top, rest, &mut batch.forced);
    }
    if top == "calibrator" {
        let own = ["pairs.input", "pairs.target", "calibrator"].map(key_of).map(str::to_string);
        let words = registry.shorthands().iter().filter(|s| s.place == top);
        let known: Vec<String> = own.into_iter().chain(words.map(|s| format!("{top}.{}", s.key))).collect();
        let known = known.join(", ");
        let fault = format!("no such setting of the calibrator; there are: {known}");
        return Err(wrong(ConfigError::plain(fault)));
    }
    let top = if top.is_empty() && is_short("scene") { "scene" } else { "" };
    set(top, key, &mut batch.forced)
}

/// Splits a setting into the key, the value as written, and the value as TOML reads it.
fn split(setting: &str) -> Result<(&str, &str, Value), ConfigError> {
    let (key, value) = setting.split_once('=').ok_or_else(|| {
        ConfigError::plain(format!(
            "--set {setting}: KEY=VALUE is expected, e.g. reconstruct.iterations=3000"
        ))
    })?;
    Ok((key.trim(), value.trim(), loose_value(value.trim())))
}

/// The index of the scene or variant whose name `rest` starts with, and the remaining text. The name may
/// contain dots, and upper and lower case are not distinguished.
fn named<'k, 'n>(
    kind: &str,
    rest: &'k str,
    names: impl Iterator<Item = &'n str> + Clone,
) -> Result<(usize, &'k str), ConfigError> {
    let after = |name: &str, exact: bool| {
        let head = rest.get(..name.len())?;
        let same = if exact { head == name } else { head.eq_ignore_ascii_case(name) };
        if same { rest[name.len()..].strip_prefix('.') } else { None }
    };
    for exact in [true, false] {
        let fitting = names.clone().enumerate().filter_map(|(i, name)| Some((i, after(name, exact)?)));
        // Of `a` and `a.b`, the longer name is meant by `a.b.reconstruct.iterations`.
        if let Some(found) = fitting.min_by_key(|(_, remaining)| remaining.len()) {
            return Ok(found);
        }
    }
    if let Some(name) = names.clone().find(|n| n.eq_ignore_ascii_case(rest)) {
        return Err(ConfigError::plain(format!(
            "a parameter is missing: give one, as in `{kind}.{name}.reconstruct.iterations=3000`"
        )));
    }
    let wrong = rest.split('.').next().unwrap_or(rest);
    Err(ConfigError::plain(format!("no {kind} `{wrong}`{}", did_you_mean(wrong, names))))
}

fn place(
    registry: &Registry,
    place: &str,
    key: &str,
    (value, text): (&Value, &str),
    into: &mut Overrides,
) -> Result<(), ConfigError> {
    if registry.switch_of(key).is_some() {
        if !value.is_boolean() {
            return Err(ConfigError::plain(format!("`{key}` is {text}; expected true or false")));
        }
        into.insert(key.to_string(), value.clone());
        return Ok(());
    }
    let shorthands = registry.shorthands().iter().filter(|s| s.place == place && s.key == key);
    let mut targets: Vec<(&str, &str)> = shorthands.map(|s| (s.stage, s.parameter)).collect();
    if targets.is_empty() {
        targets.push(key.split_once('.').ok_or_else(|| {
            let homes = homes(registry, key);
            let known: Vec<String> = homes.iter().map(|(stage, name)| format!("`{stage}.{name}`")).collect();
            let hint = match known.is_empty() {
                true => "`use3d params` lists them".to_string(),
                false => format!("did you mean {}?", known.join(" or ")),
            };
            ConfigError::plain(format!("a key is STAGE.PARAMETER; {hint}"))
        })?);
    }
    for (stage, parameter) in targets {
        let stage = registry.stage(stage).map_err(|e| ConfigError::plain(e.to_string()))?;
        let given = typed(stage, parameter, value, text)
            .map_err(|e| ConfigError::plain(folder_key(stage, &e).unwrap_or_else(|| words(&e))))?;
        merge_into(into, stage.name(), &given, true);
    }
    Ok(())
}

/// A hint that gives the right key if an unknown parameter name is in fact the name of a file or folder that
/// the stage reads.
fn folder_key(stage: &Stage, error: &ParameterError) -> Option<String> {
    let (unknown, _) = error.unknown_key()?;
    let input = stage.inputs.iter().find(|i| i.role == unknown)?;
    let Source::External(name) = input.source else { return None };
    Some(format!("`{unknown}` is an input and not a parameter; give it with `{}`", key_of(name)))
}

fn words(error: &ParameterError) -> String {
    match error.unknown_key() {
        Some((unknown, known)) => super::unknown_key(unknown, known.iter().map(String::as_str)),
        None => error.to_string(),
    }
}

/// Nests a value: `split.every`, 8 → `{split: {every: 8}}`.
pub(super) fn nested(path: &str, value: Value) -> Value {
    path.rsplit('.').fold(value, |inner, name| Value::Object(Map::from_iter([(name.to_string(), inner)])))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_two_names_that_fit_the_longer_one_is_meant() {
        for names in [["a", "a.b"], ["a.b", "a"]] {
            let found = named("scene", "a.b.reconstruct.iterations", names.into_iter()).unwrap();
            assert_eq!((names[found.0], found.1), ("a.b", "reconstruct.iterations"));
            let found = named("scene", "A.reconstruct.iterations", names.into_iter()).unwrap();
            assert_eq!((names[found.0], found.1), ("a", "reconstruct.iterations"));
        }
    }
}
