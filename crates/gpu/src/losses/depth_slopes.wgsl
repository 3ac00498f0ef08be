// The gradient of the depth loss with respect to depth.

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let group = group_of(wid, nwg);
    if (group >= view.groups) {
        return;
    }
    for (var k = 0u; k < SPAN; k = k + 256u) {
        let pixel = group * SPAN + k + lane;
        if (pixel < view.pixels) {
            let z = depth[pixel];
            var pulled = 0.0;
            if ((view.has & HAS_PRIOR) != 0u && says(z, prior[pixel]) && z > DEPTH_FLOOR) {
                let d = disparity(z);
                let by_disparity = told[3] * (d - told[1]) + told[4] * (prior[pixel] - told[2]);
                pulled = by_disparity * -DEPTH_SCALE * d * d;
            }
            gradient[pixel] = pulled;
        }
    }
}
