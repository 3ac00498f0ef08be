// Before the structure measure: computes W Î − 1 and W I − 1 of every value, and the sums of Reg-L1, of the
// squared error and of the squared mask.

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
    var absolute = 0.0;
    var squared = 0.0;
    var counted = 0.0;
    for (var k = 0u; k < SPAN; k = k + 256u) {
        let pixel = place.group * SPAN + k + lane;
        if (pixel < view.pixels) {
            let at = channel * view.pixels + pixel;
            let m = mask_at(pixel);
            let p = rendered[at] * gain * m;
            let t = photograph[at] * m;
            let w = 1.0 / (max(p, 0.0) + EPSILON);
            let off = w * (t - p);
            let from_one = w * -EPSILON;
            weighed[at] = from_one;
            weighed_target[at] = off + from_one;
            absolute = absolute + abs(off);
            let e = min(max(p, 0.0), 1.0) - t;
            squared = squared + e * e;
            counted = counted + m * m;
        }
    }
    let first = channel * view.groups + place.group;
    let all = sum_of_three(vec3<f32>(absolute, squared, counted), lane);
    if (lane == 0u) {
        sums[run_of(0u) + first] = all.x;
        sums[run_of(1u) + first] = all.y;
        sums[run_of(2u) + first] = all.z;
    }
}
