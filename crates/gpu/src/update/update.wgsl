// One thread per Gaussian: adds its records in the order of its tiles, and carries the gradient back through
// the projection to its geometry. Adam then moves the geometry; of the gradient only that of the colour is
// stored. A Gaussian that was not seen has gradient zero, and its moments decay.

fn adam3(p: vec3<f32>, g: vec3<f32>, m: ptr<function, vec4<f32>>, v: ptr<function, vec4<f32>>, rate: f32, bit: u32) -> vec3<f32> {
    var out = p;
    for (var c = 0u; c < 3u; c++) {
        var mc = (*m)[c];
        var vc = (*v)[c];
        out[c] = adam(p[c], g[c], &mc, &vc, rate, bit);
        (*m)[c] = mc;
        (*v)[c] = vc;
    }
    return out;
}

fn sum_of(first: u32, count: u32) -> array<vec4<f32>, 3> {
    var sum = array<vec4<f32>, 3>();
    // The blocks of a long run were summed before; the first record of each has its sum.
    let step = select(1u, BLOCK, count > BLOCK);
    for (var k = 0u; k < count; k += step) {
        let at = 3u * (first + k);
        sum[0] += records[at];
        sum[1] += records[at + 1u];
        sum[2] += records[at + 2u];
    }
    return sum;
}

struct Pull {
    mean: vec3<f32>,
    log_scale: vec3<f32>,
    quaternion: vec4<f32>,
}

