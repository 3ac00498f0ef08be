//! Graphics cards that were opened. Each is checked once.

use std::collections::BTreeMap;
use std::sync::{Arc, LazyLock, Mutex, PoisonError};

use use3d_atc::AtcError;
use use3d_atc::consensus::Adjoint;
use use3d_capture::{Camera, Lattice};
use use3d_enhance::engine::FieldEngine;
use use3d_enhance::{EnhanceError, EnhanceParams, EnhanceView, Guidance};
use use3d_gpu::{
    CheckError, Drawing, DrawnView, Gpu, LOSSES_WITH_KERNELS, LinearSplat, Stage1, Stage2, kernel_sources,
    open_checked,
};
use use3d_reconstruct::engine::Engine;
use use3d_reconstruct::{ReconstructParams, losses};
use use3d_render::{Composer, Composition, RenderError, Renderer};
use use3d_scene::Scene;
use use3d_splat::{Gaussians, Rendered, view_colors};
use use3d_training::{EngineError, Observer};
use use3d_workflow::{DeviceClass, Digest};

use super::{Card, OpenCard, Renderers};
use crate::code;

/// The reason why no card can be opened. Each card is tried once, and the reason is kept.
pub(crate) type OpenError = Arc<CheckError>;

/// The cards that were opened, by the name that was asked for.
static OPENED: Mutex<BTreeMap<Option<String>, Result<Gpu, OpenError>>> = Mutex::new(BTreeMap::new());

/// Closes every card; a card that is still in use is closed afterwards.
pub(crate) fn close() {
    OPENED.lock().unwrap_or_else(PoisonError::into_inner).clear();
}

/// Opens the best card with this number (`#0`), PCI address, UUID or name, or with it as a part of its name;
/// without a name, the best hardware card. Returns the reason if there is none.
pub(crate) fn open(name: Option<&str>) -> Result<OpenCard, OpenError> {
    let mut opened = OPENED.lock().unwrap_or_else(PoisonError::into_inner);
    let found =
        opened.entry(name.map(str::to_lowercase)).or_insert_with(|| open_checked(name).map_err(Arc::new));
    found.clone().map(|gpu| -> OpenCard { Box::new(gpu) })
}

/// The digest of the kernels, and of the code of the GPU crate with all crates below it.
pub(crate) fn programs() -> Digest {
    static PROGRAMS: LazyLock<Digest> = LazyLock::new(|| {
        let host = code::built_in().stage(&["use3d-gpu"], &[]).map(|code| code.digest().to_string());
        Digest::of((kernel_sources().join("\n") + &host.unwrap_or_default()).as_bytes())
    });
    *PROGRAMS
}

/// The first value of stage 1's loss that has a weight at some step and no kernel.
pub(crate) fn loss_without_kernel(params: &ReconstructParams) -> Option<&'static str> {
    let steps = [0, params.iterations / 2, params.iterations.saturating_sub(1)];
    let weights = steps.map(|step| losses::weights(params, step));
    let weighted = |at: usize| weights.iter().any(|of_step| of_step[at] != 0.0);
    without_kernel(losses::names().enumerate().map(|(at, name)| (name, weighted(at))))
}

