//! The choice of engines: for the steps of a training (the processor or a graphics card), for drawing a
//! finished scene ([`Drawn`]), and for lifting views to a scene's Gaussians.
//!
//! A card is opened and checked once per process, when its class is first needed: for a key, or at the start
//! of a stage. If a choice names a card that is missing, fails its check or cannot do the work, nothing runs;
//! `auto` then takes the processor. A command that computes nothing opens no card. A key describes the card
//! and its kernels only by the stage's numeric class. So an edit of a kernel makes no result of the processor
//! stale.

#[cfg(feature = "gpu")]
mod cards;
mod drawing;

pub use drawing::Drawn;

use use3d_atc::consensus::{Adjoint, Lift};
use use3d_capture::Formation;
use use3d_enhance::engine::{CpuFieldEngine, FieldEngine};
use use3d_enhance::{EnhanceError, EnhanceParams, EnhanceView, Guidance};
use use3d_reconstruct::engine::{CpuEngine, Engine};
use use3d_reconstruct::{ColorField, Medium, ReconstructParams, Strategy};
use use3d_render::{Look, RenderError, Renderer};
use use3d_scene::Scene;
use use3d_splat::Gaussians;
pub(crate) use use3d_training::EngineChoice;
use use3d_training::{EngineError, Observer};
use use3d_workflow::{AskedDevice, DeviceClass};

#[cfg(not(feature = "gpu"))]
mod cards {
    use use3d_workflow::Digest;

    use super::{OpenCard, ReconstructParams};

    pub(crate) fn close() {}

    /// There are no programs.
    pub(crate) fn programs() -> Digest {
        Digest::of(b"")
    }

    pub(crate) fn loss_without_kernel(_params: &ReconstructParams) -> Option<&'static str> {
        None
    }

    /// There are no cards.
    #[derive(Debug, thiserror::Error)]
    #[error("this program was built without engines for graphics cards (cargo feature `gpu`); use `cpu`")]
    pub struct OpenError;

    pub(crate) fn open(_name: Option<&str>) -> Result<OpenCard, OpenError> {
        Err(OpenError)
    }
}

use cards::{OpenError, open};

type OpenCard = Box<dyn Card>;

/// The reason why no card does what was requested.
#[derive(Debug, thiserror::Error)]
pub enum CardError {
    /// No card can be opened.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// Cards have no kernels for this water; they have them for the others.
    #[error(
        "expected cpu for the water `{0}`, which runs only on the processor; graphics cards have kernels for {1}"
    )]
    Water(&'static str, String),
    /// Cards have no kernel for this loss.
    #[error("expected cpu for the loss `{0}`, for which graphics cards have no kernel")]
    Loss(&'static str),
    /// Cards do not gather what these density rules read.
    #[error("expected cpu for the density rules `{0}`, which graphics cards do not have")]
    Rules(&'static str),
    /// Cards move all parameters in every step.
    #[error(
        "expected cpu for turns in which the water moves alone (`turns.water`), which graphics cards do not have"
    )]
    Turns,
    /// Cards have no kernel for this colour field.
    #[error("expected cpu for the colour field `{0}`, for which graphics cards have no kernel")]
    Colors(&'static str),
    /// The card of this name holds at most the first number of Gaussians, and the second was requested.
    #[error(
        "`{0}` has room for {1} Gaussians in one binding, and max_gaussians is {2}; expected a smaller max_gaussians, or cpu"
    )]
    Room(String, usize, usize),
    /// Cards do not draw this water.
    #[error("the water `{0}` is laid over finished images, which only the processor does")]
    Drawing(&'static str),
    /// A card was requested, and this reason speaks against it.
    #[error("{0}; use `--engine cpu`")]
    Requested(Box<Self>),
    /// The scene cannot be stored on the card.
    #[error(transparent)]
    Scene(#[from] EngineError),
}

/// Makes renderers of a scene that is stored on a card.
type Renderers<'s> = Box<dyn Fn(Look) -> Result<Renderer<'s>, RenderError> + 's>;

/// An open graphics card that passed its check.
trait Card {
    /// The class of arithmetic of its results.
    fn class(&self) -> DeviceClass;

    /// The adapter's name.
    fn name(&self) -> String;

    /// A description of the adapter for the user: its kernels, and the reasons why other cards were passed
    /// over.
    fn told(&self) -> String;

    /// Largest number of Gaussians that it can hold.
    fn most_gaussians(&self) -> usize;

    /// The engine of stage 1 on this card.
    fn stage1(&self) -> Result<Box<dyn Engine>, EngineError>;

    /// The engine of stage 2 on this card.
    fn stage2<'a>(
        &self,
        scene: &'a Scene,
        views: &[EnhanceView],
        guidance: Guidance<'a>,
        params: &EnhanceParams,
        observer: &mut dyn Observer,
    ) -> Result<Box<dyn FieldEngine + 'a>, EnhanceError>;

    /// Stores a scene on this card, for drawing.
    fn renderers<'s>(&self, scene: &'s Scene) -> Result<Renderers<'s>, EngineError>;

    /// The adjoint of a scene's linear splat on this card.
    fn adjoint(&self, gaussians: &Gaussians) -> Result<Box<dyn Adjoint>, EngineError>;
}

