//! The part of an evaluation that is the same in all variants of a scene: the 2D enhancer's pictures of the
//! photographs, the scores of both, and the flow between neighbouring views. The stage `baseline` stores it,
//! and `evaluate` computes what it does not find.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use use3d_capture::{Camera, Capture, Image, Pixels, Raster, View, path};
use use3d_import::load_mask;
use use3d_io_image::{read_image, read_pixels, write_png16};
use use3d_judge::flow::{Correspondence, decode, encode};
use use3d_judge::scores::{Method, Scores};
use use3d_metrics::{Mask, mask_of};
use use3d_workflow::StageError;

use super::files::{folder, proposal_of, read_json, write_json};
use super::visits::evenly;

/// The file of the scores.
pub(crate) const BASELINE: &str = "baseline.json";
/// The folder of the 2D enhancer's pictures, and that of the flow.
const ENHANCED: &str = "proposal";
const FLOW: &str = "flow";

/// The usual number of pairs that are compared, of captured views and of frames.
pub(crate) const PAIRS: usize = 8;
/// The usual number of frames of a path from one training view to the next.
pub(crate) const STEPS: usize = 4;

/// The pairs of captured views that are compared, by the first of them: at most `most`.
pub(crate) fn neighbours(capture: &Capture, most: usize) -> BTreeSet<usize> {
    evenly(capture.views.len().saturating_sub(1), most).into_iter().collect()
}

/// The frames of the path through the training cameras, and the pairs of them that are compared.
pub(crate) fn frames(capture: &Capture, most: usize, steps: usize) -> (Vec<Camera>, BTreeSet<usize>) {
    let keys: Vec<Camera> = capture.training_views().map(|v| v.camera).collect();
    let frames = path::interpolate(&keys, keys.len().saturating_sub(1) * steps + 1);
    let most = if keys.len() < 2 { 0 } else { most };
    let pairs = evenly(frames.len().saturating_sub(1), most).into_iter().collect();
    (frames, pairs)
}

/// The mask of the valid pixels of a view; `None` if all are valid.
pub(crate) fn mask(view: &View) -> Result<Option<Mask>, StageError> {
    Ok(load_mask(view)?.map(|weights| mask_of(&weights)).filter(|m| m.data().contains(&0)))
}

/// The views of the consistency strip: the middle one of the held-out views with its neighbours.
pub(crate) fn strip_views(capture: &Capture) -> Range<usize> {
    let (held_out, views) = (&capture.split.test, capture.views.len());
    let middle = held_out.get(held_out.len() / 2).copied().unwrap_or(views / 2);
    let first = middle.saturating_sub(1).min(views.saturating_sub(3));
    first..(first + 3).min(views)
}

/// Samples of 16 bits.
fn sixteen(image: &Image) -> Raster<u16, 3> {
    image.map(|v| (v.clamp(0.0, 1.0) * 65535.0 + 0.5).floor() as u16)
}

/// A picture as its file will give it back.
pub(crate) fn stored(image: &Image) -> Image {
    Pixels::Sixteen(sixteen(image)).to_image()
}

/// The first of two neighbours: captured views, or frames of a path.
#[derive(Clone, Copy)]
pub(crate) enum First<'a> {
    View(&'a View),
    Frame(usize),
}

impl First<'_> {
    fn file(self, inside: &Path) -> PathBuf {
        match self {
            Self::View(view) => proposal_of(&inside.join(FLOW), view),
            Self::Frame(frame) => inside.join(FLOW).join(format!("path/{frame:06}.png")),
        }
    }
}

/// Scores by method.
pub(crate) type ByMethod = BTreeMap<Method, Scores>;

/// The scores of the photographs and of the 2D enhancer's pictures of them, and where the rest is.
#[derive(Default, Serialize, Deserialize)]
pub(crate) struct Baseline {
    /// The folder that it is in; `None` if nothing is known.
    #[serde(skip)]
    folder: Option<PathBuf>,
    /// By held-out view.
    pub(crate) views: BTreeMap<String, ByMethod>,
    /// By the first of two neighbouring views: the scores along their flow.
    pub(crate) neighbours: BTreeMap<String, ByMethod>,
}

impl Baseline {
    /// The one in a folder; an empty one without a folder.
    pub(crate) fn read(folder: Option<&Path>) -> Result<Self, StageError> {
        let Some(folder) = folder else { return Ok(Self::default()) };
        Ok(Self { folder: Some(folder.to_path_buf()), ..read_json(&folder.join(BASELINE))? })
    }

