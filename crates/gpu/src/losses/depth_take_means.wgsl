// Computes the means that the second pass over depth subtracts. One workgroup.

@compute @workgroup_size(WG)
fn main(@builtin(local_invocation_index) lane: u32) {
    let all = totals_of(0u, view.groups, view.groups, lane);
    if (lane == 0u) {
        told[0] = all.x;
        told[1] = all.y / max(all.x, 1.0);
        told[2] = all.z / max(all.x, 1.0);
    }
}
