//! Enhanced images as colours to reproduce, from which the objective `pseudo-labels` learns.
//!
//! Making an image costs a run of a 2D enhancer. So every view's image is made once, and stored at the
//! pixels that steps render, in 16 bits.

use std::error::Error;
use std::sync::Arc;

use use3d_atc::extractor::ExtractorSettings;
use use3d_capture::{Image, Lattice, Raster};

use crate::views::{EnhanceView, Samplings};
use crate::{EnhanceError, EnhanceParams};

/// Enhanced images of the training views.
pub trait LabelSource {
    /// The enhanced image of view `index` of the list given to stage 2, of the camera's size.
    ///
    /// # Errors
    /// The source's own reason why there is none.
    fn label(&self, index: usize) -> Result<Image, Box<dyn Error + Send + Sync>>;
}

/// The enhanced images of all views at the pixels that steps render.
#[derive(Clone, Debug)]
pub struct PseudoLabels {
    views: Vec<Arc<Raster<u16, 3>>>,
}

impl PseudoLabels {
    /// Loads the image of every view, in order.
    pub fn new(
        source: &dyn LabelSource,
        views: &[EnhanceView],
        params: &EnhanceParams,
    ) -> Result<Self, EnhanceError> {
        params.validate().map_err(EnhanceError::Parameter)?;
        let mut samplings = Samplings::new(ExtractorSettings::default(), params.sample_side);
        let mut one = |(index, view): (usize, &EnhanceView)| {
            let wrong = |problem| EnhanceError::Label { view: view.name.clone(), problem };
            let size = (view.camera.intrinsics.width, view.camera.intrinsics.height);
            let label = source.label(index).map_err(wrong)?;
            let (width, height) = (label.width(), label.height());
            if (width, height) != size {
                let problem = format!("it is {width}x{height}, the camera is {}x{}", size.0, size.1);
                return Err(wrong(problem.into()));
            }
            Ok(Arc::new(on_lattice(&label, &samplings.of(size)?.lattice)))
        };
        Ok(Self { views: views.iter().enumerate().map(&mut one).collect::<Result<_, _>>()? })
    }

    /// The images of all views, on their lattices.
    pub fn views(&self) -> impl Iterator<Item = &Raster<u16, 3>> {
        self.views.iter().map(|view| &**view)
    }

    /// The image of view `index`, on the lattice that steps render.
    pub(crate) fn of(
        &self,
        index: usize,
        view: &EnhanceView,
        lattice: &Lattice,
    ) -> Result<Arc<Raster<u16, 3>>, EnhanceError> {
        let wrong = |problem| EnhanceError::Label { view: view.name.clone(), problem };
        let label = self.views.get(index).ok_or_else(|| wrong("there is none".into()))?;
        let (found, expected) = ((label.width(), label.height()), (lattice.width(), lattice.height()));
        if found != expected {
            let problem = format!(
                "it was made for other views or another `sample_side`: {}x{} pixels, expected {}x{}",
                found.0, found.1, expected.0, expected.1
            );
            return Err(wrong(problem.into()));
        }
        Ok(Arc::clone(label))
    }
}

/// The pixels of a label on the lattice, rounded to 16 bits.
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
