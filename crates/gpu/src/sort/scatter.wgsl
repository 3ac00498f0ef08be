// Moves the items of a block to their places. A block is read in rows of WG items, one item per thread. In a
// row, an item comes after the items with the same digit in lower threads. Each thread sets its bit in the
// digit's mask, and counts the bits below its own.
const WORDS: u32 = WG / 32u;

// The masks of all digits, one word after another, so that neighbouring digits lie in neighbouring banks.
var<workgroup> masks: array<atomic<u32>, DIGITS * WORDS>;
var<workgroup> places: array<u32, 256>;

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let block = group_of(wid, nwg);
    let n = item_count();
    let before = exclusive(lid, totals[lid]).x;
    places[lid] = 0u;
    if (block < order.blocks) { places[lid] = before + table[lid * order.blocks + block]; }
    for (var w = 0u; w < WORDS; w++) { atomicStore(&masks[w * DIGITS + lid], 0u); }
    for (var k = 0u; k < ITEMS; k++) {
        let i = (block * ITEMS + k) * WG + lid;
        var key = 0u;
        var digit = 0u;
        if (i < n) {
            key = keys[i];
            digit = digit_of(key);
        }
        workgroupBarrier();
        if (i < n) { atomicOr(&masks[lid / 32u * DIGITS + digit], 1u << (lid % 32u)); }
        workgroupBarrier();
        if (i < n) {
            var rank = 0u;
            for (var w = 0u; w < lid / 32u; w++) { rank += countOneBits(atomicLoad(&masks[w * DIGITS + digit])); }
            let below = (1u << (lid % 32u)) - 1u;
            rank += countOneBits(atomicLoad(&masks[lid / 32u * DIGITS + digit]) & below);
            let at = places[digit] + rank;
            sorted_keys[at] = key;
            if (IDENTITY) { sorted_values[at] = i; } else { sorted_values[at] = values[i]; }
        }
        workgroupBarrier();
        var found = 0u;
        for (var w = 0u; w < WORDS; w++) {
            found += countOneBits(atomicLoad(&masks[w * DIGITS + lid]));
            atomicStore(&masks[w * DIGITS + lid], 0u);
        }
        places[lid] += found;
    }
}
