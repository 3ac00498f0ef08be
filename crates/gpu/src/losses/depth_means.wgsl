// Sums of the first pass over depth: count, disparities, priors.

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let group = group_of(wid, nwg);
    if (group >= view.groups) {
        return;
    }
    var n = 0.0;
    var d = 0.0;
    var p = 0.0;
    for (var k = 0u; k < SPAN; k = k + 256u) {
        let pixel = group * SPAN + k + lane;
        if (pixel < view.pixels && says(depth[pixel], prior[pixel])) {
            n = n + 1.0;
            d = d + disparity(depth[pixel]);
            p = p + prior[pixel];
        }
    }
    write_sums(group, lane, n, d, p);
}
