//! The DPT head of Depth Anything V2: it turns four levels of tokens into one map.
//!
//! Each level is projected and resized to 4, 2, 1 and ½ times the token grid, then mapped to the same number
//! of features. From coarse to fine: `x ← out_conv(resize(RCU₂(x + RCU₁(level))))`, with RCU(x) =
//! conv(ReLU(conv(ReLU(x)))) + x; every resize is bilinear with the corners aligned. Ranftl, Bochkovskiy,
//! Koltun, "Vision transformers for dense prediction", ICCV 2021.

use crate::engine::activation::{self, Activation};
use crate::engine::convolution::{BlockUpsampling, Convolution, Padding};
use crate::engine::planes::Planes;
use crate::engine::resample::{Rule, resize};
use crate::error::NetError;
use crate::weights::{Layers, Weights};

/// The head with its weights.
#[derive(Clone, Debug)]
pub(crate) struct DptHead {
    projects: Vec<Convolution>,
    upsample4: BlockUpsampling,
    upsample2: BlockUpsampling,
    halve: Convolution,
    levels: Vec<Convolution>,
    /// The fusions of the levels; `fusions[0]` is the finest.
    fusions: Vec<Fusion>,
    reduce: Convolution,
    output: [Convolution; 2],
}

#[derive(Clone, Debug)]
struct Fusion {
    /// Absent at the coarsest level, which has no coarser result to add.
    skip: Option<Residual>,
    refine: Residual,
    output: Convolution,
}

#[derive(Clone, Debug)]
struct Residual([Convolution; 2]);

impl DptHead {
    pub(crate) fn read(
        width: usize,
        features: usize,
        channels: [usize; 4],
        weights: &mut dyn Weights,
    ) -> Result<Self, NetError> {
        let mut projects = Vec::new();
        let mut levels = Vec::new();
        for (i, &c) in channels.iter().enumerate() {
            projects.push(weights.same_convolution(&format!("depth_head.projects.{i}"), [c, width], 1)?);
            let shape = [features, c, 3, 3];
            let values = weights.tensor(&format!("depth_head.scratch.layer{}_rn.weight", i + 1), &shape)?;
            levels.push(Convolution::new(shape, &values, None, 1, Padding::same(1)));
        }
        let mut upsampling = |i: usize, kernel: usize| -> Result<BlockUpsampling, NetError> {
            let (name, c) = (format!("depth_head.resize_layers.{i}"), channels[i]);
            let (values, bias) = weights.parameters(&name, &[c, c, kernel, kernel])?;
            Ok(BlockUpsampling::new(c, c, kernel, &values, &bias))
        };
        let (upsample4, upsample2) = (upsampling(0, 4)?, upsampling(1, 2)?);
        let coarse = channels[3];
        let shape = [coarse, coarse, 3, 3];
        let halve = weights.convolution("depth_head.resize_layers.3", shape, 2, Padding::same(1))?;
        let fusions =
            (1..=4).map(|level| Fusion::read(level, features, weights)).collect::<Result<_, _>>()?;
        let scratch = |part: &str| format!("depth_head.scratch.{part}");
        Ok(Self {
            projects,
            upsample4,
            upsample2,
            halve,
            levels,
            fusions,
            reduce: weights.same_convolution(&scratch("output_conv1"), [features / 2, features], 3)?,
            output: [
                weights.same_convolution(&scratch("output_conv2.0"), [32, features / 2], 3)?,
                weights.same_convolution(&scratch("output_conv2.2"), [1, 32], 1)?,
            ],
        })
    }

    /// `taken` are the four levels as `[width, rows, columns]`; the first is used at the finest resolution.
    pub(crate) fn forward(
        &self,
        taken: [Planes; 4],
        size: (usize, usize),
        probe: &mut dyn FnMut(&str, &Planes),
    ) -> Planes {
        let level = |i: usize, tokens: Planes| {
            let projected = self.projects[i].forward(&tokens, Activation::Identity);
            let resized = match i {
                0 => self.upsample4.forward(&projected),
                1 => self.upsample2.forward(&projected),
                2 => projected,
                _ => self.halve.forward(&projected, Activation::Identity),
            };
            self.levels[i].forward(&resized, Activation::Identity)
        };
        // The coarsest level comes first. Each result has the size of the next finer level; the finest result
        // has twice its own size.
        let [first, second, third, fourth] = taken;
        let [first, second, third, fourth] =
            [level(0, first), level(1, second), level(2, third), level(3, fourth)];
        let size_of = |planes: &Planes| (planes.height, planes.width);
        let target = size_of(&third);
        let x = self.fusions[3].forward(None, fourth, target);
        probe("refinenet4", &x);
        let target = size_of(&second);
        let x = self.fusions[2].forward(Some(x), third, target);
        let target = size_of(&first);
        let x = self.fusions[1].forward(Some(x), second, target);
        let target = (2 * first.height, 2 * first.width);
        let x = self.fusions[0].forward(Some(x), first, target);
        probe("refinenet1", &x);
        let x = self.reduce.forward(&x, Activation::Identity);
        probe("output_conv1", &x);
        let x = resize(&x, size.0, size.1, Rule::BilinearCorners);
        let x = self.output[0].forward(&x, Activation::Relu);
        self.output[1].forward(&x, Activation::Relu)
    }
}

impl Fusion {
    fn read(level: usize, features: usize, weights: &mut dyn Weights) -> Result<Self, NetError> {
        let name = |part: &str| format!("depth_head.scratch.refinenet{level}.{part}");
        let mut residual = |unit: usize| -> Result<Residual, NetError> {
            let mut conv = |i: usize| {
                weights.same_convolution(&name(&format!("resConfUnit{unit}.conv{i}")), [features; 2], 3)
            };
            Ok(Residual([conv(1)?, conv(2)?]))
        };
        Ok(Self {
            skip: if level == 4 { None } else { Some(residual(1)?) },
            refine: residual(2)?,
            output: weights.same_convolution(&name("out_conv"), [features; 2], 1)?,
        })
    }

    /// `coarser` is the result of the next coarser level, `here` is this level's map.
    fn forward(&self, coarser: Option<Planes>, here: Planes, target: (usize, usize)) -> Planes {
        let x = match (coarser, &self.skip) {
            (Some(mut x), Some(skip)) => {
                x.add(&skip.forward(here));
                x
            }
            _ => here,
        };
        let refined = self.refine.forward(x);
        self.output
            .forward(&resize(&refined, target.0, target.1, Rule::BilinearCorners), Activation::Identity)
    }
}

impl Residual {
    fn forward(&self, mut x: Planes) -> Planes {
        let mut positive = x.clone();
        activation::apply(Activation::Relu, &mut positive.data);
        let inner = self.0[0].forward(&positive, Activation::Relu);
        drop(positive);
        self.0[1].add_to(&inner, &mut x);
        x
    }
}
