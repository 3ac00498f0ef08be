// Adam on the water's parameters. The state has three runs: values, first moments and second moments. A value
// that is not finite sets a bit, and the kernel that ends the step then stops the run.

const BETA1: f32 = 0.9;
const BETA2: f32 = 0.999;
const EPSILON: f32 = 1e-15;

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let at = group_of(wid, nwg) * WG + lane;
    if (at >= water.parameters) {
        return;
    }
    let g = slope[at];
    slope[at] = 0.0;
    if (atomicLoad(&counts[STOP]) != 0u) {
        return;
    }
    let before_coefficients = 4u * water.anchors;
    // The constant band comes first in each quantity.
    var rate = water.adam.y;
    if (at >= before_coefficients && (at - before_coefficients) % 48u < 3u) {
        rate = water.adam.x;
    }
    let n = water.parameters;
    let m = BETA1 * state[n + at] + (1.0 - BETA1) * g;
    let v = BETA2 * state[2u * n + at] + (1.0 - BETA2) * g * g;
    let value = state[at] - rate * m / (sqrt(v) * water.adam.z + EPSILON);
    state[at] = value;
    state[n + at] = m;
    state[2u * n + at] = v;
    if (is_bad(value)) {
        atomicOr(&counts[BAD], BAD_WATER);
    }
}
