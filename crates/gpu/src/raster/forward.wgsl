// One workgroup per tile, one thread per pixel: composes the light of the tile's Gaussians, nearest first.
var<workgroup> near: array<vec4<f32>, 256>;
var<workgroup> far: array<vec4<f32>, 256>;
var<workgroup> tint: array<vec4<f32>, 256>;
var<workgroup> open: atomic<u32>;
var<workgroup> any_open: u32;

// Takes every second bit of eight, beginning with the lowest.
fn every_second_bit(bits: u32) -> u32 {
    return (bits & 1u) | ((bits >> 1u) & 2u) | ((bits >> 2u) & 4u) | ((bits >> 3u) & 8u);
}

fn keep(section: u32, pixel: u32, value: f32) {
    kept[section * constants.size.x * constants.size.y + pixel] = bitcast<u32>(value);
}

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let tile = group_of(wid, nwg);
    if (tile >= constants.size.z * constants.size.w) { return; }
    // Pixels are numbered along a Z-curve. So those of threads that run in step form a rectangle that is about
    // as wide as high, and fewer Gaussians concern only some of them.
    let column = (tile % constants.size.z) * TILE + every_second_bit(lid);
    let row = (tile / constants.size.z) * TILE + every_second_bit(lid >> 1u);
    let inside = column < constants.size.x && row < constants.size.y;
    let centre_x = axes[column];
    let centre_y = axes[constants.size.z * TILE + row];
    let plane = constants.size.x * constants.size.y;
    let pixel = row * constants.size.x + column;
    var ka = vec3<f32>();
    var kb = vec3<f32>();
    if (WATER && inside) {
        for (var c = 0u; c < 3u; c++) {
            ka[c] = water[(K_ATTENUATION + c) * plane + pixel];
            kb[c] = water[(K_BACKSCATTER + c) * plane + pixel];
        }
    }
    var transmittance = 1.0f;
    var object = vec3<f32>();
    var veil = vec3<f32>();
    var object_moment = vec3<f32>();
    var veil_moment = vec3<f32>();
    var clear = vec3<f32>();
    var last = 0.0f;
    var depth = 0.0f;
    var weight = 0.0f;
    var stop = NEVER;
    var live = inside;
    if (!inside) { stop = 0u; }

    let first = starts[tile];
    let end = starts[tile + 1u];
    for (var base = first; base < end; base += WG) {
        workgroupBarrier();
        if (lid == 0u) { atomicStore(&open, 0u); }
        if (base + lid < end) {
            let i = owners[lists[base + lid]];
            near[lid] = splats[3u * i];
            far[lid] = splats[3u * i + 1u];
            tint[lid] = splats[3u * i + 2u];
        }
        workgroupBarrier();
        if (live) { atomicOr(&open, 1u); }
        workgroupBarrier();
        if (lid == 0u) { any_open = atomicLoad(&open); }
        if (workgroupUniformLoad(&any_open) == 0u) { break; }
        let count = min(WG, end - base);
        // A pixel that has stopped still takes part in the barriers above.
        if (live) {
            for (var j = 0u; j < count; j++) {
                let a = near[j];
                let b = far[j];
                let dy = centre_y - a.y;
                let t = centre_x - fma(a.z, -dy, a.x);
                let power = fma(t * a.w, -t, fma(b.x, -(dy * dy), b.y));
                if (!(power >= -LOG2_255)) { continue; }
                let alpha = min(exp2(power), ALPHA_MAX);
                let w = transmittance * alpha;
                let rest = transmittance * (1.0f - alpha);
                if (rest <= STOP_AT) {
                    stop = base + j - first;
                    live = false;
                    break;
                }
                transmittance = rest;
                let z = b.z;
                depth = fma(w, z, depth);
                weight += w;
                let color = tint[j].xyz;
                if (LAYERS) {
                    clear = fma(vec3<f32>(w), color, clear);
                    last = z;
                }
                if (WATER) {
                    let seen = exp2(-(ka * z)) * color;
                    let veiled = exp2(-(kb * z));
                    object = fma(vec3<f32>(w), seen, object);
                    veil = fma(vec3<f32>(w), veiled, veil);
                    if (TRAIN) {
                        let wz = w * z;
                        object_moment = fma(vec3<f32>(wz), seen, object_moment);
                        veil_moment = fma(vec3<f32>(wz), veiled, veil_moment);
                    }
                } else {
                    object = fma(vec3<f32>(w), color, object);
                }
            }
        }
    }
    if (!inside) { return; }
    for (var c = 0u; c < 3u; c++) {
        let at = c * plane + pixel;
        if (WATER) {
            image[at] = fma(water[at], 1.0f - veil[c], object[c]);
            if (TRAIN) {
                keep(KEPT_FIRST + c, pixel, veil[c]);
                keep(KEPT_SECOND + c, pixel, object_moment[c]);
                keep(KEPT_THIRD + c, pixel, veil_moment[c]);
            }
            if (LAYERS) { keep(KEPT_THIRD + c, pixel, transmittance * water[at] * exp2(-(kb[c] * last))); }
        } else {
            image[at] = object[c];
            if (LAYERS) { keep(KEPT_THIRD + c, pixel, 0.0f); }
        }
        if (LAYERS) {
            keep(KEPT_FIRST + c, pixel, object[c]);
            keep(KEPT_SECOND + c, pixel, clear[c]);
        }
    }
    let mean_depth = depth / max(weight, 1e-6f);
    depths[pixel] = mean_depth;
    keep(0u, pixel, weight);
    if (TRAIN) {
        keep(KEPT_DEPTH, pixel, mean_depth);
        keep(KEPT_TRANSMITTANCE, pixel, transmittance);
        kept[KEPT_STOP * plane + pixel] = stop;
    }
}