/// Closes the graphics cards that were opened. Called at the end of the program; a later use opens them
/// again.
pub fn close_devices() {
    cards::close();
}

/// True if cards have kernels for a water: one that is made of spherical harmonics and formed in front of
/// every Gaussian, or no water.
fn on_cards(medium: Medium) -> bool {
    medium == Medium::None || (medium.starts_from_harmonics() && medium.formation() == Formation::PerGaussian)
}

/// The parameters of a stage that choose an engine.
pub(crate) trait ChoosesEngine {
    /// The requested engine.
    fn engine(&self) -> &EngineChoice;

    /// The values expected instead, if no card can do what these parameters request.
    fn beyond_cards(&self) -> Option<CardError> {
        None
    }

    /// Largest number of Gaussians that these parameters request; `None` if it depends on the capture.
    fn most_gaussians(&self) -> Option<usize> {
        None
    }
}

impl ChoosesEngine for ReconstructParams {
    fn engine(&self) -> &EngineChoice {
        &self.engine
    }

    fn beyond_cards(&self) -> Option<CardError> {
        if !on_cards(self.medium) {
            return Some(CardError::Water(self.medium.name(), Medium::names(on_cards)));
        }
        if self.densify.strategy == Strategy::Signed {
            return Some(CardError::Rules("3dgs"));
        }
        if self.turns.water > 0 {
            return Some(CardError::Turns);
        }
        if self.color_field != ColorField::Off {
            return Some(CardError::Colors(self.color_field.name()));
        }
        cards::loss_without_kernel(self).map(CardError::Loss)
    }

    fn most_gaussians(&self) -> Option<usize> {
        (self.max_gaussians > 0).then_some(self.max_gaussians)
    }
}

/// The choice alone, of a stage that cards can do with all of its parameters.
impl ChoosesEngine for EngineChoice {
    fn engine(&self) -> &EngineChoice {
        self
    }
}

/// Opens the card of a name if it can do what the parameters request.
fn able(params: &impl ChoosesEngine, name: Option<&str>) -> Result<OpenCard, CardError> {
    if let Some(expected) = params.beyond_cards() {
        return Err(expected);
    }
    let card = open(name)?;
    let most = card.most_gaussians();
    match params.most_gaussians() {
        Some(asked) if asked > most => Err(CardError::Room(card.name(), most, asked)),
        _ => Ok(card),
    }
}

