//! Sizes of a view and its levels, and their constants for the kernels.

use bytemuck::{Pod, Zeroable};
use use3d_metrics::ms_ssim::{RECONSTRUCTION_WEIGHTS, WINDOW, level_weights};

use crate::kernel::{Access, Binding};

/// Largest number of levels of the structure measure.
pub(super) const LEVELS: usize = RECONSTRUCTION_WEIGHTS.len();
/// Number of pixels by which the window shortens an image's sides.
const MARGIN: usize = WINDOW - 1;
/// Side of the part of a level that a workgroup owns.
const TILE: usize = 16;
/// Number of elements of a plane that a workgroup owns.
const SPAN: usize = 1024;

pub(super) const LEVEL: Binding = (Access::Uniform, "level", "Level");
pub(super) const HALVING: Binding = (Access::Uniform, "size", "Halving");

/// A view's constants, in the form that `shared.wgsl` reads.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct LossConstants {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) pixels: u32,
    pub(super) row: u32,
    pub(super) has: u32,
    pub(super) levels: u32,
    pub(super) groups: u32,
    pub(super) views: u32,
    pub(super) slopes: [f32; 4],
    pub(super) weights: [f32; 4],
    pub(super) level_weight: [f32; 4],
    pub(super) level_mean: [f32; 4],
    pub(super) level_slope: [f32; 4],
    pub(super) level_groups: [u32; 4],
    pub(super) level_first: [u32; 4],
    pub(super) gains: [f32; 4],
    pub(super) step: u32,
    pub(super) report: u32,
    pub(super) spare: [u32; 2],
}

/// A level's constants, in the form of `structs.wgsl`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Level {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) index: u32,
    pub(super) last: u32,
    pub(super) coarse_width: u32,
    pub(super) coarse_height: u32,
    pub(super) spare: [u32; 2],
}

/// Sizes of two neighbouring levels, in the form of `structs.wgsl`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Halving {
    pub(super) fine_width: u32,
    pub(super) fine_height: u32,
    pub(super) width: u32,
    pub(super) height: u32,
}

/// A level's size.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct LevelShape {
    pub(super) width: usize,
    pub(super) height: usize,
    weight: f64,
    /// Number of workgroups per channel in the forward pass.
    pub(super) groups: usize,
}

impl LevelShape {
    /// Number of window positions that lie completely within a channel.
    pub(super) fn valid(&self) -> usize {
        (self.width - MARGIN) * (self.height - MARGIN)
    }

    /// Number of workgroups per channel in the backward pass.
    pub(super) fn tiles(&self) -> usize {
        self.width.div_ceil(TILE) * self.height.div_ceil(TILE)
    }
}

/// The size of a view and of its levels.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct ViewShape {
    pub(super) width: usize,
    pub(super) height: usize,
    /// Number of workgroups for a plane if each owns 1024 pixels.
    pub(super) groups: usize,
    pub(super) levels: Vec<LevelShape>,
}

impl ViewShape {
    /// The shape of a view.
    pub(super) fn of(width: usize, height: usize) -> Self {
        let (mut w, mut h) = (width, height);
        let levels = level_weights(&RECONSTRUCTION_WEIGHTS, width, height)
            .into_iter()
            .map(|weight| {
                let groups = (w - MARGIN).div_ceil(TILE) * (h - MARGIN).div_ceil(TILE);
                let level = LevelShape { width: w, height: h, weight, groups };
                (w, h) = (w.div_ceil(2), h.div_ceil(2));
                level
            })
            .collect();
        Self { width, height, groups: (width * height).div_ceil(SPAN), levels }
    }

    /// The constants that follow from the size alone.
    pub(super) fn view(&self) -> LossConstants {
        let mut view = LossConstants {
            width: self.width as u32,
            height: self.height as u32,
            pixels: (self.width * self.height) as u32,
            levels: self.levels.len() as u32,
            groups: self.groups as u32,
            ..LossConstants::default()
        };
        let mut first = 0;
        for (l, level) in self.levels.iter().enumerate() {
            let places = level.valid() as f64;
            view.level_weight[l] = level.weight as f32;
            view.level_mean[l] = (1.0 / places) as f32;
            view.level_slope[l] = (level.weight / (3.0 * places)) as f32;
            view.level_groups[l] = level.groups as u32;
            view.level_first[l] = first;
            first += 3 * level.groups as u32;
        }
        view
    }

    /// A level's constants.
    pub(super) fn level(&self, at: usize) -> Level {
        let (own, coarse) = (&self.levels[at], self.levels.get(at + 1));
        Level {
            width: own.width as u32,
            height: own.height as u32,
            index: at as u32,
            last: u32::from(coarse.is_none()),
            coarse_width: coarse.map_or(0, |l| l.width as u32),
            coarse_height: coarse.map_or(0, |l| l.height as u32),
            spare: [0; 2],
        }
    }

    /// The sizes of a level and of the finer one.
    pub(super) fn halving(&self, at: usize) -> Halving {
        let (fine, own) = (&self.levels[at.saturating_sub(1)], &self.levels[at]);
        Halving {
            fine_width: fine.width as u32,
            fine_height: fine.height as u32,
            width: own.width as u32,
            height: own.height as u32,
        }
    }
}
