// One workgroup per digit: for each block, the place of its items among all items with this digit.
@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let digit = group_of(wid, nwg);
    if (digit >= DIGITS) { return; }
    var carry = 0u;
    for (var first = 0u; first < order.blocks; first += WG) {
        let block = first + lid;
        var count = 0u;
        if (block < order.blocks) { count = table[digit * order.blocks + block]; }
        let sums = exclusive(lid, count);
        if (block < order.blocks) { table[digit * order.blocks + block] = carry + sums.x; }
        carry += sums.y;
    }
    if (lid == 0u) { totals[digit] = carry; }
}
