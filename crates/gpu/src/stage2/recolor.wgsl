// One thread per listed Gaussian: writes its enhanced colour, exp(a) (c + A c + b_g) + b, into its splat.
@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let i = group_of(wid, nwg) * WG + lid;
    if (i >= field.listed) { return; }
    let graded = graded_of(base[i].xyz);
    var color = vec3<f32>();
    for (var o = 0u; o < 3u; o++) {
        let gain = exp(raw[OUTPUTS * i + o] - grade[o]);
        color[o] = fma(gain, graded[o], raw[OUTPUTS * i + 3u + o] - grade[3u + o]);
    }
    splats[3u * i + 2u] = vec4<f32>(color, 1.0f);
}
