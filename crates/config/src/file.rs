//! The pipeline file's own tables, as the JSON schema describes them. The tables of the stages are added in
//! [`super::schema`].

use schemars::JsonSchema;
use serde::Deserialize;

use use3d_prepare::Recipe;

use super::presets::{method_schema as method_name, name_schema as preset_name};

/// The top level of a pipeline file.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct PipelineFile {
    /// The pipeline's name. Results, logs and records are stored under it.
    pub(crate) name: String,
    /// The seed of all random numbers.
    #[serde(default = "default_seed")]
    pub(crate) seed: u64,
    /// The method that is trained, with its authors' schedule; `3d-use`, if not set.
    #[serde(default)]
    #[schemars(schema_with = "method_name")]
    pub(crate) method: Option<String>,
    /// A named set of stage parameters, over those of the method. Every other setting overrides them.
    #[serde(default)]
    #[schemars(schema_with = "preset_name")]
    pub(crate) preset: Option<String>,
    /// True if a scene that fails ends no other one, as with `--keep-going`.
    #[serde(default)]
    pub(crate) keep_going: bool,
    /// The cache folder. `--cache` and USE3D_CACHE override it.
    #[serde(default)]
    pub(crate) cache: Option<String>,
    /// Networks trained by others.
    #[serde(default)]
    pub(crate) models: Models,
    /// The source of the meaning of "enhanced".
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
    /// The folder of their weights. `--models` and USE3D_MODELS override it.
    #[serde(default)]
    pub(crate) dir: Option<String>,
}

/// The source of the meaning of "enhanced"; without any, proposals stay as they are.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Calibrator {
    /// Two folders of images with equal file stems.
    #[serde(default)]
    pub(crate) pairs: Option<Pairs>,
    /// A finished calibrator, made by `use3d calibrate` or by the paper's authors
    /// (`transition_calibrator.pth`); then nothing is learnt.
    #[serde(default)]
    pub(crate) file: Option<String>,
}

/// A calibrator for a single scene or variant.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct OwnCalibrator {
    /// A finished calibrator that replaces the common one here; a variant's overrides a scene's. Pairs apply
    /// to all scenes and variants.
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

/// A scene, or with `from` many scenes.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(extend("oneOf" = [
    { "required": ["name", "capture"] }, { "required": ["name", "footage"] }, { "required": ["from"] },
    { "required": ["name", "download"] }
]))]
pub(crate) struct SceneEntry {
    /// Its name, unique in the file.
    #[serde(default)]
    pub(crate) name: Option<String>,
    /// Its capture folder: images, and a model of COLMAP or another program. `${NAME}` stands for an
    /// environment variable.
    #[serde(default)]
    pub(crate) capture: Option<String>,
    /// A film, or a folder with films or photographs, in place of a capture: the stage `prepare` finds their
    /// cameras.
    #[serde(default)]
    pub(crate) footage: Option<String>,
    /// A pattern of folders and films, such as `dives/*`, in place of name and capture. Every match is a
    /// scene of its name. The stage `prepare` finds the cameras of films and of folders that have none.
    #[serde(default)]
    pub(crate) from: Option<String>,
    /// The data set that has the scene of this name, in place of a capture: `seathru`, `d3d5` or `druva`. It
    /// is found where its owners' files lie, below the folder that DATA names or that its own variable names.
    #[serde(default)]
    #[schemars(with = "Option<String>")]
    pub(crate) download: Option<Recipe>,
    /// The group whose mean includes this scene.
    #[serde(default)]
    pub(crate) group: String,
    /// A finished calibrator for this scene only.
    #[serde(default)]
    pub(crate) calibrator: Option<OwnCalibrator>,
}

/// A named set of changes. Every scene is also computed with them; stages that do not change are shared.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct VariantEntry {
    /// Its name, unique in the file.
    pub(crate) name: String,
    /// The groups of the scenes that are computed with it; every scene if not set.
    #[serde(default)]
    pub(crate) groups: Vec<String>,
    /// Another seed.
    #[serde(default)]
    pub(crate) seed: Option<u64>,
    /// Another method, over the pipeline's preset.
    #[serde(default)]
    #[schemars(schema_with = "method_name")]
    pub(crate) method: Option<String>,
    /// Another preset, over the pipeline's.
    #[serde(default)]
    #[schemars(schema_with = "preset_name")]
    pub(crate) preset: Option<String>,
    /// A finished calibrator for this variant only.
    #[serde(default)]
    pub(crate) calibrator: Option<OwnCalibrator>,
}
