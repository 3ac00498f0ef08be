// One workgroup per tile, one thread per Gaussian. Each thread walks over the tile's pixels, one step behind
// the thread before it. So every pixel meets its Gaussians from the farthest to the nearest, and every thread
// adds up the record of its own Gaussian. No sum leaves its thread, so the bits do not depend on how many
// threads run in step.
//
// During the walk only two numbers of a pixel change: the transmittance (`left`), and `-sum w v` over the
// Gaussians behind (`behind`).
var<workgroup> pull: array<vec4<f32>, 256>;
var<workgroup> veiled_pull: array<vec4<f32>, 256>;
var<workgroup> fog: array<vec4<f32>, 256>;
var<workgroup> fog_rest: array<vec2<f32>, 256>;
var<workgroup> left: array<f32, 256>;
var<workgroup> behind: array<f32, 256>;
var<workgroup> ends: array<u32, 256>;
var<workgroup> centres: array<f32, 32>;
var<workgroup> last: atomic<u32>;
var<workgroup> last_entry: u32;

// The three values of a section of the water.
fn water_at(section: u32, pixel: u32) -> vec3<f32> {
    let plane = constants.size.x * constants.size.y;
    let first = section * plane + pixel;
    return vec3<f32>(water[first], water[first + plane], water[first + 2u * plane]);
}

fn load(p: u32, tile: u32) {
    let column = (tile % constants.size.z) * TILE + p % TILE;
    let row = (tile / constants.size.z) * TILE + p / TILE;
    left[p] = 1.0f;
    behind[p] = 0.0f;
    ends[p] = 0u;
    if (column >= constants.size.x || row >= constants.size.y) { return; }
    let plane = constants.size.x * constants.size.y;
    let pixel = row * constants.size.x + column;
    let g = vec3<f32>(image_pull[pixel], image_pull[plane + pixel], image_pull[2u * plane + pixel]);
    let sum = bitcast<f32>(kept[pixel]);
    let by_depth = depth_pull[pixel] / max(sum, 1e-6f);
    var by_weight = 0.0f;
    if (sum > 1e-6f) { by_weight = -(by_depth * bitcast<f32>(kept[KEPT_DEPTH * plane + pixel])); }
    pull[p] = vec4<f32>(g, by_depth);
    var gc = vec3<f32>();
    if (WATER) {
        gc = -(g * water_at(0u, pixel));
        let kb = water_at(K_BACKSCATTER, pixel);
        fog[p] = vec4<f32>(water_at(K_ATTENUATION, pixel), kb.x);
        fog_rest[p] = kb.yz;
    }
    veiled_pull[p] = vec4<f32>(gc, by_weight);
    left[p] = bitcast<f32>(kept[KEPT_TRANSMITTANCE * plane + pixel]);
    let stop = kept[KEPT_STOP * plane + pixel];
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
    for (var k = end + lid; k < count; k += WG) {
        let entry = lists[first + k];
        for (var r = 0u; r < 3u; r++) { records[3u * entry + r] = vec4<f32>(); }
    }
    let s_gradient = f32(constants.flags.y);
    for (var base = 0u; base < end; base += WG) {
        let mine = base + lid < end;
        var k = 0u;
        var entry = 0u;
        var a = vec4<f32>();
        var b = vec4<f32>();
        var color = vec3<f32>();
        if (mine) {
            k = end - 1u - base - lid;
            entry = lists[first + k];
            let i = owners[entry];
            a = splats[3u * i];
            b = splats[3u * i + 1u];
            color = splats[3u * i + 2u].xyz;
        }
        let kappa = a.z * (a.w * (2.0f * LN_2));
        let inverse = b.x * (2.0f * LN_2);
        var r0 = vec4<f32>();
        var r1 = vec4<f32>();
        var r2 = vec4<f32>();
        let steps = PIXELS + min(WG, end - base) - 1u;
        for (var s = 0u; s < steps; s++) {
            let p = s - lid;
            if (mine && lid <= s && p < PIXELS) {
                let dy = centres[TILE + p / TILE] - a.y;
                let t = centres[p % TILE] - fma(a.z, -dy, a.x);
                let power = fma(t * a.w, -t, fma(b.x, -(dy * dy), b.y));
                if (power >= -LOG2_255 && ends[p] > k) {
                    let raw = exp2(power);
                    let alpha = min(raw, ALPHA_MAX);
                    let over = 1.0f / (1.0f - alpha);
                    let transmittance = left[p] * over;
                    left[p] = transmittance;
                    let w = transmittance * alpha;
                    let g = pull[p];
                    let gc = veiled_pull[p];
                    let z = b.z;
                    var v = fma(g.w, z, gc.w);
                    var slope = 0.0f;
                    var by_color = g.xyz;
                    if (WATER) {
                        let ka = fog[p].xyz;
                        let kb = vec3<f32>(fog[p].w, fog_rest[p]);
                        by_color = g.xyz * exp2(-(ka * z));
                        let colored = by_color * color;
                        let veiled = gc.xyz * exp2(-(kb * z));
                        v += colored.x + veiled.x;
                        v += colored.y + veiled.y;
                        v += colored.z + veiled.z;
                        slope = -(dot(ka, colored) + dot(kb, veiled)) * s_gradient;
                    } else {
                        v += dot(g.xyz, color);
                    }
                    slope = fma(g.w, LOG2_E, slope);
                    let wv = w * v;
                    var pulled = fma(alpha * over, behind[p], wv);
                    behind[p] -= wv;
                    if (!(raw <= ALPHA_MAX)) { pulled = 0.0f; }
                    let pt = pulled * t;
                    let py = pulled * dy;
                    r0 += vec4<f32>(pulled, pt, py, pt * t);
                    r1 += vec4<f32>(pt * dy, py * dy, w * slope, w * by_color.x);
                    r2 += vec4<f32>(w * by_color.yz, abs(pt), abs(pulled) * abs(fma(t, kappa, dy * inverse)));
                }
            }
            workgroupBarrier();
        }
        if (mine) {
            records[3u * entry] = r0;
            records[3u * entry + 1u] = r1;
            records[3u * entry + 2u] = r2;
        }
    }
}
