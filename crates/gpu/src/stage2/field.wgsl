// The field: its sizes, the places of its groups in the flat vector of parameters, and functions that several
// kernels use.
struct Field {
    // Nodes per axis, hidden units, Gaussians listed, how many of them define the mean.
    resolution: u32,
    width: u32,
    listed: u32,
    centred: u32,
    // Lookups (the listed Gaussians, then the rows of the water's table), pixels, lookups of a block, blocks.
    lookups: u32,
    pixels: u32,
    per_block: u32,
    blocks: u32,
    // Where the groups begin that come after the factors.
    hidden_weight: u32,
    hidden_bias: u32,
    output_weight: u32,
    output_bias: u32,
    guide: u32,
    affine: u32,
    transport: u32,
    parameters: u32,
    // Workgroups: hidden units of a block, nodes of a block, lookups, pixels.
    unit_groups: u32,
    node_groups: u32,
    lookup_groups: u32,
    water_groups: u32,
    // Adam: step of the field, step of the ratios, 1 / sqrt(1 - beta2^t), 0.
    adam: vec4<f32>,
}

const OUTPUTS: u32 = 6u;
// Rows of the water's guide table.
const TABLE: u32 = 16u;
// The largest log-ratio of the transport coefficients, ln 4.
const LOG_RATIO: f32 = 1.3862944f;
// Where `grade` has the mean, the table, and the two ratios.
const GRADE_TABLE: u32 = 8u;
const GRADE_RATIOS: u32 = 104u;
// Where `totals` has the derivatives of the listed colours, of the water, of the guide.
const OF_WATER: u32 = 18u;
const OF_GUIDE: u32 = 132u;
// Of the water's: the affine, the guide, the ratios; the table comes first.
const WATER_AFFINE: u32 = 96u;
const WATER_GUIDE: u32 = 108u;
const WATER_RATIOS: u32 = 112u;
const WATER_SUMS: u32 = 114u;

// The hyperbolic tangent to its last digits: a polynomial (Cephes) where a quotient of exponentials would
// cancel. Nothing overflows.
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

// The lower node and the fraction towards the next of a coordinate in [-1, 1].
fn locate(u: f32, nodes: u32) -> Place {
    let at = (u + 1.0f) * (0.5f * f32(nodes - 1u));
    let node = min(u32(max(at, 0.0f)), nodes - 2u);
    return Place(node, at - f32(node));
}
