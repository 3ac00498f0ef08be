//! Presets: named sets of stage parameters. Each is a file of this folder and a row of the table.
//!
//! A preset is the weakest layer of parameters, below `[defaults]`. The line `base = "paper"` at the top of
//! its file puts it over another preset. A variant's preset lies over the pipeline's: their names are then
//! joined, as in `paper + vanilla`. Only its values count: no key, artifact or stage contains its name, so a
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
    ("vanilla", include_str!("presets/vanilla.toml")),
    ("watersplatting", include_str!("presets/watersplatting.toml")),
    ("plenodium", include_str!("presets/plenodium.toml")),
];

/// The names of all presets.
pub fn presets() -> impl Iterator<Item = &'static str> + Clone {
    PRESETS.iter().map(|(name, _)| *name)
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
    let Some(at) = table.iter().position(|(known, _)| *known == name) else {
        let names = || table.iter().map(|(name, _)| *name);
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
    fn joined_names_are_layers() {
        let both = preset_values("paper + vanilla").unwrap();
        assert_eq!(
            (&both["reconstruct"]["iterations"], &both["reconstruct"]["medium"]),
            (&json!(15000), &json!("none"))
        );
        assert!(preset_values("paper + none").is_err());
    }
}
