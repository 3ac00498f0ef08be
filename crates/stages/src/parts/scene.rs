//! The scene that a stage works on, and the engine that draws it.

use use3d_scene::Scene;
use use3d_workflow::{StageContext, StageError};

use crate::engines::{Drawn, EngineChoice};

/// Loads the scene of an input role.
pub(crate) fn scene(context: &StageContext, role: &str) -> Result<Scene, StageError> {
    Scene::load(context.input(role)?).map_err(StageError::bad_input)
}

/// Loads the scene that pictures show: the enhanced one, if there is one.
pub(crate) fn shown_scene(context: &StageContext) -> Result<Scene, StageError> {
    scene(context, if context.optional_input("enhanced").is_some() { "enhanced" } else { "scene" })
}

/// Loads a scene into the engine that draws it, and reports the engine unless the parameters request the
/// processor.
pub(crate) fn drawn<'s>(
    context: &StageContext,
    scene: &'s Scene,
    engine: &EngineChoice,
) -> Result<Drawn<'s>, StageError> {
    let drawn = Drawn::new(scene, engine)?;
    if *engine != EngineChoice::Cpu {
        context.say(format_args!("engine: {}", drawn.told));
    }
    Ok(drawn)
}
