//! The loss of stage 1 on the device: the values and gradients of the processor's table of terms.
//!
//! ```text
//! weigh ─▶ pool ─▶ pool ─▶ compare × levels ─▶ weigh_levels ─▶ blur_back × levels ─▶ pull ─▶ tell
//! depth_means ─▶ depth_take_means ─▶ depth_deviations ─▶ depth_correlate ─▶ depth_slopes ──────▲
//! ```
//!
//! The formulas are those of `use3d_reconstruct::losses` and `use3d_metrics::ms_ssim`, including the images
//! *minus one* for which f32 is enough. Sums run through trees whose form follows from the image's size
//! alone. [`VALUES`] are the terms' values for which there are kernels; a plan with a weight for another
//! one is refused.

mod shape;
#[cfg(test)]
mod tests;

use use3d_metrics::ms_ssim::window;
use use3d_numerics::adam::Adam;
use use3d_reconstruct::ExposureStep;
use use3d_training::EngineError;

use crate::buffer::Array;
use crate::constants::counts;
use crate::device::{Gpu, NAME};
use crate::kernel::{Access, Binding, Constant, Kernel, SUM, Spec, bound, read, write};
use crate::per_view::PerView;
use shape::{HALVING, Halving, LEVEL, LEVELS, Level, LossConstants, ViewShape};

/// The values of stage 1's loss for which there are kernels, in the order of the table of terms.
pub const VALUES: [&str; 3] = ["reg_l1", "reg_ms_ssim", "depth_loss"];

/// Number of floats that the losses write to a step's report: total, the three [`VALUES`], mean squared
/// error, number of pixels that count.
pub(crate) const TOLD: usize = 6;

const WITH_MASK: u32 = 1;
const WITH_GAINS: u32 = 2;
const WITH_PRIOR: u32 = 4;

/// The input of a view's loss. Colour planes lie channel by channel.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LossInput<'a> {
    /// The rendered image, before the view's gain: 3 P.
    pub(crate) image: &'a Array<f32>,
    /// Expected depth: P.
    pub(crate) depth: &'a Array<f32>,
    /// The photograph: 3 P.
    pub(crate) photograph: &'a Array<f32>,
    /// The weights of its pixels: P.
    pub(crate) mask: Option<&'a Array<f32>>,
    /// The depth prior: P.
    pub(crate) prior: Option<&'a Array<f32>>,
}

/// The buffers for gradients and values.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LossOutput<'a> {
    /// Gradient with respect to the rendered image, before the view's gain: 3 P.
    pub(crate) image: &'a Array<f32>,
    /// Gradient with respect to depth: P, zeros if there is no prior.
    pub(crate) depth: &'a Array<f32>,
    /// Reports of steps, sixteen floats each; [`TOLD`] of them are written.
    pub(crate) reports: &'a Array<f32>,
    /// The run's counts, which contain the word that stops it.
    pub(crate) counts: &'a Array<u32>,
}

/// The settings of a step's loss.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct LossPlan {
    /// The step.
    pub(crate) step: u64,
    /// Index of the step's report.
    pub(crate) report: u32,
    /// Weights of [`VALUES`].
    pub(crate) weights: [f64; 3],
    /// The view's row in the gains, and the settings by which they are learnt; `None` if every gain is one.
    pub(crate) gains: Option<(usize, ExposureStep)>,
}

impl LossPlan {
    /// The weights of a plan, in the order of [`VALUES`]; returns an error if a value without a kernel has
    /// a weight.
    pub(crate) fn weights(given: &[f64]) -> Result<[f64; 3], EngineError> {
        let refused = |what: String| EngineError::Request { engine: NAME, what };
        let names: Vec<&str> = use3d_reconstruct::losses::names().collect();
        if given.len() != names.len() {
            let (found, expected) = (given.len(), names.len());
            return Err(refused(format!("the plan has {found} weights of the loss, expected {expected}")));
        }
        let mut weights = [0.0; 3];
        for (name, weight) in names.into_iter().zip(given) {
            match VALUES.iter().position(|value| *value == name) {
                Some(at) => weights[at] = *weight,
                None if *weight == 0.0 => {}
                None => {
                    let what = format!("there is no kernel for the loss `{name}`; use the engine cpu");
                    return Err(refused(what));
                }
            }
        }
        Ok(weights)
    }
}

/// The buffers of one level of the structure measure.
#[derive(Debug)]
struct LevelBuffers {
    level: Array<Level>,
    /// The sizes by which it is computed from the finer level; unused by the finest.
    halving: Array<Halving>,
    /// `W Î − 1` and `W I − 1`.
    x: Array<f32>,
    y: Array<f32>,
    by_mean: Array<f32>,
    by_square: Array<f32>,
    by_product: Array<f32>,
    /// Gradient with respect to `x`; for the finest level the caller owns the buffer.
    slope: Array<f32>,
}