/// The first weighted name without a kernel.
fn without_kernel(values: impl IntoIterator<Item = (&'static str, bool)>) -> Option<&'static str> {
    values
        .into_iter()
        .find_map(|(name, weighted)| (weighted && !LOSSES_WITH_KERNELS.contains(&name)).then_some(name))
}

impl Card for Gpu {
    /// The class contains the adapter, its driver, the way its kernels add up, and the code of the GPU crate
    /// with its kernels and all crates below it.
    fn class(&self) -> DeviceClass {
        let adapter = &self.adapter;
        DeviceClass {
            engine: format!("gpu ({})", self.variant),
            adapter: adapter.name.clone(),
            driver: format!("{} ({})", adapter.driver, adapter.backend),
            kernels: programs(),
        }
    }

    fn name(&self) -> String {
        self.adapter.name.clone()
    }

    fn told(&self) -> String {
        let passed_over = match &self.refused_before[..] {
            [] => String::new(),
            refusals => format!("; skipped: {}", refusals.join("; ")),
        };
        format!("{} (kernels: {}){passed_over}", self.name(), self.kernels())
    }

    fn most_gaussians(&self) -> usize {
        Gpu::most_gaussians(self)
    }

    fn stage1(&self) -> Result<Box<dyn Engine>, EngineError> {
        Ok(Box::new(Stage1::new(self)?))
    }

    fn stage2<'a>(
        &self,
        scene: &'a Scene,
        views: &[EnhanceView],
        guidance: Guidance<'a>,
        params: &EnhanceParams,
        observer: &mut dyn Observer,
    ) -> Result<Box<dyn FieldEngine + 'a>, EnhanceError> {
        Ok(Box::new(Stage2::new(self, scene, views, guidance, params, observer)?))
    }

    fn renderers<'s>(&self, scene: &'s Scene) -> Result<Renderers<'s>, EngineError> {
        let gaussians = &scene.gaussians;
        let drawing = Arc::new(Mutex::new(Drawing::new(self, gaussians)?));
        let painter = Painter { device: self.name(), gaussians, drawing, colors: Vec::new() };
        Ok(Box::new(move |look| Renderer::on(Box::new(painter.clone()), scene, look)))
    }

    fn adjoint(&self, gaussians: &Gaussians) -> Result<Box<dyn Adjoint>, EngineError> {
        let splat = LinearSplat::new(self, gaussians)?;
        Ok(Box::new(Lifting { device: self.name(), gaussians: gaussians.len(), splat }))
    }
}

/// Lifts views to Gaussians that are stored on a card.
struct Lifting {
    device: String,
    gaussians: usize,
    splat: LinearSplat,
}

impl Adjoint for Lifting {
    fn gaussians(&self) -> usize {
        self.gaussians
    }

    fn lift(
        &mut self,
        camera: &Camera,
        channels: usize,
        planes: &[f32],
        out: &mut [f32],
    ) -> Result<(), AtcError> {
        let lattice = Lattice::size(camera.intrinsics.width, camera.intrinsics.height);
        let seen = self.splat.view(camera, &lattice);
        let lifted = seen.and_then(|()| self.splat.adjoint(channels, planes, out));
        lifted.map_err(|e| AtcError::Device { device: self.device.clone(), problem: e.to_string() })
    }
}

/// Draws Gaussians that are stored on a card. Clones share them.
#[derive(Clone)]
struct Painter<'s> {
    device: String,
    gaussians: &'s Gaussians,
    drawing: Arc<Mutex<Drawing>>,
    colors: Vec<[f32; 3]>,
}

impl Composer for Painter<'_> {
    /// Colours that are changed by a look are computed on the processor, one per Gaussian; the card does the
    /// rest.
    fn compose(&mut self, view: &Composition<'_>, out: &mut Rendered) -> Result<(), RenderError> {
        let Composition { camera, lattice, recolor, medium, layers } = *view;
        let colors = recolor.map(|recolor| {
            view_colors(self.gaussians, camera, self.gaussians.sh_degree, &mut self.colors);
            recolor(&mut self.colors);
            &self.colors[..]
        });
        let mut drawing = self.drawing.lock().unwrap_or_else(PoisonError::into_inner);
        let drawn = drawing.draw(&DrawnView { camera, lattice, colors, medium, layers }, out);
        drawn.map_err(|error| RenderError::Device { device: self.device.clone(), problem: error.to_string() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_loss_that_has_a_weight_and_no_kernel_is_refused() {
        assert_eq!(loss_without_kernel(&ReconstructParams::default()), None);
        let table = |weighted| [("reg_l1", true), ("opacity", weighted)];
        assert_eq!(without_kernel(table(false)), None);
        assert_eq!(without_kernel(table(true)), Some("opacity"));
    }
}
