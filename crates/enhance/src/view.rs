//! What is constant about a training view, and how much of it is kept.

use std::sync::Arc;

use use3d_atc::consensus::{Targets, ViewTarget};
use use3d_atc::extractor::{ExtractorSettings, Geometry, Source};
use use3d_capture::{Camera, Image, Lattice, MediumMaps, Raster, View};
use use3d_scene::Scene;
use use3d_splat::{Colors, Options, Prepared, Rasterizer, Rendered, view_colors};
use use3d_ubaf::Water;

use crate::EnhanceError;

/// A training view: its name for messages, its camera in the scene's frame.
#[derive(Clone, Debug, PartialEq)]
pub struct EnhanceView {
    /// The image's name.
    pub name: String,
    /// Where it was taken from.
    pub camera: Camera,
}

impl From<&View> for EnhanceView {
    fn from(view: &View) -> Self {
        Self { name: view.name.clone(), camera: view.camera }
    }
}

/// Enhanced images of the training views, for the objective `pseudo-labels`.
pub trait LabelSource {
    /// The enhanced image of view `index` of the list given to stage 2, of the camera's size; or what is wrong.
    fn label(&self, index: usize) -> Result<Image, String>;
}

/// What stage 2 is guided by.
#[derive(Clone, Copy)]
pub enum Guidance<'a> {
    /// Transition targets.
    Targets(&'a Targets),
    /// One enhanced image per view.
    Labels(&'a dyn LabelSource),
}

/// What a rendered view is compared with.
pub(crate) enum Reference {
    /// The stage-1 render as the extractor sees it, and the local target on its grid.
    Transition(Box<Source>, ViewTarget),
    /// The pseudo-label's pixels on the lattice, 16 bit.
    Label(Raster<u16, 3>),
}

/// The small constants of a view, always kept.
pub(crate) struct ViewConstants {
    pub(crate) camera: Camera,
    pub(crate) center: [f32; 3],
    pub(crate) lattice: Lattice,
    pub(crate) reference: Reference,
}

/// The large constants of a view: kept while the budget lasts, else made anew for every step.
pub(crate) struct Frozen {
    /// Projection and trimmed tile lists; its colours change with every step.
    pub(crate) prepared: Prepared,
    /// Stage-1 colours of all Gaussians in this view.
    pub(crate) base: Vec<[f32; 3]>,
    /// The frozen water; `None` in a scene without.
    pub(crate) water: Option<Water>,
}

impl Frozen {
    pub(crate) fn new(scene: &Scene, camera: &Camera, lattice: &Lattice) -> Self {
        let mut base = Vec::new();
        view_colors(&scene.gaussians, camera, scene.gaussians.sh_degree, &mut base);
        let mut prepared = Prepared::new();
        prepared.prepare(&scene.gaussians, camera, lattice, Colors::Given(&base));
        let water = (!scene.medium.is_none()).then(|| {
            let mut maps = MediumMaps::zeros(0, 0);
            scene.medium.maps(camera, lattice, scene.medium_degree, &mut maps);
            Water::new(maps)
        });
        Self { prepared, base, water }
    }

    pub(crate) fn bytes(&self) -> usize {
        self.prepared.memory()
            + size_of_val(self.base.as_slice())
            + self.water.as_ref().map_or(0, Water::bytes)
    }
}

/// Which pixels of views of one size are rendered, and how the extractor reads them.
struct Sampled {
    size: (usize, usize),
    geometry: Arc<Geometry>,
    lattice: Lattice,
}

/// Prepares views one after another; views of one size share what depends on the size alone.
pub(crate) struct Preparer<'a> {
    pub(crate) scene: &'a Scene,
    pub(crate) guidance: Guidance<'a>,
    sample_side: usize,
    samplings: Vec<Arc<Sampled>>,
    rasterizer: Rasterizer,
    rendered: Rendered,
}

impl<'a> Preparer<'a> {
    pub(crate) fn new(scene: &'a Scene, guidance: Guidance<'a>, sample_side: usize) -> Self {
        Self {
            scene,
            guidance,
            sample_side,
            samplings: Vec::new(),
            rasterizer: Rasterizer::new(),
            rendered: Rendered::new(),
        }
    }

    fn sampled(&mut self, size: (usize, usize)) -> Result<Arc<Sampled>, EnhanceError> {
        if let Some(known) = self.samplings.iter().find(|s| s.size == size) {
            return Ok(known.clone());
        }
        // Pseudo-labels are compared on the pixels that the default extractor would read.
        let settings = match self.guidance {
            Guidance::Targets(targets) => targets.extractor.clone(),
            Guidance::Labels(_) => ExtractorSettings::default(),
        };
        let whole = Geometry::new(size.0, size.1, &settings)?;
        let some = if self.sample_side > 0 { whole.sampled(self.sample_side)? } else { None };
        let (lattice, geometry) = some.unwrap_or_else(|| (whole.lattice(), whole));
        let sampled = Arc::new(Sampled { size, geometry: Arc::new(geometry), lattice });
        self.samplings.push(sampled.clone());
        Ok(sampled)
    }

    /// Cuts the tile lists of a view down to what its pixels see: worth it for a view that is rendered again and again.
    pub(crate) fn trim(&mut self, frozen: &mut Frozen) {
        self.rasterizer.trim(&mut frozen.prepared);
    }

    /// The constants of a view. `local` is its local target where that is known already.
    pub(crate) fn view(
        &mut self,
        index: usize,
        view: &EnhanceView,
        local: Option<&ViewTarget>,
    ) -> Result<(ViewConstants, Frozen), EnhanceError> {
        let camera = view.camera;
        let size = (camera.intrinsics.width, camera.intrinsics.height);
        let sampled = self.sampled(size)?;
        let Sampled { geometry, lattice, .. } = &*sampled;
        let frozen = Frozen::new(self.scene, &camera, lattice);
        let reference = match self.guidance {
            Guidance::Targets(targets) => {
                let maps = frozen.water.as_ref().map(|w| &w.maps);
                let options = Options::default();
                self.rasterizer.forward(&frozen.prepared, maps, &options, &mut self.rendered);
                let source = Source::on_lattice(geometry, &self.rendered.image)?;
                let target = match local {
                    Some(known) => known.clone(),
                    None => targets.view_target(&self.scene.gaussians, &camera, &mut self.rasterizer)?,
                };
                Reference::Transition(Box::new(source), target)
            }
            Guidance::Labels(labels) => {
                let wrong = |problem: String| EnhanceError::Label { view: view.name.clone(), problem };
                let label = labels.label(index).map_err(wrong)?;
                if (label.width(), label.height()) != size {
                    return Err(wrong(format!(
                        "it is {}x{}, the camera is {}x{}",
                        label.width(),
                        label.height(),
                        size.0,
                        size.1
                    )));
                }
                Reference::Label(on_lattice(&label, lattice))
            }
        };
        let center = camera.pose.center().as_vec3().to_array();
        Ok((ViewConstants { camera, center, lattice: lattice.clone(), reference }, frozen))
    }
}

/// The pixels of a label that the lattice has, rounded to 16 bit.
fn on_lattice(label: &Image, lattice: &Lattice) -> Raster<u16, 3> {
    let mut out = Raster::new(lattice.width(), lattice.height());
    for (y, &row) in lattice.rows().iter().enumerate() {
        for (x, &column) in lattice.columns().iter().enumerate() {
            let pixel = label.pixel(column as usize, row as usize);
            out.set_pixel(x, y, pixel.map(|v| (v.clamp(0.0, 1.0) * 65535.0 + 0.5) as u16));
        }
    }
    out
}
