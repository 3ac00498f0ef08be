// The view's gain of a channel. Used by kernels that read `gains`.
fn gain_of(channel: u32) -> f32 {
    if ((view.has & HAS_GAINS) != 0u) {
        return exp(gains[3u * view.row + channel]);
    }
    return 1.0;
}
