//! Photographs on the device, at the sizes that steps use.

use std::collections::VecDeque;

use use3d_capture::{Camera, Map};
use use3d_reconstruct::{Target, TrainingView};
use use3d_training::EngineError;

use super::stored::{Floats, StoredView, Unpacked};
use crate::buffer::Array;
use crate::device::Gpu;

/// A view at a smaller size: means, stored as floats.
#[derive(Debug)]
pub(super) struct Reduced {
    /// Colour planes.
    photograph: Array<f32>,
    alpha: Option<Array<f32>>,
    mask: Option<Array<f32>>,
    prior: Option<Array<f32>>,
}

/// The form of a view on the device.
#[derive(Debug)]
pub(super) enum Values {
    /// At full size, in the stored form.
    Stored(StoredView),
    /// At a smaller size.
    Reduced(Reduced),
}

/// A view at the size of a step.
#[derive(Debug)]
pub(super) struct DeviceTarget {
    pub(super) camera: Camera,
    pub(super) values: Values,
}

impl Reduced {
    fn new(gpu: &Gpu, target: &Target) -> Result<Self, EngineError> {
        let map = |what, map: &Option<Map>| match map {
            Some(map) => Array::from(gpu, what, map.data()).map(Some),
            None => Ok(None),
        };
        Ok(Self {
            photograph: Array::from(gpu, "photograph", target.image.data())?,
            alpha: map("opacity of a photograph", &target.alpha)?,
            mask: map("mask", &target.mask)?,
            prior: map("depth prior", &target.prior)?,
        })
    }

    fn size(&self) -> usize {
        let maps = [&self.alpha, &self.mask, &self.prior];
        self.photograph.size() + maps.into_iter().flatten().map(Array::size).sum::<usize>()
    }
}

impl DeviceTarget {
    fn new(
        gpu: &Gpu,
        view: &TrainingView,
        divisor: usize,
        scratch: &mut Target,
    ) -> Result<Self, EngineError> {
        let (camera, divisor) = view.camera_over(divisor);
        let values = if divisor == 1 {
            Values::Stored(StoredView::new(gpu, view)?)
        } else {
            view.target(divisor, scratch);
            Values::Reduced(Reduced::new(gpu, scratch)?)
        };
        Ok(Self { camera, values })
    }

    fn size(&self) -> usize {
        match &self.values {
            Values::Stored(view) => view.size(),
            Values::Reduced(view) => view.size(),
        }
    }

    /// Makes room for the results of [`DeviceTarget::record`].
    pub(super) fn prepare(&self, gpu: &Gpu, unpacked: &mut Unpacked) -> Result<(), EngineError> {
        match &self.values {
            Values::Stored(view) => unpacked.grow(gpu, view),
            // The water is put behind a copy of the photograph.
            Values::Reduced(Reduced { photograph, alpha: Some(_), .. }) => {
                unpacked.photograph.grow(gpu, photograph.capacity()).map(|_| ())
            }
            Values::Reduced(_) => Ok(()),
        }
    }

    /// Records the copies that are needed before a step's kernels.
    pub(super) fn copy(&self, encoder: &mut wgpu::CommandEncoder, unpacked: &Unpacked) {
        if let Values::Reduced(Reduced { photograph, alpha: Some(_), .. }) = &self.values {
            let from = photograph.raw();
            encoder.copy_buffer_to_buffer(from, 0, unpacked.photograph.raw(), 0, from.size());
        }
    }

    /// Records the computation of its floats if they are not stored.
    pub(super) fn record(&self, pass: &mut wgpu::ComputePass<'_>, unpacked: &Unpacked) {
        if let Values::Stored(view) = &self.values {
            unpacked.record(pass, view);
        }
    }

    /// The floats that kernels of the loss read of it, after [`DeviceTarget::record`]. A photograph with
    /// transparent pixels is copied in every step, so that the water can be put behind it.
    pub(super) fn floats<'a>(&'a self, unpacked: &'a Unpacked) -> Floats<'a> {
        match &self.values {
            Values::Stored(view) => unpacked.floats(view),
            Values::Reduced(Reduced { photograph, alpha, mask, prior }) => Floats {
                photograph: if alpha.is_some() { &unpacked.photograph } else { photograph },
                alpha: alpha.as_ref(),
                mask: mask.as_ref(),
                prior: prior.as_ref(),
            },
        }
    }
}

/// The views, and the targets on the device.
#[derive(Debug, Default)]
pub(super) struct Targets {
    pub(super) views: Vec<TrainingView>,
    kept: VecDeque<((usize, usize), DeviceTarget)>,
    bytes: usize,
    scratch: Target,
}

impl Targets {
    /// Puts a view at a divisor on the device if it is not there yet; returns its index, valid until the
    /// next call.
    pub(super) fn place(&mut self, gpu: &Gpu, view: usize, divisor: usize) -> Result<usize, EngineError> {
        if let Some(at) = self.kept.iter().position(|(key, _)| *key == (view, divisor)) {
            return Ok(at);
        }
        let target = DeviceTarget::new(gpu, &self.views[view], divisor, &mut self.scratch)?;
        self.bytes += target.size();
        // The oldest are dropped to make room for new ones.
        while self.bytes > gpu.view_bytes()
            && let Some((_, old)) = self.kept.pop_front()
        {
            self.bytes -= old.size();
            gpu.forget_bindings();
        }
        self.kept.push_back(((view, divisor), target));
        Ok(self.kept.len() - 1)
    }

    /// A target on the device.
    pub(super) fn at(&self, place: usize) -> &DeviceTarget {
        &self.kept[place].1
    }

    /// Number of bytes on the device.
    pub(super) fn size(&self) -> usize {
        self.bytes
    }
}
