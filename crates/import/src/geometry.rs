//! The changes to the pixels of one camera's files: undistortion, then scale and crop; and the intrinsics of
//! the result.

use std::sync::Arc;

use use3d_capture::{Image, Intrinsics, Map, Pixels, Raster};
use use3d_survey::{Lens, SurveyCamera};

use crate::error::ImportError;
use crate::params::{ImportParams, LEAST_SIDE};
use crate::resample::Resize;
use crate::undistort::{Undistortion, is_pinhole};

/// The sizes of image files and of the model may differ by a factor of at most this, in either direction.
const MAX_FACTOR: usize = 32;

/// The chain of changes from a file's pixels to a view's.
#[derive(Debug)]
pub(crate) struct Geometry {
    /// The file's size over the model's.
    pub(crate) scale: (f64, f64),
    pub(crate) file: (usize, usize),
    /// The lens that took the file, at the file's size.
    pub(crate) lens: Lens,
    pub(crate) undistortion: Option<Arc<Undistortion>>,
    pub(crate) resize: Option<Resize>,
    /// The intrinsics of the pixels before they are scaled and cropped.
    pinhole: Intrinsics,
    pub(crate) intrinsics: Intrinsics,
}

/// True if one size is a whole multiple of the other (within rounding to whole pixels).
pub(crate) fn is_whole_multiple(model: (usize, usize), file: (usize, usize)) -> bool {
    let close = |a: usize, factor: usize, b: usize| (a as f64 / factor as f64 - b as f64).abs() < 1.0;
    model == file
        || (2..=MAX_FACTOR).any(|k| {
            (close(model.0, k, file.0) && close(model.1, k, file.1))
                || (model.0 * k == file.0 && model.1 * k == file.1)
        })
}

/// File size over model size, if both have one shape (within rounding to whole pixels).
pub(crate) fn size_ratio(model: (usize, usize), file: (usize, usize)) -> Option<(f64, f64)> {
    let scale = (file.0 + file.1) as f64 / (model.0 + model.1) as f64;
    let most = MAX_FACTOR as f64;
    let close = |a: usize, b: usize| (a as f64 * scale - b as f64).abs() < 1.0;
    let fits = (1.0 / most..=most).contains(&scale) && close(model.0, file.0) && close(model.1, file.1);
    (fits || is_whole_multiple(model, file))
        .then(|| (file.0 as f64 / model.0 as f64, file.1 as f64 / model.1 as f64))
}

impl Geometry {
    /// The geometry for files of one size taken by a camera; `path` is one of them, for messages.
    pub(crate) fn new(
        camera: &SurveyCamera,
        file: (usize, usize),
        path: &std::path::Path,
        params: &ImportParams,
    ) -> Result<Self, ImportError> {
        let model = (camera.width, camera.height);
        let scale = size_ratio(model, file).ok_or_else(|| ImportError::Size {
            path: path.to_path_buf(),
            found: file,
            expected: format!(
                "but camera {} of the model is {} x {}, so it has another shape; \
                 give the folder with the images that the cameras were found from as `image_dir`",
                camera.id, model.0, model.1
            ),
        })?;
        let bad = |reason| ImportError::Lens { camera: camera.id, reason };
        let lens = camera.lens.scaled(scale.0, scale.1);
        let bent = !is_pinhole(&lens, file.0, file.1);
        let undistortion = bent.then(|| Undistortion::new(lens, file.0, file.1)).transpose().map_err(bad)?;
        let pinhole = undistortion.as_ref().map_or_else(|| lens.intrinsics(file.0, file.1), |u| u.pinhole);
        let from = (pinhole.width, pinhole.height);
        let resize = if let Some(size) = params.size {
            Some(Resize::cover(from, size.width, size.height))
        } else if params.downscale > 1 {
            let longer = from.0.max(from.1) / params.downscale;
            if longer < LEAST_SIDE {
                let reason = format!(
                    "divided by {}, the longer side of {} has {longer} pixels left; expected at least \
                     {LEAST_SIDE}: take a smaller number",
                    params.downscale,
                    path.display()
                );
                return Err(ImportError::Parameter { field: "downscale", reason });
            }
            Some(Resize::fraction(from, params.downscale))
        } else if params.max_side > 0 && from.0.max(from.1) > params.max_side {
            let s = params.max_side as f64 / from.0.max(from.1) as f64;
            let side = |n: usize| ((n as f64 * s).round() as usize).max(1);
            Some(Resize::whole(from, side(from.0), side(from.1)))
        } else {
            None
        };
        let resize = resize.filter(|r| !r.is_identity(from));
        let intrinsics = resize.map_or(pinhole, |r| r.intrinsics(&pinhole));
        let undistortion = undistortion.map(Arc::new);
        Ok(Self { scale, file, lens, undistortion, resize, pinhole, intrinsics })
    }