/// The losses of views of one size, with their buffers.
#[derive(Debug)]
pub(crate) struct Losses {
    /// In the order of [`specs`].
    kernels: [Kernel; 13],
    view: Array<LossConstants>,
    levels: Vec<LevelBuffers>,
    sums: Array<f32>,
    level_sums: Array<f32>,
    factors: Array<f32>,
    depth_sums: Array<f32>,
    depth_told: Array<f32>,
    /// A buffer that is bound if a view has no mask, prior or gains.
    nothing: Array<f32>,
    shape: ViewShape,
}

const VIEW: Binding = (Access::Uniform, "view", "LossConstants");

fn spec(name: &'static str, bindings: &[Binding], parts: &[&'static str]) -> Spec {
    let mut all = vec![SUM, include_str!("sum_of_three.wgsl"), include_str!("shared.wgsl")];
    all.extend(parts);
    let mut constants = counts::constants();
    constants.extend([("BAD_GAINS", Constant::Count(1 << 6)), ("BAD_LOSS", Constant::Count(1 << 7))]);
    // The window is symmetric, so six of its eleven taps suffice.
    let taps = ["TAP0", "TAP1", "TAP2", "TAP3", "TAP4", "TAP5"];
    constants.extend(taps.into_iter().zip(window().map(Constant::Real)));
    Spec { name, threads: 256, bindings: bindings.to_vec(), constants, parts: all }
}

/// All kernels of the losses.
pub(crate) fn specs() -> [Spec; 13] {
    const STRUCTS: &str = include_str!("structs.wgsl");
    const LEVEL_TEXT: &str = include_str!("level.wgsl");
    const DEPTH: &str = include_str!("depth.wgsl");
    const GAIN: &str = include_str!("gain.wgsl");
    const MASK: &str = include_str!("mask.wgsl");
    const TOTAL_OF: &str = include_str!("total_of.wgsl");
    const WRITE_SUMS: &str = include_str!("write_sums.wgsl");
    [
        spec(
            "weigh",
            &[
                VIEW,
                read("rendered"),
                read("photograph"),
                read("mask"),
                read("gains"),
                write("weighed"),
                write("weighed_target"),
                write("sums"),
            ],
            &[GAIN, MASK, include_str!("weigh.wgsl")],
        ),
        spec(
            "pool",
            &[VIEW, HALVING, read("fine"), read("fine_target"), write("coarse"), write("coarse_target")],
            &[STRUCTS, include_str!("pool.wgsl")],
        ),
        spec(
            "compare",
            &[
                VIEW,
                LEVEL,
                read("x_plane"),
                read("y_plane"),
                write("by_mean"),
                write("by_square"),
                write("by_product"),
                write("sums"),
            ],
            &[STRUCTS, LEVEL_TEXT, include_str!("compare.wgsl")],
        ),
        spec(
            "weigh_levels",
            &[VIEW, read("sums"), write("factors")],
            &[TOTAL_OF, include_str!("weigh_levels.wgsl")],
        ),
        spec(
            "blur_back",
            &[
                VIEW,
                LEVEL,
                read("x_plane"),
                read("y_plane"),
                read("by_mean"),
                read("by_square"),
                read("by_product"),
                read("factors"),
                read("coarse"),
                write("slope"),
            ],
            &[STRUCTS, LEVEL_TEXT, include_str!("blur_back.wgsl")],
        ),
        spec(
            "pull",
            &[
                VIEW,
                read("rendered"),
                read("mask"),
                read("gains"),
                read("weighed"),
                read("weighed_target"),
                write("sums"),
                write("gradient"),
            ],
            &[GAIN, MASK, include_str!("pull.wgsl")],
        ),
        spec(
            "depth_means",
            &[VIEW, read("depth"), read("prior"), write("sums")],
            &[DEPTH, WRITE_SUMS, include_str!("depth_means.wgsl")],
        ),
        spec(
            "depth_take_means",
            &[VIEW, read("sums"), write("told")],
            &[DEPTH, TOTAL_OF, include_str!("depth_take_means.wgsl")],
        ),
        spec(
            "depth_deviations",
            &[VIEW, read("depth"), read("prior"), read("told"), write("sums")],
            &[DEPTH, WRITE_SUMS, include_str!("depth_deviations.wgsl")],
        ),
        spec(
            "depth_correlate",
            &[VIEW, read("sums"), write("told")],
            &[DEPTH, TOTAL_OF, include_str!("depth_correlate.wgsl")],
        ),
        spec(
            "depth_slopes",
            &[VIEW, read("depth"), read("prior"), read("told"), write("gradient")],
            &[DEPTH, include_str!("depth_slopes.wgsl")],
        ),
        spec(
            "tell",
            &[VIEW, read("sums"), read("factors"), read("depth_told"), write("told"), counts::SHARED],
            &[TOTAL_OF, include_str!("tell.wgsl")],
        ),
        spec(
            "gains",
            &[VIEW, read("sums"), write("gains"), counts::SHARED],
            &[TOTAL_OF, include_str!("gains.wgsl")],
        ),
    ]
}

