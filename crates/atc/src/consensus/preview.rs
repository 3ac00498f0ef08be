//! Pictures that show why consensus matters: a captured view, its proposal, its own calibrated transition,
//! and the scene's transition.
//!
//! These are 2D previews, in which a transition is applied to pixels. The method itself never does that:
//! stage 2 changes the scene's appearance so that it shows the transition in 3D.

use rayon::prelude::*;
use use3d_capture::{Image, Map};
use use3d_numerics::math;
use use3d_splat::{Gaussians, Rasterizer};

use super::rasterise::support_map;
use super::{Proposals, Targets, ViewInput, ViewRecord};
use crate::calibrator::Calibrator;
use crate::error::AtcError;
use crate::extractor::resize::Resize;
use crate::extractor::{Affine, ExtractorSettings, Form, SourceImage, affine_apply};

/// Four versions of one view, all at the captured size, and a map of the targets' support.
#[derive(Clone, Debug, PartialEq)]
pub struct Preview {
    /// The captured image; for clear radiance, the image that stage 1 computed.
    pub captured: Image,
    /// The proposer's result alone.
    pub proposal: Image,
    /// The image after this view's own calibrated transition.
    pub calibrated: Image,
    /// The image after the scene's operator and the targets of the Gaussians it sees.
    pub consensus: Image,
    /// The share of each pixel that shows Gaussians with a target.
    pub support: Map,
}

impl Preview {
    /// Makes the previews of one view.
    pub fn new(
        gaussians: &Gaussians,
        view: &ViewInput,
        record: &ViewRecord,
        proposals: Proposals<'_>,
        calibrator: &Calibrator,
        targets: &Targets,
        rasterizer: &mut Rasterizer,
    ) -> Result<Self, AtcError> {
        let size = (view.image.width(), view.image.height());
        let proposal = match (&view.proposal, proposals) {
            (Some(proposal), _) => proposal.clone(),
            (None, Proposals::From(proposer)) => {
                let settings: &ExtractorSettings = &calibrator.extractor;
                proposer.propose(&SourceImage::from_image(&view.image, settings)?.image)?
            }
            (None, Proposals::Given(id)) => return Err(proposals.missing(&view.name, id)),
        };
        let mut full = Image::new(0, 0);
        Resize::between((proposal.width(), proposal.height()), size).forward(&proposal, &mut full);
        let own = calibrator.calibrate_local(&record.descriptors, &record.proposal, &record.candidate)?;
        let form = calibrator.extractor.form;
        let seen = targets.view_target(gaussians, &record.camera, rasterizer)?;
        Ok(Self {
            captured: view.image.clone(),
            proposal: full,
            calibrated: apply_transition(&view.image, &record.candidate, record.grid, &own, form),
            consensus: apply_transition(&view.image, &targets.scene, seen.grid, &seen.local, form),
            support: support_map(gaussians, &targets.state, &record.camera, rasterizer),
        })
    }

    /// Captured, proposal, calibrated, consensus: side by side, left to right.
    pub fn sheet(&self) -> Image {
        side_by_side(&[&self.captured, &self.proposal, &self.calibrated, &self.consensus])
    }
}

/// Applies a transition to an image: the global operator per pixel, then the local operators of a grid
/// (columns, rows), bilinearly interpolated. An empty `local` applies the global operator alone.
pub fn apply_transition(
    image: &Image,
    global: &Affine,
    grid: (usize, usize),
    local: &[[f64; 6]],
    form: Form,
) -> Image {
    let (w, h) = (image.width(), image.height());
    let mut maps = Vec::new();
    if !local.is_empty() {
        let planes: Vec<f32> = (0..6).flat_map(|k| local.iter().map(move |c| c[k] as f32)).collect();
        maps.resize(6 * w * h, 0.0);
        Resize::between(grid, (w, h)).forward_planes(&planes, &mut maps);
    }
    let planes = image.planes();
    let value = |c: usize, p: usize| -> f32 {
        let colour = affine_apply(global, std::array::from_fn(|k| f64::from(planes[k][p])))[c] as f32;
        if maps.is_empty() {
            return colour;
        }
        let (a, b) = (maps[c * w * h + p], maps[(3 + c) * w * h + p]);
        let gain = match form {
            Form::Log => math::exp(a),
            Form::Linear => 1.0 + a,
        };
        gain * colour + b
    };
    let mut out = Image::new(w, h);
    for c in 0..3 {
        out.plane_mut(c).par_iter_mut().enumerate().for_each(|(p, v)| *v = value(c, p));
    }
    out
}

/// Images in one row with narrow dark gaps, aligned at the top.
pub fn side_by_side(images: &[&Image]) -> Image {
    const GAP: usize = 6;
    let width = images.iter().map(|i| i.width()).sum::<usize>() + GAP * images.len().saturating_sub(1);
    let height = images.iter().map(|i| i.height()).max().unwrap_or(0);
    let mut sheet = Image::filled(width, height, 0.08);
    let mut left = 0;
    for image in images {
        for c in 0..3 {
            for y in 0..image.height() {
                let start = y * width + left;
                sheet.plane_mut(c)[start..start + image.width()].copy_from_slice(image.row(c, y));
            }
        }
        left += image.width() + GAP;
    }
    sheet
}
