//! Presets: named sets of stage parameters. Each is a file of this folder and a row of the table.
//!
//! A preset is the weakest layer of parameters, below `[defaults]`. The line `base = "paper"` at the top of
//! its file puts it over another preset. A *method* is the preset of a method of the paper's tables, on which
//! another preset can stand: `3dgs + paper`. A variant's preset lies over the pipeline's: their names are
//! then joined, as in `paper + 3dgs`. Only its values count: no key, artifact or stage has its name. So a
//! file that writes the values out is the same pipeline. Only the results record the name of the preset and
//! the changes made to it.

use std::path::Path;

use schemars::{Schema, SchemaGenerator, json_schema};
use use3d_workflow::Batch;
use use3d_workflow::graph::Overrides;

use super::document::{ConfigError, Document};
use super::{did_you_mean, merge_into};

/// Names and file contents of the presets.
const PRESETS: &[(&str, &str)] = &[
    ("paper", include_str!("presets/paper.toml")),
    ("3d-use", include_str!("presets/3d-use.toml")),
    ("3dgs", include_str!("presets/3dgs.toml")),
    ("water-splatting", include_str!("presets/water-splatting.toml")),
    ("plenodium", include_str!("presets/plenodium.toml")),
    ("seasplat", include_str!("presets/seasplat.toml")),
    ("3d-uir", include_str!("presets/3d-uir.toml")),
    ("marinestd-gs", include_str!("presets/marinestd-gs.toml")),
];

/// The methods of the paper's tables that can be trained, in the order of its tables: presets on which
/// another preset can stand.
pub const METHODS: &[&str] =
    &["3dgs", "seasplat", "water-splatting", "plenodium", "3d-uir", "marinestd-gs", "3d-use"];

/// Further names of presets.
const ALIASES: &[(&str, &str)] = &[("vanilla", "3dgs"), ("watersplatting", "water-splatting")];

/// The names of all presets.
pub fn presets() -> impl Iterator<Item = &'static str> + Clone {
    PRESETS.iter().chain(ALIASES).map(|(name, _)| *name)
}

/// The preset that a name stands for.
fn standing(name: &str) -> &str {
    ALIASES.iter().find(|(alias, _)| *alias == name).map_or(name, |(_, preset)| preset)
}

fn is_method(name: &str) -> bool {
    METHODS.contains(&standing(name))
}

/// The name of a preset with another method below it.
///
/// # Errors
/// There is no such method.
pub(super) fn with_method(preset: &str, method: &str) -> Result<String, ConfigError> {
    if !is_method(method) {
        let known = METHODS.join(", ");
        let near = did_you_mean(method, METHODS.iter().copied());
        return Err(ConfigError::plain(format!("no method `{method}`; there are {known}{near}")));
    }
    let above = preset.split(OVER).filter(|name| !name.is_empty() && !is_method(name));
    Ok([method].into_iter().chain(above).collect::<Vec<_>>().join(OVER))
}

/// The name of a preset over the methods of another one. A method replaces them.
pub(super) fn with_preset(before: &str, preset: &str) -> String {
    let method = before.split(OVER).filter(|name| is_method(name) && !is_method(preset));
    method.chain([preset]).collect::<Vec<_>>().join(OVER)
}

/// Stands between the names of presets that lie over one another, the lowest first.
const OVER: &str = " + ";

/// The parameters of a preset, by stage; those of several for names joined by ` + `.
///
/// # Errors
/// There is no such preset.
pub fn preset_values(name: &str) -> Result<Overrides, ConfigError> {
    let mut values = Overrides::new();
    for name in name.split(OVER) {
        lay_over(&mut values, &values_in(PRESETS, name)?);
    }
    Ok(values)
}

