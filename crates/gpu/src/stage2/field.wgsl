// The field: its sizes, the places of its parameter groups in the flat vector of parameters, and functions
// that several kernels use.
struct Field {
    // Nodes per axis, hidden units, listed Gaussians, and listed Gaussians that define the mean.
    resolution: u32,
    width: u32,
    listed: u32,
    centred: u32,
    // Lookups (the listed Gaussians, then the rows of the water's table), pixels, lookups per block, blocks.
    lookups: u32,
    pixels: u32,
    per_block: u32,
    blocks: u32,
    // First index of each parameter group that comes after the factors.
    hidden_weight: u32,
    hidden_bias: u32,
    output_weight: u32,
    output_bias: u32,
    guide: u32,
    affine: u32,
    transport: u32,
    parameters: u32,
    // Number of workgroups for the hidden units of a block, the nodes of a block, the lookups, and the
    // pixels.
    unit_groups: u32,
    node_groups: u32,
    lookup_groups: u32,
    water_groups: u32,
    // Adam: step size of the field, step size of the ratios, 1 / sqrt(1 - beta2^t), 0.
    adam: vec4<f32>,
}

const OUTPUTS: u32 = 6u;
// Number of rows in the water's guide table.
const TABLE: u32 = 16u;
// The largest log-ratio of the transport coefficients, ln 4.
const LOG_RATIO: f32 = 1.3862944f;
// Layout of `grade`: the mean at 0, the table at GRADE_TABLE, the two ratios at GRADE_RATIOS.
const GRADE_TABLE: u32 = 8u;
const GRADE_RATIOS: u32 = 104u;
// Layout of `totals`: the gradients of the listed colours at 0, of the water at OF_WATER, of the guide at
// OF_GUIDE.
const OF_WATER: u32 = 18u;
const OF_GUIDE: u32 = 132u;
// Layout of the water's sums: the table at 0, then the affine, the guide and the ratios; WATER_SUMS in all.
const WATER_AFFINE: u32 = 96u;
const WATER_GUIDE: u32 = 108u;
const WATER_RATIOS: u32 = 112u;
const WATER_SUMS: u32 = 114u;

// The hyperbolic tangent, accurate to its last digits. Near 0 it is a polynomial (Cephes), because a quotient
// of exponentials loses digits there by cancellation. Nothing overflows.
fn squash(x: f32) -> f32 {
    if (abs(x) < 0.625f) {
        let y = x * x;
        var p = fma(-5.70498872745e-3f, y, 2.06390887954e-2f);
        p = fma(p, y, -5.37397155531e-2f);
        p = fma(p, y, 1.33314422036e-1f);
        p = fma(p, y, -3.33332819422e-1f);
        return fma(p * y, x, x);
    }
    let t = 1.0f - 2.0f / (exp(2.0f * min(abs(x), 20.0f)) + 1.0f);
    return select(t, -t, x < 0.0f);
}

struct Place {
    node: u32,
    t: f32,
}

// The lower node of a coordinate in [-1, 1], and the fraction of the way to the next node.
fn locate(u: f32, nodes: u32) -> Place {
    let at = (u + 1.0f) * (0.5f * f32(nodes - 1u));
    let node = min(u32(max(at, 0.0f)), nodes - 2u);
    return Place(node, at - f32(node));
}
