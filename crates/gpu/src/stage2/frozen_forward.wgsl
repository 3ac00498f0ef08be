// One thread per pixel: composes the pixel from the weights of its Gaussians, which do not change. It
// computes what the forward pass computes, in the same order.
@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let pixel = group_of(wid, nwg) * WG + lid;
    let plane = sizes.x;
    if (pixel >= plane) { return; }
    var ka = vec3<f32>();
    var kb = vec3<f32>();
    if (WATER) {
        for (var c = 0u; c < 3u; c++) {
            ka[c] = water[(K_ATTENUATION + c) * plane + pixel];
            kb[c] = water[(K_BACKSCATTER + c) * plane + pixel];
        }
    }
    var object = vec3<f32>();
    var veil = vec3<f32>();
    var object_moment = vec3<f32>();
    var veil_moment = vec3<f32>();
    let end = firsts[pixel + 1u];
    for (var k = firsts[pixel]; k < end; k++) {
        let pair = pairs[k];
        let w = bitcast<f32>(pair.y);
        let color = splats[3u * pair.x + 2u].xyz;
        if (WATER) {
            let z = splats[3u * pair.x + 1u].z;
            let seen = exp2(-(ka * z)) * color;
            let veiled = exp2(-(kb * z));
            object = fma(vec3<f32>(w), seen, object);
            veil = fma(vec3<f32>(w), veiled, veil);
            let wz = w * z;
            object_moment = fma(vec3<f32>(wz), seen, object_moment);
            veil_moment = fma(vec3<f32>(wz), veiled, veil_moment);
        } else {
            object = fma(vec3<f32>(w), color, object);
        }
    }
    for (var c = 0u; c < 3u; c++) {
        let at = c * plane + pixel;
        if (WATER) {
            image[at] = fma(water[at], 1.0f - veil[c], object[c]);
            kept[(KEPT_FIRST + c) * plane + pixel] = bitcast<u32>(veil[c]);
            kept[(KEPT_SECOND + c) * plane + pixel] = bitcast<u32>(object_moment[c]);
            kept[(KEPT_THIRD + c) * plane + pixel] = bitcast<u32>(veil_moment[c]);
        } else {
            image[at] = object[c];
        }
    }
}
