// The anchors with the highest affinity to the camera, and the weighted sum of their coefficients. One
// workgroup. After the 144 mixed coefficients come, for each place, the index of the anchor and its share.

const WIDTH_FLOOR: f32 = 1e-4;
const FARTHEST: f32 = -3e38;

var<workgroup> affinities: array<f32, 256>;
var<workgroup> nearest: array<u32, 256>;

fn affinity(anchor: u32) -> f32 {
    let here = vec3<f32>(water.to_world_x.w, water.to_world_y.w, water.to_world_z.w);
    let center =
        vec3<f32>(parameters[3u * anchor], parameters[3u * anchor + 1u], parameters[3u * anchor + 2u]);
    let offset = here - center;
    let sigma = max(exp(parameters[3u * water.anchors + anchor]), WIDTH_FLOOR);
    let scaled = offset / sigma;
    // Kept in range: an anchor that is so far away has share 0 in any case.
    return max(-0.5 * dot(scaled, scaled), FARTHEST);
}

// True if (a, at i) comes before (b, at j): the higher affinity, then the lower index.
fn before(a: f32, i: u32, b: f32, j: u32) -> bool {
    return a > b || (a == b && i < j);
}

@compute @workgroup_size(WG)
fn main(@builtin(local_invocation_index) lane: u32) {
    if (water.anchors == 0u) {
        if (lane < COEFFICIENTS) {
            mixed[lane] = parameters[lane];
        }
        return;
    }
    // Chooses the anchors that share the view, best first. Each round takes the best anchor that comes after
    // the last one chosen.
    var last_affinity = 3e38;
    var last = 0u;
    for (var place = 0u; place < water.shared_by; place = place + 1u) {
        var best = -3.4e38;
        var at = 0xffffffffu;
        for (var anchor = lane; anchor < water.anchors; anchor = anchor + 256u) {
            let a = affinity(anchor);
            if ((place == 0u || before(last_affinity, last, a, anchor)) && before(a, anchor, best, at)) {
                best = a;
                at = anchor;
            }
        }
        affinities[lane] = best;
        nearest[lane] = at;
        workgroupBarrier();
        for (var reach = 128u; reach > 0u; reach = reach >> 1u) {
            if (lane < reach
                && before(affinities[lane + reach], nearest[lane + reach], affinities[lane], nearest[lane])) {
                affinities[lane] = affinities[lane + reach];
                nearest[lane] = nearest[lane + reach];
            }
            workgroupBarrier();
        }
        last_affinity = affinities[0];
        last = nearest[0];
        if (lane == 0u) {
            mixed[COEFFICIENTS + 2u * place] = f32(last);
            mixed[COEFFICIENTS + 2u * place + 1u] = last_affinity;
        }
        storageBarrier();
        workgroupBarrier();
    }
    if (lane == 0u) {
        let best = mixed[COEFFICIENTS + 1u];
        var total = 0.0;
        for (var place = 0u; place < water.shared_by; place = place + 1u) {
            let share = exp(mixed[COEFFICIENTS + 2u * place + 1u] - best);
            mixed[COEFFICIENTS + 2u * place + 1u] = share;
            total = total + share;
        }
        for (var place = 0u; place < water.shared_by; place = place + 1u) {
            mixed[COEFFICIENTS + 2u * place + 1u] = mixed[COEFFICIENTS + 2u * place + 1u] / total;
        }
    }
    storageBarrier();
    if (lane < COEFFICIENTS) {
        var sum = 0.0;
        for (var place = 0u; place < water.shared_by; place = place + 1u) {
            let anchor = u32(mixed[COEFFICIENTS + 2u * place]);
            let share = mixed[COEFFICIENTS + 2u * place + 1u];
            sum = sum + share * parameters[4u * water.anchors + COEFFICIENTS * anchor + lane];
        }
        mixed[lane] = sum;
    }
}
