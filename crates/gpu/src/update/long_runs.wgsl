// One thread per entry. Sums the records of a Gaussian with more than one block of entries, block by block,
// so that no thread of the update adds thousands of records one after another. The thread of the first entry
// of a block sums it, and stores the sum in that entry's record.
@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let entry = group_of(wid, nwg) * WG + lid;
    if (entry >= counts[ENTRIES]) { return; }
    let run = runs[owners[entry]];
    let place = entry - run.x;
    if (run.y <= BLOCK || place % BLOCK != 0u) { return; }
    let end = min(run.y, place + BLOCK);
    var part = array<vec4<f32>, 3>();
    for (var k = place; k < end; k++) {
        let at = 3u * (run.x + k);
        part[0] += records[at];
        part[1] += records[at + 1u];
        part[2] += records[at + 2u];
    }
    for (var r = 0u; r < 3u; r++) { records[3u * entry + r] = part[r]; }
}
