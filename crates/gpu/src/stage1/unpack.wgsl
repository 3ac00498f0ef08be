// One thread per pixel of a step: turns a stored view, 8 or 16 bits per value, into floats. A pixel is the mean
// of a box of stored pixels, which is one pixel at full size; of the photograph only pixels that the mask counts
// are in the mean. Values of the mask, and of the photograph in full boxes, are sums of integers times a
// factor, so they have the processor's bits as long as a float holds the sum. The prior and the photograph in
// other boxes are quotients, and a GPU may round quotients in another way. The binary digits of v / 65535 are
// those of v, repeated without end, so the float of one pixel is built from them.

fn byte_at(section: u32, at: u32) -> u32 { return (stored[section + at / 4u] >> (8u * (at % 4u))) & 0xffu; }

fn short_at(section: u32, at: u32) -> u32 { return (stored[section + at / 2u] >> (16u * (at % 2u))) & 0xffffu; }

fn is_counted(at: u32) -> bool { return view.sections.mask == 0u || byte_at(view.sections.mask, at) != 0u; }

// The number of pixels of a box that the mask counts.
fn counted_in(first: u32) -> u32 {
    if (view.sections.mask == 0u) { return view.divisor * view.divisor; }
    var count = 0u;
    for (var row = 0u; row < view.divisor; row++) {
        for (var k = 0u; k < view.divisor; k++) {
            count += select(0u, 1u, is_counted(first + row * view.stored_columns + k));
        }
    }
    return count;
}

// The sum of a plane of the photograph over the counted pixels of a box.
fn sum_of_plane(plane: u32, first: u32) -> f32 {
    var low = 0u;
    var high = 0u;
    for (var row = 0u; row < view.divisor; row++) {
        // 32 bits hold one row of 16-bit values.
        var sum = 0u;
        for (var k = 0u; k < view.divisor; k++) {
            let at = first + row * view.stored_columns + k;
            if (is_counted(at)) {
                if (view.sections.deep != 0u) {
                    sum += short_at(0u, plane + at);
                } else {
                    sum += byte_at(0u, plane + at);
                }
            }
        }
        low += sum & 0xffffu;
        high += sum >> 16u;
    }
    return f32(high) * 65536.0f + f32(low);
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
    let deep = sections.deep != 0u;
    let box_size = view.divisor * view.divisor;
    let counted = counted_in(first);
    let full = select(255.0f, 65535.0f, deep);
    let factor = select(view.from_bytes, view.from_shorts, deep);
    for (var c = 0u; c < 3u; c++) {
        let sum = sum_of_plane(c * view.stored_pixels, first);
        var mean = sum * factor;
        if (counted < box_size) { mean = sum / (full * f32(max(counted, 1u))); }
        photograph[c * view.pixels + pixel] = mean;
    }
    var counts = 1.0f;
    if (sections.mask != 0u) {
        counts = select(0.0f, 1.0f, 2u * counted >= box_size);
        mask[pixel] = counts;
    }
    if (sections.prior != 0u) {
        var known = mean_of_prior(sections.prior, first);
        if (counts == 0.0f) { known = 0.0f; }
        prior[pixel] = known;
    }
}
