//! The scene that a stage works on.

use use3d_scene::Scene;

use use3d_workflow::{StageContext, StageError};

/// Loads the scene of an input role.
pub(crate) fn scene(context: &StageContext, role: &str) -> Result<Scene, StageError> {
    Scene::load(context.input(role)?).map_err(StageError::bad_input)
}

/// Loads the scene that pictures show: the enhanced one, if there is one.
pub(crate) fn shown_scene(context: &StageContext) -> Result<Scene, StageError> {
    scene(context, if context.optional_input("enhanced").is_some() { "enhanced" } else { "scene" })
}
