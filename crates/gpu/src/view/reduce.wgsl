// Number of entries of each block of Gaussians, in the order of depth.
@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let block = group_of(wid, nwg);
    let n = constants.counts.x;
    var sum = 0u;
    for (var k = 0u; k < ITEMS; k++) {
        let rank = (block * ITEMS + k) * WG + lid;
        if (rank < n) { sum += tiles[order[rank]]; }
    }
    let sums = exclusive(lid, sum);
    if (lid == 0u && block * ITEMS * WG < n) { partial[block] = sums.y; }
}
