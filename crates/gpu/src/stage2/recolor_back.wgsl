// One thread per listed Gaussian: adds up the gradient with respect to its colour over its entries, in their
// order. From it follow the gradients with respect to its six outputs. Per workgroup: the sums of these six,
// and of the affine's gradients.
@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let group = group_of(wid, nwg);
    let i = group * WG + lid;
    var d = vec3<f32>();
    var by_gain = vec3<f32>();
    var through = vec3<f32>();
    var c = vec3<f32>();
    if (i < field.listed) {
        let run = runs[i];
        for (var k = 0u; k < run.y; k++) { d += records[run.x + k].xyz; }
        c = base[i].xyz;
        let graded = graded_of(c);
        for (var o = 0u; o < 3u; o++) {
            through[o] = d[o] * exp(raw[OUTPUTS * i + o] - grade[o]);
            by_gain[o] = through[o] * graded[o];
            slopes[OUTPUTS * i + o] = by_gain[o];
            slopes[OUTPUTS * i + 3u + o] = d[o];
        }
    }
    let gains = sum_of_rows(vec4<f32>(by_gain, 0.0f), lid);
    let biases = sum_of_rows(vec4<f32>(d, 0.0f), lid);
    let with_one = vec4<f32>(c, 1.0f);
    let red = sum_of_rows(through.x * with_one, lid);
    let green = sum_of_rows(through.y * with_one, lid);
    let blue = sum_of_rows(through.z * with_one, lid);
    if (lid != 0u || group * WG >= field.listed) { return; }
    let at = 18u * group;
    for (var o = 0u; o < 3u; o++) {
        partial[at + o] = gains[o];
        partial[at + 3u + o] = biases[o];
    }
    for (var k = 0u; k < 4u; k++) {
        partial[at + 6u + k] = red[k];
        partial[at + 10u + k] = green[k];
        partial[at + 14u + k] = blue[k];
    }
}
