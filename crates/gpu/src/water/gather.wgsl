// Gradients of the loss with respect to the mixed coefficients. They follow from the sums of the forward pass
// along every ray, with the gradient g of the image:
//
//   ∂c = g (1 − V)      ∂β_bs = g c MB |d|      ∂β_attn = −g MA |d|
//
// with V = Σ w e_bs (`VEIL`), MB = Σ w z e_bs (`VEIL_BY_DEPTH`), MA = Σ w z c e_attn (`LIGHT_BY_DEPTH`). The
// products of basis and gradient are summed over 1024 pixels per workgroup, 128 at a time. Each sum is
// computed in one lane.

const LOG2_E: f32 = 1.4426950408889634;
const SPAN: u32 = 1024u;
const LANES: u32 = 128u;
// Floats between rows in workgroup memory: one more than a row has, so that threads that read the same column
// of several rows use different banks.
const STRIDE: u32 = 129u;

var<workgroup> bases: array<f32, 16u * STRIDE>;
var<workgroup> slopes: array<f32, 9u * STRIDE>;

// First planes of the sections of `kept`, whose words are the bits of floats.
const VEIL: u32 = 1u;
const LIGHT_BY_DEPTH: u32 = 4u;
const VEIL_BY_DEPTH: u32 = 7u;

fn along(section: u32, at: u32) -> f32 {
    return bitcast<f32>(kept[section * water.pixels + at]);
}

// 1 − e^{−y} for y ≥ 0: the derivative of softplus, from its value y.
fn softplus_slope(y: f32) -> f32 {
    if (y > 0.5) {
        return 1.0 - exp(-y);
    }
    var sum = 1.0;
    for (var k = 9u; k >= 2u; k = k - 1u) {
        sum = 1.0 - y / f32(k) * sum;
    }
    return y * sum;
}

// One of the 144 sums, over the pixels in workgroup memory. Four interleaved partial sums are added.
fn sum_of(index: u32) -> f32 {
    let quantity = index / 48u;
    let band = (index % 48u) / 3u;
    let channel = index % 3u;
    if (band >= water.bands) {
        return 0.0;
    }
    let b = band * STRIDE;
    let s = (3u * quantity + channel) * STRIDE;
    var sum = vec4<f32>(0.0);
    for (var k = 0u; k < LANES; k = k + 4u) {
        sum = sum
            + vec4<f32>(bases[b + k], bases[b + k + 1u], bases[b + k + 2u], bases[b + k + 3u])
                * vec4<f32>(slopes[s + k], slopes[s + k + 1u], slopes[s + k + 2u], slopes[s + k + 3u]);
    }
    return (sum.x + sum.y) + (sum.z + sum.w);
}

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let own = group_of(wid, nwg);
    if (own >= water.groups) {
        return;
    }
    var first = 0.0;
    var second = 0.0;
    for (var start = 0u; start < SPAN; start = start + LANES) {
        let pixel = own * SPAN + start + lane;
        if (pixel < water.pixels) {
            let ray = ray_of(pixel);
            var basis = basis_of(ray.direction);
            for (var band = 0u; band < 16u; band = band + 1u) {
                bases[band * STRIDE + lane] = basis[band];
            }
            let to_value = 1.0 / (LOG2_E * ray.length);
            for (var channel = 0u; channel < 3u; channel = channel + 1u) {
                let at = channel * water.pixels + pixel;
                let g = image_slope[at];
                let c = maps[at];
                var by_color = 0.0;
                if (c > 0.0) {
                    by_color = g * (1.0 - along(VEIL, at));
                }
                let by_backscatter = g * c * along(VEIL_BY_DEPTH, at) * ray.length;
                let by_attenuation = -g * along(LIGHT_BY_DEPTH, at) * ray.length;
                slopes[channel * STRIDE + lane] = by_color;
                slopes[(3u + channel) * STRIDE + lane] =
                    by_backscatter * softplus_slope(maps[BACKSCATTER * water.pixels + at] * to_value);
                slopes[(6u + channel) * STRIDE + lane] =
                    by_attenuation * softplus_slope(maps[ATTENUATION * water.pixels + at] * to_value);
            }
        } else {
            for (var band = 0u; band < 16u; band = band + 1u) {
                bases[band * STRIDE + lane] = 0.0;
            }
            for (var quantity = 0u; quantity < 9u; quantity = quantity + 1u) {
                slopes[quantity * STRIDE + lane] = 0.0;
            }
        }
        workgroupBarrier();
        first = first + sum_of(lane);
        if (lane < COEFFICIENTS - LANES) {
            second = second + sum_of(LANES + lane);
        }
        workgroupBarrier();
    }
    partial[lane * water.groups + own] = first;
    if (lane < COEFFICIENTS - LANES) {
        partial[(LANES + lane) * water.groups + own] = second;
    }
}
