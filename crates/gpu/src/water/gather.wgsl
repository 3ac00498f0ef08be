// Gradients of the loss with respect to the mixed coefficients. They follow from the sums of the forward pass
// along every ray, with the gradient g of the image:
//
//   ∂c = g (1 − V)      ∂β_bs = g c MB |d|      ∂β_attn = −g MA |d|
//
// with V = Σ w e_bs (`VEIL`), MB = Σ w z e_bs (`VEIL_BY_DEPTH`), MA = Σ w z c e_attn (`LIGHT_BY_DEPTH`). The
// products of basis and gradient are summed over 1024 pixels per workgroup, 128 at a time. Each of 120 threads
// sums the twelve products of four bands with the three channels of a quantity, over every tenth pixel. In the
// end the ten parts of each sum are added.

const LOG2_E: f32 = 1.4426950408889634;
const SPAN: u32 = 1024u;
const LANES: u32 = 128u;
// Rows of four bands times quantities.
const JOBS: u32 = 12u;
// Parts of the pixels: as many as there are threads for.
const PARTS: u32 = LANES / JOBS;
// Rows between two groups of bands in workgroup memory: one more than there are, so that threads that read
// the same pixel use different banks.
const STRIDE: u32 = LANES + 1u;

// Four groups of four bands, pixel after pixel. Afterwards the threads' sums.
var<workgroup> bases: array<vec4<f32>, 4u * STRIDE>;
// Three channels of each quantity, pixel after pixel.
var<workgroup> slopes: array<vec4<f32>, 3u * STRIDE>;

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

fn three_of(section: u32, pixel: u32) -> vec3<f32> {
    let at = section * water.pixels + pixel;
    return vec3<f32>(maps[at], maps[at + water.pixels], maps[at + 2u * water.pixels]);
}

fn sums_of(section: u32, pixel: u32) -> vec3<f32> {
    let at = section * water.pixels + pixel;
    return bitcast<vec3<f32>>(vec3<u32>(kept[at], kept[at + water.pixels], kept[at + 2u * water.pixels]));
}

fn softplus_slopes(k: vec3<f32>, to_value: f32) -> vec3<f32> {
    let y = k * to_value;
    return vec3<f32>(softplus_slope(y.x), softplus_slope(y.y), softplus_slope(y.z));
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
    let job = lane % JOBS;
    let part = lane / JOBS;
    let band_row = (job % 4u) * STRIDE;
    let quantity_row = (job / 4u) * STRIDE;
    var red = vec4<f32>(0.0);
    var green = vec4<f32>(0.0);
    var blue = vec4<f32>(0.0);
    for (var start = 0u; start < SPAN; start = start + LANES) {
        let pixel = own * SPAN + start + lane;
        var basis = Basis();
        var by_color = vec3<f32>(0.0);
        var by_backscatter = vec3<f32>(0.0);
        var by_attenuation = vec3<f32>(0.0);
        if (pixel < water.pixels) {
            let ray = ray_of(pixel);
            basis = basis_of(ray.direction);
            let to_value = 1.0 / (LOG2_E * ray.length);
            let n = water.pixels;
            let g = vec3<f32>(image_slope[pixel], image_slope[n + pixel], image_slope[2u * n + pixel]);
            let c = three_of(0u, pixel);
            by_color = select(vec3<f32>(0.0), g * (1.0 - sums_of(VEIL, pixel)), c > vec3<f32>(0.0));
            by_backscatter = g * c * sums_of(VEIL_BY_DEPTH, pixel) * ray.length
                * softplus_slopes(three_of(BACKSCATTER, pixel), to_value);
            by_attenuation = -g * sums_of(LIGHT_BY_DEPTH, pixel) * ray.length
                * softplus_slopes(three_of(ATTENUATION, pixel), to_value);
        }
        bases[lane] = basis.row0;
        bases[STRIDE + lane] = basis.row1;
        bases[2u * STRIDE + lane] = basis.row2;
        bases[3u * STRIDE + lane] = basis.row3;
        slopes[lane] = vec4<f32>(by_color, 0.0);
        slopes[STRIDE + lane] = vec4<f32>(by_backscatter, 0.0);
        slopes[2u * STRIDE + lane] = vec4<f32>(by_attenuation, 0.0);
        workgroupBarrier();
        if (part < PARTS) {
            for (var k = part; k < LANES; k = k + PARTS) {
                let basis_row = bases[band_row + k];
                let slope = slopes[quantity_row + k];
                red = red + basis_row * slope.x;
                green = green + basis_row * slope.y;
                blue = blue + basis_row * slope.z;
            }
        }
        workgroupBarrier();
    }
    if (part < PARTS) {
        bases[3u * lane] = red;
        bases[3u * lane + 1u] = green;
        bases[3u * lane + 2u] = blue;
    }
    workgroupBarrier();
    for (var index = lane; index < COEFFICIENTS; index = index + LANES) {
        let quantity = index / 48u;
        let band = (index % 48u) / 3u;
        let channel = index % 3u;
        let first = 3u * (4u * quantity + band / 4u) + channel;
        var sum = 0.0;
        for (var p = 0u; p < PARTS; p = p + 1u) {
            sum = sum + bases[first + 3u * JOBS * p][band % 4u];
        }
        partial[index * water.groups + own] = select(0.0, sum, band < water.bands);
    }
}
