//! The pictures that transitions start from: photographs, stage-1 renders in thinner water, or stage-1
//! renders without water; and the proposer for them.

use use3d_atc::AtcError;
use use3d_atc::calibrator::Calibrator;
use use3d_atc::consensus::{Proposals, ViewInput};
use use3d_atc::extractor::ExtractorSettings;
use use3d_atc::proposers::{Proposer, ProposerId};
use use3d_capture::{Appearance, Image, KeptWater, View};
use use3d_import::load_pixels;
use use3d_scene::{KnownViews, Scene};
use use3d_workflow::{StageContext, StageError};

use super::calibrator::read_calibrator;
use super::kept_water;
use super::proposer::{NO_PROPOSER, ProposerChoice, of_calibrator, open};
use super::target_params::{Params, Source};

/// The source of the pictures.
enum Pictures<'s> {
    /// The photographs, and proposals for them.
    Photographs(Box<dyn Proposer>),
    /// Stage-1 renders that show this share of the water (`None`: clear radiance), and proposals for them.
    Renders { views: Box<KnownViews<'s>>, shown: Option<KeptWater>, proposer: Box<dyn Proposer> },
    /// The photographs of a scene in air, which stay as they are.
    InAir,
}

/// The pictures that transitions start from, and the calibrator that corrects the proposals.
pub(crate) struct TransitionSources<'s> {
    pictures: Pictures<'s>,
    /// The calibrator. If none is given, it corrects nothing.
    pub(crate) calibrator: Calibrator,
    /// The proposer's name and version.
    pub(crate) proposer: ProposerId,
}

impl<'s> TransitionSources<'s> {
    /// Opens the pictures, the proposer and the calibrator that the parameters request.
    pub(crate) fn open(
        context: &StageContext,
        params: &Params,
        scene: &'s Scene,
        views: &[&View],
    ) -> Result<Self, StageError> {
        if let Some((problem, _)) = params.conflict() {
            return Err(StageError::bad_input_message(problem));
        }
        let in_air = scene.medium.is_none();
        if stays_as_photographed(params, context.optional_input("calibrator").is_some(), in_air) {
            context.say(
                "the scene has no water, so its colours stay as photographed; \
                 `--set targets.proposer=fusion` enhances them all the same",
            );
            let id = ProposerId { name: NO_PROPOSER.into(), digest: String::new() };
            return Ok(Self::uncalibrated(Pictures::InAir, id));
        }
        let (calibrator, proposer) = Self::two_dimensional(context, params)?;
        let id = proposer.id();
        let shown = match (params.source, params.kept_water.given()) {
            (Source::Photographs, _) => Some(KeptWater::ALL),
            (Source::Clear, _) => None,
            (Source::Renders, Some(kept)) => Some(kept),
            (Source::Renders, None) => Some(kept_water::choose(context, scene, views)?),
        };
        let pictures = if in_air || shown.is_some_and(|kept| kept.is_all()) {
            Pictures::Photographs(proposer)
        } else {
            Pictures::Renders { views: Box::new(KnownViews::new(scene)), shown, proposer }
        };
        let starts = Self { pictures, calibrator, proposer: id };
        context.detail(starts.message(context));
        context.say(starts.in_short(context));
        Ok(starts)
    }

    /// The 2D enhancer, and the calibrator that was fitted for it; without a given one, a calibrator that
    /// corrects nothing.
    fn two_dimensional(
        context: &StageContext,
        params: &Params,
    ) -> Result<(Calibrator, Box<dyn Proposer>), StageError> {
        let models = context.optional_input("models");
        let Some(file) = context.optional_input("calibrator") else {
            let proposer = open(params.proposer, models, &mut |line| context.log(line))
                .map_err(StageError::bad_input)?;
            return Ok((Calibrator::uncalibrated(ExtractorSettings::default(), proposer.id()), proposer));
        };
        if !params.calibrated {
            return Err(StageError::bad_input_message(
                "a calibrator is named, but `calibrated = false` uses none; leave one of the two out",
            ));
        }
        let calibrator = read_calibrator(file)?;
        let proposer = of_calibrator(params.proposer, &calibrator.proposer.name, models)
            .map_err(StageError::bad_input)?;
        calibrator.proposer.require(&proposer.id()).map_err(StageError::bad_input)?;
        Ok((calibrator, proposer))
    }

