// Shared by all kernels of the losses: the view's constants.

struct LossConstants {
    width: u32,
    height: u32,
    pixels: u32,
    // Row of the view in the array of gains.
    row: u32,
    // Sum of flags. 1: a mask, 2: gains, 4: a depth prior with a weight other than 0.
    has: u32,
    // Number of levels of the structure measure; 0 if the image is too small for one.
    levels: u32,
    // Number of workgroups per plane in `weigh`, `pull` and the passes over depth.
    groups: u32,
    views: u32,
    // Factors of the gradients of the absolute difference, the structure measure and the depth loss; one
    // spare.
    slopes: vec4<f32>,
    // Weights of the loss terms in the total, as in the plan.
    weights: vec4<f32>,
    // Per level: its weight, 1 / positions, and weight / (3 × positions).
    level_weight: vec4<f32>,
    level_mean: vec4<f32>,
    level_slope: vec4<f32>,
    // Per level: number of workgroups per channel, and index of the first sum.
    level_groups: vec4<u32>,
    level_first: vec4<u32>,
    // Adam on the gains: step size, 1 / √(second bias correction), weight of the pull towards gain 1; one
    // spare.
    gains: vec4<f32>,
    // The step modulo 2^32, and the index of its report.
    step: u32,
    report: u32,
    spare0: u32,
    spare1: u32,
}

const HAS_MASK: u32 = 1u;
const HAS_GAINS: u32 = 2u;
const HAS_PRIOR: u32 = 4u;
// Number of elements of a plane that one workgroup owns.
const SPAN: u32 = 1024u;

// A workgroup's index within its plane, and its channel. A workgroup past the last channel has no work.
struct Place {
    group: u32,
    channel: u32,
}

fn place_of(group: u32) -> Place {
    return Place(group % view.groups, group / view.groups);
}

// First index of a quantity in `sums`, which has one number per channel and workgroup. The quantities are 0:
// |W (Î − I)|, 1: the squared error, 2: the squared mask, 3: Ĩ ∂L/∂Ĩ.
fn run_of(quantity: u32) -> u32 {
    return 3u * quantity * view.groups;
}
