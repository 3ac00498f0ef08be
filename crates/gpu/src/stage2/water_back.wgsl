// Gradients with respect to the inputs of the enhanced water. They follow from the sums of the forward pass
// along every ray, with the gradient g of the image:
//
//   dc = g (1 - V)      dk_bs = g c MB ln 2      dk_attn = -g MA ln 2
//
// with V = sum w e_bs (`VEIL`), MB = sum w z e_bs (`VEIL_BY_DEPTH`), MA = sum w z c e_attn
// (`LIGHT_BY_DEPTH`). A workgroup takes 256 pixels, 64 at a time; each of its threads computes one sum: 16 x
// 6 for the table, 12 for the affine, 4 for the guide, 2 for the ratios.
const LN_2: f32 = 0.69314718f;
const SPAN: u32 = 256u;
const AT_ONCE: u32 = 64u;
// First planes of the sections of `kept`, whose words are the bits of floats.
const VEIL: u32 = 1u;
const LIGHT_BY_DEPTH: u32 = 4u;
const VEIL_BY_DEPTH: u32 = 7u;

struct Pixel {
    row: u32,
    t: f32,
    by_guide: f32,
    by_gain: vec3<f32>,
    by_bias: vec3<f32>,
    through: vec3<f32>,
    color: vec3<f32>,
    logs: vec3<f32>,
    by_ratios: vec2<f32>,
}

var<workgroup> pixels: array<Pixel, 64>;

fn along(section: u32, at: u32) -> f32 {
    return bitcast<f32>(kept[section * field.pixels + at]);
}

fn pixel_at(p: u32) -> Pixel {
    let n = field.pixels;
    var out = Pixel();
    out.color = three_at(COLOR, p);
    out.logs = three_at(LOGS, p);
    let gamma = guide_of(out.logs);
    let seen = table_at(gamma);
    let graded = graded_of(out.color);
    out.row = seen.place.node;
    out.t = seen.place.t;
    var rise = 0.0f;
    for (var c = 0u; c < 3u; c++) {
        let at = c * n + p;
        let g = image_pull[at];
        let d = g * (1.0f - along(VEIL, at));
        let now = fma(seen.gain[c], graded[c], seen.bias[c]);
        out.by_bias[c] = d;
        out.by_gain[c] = d * graded[c];
        out.through[c] = d * seen.gain[c];
        rise += out.by_gain[c] * seen.gain_rise[c] + d * seen.bias_rise[c];
        out.by_ratios.x += g * now * along(VEIL_BY_DEPTH, at) * water[BACKSCATTER * n + at];
        out.by_ratios.y -= g * along(LIGHT_BY_DEPTH, at) * water[ATTENUATION * n + at];
    }
    out.by_ratios *= LN_2;
    out.by_guide = rise * (0.5f * f32(TABLE - 1u)) * (1.0f - gamma * gamma);
    return out;
}

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let group = group_of(wid, nwg);
    if (group >= field.water_groups) { return; }
    let end = min((group + 1u) * SPAN, field.pixels);
    var sum = 0.0f;
    for (var first = group * SPAN; first < end; first += AT_ONCE) {
        workgroupBarrier();
        if (lid < AT_ONCE && first + lid < end) { pixels[lid] = pixel_at(first + lid); }
        workgroupBarrier();
        let count = min(AT_ONCE, end - first);
        var own = 0.0f;
        for (var k = 0u; k < count; k++) {
            if (lid < WATER_AFFINE) {
                let row = lid / OUTPUTS;
                let o = lid % OUTPUTS;
                var weight = 0.0f;
                if (pixels[k].row == row) { weight = 1.0f - pixels[k].t; }
                if (pixels[k].row + 1u == row) { weight = pixels[k].t; }
                var value = pixels[k].by_gain[o % 3u];
                if (o >= 3u) { value = pixels[k].by_bias[o % 3u]; }
                own += weight * value;
            } else if (lid < WATER_GUIDE) {
                let o = (lid - WATER_AFFINE) / 4u;
                let x = lid % 4u;
                var factor = 1.0f;
                if (x < 3u) { factor = pixels[k].color[x]; }
                own += pixels[k].through[o] * factor;
            } else if (lid < WATER_RATIOS) {
                let x = lid - WATER_GUIDE;
                var factor = 1.0f;
                if (x < 3u) { factor = pixels[k].logs[x]; }
                own += pixels[k].by_guide * factor;
            } else if (lid < WATER_SUMS) {
                own += pixels[k].by_ratios[lid - WATER_RATIOS];
            }
        }
        sum += own;
    }
    if (lid < WATER_SUMS) { partial[WATER_SUMS * group + lid] = sum; }
}
