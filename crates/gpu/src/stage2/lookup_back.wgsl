// One thread per lookup: from the gradients with respect to its outputs it computes those with respect to its
// code and the guide. A lookup that defines the mean first subtracts the mean's gradient. The code and its
// gradient are stored for the kernels that add up the gradients of the parameters.
@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let group = group_of(wid, nwg);
    let i = group * WG + lid;
    var by_guide = vec4<f32>();
    if (i < field.lookups) {
        var by_gain = vec3<f32>();
        var by_bias = vec3<f32>();
        for (var o = 0u; o < 3u; o++) {
            by_gain[o] = slopes[OUTPUTS * i + o];
            by_bias[o] = slopes[OUTPUTS * i + 3u + o];
            if (i < field.centred) {
                by_gain[o] -= totals[o] / f32(field.centred);
                by_bias[o] -= totals[3u + o] / f32(field.centred);
            }
            slopes[OUTPUTS * i + o] = by_gain[o];
            slopes[OUTPUTS * i + 3u + o] = by_bias[o];
        }
        let gamma = gamma_of(i);
        let places = places_of(i, gamma);
        var z: array<f32, RANK>;
        var by_z: array<f32, RANK>;
        for (var r = 0u; r < RANK; r++) {
            z[r] = factor(0u, places[0], r) * factor(1u, places[1], r) * factor(2u, places[2], r) * factor(3u, places[3], r);
            by_z[r] = 0.0f;
        }
        for (var unit = 0u; unit < field.width; unit++) {
            let pre = activation(unit, &z);
            let s = logistic(pre);
            let by_hidden = dot(by_gain, gain_weights(unit)) + dot(by_bias, bias_weights(unit));
            let by_pre = by_hidden * s * fma(pre, 1.0f - s, 1.0f);
            let at = field.hidden_weight + unit * RANK;
            for (var r = 0u; r < RANK; r++) { by_z[r] = fma(by_pre, state[at + r], by_z[r]); }
        }
        var rise = 0.0f;
        for (var r = 0u; r < RANK; r++) {
            codes[RANK * i + r] = z[r];
            by_codes[RANK * i + r] = by_z[r];
            let others = factor(0u, places[0], r) * factor(1u, places[1], r) * factor(2u, places[2], r);
            let at = (3u * field.resolution + places[3].node) * RANK + r;
            rise += by_z[r] * others * (state[at + RANK] - state[at]);
        }
        if (!is_fixed(i)) {
            let d = rise * (0.5f * f32(field.resolution - 1u)) * (1.0f - gamma * gamma);
            by_guide = d * vec4<f32>(bitcast<vec3<f32>>(sites[2u * i + 1u].xyz), 1.0f);
        }
    }
    let sum = sum_of_rows(by_guide, lid);
    if (lid == 0u && group < field.lookup_groups) {
        for (var k = 0u; k < 4u; k++) { partial[4u * group + k] = sum[k]; }
    }
}
