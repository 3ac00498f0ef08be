// Adam on the gain of one view; then the mean log-gain of all views is subtracted, channel by channel. One
// workgroup. `gains` holds three runs of 3 × views numbers: the log-gains, their first and their second
// moments.

const BETA1: f32 = 0.9;
const BETA2: f32 = 0.999;
const EPSILON: f32 = 1e-15;

@compute @workgroup_size(WG)
fn main(@builtin(local_invocation_index) lane: u32) {
    // Barriers follow, so every thread runs to the end. After a stop it writes nothing.
    let going = atomicLoad(&counts[STOP]) == 0u;
    let all = 3u * view.views;
    for (var channel = 0u; channel < 3u; channel = channel + 1u) {
        let pulled = total_of(run_of(3u) + channel * view.groups, view.groups, lane);
        let at = 3u * view.row + channel;
        if (lane == 0u && going) {
            let g = pulled + view.gains.z * gains[at];
            let m = BETA1 * gains[all + at] + (1.0 - BETA1) * g;
            let v = BETA2 * gains[2u * all + at] + (1.0 - BETA2) * g * g;
            gains[all + at] = m;
            gains[2u * all + at] = v;
            gains[at] = gains[at] - view.gains.x * m / (sqrt(v) * view.gains.y + EPSILON);
        }
        storageBarrier();
        var sum = 0.0;
        for (var row = lane; row < view.views; row = row + 256u) {
            sum = sum + gains[3u * row + channel];
        }
        let mean = sum_of_group(sum, lane) / f32(view.views);
        for (var row = lane; row < view.views && going; row = row + 256u) {
            gains[3u * row + channel] = gains[3u * row + channel] - mean;
        }
        if (lane == 0u && going && is_bad(mean)) {
            atomicOr(&counts[BAD], BAD_GAINS);
        }
        storageBarrier();
    }
}
