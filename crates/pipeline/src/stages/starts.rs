//! What each view brings into the consensus: its photograph and a 2D enhancer's version of it, or its clear
//! radiance and the scene's grade.

use use3d_atc::AtcError;
use use3d_atc::calibrator::Calibrator;
use use3d_atc::consensus::{Proposals, ViewInput};
use use3d_atc::extractor::ExtractorSettings;
use use3d_atc::proposers::{Proposer, ProposerId, SceneFindings, SceneProposer, SceneSurvey, SceneView};
use use3d_build::{StageContext, StageError};
use use3d_capture::{Appearance, View};
use use3d_import::load_pixels;
use use3d_scene::{KnownView, KnownViews, Scene};

use super::calibrator::read_calibrator;
use super::proposer::{ProposerChoice, of_calibrator};

/// Where transitions start from.
pub(super) enum Start<'s> {
    /// Photographs, and proposals of a 2D enhancer.
    Photographs(Box<dyn Proposer>),
    /// What stage 1 knows of each view, and the grade of the whole scene.
    Known(Box<(KnownViews<'s>, SceneProposer)>),
}

/// Where transitions start from, and what corrects them.
pub(super) struct Starts<'s> {
    start: Start<'s>,
    /// The calibrator; of proposals in clear radiance, one that corrects nothing.
    pub(super) calibrator: Calibrator,
    /// Whose proposals they are.
    pub(super) proposer: ProposerId,
}

impl<'s> Starts<'s> {
    /// As the parameters ask.
    pub(super) fn open(
        context: &StageContext,
        choice: ProposerChoice,
        scene: &'s Scene,
        views: &[&View],
    ) -> Result<Self, StageError> {
        if choice == ProposerChoice::Scene {
            return Self::known(context, scene, views);
        }
        let calibrator = read_calibrator(context.input("calibrator")?)?;
        let models = context.optional_input("models");
        let proposer = of_calibrator(choice, &calibrator.proposer.name, models)
            .map_err(StageError::bad_input_message)?;
        let id = proposer.id();
        calibrator.proposer.require(&id).map_err(StageError::bad_input)?;
        Ok(Self { start: Start::Photographs(proposer), calibrator, proposer: id })
    }

    fn known(context: &StageContext, scene: &'s Scene, views: &[&View]) -> Result<Self, StageError> {
        if context.optional_input("calibrator").is_some() {
            return Err(StageError::bad_input_message(
                "a calibrator is named, but `proposer = \"scene\"` has none: calibrators are fitted to photographs; leave one of the two out",
            ));
        }
        let mut known = KnownViews::new(scene);
        let mut survey = SceneSurvey::new();
        for (i, view) in views.iter().enumerate() {
            context.alive()?;
            context.progress_with(i as u64, views.len() as u64, "views", "looking at what stage 1 knows");
            survey.add(&seen(&mut known, view))?;
        }
        let proposer = survey.finish();
        context.say(said(proposer.findings()));
        let id = SceneProposer::id();
        let calibrator = Calibrator::uncalibrated(ExtractorSettings::default(), id.clone());
        Ok(Self { start: Start::Known(Box::new((known, proposer))), calibrator, proposer: id })
    }

    /// What the transitions are between.
    pub(super) fn appearance(&self) -> Appearance {
        match &self.start {
            Start::Photographs(_) => Appearance::Water,
            Start::Known(_) => Appearance::Clear,
        }
    }

    /// What was found about the scene, where it was looked at.
    pub(super) fn findings(&self) -> Option<&SceneFindings> {
        match &self.start {
            Start::Photographs(_) => None,
            Start::Known(known) => Some(known.1.findings()),
        }
    }

    /// Where proposals come from, for the consensus.
    pub(super) fn proposals(&self) -> Proposals<'_> {
        match &self.start {
            Start::Photographs(proposer) => Proposals::From(proposer.as_ref()),
            Start::Known(_) => Proposals::Given(&self.proposer),
        }
    }

    /// A training view on its way into the consensus.
    pub(super) fn view(&mut self, view: &View) -> Result<ViewInput, AtcError> {
        let (image, proposal) = match &mut self.start {
            Start::Photographs(_) => {
                let pixels = load_pixels(view)
                    .map_err(|e| AtcError::View { view: view.name.to_string(), problem: e.to_string() })?;
                (pixels.to_image(), None)
            }
            Start::Known(known) => {
                let seen = seen(&mut known.0, view);
                let proposal = known.1.propose(&seen)?;
                (seen.clear, Some(proposal))
            }
        };
        Ok(ViewInput { name: view.name.to_string(), camera: view.camera, image, proposal })
    }
}

/// What stage 1 knows of a view, as the proposer takes it.
fn seen(known: &mut KnownViews<'_>, view: &View) -> SceneView {
    let KnownView { clear, accumulation, arriving } = known.view(&view.camera);
    SceneView { clear, accumulation, arriving }
}

/// The scene's grade, for a person to read.
fn said(found: &SceneFindings) -> String {
    let [r, g, b] = found.balance;
    let cast = if found.trusted > 0.0 {
        format!("white balance ×{r:.2} ×{g:.2} ×{b:.2} ({:.0} % of a cast taken off)", 100.0 * found.trusted)
    } else {
        "no cast that is sure, colours as they are".into()
    };
    format!(
        "proposer: scene, in clear radiance, not calibrated: {cast}; brightness ×{:.2}, contrast ×{:.2}",
        found.brightness, found.contrast
    )
}
