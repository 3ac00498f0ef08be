// One thread per pixel of a step: turns a stored view, 8 or 16 bits per value, into floats. A pixel is the mean
// of a box of stored pixels, which is one pixel at full size. Values of the photograph, opacity and mask are
// sums of integers times a factor, so they have the processor's bits as long as a float holds the sum.
// The prior is a quotient, and a GPU may round quotients in another way. The binary digits of v / 65535 are
// those of v, repeated without end, so the float of one pixel is built from them.

fn byte_at(section: u32, at: u32) -> u32 { return (stored[section + at / 4u] >> (8u * (at % 4u))) & 0xffu; }

fn short_at(section: u32, at: u32) -> u32 { return (stored[section + at / 2u] >> (16u * (at % 2u))) & 0xffffu; }

// The mean of a box of 8-bit values whose first one is at `first`.
fn mean_of_bytes(section: u32, first: u32) -> f32 {
    var sum = 0u;
    for (var row = 0u; row < view.divisor; row++) {
        for (var k = 0u; k < view.divisor; k++) {
            sum += byte_at(section, first + row * view.stored_columns + k);
        }
    }
    return f32(sum) * view.from_bytes;
}

struct BoxSum {
    sum: f32,
    // Number of values that are not 0.
    known: u32,
}

// The sum of a box of 16-bit values, of which 32 bits may hold one row only.
fn sum_of_shorts(section: u32, first: u32) -> BoxSum {
    var low = 0u;
    var high = 0u;
    var known = 0u;
    for (var row = 0u; row < view.divisor; row++) {
        var sum = 0u;
        for (var k = 0u; k < view.divisor; k++) {
            let value = short_at(section, first + row * view.stored_columns + k);
            sum += value;
            known += min(value, 1u);
        }
        low += sum & 0xffffu;
        high += sum >> 16u;
    }
    return BoxSum(f32(high) * 65536.0f + f32(low), known);
}

fn over_65535(v: u32) -> f32 {
    if (v == 0u) { return 0.0f; }
    let empty = countLeadingZeros(v) - 16u;
    let digits = ((v << 16u) | v) << empty;
    // The digits that follow are never exactly half of the last digit, so there is no tie.
    var rounded = digits >> 8u;
    if ((digits & 0xffu) >= 0x80u) { rounded += 1u; }
    return f32(rounded) * bitcast<f32>((103u - empty) << 23u);
}

// The mean of the known values of a prior, 0 if there are none.
fn mean_of_prior(section: u32, first: u32) -> f32 {
    if (view.divisor == 1u) { return over_65535(short_at(section, first)); }
    let of_box = sum_of_shorts(section, first);
    return of_box.sum / (f32(max(of_box.known, 1u)) * 65535.0f);
}

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let pixel = group_of(wid, nwg) * WG + lid;
    if (pixel >= view.pixels) { return; }
    let first = (pixel / view.columns * view.stored_columns + pixel % view.columns) * view.divisor;
    let sections = view.sections;
    for (var c = 0u; c < 3u; c++) {
        let of_plane = c * view.stored_pixels + first;
        if (sections.deep != 0u) {
            photograph[c * view.pixels + pixel] = sum_of_shorts(0u, of_plane).sum * view.from_shorts;
        } else {
            photograph[c * view.pixels + pixel] = mean_of_bytes(0u, of_plane);
        }
    }
    if (sections.alpha != 0u) { alpha[pixel] = mean_of_bytes(sections.alpha, first); }
    var counts = 1.0f;
    if (sections.mask != 0u) {
        counts = mean_of_bytes(sections.mask, first);
        mask[pixel] = counts;
    }
    if (sections.prior != 0u) {
        var known = mean_of_prior(sections.prior, first);
        if (counts < 0.5f) { known = 0.0f; }
        prior[pixel] = known;
    }
}
