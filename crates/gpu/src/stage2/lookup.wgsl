// One thread per lookup: the raw outputs of the field there. Per workgroup: the sum of these over the lookups
// that define the mean.
@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let group = group_of(wid, nwg);
    let i = group * WG + lid;
    var gain = vec3<f32>();
    var bias = vec3<f32>();
    if (i < field.lookups) {
        let places = places_of(i, gamma_of(i));
        var z: array<f32, RANK>;
        for (var r = 0u; r < RANK; r++) {
            z[r] = factor(0u, places[0], r) * factor(1u, places[1], r) * factor(2u, places[2], r) * factor(3u, places[3], r);
        }
        let at = field.output_bias;
        gain = vec3<f32>(state[at], state[at + 1u], state[at + 2u]);
        bias = vec3<f32>(state[at + 3u], state[at + 4u], state[at + 5u]);
        for (var unit = 0u; unit < field.width; unit++) {
            let pre = activation(unit, &z);
            let hidden = pre * logistic(pre);
            gain = fma(vec3<f32>(hidden), gain_weights(unit), gain);
            bias = fma(vec3<f32>(hidden), bias_weights(unit), bias);
        }
        for (var o = 0u; o < 3u; o++) {
            raw[OUTPUTS * i + o] = gain[o];
            raw[OUTPUTS * i + 3u + o] = bias[o];
        }
    }
    if (i >= field.centred) {
        gain = vec3<f32>();
        bias = vec3<f32>();
    }
    let gains = sum_of_rows(vec4<f32>(gain, 0.0f), lid);
    let biases = sum_of_rows(vec4<f32>(bias, 0.0f), lid);
    if (lid == 0u && group < field.lookup_groups) {
        partial[2u * group] = gains;
        partial[2u * group + 1u] = biases;
    }
}
