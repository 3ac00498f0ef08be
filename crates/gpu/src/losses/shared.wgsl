// What all kernels of the losses share: the view's constants.

struct LossConstants {
    width: u32,
    height: u32,
    pixels: u32,
    // Row of the view in the gains.
    row: u32,
    // 1: a mask, 2: gains, 4: a depth prior that weighs something, 8: water.
    has: u32,
    // Levels of the structure measure; 0 where the image is too small for one.
    levels: u32,
    // Workgroups of a plane in `weigh`, `pull` and the passes over depth.
    groups: u32,
    views: u32,
    // Slopes: of the absolute difference, of the structure, of the depth's loss; the last is spare.
    slopes: vec4<f32>,
    // Weights of the values in the total, as the plan has them.
    weights: vec4<f32>,
    // Per level: its weight, one over its positions, its weight over three times its positions.
    level_weight: vec4<f32>,
    level_mean: vec4<f32>,
    level_slope: vec4<f32>,
    // Per level: workgroups of a channel, and the first of its sums.
    level_groups: vec4<u32>,
    level_first: vec4<u32>,
    // The window, eleven taps.
    taps: array<vec4<f32>, 3>,
    // Adam on the gains: step size, one over the root of the second correction, pull towards one, whether
    // they move.
    gains: vec4<f32>,
    // The step modulo 2^32, and the place of its report.
    step: u32,
    report: u32,
    spare0: u32,
    spare1: u32,
}

const HAS_MASK: u32 = 1u;
const HAS_GAINS: u32 = 2u;
const HAS_PRIOR: u32 = 4u;
const HAS_WATER: u32 = 8u;
// Elements of a plane that one workgroup owns.
const SPAN: u32 = 1024u;

// Which of a plane's workgroups this is, and the channel; past the last channel there is nothing to do.
struct Place {
    group: u32,
    channel: u32,
}

fn place_of(group: u32) -> Place {
    return Place(group % view.groups, group / view.groups);
}

// Runs of `sums`, one number per channel and workgroup each: |W (Î − I)|, the squared error, the squared
// mask, Ĩ ∂L/∂Ĩ.
fn run_of(quantity: u32) -> u32 {
    return 3u * quantity * view.groups;
}