/// The parameters of a preset of `table`, over those of its base.
fn values_in(table: &[(&str, &str)], name: &str) -> Result<Overrides, ConfigError> {
    let Some(at) = table.iter().position(|(known, _)| *known == standing(name)) else {
        let names = || table.iter().chain(ALIASES).map(|(name, _)| *name);
        let (known, near) = (Vec::from_iter(names()).join(", "), did_you_mean(name, names()));
        return Err(ConfigError::plain(format!("no preset `{name}`; there are {known}{near}")));
    };
    let document = Document::parse(Path::new(name), table[at].1.to_string())?;
    let mut own = document.value.as_object().cloned().unwrap_or_default();
    let Some(base) = own.remove("base") else { return Ok(own) };
    // A base stands before the presets over it, so no preset can be its own base.
    let mut values = values_in(&table[..at], base.as_str().unwrap_or_default())?;
    lay_over(&mut values, &own);
    Ok(values)
}

/// Lays parameters over those of a layer below.
fn lay_over(below: &mut Overrides, above: &Overrides) {
    above.iter().for_each(|(stage, values)| merge_into(below, stage, values, true));
}

/// Lays the presets of the variants over the pipeline's, once all settings have named theirs.
pub(super) fn compose(batch: &mut Batch) {
    for variant in &mut batch.variants {
        let (Some(own), Some(name)) = (&variant.preset, &variant.preset_name) else { continue };
        if batch.preset_name.is_empty() || batch.preset_name == *name {
            continue;
        }
        let mut values = batch.preset.clone();
        lay_over(&mut values, own);
        variant.preset_name = Some([&batch.preset_name, name.as_str()].join(OVER));
        variant.preset = Some(values);
    }
}

/// The schema of a method's name.
pub(super) fn method_schema(_: &mut SchemaGenerator) -> Schema {
    json_schema!({ "type": ["string", "null"], "enum": METHODS.iter().map(Some).chain([None]).collect::<Vec<_>>() })
}

/// The schema of a preset's name.
pub(super) fn name_schema(_: &mut SchemaGenerator) -> Schema {
    json_schema!({ "type": ["string", "null"], "enum": presets().map(Some).chain([None]).collect::<Vec<_>>() })
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn a_preset_lies_over_its_base_and_a_base_stands_before_it() {
        let table = [
            ("long", "[reconstruct]\niterations = 15000\nmedium = \"rbf\""),
            ("plain", "base = \"long\"\n[reconstruct]\nmedium = \"none\""),
            ("round", "base = \"round\""),
        ];
        let values = |name| values_in(&table, name).map(serde_json::Value::Object);
        let plain = json!({ "reconstruct": { "iterations": 15000, "medium": "none" } });
        assert_eq!(values("plain"), Ok(plain));
        assert!(values("round").unwrap_err().to_string().contains("no preset `round`"));
        assert!(values("plan").unwrap_err().to_string().contains("did you mean `plain`?"));
    }

    #[test]
    fn a_method_is_the_base_of_a_preset_and_another_name_is_refused() {
        let with = |preset, method| with_method(preset, method).map_err(|e| e.to_string());
        assert_eq!(with("", "3dgs").as_deref(), Ok("3dgs"));
        assert_eq!(with("paper", "3d-use").as_deref(), Ok("3d-use + paper"));
        assert_eq!(with("plenodium + paper", "3dgs").as_deref(), Ok("3dgs + paper"));
        assert_eq!(with_preset("3dgs", "paper"), "3dgs + paper");
        assert_eq!(
            (with_preset("3dgs", "vanilla"), with_preset("", "paper")),
            ("vanilla".into(), "paper".into())
        );
        assert!(with("", "3dsg").unwrap_err().contains("did you mean `3dgs`?"));
        assert_eq!(preset_values("3d-use + paper"), preset_values("paper"));
        assert_eq!(preset_values("vanilla"), preset_values("3dgs"));
        for method in METHODS {
            assert!(presets().any(|name| name == *method));
        }
    }

    #[test]
    fn joined_names_are_layers() {
        let both = preset_values("paper + 3dgs").unwrap();
        assert_eq!(
            (&both["reconstruct"]["iterations"], &both["reconstruct"]["medium"]),
            (&json!(30000), &json!("none"))
        );
        assert!(preset_values("paper + none").is_err());
    }
}
