// After the structure measure: turns its gradient into the gradient with respect to the rendered image,
// before the view's gain is applied. Also sums the gradient with respect to the log-gain.

const EPSILON: f32 = 1e-3;

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let place = place_of(group_of(wid, nwg));
    let channel = place.channel;
    if (channel >= 3u) {
        return;
    }
    let gain = gain_of(channel);
    var by_gain = 0.0;
    for (var k = 0u; k < SPAN; k = k + 256u) {
        let pixel = place.group * SPAN + k + lane;
        if (pixel < view.pixels) {
            let at = channel * view.pixels + pixel;
            let x = weighed[at];
            let y = weighed_target[at];
            let w = x * (-1.0 / EPSILON) * mask_at(pixel);
            var slope = 0.0;
            if (x > y) {
                slope = view.slopes.x;
            } else if (x < y) {
                slope = -view.slopes.x;
            }
            if (view.levels > 0u) {
                slope = slope + gradient[at] * view.slopes.y;
            }
            let own = w * slope;
            by_gain = by_gain + rendered[at] * gain * own;
            gradient[at] = own * gain;
        }
    }
    let total = sum_of_group(by_gain, lane);
    if (lane == 0u) {
        sums[run_of(3u) + channel * view.groups + place.group] = total;
    }
}
