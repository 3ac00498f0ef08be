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

// The mixed coefficients of the active bands, four numbers to a row. Bands that are not active are zero.
var<workgroup> rows: array<vec4<f32>, 36>;

// Adds the products of four bands with the three channels of their coefficients.
fn add_four(sum: vec3<f32>, basis: vec4<f32>, at: u32) -> vec3<f32> {
    let a = rows[at];
    let b = rows[at + 1u];
    let c = rows[at + 2u];
    var all = sum + basis.x * a.xyz;
    all = all + basis.y * vec3<f32>(a.w, b.xy);
    all = all + basis.z * vec3<f32>(b.zw, c.x);
    return all + basis.w * c.yzw;
}

// The three channels of a quantity along a direction.
fn channels_of(quantity: u32, basis: Basis) -> vec3<f32> {
    let at = 12u * quantity;
    let low = add_four(add_four(vec3<f32>(0.0), basis.row0, at), basis.row1, at + 3u);
    return add_four(add_four(low, basis.row2, at + 6u), basis.row3, at + 9u);
}

// Writes the three channels of a section of the maps.
fn write_maps(section: u32, pixel: u32, values: vec3<f32>) {
    let at = section * water.pixels + pixel;
    maps[at] = values.x;
    maps[at + water.pixels] = values.y;
    maps[at + 2u * water.pixels] = values.z;
}

fn exponents(raw: vec3<f32>, length: f32) -> vec3<f32> {
    return vec3<f32>(softplus(raw.x), softplus(raw.y), softplus(raw.z)) * (LOG2_E * length);
}

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    if (lane < COEFFICIENTS) {
        let is_active = lane % 48u < 3u * water.bands;
        rows[lane / 4u][lane % 4u] = select(0.0, mixed[lane], is_active);
    }
    workgroupBarrier();
    let pixel = group_of(wid, nwg) * WG + lane;
    if (pixel >= water.pixels) {
        return;
    }
    let ray = ray_of(pixel);
    let basis = basis_of(ray.direction);
    write_maps(0u, pixel, max(channels_of(0u, basis) + 0.5, vec3<f32>(0.0)));
    write_maps(BACKSCATTER, pixel, exponents(channels_of(1u, basis), ray.length));
    write_maps(ATTENUATION, pixel, exponents(channels_of(2u, basis), ray.length));
}
