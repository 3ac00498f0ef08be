// One workgroup per tile, one thread per Gaussian: the gradient of the loss with respect to the Gaussian's
// colour, summed over the tile's pixels. Each thread walks over the pixels, one step behind the thread before
// it. A pixel meets its Gaussians from the nearest to the farthest, so its transmittance is that of the
// forward pass. No sum leaves its thread, so the bits do not depend on how many threads run in step.
var<workgroup> pull: array<vec4<f32>, 256>;
var<workgroup> fog: array<vec4<f32>, 256>;
var<workgroup> left: array<f32, 256>;
var<workgroup> ends: array<u32, 256>;
var<workgroup> centres: array<f32, 32>;
var<workgroup> last: atomic<u32>;
var<workgroup> last_entry: u32;

fn load(p: u32, tile: u32) {
    let column = (tile % constants.size.z) * TILE + p % TILE;
    let row = (tile / constants.size.z) * TILE + p / TILE;
    left[p] = 1.0f;
    ends[p] = 0u;
    if (column >= constants.size.x || row >= constants.size.y) { return; }
    let plane = constants.size.x * constants.size.y;
    let at = row * constants.size.x + column;
    pull[p] = vec4<f32>(image_pull[at], image_pull[plane + at], image_pull[2u * plane + at], 0.0f);
    if (WATER) {
        let k = K_ATTENUATION * plane + at;
        fog[p] = vec4<f32>(water[k], water[k + plane], water[k + 2u * plane], 0.0f);
    }
    let stop = kept[KEPT_STOP * plane + at];
    ends[p] = stop;
    atomicMax(&last, stop);
}

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let tile = group_of(wid, nwg);
    if (tile >= constants.size.z * constants.size.w) { return; }
    let first = starts[tile];
    let count = starts[tile + 1u] - first;
    if (count == 0u) { return; }
    if (lid == 0u) { atomicStore(&last, 0u); }
    workgroupBarrier();
    for (var p = lid; p < PIXELS; p += WG) { load(p, tile); }
    if (lid < TILE) {
        centres[lid] = axes[(tile % constants.size.z) * TILE + lid];
        centres[TILE + lid] = axes[(constants.size.z + tile / constants.size.z) * TILE + lid];
    }
    workgroupBarrier();
    if (lid == 0u) { last_entry = min(count, atomicLoad(&last)); }
    let end = workgroupUniformLoad(&last_entry);
    // Entries behind the last stop of all pixels have no effect, so their records are zero.
    for (var k = end + lid; k < count; k += WG) { records[lists[first + k]] = vec4<f32>(); }
    for (var base = 0u; base < end; base += WG) {
        let k = base + lid;
        let mine = k < end;
        var entry = 0u;
        var a = vec4<f32>();
        var b = vec4<f32>();
        if (mine) {
            entry = lists[first + k];
            let i = owners[entry];
            a = splats[3u * i];
            b = splats[3u * i + 1u];
        }
        var sum = vec3<f32>();
        let steps = PIXELS + min(WG, end - base) - 1u;
        for (var s = 0u; s < steps; s++) {
            let p = s - lid;
            if (mine && lid <= s && p < PIXELS) {
                let dy = centres[TILE + p / TILE] - a.y;
                let t = centres[p % TILE] - fma(a.z, -dy, a.x);
                let power = fma(t * a.w, -t, fma(b.x, -(dy * dy), b.y));
                if (power >= -LOG2_255 && ends[p] > k) {
                    let alpha = min(exp2(power), ALPHA_MAX);
                    let w = left[p] * alpha;
                    left[p] *= 1.0f - alpha;
                    var by_color = pull[p].xyz;
                    if (WATER) { by_color *= exp2(-(fog[p].xyz * b.z)); }
                    sum = fma(vec3<f32>(w), by_color, sum);
                }
            }
            workgroupBarrier();
        }
        if (mine) { records[entry] = vec4<f32>(sum, 0.0f); }
    }
}