/// The card that a stage uses; `None` for the processor.
fn card(params: &impl ChoosesEngine) -> Result<Option<OpenCard>, CardError> {
    match params.engine() {
        EngineChoice::Cpu => Ok(None),
        EngineChoice::Auto => Ok(able(params, None).ok()),
        EngineChoice::Gpu(name) => able(params, name.as_deref()).map(Some),
    }
}

/// Chooses the card at the start of a training; also returns the message to show.
fn chosen(params: &impl ChoosesEngine) -> Result<(Option<OpenCard>, Option<String>), EngineError> {
    let refused = |fault: CardError| EngineError::Request { engine: "gpu", what: fault.to_string() };
    let card = card(params).map_err(refused)?;
    let said = match &card {
        Some(card) => Some(format!("engine: gpu, {}", card.told())),
        None if *params.engine() == EngineChoice::Cpu => None,
        None => {
            let why = able(params, None).err().map(|fault| fault.to_string());
            Some(format!("engine: cpu ({})", why.unwrap_or_default()))
        }
    };
    Ok((card, said))
}

/// Refuses a card for work that no card can do: returns the parameter and the problem.
pub(crate) fn check(params: &ReconstructParams) -> Result<(), (String, String)> {
    match (params.engine(), params.beyond_cards()) {
        (EngineChoice::Gpu(_), Some(fault)) => Err(("engine".to_string(), fault.to_string())),
        _ => Ok(()),
    }
}

/// The card that parameters ask for; `None` for the processor alone.
pub(crate) fn asked<T: ChoosesEngine>(params: &T) -> Option<AskedDevice> {
    let required = match params.engine() {
        EngineChoice::Cpu => return None,
        EngineChoice::Auto if params.beyond_cards().is_some() => return None,
        EngineChoice::Auto => false,
        EngineChoice::Gpu(_) => true,
    };
    Some(AskedDevice { name: params.engine().to_string(), required, programs: cards::programs() })
}

/// The class of the card that a stage computes on here; `None` for the processor alone.
///
/// # Errors
/// The requested card is not there, or cannot do the work; the text says why.
pub(crate) fn class<T: ChoosesEngine>(params: &T) -> Result<Option<DeviceClass>, String> {
    let card = card(params).map_err(|fault| fault.to_string())?;
    Ok(card.map(|card| card.class()))
}

/// The engine of stage 1 for a capture that may grow to `most` Gaussians, and the message to show about the
/// choice.
pub(crate) fn stage1(
    params: &ReconstructParams,
    most: usize,
) -> Result<(Box<dyn Engine>, Option<String>), EngineError> {
    let (card, said) = chosen(params)?;
    // The number of Gaussians is known only during the training, and the key already names the card. So a
    // card that may be too small is only reported here.
    let room = card.as_ref().map_or(usize::MAX, |card| card.most_gaussians());
    let said = said.map(|said| said + &narrow(most, room));
    let engine = match card {
        Some(card) => card.stage1()?,
        None => Box::new(CpuEngine::default()),
    };
    Ok((engine, said))
}

/// The message if a training may grow beyond the number of Gaussians that a card can hold.
fn narrow(most: usize, room: usize) -> String {
    if most <= room {
        return String::new();
    }
    format!(
        "; it has room for {room} Gaussians in one binding, and this capture may come to {most}, where the \
         training would fail: set max_gaussians={room}, or use cpu, which has no such limit"
    )
}

/// The engine of stage 2, and the message to show about the choice.
pub(crate) fn stage2<'a>(
    scene: &'a Scene,
    views: &[EnhanceView],
    guidance: Guidance<'a>,
    params: &EnhanceParams,
    observer: &mut dyn Observer,
) -> Result<(Box<dyn FieldEngine + 'a>, Option<String>), EnhanceError> {
    // The water is frozen in stage 2, so every kind is possible.
    let (card, said) = chosen(&params.engine)?;
    let engine: Box<dyn FieldEngine + 'a> = match card {
        Some(card) => card.stage2(scene, views, guidance, params, observer)?,
        None => Box::new(CpuFieldEngine::new(scene, views, guidance, params, observer)?),
    };
    Ok((engine, said))
}

