//! Compares the preset `paper` with a table written from the paper: every parameter of every stage, its value
//! and its source.

use std::collections::BTreeMap;

use serde_json::{Value, json};
use use3d_pipeline::config::{parameters, preset_values};
use use3d_stages::registry;

/// A parameter in the paper's configuration.
struct Entry {
    /// The value; `None` if the preset leaves it to the pipeline.
    value: Option<Value>,
    /// `paper`, `authors`, `ours` or `pipeline`.
    by: String,
    where_: String,
}

/// The table, by `stage.parameter`.
fn table() -> BTreeMap<String, Entry> {
    let text = include_str!("parameters.toml");
    let stages: toml::Table = text.parse().expect("TOML");
    let mut all = BTreeMap::new();
    for (stage, entries) in &stages {
        for (name, entry) in entries.as_table().expect("a table") {
            let text = |key: &str| entry.get(key).and_then(|v| v.as_str()).unwrap_or_default().to_string();
            let value = entry.get("value").map(|v| serde_json::to_value(v).expect("a value"));
            let entry = Entry { value, by: text("by"), where_: text("where") };
            all.insert(format!("{stage}.{name}"), entry);
        }
    }
    all
}

/// Dotted paths and values of some parameters.
fn leaves(value: &Value, place: &str, found: &mut BTreeMap<String, Value>) {
    match value {
        Value::Object(fields) => {
            fields.iter().for_each(|(key, inner)| leaves(inner, &format!("{place}.{key}"), found));
        }
        _ => {
            found.insert(place.to_string(), value.clone());
        }
    }
}

/// True if two values are the same number, text or list; 32-bit numbers agree to 7 digits.
fn same(a: &Value, b: &Value) -> bool {
    match (a, b) {
        (Value::Number(a), Value::Number(b)) => {
            let (a, b) = (a.as_f64().expect("a number"), b.as_f64().expect("a number"));
            (a - b).abs() <= 1e-7 * a.abs().max(b.abs())
        }
        (Value::Array(a), Value::Array(b)) => a.len() == b.len() && a.iter().zip(b).all(|(a, b)| same(a, b)),
        _ => a == b,
    }
}

const HELP: &str = "Every parameter stands in crates/pipeline/tests/paper/parameters.toml, with its value in the paper's \
    configuration and where the paper says so (or by = \"ours\" and the row of docs/science/decisions.md), and with the same value in \
    crates/pipeline/src/config/presets/paper.toml. A parameter that switches something on which the paper does not have gets \
    the value that leaves the method as the paper has it. Places and bookkeeping get by = \"pipeline\", no value, and no line \
    in the preset";

#[test]
fn the_preset_is_the_paper_value_by_value() {
    let registry = registry().expect("the stage table");
    let table = table();
    let written = preset_values("paper").expect("the preset");
    let (mut there, mut said) = (BTreeMap::new(), BTreeMap::new());
    for stage in registry.stages() {
        let given = written.get(stage.name()).cloned().unwrap_or_else(|| json!({}));
        leaves(stage.parameters(&given).expect("the preset fits").json(), stage.name(), &mut there);
    }
    written.iter().for_each(|(stage, values)| leaves(values, stage, &mut said));
    let mut wrong = Vec::new();
    for (name, found) in &there {
        match table.get(name) {
            None => wrong.push(format!("{name} = {found} is not in the table")),
            Some(Entry { value: Some(value), .. }) => {
                if !same(value, found) {
                    wrong.push(format!("{name} is {value} in the table and {found} with the preset"));
                }
                if !said.contains_key(name) {
                    wrong.push(format!("{name} = {value} is not written out in the preset"));
                }
            }
            Some(Entry { value: None, .. }) => {
                if said.contains_key(name) {
                    wrong.push(format!("{name} is the pipeline's to say, and the preset says it"));
                }
            }
        }
    }
    for (name, entry) in &table {
        if !there.contains_key(name) {
            wrong.push(format!("{name} is in the table and is no parameter"));
        }
        let known = ["paper", "authors", "ours", "pipeline"].contains(&entry.by.as_str());
        if !known || entry.where_.is_empty() || (entry.by == "pipeline") == entry.value.is_some() {
            wrong.push(format!("{name}: `by` and `where` do not say who states its value"));
        }
    }
    assert!(wrong.is_empty(), "{}\n\n{HELP}.", wrong.join("\n"));
}

/// `use3d params --preset paper --json` prints this list.
#[test]
fn the_listed_parameters_of_the_preset_equal_the_table() {
    let listed = parameters(&registry().expect("the stage table"), None, Some("paper")).expect("a list");
    let table = table();
    for stage in &listed {
        for parameter in &stage.parameters {
            let name = format!("{}.{}", stage.stage, parameter.name);
            // An optional parameter without a value has nothing to compare.
            if parameter.value.is_null() && !table.contains_key(&name) {
                continue;
            }
            let entry = table.get(&name).unwrap_or_else(|| panic!("{name}. {HELP}."));
            if let Some(value) = &entry.value {
                assert!(same(value, &parameter.value), "{name}: {value} and {}", parameter.value);
            } else {
                assert_eq!(parameter.value, parameter.default, "{name}");
            }
        }
    }
    let unknown =
        parameters(&registry().expect("the stage table"), None, Some("papre")).unwrap_err().to_string();
    assert!(unknown.contains("did you mean `paper`?"), "{unknown}");
}

/// The table is written from the paper, so the paper's own numbers must be marked in it as the paper's.
#[test]
fn what_the_paper_states_is_marked_as_the_papers() {
    let table = table();
    for (name, value) in [
        ("reconstruct.iterations", json!(15000)),
        ("reconstruct.anchors", json!(8)),
        ("reconstruct.top_k", json!(4)),
        ("reconstruct.sh_degree", json!(3)),
        ("reconstruct.structure_weight", json!(0.2)),
        ("reconstruct.depth_weight", json!(0.1)),
        ("enhance.iterations", json!(5000)),
        ("enhance.resolution", json!(16)),
        ("enhance.rank", json!(8)),
        ("enhance.width", json!(64)),
        ("enhance.lambda_variation", json!(1e-4)),
        ("enhance.learning_rate", json!(1e-3)),
        ("enhance.transport_learning_rate", json!(2e-4)),
        ("pairs.extractor.cells", json!(16)),
        ("calibrate.scales", json!("operators")),
        ("evaluate.scores", json!("all")),
    ] {
        let entry = &table[name];
        assert_eq!((entry.by.as_str(), entry.value.as_ref()), ("paper", Some(&value)), "{name}");
    }
}
