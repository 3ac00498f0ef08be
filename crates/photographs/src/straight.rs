//! A photograph as a pinhole would have taken it: for programs that know no distortion.
//!
//! Every pixel of the pinhole's picture is read in the photograph at the place where the lens shows its ray,
//! bilinearly; beyond the outermost pixel centres the edge continues. So these photographs are resampled,
//! which costs some sharpness.

use fearless_simd::{Level, dispatch};
use rayon::prelude::*;
use use3d_capture::Intrinsics;
use use3d_survey::Lens;

use crate::sample::Sample;

/// Pixels between places that are computed; others are read between these.
const STEP: usize = 8;

/// [`crate::straight()`] for one type of sample.
pub(crate) fn read<T: Sample>(
    (pixels, channels): (&[T], usize),
    (width, height): (usize, usize),
    lens: &Lens,
    k: &Intrinsics,
) -> Vec<T> {
    let mut out = vec![T::of(0.0); k.width * k.height * channels];
    if pixels.len() < width * height * channels || out.is_empty() || width * height == 0 {
        return Vec::new();
    }
    let place = |x: usize, y: usize| {
        let (u, v) = ((x as f64 + 0.5 - k.cx) / k.fx, (y as f64 + 0.5 - k.cy) / k.fy);
        let (px, py) = lens.project(u, v);
        [px as f32 - 0.5, py as f32 - 0.5]
    };
    let knots = k.width.div_ceil(STEP) + 1;
    let level = Level::new();
    out.par_chunks_mut(k.width * channels * STEP).enumerate().for_each(|(block, lines)| {
        let knots_of = |y: usize| -> Vec<[f32; 2]> { (0..knots).map(|i| place(i * STEP, y)).collect() };
        let (above, below) = (knots_of(block * STEP), knots_of((block + 1) * STEP));
        dispatch!(level, _simd => {
            for (row, line) in lines.chunks_mut(k.width * channels).enumerate() {
                let down = row as f32 / STEP as f32;
                for (x, pixel) in line.chunks_exact_mut(channels).enumerate() {
                    let (i, across) = (x / STEP, (x % STEP) as f32 / STEP as f32);
                    let mix = |a: f32, b: f32, t: f32| a + t * (b - a);
                    let at = |axis: usize| {
                        let top = mix(above[i][axis], above[i + 1][axis], across);
                        mix(top, mix(below[i][axis], below[i + 1][axis], across), down)
                    };
                    let (u, v) = (at(0).clamp(0.0, (width - 1) as f32), at(1).clamp(0.0, (height - 1) as f32));
                    let (x0, y0) = (u as usize, v as usize);
                    let (x1, y1) = ((x0 + 1).min(width - 1), (y0 + 1).min(height - 1));
                    let (fx, fy) = (u - x0 as f32, v - y0 as f32);
                    for (c, value) in pixel.iter_mut().enumerate() {
                        let of = |x: usize, y: usize| pixels[(y * width + x) * channels + c].value();
                        let top = mix(of(x0, y0), of(x1, y0), fx);
                        *value = T::of(mix(top, mix(of(x0, y1), of(x1, y1), fx), fy));
                    }
                }
            }
        });
    });
    out
}

#[cfg(test)]
mod tests {
    use use3d_survey::Distortion;

    use super::*;

    #[test]
    fn a_distorted_slope_comes_out_straight_and_a_pinhole_as_it_is() {
        let (w, h) = (200usize, 150usize);
        let plain = Lens::pinhole([180.0, 180.0], [100.0, 75.0]);
        let numerator = [-0.18, 0.03, 0.0, 0.0, 0.0, 0.0];
        let bent = Lens { distortion: Distortion { numerator, ..Distortion::default() }, ..plain };
        // The slope of each ray is its value: linear in a pinhole's picture.
        let mut photograph = vec![0.0f32; w * h * 3];
        for (i, pixel) in photograph.chunks_exact_mut(3).enumerate() {
            let (u, v) = bent.unproject((i % w) as f64 + 0.5, (i / w) as f64 + 0.5).expect("a ray");
            pixel.copy_from_slice(&[u as f32, v as f32, 1.0]);
        }
        let pinhole = Intrinsics { width: 160, height: 120, fx: 180.0, fy: 180.0, cx: 80.0, cy: 60.0 };
        let out = read((&photograph, 3), (w, h), &bent, &pinhole);
        for (i, pixel) in out.chunks_exact(3).enumerate() {
            let (u, v) = (((i % 160) as f32 + 0.5 - 80.0) / 180.0, ((i / 160) as f32 + 0.5 - 60.0) / 180.0);
            // A tenth of a pixel.
            assert!((pixel[0] - u).abs() < 0.1 / 180.0 && (pixel[1] - v).abs() < 0.1 / 180.0, "{i}");
        }
        let same = Intrinsics { width: w, height: h, fx: 180.0, fy: 180.0, cx: 100.0, cy: 75.0 };
        let bytes: Vec<u8> = (0..w * h).map(|i| (i * 7 % 251) as u8).collect();
        assert_eq!(read((&bytes, 1), (w, h), &plain, &same), bytes);
    }
}
