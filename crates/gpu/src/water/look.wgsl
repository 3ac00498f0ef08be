// The water along every ray: its colour c_m, and the exponents k = β |d| log2 e per unit of z.

const LOG2_E: f32 = 1.4426950408889634;

// ln(1 + e^x) with a small relative error even where it is close to 0: ln(1 + t) = 2 artanh(t / (2 + t)).
fn softplus(x: f32) -> f32 {
    let t = exp(-abs(x));
    let s = t / (t + 2.0);
    let q = s * s;
    let series = 1.0 / 3.0 + q * (1.0 / 5.0 + q * (1.0 / 7.0 + q * (1.0 / 9.0 + q * (1.0 / 11.0 + q * (1.0 / 13.0 + q / 15.0)))));
    return max(x, 0.0) + 2.0 * (s + s * q * series);
}

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let pixel = group_of(wid, nwg) * WG + lane;
    if (pixel >= water.pixels) {
        return;
    }
    let ray = ray_of(pixel);
    var basis = basis_of(ray.direction);
    var raw = array<f32, 9>();
    for (var quantity = 0u; quantity < 3u; quantity = quantity + 1u) {
        for (var channel = 0u; channel < 3u; channel = channel + 1u) {
            var sum = 0.0;
            for (var band = 0u; band < water.bands; band = band + 1u) {
                sum = sum + basis[band] * mixed[48u * quantity + 3u * band + channel];
            }
            raw[3u * quantity + channel] = sum;
        }
    }
    let to_exponent = LOG2_E * ray.length;
    for (var channel = 0u; channel < 3u; channel = channel + 1u) {
        let at = channel * water.pixels + pixel;
        maps[at] = max(raw[channel] + 0.5, 0.0);
        maps[BACKSCATTER * water.pixels + at] = softplus(raw[3u + channel]) * to_exponent;
        maps[ATTENUATION * water.pixels + at] = softplus(raw[6u + channel]) * to_exponent;
    }
}
