//! Prepares a stage's scene for drawing on the processor or on a graphics card.

use use3d_scene::Scene;
use use3d_workflow::{StageContext, StageError};

use crate::engines::{Drawn, EngineChoice};

/// Loads a scene into the engine that draws it, and reports the engine unless the parameters request the
/// processor.
pub(crate) fn drawn<'s>(
    context: &StageContext,
    scene: &'s Scene,
    engine: &EngineChoice,
) -> Result<Drawn<'s>, StageError> {
    let drawn = Drawn::new(scene, engine).map_err(StageError::message)?;
    if *engine != EngineChoice::Cpu {
        context.say(format_args!("engine: {}", drawn.told));
    }
    Ok(drawn)
}
