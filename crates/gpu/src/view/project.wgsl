// One thread per Gaussian of a chunk: its splat, its key for the order by depth, and its number of tiles.
const HIDDEN: u32 = 0x0fffffffu;

fn hide(i: u32) {
    splats[3u * i] = vec4<f32>();
    splats[3u * i + 1u] = vec4<f32>();
    splats[3u * i + 2u] = vec4<f32>();
    keys[i] = HIDDEN;
    tiles[i] = 0u;
}

// log2 of 1 + e for e in [0, 1].
fn log2_1p(e: f32) -> f32 {
    if (e < 0.01f) { return LOG2_E * (e * (1.0f - e * (0.5f - e * (1.0f / 3.0f - e * 0.25f)))); }
    return log2(1.0f + e);
}

// A number of the array of colours.
fn number_at(place: u32) -> f32 { return colors[place / 4u][place % 4u]; }

fn large(v: f32) -> bool { return !(abs(v) < 1e30f) || is_bad(v); }

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let own = group_of(wid, nwg) * WG + lid;
    let i = chunk.x + own;
    if (own >= chunk.y || i >= constants.counts.x) { return; }
    let g0 = geometry[3u * i];
    let g1 = geometry[3u * i + 1u];
    let q = geometry[3u * i + 2u];
    let x = camera_frame(g0.xyz);
    if (!(x.z >= NEAR && x.z <= FAR) || is_bad(x.z)) { hide(i); return; }
    let s = screen_of(x, g1.xyz, q);
    let v = s.variance;
    let xx = dot(v * s.a, s.a);
    let xy = dot(v * s.a, s.b);
    let yy = dot(v * s.b, s.b);
    let cov_xx = xx + BLUR;
    let cov_yy = yy + BLUR;
    let mean = constants.lens.xy * (x.xy / x.z) + constants.lens.zw;
    if (large(mean.x) || large(mean.y) || large(cov_xx) || large(xy) || large(cov_yy)) { hide(i); return; }
    let logit = g0.w;
    let log2_opacity = min(logit, 0.0f) * LOG2_E - log2_1p(exp2(-abs(logit) * LOG2_E));
    let level = log2_opacity + LOG2_255;
    if (!(level >= 0.0f) || is_bad(level)) { hide(i); return; }
    let cc = s.c * s.c;
    let det = v.y * v.z * cc.x + v.x * v.z * cc.y + v.x * v.y * cc.z + BLUR * (xx + yy) + BLUR * BLUR;
    if (!(det > 0.0f) || is_bad(det)) { hide(i); return; }
    let twice_sigma = 2.0f * level * LN_2;
    let reach = sqrt(twice_sigma * vec2<f32>(cov_xx, cov_yy)) * (1.0f + 1e-6f) + 1e-3f;
    let shear = -xy / cov_yy;
    let steepness = 0.5f * LOG2_E * cov_yy / det;
    let steepness_y = 0.5f * LOG2_E / cov_yy;
    let finite = !is_bad(shear) && steepness > 0.0f && steepness_y > 0.0f && !is_bad(steepness);
    let e = constants.extent;
    let meets = mean.x + reach.x >= e.x && mean.x - reach.x <= e.y && mean.y + reach.y >= e.z && mean.y - reach.y <= e.w;
    if (!finite || !meets) { hide(i); return; }

    let bands = constants.counts.y;
    var color: vec3<f32>;
    if (bands == 0u) {
        let at = 3u * own;
        color = vec3<f32>(number_at(at), number_at(at + 1u), number_at(at + 2u));
    } else {
        // Four bands lie in three rows.
        var y = harmonics(bands, direction_to(g0.xyz));
        color = vec3<f32>(0.5f);
        for (var four = 0u; four < 4u; four++) {
            if (4u * four < bands) {
                let a = colors[12u * own + 3u * four];
                let b = colors[12u * own + 3u * four + 1u];
                let c = colors[12u * own + 3u * four + 2u];
                color = fma(vec3<f32>(y[4u * four]), a.xyz, color);
                if (4u * four + 1u < bands) {
                    color = fma(vec3<f32>(y[4u * four + 1u]), vec3<f32>(a.w, b.xy), color);
                    color = fma(vec3<f32>(y[4u * four + 2u]), vec3<f32>(b.zw, c.x), color);
                    color = fma(vec3<f32>(y[4u * four + 3u]), c.yzw, color);
                }
            }
        }
        color = max(color, vec3<f32>(0.0f));
    }
    splats[3u * i] = vec4<f32>(mean, shear, steepness);
    splats[3u * i + 1u] = vec4<f32>(steepness_y, log2_opacity, x.z, reach.y);
    splats[3u * i + 2u] = vec4<f32>(color, 1.0f);
    keys[i] = min(bitcast<u32>(x.z) - bitcast<u32>(NEAR), HIDDEN - 1u);
    let contour = Contour(mean.x, mean.y, shear, steepness, steepness_y, level, reach.y);
    let rows = rows_meeting(mean.y - reach.y, mean.y + reach.y);
    var count = 0u;
    for (var row = rows.x; row < rows.y; row++) {
        let span = row_span(contour, row);
        count += max(span.y, span.x) - span.x;
    }
    tiles[i] = count;
}
