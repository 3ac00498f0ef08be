// Composes a photograph's transparent pixels over the water's colour, times the view's gain. Without water
// they are composed over black.

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
    for (var k = 0u; k < SPAN; k = k + 256u) {
        let pixel = place.group * SPAN + k + lane;
        if (pixel < view.pixels) {
            let at = channel * view.pixels + pixel;
            let a = alpha[pixel];
            var behind = 0.0;
            if ((view.has & HAS_WATER) != 0u) {
                behind = gain * water[at];
            }
            photograph[at] = a * photograph[at] + (1.0 - a) * behind;
        }
    }
}
