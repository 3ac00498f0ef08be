// The Pearson loss against a depth prior. Two passes of sums, the second around the means of the first: f32
// then suffices where the processor sums in f64. The results between passes: 0 count, 1 mean of disparities,
// 2 mean of priors, 3 slope of the own deviation, 4 slope of the other, 5 loss.

const FEWEST_PIXELS: f32 = 32.0;
const DEPTH_SCALE: f32 = 10.0;
const DEPTH_FLOOR: f32 = 1e-6;
const DEVIATION_FLOOR: f32 = 1e-6;
const INFINITE: u32 = 0x7f800000u;

fn disparity(z: f32) -> f32 {
    return 1.0 / (DEPTH_SCALE * max(z, DEPTH_FLOOR) + 1.0);
}

// Finite by its bits: a compiler may take comparisons with infinities and NaN as it likes.
fn positive(value: f32) -> bool {
    let bits = bitcast<u32>(value);
    return bits > 0u && bits < INFINITE;
}

fn says(z: f32, known: f32) -> bool {
    return positive(z) && positive(known);
}
