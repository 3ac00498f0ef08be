//! The constants of a training view, and the choice of those that are kept.

use std::sync::Arc;

use use3d_atc::consensus::{Targets, ViewTarget};
use use3d_atc::extractor::{ExtractorSettings, Geometry, SourceImage};
use use3d_capture::{Appearance, Camera, Image, KeptWater, Lattice, MediumMaps, Raster, View};
use use3d_scene::Scene;
use use3d_splat::{Options, Prepared, Rasterizer, Rendered};
use use3d_ubaf::{Sites, ViewWater};

use crate::EnhanceError;
use crate::labels::PseudoLabels;

/// A training view: its name for messages, its camera in the scene's frame.
#[derive(Clone, Debug, PartialEq)]
pub struct EnhanceView {
    /// The image's name.
    pub name: String,
    /// The camera that took it.
    pub camera: Camera,
}

impl From<&View> for EnhanceView {
    fn from(view: &View) -> Self {
        Self { name: view.name.to_string(), camera: view.camera }
    }
}

/// The guidance of stage 2.
#[derive(Clone, Copy)]
pub enum Guidance<'a> {
    /// Transition targets.
    Targets(&'a Targets),
    /// One enhanced image per view.
    Labels(&'a PseudoLabels),
}

impl<'a> Guidance<'a> {
    /// The transition targets; `None` for labels.
    pub(crate) fn targets(self) -> Option<&'a Targets> {
        match self {
            Self::Targets(targets) => Some(targets),
            Self::Labels(_) => None,
        }
    }

    /// The appearance that is compared. Targets define it; labels are enhanced photographs, which show the
    /// water.
    pub fn appearance(&self) -> Appearance {
        self.targets().map_or(Appearance::Water, |targets| targets.appearance)
    }

    /// The share of the stage-1 water in the compared images; all of it in photographs, and so in labels.
    pub fn kept_water(&self) -> KeptWater {
        self.targets().map_or(KeptWater::ALL, |targets| targets.kept_water)
    }

    /// True if the identity is the answer, as in a scene in air whose colours stay as photographed.
    pub fn asks_for_no_change(&self) -> bool {
        self.targets().is_some_and(Targets::ask_for_no_change)
    }

    /// Computes the stage-1 water in front of a camera for the comparison of views: thinned to the kept
    /// share. Returns `false` and leaves `maps` unchanged in a scene without water and in clear radiance.
    pub fn look_through(
        &self,
        scene: &Scene,
        camera: &Camera,
        lattice: &Lattice,
        maps: &mut MediumMaps,
    ) -> bool {
        let shown = self.appearance() == Appearance::Water && scene.look_through(camera, lattice, maps);
        if shown {
            self.kept_water().thin(maps);
        }
        shown
    }
}

/// The reference with which a rendered view is compared; made by [`References`], read by
/// [`Measure`](crate::engine::Measure).
#[derive(Clone, Debug)]
pub enum Reference {
    /// The stage-1 render as the extractor's source, and the local target on its grid.
    Transition(Box<SourceImage>, ViewTarget),
    /// The pseudo-label's pixels on the lattice, 16 bit.
    Label(Arc<Raster<u16, 3>>),
}

/// The small constants of a view, always kept.
pub(crate) struct ViewConstants {
    pub(crate) camera: Camera,
    pub(crate) center: [f32; 3],
    pub(crate) lattice: Lattice,
    pub(crate) reference: Reference,
}

/// The indices of the Gaussians, out of `count`, that define the field's constant mode: at most `sample`,
/// at regular intervals. `None` means all of them, also if `sample` is 0.
pub fn centred(count: usize, sample: usize) -> Option<Vec<u32>> {
    let some = sample > 0 && sample < count;
    some.then(|| (0..count as u32).step_by(count.div_ceil(sample)).collect())
}

/// The sites at which the scene's Gaussians look the field up, and the Gaussians that define its constant
/// mode.
#[derive(Clone)]
pub(crate) struct Lookups {
    all: Arc<Sites>,
    /// The Gaussians that define it; `None` if all do, and then every view lists all of them.
    centred: Option<Vec<u32>>,
}

impl Lookups {
    /// Lookups with the mean over at most `sample` Gaussians, at regular intervals; over all if `sample` is
    /// 0.
    pub(crate) fn new(all: Arc<Sites>, sample: usize) -> Self {
        let centred = centred(all.len(), sample);
        Self { all, centred }
    }

    /// The sites that define the mean, and no others.
    pub(crate) fn centre(&self) -> Arc<Sites> {
        match &self.centred {
            Some(centred) => Arc::new(self.all.select(centred, centred.len())),
            None => Arc::clone(&self.all),
        }
    }

