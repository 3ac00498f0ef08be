// One workgroup: the first entry of every block, and the number of all entries. If there is no room for them,
// the number is set to 0 and all following steps stop.
@compute @workgroup_size(WG)
fn main(@builtin(local_invocation_index) lid: u32) {
    let n = constants.counts.x;
    let blocks = (n + ITEMS * WG - 1u) / (ITEMS * WG);
    var carry = 0u;
    for (var first = 0u; first < blocks; first += WG) {
        let block = first + lid;
        var count = 0u;
        if (block < blocks) { count = partial[block]; }
        let sums = exclusive(lid, count);
        if (block < blocks) { partial[block] = carry + sums.x; }
        carry += sums.y;
    }
    if (lid != 0u) { return; }
    counts[MOST] = max(counts[MOST], carry);
    if (carry <= constants.counts.z) {
        counts[ENTRIES] = carry;
        return;
    }
    counts[ENTRIES] = 0u;
    if (counts[STOP] == 0u) {
        counts[STOP] = OVERFLOW;
        counts[STOP_STEP] = constants.counts.w;
    }
}
