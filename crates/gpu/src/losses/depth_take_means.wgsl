// The means that the second pass over depth is around. One workgroup.

fn total_of(quantity: u32, lane: u32) -> f32 {
    var own = 0.0;
    for (var group = lane; group < view.groups; group = group + 256u) {
        own = own + sums[quantity * view.groups + group];
    }
    return sum_of_group(own, lane);
}

@compute @workgroup_size(WG)
fn main(@builtin(local_invocation_index) lane: u32) {
    let n = total_of(0u, lane);
    let d = total_of(1u, lane);
    let p = total_of(2u, lane);
    if (lane == 0u) {
        told[0] = n;
        told[1] = d / max(n, 1.0);
        told[2] = p / max(n, 1.0);
    }
}
