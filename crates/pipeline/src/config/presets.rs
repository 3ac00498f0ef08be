//! Presets: named sets of stage parameters. Each is a file of this folder and a row of the table.
//!
//! A preset is the weakest layer of parameters, below `[defaults]`. Only its values count: no key, artifact
//! or stage contains its name, so a file that writes the values out is the same pipeline. Only the results
//! record the name of the preset and the changes made to it.

use std::path::Path;

use schemars::{Schema, SchemaGenerator, json_schema};
use use3d_workflow::graph::Overrides;

use super::did_you_mean;
use super::document::{ConfigError, Document};

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

/// The parameters of a preset, by stage.
///
/// # Errors
/// There is no such preset.
pub fn preset_values(name: &str) -> Result<Overrides, ConfigError> {
    let Some((_, text)) = PRESETS.iter().find(|(known, _)| *known == name) else {
        let near = did_you_mean(name, presets());
        let known = Vec::from_iter(presets()).join(", ");
        return Err(ConfigError::plain(format!("no preset `{name}`; there are {known}{near}")));
    };
    let document = Document::parse(Path::new(name), (*text).to_string())?;
    Ok(document.value.as_object().cloned().unwrap_or_default())
}

/// The schema of a preset's name.
pub(super) fn name_schema(_: &mut SchemaGenerator) -> Schema {
    json_schema!({ "type": ["string", "null"], "enum": presets().map(Some).chain([None]).collect::<Vec<_>>() })
}
