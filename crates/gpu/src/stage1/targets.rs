//! Photographs on the device, at the sizes that steps ask for.

use std::collections::VecDeque;

use use3d_capture::{Camera, Map};
use use3d_reconstruct::{Target, TrainingView};
use use3d_training::EngineError;

use crate::buffer::Array;
use crate::device::Gpu;

/// Bytes of photographs kept on the device; the oldest make room for new ones.
const KEPT: usize = 3 << 29;

/// A view at the size of a step.
#[derive(Debug)]
pub(super) struct DeviceTarget {
    pub(super) camera: Camera,
    /// Colour planes.
    pub(super) photograph: Array<f32>,
    /// Its opacity; its transparent pixels take the water's colour in every step anew.
    pub(super) alpha: Option<Array<f32>>,
    pub(super) mask: Option<Array<f32>>,
    pub(super) prior: Option<Array<f32>>,
}

impl DeviceTarget {
    fn new(
        gpu: &Gpu,
        view: &TrainingView,
        divisor: usize,
        scratch: &mut Target,
    ) -> Result<Self, EngineError> {
        let camera = view.target(divisor, scratch);
        let map = |what, map: &Option<Map>| match map {
            Some(map) => Array::from(gpu, what, map.data()).map(Some),
            None => Ok(None),
        };
        Ok(Self {
            camera,
            photograph: Array::from(gpu, "photograph", scratch.image.data())?,
            alpha: map("opacity of a photograph", &scratch.alpha)?,
            mask: map("mask", &scratch.mask)?,
            prior: map("depth prior", &scratch.prior)?,
        })
    }

    fn size(&self) -> usize {
        let maps = [&self.alpha, &self.mask, &self.prior];
        self.photograph.size() + maps.into_iter().flatten().map(Array::size).sum::<usize>()
    }
}

/// Views with what of them is on the device.
#[derive(Debug, Default)]
pub(super) struct Targets {
    pub(super) views: Vec<TrainingView>,
    kept: VecDeque<((usize, usize), DeviceTarget)>,
    bytes: usize,
    scratch: Target,
}

impl Targets {
    /// Puts a view at a divisor on the device where it is not there yet; its place until the next call.
    pub(super) fn place(&mut self, gpu: &Gpu, view: usize, divisor: usize) -> Result<usize, EngineError> {
        if let Some(at) = self.kept.iter().position(|(key, _)| *key == (view, divisor)) {
            return Ok(at);
        }
        let target = DeviceTarget::new(gpu, &self.views[view], divisor, &mut self.scratch)?;
        self.bytes += target.size();
        while self.bytes > KEPT
            && let Some((_, old)) = self.kept.pop_front()
        {
            self.bytes -= old.size();
            gpu.forget_bindings();
        }
        self.kept.push_back(((view, divisor), target));
        Ok(self.kept.len() - 1)
    }

    /// A view that was placed.
    pub(super) fn at(&self, place: usize) -> &DeviceTarget {
        &self.kept[place].1
    }

    /// Bytes on the device.
    pub(super) fn size(&self) -> usize {
        self.bytes
    }
}
