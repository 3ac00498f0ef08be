//! The data stored for each captured view: a few tens of kilobytes of operators, never its pixels.

use std::sync::Arc;

use use3d_capture::{Camera, Image};

use crate::calibrator::Calibrator;
use crate::error::AtcError;
use crate::extractor::{Affine, Descriptors, Geometry, SourceImage, Transition, Workspace, center};
use crate::proposers::{Proposer, ProposerId};

/// A view as input of the consensus.
pub struct ViewInput {
    /// Its name, for reports.
    pub name: String,
    /// Its camera, in the scene's frame. The image has the camera's size.
    pub camera: Camera,
    /// The start of the transition: the captured image, or the view's clear radiance.
    pub image: Image,
    /// The proposer's result for it, at any size, if it was already computed.
    pub proposal: Option<Image>,
}

/// The source of the proposals.
#[derive(Clone, Copy)]
pub enum Proposals<'a> {
    /// This proposer computes them, at the extractor's working resolution, for views that do not contain a
    /// proposal.
    From(&'a dyn Proposer),
    /// Every view contains a proposal of this proposer.
    Given(&'a ProposerId),
}

impl Proposals<'_> {
    /// The proposer of the proposals.
    pub fn id(&self) -> ProposerId {
        match self {
            Self::From(proposer) => proposer.id(),
            Self::Given(id) => (*id).clone(),
        }
    }

    /// The error for a view that must contain a proposal and does not.
    pub(crate) fn missing(self, view: &str, id: &ProposerId) -> AtcError {
        AtcError::View { view: view.into(), problem: format!("it has no proposal by `{}`", id.name) }
    }
}

/// A view after extraction.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewRecord {
    /// Its name.
    pub name: String,
    /// Its camera.
    pub camera: Camera,
    /// Columns and rows of its grid.
    pub grid: (usize, usize),
    /// Descriptors of its image.
    pub descriptors: Descriptors,
    /// `E(image, proposal)`.
    pub proposal: Transition,
    /// The calibrated global operator: this view's candidate.
    pub candidate: Affine,
}

impl ViewRecord {
    /// The centred local operators of this view under the scene operator.
    pub fn local(&self, calibrator: &Calibrator, scene: &Affine) -> Result<Vec<[f64; 6]>, AtcError> {
        let mut cells = calibrator.calibrate_local(&self.descriptors, &self.proposal, scene)?;
        center(&mut cells);
        Ok(cells)
    }
}

/// Turns views into records, one at a time; views of one size share their tables.
#[derive(Default)]
pub struct Recorder {
    geometries: Vec<Arc<Geometry>>,
    workspace: Workspace,
}

impl Recorder {
    /// Proposes (unless the view contains a proposal), extracts and calibrates one view.
    pub fn record(
        &mut self,
        view: &ViewInput,
        proposals: Proposals<'_>,
        calibrator: &Calibrator,
    ) -> Result<ViewRecord, AtcError> {
        let fail = |problem: String| AtcError::View { view: view.name.clone(), problem };
        view.camera.validate().map_err(|e| fail(e.to_string()))?;
        let size = (view.camera.intrinsics.width, view.camera.intrinsics.height);
        let found = (view.image.width(), view.image.height());
        if size != found {
            return Err(fail(format!(
                "its image is {}x{}, its camera {}x{}; scale one to the other",
                found.0, found.1, size.0, size.1
            )));
        }
        let geometry =
            match self.geometries.iter().find(|g| g.size == size && g.settings == calibrator.extractor) {
                Some(geometry) => geometry.clone(),
                None => {
                    let geometry = Arc::new(Geometry::new(size.0, size.1, &calibrator.extractor)?);
                    self.geometries.push(geometry.clone());
                    geometry
                }
            };
        let source = SourceImage::new(&geometry, &view.image).map_err(|e| fail(e.to_string()))?;
        let computed;
        let proposal = match (&view.proposal, proposals) {
            (Some(proposal), _) => proposal,
            (None, Proposals::From(proposer)) => {
                computed = proposer.propose(&source.image).map_err(|e| fail(e.to_string()))?;
                &computed
            }
            (None, Proposals::Given(id)) => {
                return Err(proposals.missing(&view.name, id));
            }
        };
        let transition =
            source.forward(proposal, &mut self.workspace).map_err(|e| fail(e.to_string()))?.clone();
        let descriptors = source.descriptors();
        let candidate = calibrator.calibrate_global(&descriptors.global, &transition.global);
        if !candidate.iter().chain(transition.local.as_flattened()).all(|v| v.is_finite()) {
            return Err(fail("its transition is not finite; look at its proposal".into()));
        }
        Ok(ViewRecord {
            name: view.name.clone(),
            camera: view.camera,
            grid: geometry.grid,
            descriptors,
            proposal: transition,
            candidate,
        })
    }
}
