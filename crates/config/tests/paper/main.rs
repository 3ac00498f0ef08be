//! The preset `paper`: every parameter of every stage that it names has its value there and the value's
//! source, and what the paper states is compared with a list of its own. A stage that it does not name is not
//! the paper's.

use std::collections::{BTreeMap, BTreeSet};

use serde_json::{Value, json};
use use3d_config::{parameters, preset_values};
use use3d_stages::registry;

mod lines;

use lines::lines;

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

const HELP: &str = "Every parameter of a stage of the paper has a line in crates/config/src/presets/paper.toml: its value in the paper's \
    configuration, and in the line's comment who states it (`paper`, `authors`, or `ours` with the row of \
    docs/science/decisions.md) and where. A parameter that switches something on which the paper does not have gets the value \
    that leaves the method as the paper has it. Places and bookkeeping have the line `# NAME # pipeline: REASON`";

#[test]
fn the_preset_has_every_parameter_with_its_source() {
    let registry = registry().expect("the stage table");
    let written = preset_values("paper").expect("the preset");
    let (mut there, mut said) = (BTreeMap::new(), BTreeMap::new());
    for stage in registry.sections() {
        let given = written.get(stage.name()).cloned().unwrap_or_else(|| json!({}));
        leaves(stage.parameters(&given).expect("the preset fits").json(), stage.name(), &mut there);
    }
    written.iter().for_each(|(stage, values)| leaves(values, stage, &mut said));
    let lines = lines();
    let mut wrong = Vec::new();
    // The other tests of completeness ask the values as they are written, where a field may be left out.
    for stage in parameters(&registry, None, None).expect("a list") {
        let names = stage.parameters.iter().map(|parameter| format!("{}.{}", stage.stage, parameter.name));
        let hidden = names.filter(|name| !there.contains_key(name));
        wrong.extend(hidden.map(|name| format!("{name} is a parameter, and its default is never written")));
    }
    let stage_of = |name: &str| name.split('.').next().unwrap_or_default().to_string();
    let named: BTreeSet<String> = lines.keys().map(|name| stage_of(name)).collect();
    for name in there.keys().filter(|name| named.contains(&stage_of(name)) && !lines.contains_key(*name)) {
        wrong.push(format!("{name} has no line"));
    }
    for stage in ["import", "depth", "pairs", "calibrate", "reconstruct", "targets", "enhance", "evaluate"] {
        assert!(named.contains(stage), "{stage} is a stage of the paper");
    }
    for (name, (by, place)) in &lines {
        if !there.contains_key(name) {
            wrong.push(format!("{name} has a line and is no parameter"));
        }
        if !["paper", "authors", "ours", "pipeline"].contains(&by.as_str()) || place.is_empty() {
            wrong.push(format!("{name}: the comment does not say who states its value, and where"));
        }
        if (by == "pipeline") == said.contains_key(name) {
            wrong.push(format!(
                "{name}: places and bookkeeping have no value in the preset, all others have one"
            ));
        }
    }
    assert!(wrong.is_empty(), "{}\n\n{HELP}.", wrong.join("\n"));
}

/// `use3d params --preset paper --json` prints this list.
#[test]
fn the_listed_parameters_are_those_of_the_preset() {
    let listed = parameters(&registry().expect("the stage table"), None, Some("paper")).expect("a list");
    let mut said = BTreeMap::new();
    preset_values("paper").expect("the preset").iter().for_each(|(stage, v)| leaves(v, stage, &mut said));
    for stage in &listed {
        for parameter in &stage.parameters {
            let name = format!("{}.{}", stage.stage, parameter.name);
            match said.get(&name) {
                Some(value) => {
                    assert!(same(value, &parameter.value), "{name}: {value} and {}", parameter.value);
                }
                None => assert_eq!(parameter.value, parameter.default, "{name}"),
            }
        }
    }
    let unknown =
        parameters(&registry().expect("the stage table"), None, Some("papre")).unwrap_err().to_string();
    assert!(unknown.contains("did you mean `paper`?"), "{unknown}");
}

/// This list is written from the paper, not from the preset.
#[test]
fn the_preset_has_what_the_paper_states() {
    let (lines, mut said) = (lines(), BTreeMap::new());
    preset_values("paper").expect("the preset").iter().for_each(|(stage, v)| leaves(v, stage, &mut said));
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
        ("calibrate.scale_floor", json!(1e-4)),
        ("evaluate.scores", json!("all")),
        ("evaluate.fps_size", json!("1400x933")),
    ] {
        assert_eq!((lines[name].0.as_str(), &said[name]), ("paper", &value), "{name}");
    }
}