    /// The sites that define the mean, followed by the others that a view sees.
    fn of(&self, prepared: &Prepared) -> Listed {
        let Some(centred) = &self.centred else {
            return Listed { gaussians: None, sites: Arc::clone(&self.all) };
        };
        let mut listed = vec![false; self.all.len()];
        centred.iter().for_each(|&i| listed[i as usize] = true);
        let mut gaussians = centred.clone();
        gaussians.extend(prepared.visible().filter(|&i| !listed[i]).map(|i| i as u32));
        gaussians[centred.len()..].sort_unstable();
        let sites = Arc::new(self.all.select(&gaussians, centred.len()));
        Listed { gaussians: Some(gaussians), sites }
    }
}

/// The Gaussians whose appearance a step needs.
pub(crate) struct Listed {
    /// Their indices; `None` for all, in order.
    gaussians: Option<Vec<u32>>,
    /// The sites at which they look the field up.
    pub(crate) sites: Arc<Sites>,
}

impl Listed {
    /// A list of all of them.
    #[cfg(test)]
    pub(crate) fn all(sites: &Arc<Sites>) -> Self {
        Self { gaussians: None, sites: Arc::clone(sites) }
    }

    /// The listed rows of `all`, in the list's order.
    fn rows(&self, all: Vec<[f32; 3]>) -> Vec<[f32; 3]> {
        match &self.gaussians {
            Some(gaussians) => gaussians.iter().map(|&i| all[i as usize]).collect(),
            None => all,
        }
    }

    /// Copies the listed rows into a buffer, or returns `all` itself.
    pub(crate) fn gather<'a>(&self, all: &'a [[f32; 3]], out: &'a mut Vec<[f32; 3]>) -> &'a [[f32; 3]] {
        let Some(gaussians) = &self.gaussians else { return all };
        out.clear();
        out.extend(gaussians.iter().map(|&i| all[i as usize]));
        out
    }

    /// Puts the listed rows back at their positions among `count`; rows that are not listed keep their
    /// values.
    pub(crate) fn scatter<'a>(
        &self,
        rows: &'a [[f32; 3]],
        count: usize,
        out: &'a mut Vec<[f32; 3]>,
    ) -> &'a [[f32; 3]] {
        let Some(gaussians) = &self.gaussians else { return rows };
        out.resize(count, [0.0; 3]);
        for (&i, row) in gaussians.iter().zip(rows) {
            out[i as usize] = *row;
        }
        out
    }
}

/// The large constants of a view: kept while the memory limit allows, otherwise made again for every step.
pub(crate) struct Frozen {
    /// Projection, trimmed tile lists and the pixels' weights; its colours change with every step.
    pub(crate) prepared: Prepared,
    /// The Gaussians whose appearance it needs.
    pub(crate) listed: Listed,
    /// Their stage-1 colours in this view.
    pub(crate) base: Vec<[f32; 3]>,
    /// The frozen water; `None` in a scene without water, and in clear radiance.
    pub(crate) water: Option<ViewWater>,
}

impl Frozen {
    /// Makes the constants; with a `trimmer`, without the entries that no pixel sees.
    pub(crate) fn new(
        scene: &Scene,
        guidance: Guidance<'_>,
        lookups: &Lookups,
        camera: &Camera,
        lattice: &Lattice,
        trimmer: Option<&mut Rasterizer>,
    ) -> Self {
        let (mut colors, mut prepared) = (Vec::new(), Prepared::new());
        scene.project(camera, lattice, |_| (), &mut colors, &mut prepared);
        if let Some(rasterizer) = trimmer {
            rasterizer.trim(&mut prepared);
        }
        let listed = lookups.of(&prepared);
        let base = listed.rows(colors);
        let mut maps = MediumMaps::zeros(0, 0);
        let shown = guidance.look_through(scene, camera, lattice, &mut maps);
        let water = shown.then(|| ViewWater::new(maps));
        Self { prepared, listed, base, water }
    }

    /// The same constants with another list.
    #[cfg(test)]
    pub(crate) fn relist(&mut self, lookups: &Lookups) {
        assert!(self.listed.gaussians.is_none());
        self.listed = lookups.of(&self.prepared);
        assert!(self.listed.gaussians.is_some(), "the scene is too small for a list");
        self.base = self.listed.rows(std::mem::take(&mut self.base));
    }

    pub(crate) fn bytes(&self) -> usize {
        let listed = self.listed.gaussians.as_ref().map_or(0, |g| 4 * g.len() + self.listed.sites.bytes());
        self.prepared.memory()
            + listed
            + size_of_val(self.base.as_slice())
            + self.water.as_ref().map_or(0, ViewWater::bytes)
    }
}

/// The pixels of views of one size that are rendered, and the way in which the extractor reads them.
pub(crate) struct Sampled {
    size: (usize, usize),
    geometry: Arc<Geometry>,
    pub(crate) lattice: Lattice,
}

/// The sampled pixels for views of several sizes.
pub(crate) struct Samplings {
    settings: ExtractorSettings,
    /// Number of pixels of the long side; 0 for all that the extractor weighs.
    side: usize,
    known: Vec<Arc<Sampled>>,
}

