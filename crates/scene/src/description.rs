//! `scene.json`, the file that marks a folder as a scene.

use std::path::{Component, Path};

use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};
use use3d_capture::{Appearance, Frame, KeptWater, World, shown};
use use3d_medium::MediumKind;

use crate::files::MediumEntry;
use crate::{Origin, Scene, SceneError, files};

/// The file's name.
pub(crate) const FILE: &str = "scene.json";
const FORMAT: &str = "3d-use scene";
const VERSION: u32 = 1;
/// Largest size of a description, bytes; a larger file must be something else.
const MOST_BYTES: u64 = 1 << 24;

#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct Description {
    format: String,
    version: u32,
    sh_degree: usize,
    pub(crate) frame: FrameRows,
    #[serde(default = "default_gaussians")]
    pub(crate) gaussians: String,
    pub(crate) medium: MediumEntry,
    #[serde(default)]
    pub(crate) enhancement: Option<EnhancementEntry>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) world: Option<World>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) origin: Option<Origin>,
}

fn default_gaussians() -> String {
    files::GAUSSIANS.into()
}

/// The similarity, with its rotation row by row.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(crate) struct FrameRows {
    scale: f64,
    rotation: [f64; 9],
    translation: [f64; 3],
}

#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct EnhancementEntry {
    pub(crate) file: String,
    /// Scenes from before this field existed were enhanced with their water.
    #[serde(default)]
    pub(crate) appearance: Appearance,
    /// Absent if the enhanced scene keeps all of its water.
    #[serde(default, skip_serializing_if = "KeptWater::is_all")]
    pub(crate) kept_water: KeptWater,
}

impl From<FrameRows> for Frame {
    fn from(rows: FrameRows) -> Self {
        Self {
            scale: rows.scale,
            rotation: DMat3::from_cols_array(&rows.rotation).transpose(),
            translation: DVec3::from_array(rows.translation),
        }
    }
}

impl From<Frame> for FrameRows {
    fn from(frame: Frame) -> Self {
        Self {
            scale: frame.scale,
            rotation: frame.rotation.transpose().to_cols_array(),
            translation: frame.translation.to_array(),
        }
    }
}

/// The words for a file that is no description.
fn damaged(error: &serde_json::Error) -> String {
    let (line, text) = (error.line(), error.to_string());
    let place = format!(" at line {line} column {}", error.column());
    let reason =
        if error.is_eof() { "the file ends here" } else { text.strip_suffix(&place).unwrap_or(&text) };
    format!("it is damaged or cut off (line {line}: {}); {}", shown(reason), files::AGAIN)
}

impl Description {
    /// The description that `save` writes for a scene.
    pub(crate) fn of(scene: &Scene) -> Self {
        let kind = scene.medium.kind();
        let top_k = scene.medium.anchors().map(|anchors| anchors.top_k);
        Self {
            format: FORMAT.into(),
            version: VERSION,
            sh_degree: scene.gaussians.sh_degree,
            frame: scene.frame.into(),
            gaussians: default_gaussians(),
            medium: MediumEntry {
                kind: kind.name().into(),
                file: (kind != MediumKind::None).then(|| files::MEDIUM.into()),
                top_k,
                sh_degree: (kind != MediumKind::None).then_some(scene.medium_degree),
            },
            enhancement: scene.enhancement.as_ref().map(|e| EnhancementEntry {
                file: files::ENHANCEMENT.into(),
                appearance: e.appearance,
                kept_water: e.kept_water,
            }),
            world: None,
            origin: None,
        }
    }

    pub(crate) fn read(dir: &Path) -> Result<Self, SceneError> {
        let path = dir.join(FILE);
        if !path.is_file() {
            return Err(SceneError::NotAScene(dir.into()));
        }
        let bytes = files::read_bounded(&path, MOST_BYTES)?;
        let wrong = files::at::<String>(&path);
        let description: Self = serde_json::from_slice(&bytes).map_err(|e| wrong(damaged(&e)))?;
        if description.format != FORMAT {
            return Err(wrong(format!("format is `{}`; expected `{FORMAT}`", shown(&description.format))));
        }
        if description.version != VERSION {
            return Err(wrong(format!(
                "version is {}; this program reads version {VERSION}{}",
                description.version,
                if description.version > VERSION {
                    ": a newer program wrote the scene; use that one, or train it again with this one"
                } else {
                    ", the first there was: the file is damaged; train the scene again"
                }
            )));
        }
        if description.sh_degree > 3 {
            return Err(wrong(format!("sh_degree is {}; expected 0 to 3", description.sh_degree)));
        }
        let frame = &description.frame;
        if !(frame.scale.is_finite() && frame.scale > 0.0) {
            return Err(wrong(format!("frame.scale is {}; expected a positive number", frame.scale)));
        }
        if frame.rotation.iter().chain(&frame.translation).any(|v| !v.is_finite()) {
            return Err(wrong("frame has an entry that is not finite".into()));
        }
        if let Some(kept) = description.enhancement.as_ref().map(|e| e.kept_water)
            && !kept.is_valid()
        {
            return Err(wrong(format!(
                "enhancement.kept_water is {:?}; expected three numbers from 0 to 1",
                kept.0
            )));
        }
        if let Some(world) = description.world.as_ref().filter(|world| !world.is_valid()) {
            return Err(wrong(format!(
                "world.metres_per_unit is {} and world.transform {:?}; expected finite numbers and a scale above 0",
                world.metres_per_unit, world.transform
            )));
        }
        let enhancement = description.enhancement.as_ref().map(|e| &e.file);
        let names = [Some(&description.gaussians), description.medium.file.as_ref(), enhancement];
        for name in names.into_iter().flatten() {
            // A file name in a description never leads out of the folder.
            let mut parts = Path::new(name).components();
            if !matches!((parts.next(), parts.next()), (Some(Component::Normal(_)), None)) {
                return Err(wrong(format!(
                    "file name {name:?}; expected a plain name inside the scene folder"
                )));
            }
        }
        Ok(description)
    }

    pub(crate) fn write(&self, dir: &Path) -> Result<(), SceneError> {
        files::write_json(&dir.join(FILE), self)
    }
}
