// First entry of every Gaussian, by its rank in the order of depth (`offsets`), and by its index (`runs`).
@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let block = group_of(wid, nwg);
    let n = constants.counts.x;
    let nothing = counts[ENTRIES] == 0u;
    var carry = 0u;
    if (block * ITEMS * WG < n) { carry = partial[block]; }
    for (var k = 0u; k < ITEMS; k++) {
        let rank = (block * ITEMS + k) * WG + lid;
        var gaussian = 0u;
        var count = 0u;
        if (rank < n) {
            gaussian = order[rank];
            if (!nothing) { count = tiles[gaussian]; }
        }
        let sums = exclusive(lid, count);
        if (rank < n) {
            offsets[rank] = carry + sums.x;
            runs[gaussian] = vec2<u32>(carry + sums.x, count);
        }
        carry += sums.y;
    }
}
