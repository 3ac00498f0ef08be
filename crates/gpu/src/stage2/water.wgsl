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
    let graded = graded_of(three_at(COLOR, p));
    let seen = table_at(guide_of(three_at(LOGS, p)));
    for (var c = 0u; c < 3u; c++) {
        let at = c * n + p;
        enhanced[at] = fma(seen.gain[c], graded[c], seen.bias[c]);
        let backscatter = BACKSCATTER * n + at;
        enhanced[backscatter] = water[backscatter] * grade[GRADE_RATIOS];
        let attenuation = ATTENUATION * n + at;
        enhanced[attenuation] = water[attenuation] * grade[GRADE_RATIOS + 1u];
    }
}
