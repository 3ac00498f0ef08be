// Adds up the sums of all workgroups; one workgroup per coefficient.

@compute @workgroup_size(WG)
fn main(@builtin(workgroup_id) wid: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    var own = 0.0;
    for (var at = lane; at < water.groups; at = at + WG) {
        own = own + partial[wid.x * water.groups + at];
    }
    let sum = sum_of_group(own, lane);
    if (lane == 0u) {
        by_mixed[wid.x] = sum;
    }
}
