//! The JSON schema of the pipeline file, for editors: the file's own tables and every stage's parameters.

use schemars::JsonSchema;
use schemars::generate::SchemaSettings;
use serde_json::{Map, Value, json};
use use3d_workflow::{Registry, Scope, canonical};

use super::file::{PipelineFile, SceneEntry, VariantEntry};

/// The schema for the stages of `registry`.
pub fn schema(registry: &Registry) -> Value {
    let mut generator = SchemaSettings::draft2020_12().into_generator();
    let mut top = PipelineFile::json_schema(&mut generator).to_value();
    let mut scene = SceneEntry::json_schema(&mut generator).to_value();
    let mut variant = VariantEntry::json_schema(&mut generator).to_value();
    let mut stages = Map::new();
    for stage in registry.sections() {
        let schema = stage.schema(&mut generator).to_value();
        let schema = json!({ "description": stage.about, "allOf": [schema] });
        stages.insert(stage.name().to_string(), schema.clone());
        if stage.scope() == Scope::Scene {
            add(&mut scene, stage.name(), &schema);
        }
        if stage.scope() != Scope::Batch {
            add(&mut variant, stage.name(), &schema);
        }
    }
    for switch in registry.switches() {
        let entry = json!({ "description": switch.about, "type": "boolean" });
        [&mut top, &mut scene, &mut variant].into_iter().for_each(|table| add(table, switch.key, &entry));
    }
    let mut definitions = generator.take_definitions(true);
    for short in registry.shorthands() {
        let entry = json!({ "description": format!("Stands for `{}.{}`.", short.stage, short.parameter) });
        let table = match short.place {
            "scene" => Some(&mut scene),
            "variant" => Some(&mut variant),
            "" => Some(&mut top),
            place => definitions.get_mut(&(place[..1].to_uppercase() + &place[1..])),
        };
        if let Some(table) = table {
            add(table, short.key, &entry);
        }
    }
    let defaults = json!({
        "type": "object", "description": "Parameters of the stages, for all scenes.",
        "properties": stages, "additionalProperties": false
    });
    add(&mut top, "defaults", &defaults);
    add(&mut top, "scene", &json!({ "type": "array", "minItems": 1, "items": scene }));
    add(&mut top, "variant", &json!({ "type": "array", "items": variant }));
    if let Some(required) = top.get_mut("required").and_then(Value::as_array_mut) {
        required.push(json!("scene"));
    }
    canonical::merge(
        &mut top,
        &json!({
            "$schema": "https://json-schema.org/draft/2020-12/schema",
            "title": "use3d pipeline", "$defs": definitions
        }),
    );
    let whole = top.clone();
    shorten_defaults(&whole, &mut top);
    top
}

/// A default value as people write it. A 32-bit number gets the fewest digits that restore it; JSON would
/// print the digits of the same number in 64 bits. `entry` is the part of `schema` that describes the value.
pub(super) fn shortest(schema: &Value, entry: &Value, default: &Value) -> Value {
    let entry = resolved(schema, entry);
    match default {
        Value::Object(fields) => {
            let short = |(name, value): (&String, &Value)| {
                (name.clone(), shortest(schema, &entry["properties"][name], value))
            };
            Value::Object(fields.iter().map(short).collect())
        }
        Value::Array(items) => items.iter().map(|item| shortest(schema, &entry["items"], item)).collect(),
        Value::Number(number) if entry["format"] == "float" => {
            let single = number.as_f64().map(|double| (double as f32).to_string());
            single.and_then(|text| text.parse::<f64>().ok()).map_or_else(|| default.clone(), Value::from)
        }
        other => other.clone(),
    }
}

fn shorten_defaults(schema: &Value, entry: &mut Value) {
    if let Some(default) = entry.get("default").map(|default| shortest(schema, entry, default)) {
        entry["default"] = default;
    }
    match entry {
        Value::Object(fields) => {
            fields.values_mut().for_each(|inner| shorten_defaults(schema, inner));
        }
        Value::Array(items) => items.iter_mut().for_each(|inner| shorten_defaults(schema, inner)),
        _ => {}
    }
}

/// The schema that a reference leads to; for an optional value, the schema of the value that is not null.
pub(super) fn resolved<'s>(schema: &'s Value, entry: &'s Value) -> &'s Value {
    if let Some(name) = entry["$ref"].as_str().and_then(|r| r.strip_prefix("#/$defs/")) {
        return resolved(schema, &schema["$defs"][name]);
    }
    let given = |e: &&Value| e["type"] != "null";
    match entry["anyOf"].as_array().and_then(|options| options.iter().find(given)) {
        Some(option) => resolved(schema, option),
        None => entry,
    }
}

/// The text of the schema, as `use3d pipelines schema` prints it.
pub fn schema_text(registry: &Registry) -> String {
    let mut text = serde_json::to_string_pretty(&schema(registry)).unwrap_or_default();
    text.push('\n');
    text
}

fn add(schema: &mut Value, name: &str, entry: &Value) {
    canonical::merge(schema, &json!({ "properties": { name: entry } }));
}