impl LevelBuffers {
    fn new(gpu: &Gpu) -> Result<Self, EngineError> {
        let planes = |what| Array::new(gpu, what, 1);
        Ok(Self {
            level: Array::uniform(gpu, "a level")?,
            halving: Array::uniform(gpu, "a level's sizes")?,
            x: planes("a level's image")?,
            y: planes("a level's photograph")?,
            by_mean: planes("a level's slopes by means")?,
            by_square: planes("a level's slopes by squares")?,
            by_product: planes("a level's slopes by products")?,
            slope: planes("a level's slopes")?,
        })
    }
}

impl Losses {
    /// The losses without a size.
    pub(crate) fn new(gpu: &Gpu) -> Result<Self, EngineError> {
        Ok(Self {
            kernels: Kernel::all(gpu, &specs())?,
            view: Array::uniform(gpu, "a view's constants")?,
            levels: (0..LEVELS).map(|_| LevelBuffers::new(gpu)).collect::<Result<_, _>>()?,
            sums: Array::new(gpu, "sums of the loss", 1)?,
            level_sums: Array::new(gpu, "sums of the structure measure", 1)?,
            factors: Array::new(gpu, "factors of the levels", 10)?,
            depth_sums: Array::new(gpu, "sums over depth", 1)?,
            depth_told: Array::new(gpu, "the depth loss", 8)?,
            nothing: Array::new(gpu, "nothing", 4)?,
            shape: ViewShape::default(),
        })
    }

    /// Number of bytes on the device.
    pub(crate) fn memory(&self) -> usize {
        let levels = self
            .levels
            .iter()
            .flat_map(|l| [&l.x, &l.y, &l.by_mean, &l.by_square, &l.by_product, &l.slope].map(Array::size));
        levels.sum::<usize>() + self.sums.size() + self.level_sums.size() + self.depth_sums.size()
    }

    /// Makes room for views of this size.
    pub(crate) fn resize(&mut self, gpu: &Gpu, width: usize, height: usize) -> Result<(), EngineError> {
        let shape = ViewShape::of(width, height);
        if shape == self.shape {
            return Ok(());
        }
        self.shape = ViewShape::default();
        self.sums.grow(gpu, 12 * shape.groups)?;
        self.depth_sums.grow(gpu, 3 * shape.groups)?;
        self.level_sums.grow(gpu, 3 * shape.levels.iter().map(|level| level.groups).sum::<usize>())?;
        // The image itself is weighed in any case; its gradients are kept if it has a level of its own.
        let finest = 3 * width * height;
        self.levels[0].x.grow(gpu, finest)?;
        self.levels[0].y.grow(gpu, finest)?;
        for (at, (buffers, level)) in self.levels.iter_mut().zip(&shape.levels).enumerate() {
            let (pixels, valid) = (3 * level.width * level.height, 3 * level.valid());
            if at > 0 {
                buffers.x.grow(gpu, pixels)?;
                buffers.y.grow(gpu, pixels)?;
                buffers.slope.grow(gpu, pixels)?;
            }
            buffers.by_mean.grow(gpu, valid)?;
            buffers.by_square.grow(gpu, valid)?;
            buffers.by_product.grow(gpu, valid)?;
            buffers.level.write(gpu, 0, &[shape.level(at)]);
            buffers.halving.write(gpu, 0, &[shape.halving(at)]);
        }
        self.shape = shape;
        Ok(())
    }

