// Counts each digit in each block of items.
var<workgroup> bins: array<atomic<u32>, 256>;

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let block = group_of(wid, nwg);
    atomicStore(&bins[lid], 0u);
    workgroupBarrier();
    let n = item_count();
    for (var k = 0u; k < ITEMS; k++) {
        let i = (block * ITEMS + k) * WG + lid;
        if (i < n) { atomicAdd(&bins[digit_of(keys[i])], 1u); }
    }
    workgroupBarrier();
    if (block < order.blocks) { table[lid * order.blocks + block] = atomicLoad(&bins[lid]); }
}