// From sums over pixels to the gradient of the geometry. With v = conic (pixel - centre) = (a t, shear a t +
// b dy) and the projected axes u_k, the gradient along axis k is a sum of G v (v . u_k). The product is v .
// u_k = a t m_k + b dy b_k, with m_k = a_k + shear b_k. Here m_k is computed from cross products, which do
// not contain axis k itself: for a needle that is its long axis.
fn pull_back(x: vec3<f32>, s: Screen, splat0: vec4<f32>, splat1: vec4<f32>, sum: array<vec4<f32>, 3>) -> Pull {
    var sums = sum;
    let k = splat0.z;
    let a = splat0.w * (2.0f * LN_2);
    let b = splat1.x * (2.0f * LN_2);
    let st = sums[0].y;
    let sy = sums[0].z;
    let tt = sums[0].w;
    let ty = sums[1].x;
    let yy = sums[1].y;
    let d_z = sums[1].z * LN_2;
    let d_mean = vec2<f32>(a * st, k * a * st + b * sy);
    let v = s.variance;
    let cov_yy = dot(v * s.b, s.b) + BLUR;
    let c = s.c;
    let vb = v * s.b;
    let m = (BLUR * s.a + vec3<f32>(vb.y * c.z - vb.z * c.y, vb.z * c.x - vb.x * c.z, vb.x * c.y - vb.y * c.x)) / cov_yy;
    let am = a * m;
    let bb = b * s.b;
    let p = am * tt + bb * ty;
    let q = am * ty + bb * yy;
    var out: Pull;
    out.log_scale = v * (am * p + bb * q);
    let d_a = v * (a * p);
    let d_b = v * (k * a * p + b * q);
    // a = jr0 turn, b = jr1 turn.
    let d_jr0 = s.turn * d_a;
    let d_jr1 = s.turn * d_b;
    // Rows of the gradient of the rotation.
    let t0 = s.jr0.x * d_a + s.jr1.x * d_b;
    let t1 = s.jr0.y * d_a + s.jr1.y * d_b;
    let t2 = s.jr0.z * d_a + s.jr1.z * d_b;
    let u = s.unit;
    let g = vec4<f32>(
        2.0f * (u.y * (t2.y - t1.z) + u.z * (t0.z - t2.x) + u.w * (t1.x - t0.y)),
        2.0f * (-2.0f * u.y * (t1.y + t2.z) + u.z * (t0.y + t1.x) + u.w * (t0.z + t2.x) + u.x * (t2.y - t1.z)),
        2.0f * (u.y * (t0.y + t1.x) - 2.0f * u.z * (t0.x + t2.z) + u.w * (t1.z + t2.y) + u.x * (t0.z - t2.x)),
        2.0f * (u.y * (t0.z + t2.x) + u.z * (t1.z + t2.y) - 2.0f * u.w * (t0.x + t1.y) + u.x * (t1.x - t0.y)),
    );
    let along = dot(g, u);
    out.quaternion = (g - along * u) / s.norm;
    let r2 = constants.rotation[2].xyz;
    let z = x.z;
    var d_x = vec3<f32>(0.0f, 0.0f, d_z);
    let slope = vec2<f32>(-(constants.lens.x / z) * dot(d_jr0, r2), -(constants.lens.y / z) * dot(d_jr1, r2));
    d_x.z -= (dot(d_jr0, s.jr0) + dot(d_jr1, s.jr1)) / z;
    for (var i = 0u; i < 2u; i++) {
        if (s.free[i]) {
            d_x[i] += slope[i] / z;
            d_x.z -= slope[i] * s.slope[i] / z;
        }
        d_x[i] += d_mean[i] * constants.lens[i] / z;
        d_x.z -= d_mean[i] * constants.lens[i] * x[i] / (z * z);
    }
    out.mean = constants.rotation[0].xyz * d_x.x + constants.rotation[1].xyz * d_x.y + r2 * d_x.z;
    return out;
}

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let i = group_of(wid, nwg) * WG + lid;
    if (i >= constants.counts.x || atomicLoad(&counts[STOP]) != 0u) { return; }
    bad = 0u;
    var g0 = geometry[3u * i];
    var g1 = geometry[3u * i + 1u];
    var g2 = geometry[3u * i + 2u];
    let splat0 = splats[3u * i];
    let splat1 = splats[3u * i + 1u];
    let splat2 = splats[3u * i + 2u];
    let visible = splat2.w == 1.0f;
    let run = runs[i];
    var sum = array<vec4<f32>, 3>();
    var pull: Pull;
    var d_logit = 0.0f;
    let direction = direction_to(g0.xyz);
    if (visible) {
        sum = sum_of(run.x, run.y);
        let x = camera_frame(g0.xyz);
        pull = pull_back(x, screen_of(x, g1.xyz, g2), splat0, splat1, sum);
        d_logit = sum[0].x / (1.0f + exp2(g0.w * LOG2_E));
    }
    var m = geometry_first[3u * i];
    var v = geometry_second[3u * i];
    let mean = adam3(g0.xyz, pull.mean, &m, &v, constants.rates.x, 1u);
    var mw = m.w;
    var vw = v.w;
    let logit = adam(g0.w, d_logit, &mw, &vw, constants.rates.w, 8u);
    geometry[3u * i] = vec4<f32>(mean, logit);
    geometry_first[3u * i] = vec4<f32>(m.xyz, mw);
    geometry_second[3u * i] = vec4<f32>(v.xyz, vw);
    m = geometry_first[3u * i + 1u];
    v = geometry_second[3u * i + 1u];
    geometry[3u * i + 1u] = vec4<f32>(adam3(g1.xyz, pull.log_scale, &m, &v, constants.rates.y, 2u), 0.0f);
    geometry_first[3u * i + 1u] = m;
    geometry_second[3u * i + 1u] = v;
    m = geometry_first[3u * i + 2u];
    v = geometry_second[3u * i + 2u];
    let axes_moved = adam3(g2.xyz, pull.quaternion.xyz, &m, &v, constants.rates.z, 4u);
    mw = m.w;
    vw = v.w;
    let last_moved = adam(g2.w, pull.quaternion.w, &mw, &vw, constants.rates.z, 4u);
    geometry[3u * i + 2u] = vec4<f32>(axes_moved, last_moved);
    geometry_first[3u * i + 2u] = vec4<f32>(m.xyz, mw);
    geometry_second[3u * i + 2u] = vec4<f32>(v.xyz, vw);

    // The colour has no gradient where it is clamped at black. The colours have a kernel of their own, which
    // needs the direction from which the Gaussian was seen, before it moved.
    let by_color = vec3<f32>(sum[1].w, sum[2].xy) * vec3<f32>(splat2.xyz > vec3<f32>(0.0f));
    for (var c = 0u; c < 3u; c++) {
        color_pull[6u * i + c] = by_color[c];
        color_pull[6u * i + 3u + c] = direction[c];
    }
    if (constants.flags.z != 0u && visible) {
        let a = splat0.w * (2.0f * LN_2);
        let s = constants.screen.xy * vec2<f32>(a * sum[2].z, sum[2].w);
        let before = statistics[i];
        let norm = bitcast<f32>(before.x) + sqrt(s.x * s.x + s.y * s.y);
        statistics[i] = vec2<u32>(bitcast<u32>(norm), before.y + 1u);
    }
    if (bad != 0u) { atomicOr(&counts[BAD], bad); }
}
