// Adam on the field. The state has three runs: values, first moments and second moments. A gradient that is
// not finite changes nothing.
const BETA1: f32 = 0.9f;
const BETA2: f32 = 0.999f;
const EPSILON: f32 = 1e-15f;

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let at = group_of(wid, nwg) * WG + lid;
    let n = field.parameters;
    if (at >= n || atomicLoad(&status[BAD_GRADIENT]) != NONE) { return; }
    let rate = select(field.adam.x, field.adam.y, at >= field.transport);
    let g = gradient[at];
    let m = BETA1 * state[n + at] + (1.0f - BETA1) * g;
    let v = BETA2 * state[2u * n + at] + (1.0f - BETA2) * g * g;
    let value = state[at] - rate * m / (sqrt(v) * field.adam.z + EPSILON);
    state[at] = value;
    state[n + at] = m;
    state[2u * n + at] = v;
    if (is_bad(value)) { atomicMin(&status[BAD_PARAMETER], at); }
}
