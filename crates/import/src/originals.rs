//! The photographs of a capture as they came, in `originals.json`.
//!
//! A prepared capture holds undistorted pictures at the size of the training. `originals.json` beside
//! `capture.json` keeps what is lost on the way there: the file of every photograph, its size, its distorted
//! lens, and the gains of a white balance. A scene folder has a copy of it, so that a scene alone knows which
//! photographs it was made from, and with which cameras they were taken.
//!
//! The file holds content only: names inside the capture, no times, and the image folder as it was found or
//! given. Photographs without a camera are not in it, because they are no part of a capture:
//! [`Originals::without_camera`] looks for them. Numbers are read back exactly. Rotations are row-major.
//! Lenses are stored once, and photographs refer to them by index.
//!
//! Limits: EXIF orientations are not applied, neither to sizes nor to lenses.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use glam::DVec3;
use serde::{Deserialize, Serialize};
use use3d_capture::{Camera, FileName, Intrinsics, Pose, View, masked, stem};
use use3d_io_image::whole_photograph_info;
use use3d_numerics::math;
use use3d_survey::Lens;

use crate::error::ImportError;
use crate::folder::{SourceFolder, may_hold_photographs};
use crate::rows::{from_row_major, row_major};

const FORMAT: &str = "3d-use originals";
const VERSION: u32 = 1;

/// One photograph of a capture as it came, before undistortion and scaling.
#[derive(Clone, Debug, PartialEq)]
pub struct Original {
    /// The name of its view in the prepared capture.
    pub name: FileName,
    /// Its file, relative to the capture's folder, with `/` between folders: the image folder and
    /// [`relative`](Self::relative). It begins with `../` or `/` only if the image folder was given so.
    pub file: String,
    /// Its name in the image folder, with its own extension. No two photographs have the same one.
    pub relative: FileName,
    /// Width of the file, pixels as stored.
    pub width: usize,
    /// Height of the file, pixels as stored.
    pub height: usize,
    /// The lens that took it, in pixels of the file: with its distortion.
    pub lens: Lens,
    /// Its pose in the capture's frame, which is that of the scene.
    pub pose: Pose,
    /// The pinhole of its view in the prepared capture.
    pub camera: Intrinsics,
    /// True if its view was learnt from.
    pub train: bool,
    /// True if its view was held out from training.
    pub held_out: bool,
    /// True if it has a mask: a file, or an alpha channel.
    pub mask: bool,
}

/// The photographs of a capture as they came.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Originals {
    /// The image folder, relative to the capture's folder; `.` for that folder itself.
    pub image_folder: String,
    /// Gains for R, G, B that the import multiplied the photographs by; `None` without a white balance.
    pub gains: Option<[f32; 3]>,
    /// The photographs, in the order of their views.
    pub photographs: Vec<Original>,
    /// Names of images of the model that had no file.
    pub missing: Vec<String>,
}

/// `originals.json`.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct OriginalsFile {
    format: String,
    version: u32,
    image_folder: String,
    gains: Option<[f32; 3]>,
    lenses: Vec<LensEntry>,
    photographs: Vec<OriginalEntry>,
    missing: Vec<String>,
}

/// A lens with a size of file, and the pinhole in its place.
#[derive(Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct LensEntry {
    width: usize,
    height: usize,
    lens: Lens,
    pinhole: Intrinsics,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct OriginalEntry {
    name: FileName,
    relative: FileName,
    /// Index of its lens.
    lens: usize,
    rotation: [f64; 9],
    translation: [f64; 3],
    train: bool,
    held_out: bool,
    mask: bool,
}

/// The path of a file of the image folder, relative to the capture.
pub(crate) fn in_capture(image_folder: &str, relative: &FileName) -> String {
    match image_folder.trim_end_matches('/') {
        "." => relative.to_string(),
        folder => format!("{folder}/{relative}"),
    }
}

impl Originals {
    /// The name of the file in a prepared capture and in a scene folder.
    pub const FILE: &str = "originals.json";

