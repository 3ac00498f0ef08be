// Weight of a pixel. Used by kernels that read `mask`.
fn mask_at(pixel: u32) -> f32 {
    if ((view.has & HAS_MASK) != 0u) {
        return mask[pixel];
    }
    return 1.0;
}
