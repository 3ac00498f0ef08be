// One thread per entry: its Gaussian and its tile. The kernel that counted the tiles is compiled on its own,
// so its arithmetic may have counted more tiles than are found here. A surplus entry gets a tile after the
// last one, which is never drawn, and a gradient of zero.
@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let entry = group_of(wid, nwg) * WG + lid;
    if (entry >= counts[ENTRIES]) { return; }
    var a = 0u;
    var b = constants.counts.x;
    while (a < b) {
        let middle = (a + b) / 2u;
        if (offsets[middle] <= entry) { a = middle + 1u; } else { b = middle; }
    }
    let rank = a - 1u;
    let i = order[rank];
    var rest = entry - offsets[rank];
    let s0 = splats[3u * i];
    let s1 = splats[3u * i + 1u];
    let contour = Contour(s0.x, s0.y, s0.z, s0.w, s1.x, s1.y + LOG2_255, s1.w);
    let rows = rows_meeting(s0.y - s1.w, s0.y + s1.w);
    var tile = constants.size.z * constants.size.w;
    for (var row = rows.x; row < rows.y; row++) {
        let span = row_span(contour, row);
        let count = max(span.y, span.x) - span.x;
        if (rest < count) {
            tile = row * constants.size.z + span.x + rest;
            break;
        }
        rest -= count;
    }
    if (RECORDS && tile == constants.size.z * constants.size.w) {
        for (var k = 0u; k < 3u; k++) { records[3u * entry + k] = vec4<f32>(); }
    }
    keys[entry] = tile;
    owners[entry] = i;
}