impl Samplings {
    pub(crate) fn new(settings: ExtractorSettings, side: usize) -> Self {
        Self { settings, side, known: Vec::new() }
    }

    /// The sampled pixels for views of this size.
    pub(crate) fn of(&mut self, size: (usize, usize)) -> Result<Arc<Sampled>, EnhanceError> {
        if let Some(known) = self.known.iter().find(|s| s.size == size) {
            return Ok(known.clone());
        }
        let whole = Geometry::new(size.0, size.1, &self.settings)?;
        let some = if self.side > 0 { whole.sampled(self.side)? } else { None };
        let (lattice, geometry) = some.unwrap_or_else(|| (whole.lattice(), whole));
        let sampled = Arc::new(Sampled { size, geometry: Arc::new(geometry), lattice });
        self.known.push(sampled.clone());
        Ok(sampled)
    }
}

/// Makes the references of views, one after another; views of one size share the data that depends on the
/// size alone.
pub struct References<'a> {
    scene: &'a Scene,
    guidance: Guidance<'a>,
    samplings: Samplings,
    rasterizer: Rasterizer,
}

impl<'a> References<'a> {
    /// References on lattices of `sample_side` pixels on the long side; 0 for all that the extractor
    /// weighs.
    pub fn new(scene: &'a Scene, guidance: Guidance<'a>, sample_side: usize) -> Self {
        // Pseudo-labels are compared on the pixels that the default extractor would read.
        let settings = guidance.targets().map(|targets| targets.extractor.clone()).unwrap_or_default();
        let samplings = Samplings::new(settings, sample_side);
        Self { scene, guidance, samplings, rasterizer: Rasterizer::new() }
    }

    fn sampled(&mut self, camera: &Camera) -> Result<Arc<Sampled>, EnhanceError> {
        self.samplings.of((camera.intrinsics.width, camera.intrinsics.height))
    }

    /// The pixels of a view that are rendered.
    pub fn lattice(&mut self, camera: &Camera) -> Result<Lattice, EnhanceError> {
        Ok(self.sampled(camera)?.lattice.clone())
    }

    /// Makes the reference of view `index`. `stage1` draws its stage-1 render on the
    /// [lattice](Self::lattice); labels do not need it. `known` is a reference of the same view on another
    /// lattice: its local target is the same.
    pub fn of(
        &mut self,
        index: usize,
        view: &EnhanceView,
        stage1: impl FnOnce(&mut Rasterizer, &mut Image),
        known: Option<&Reference>,
    ) -> Result<Reference, EnhanceError> {
        let sampled = self.sampled(&view.camera)?;
        Ok(match self.guidance {
            Guidance::Targets(targets) => {
                let mut image = Image::new(0, 0);
                stage1(&mut self.rasterizer, &mut image);
                let source = SourceImage::on_lattice(&sampled.geometry, &image)?;
                let target = match known {
                    Some(Reference::Transition(_, target)) => target.clone(),
                    _ => targets.view_target(&self.scene.gaussians, &view.camera, &mut self.rasterizer)?,
                };
                Reference::Transition(Box::new(source), target)
            }
            Guidance::Labels(labels) => Reference::Label(labels.of(index, view, &sampled.lattice)?),
        })
    }
}

/// Prepares views for the processor's engine.
pub(crate) struct Preparer<'a> {
    lookups: Lookups,
    references: References<'a>,
    rendered: Rendered,
}

impl<'a> Preparer<'a> {
    pub(crate) fn new(
        scene: &'a Scene,
        guidance: Guidance<'a>,
        lookups: Lookups,
        sample_side: usize,
    ) -> Self {
        let references = References::new(scene, guidance, sample_side);
        Self { lookups, references, rendered: Rendered::new() }
    }

    /// Makes the constants of a view, trimmed if it is to be rendered many times. `known` is the view's
    /// reference on another lattice, if there is one.
    pub(crate) fn view(
        &mut self,
        index: usize,
        view: &EnhanceView,
        known: Option<&Reference>,
        trim: bool,
    ) -> Result<(ViewConstants, Frozen), EnhanceError> {
        let Self { lookups, references, rendered } = self;
        let camera = view.camera;
        let lattice = references.lattice(&camera)?;
        let (scene, guidance) = (references.scene, references.guidance);
        let trimmer = trim.then_some(&mut references.rasterizer);
        let frozen = Frozen::new(scene, guidance, lookups, &camera, &lattice, trimmer);
        let draw = |rasterizer: &mut Rasterizer, image: &mut Image| {
            let maps = frozen.water.as_ref().map(|w| &w.maps);
            rasterizer.forward(&frozen.prepared, maps, &Options::default(), rendered);
            std::mem::swap(image, &mut rendered.image);
        };
        let reference = references.of(index, view, draw, known)?;
        let center = camera.pose.center().as_vec3().to_array();
        Ok((ViewConstants { camera, center, lattice, reference }, frozen))
    }
}
