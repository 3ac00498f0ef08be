// Sums of the second pass over depth: squares and product of the deviations from the means.

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
    let mean_d = told[1];
    let mean_p = told[2];
    var dd = 0.0;
    var pp = 0.0;
    var dp = 0.0;
    for (var k = 0u; k < SPAN; k = k + 256u) {
        let pixel = group * SPAN + k + lane;
        if (pixel < view.pixels && says(depth[pixel], prior[pixel])) {
            let d = disparity(depth[pixel]) - mean_d;
            let p = prior[pixel] - mean_p;
            dd = dd + d * d;
            pp = pp + p * p;
            dp = dp + d * p;
        }
    }
    write_sums(group, lane, dd, pp, dp);
}
