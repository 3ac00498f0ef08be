// Writes the report of a view: the loss, its terms reg_l1, reg_ms_ssim and depth_loss, the mean squared
// error, and the number of pixels that count. One workgroup. A loss that is not finite stops the run before
// anything is updated.

// Sum of a quantity over all channels.
fn total_over(quantity: u32, lane: u32) -> f32 {
    let channels = totals_of(run_of(quantity), view.groups, view.groups, lane);
    return channels.x + channels.y + channels.z;
}

@compute @workgroup_size(WG)
fn main(@builtin(local_invocation_index) lane: u32) {
    let absolute = total_over(0u, lane);
    let squared = total_over(1u, lane);
    let counted = total_over(2u, lane);
    if (lane == 0u) {
        let at = 16u * view.report;
        let reg_l1 = absolute / (3.0 * f32(view.pixels));
        var reg_ms_ssim = 0.0;
        if (view.levels > 0u) {
            reg_ms_ssim = 1.0 - factors[9];
        }
        var depth_loss = 0.0;
        if ((view.has & HAS_PRIOR) != 0u) {
            depth_loss = depth_told[5];
        }
        let loss = view.weights.x * reg_l1 + view.weights.y * reg_ms_ssim + view.weights.z * depth_loss;
        told[at] = loss;
        told[at + 1u] = reg_l1;
        told[at + 2u] = reg_ms_ssim;
        told[at + 3u] = depth_loss;
        told[at + 4u] = select(0.0, squared / counted, counted > 0.0);
        told[at + 5u] = counted / 3.0;
        if (is_bad(loss) && atomicLoad(&counts[STOP]) == 0u) {
            atomicStore(&counts[STOP], NON_FINITE);
            atomicStore(&counts[STOP_STEP], view.step);
            atomicOr(&counts[BAD], BAD_LOSS);
        }
    }
}
