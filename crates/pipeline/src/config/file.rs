//! The pipeline file's own tables, as the JSON schema describes them. Stages add
//! theirs, see [`super::schema`].

use schemars::JsonSchema;
use serde::Deserialize;

use super::presets::name_schema as preset_name;

/// The top of a pipeline file.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct PipelineFile {
    /// The pipeline's name: results, logs and records are kept under it.
    pub(crate) name: String,
    /// Everything random follows from it.
    #[serde(default = "default_seed")]
    pub(crate) seed: u64,
    /// Parameters of stages under a name; all that is said elsewhere wins over them.
    #[serde(default)]
    #[schemars(schema_with = "preset_name")]
    pub(crate) preset: Option<String>,
    /// The cache folder. `--cache` and USE3D_CACHE win over it.
    #[serde(default)]
    pub(crate) cache: Option<String>,
    /// Networks trained by others.
    #[serde(default)]
    pub(crate) models: Models,
    /// What "enhanced" is learnt from.
    #[serde(default)]
    pub(crate) calibrator: Calibrator,
}

pub(crate) fn default_seed() -> u64 {
    42
}

/// Networks trained by others.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Models {
    /// Their folder. `--models` and USE3D_MODELS win over it.
    #[serde(default)]
    pub(crate) dir: Option<String>,
}

/// What "enhanced" is learnt from; without any, proposals stay as they are.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Calibrator {
    /// Two folders of images with equal file stems.
    #[serde(default)]
    pub(crate) pairs: Option<Pairs>,
    /// A calibrator that was made before, by `use3d calibrate` or by the paper's authors
    /// (`transition_calibrator.pth`); nothing is learnt then.
    #[serde(default)]
    pub(crate) file: Option<String>,
}

/// A calibrator of a scene or a variant alone.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct OwnCalibrator {
    /// A calibrator that was made before, read here in place of what the others use; a variant's wins over a
    /// scene's. Pairs are for all scenes and variants.
    pub(crate) file: String,
}

/// Two folders of images with equal file stems.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Pairs {
    /// Underwater images.
    pub(crate) input: String,
    /// Their enhanced counterparts.
    pub(crate) target: String,
}

/// A scene.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct SceneEntry {
    /// Its name, unique in the file.
    pub(crate) name: String,
    /// Its capture folder: images and a COLMAP model. `${NAME}` stands for an environment variable.
    pub(crate) capture: String,
    /// The group whose mean it counts in.
    #[serde(default)]
    pub(crate) group: String,
    /// A finished calibrator for this scene only.
    #[serde(default)]
    pub(crate) calibrator: Option<OwnCalibrator>,
}

/// A named set of changes that every scene is computed with; what it does not change is shared.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct VariantEntry {
    /// Its name, unique in the file.
    pub(crate) name: String,
    /// Another seed.
    #[serde(default)]
    pub(crate) seed: Option<u64>,
    /// Another preset, in place of the pipeline's.
    #[serde(default)]
    #[schemars(schema_with = "preset_name")]
    pub(crate) preset: Option<String>,
    /// A finished calibrator for this variant only.
    #[serde(default)]
    pub(crate) calibrator: Option<OwnCalibrator>,
}
