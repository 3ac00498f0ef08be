//! The folder of a capture that a fault changes, and the steps that several faults share.

use std::fs;
use std::path::{Path, PathBuf};

use glam::DVec3;
use image::{Rgb, RgbImage};
use use3d_capture::FileName;
use use3d_io_colmap::{Model, read_model, write_model_binary};
use use3d_numerics::random::{Purpose, Stream};

use super::tracks;
use crate::error::SynthError;

pub(super) type Done = Result<(), SynthError>;

/// A sound capture folder, and the fault that is put into it.
pub(super) struct Spoiler<'a> {
    pub(super) dir: &'a Path,
    pub(super) seed: u64,
    /// The fault's name: the purpose of its random numbers.
    pub(super) name: &'static str,
    pub(super) strength: f64,
}

/// Random numbers, one after another.
pub(super) struct Chance {
    stream: Stream,
    next: u64,
}

impl Chance {
    /// Uniform in `[0, 1)`.
    pub(super) fn uniform(&mut self) -> f64 {
        self.next += 1;
        self.stream.uniform(self.next)
    }

    /// Standard normal.
    pub(super) fn normal(&mut self) -> f64 {
        // A normal draw uses two numbers of the stream.
        self.next = self.next.div_ceil(2) + 1;
        let value = self.stream.normal(self.next);
        self.next = 2 * self.next + 1;
        value
    }

    /// A direction in space.
    pub(super) fn direction(&mut self) -> DVec3 {
        DVec3::new(self.normal(), self.normal(), self.normal()).normalize_or(DVec3::X)
    }
}

/// An error of the crate `image`.
pub(super) fn pixels_error(path: &Path) -> impl FnOnce(image::ImageError) -> SynthError + '_ {
    move |source| SynthError::io(path)(std::io::Error::other(source))
}

/// A share of `n` things, at least one of them, evenly among them.
pub(super) fn some(share: f64, n: usize) -> Vec<bool> {
    let count = ((share * n as f64).round() as usize).clamp(1.min(n), n);
    (0..n).map(|i| (i + 1) * count / n > i * count / n).collect()
}

impl Spoiler<'_> {
    pub(super) fn path(&self, below: &str) -> PathBuf {
        self.dir.join(below)
    }

    /// The random numbers of one view, or of the whole fault.
    pub(super) fn chance(&self, step: usize) -> Chance {
        Chance { stream: Stream::new(self.seed, Purpose::new(self.name), step as u64), next: 0 }
    }

    pub(super) fn write(&self, below: &str, bytes: impl AsRef<[u8]>) -> Done {
        let path = self.path(below);
        let folder = use3d_files::folder_of(&path);
        fs::create_dir_all(folder).map_err(SynthError::io(folder))?;
        fs::write(&path, bytes).map_err(SynthError::io(&path))
    }

    /// Changes the bytes of a file.
    pub(super) fn edit(&self, path: &Path, change: impl FnOnce(&mut Vec<u8>)) -> Done {
        let mut bytes = fs::read(path).map_err(SynthError::io(path))?;
        change(&mut bytes);
        fs::write(path, bytes).map_err(SynthError::io(path))
    }

    /// Renames a file; folders in the new name are made.
    pub(super) fn rename(&self, from: &Path, to: &Path) -> Done {
        let folder = use3d_files::folder_of(to);
        fs::create_dir_all(folder).map_err(SynthError::io(folder))?;
        fs::rename(from, to).map_err(SynthError::io(from))
    }

    /// Removes a file or a folder, if it is there.
    pub(super) fn remove(&self, below: &str) -> Done {
        let path = self.path(below);
        let removed = if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
        match removed {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(SynthError::io(&path)(e)),
            _ => Ok(()),
        }
    }

    /// The files of a folder in the order of their names; none if it is not there.
    pub(super) fn files(&self, below: &str) -> Result<Vec<PathBuf>, SynthError> {
        let path = self.path(below);
        if !path.is_dir() {
            return Ok(Vec::new());
        }
        let entries = fs::read_dir(&path).map_err(SynthError::io(&path))?;
        let mut files: Vec<PathBuf> = entries.flatten().map(|e| e.path()).filter(|p| p.is_file()).collect();
        files.sort();
        Ok(files)
    }

    pub(super) fn photographs(&self) -> Result<Vec<PathBuf>, SynthError> {
        self.files("images")
    }

    pub(super) fn photograph(&self, path: &Path) -> Result<RgbImage, SynthError> {
        Ok(image::open(path).map_err(pixels_error(path))?.into_rgb8())
    }

    /// The size of the photographs, pixels.
    pub(super) fn size(&self) -> Result<(u32, u32), SynthError> {
        self.photographs()?.first().map_or(Ok((1, 1)), |path| Ok(self.photograph(path)?.dimensions()))
    }

    /// Changes a share of the photographs.
    pub(super) fn repaint(&self, share: f64, change: impl Fn(usize, RgbImage) -> RgbImage) -> Done {
        let files = self.photographs()?;
        for (i, path) in files.iter().enumerate().filter(|(i, _)| some(share, files.len())[*i]) {
            change(i, self.photograph(path)?).save(path).map_err(pixels_error(path))?;
        }
        Ok(())
    }

    /// Covers pixels of every photograph with a colour, by view and pixel; no feature is found there.
    pub(super) fn cover(&self, color: impl Fn(usize, u32, u32) -> Option<[u8; 3]>) -> Done {
        self.repaint(1.0, |i, mut picture| {
            for (x, y, pixel) in picture.enumerate_pixels_mut() {
                if let Some(color) = color(i, x, y) {
                    *pixel = Rgb(color);
                }
            }
            picture
        })?;
        let (w, h) = self.size()?;
        self.edit_model(|model, _| {
            // Noise puts some keypoints beyond an edge.
            let pixel = |v: f64, side: u32| (v.max(0.0) as u32).min(side - 1);
            tracks::forget(model, |i, x, y| color(i, pixel(x, w), pixel(y, h)).is_some());
        })
    }

    pub(super) fn model(&self) -> Result<Model, SynthError> {
        Ok(read_model(&self.path("sparse/0"))?)
    }

    pub(super) fn put_model(&self, model: &Model) -> Done {
        Ok(write_model_binary(&self.path("sparse/0"), model)?)
    }

    pub(super) fn edit_model(&self, change: impl FnOnce(&mut Model, &mut Chance)) -> Done {
        let mut model = self.model()?;
        change(&mut model, &mut self.chance(usize::MAX));
        self.put_model(&model)
    }

    /// Changes the names that the model has, and leaves the files.
    pub(super) fn rename_in_model(&self, name: impl Fn(usize, &str) -> String) -> Done {
        let mut model = self.model()?;
        for (i, image) in model.images.iter_mut().enumerate() {
            image.name = FileName::new(&name(i, &image.name))?;
        }
        self.put_model(&model)
    }

    /// Renames photographs with their depth maps, by number and name. The model has the new names.
    pub(super) fn rename_photographs(&self, name: impl Fn(usize, &str) -> String) -> Done {
        for folder in ["images", "depth", "masks"] {
            for (i, path) in self.files(folder)?.iter().enumerate() {
                let old = path.file_name().unwrap_or_default().to_string_lossy();
                let mut new = PathBuf::from(name(i, &old));
                if folder != "images" {
                    new.set_extension("png");
                }
                self.rename(path, &self.path(folder).join(new))?;
            }
        }
        self.rename_in_model(name)
    }
}
