// One thread per Gaussian: its values, up to three, replace its colour.
@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let i = group_of(wid, nwg) * WG + lid;
    if (i >= constants.counts.x) { return; }
    var value = vec3<f32>();
    for (var c = 0u; c < part.x; c++) { value[c] = values[part.x * i + c]; }
    splats[3u * i + 2u] = vec4<f32>(value, splats[3u * i + 2u].w);
}
