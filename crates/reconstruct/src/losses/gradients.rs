//! Gradients of a view's loss with respect to its rendered rasters, summed over the terms.

use use3d_capture::{MediumMaps, Raster};

/// The gradient with respect to one raster; absent until a term adds one.
#[derive(Clone, Debug, Default)]
pub struct Slot<const C: usize> {
    sum: Raster<f32, C>,
    /// Buffer that a later term fills before it is added.
    own: Raster<f32, C>,
    given: bool,
}

impl<const C: usize> Slot<C> {
    /// Adds a term's gradient. `write` receives a raster of any size and contents, and must overwrite it
    /// with the gradient per pixel.
    pub fn add<R>(&mut self, write: impl FnOnce(&mut Raster<f32, C>) -> R) -> R {
        if !self.given {
            self.given = true;
            return write(&mut self.sum);
        }
        let result = write(&mut self.own);
        add(&mut self.sum, &self.own);
        result
    }

    /// The sum of the terms' gradients; `None` if no term added one.
    pub fn get(&self) -> Option<&Raster<f32, C>> {
        self.given.then_some(&self.sum)
    }

    /// The sum of the terms' gradients; zeros of this size if no term added one.
    pub(crate) fn or_zeros(&mut self, width: usize, height: usize) -> &mut Raster<f32, C> {
        if !self.given {
            self.given = true;
            self.sum.resize(width, height);
            self.sum.data_mut().fill(0.0);
        }
        &mut self.sum
    }
}

/// Gradients of the loss with respect to the rasters that a term may read.
#[derive(Clone, Debug, Default)]
pub struct ViewGradients {
    /// Gradient with respect to the image as it is [shown](super::Observation::image).
    pub image: Slot<3>,
    /// Gradient with respect to the clear image.
    pub clear: Slot<3>,
    /// Gradient with respect to expected depth.
    pub depth: Slot<1>,
    /// Gradient with respect to accumulation.
    pub accumulation: Slot<1>,
    /// Gradient with respect to the colour of infinitely deep water.
    pub water_color: Slot<3>,
    /// Gradient with respect to the backscatter coefficient.
    pub backscatter: Slot<3>,
    /// Gradient with respect to the attenuation coefficient.
    pub attenuation: Slot<3>,
    /// Gradient with respect to the log standard deviations of all Gaussians; empty until a term adds one.
    log_scales: Vec<[f32; 3]>,
}

impl ViewGradients {
    pub(crate) fn forget(&mut self) {
        let water = [&mut self.water_color, &mut self.backscatter, &mut self.attenuation];
        for slot in [&mut self.image, &mut self.clear].into_iter().chain(water) {
            slot.given = false;
        }
        for slot in [&mut self.depth, &mut self.accumulation] {
            slot.given = false;
        }
        self.log_scales.clear();
    }

    /// The gradient with respect to the log standard deviations of `n` Gaussians, to which a term adds.
    pub fn log_scales(&mut self, n: usize) -> &mut [[f32; 3]] {
        self.log_scales.resize(n, [0.0; 3]);
        &mut self.log_scales
    }

    /// Adds the terms' own gradients of the Gaussians' sizes.
    pub(crate) fn add_scales(&self, sum: &mut [[f32; 3]]) {
        for (sum, own) in sum.as_flattened_mut().iter_mut().zip(self.log_scales.as_flattened()) {
            *sum += own;
        }
    }

    /// Adds the terms' own gradients of the water's maps.
    pub(crate) fn add_water(&self, maps: &mut MediumMaps) {
        for (slot, sum) in [
            (&self.water_color, &mut maps.color),
            (&self.backscatter, &mut maps.backscatter),
            (&self.attenuation, &mut maps.attenuation),
        ] {
            if let Some(own) = slot.get() {
                add(sum, own);
            }
        }
    }
}

fn add<const C: usize>(sum: &mut Raster<f32, C>, own: &Raster<f32, C>) {
    assert_eq!((sum.width(), sum.height()), (own.width(), own.height()), "derivatives have the view's size");
    for (sum, own) in sum.data_mut().iter_mut().zip(own.data()) {
        *sum += own;
    }
}