    /// The geometry for files that are used unchanged.
    pub(crate) fn identity(intrinsics: Intrinsics) -> Self {
        let file = (intrinsics.width, intrinsics.height);
        let Intrinsics { fx, fy, cx, cy, .. } = intrinsics;
        let (lens, pinhole) = (Lens::pinhole([fx, fy], [cx, cy]), intrinsics);
        Self { scale: (1.0, 1.0), file, lens, undistortion: None, resize: None, pinhole, intrinsics }
    }

    /// The same geometry without scale and crop.
    pub(crate) fn full_size(&self) -> Self {
        Self { undistortion: self.undistortion.clone(), resize: None, intrinsics: self.pinhole, ..*self }
    }

    /// True if pixels change.
    pub(crate) fn resamples(&self) -> bool {
        self.undistortion.is_some() || self.resize.is_some()
    }

    /// The view's pixels from the file's, multiplied by `gains`, in the file's precision.
    pub(crate) fn pixels(&self, pixels: &Pixels, gains: [f32; 3]) -> Pixels {
        // The casts saturate.
        match pixels {
            Pixels::Eight(p) => Pixels::Eight(self.colors(p, gains).map(|v| (v + 0.5).floor() as u8)),
            Pixels::Sixteen(p) => Pixels::Sixteen(self.colors(p, gains).map(|v| (v + 0.5).floor() as u16)),
        }
    }

    fn colors<T: Copy + Default + Into<f32>>(&self, from: &Raster<T, 3>, gains: [f32; 3]) -> Image {
        let mut out = match (&self.undistortion, &self.resize) {
            (Some(u), Some(r)) => r.apply(&u.apply(from)),
            (Some(u), None) => u.apply(from),
            (None, Some(r)) => r.apply(from),
            (None, None) => from.map(T::into),
        };
        for (c, gain) in gains.into_iter().enumerate() {
            out.plane_mut(c).iter_mut().for_each(|v| *v *= gain);
        }
        out
    }

    /// The view's mask from one of the file's size.
    pub(crate) fn mask(&self, mask: &Map) -> Map {
        let flat = self.undistortion.as_ref().map(|u| u.apply(mask));
        let mask = flat.as_ref().unwrap_or(mask);
        self.resize.map_or_else(|| mask.clone(), |r| r.apply(mask))
    }

    /// The view's depth prior from one of the file's size.
    pub(crate) fn depth(&self, depth: &Map) -> Map {
        let flat = self.undistortion.as_ref().map(|u| u.apply_nearest(depth));
        let depth = flat.as_ref().unwrap_or(depth);
        self.resize.map_or_else(|| depth.clone(), |r| r.apply_to_depth(depth))
    }

    /// The position in the view of a keypoint of the model's image; `None` if the lens has no ray for it.
    pub(crate) fn point(&self, x: f64, y: f64) -> Option<(f64, f64)> {
        let (mut x, mut y) = (x * self.scale.0, y * self.scale.1);
        if let Some(u) = &self.undistortion {
            (x, y) = u.undistort_point(x, y)?;
        }
        if let Some(r) = &self.resize {
            (x, y) = (x * r.sx - r.left, y * r.sy - r.top);
        }
        Some((x, y))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whole_fractions_are_recognised() {
        assert_eq!(size_ratio((1280, 720), (1280, 720)), Some((1.0, 1.0)));
        assert_eq!(size_ratio((1280, 720), (640, 360)), Some((0.5, 0.5)));
        assert!(size_ratio((995, 746), (497, 373)).is_some(), "rounded down");
        assert!(size_ratio((995, 746), (249, 187)).is_some(), "rounded up");
        assert_eq!(size_ratio((500, 300), (1000, 600)), Some((2.0, 2.0)));
        assert!(size_ratio((1280, 720), (1000, 563)).is_some(), "the same shape");
        assert!(!is_whole_multiple((1280, 720), (1000, 563)));
        assert_eq!(size_ratio((1280, 720), (640, 480)), None);
    }
}
