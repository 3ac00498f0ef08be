//! A COLMAP model: cameras, posed images with their keypoints, triangulated points with their tracks.
//!
//! Poses are world-to-camera, quaternions `w x y z`; pixel (0, 0) is the image's top-left corner. Records
//! keep the order of the file; ids need not be contiguous or ordered. A model is a folder with `cameras`,
//! `images` and `points3D`, all `.bin` (preferred if both exist) or all `.txt`. The additional files of newer
//! versions (`rigs`, `frames`) are not needed.

use std::collections::BTreeSet;
use std::fmt;
use std::path::{Path, PathBuf};

use use3d_survey::{
    PosedImage as ModelImage, SHORTEST_FOCAL, SINGLE_RANGE, SurveyPoint as ModelPoint, check_records,
    fits_single,
};

use crate::camera::ModelCamera;
use crate::error::ModelError;
use crate::{binary, text};

/// A model.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Model {
    /// Cameras in file order.
    pub cameras: Vec<ModelCamera>,
    /// Images in file order.
    pub images: Vec<ModelImage>,
    /// Points in file order.
    pub points: Vec<ModelPoint>,
}

/// The format in which a model is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ModelForm {
    /// `cameras.bin`, `images.bin`, `points3D.bin`.
    Binary,
    /// `cameras.txt`, `images.txt`, `points3D.txt`.
    Text,
}

impl fmt::Display for ModelForm {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Binary => "binary",
            Self::Text => "text",
        })
    }
}

impl ModelForm {
    /// Paths of the three files in a folder.
    pub(crate) fn files(self, dir: &Path) -> [PathBuf; 3] {
        let extension = match self {
            Self::Binary => "bin",
            Self::Text => "txt",
        };
        ["cameras", "images", "points3D"].map(|stem| dir.join(format!("{stem}.{extension}")))
    }

    /// The missing files of a folder that holds some files of a model, for the format with the fewest
    /// missing.
    pub(crate) fn missing(dir: &Path) -> Option<Vec<String>> {
        let absent = |form: Self| -> Vec<String> {
            let files = form.files(dir).into_iter().filter(|f| !f.is_file());
            files.filter_map(|f| Some(f.file_name()?.to_string_lossy().into_owned())).collect()
        };
        [Self::Binary, Self::Text].map(absent).into_iter().filter(|m| m.len() < 3).min_by_key(Vec::len)
    }

    /// The format of the model in a folder, binary first; `None` if there is none.
    pub fn of(dir: &Path) -> Option<Self> {
        [Self::Binary, Self::Text].into_iter().find(|form| form.files(dir).iter().all(|f| f.is_file()))
    }
}

/// Reads the model in a folder and checks it ([`Model::check`]).
pub fn read_model(dir: &Path) -> Result<Model, ModelError> {
    read_model_as(dir, form_of(dir)?)
}

/// The format of the model in a folder.
///
/// # Errors
/// Reports the reason if there is none: no file of a model, or not all of them.
pub fn form_of(dir: &Path) -> Result<ModelForm, ModelError> {
    ModelForm::of(dir).ok_or_else(|| match ModelForm::missing(dir) {
        Some(missing) => ModelError::Incomplete { path: dir.to_path_buf(), missing: missing.join(" and ") },
        None => ModelError::NotFound { path: dir.to_path_buf() },
    })
}

/// Reads a model in a given format and checks it.
pub fn read_model_as(dir: &Path, form: ModelForm) -> Result<Model, ModelError> {
    let model = read_unchecked(dir, form)?;
    model.check(dir)?;
    Ok(model)
}

/// Reads a model in a given format, whose records may not fit together.
pub(crate) fn read_unchecked(dir: &Path, form: ModelForm) -> Result<Model, ModelError> {
    let files = form.files(dir);
    let read = |path: &Path| {
        std::fs::read(path).map_err(|source| ModelError::Open { path: path.to_path_buf(), source })
    };
    // One file at a time: the bytes of one file are freed before the next is read.
    Ok(match form {
        ModelForm::Binary => Model {
            cameras: binary::cameras(&read(&files[0])?, &files[0])?,
            images: binary::images(&read(&files[1])?, &files[1])?,
            points: binary::points(&read(&files[2])?, &files[2])?,
        },
        ModelForm::Text => Model {
            cameras: text::cameras(&read(&files[0])?, &files[0])?,
            images: text::images(&read(&files[1])?, &files[1])?,
            points: text::points(&read(&files[2])?, &files[2])?,
        },
    })
}

