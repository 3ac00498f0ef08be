//! A capture: posed views, their split into training and test, and the sparse points from which a scene
//! starts.

use std::path::PathBuf;

use glam::DVec3;

use crate::{Camera, FileName, Frame, Raster};

/// One photograph: its path on disk and its camera. Pixels are loaded when needed, never all at once.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// The image's name relative to the capture's image folder.
    pub name: FileName,
    /// COLMAP's image id (0 if there is none).
    pub id: u32,
    /// The file of the pixels.
    pub image: PathBuf,
    /// A mask file: 0 is ignored, the maximum counts fully.
    pub mask: Option<PathBuf>,
    /// A depth-prior file: larger is nearer, 0 is unknown.
    pub depth_prior: Option<PathBuf>,
    /// The pinhole camera, in the capture's normalised frame.
    pub camera: Camera,
}

impl View {
    /// [`FileName::stem`] of the name.
    pub fn stem(&self) -> &str {
        self.name.stem()
    }

    /// [`FileName::flat_stem`] of the name.
    pub fn flat_stem(&self) -> String {
        self.name.flat_stem()
    }
}

/// A triangulated point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SparsePoint {
    /// Position in the capture's normalised frame.
    pub position: DVec3,
    /// Display-referred colour.
    pub color: [u8; 3],
    /// Mean reprojection error, pixels.
    pub error: f64,
    /// Number of views that saw it (0 if the model stores no tracks).
    pub track_length: u32,
}

/// The training views and the held-out views, as indices into [`Capture::views`], ascending.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Split {
    /// Views to train on.
    pub train: Vec<usize>,
    /// Views never seen in training.
    pub test: Vec<usize>,
}

impl Split {
    /// Every `every`-th of `count` views, starting with the first, becomes a test view (R8); `every = 0`
    /// holds out none.
    pub fn every(count: usize, every: usize) -> Self {
        let is_test = |i: &usize| every != 0 && i.is_multiple_of(every);
        Self {
            train: (0..count).filter(|i| !is_test(i)).collect(),
            test: (0..count).filter(is_test).collect(),
        }
    }
}

/// An error of a capture as a whole.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CaptureError {
    /// No view can be used for training.
    #[error(
        "no training views: all {views} views are in the test split; lower the share of test views (`split.every`) or edit test_list.txt"
    )]
    NoTrainingViews {
        /// Number of views.
        views: usize,
    },
    /// No views at all.
    #[error("the capture has no views")]
    NoViews,
}

/// A posed photograph set, in its normalised frame. Views are ordered by file name.
#[derive(Clone, Debug)]
pub struct Capture {
    /// A short name, from its folder.
    pub name: String,
    /// Views in file-name order.
    pub views: Vec<View>,
    /// The split into training and held-out views.
    pub split: Split,
    /// Sparse points.
    pub points: Vec<SparsePoint>,
    /// The similarity from COLMAP's frame to this one.
    pub frame: Frame,
}

impl Capture {
    /// Training views, in order.
    pub fn training_views(&self) -> impl ExactSizeIterator<Item = &View> {
        self.split.train.iter().map(|&i| &self.views[i])
    }

    /// Held-out views, in order.
    pub fn test_views(&self) -> impl ExactSizeIterator<Item = &View> {
        self.split.test.iter().map(|&i| &self.views[i])
    }

    /// Checks that the capture has training views.
    pub fn validate(&self) -> Result<(), CaptureError> {
        if self.views.is_empty() {
            return Err(CaptureError::NoViews);
        }
        if self.split.train.is_empty() {
            return Err(CaptureError::NoTrainingViews { views: self.views.len() });
        }
        Ok(())
    }
}

/// A view's pixels in the form that a training loop keeps: 8-bit if the file is 8-bit, so that hundreds of
/// views fit in memory.
#[derive(Clone, Debug, PartialEq)]
pub enum Pixels {
    /// From an 8-bit file.
    Eight(Raster<u8, 3>),
    /// From a 16-bit or float file, as 16-bit.
    Sixteen(Raster<u16, 3>),
}

impl Pixels {
    /// Width and height, pixels.
    pub fn size(&self) -> (usize, usize) {
        match self {
            Self::Eight(r) => (r.width(), r.height()),
            Self::Sixteen(r) => (r.width(), r.height()),
        }
    }

    /// The display-range image.
    pub fn to_image(&self) -> crate::Image {
        match self {
            Self::Eight(r) => r.to_float(),
            Self::Sixteen(r) => r.map(|v| f32::from(v) / 65535.0),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_eighth_view_is_a_test_view() {
        let split = Split::every(18, 8);
        assert_eq!(split.test, [0, 8, 16]);
        assert_eq!(split.train.len(), 15);
        assert!(Split::every(3, 0).test.is_empty());
    }
}