    /// Writes `originals.json` into a folder.
    ///
    /// # Errors
    /// Fails if the file cannot be written.
    pub fn write(&self, dir: &Path) -> Result<(), ImportError> {
        let mut lenses: Vec<LensEntry> = Vec::new();
        let mut entry = |original: &Original| {
            let Original { width, height, lens, camera: pinhole, .. } = *original;
            let wanted = LensEntry { width, height, lens, pinhole };
            // Neighbours mostly share their lens, so the search begins with the newest one.
            let known = lenses.iter().rposition(|known| *known == wanted);
            OriginalEntry {
                name: original.name.clone(),
                relative: original.relative.clone(),
                lens: known.unwrap_or_else(|| {
                    lenses.push(wanted);
                    lenses.len() - 1
                }),
                rotation: row_major(&original.pose.rotation),
                translation: original.pose.translation.to_array(),
                train: original.train,
                held_out: original.held_out,
                mask: original.mask,
            }
        };
        let photographs = self.photographs.iter().map(&mut entry).collect();
        let file = OriginalsFile {
            format: FORMAT.into(),
            version: VERSION,
            image_folder: self.image_folder.clone(),
            gains: self.gains,
            lenses,
            photographs,
            missing: self.missing.clone(),
        };
        let path = dir.join(Self::FILE);
        use3d_files::write_atomically(&path, |w| {
            serde_json::to_writer_pretty(&mut *w, &file)?;
            std::io::Write::write_all(w, b"\n")
        })
        .map_err(ImportError::file(&path))
    }

    /// Reads `originals.json` of a folder, exactly as it was written; `None` if the folder has none, because
    /// it was made by an older version.
    ///
    /// # Errors
    /// Names the file and the field that cannot be used.
    pub fn read(dir: &Path) -> Result<Option<Self>, ImportError> {
        let path = dir.join(Self::FILE);
        let bytes = match std::fs::read(&path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(ImportError::file(&path)(error)),
        };
        let parsed: Result<OriginalsFile, _> =
            serde_path_to_error::deserialize(&mut serde_json::Deserializer::from_slice(&bytes));
        let wrong = |reason: String| ImportError::Prepared { path: path.clone(), reason };
        let read = parsed.map_err(|error| match error.path().to_string().as_str() {
            "." => wrong(error.inner().to_string()),
            field => wrong(format!("`{field}`: {}", error.inner())),
        });
        Ok(Some(read?.checked(&wrong)?))
    }

    /// Copies `originals.json` from one folder to another, byte for byte; does nothing if the first has none.
    ///
    /// # Errors
    /// Fails if the file cannot be read, is damaged, or cannot be written.
    pub fn hand_on(from: &Path, to: &Path) -> Result<(), ImportError> {
        let (source, target) = (from.join(Self::FILE), to.join(Self::FILE));
        if Self::read(from)?.is_some() {
            let bytes = std::fs::read(&source).map_err(ImportError::file(&source))?;
            std::fs::write(&target, bytes).map_err(ImportError::file(&target))?;
        }
        Ok(())
    }

    /// Names, in the image folder, of the images that have no camera: those there now that are none of the
    /// photographs, their masks or damaged. Hidden files are left out, and so are names that no result can
    /// have (control characters). `capture` is the folder that was imported.
    ///
    /// # Errors
    /// Fails if the image folder is not there.
    pub fn without_camera(&self, capture: &Path) -> Result<Vec<FileName>, ImportError> {
        let folder = SourceFolder::open_own(capture, &self.image_folder).ok_or_else(|| {
            let missing = std::io::Error::new(
                std::io::ErrorKind::NotFound,
                "the folder of the photographs is not there; give the capture that the scene was made from",
            );
            ImportError::file(&capture.join(&self.image_folder))(missing)
        })?;
        let mut known: BTreeSet<PathBuf> = BTreeSet::new();
        for original in &self.photographs {
            known.extend(folder.file(&original.relative)?);
        }
        let mut allowed: BTreeMap<String, bool> = BTreeMap::new();
        let mut found = Vec::new();
        let listed = folder.images();
        let photographs: BTreeSet<&str> =
            listed.iter().flat_map(|name| [name.as_str(), stem(name)]).collect();
        for name in &listed {
            if masked(name).is_some_and(|of| photographs.contains(of)) {
                continue;
            }
            // If photographs lie in the capture's own folder, its masks and depths are below it.
            let usable = name.split_once('/').is_none_or(|(first, _)| {
                let first = allowed.entry(first.to_string());
                *first.or_insert_with_key(|first| may_hold_photographs(&folder.path, first))
            });
            let Some(name) = usable.then(|| FileName::new(name).ok()).flatten() else { continue };
            let usable = |file: &PathBuf| !known.contains(file) && whole_photograph_info(file).is_ok();
            found.extend(folder.file(&name)?.filter(usable).map(|_| name));
        }
        Ok(found)
    }

