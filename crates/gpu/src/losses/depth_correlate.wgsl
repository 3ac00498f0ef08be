// Computes the correlation, the loss, and the two factors of every pixel's gradient. One workgroup.

@compute @workgroup_size(WG)
fn main(@builtin(local_invocation_index) lane: u32) {
    let all = totals_of(0u, view.groups, view.groups, lane);
    if (lane == 0u) {
        let n = told[0];
        var own = 0.0;
        var other = 0.0;
        var loss = 0.0;
        if (n >= FEWEST_PIXELS) {
            let variance_d = all.x / n;
            let product = sqrt(variance_d) * sqrt(all.y / n);
            let correlation = all.z / n / max(product, DEVIATION_FLOOR);
            if (product > DEVIATION_FLOOR) {
                own = view.slopes.z * correlation / (n * variance_d);
                other = -view.slopes.z / (n * product);
            } else {
                other = -view.slopes.z / (n * DEVIATION_FLOOR);
            }
            loss = 1.0 - correlation;
        }
        told[3] = own;
        told[4] = other;
        told[5] = loss;
    }
}
