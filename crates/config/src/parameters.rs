//! The list of all stage parameters for users: name, kind, default and meaning. It comes from the schema that
//! checks pipeline files.

use serde::Serialize;
use serde_json::{Value, json};
use use3d_workflow::{Registry, Stage};

use super::document::{ConfigError, join};
use super::presets::preset_values;
use super::schema::{resolved, schema, shortest};

/// The parameters of a stage.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct StageParameters {
    /// The stage.
    pub stage: &'static str,
    /// A description of one line.
    pub about: &'static str,
    /// Its parameters, by name.
    pub parameters: Vec<Parameter>,
}

/// One parameter.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Parameter {
    /// Its name within the stage, with dots between levels: `split.every`.
    pub name: String,
    /// The accepted values: `whole number`, `number`, `true or false`, `text`, `list`, or the choices.
    pub kind: String,
    /// Its value if nothing is set.
    pub default: Value,
    /// Its value with the requested preset; the default value without a preset.
    pub value: Value,
    /// Its effect, and its range.
    pub meaning: String,
}

/// The parameters of all stages or of one stage, with the values of a preset if one is named.
///
/// # Errors
/// The stage or the preset is unknown.
pub fn parameters(
    registry: &Registry,
    stage: Option<&str>,
    preset: Option<&str>,
) -> Result<Vec<StageParameters>, ConfigError> {
    let section = |name| registry.stage(name).map(Stage::section);
    let stage = stage.map(section).transpose().map_err(|e| ConfigError::plain(e.to_string()))?;
    let preset = preset.map(preset_values).transpose()?.unwrap_or_default();
    let schema = schema(registry);
    let chosen = registry.sections().filter(|s| stage.is_none_or(|name| s.name() == name));
    let of = |stage: &Stage| {
        let table = &schema["properties"]["defaults"]["properties"][stage.name()]["allOf"][0];
        let of = |given: &Value| stage.parameters(given).map_or(Value::Null, |p| Value::clone(p.json()));
        let defaults = of(&json!({}));
        let given = preset.get(stage.name()).cloned().unwrap_or_else(|| json!({}));
        let values = of(&given);
        let mut parameters = Vec::new();
        list(&schema, table, [&defaults, &values], "", &mut parameters);
        StageParameters { stage: stage.name(), about: stage.about, parameters }
    };
    Ok(chosen.map(of).collect())
}

/// The stage parameters that a name without a stage may mean, as (stage, parameter) pairs: the parameters of
/// exactly that name, else those with the most similar name.
pub(super) fn homes(registry: &Registry, name: &str) -> Vec<(&'static str, String)> {
    let all: Vec<(&'static str, String)> = parameters(registry, None, None)
        .unwrap_or_default()
        .into_iter()
        .flat_map(|s| s.parameters.into_iter().map(move |p| (s.stage, p.name)))
        .collect();
    let last = |name: &str| name.rsplit('.').next().unwrap_or(name).to_string();
    let exact: Vec<_> = all.iter().filter(|(_, p)| *p == name || last(p) == name).cloned().collect();
    if !exact.is_empty() {
        return exact;
    }
    let near = use3d_workflow::error::nearest(name, all.iter().map(|(_, p)| p.as_str())).map(String::from);
    all.into_iter().filter(|(_, p)| near.as_ref() == Some(p)).collect()
}

/// The stage and the parameter that a key without a stage most likely means. `None` if one of the names that
/// are valid at this place is as similar.
pub(super) fn meant<'k>(
    registry: &Registry,
    key: &str,
    known: impl Iterator<Item = &'k str>,
) -> Option<(&'static str, String)> {
    let near = |name: &str| strsim::jaro_winkler(key, name);
    let best = known.map(near).fold(0.0, f64::max);
    homes(registry, key).into_iter().find(|(_, name)| near(name) > best.max(0.9))
}

fn list(schema: &Value, table: &Value, values: [&Value; 2], base: &str, into: &mut Vec<Parameter>) {
    let Some(properties) = resolved(schema, table)["properties"].as_object() else { return };
    for (key, entry) in properties {
        let name = join(base, key);
        let what = resolved(schema, entry);
        if what["properties"].is_object() {
            list(schema, entry, values.map(|v| &v[key]), &name, into);
            continue;
        }
        let meaning = entry["description"].as_str().or(what["description"].as_str()).unwrap_or_default();
        let meaning = meaning.split_whitespace().collect::<Vec<_>>().join(" ");
        let [default, value] = values.map(|v| shortest(schema, entry, &v[key]));
        into.push(Parameter { name, kind: kind(what), default, value, meaning });
    }
}

/// The accepted values of a parameter, as text.
fn kind(entry: &Value) -> String {
    fn items(list: &Value) -> &[Value] {
        list.as_array().map(Vec::as_slice).unwrap_or_default()
    }
    // Choices without a comment of their own are listed together in an `enum`.
    let alone = items(&entry["oneOf"]).iter().map(|choice| &choice["const"]);
    let together = items(&entry["oneOf"]).iter().chain([entry]).flat_map(|group| items(&group["enum"]));
    let named: Vec<&str> = alone.chain(together).filter_map(Value::as_str).collect();
    if !named.is_empty() {
        return named.join(" | ");
    }
    let own = match &entry["type"] {
        Value::Array(types) => types.iter().find_map(Value::as_str),
        other => other.as_str(),
    };
    match own {
        Some("integer") => "whole number",
        Some("number") => "number",
        Some("boolean") => "true or false",
        Some("array") => "list",
        _ => "text",
    }
    .to_string()
}
