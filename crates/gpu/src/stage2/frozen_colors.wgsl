// One thread per entry: the gradient of the loss with respect to its Gaussian's colour, summed over the
// pixels of the entry in their order.
@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let entry = group_of(wid, nwg) * WG + lid;
    if (entry >= sizes.y) { return; }
    let plane = sizes.x;
    let z = splats[3u * owners[entry] + 1u].z;
    var sum = vec3<f32>();
    let end = firsts[entry + 1u];
    for (var k = firsts[entry]; k < end; k++) {
        let pair = pairs[k];
        let at = pair.x;
        let w = bitcast<f32>(pair.y);
        var by_color = vec3<f32>(image_pull[at], image_pull[plane + at], image_pull[2u * plane + at]);
        if (WATER) {
            let first = K_ATTENUATION * plane + at;
            let ka = vec3<f32>(water[first], water[first + plane], water[first + 2u * plane]);
            by_color *= exp2(-(ka * z));
        }
        sum = fma(vec3<f32>(w), by_color, sum);
    }
    records[entry] = vec4<f32>(sum, 0.0f);
}