    /// Refuses photographs that are not those of the capture's views.
    pub(crate) fn check_views(&self, views: &[View], dir: &Path) -> Result<(), ImportError> {
        let by_name: BTreeMap<&FileName, &Camera> = views.iter().map(|v| (&v.name, &v.camera)).collect();
        for original in &self.photographs {
            let camera = Camera { intrinsics: original.camera, pose: original.pose };
            let reason = match by_name.get(&original.name) {
                None => format!("the photograph {} is no view of capture.json", original.name),
                Some(found) if **found != camera => {
                    format!("the camera of {} is not that of capture.json", original.name)
                }
                Some(_) => continue,
            };
            return Err(ImportError::Prepared { path: dir.join(Self::FILE), reason });
        }
        Ok(())
    }
}

impl OriginalsFile {
    /// The photographs, if every value can be used; `wrong` makes an error from the field and the problem.
    fn checked(self, wrong: &dyn Fn(String) -> ImportError) -> Result<Originals, ImportError> {
        if self.format != FORMAT || self.version != VERSION {
            let (format, version) = (&self.format, self.version);
            let expected = format!("{FORMAT:?} version {VERSION}");
            return Err(wrong(format!("it is {format:?} version {version}; expected {expected}")));
        }
        if self.image_folder.is_empty() || self.image_folder.chars().any(char::is_control) {
            return Err(wrong(format!("`image_folder` is {:?}; expected a folder", self.image_folder)));
        }
        if let Some(gains) = self.gains.filter(|gains| !gains.iter().all(|g| g.is_finite() && *g > 0.0)) {
            return Err(wrong(format!("`gains` is {gains:?}; expected positive numbers")));
        }
        for (index, entry) in self.lenses.iter().enumerate() {
            entry.check(&|reason| wrong(format!("`lenses[{index}]`: {reason}")))?;
        }
        let (mut names, mut files) = (BTreeSet::new(), BTreeSet::new());
        let mut photographs = Vec::with_capacity(self.photographs.len());
        for (index, entry) in self.photographs.into_iter().enumerate() {
            let at = |field: &str, reason: String| wrong(format!("`photographs[{index}].{field}`: {reason}"));
            let LensEntry { width, height, lens, pinhole } = *self
                .lenses
                .get(entry.lens)
                .ok_or_else(|| at("lens", format!("there is no lens {}", entry.lens)))?;
            let pose = Pose {
                rotation: from_row_major(&entry.rotation),
                translation: DVec3::from_array(entry.translation),
            };
            pose.validate().map_err(|error| at("rotation", error.to_string()))?;
            if !names.insert(entry.name.clone()) {
                return Err(at("name", format!("{} stands there twice", entry.name)));
            }
            if !files.insert(entry.relative.clone()) {
                return Err(at("relative", format!("{} stands there twice", entry.relative)));
            }
            photographs.push(Original {
                name: entry.name,
                file: in_capture(&self.image_folder, &entry.relative),
                relative: entry.relative,
                width,
                height,
                lens,
                pose,
                camera: pinhole,
                train: entry.train,
                held_out: entry.held_out,
                mask: entry.mask,
            });
        }
        let Self { image_folder, gains, missing, .. } = self;
        Ok(Originals { image_folder, gains, photographs, missing })
    }
}

impl LensEntry {
    /// Refuses sizes of zero or beyond every image, and lenses that do not show the middle of their image.
    fn check(&self, wrong: &dyn Fn(String) -> ImportError) -> Result<(), ImportError> {
        let Self { width, height, lens, pinhole } = self;
        let size = |field: &str, width: usize, height: usize| {
            let most = use3d_io_image::MAX_PIXELS;
            let pixels = (width as u64).saturating_mul(height as u64);
            if (1..=most).contains(&pixels) {
                return Ok(());
            }
            Err(wrong(format!("{field} is {width} x {height}; expected 1 to {most} pixels")))
        };
        size("the size", *width, *height)?;
        size("the size of `pinhole`", pinhole.width, pinhole.height)?;
        pinhole.validate().map_err(|error| wrong(format!("`pinhole`: {error}")))?;
        let plain = lens.intrinsics(*width, *height);
        plain.validate().map_err(|error| wrong(format!("`lens`: {error}")))?;
        let (x, y) = (0.5 * *width as f64, 0.5 * *height as f64);
        let back = lens.unproject(x, y).map(|(u, v)| lens.project(u, v));
        match back.filter(|back| math::hypot(back.0 - x, back.1 - y) < 1e-3) {
            Some(_) => Ok(()),
            None => Err(wrong("`lens`: no ray reaches the middle of the image".into())),
        }
    }
}
