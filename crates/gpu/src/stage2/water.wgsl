// One thread per pixel: computes the enhanced water in front of it.
@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let p = group_of(wid, nwg) * WG + lid;
    let n = field.pixels;
    if (p >= n) { return; }
    let graded = graded_of(vec3<f32>(color[p], color[n + p], color[2u * n + p]));
    let seen = table_at(guide_of(vec3<f32>(logs[p], logs[n + p], logs[2u * n + p])));
    for (var c = 0u; c < 3u; c++) {
        let at = c * n + p;
        new_color[at] = fma(seen.gain[c], graded[c], seen.bias[c]);
        new_backscatter[at] = backscatter[at] * grade[GRADE_RATIOS];
        new_attenuation[at] = attenuation[at] * grade[GRADE_RATIOS + 1u];
    }
}
