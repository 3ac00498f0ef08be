// Computes the means that the second pass over depth subtracts. One workgroup.

@compute @workgroup_size(WG)
fn main(@builtin(local_invocation_index) lane: u32) {
    let n = total_of(0u, view.groups, lane);
    let d = total_of(view.groups, view.groups, lane);
    let p = total_of(2u * view.groups, view.groups, lane);
    if (lane == 0u) {
        told[0] = n;
        told[1] = d / max(n, 1.0);
        told[2] = p / max(n, 1.0);
    }
}
