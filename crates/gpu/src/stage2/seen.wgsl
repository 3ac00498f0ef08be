// One workgroup per tile, one thread per entry: 1 if the entry's contour contains a pixel whose composing has
// not stopped before this entry. The compositor skips all other entries anyway. The contour gets a small
// margin, so that an entry is kept even if the compositor's test rounds in another way.
const MARGIN: f32 = 1e-3f;

var<workgroup> ends: array<u32, 256>;

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let tile = group_of(wid, nwg);
    if (tile >= constants.size.z * constants.size.w) { return; }
    let left = (tile % constants.size.z) * TILE;
    let top = (tile / constants.size.z) * TILE;
    let columns = min(TILE, constants.size.x - left);
    let rows = min(TILE, constants.size.y - top);
    let stops = KEPT_STOP * constants.size.x * constants.size.y;
    for (var p = lid; p < PIXELS; p += WG) {
        let column = p % TILE;
        let row = p / TILE;
        if (column < columns && row < rows) { ends[p] = kept[stops + (top + row) * constants.size.x + left + column]; }
    }
    workgroupBarrier();
    let first = starts[tile];
    let count = starts[tile + 1u] - first;
    for (var k = lid; k < count; k += WG) {
        let i = owners[lists[first + k]];
        let a = splats[3u * i];
        let b = splats[3u * i + 1u];
        var sees = 0u;
        for (var row = 0u; row < rows && sees == 0u; row++) {
            let dy = axes[constants.size.z * TILE + top + row] - a.y;
            let peak = fma(b.x, -(dy * dy), b.y);
            if (peak < -LOG2_255 - MARGIN) { continue; }
            for (var column = 0u; column < columns; column++) {
                let t = axes[left + column] - fma(a.z, -dy, a.x);
                // The Gaussian that stops a pixel counts as seen by it.
                if (fma(t * a.w, -t, peak) >= -LOG2_255 - MARGIN && ends[row * TILE + column] >= k) { sees = 1u; }
            }
        }
        seen[first + k] = sees;
    }
}