    /// Writes the constants of a step. Called before its pass is submitted and after [`Losses::resize`].
    pub(crate) fn prepare(
        &mut self,
        gpu: &Gpu,
        plan: &LossPlan,
        seen: &LossInput<'_>,
        gains: Option<&mut PerView>,
    ) {
        let shape = &self.shape;
        let mut view = shape.view();
        let with_prior = seen.prior.is_some() && plan.weights[2] != 0.0;
        for (has, bit) in [(seen.mask.is_some(), WITH_MASK), (with_prior, WITH_PRIOR)] {
            view.has |= if has { bit } else { 0 };
        }
        if let (Some((row, step)), Some(gains)) = (plan.gains, gains)
            && row < gains.steps.len()
        {
            let count = &mut gains.steps[row];
            view.has |= WITH_GAINS;
            *count += 1;
            let adam = Adam::SPLATTING.scalars(*count, step.rate);
            view.row = row as u32;
            view.views = gains.steps.len() as u32;
            view.gains = [adam.step_size, adam.root, step.weight as f32, 0.0];
        }
        let count = 3.0 * (shape.width * shape.height) as f64;
        let [difference, structure, depth] = plan.weights;
        view.slopes = [(difference / count) as f32, -structure as f32, depth as f32, 0.0];
        view.weights = [difference as f32, structure as f32, depth as f32, 0.0];
        view.step = plan.step as u32;
        view.report = plan.report;
        self.view.write(gpu, 0, &[view]);
    }

    /// Records values and gradients of one view.
    pub(crate) fn record(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        seen: &LossInput<'_>,
        gains: Option<&PerView>,
        told: &LossOutput<'_>,
    ) {
        let (shape, view, k) = (&self.shape, &self.view, &self.kernels);
        let [weigh, pool, compare, weigh_levels, blur_back, pull, ..] = k;
        let [.., depth_means, depth_take_means, depth_deviations, depth_correlate, depth_slopes, tell, _] = k;
        let gains = gains.map_or(&self.nothing, |g| &g.state);
        let mask = seen.mask.unwrap_or(&self.nothing);
        let per_plane = 3 * shape.groups;
        let LevelBuffers { x, y, .. } = &self.levels[0];
        let buffers = bound![*view, *seen.image, *seen.photograph, *mask, *gains, *x, *y, self.sums];
        weigh.record_groups(pass, per_plane, buffers);
        let levels = &self.levels[..shape.levels.len()];
        for (pair, size) in levels.windows(2).zip(shape.levels.iter().skip(1)) {
            let [fine, coarse] = [&pair[0], &pair[1]];
            let buffers = bound![*view, coarse.halving, fine.x, fine.y, coarse.x, coarse.y];
            pool.record(pass, 3 * size.width * size.height, buffers);
        }
        for (buffers, level) in levels.iter().zip(&shape.levels) {
            let LevelBuffers { level: constants, x, y, by_mean, by_square, by_product, .. } = buffers;
            let to = bound![*view, *constants, *x, *y, *by_mean, *by_square, *by_product, self.level_sums];
            compare.record_groups(pass, 3 * level.groups, to);
        }
        weigh_levels.record_groups(pass, 1, bound![*view, self.level_sums, self.factors]);
        for (at, (buffers, level)) in levels.iter().zip(&shape.levels).enumerate().rev() {
            let LevelBuffers { level: constants, x, y, by_mean, by_square, by_product, slope, .. } = buffers;
            let slope = if at == 0 { told.image } else { slope };
            let coarse = levels.get(at + 1).map_or(&self.nothing, |coarse| &coarse.slope);
            let mut buffers = bound![*view, *constants, *x, *y, *by_mean, *by_square, *by_product];
            buffers.extend(bound![self.factors, *coarse, *slope]);
            blur_back.record_groups(pass, 3 * level.tiles(), buffers);
        }
        let buffers = bound![*view, *seen.image, *mask, *gains, *x, *y, self.sums, *told.image];
        pull.record_groups(pass, per_plane, buffers);
        let (depth, sums, found) = (seen.depth, &self.depth_sums, &self.depth_told);
        if let Some(prior) = seen.prior {
            depth_means.record_groups(pass, shape.groups, bound![*view, *depth, *prior, *sums]);
            depth_take_means.record_groups(pass, 1, bound![*view, *sums, *found]);
            depth_deviations.record_groups(pass, shape.groups, bound![*view, *depth, *prior, *found, *sums]);
            depth_correlate.record_groups(pass, 1, bound![*view, *sums, *found]);
        }
        let prior = seen.prior.unwrap_or(&self.nothing);
        depth_slopes.record_groups(pass, shape.groups, bound![*view, *depth, *prior, *found, *told.depth]);
        let buffers = bound![*view, self.sums, self.factors, *found, *told.reports, *told.counts];
        tell.record_groups(pass, 1, buffers);
    }

    /// Records the update of the view's gain, after [`Losses::record`].
    pub(crate) fn learn_gains(&self, pass: &mut wgpu::ComputePass<'_>, gains: &PerView, counts: &Array<u32>) {
        let [.., learn] = &self.kernels;
        learn.record_groups(pass, 1, bound![self.view, self.sums, gains.state, *counts]);
    }
}
