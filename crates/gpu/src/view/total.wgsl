// One workgroup: the first entry of every block, and the number of all entries. If there is no room for them,
// the number is set to 0 and all following steps stop. A number that 32 bits cannot hold counts as the
// largest number that they hold, so it never seems small: `high` sums the numbers without their last eight
// bits.
const FULL: u32 = 0xffffffffu;
// Below this the last eight bits of at most 65,536 blocks cannot reach 2^32.
const HIGHEST: u32 = 0x00ff0000u;

@compute @workgroup_size(WG)
fn main(@builtin(local_invocation_index) lid: u32) {
    let n = constants.counts.x;
    let blocks = (n + ITEMS * WG - 1u) / (ITEMS * WG);
    var carry = 0u;
    var high = 0u;
    for (var first = 0u; first < blocks; first += WG) {
        let block = first + lid;
        var count = 0u;
        if (block < blocks) { count = partial[block]; }
        let sums = exclusive(lid, count);
        if (block < blocks) { partial[block] = carry + sums.x; }
        carry += sums.y;
        let more = high + exclusive(lid, count >> 8u).y;
        high = select(more, FULL, more < high);
    }
    if (lid != 0u) { return; }
    if (high >= HIGHEST) { carry = FULL; }
    counts[MOST] = max(counts[MOST], carry);
    if (carry <= constants.counts.z && high < HIGHEST) {
        counts[ENTRIES] = carry;
        return;
    }
    counts[ENTRIES] = 0u;
    if (counts[STOP] == 0u) {
        counts[STOP] = OVERFLOW;
        counts[STOP_STEP] = constants.counts.w;
    }
}
