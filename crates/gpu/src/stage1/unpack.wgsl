// One thread per pixel: turns a stored view, 8 or 16 bits per value, into floats with the same bits as on the
// processor. Values of the photograph, opacity and mask are products with one rounding. The prior is a
// quotient, and a GPU may round quotients in another way. The binary digits of v / 65535 are those of v,
// repeated without end, so the float is built from them.
const BYTE: f32 = 0.003921568859368563f;
const SHORT: f32 = 1.5259021893143654e-05f;

fn byte_at(section: u32, at: u32) -> f32 {
    return f32((stored[section + at / 4u] >> (8u * (at % 4u))) & 0xffu) * BYTE;
}

fn short_at(section: u32, at: u32) -> u32 { return (stored[section + at / 2u] >> (16u * (at % 2u))) & 0xffffu; }

fn over_65535(v: u32) -> f32 {
    if (v == 0u) { return 0.0f; }
    let empty = countLeadingZeros(v) - 16u;
    let digits = ((v << 16u) | v) << empty;
    // The digits that follow are never exactly half of the last digit, so there is no tie.
    var rounded = digits >> 8u;
    if ((digits & 0xffu) >= 0x80u) { rounded += 1u; }
    return f32(rounded) * bitcast<f32>((103u - empty) << 23u);
}

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let pixel = group_of(wid, nwg) * WG + lid;
    if (pixel >= sections.pixels) { return; }
    for (var c = 0u; c < 3u; c++) {
        let at = c * sections.pixels + pixel;
        if (sections.deep != 0u) {
            photograph[at] = f32(short_at(0u, at)) * SHORT;
        } else {
            photograph[at] = byte_at(0u, at);
        }
    }
    if (sections.alpha != 0u) { alpha[pixel] = byte_at(sections.alpha, pixel); }
    var counts = 1.0f;
    if (sections.mask != 0u) {
        counts = byte_at(sections.mask, pixel);
        mask[pixel] = counts;
    }
    if (sections.prior != 0u) {
        var known = over_65535(short_at(sections.prior, pixel));
        if (counts < 0.5f) { known = 0.0f; }
        prior[pixel] = known;
    }
}
