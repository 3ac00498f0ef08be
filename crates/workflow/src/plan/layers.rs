//! The layers of parameters of a scene and variant: preset, defaults, scene, variant and command line, and
//! then the forced parameters of the variant and of the scene. Later layers win.

use std::collections::BTreeSet;

use serde_json::Value;

use crate::error::{BuildError, ParameterError};
use crate::plan::graph::{Batch, BatchScene, Variant};
use crate::stage::definition::Scope;
use crate::stage::registry::Registry;

/// The values that the layers give for a stage or a switch, from weak to strong.
pub(super) fn of<'b>(
    batch: &'b Batch,
    scene: Option<&'b BatchScene>,
    variant: Option<&'b Variant>,
    key: &str,
) -> impl Iterator<Item = &'b Value> {
    let layers = [
        Some(variant.and_then(|v| v.preset.as_ref()).unwrap_or(&batch.preset)),
        Some(&batch.defaults),
        scene.map(|s| &s.overrides),
        variant.map(|v| &v.overrides),
        Some(&batch.forced),
        variant.map(|v| &v.forced),
        scene.map(|s| &s.forced),
    ];
    layers.into_iter().flatten().filter_map(move |layer| layer.get(key))
}

/// The stages that switches leave out for a scene in a variant.
pub(super) fn left_out(
    registry: &Registry,
    batch: &Batch,
    scene: Option<&BatchScene>,
    variant: &Variant,
) -> BTreeSet<&'static str> {
    let value = |key| of(batch, scene, Some(variant), key).last();
    let off = registry.switches().iter().filter(|switch| value(switch.key) == Some(&Value::Bool(false)));
    off.flat_map(|switch| registry.switched(switch)).collect()
}

/// Refuses parameters of unknown stages, and those of a scene for a stage that is made once for all scenes.
///
/// # Errors
/// The first of them.
pub(super) fn check_names(registry: &Registry, batch: &Batch) -> Result<(), BuildError> {
    for scene in &batch.scenes {
        let keys = scene.overrides.keys().chain(scene.forced.keys());
        for name in keys.filter(|key| registry.switch_of(key).is_none()) {
            let stage = registry.stage(name)?;
            if stage.scope != Scope::Scene {
                let message = format!("`{name}` is made once for all scenes; set it in [defaults.{name}]");
                let error = ParameterError::new(name, message);
                return Err(BuildError::Parameters {
                    place: format!("scene {}", scene.name),
                    error: error.into(),
                });
            }
        }
    }
    let scenes = batch.scenes.iter().map(|s| &s.overrides);
    let variants = batch.variants.iter().map(|v| &v.overrides);
    for overrides in [&batch.preset, &batch.defaults, &batch.forced].into_iter().chain(scenes).chain(variants)
    {
        for name in overrides.keys().filter(|key| registry.switch_of(key).is_none()) {
            let section = registry.stage(name)?.section();
            if section != name {
                let message = format!("`{name}` follows `{section}`; set it in `{section}`");
                let error = ParameterError::new(name, message).into();
                return Err(BuildError::Parameters { place: format!("stage {name}"), error });
            }
        }
    }
    Ok(())
}

/// True if a scene is computed with a variant.
pub(super) fn is_of(variant: &Variant, scene: &BatchScene) -> bool {
    variant.groups.is_empty() || variant.groups.contains(&scene.group)
}

/// The variants that a scene is computed with.
pub(super) fn of_scene<'v>(variants: &'v [Variant], scene: &BatchScene) -> Vec<&'v Variant> {
    variants.iter().filter(|variant| is_of(variant, scene)).collect()
}

/// Variants with the reference variant first, at any position in the list.
pub(super) fn ordered<'v>(
    variants: &[&'v Variant],
    reference: Option<&'v Variant>,
) -> impl Iterator<Item = &'v Variant> {
    let others = variants.iter().copied().filter(move |v| reference.is_none_or(|r| r.name != v.name));
    reference.into_iter().chain(others.collect::<Vec<_>>())
}
