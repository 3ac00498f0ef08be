// From the gradient of the mixed coefficients to the gradients of the anchors. One workgroup. All gradients
// are zero before.

const WIDTH_FLOOR: f32 = 1e-4;

// Gradient with respect to an anchor's share, less its mean over all shares. That mean belongs to the mixed
// coefficients, so these are subtracted before the sum and not after it.
fn by_share(anchor: u32, lane: u32) -> f32 {
    var product = 0.0;
    if (lane < COEFFICIENTS) {
        product = by_mixed[lane] * (state[4u * water.anchors + COEFFICIENTS * anchor + lane] - mixed[lane]);
    }
    return sum_of_group(product, lane);
}

@compute @workgroup_size(WG)
fn main(@builtin(local_invocation_index) lane: u32) {
    if (water.anchors == 0u) {
        if (lane < COEFFICIENTS) {
            slope[lane] = by_mixed[lane];
        }
        return;
    }
    for (var place = 0u; place < water.shared_by; place = place + 1u) {
        let anchor = u32(mixed[COEFFICIENTS + 2u * place]);
        let share = mixed[COEFFICIENTS + 2u * place + 1u];
        let pull = share * by_share(anchor, lane);
        if (lane < COEFFICIENTS) {
            slope[4u * water.anchors + COEFFICIENTS * anchor + lane] = share * by_mixed[lane];
        }
        if (lane == 0u) {
            let here = vec3<f32>(water.to_world_x.w, water.to_world_y.w, water.to_world_z.w);
            let center = vec3<f32>(state[3u * anchor], state[3u * anchor + 1u], state[3u * anchor + 2u]);
            let width = exp(state[3u * water.anchors + anchor]);
            let sigma = max(width, WIDTH_FLOOR);
            let scaled = (here - center) / sigma;
            let by_center = pull * scaled / sigma;
            slope[3u * anchor] = by_center.x;
            slope[3u * anchor + 1u] = by_center.y;
            slope[3u * anchor + 2u] = by_center.z;
            if (width >= WIDTH_FLOOR) {
                slope[3u * water.anchors + anchor] = pull * dot(scaled, scaled);
            }
        }
    }
}