/// The lift from views to a scene's Gaussians, and the message to show about the choice.
pub(crate) fn lift<'s>(
    gaussians: &'s Gaussians,
    engine: &EngineChoice,
) -> Result<(Lift<'s>, Option<String>), EngineError> {
    let (card, said) = chosen(engine)?;
    let lift = match card {
        Some(card) => Lift::by(card.adjoint(gaussians)?),
        None => Lift::new(gaussians),
    };
    Ok((lift, said))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn asking(engine: &str, medium: Medium) -> ReconstructParams {
        ReconstructParams { engine: engine.parse().unwrap(), medium, ..ReconstructParams::default() }
    }

    #[test]
    fn the_processor_is_the_default_and_asks_for_nothing() {
        let params = ReconstructParams::default();
        assert_eq!((check(&params), asked(&params), class(&params)), (Ok(()), None, Ok(None)));
        assert!(stage1(&params, usize::MAX).unwrap().1.is_none());
    }

    #[test]
    fn a_capture_that_may_outgrow_its_card_is_told_so() {
        assert_eq!(narrow(100, 100), "");
        let said = narrow(4_000_000, 2_796_202);
        assert!(said.contains("may come to 4000000") && said.contains("max_gaussians=2796202"), "{said}");
    }

    #[test]
    fn what_no_card_can_do_is_refused_by_name_and_left_to_the_processor_by_auto() {
        for (medium, name) in [(Medium::Mlp, "`mlp`"), (Medium::Image, "`image`")] {
            let (at, what) = check(&asking("gpu", medium)).unwrap_err();
            assert!(at == "engine" && what.contains(name) && what.contains("expected cpu"), "{what}");
        }
        let mut rules = asking("gpu", Medium::None);
        rules.densify.strategy = Strategy::Signed;
        assert!(check(&rules).unwrap_err().1.contains("density rules `3dgs`"));
        let mut field = asking("gpu", Medium::None);
        field.color_field = ColorField::Caustics;
        assert!(check(&field).unwrap_err().1.contains("colour field `caustics`"));
        let auto = asking("auto", Medium::Mlp);
        assert_eq!((check(&auto), asked(&auto), class(&auto)), (Ok(()), None, Ok(None)));
        let (_, said) = stage1(&auto, 1000).unwrap();
        assert!(said.unwrap().contains("engine: cpu (expected cpu for the water `mlp`"));
    }

    #[test]
    fn more_gaussians_than_a_card_binds_are_refused_with_their_number() {
        let mut params = asking("gpu:llvmpipe", Medium::Rbf);
        if let Err(what) = class(&params) {
            assert!(std::env::var("USE3D_REQUIRE_GPU").as_deref() != Ok("1"), "{what}");
            eprintln!("SKIPPED, no software adapter (package mesa-vulkan-drivers): {what}");
            return;
        }
        assert!(class(&params).unwrap().is_some_and(|class| class.engine == "gpu (portable)"));
        params.max_gaussians = 4_000_000_000;
        let what = class(&params).unwrap_err();
        assert!(what.contains("max_gaussians is 4000000000") && what.contains("llvmpipe"), "{what}");
    }

    #[test]
    fn a_name_that_no_adapter_has_is_refused_with_those_there_are() {
        let stage2 =
            EnhanceParams { engine: "gpu:no such card".parse().unwrap(), ..EnhanceParams::default() };
        for what in
            [class(&asking("gpu:no such card", Medium::Rbf)).unwrap_err(), class(&stage2.engine).unwrap_err()]
        {
            assert!(what.contains("no such card") || what.contains("cargo feature `gpu`"), "{what}");
        }
        assert_eq!(class(&EnhanceParams::default().engine), Ok(None));
    }
}