/// Number of images that a model lists, without reading the rest of it.
///
/// # Errors
/// Fails if the list cannot be read.
pub fn count_images(dir: &Path, form: ModelForm) -> Result<u64, ModelError> {
    let path = &form.files(dir)[1];
    let open = |source| ModelError::Open { path: path.clone(), source };
    match form {
        ModelForm::Binary => {
            use std::io::Read;
            let mut count = [0u8; 8];
            let mut file = std::fs::File::open(path).map_err(open)?;
            match file.read_exact(&mut count) {
                Ok(()) => Ok(u64::from_le_bytes(count)),
                Err(e) if e.kind() == std::io::ErrorKind::UnexpectedEof => {
                    let length = file.metadata().map_err(open)?.len();
                    let reason = format!("the file has {length} bytes; a list of images has 8 at least");
                    Err(ModelError::broken(path, "header".into(), reason))
                }
                Err(e) => Err(open(e)),
            }
        }
        ModelForm::Text => Ok(text::images(&std::fs::read(path).map_err(open)?, path)?.len() as u64),
    }
}

/// Writes `cameras.bin`, `images.bin`, `points3D.bin` into a folder; each file is written completely or not
/// at all.
pub fn write_model_binary(dir: &Path, model: &Model) -> Result<(), ModelError> {
    let [cameras, images, points] = ModelForm::Binary.files(dir);
    write(&cameras, |w| binary::write_cameras(w, &model.cameras))?;
    write(&images, |w| binary::write_images(w, &model.images))?;
    write(&points, |w| binary::write_points(w, &model.points))
}

/// Writes `cameras.txt`, `images.txt`, `points3D.txt`. Numbers are written so that reading them restores the
/// same bits.
pub fn write_model_text(dir: &Path, model: &Model) -> Result<(), ModelError> {
    let [cameras, images, points] = ModelForm::Text.files(dir);
    write(&cameras, |w| text::write_cameras(w, &model.cameras))?;
    write(&images, |w| text::write_images(w, &model.images))?;
    write(&points, |w| text::write_points(w, &model.points))
}

fn write(
    path: &Path,
    fill: impl FnOnce(&mut std::io::BufWriter<std::fs::File>) -> std::io::Result<()>,
) -> Result<(), ModelError> {
    use3d_files::write_atomically(path, fill)
        .map_err(|source| ModelError::Write { path: path.to_path_buf(), source })
}

/// The largest image that a camera may announce: the limit of the image readers.
const MAX_PIXELS: u64 = use3d_io_image::MAX_PIXELS;

impl Model {
    /// Checks conditions that involve more than one record or field: ids are unique and known, numbers
    /// finite, sizes sensible.
    pub fn check(&self, path: &Path) -> Result<(), ModelError> {
        let fail = |place: String, reason: String| Err(ModelError::broken(path, place, reason));
        let mut cameras = BTreeSet::new();
        for camera in &self.cameras {
            let place = || format!("camera {}", camera.id);
            if !cameras.insert(camera.id) {
                return fail(place(), "its id occurs twice".into());
            }
            let (w, h) = (camera.width as u64, camera.height as u64);
            if w == 0 || h == 0 || w.saturating_mul(h) > MAX_PIXELS {
                return fail(place(), format!("its size is {w}x{h}; expected 1 to {MAX_PIXELS} pixels"));
            }
            let Some(lens) = camera.lens() else {
                let (found, expected) = (camera.parameters.len(), camera.model.parameter_count());
                return fail(place(), format!("{found} parameters, {} has {expected}", camera.model.name()));
            };
            if let Some(bad) = camera.parameters.iter().position(|p| !p.is_finite()) {
                return fail(place(), format!("parameter {bad} is {}", camera.parameters[bad]));
            }
            if lens.focal.iter().any(|f| *f <= 0.0) {
                return fail(place(), format!("its focal length is {:?}; expected > 0", lens.focal));
            }
        }
        check_records(&self.images, &self.points, |id| cameras.contains(&id), f64::is_finite, "")
            .or_else(|(place, reason)| fail(place, reason))
    }

    /// Checks that every number used in training or rendering is usable in single precision.
    ///
    /// # Errors
    /// Returns the first number that is not, with its record.
    pub fn check_single(&self, path: &Path) -> Result<(), ModelError> {
        let fail = |place: String, reason: String| Err(ModelError::broken(path, place, reason));
        for camera in &self.cameras {
            let place = format!("camera {}", camera.id);
            if let Some(bad) = camera.parameters.iter().position(|p| !fits_single(*p)) {
                return fail(place, format!("parameter {bad} is {:e}{SINGLE_RANGE}", camera.parameters[bad]));
            }
            let focal = camera.lens().map(|lens| lens.focal);
            if let Some(focal) = focal.filter(|f| f.iter().any(|f| *f < SHORTEST_FOCAL)) {
                let reason =
                    format!("its focal length is {focal:?}; expected {SHORTEST_FOCAL} pixels or more");
                return fail(place, reason);
            }
        }
        check_records(&self.images, &self.points, |_| true, fits_single, SINGLE_RANGE)
            .or_else(|(place, reason)| fail(place, reason))
    }
}
