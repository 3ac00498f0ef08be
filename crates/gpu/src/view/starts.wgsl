// One thread per tile, and one more: the index of the first entry of its list.
@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let tile = group_of(wid, nwg) * WG + lid;
    if (tile > constants.size.z * constants.size.w) { return; }
    var a = 0u;
    var b = counts[ENTRIES];
    while (a < b) {
        let middle = (a + b) / 2u;
        if (keys[middle] < tile) { a = middle + 1u; } else { b = middle; }
    }
    starts[tile] = a;
}
