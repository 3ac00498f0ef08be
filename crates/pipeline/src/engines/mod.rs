//! Which engine does a training's steps: the processor's, or a graphics card's.
//!
//! A card is opened and checked once in a process, when its name first matters: where a key is made of it, or a training starts. A
//! choice that names a card which is not there, fails its check or cannot do what is asked is refused with the parameters, before anything
//! runs; `auto` takes the processor then. What the card and its kernels are is told by the stage's numeric class and by nothing else of its
//! key, so an edit of a kernel makes no training on the processor stale.

#[cfg(feature = "gpu")]
mod cards;

use use3d_build::DeviceClass;
use use3d_reconstruct::engine::{CpuEngine, Engine};
use use3d_reconstruct::{EngineChoice, Medium, ReconstructParams};
use use3d_training::EngineError;

#[cfg(not(feature = "gpu"))]
mod cards {
    use super::{DeviceClass, Engine, EngineError};

    /// None is ever made.
    pub(super) enum Card {}

    pub(super) fn open(_name: Option<&str>) -> Result<Card, String> {
        Err("this program was built without engines for graphics cards (cargo feature `gpu`); use `cpu`"
            .into())
    }

    impl Card {
        pub(super) fn class(&self) -> DeviceClass {
            match *self {}
        }

        pub(super) fn name(&self) -> String {
            match *self {}
        }

        pub(super) fn stage1(&self) -> Result<Box<dyn Engine>, EngineError> {
            match *self {}
        }
    }
}

use cards::{Card, open};

/// Whether cards have kernels for a water: one made of spherical harmonics, or none.
fn on_cards(medium: Medium) -> bool {
    medium == Medium::None || medium.starts_from_harmonics()
}

/// Why no card can do such a training.
fn beyond_cards(params: &ReconstructParams) -> Option<String> {
    (!on_cards(params.medium)).then(|| {
        format!(
            "cpu for the water `{}`, which runs on the processor alone; of {} graphics cards have kernels",
            params.medium.name(),
            Medium::names(on_cards)
        )
    })
}

/// The card that a training takes; `None`: the processor.
fn card(params: &ReconstructParams) -> Result<Option<Card>, String> {
    match &params.engine {
        EngineChoice::Cpu => Ok(None),
        EngineChoice::Auto if beyond_cards(params).is_some() => Ok(None),
        EngineChoice::Auto => Ok(open(None).ok()),
        EngineChoice::Gpu(name) => match beyond_cards(params) {
            Some(expected) => Err(format!("expected {expected}")),
            None => open(name.as_deref()).map(Some),
        },
    }
}

/// Refuses a choice of engine that cannot be kept on this machine: the parameter, and what is wrong.
pub(crate) fn check(params: &ReconstructParams) -> Result<(), (String, String)> {
    card(params).map(|_| ()).map_err(|what| ("engine".to_string(), what))
}

/// The device that a training computes on; `None`: the processor alone.
pub(crate) fn class(params: &ReconstructParams) -> Option<DeviceClass> {
    card(params).ok().flatten().map(|card| card.class())
}

/// The engine of stage 1, and what a person is told of the choice, if there was one.
pub(crate) fn stage1(params: &ReconstructParams) -> Result<(Box<dyn Engine>, Option<String>), EngineError> {
    let chosen = card(params).map_err(|what| EngineError::Request { engine: "gpu", what })?;
    let processor = || -> Box<dyn Engine> { Box::new(CpuEngine::new()) };
    Ok(match chosen {
        Some(card) => (card.stage1()?, Some(format!("engine: gpu, {}", card.name()))),
        None if params.engine == EngineChoice::Cpu => (processor(), None),
        None => {
            let why = beyond_cards(params).map(|expected| format!("expected {expected}"));
            let why = why.or_else(|| open(None).err()).unwrap_or_default();
            (processor(), Some(format!("engine: cpu ({why})")))
        }
    })
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
        assert_eq!((check(&params), class(&params)), (Ok(()), None));
        assert!(stage1(&params).unwrap().1.is_none());
    }

    #[test]
    fn what_no_card_can_do_is_refused_by_name_and_left_to_the_processor_by_auto() {
        let (at, what) = check(&asking("gpu", Medium::Mlp)).unwrap_err();
        assert!(at == "engine" && what.contains("`mlp`") && what.contains("expected cpu"), "{what}");
        let auto = asking("auto", Medium::Mlp);
        assert_eq!((check(&auto), class(&auto)), (Ok(()), None));
        let (_, said) = stage1(&auto).unwrap();
        assert!(said.unwrap().contains("engine: cpu (expected cpu for the water `mlp`"));
    }

    #[test]
    fn a_name_that_no_adapter_has_is_refused_with_those_there_are() {
        let (at, what) = check(&asking("gpu:no such card", Medium::Rbf)).unwrap_err();
        assert_eq!(at, "engine");
        assert!(what.contains("no such card") || what.contains("cargo feature `gpu`"), "{what}");
    }
}
