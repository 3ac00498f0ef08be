// Adds up the sums of all workgroups; one workgroup per coefficient.

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let coefficient = group_of(wid, nwg);
    if (coefficient >= COEFFICIENTS) {
        return;
    }
    var own = 0.0;
    for (var at = lane; at < water.groups; at = at + WG) {
        own = own + partial[coefficient * water.groups + at];
    }
    let sum = sum_of_group(own, lane);
    if (lane == 0u) {
        by_mixed[coefficient] = sum;
    }
}
