// One workgroup per tile, one thread per pixel: the weights of the Gaussians that contribute to the pixel,
// nearest first, by the operations of the forward pass. The first run counts them; the second writes them,
// each with the entry that it belongs to.
@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let tile = group_of(wid, nwg);
    if (tile >= constants.size.z * constants.size.w) { return; }
    let column = (tile % constants.size.z) * TILE + lid % TILE;
    let row = (tile / constants.size.z) * TILE + lid / TILE;
    if (column >= constants.size.x || row >= constants.size.y) { return; }
    let centre_x = axes[column];
    let centre_y = axes[constants.size.z * TILE + row];
    let pixel = row * constants.size.x + column;
    var at = 0u;
    if (WRITE) { at = firsts[pixel]; }
    let first = at;
    var transmittance = 1.0f;
    let end = starts[tile + 1u];
    for (var k = starts[tile]; k < end; k++) {
        let entry = lists[k];
        let i = owners[entry];
        let a = splats[3u * i];
        let b = splats[3u * i + 1u];
        let dy = centre_y - a.y;
        let t = centre_x - fma(a.z, -dy, a.x);
        let power = fma(t * a.w, -t, fma(b.x, -(dy * dy), b.y));
        if (!(power >= -LOG2_255)) { continue; }
        let alpha = min(exp2(power), ALPHA_MAX);
        let w = transmittance * alpha;
        let rest = transmittance * (1.0f - alpha);
        if (rest <= STOP_AT) { break; }
        transmittance = rest;
        if (WRITE) { pairs[at] = vec2<u32>(entry, bitcast<u32>(w)); }
        at += 1u;
    }
    if (!WRITE) { firsts[pixel] = at - first; }
}
