// The Pearson loss against a depth prior, with two passes of sums. The second pass subtracts the means of the
// first, so f32 is accurate enough; the processor sums in f64. The passes hand on six results in `told`: 0
// count, 1 mean of disparities, 2 mean of priors, 5 loss. The gradient with respect to a disparity d with
// prior p is told[3] (d − mean of disparities) + told[4] (p − mean of priors).

const FEWEST_PIXELS: f32 = 32.0;
const DEPTH_SCALE: f32 = 10.0;
const DEPTH_FLOOR: f32 = 1e-6;
const DEVIATION_FLOOR: f32 = 1e-6;
const INFINITE: u32 = 0x7f800000u;

fn disparity(z: f32) -> f32 {
    return 1.0 / (DEPTH_SCALE * max(z, DEPTH_FLOOR) + 1.0);
}

// True if the value is positive and finite. Tests the bits, because a compiler may treat comparisons with
// infinities and NaN as it likes.
fn positive(value: f32) -> bool {
    let bits = bitcast<u32>(value);
    return bits > 0u && bits < INFINITE;
}

fn says(z: f32, known: f32) -> bool {
    return positive(z) && positive(known);
}
