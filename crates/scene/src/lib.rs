//! The scene folder: stage 1 and stage 2 write it, and rendering and export read it.
//!
//! [`Scene`] loads and saves a folder. This crate trains nothing, and it writes no picture files.
//!
//! ```text
//! scene.json            format, version, frame, medium, enhancement (its appearance, the water that it
//!                       keeps), the world in metres where it is known, the views it was made from
//! gaussians.ply         the usual 3D Gaussian splatting layout
//! medium.safetensors    the medium's tensors (absent for `none`)
//! ubaf.safetensors      the enhancement's tensors (stage 2 only)
//! ```
//!
//! Everything is in the scene's normalised frame; `frame` is the similarity from COLMAP's frame:
//! `x_normalised = scale (R x_colmap) + t`, with `R` row by row. A folder without `scene.json` is not a
//! scene. That file is removed first and written last, so a folder that was only partly written is never read
//! as a complete one.
//!
//! [`Compositor`] draws a scene as stage 1 learnt it. [`KnownViews`] computes further quantities of a view
//! that stage 1 knows. Looks, modes and colour maps are in the crate `render`.

mod compositor;
mod description;
mod files;
mod known;
mod origin;
pub mod similarity;
pub mod white;

pub use compositor::Compositor;
pub use known::{KnownView, KnownViews};
pub use origin::Origin;
pub use white::White;

use std::path::{Path, PathBuf};

use use3d_capture::{Frame, World};
use use3d_medium::MediumModel;
use use3d_splat::Gaussians;
use use3d_ubaf::Enhancement;

use description::{Description, EnhancementEntry};

/// A reconstructed, possibly enhanced scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// The Gaussians, in the normalised frame.
    pub gaussians: Gaussians,
    /// The similarity from COLMAP's frame to the normalised one.
    pub frame: Frame,
    /// The water.
    pub medium: MediumModel,
    /// Degree up to which the medium's harmonics are read, 0 to 3.
    pub medium_degree: usize,
    /// The enhancement that stage 2 learnt.
    pub enhancement: Option<Enhancement>,
}

/// A scene folder that cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// The folder has no description.
    #[error("{}", not_a_scene(.0))]
    NotAScene(PathBuf),
    /// A file cannot be read or written, or its content is damaged or has another format.
    #[error("{}: {source}", path.display())]
    File {
        /// The file or folder.
        path: PathBuf,
        /// The system's error, or the wrong field with the value found and the value expected.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// The scene and a capture do not belong together.
    #[error("{} {problem}", scene.display())]
    Capture {
        /// The scene.
        scene: PathBuf,
        /// The problem, and the next step.
        problem: String,
    },
}

/// The reason why a path is no scene, and the next step.
fn not_a_scene(path: &Path) -> String {
    let shown = path.display();
    let expected = "expected a scene folder, or the results folder of a run";
    if path.is_dir() {
        format!("{shown} is not a scene folder: it has no scene.json; `use3d reconstruct` makes one")
    } else if path.exists() {
        format!("{shown}: this is a file; {expected}")
    } else {
        format!("{shown}: there is no such folder; {expected}")
    }
}

impl Scene {
    /// Reads a scene folder; every number is checked.
    pub fn load(dir: &Path) -> Result<Self, SceneError> {
        let description = Description::read(dir)?;
        let ply = dir.join(&description.gaussians);
        let gaussians = files::read_gaussians(&ply)?;
        gaussians.validate().map_err(files::at(&ply))?;
        let (medium, medium_degree) = files::read_medium(dir, &description.medium)?;
        let mut enhancement = None;
        if let Some(EnhancementEntry { file, appearance, kept_water }) = description.enhancement {
            let read = files::read_enhancement(&dir.join(file))?;
            enhancement = Some(Enhancement { appearance, kept_water, ..read });
        }
        Ok(Self { gaussians, frame: description.frame.into(), medium, medium_degree, enhancement })
    }

    /// Writes the scene into `dir`, which is created if needed. Other files in it are not changed.
    pub fn save(&self, dir: &Path) -> Result<(), SceneError> {
        std::fs::create_dir_all(dir).map_err(files::at(dir))?;
        files::remove(&dir.join(description::FILE))?;
        files::write_gaussians(&dir.join(files::GAUSSIANS), &self.gaussians)?;
        files::write_medium(dir, &self.medium)?;
        files::write_enhancement(dir, self.enhancement.as_ref())?;
        Description::of(self).write(dir)
    }

    /// Reads the world of a scene folder, from COLMAP's frame to metres; `None` if it is not known.
    ///
    /// # Errors
    /// Fails if the folder is not a scene.
    pub fn world(dir: &Path) -> Result<Option<World>, SceneError> {
        Ok(Description::read(dir)?.world)
    }

    /// Records the world in a saved scene folder.
    ///
    /// # Errors
    /// Fails if the folder is not a scene, or cannot be written.
    pub fn set_world(dir: &Path, world: &World) -> Result<(), SceneError> {
        let mut description = Description::read(dir)?;
        description.world = Some(world.clone());
        description.write(dir)
    }

    /// True if `dir` looks like a scene folder.
    pub fn is_scene(dir: &Path) -> bool {
        dir.join(description::FILE).is_file()
    }
}