    /// Writes the scores.
    pub(crate) fn write(&self, into: &Path) -> Result<(), StageError> {
        write_json(&into.join(BASELINE), self)
    }

    /// The 2D enhancer's picture of a photograph, if it is known.
    pub(crate) fn proposal(&self, view: &View) -> Result<Option<Image>, StageError> {
        let file = self.folder.as_ref().map(|folder| proposal_of(&folder.join(ENHANCED), view));
        Ok(file.filter(|file| file.is_file()).map(|file| read_image(&file)).transpose()?)
    }

    /// The flow of a pair, if it is known.
    pub(crate) fn flow(&self, first: First<'_>) -> Result<Option<Correspondence>, StageError> {
        let file = self.folder.as_ref().map(|folder| first.file(folder)).filter(|file| file.is_file());
        match file.map(|file| read_pixels(&file)).transpose()? {
            Some(Pixels::Sixteen(samples)) => Ok(Some(Ok(decode(&samples)))),
            _ => Ok(None),
        }
    }
}

/// Makes the folders of pictures and flow.
pub(crate) fn folders(into: &Path) -> Result<(), StageError> {
    [into.join(ENHANCED), into.join(FLOW).join("path")].iter().try_for_each(|path| folder(path))
}

/// Stores the 2D enhancer's picture of a photograph.
pub(crate) fn keep_proposal(into: &Path, view: &View, image: &Image) -> Result<(), StageError> {
    Ok(write_png16(&proposal_of(&into.join(ENHANCED), view), &sixteen(image))?)
}

/// Stores the flow of a pair, if there is one.
pub(crate) fn keep_flow(into: &Path, first: First<'_>, flow: &Correspondence) -> Result<(), StageError> {
    let Ok((flow, mask)) = flow else { return Ok(()) };
    Ok(write_png16(&first.file(into), &encode(flow, mask))?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_capture::{FileName, Intrinsics, Pose};
    use use3d_metrics::Flow;

    #[test]
    fn what_was_stored_comes_back_and_the_rest_is_unknown() {
        let dir = tempfile::tempdir().expect("folder");
        let intrinsics = Intrinsics { width: 3, height: 2, fx: 3.0, fy: 3.0, cx: 1.5, cy: 1.0 };
        let camera = Camera { intrinsics, pose: Pose::IDENTITY };
        let view = |name: &str| View {
            name: FileName::new(name).expect("a name"),
            id: 0,
            image: name.into(),
            mask: None,
            depth_prior: None,
            camera,
        };
        let (seen, other) = (view("dive/a.png"), view("dive/b.png"));
        let picture = Image::filled(3, 2, 0.123_456_7);
        let (mut flow, mask) = (Flow::filled(3, 2, 0.25), Mask::filled(3, 2, 1));
        flow.set_pixel(1, 1, [-7.5, 3.0]);
        folders(dir.path()).expect("made");
        keep_proposal(dir.path(), &seen, &picture).expect("kept");
        let found: Correspondence = Ok((flow.clone(), mask.clone()));
        keep_flow(dir.path(), First::View(&seen), &found).expect("kept");
        keep_flow(dir.path(), First::Frame(4), &found).expect("kept");
        let scores = BTreeMap::from([(Method::Proposal, Scores::new())]);
        let known = Baseline { views: [("a".to_string(), scores)].into(), ..Baseline::default() };
        known.write(dir.path()).expect("written");

        let known = Baseline::read(Some(dir.path())).expect("read");
        assert!(known.views["a"].contains_key(&Method::Proposal));
        let image = known.proposal(&seen).expect("read").expect("a picture");
        assert_eq!(image, stored(&picture));
        assert!((image.pixel(0, 0)[0] - 0.123_456_7).abs() < 1e-5);
        for first in [First::View(&seen), First::Frame(4)] {
            let kept = known.flow(first).expect("read").expect("a flow").expect("of pixels");
            assert_eq!(kept, (flow.clone(), mask.clone()));
        }
        assert!(known.proposal(&other).expect("looked").is_none());
        assert!(known.flow(First::View(&other)).expect("looked").is_none());
        assert!(known.flow(First::Frame(5)).expect("looked").is_none());
        assert!(Baseline::read(None).expect("nothing").proposal(&seen).expect("looked").is_none());
    }
}