    /// A sentence that describes the choice.
    fn message(&self, context: &StageContext) -> String {
        let calibrated = match context.optional_input("calibrator") {
            Some(_) => "corrected by the calibrator",
            None => "not calibrated: nothing was learnt from pairs of images",
        };
        let pictures = match &self.pictures {
            Pictures::Photographs(_) => "the photographs".to_string(),
            Pictures::Renders { shown: None, .. } => "renders of the scene without its water".to_string(),
            Pictures::Renders { shown: Some(KeptWater([r, g, b])), .. } => format!(
                "renders of the scene with {:.0} / {:.0} / {:.0} % of its water (red / green / blue)",
                100.0 * r,
                100.0 * g,
                100.0 * b
            ),
            Pictures::InAir => String::new(),
        };
        format!("`{}` proposes for {pictures}; {calibrated}", self.proposer.name)
    }

    /// The choice in the words of a diver.
    fn in_short(&self, context: &StageContext) -> String {
        let filter = match self.proposer.name.as_str() {
            "fusion" => "the program's own filter".to_string(),
            name => format!("the filter {name}"),
        };
        let water = match &self.pictures {
            Pictures::Renders { shown: None, .. } => {
                ", after all of the water's effect was taken away".to_string()
            }
            Pictures::Renders { shown: Some(KeptWater(left)), .. } => {
                let left: f64 = left.iter().map(|share| f64::from(*share) / 3.0).sum();
                format!(", after {:.0} % of the water's effect was taken away", 100.0 * (1.0 - left))
            }
            Pictures::Photographs(_) | Pictures::InAir => String::new(),
        };
        let pairs = match context.optional_input("calibrator") {
            Some(_) => ", adjusted by what was learnt from your pairs of pictures",
            None => "",
        };
        format!("colours are corrected by {filter}{pairs}{water}")
    }

    fn uncalibrated(pictures: Pictures<'s>, proposer: ProposerId) -> Self {
        let calibrator = Calibrator::uncalibrated(ExtractorSettings::default(), proposer.clone());
        Self { pictures, calibrator, proposer }
    }

    /// The appearance of the pictures, and the share of the water in them.
    pub(crate) fn shown(&self) -> (Appearance, KeptWater) {
        match &self.pictures {
            Pictures::Photographs(_) | Pictures::InAir => (Appearance::Water, KeptWater::ALL),
            Pictures::Renders { shown: Some(kept), .. } => (Appearance::Water, *kept),
            Pictures::Renders { shown: None, .. } => (Appearance::Clear, KeptWater::ALL),
        }
    }

    /// The source of the proposals, for the consensus.
    pub(crate) fn proposals(&self) -> Proposals<'_> {
        match &self.pictures {
            Pictures::Photographs(proposer) => Proposals::From(proposer.as_ref()),
            Pictures::Renders { .. } | Pictures::InAir => Proposals::Given(&self.proposer),
        }
    }

    /// Prepares a training view for the consensus.
    pub(crate) fn view(&mut self, view: &View) -> Result<ViewInput, AtcError> {
        let (image, proposal) = match &mut self.pictures {
            Pictures::Photographs(_) => (photograph(view)?, None),
            Pictures::InAir => {
                let image = photograph(view)?;
                (image.clone(), Some(image))
            }
            Pictures::Renders { views, shown, proposer } => {
                let image = match shown {
                    Some(kept) => views.through(&view.camera, *kept),
                    None => views.view(&view.camera).clear,
                };
                let image: Image = image.map(|v| v.clamp(0.0, 1.0));
                let proposal = proposer.enhance(&image)?;
                (image, Some(proposal))
            }
        };
        Ok(ViewInput { name: view.name.to_string(), camera: view.camera, image, proposal })
    }
}

/// The photograph of a view.
fn photograph(view: &View) -> Result<Image, AtcError> {
    let pixels = load_pixels(view)
        .map_err(|e| AtcError::View { view: view.name.to_string(), problem: e.to_string() })?;
    Ok(pixels.to_image())
}

/// True if the colours of a scene are left alone: it is in air, and the parameters leave the choice open. In
/// blind rankings people like a photograph in air better than any 2D enhancement of it.
fn stays_as_photographed(params: &Params, calibrator: bool, in_air: bool) -> bool {
    let open = params.source == Source::Renders && params.proposer == ProposerChoice::Auto;
    in_air && open && !calibrator
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_in_air_stay_unless_an_enhancement_is_named() {
        let open = Params::default();
        assert!(stays_as_photographed(&open, false, true));
        assert!(!stays_as_photographed(&open, false, false), "under water");
        assert!(!stays_as_photographed(&open, true, true), "a calibrator is named");
        let named = Params { proposer: ProposerChoice::Fusion, ..Params::default() };
        assert!(!stays_as_photographed(&named, false, true));
        let paper = Params { source: Source::Photographs, ..Params::default() };
        assert!(!stays_as_photographed(&paper, false, true));
    }
}
