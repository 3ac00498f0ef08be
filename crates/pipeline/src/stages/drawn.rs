//! The scene of a stage where it is drawn: on the processor or on a card.

use use3d_build::{StageContext, StageError};
use use3d_scene::Scene;

use crate::engines::{Drawn, EngineChoice};

/// Takes a scene to what draws it, and tells a person which that is unless it is
/// the processor that was asked for.
pub(super) fn drawn<'s>(
    context: &StageContext,
    scene: &'s Scene,
    engine: &EngineChoice,
) -> Result<Drawn<'s>, StageError> {
    let drawn = Drawn::new(scene, engine).map_err(StageError::message)?;
    if *engine != EngineChoice::Cpu {
        context.say(format_args!("engine: {}", drawn.told()));
    }
    Ok(drawn)
}
