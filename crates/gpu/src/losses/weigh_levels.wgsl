// Computes the structure measure, and the factor of every level in the backward pass. One workgroup.
// `factors` holds three channels per level; entry 9 is the measure.

var<private> level_means: array<f32, 12>;

@compute @workgroup_size(WG)
fn main(@builtin(local_invocation_index) lane: u32) {
    for (var level = 0u; level < view.levels; level = level + 1u) {
        let groups = view.level_groups[level];
        let means = totals_of(view.level_first[level], groups, groups, lane) * view.level_mean[level];
        if (lane == 0u) {
            level_means[3u * level] = means.x;
            level_means[3u * level + 1u] = means.y;
            level_means[3u * level + 2u] = means.z;
        }
    }
    // The first thread alone writes the means and reads them, so no barrier is needed.
    if (lane == 0u) {
        var similarity = 0.0;
        for (var channel = 0u; channel < 3u; channel = channel + 1u) {
            var product = 1.0;
            for (var level = 0u; level < view.levels; level = level + 1u) {
                let mean = level_means[3u * level + channel];
                if (mean > 0.0) {
                    product = product * pow(mean, view.level_weight[level]);
                } else {
                    product = 0.0;
                }
            }
            for (var level = 0u; level < view.levels; level = level + 1u) {
                // A channel with a mean at or below 0 has value 0 and no gradient.
                var factor = 0.0;
                if (product > 0.0) {
                    factor = product * view.level_slope[level] / level_means[3u * level + channel];
                }
                factors[3u * level + channel] = factor;
            }
            similarity = similarity + product;
        }
        factors[9] = similarity / 3.0;
    }
}
