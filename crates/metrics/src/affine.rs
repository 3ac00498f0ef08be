//! The affine map of colours that brings one image closest to another.
//!
//! `Σ |A x + b - y|²` over all pixels is smallest for `A = C_yx C_xx⁻¹` and `b = ȳ - A x̄`, with the means
//! `x̄`, `ȳ` and the centred second moments `C` of the two images' colours. These twelve numbers per image
//! can correct exposure, white balance, contrast and a cast; a difference that remains is one of structure.
//! Values are used unchanged; clipping is left to the caller.
//!
//! Along a direction in which the colours of `x` do not vary (a grey image has two such directions) the map
//! is not determined. That direction is left out, and the sum is still the smallest.

use use3d_capture::Image;
use use3d_numerics::sums;

use crate::error::{MetricError, comparable};

/// Directions with a variance below this share of the largest channel's count as constant: f32 values have
/// 24 bits.
const FLAT: f64 = 1e-12;

/// Rows `(A | b)`: red, green and blue of the image as functions of the colours of another.
pub type ColourMap = [[f64; 4]; 3];

/// The least-squares map from the colours of `x` to those of `y`.
///
/// # Errors
/// The images have different sizes, no pixels, or values that are not finite.
pub fn affine_fit(x: &Image, y: &Image) -> Result<ColourMap, MetricError> {
    comparable("an affine map", x, y, 1)?;
    let n = x.pixels();
    let value = |image: &Image, c: usize, i: usize| f64::from(image.plane(c)[i]);
    let mean = |image: &Image| {
        sums::sums::<3>(n, |i, t| (0..3).for_each(|c| t[c] += value(image, c, i))).map(|s| s / n as f64)
    };
    let (mx, my) = (mean(x), mean(y));
    // Each row has three moments with x, then three with y.
    let moments = sums::sums::<18>(n, |i, t| {
        let dx: [f64; 3] = std::array::from_fn(|c| value(x, c, i) - mx[c]);
        let dy: [f64; 3] = std::array::from_fn(|c| value(y, c, i) - my[c]);
        for r in 0..3 {
            for c in 0..3 {
                t[6 * r + c] += dx[r] * dx[c];
                t[6 * r + 3 + c] += dx[r] * dy[c];
            }
        }
    });
    let mut rows: [[f64; 6]; 3] = std::array::from_fn(|r| std::array::from_fn(|c| moments[6 * r + c]));
    let solved = eliminate(&mut rows);
    Ok(std::array::from_fn(|out| {
        let a: [f64; 3] = std::array::from_fn(|c| if solved[c] { rows[c][3 + out] } else { 0.0 });
        let b = my[out] - (0..3).map(|c| a[c] * mx[c]).sum::<f64>();
        [a[0], a[1], a[2], b]
    }))
}

/// Gauss-Jordan elimination of a symmetric, non-negative system with the largest diagonal entry as pivot.
/// Returns true for the unknowns that were solved; the others are free and set to zero.
fn eliminate(rows: &mut [[f64; 6]; 3]) -> [bool; 3] {
    let most = (0..3).map(|i| rows[i][i]).fold(0.0, f64::max);
    let mut solved = [false; 3];
    for _ in 0..3 {
        let left = (0..3).filter(|&i| !solved[i]);
        let Some(pivot) = left.max_by(|&a, &b| rows[a][a].total_cmp(&rows[b][b])) else { break };
        if rows[pivot][pivot] <= FLAT * most {
            break;
        }
        solved[pivot] = true;
        let by = rows[pivot][pivot];
        rows[pivot].iter_mut().for_each(|v| *v /= by);
        let head = rows[pivot];
        for (_, row) in rows.iter_mut().enumerate().filter(|(i, _)| *i != pivot) {
            let factor = row[pivot];
            row.iter_mut().zip(head).for_each(|(v, h)| *v -= factor * h);
        }
    }
    solved
}

/// The image with its colours mapped, unclipped.
pub fn map_colours(image: &Image, map: &ColourMap) -> Image {
    let mut out = Image::new(image.width(), image.height());
    let [r, g, b] = [0, 1, 2].map(|c| image.plane(c));
    for (c, row) in map.iter().enumerate() {
        for (i, v) in out.plane_mut(c).iter_mut().enumerate() {
            *v = (row[0] * f64::from(r[i]) + row[1] * f64::from(g[i]) + row[2] * f64::from(b[i]) + row[3])
                as f32;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_numerics::random::{Purpose, Stream};

    fn noise(seed: u64) -> Image {
        let stream = Stream::new(seed, Purpose::new("test colours"), 0);
        let mut image = Image::new(31, 17);
        image.data_mut().iter_mut().enumerate().for_each(|(i, v)| *v = stream.uniform(i as u64) as f32);
        image
    }

    fn square(x: &Image, y: &Image, map: &ColourMap) -> f64 {
        let mapped = map_colours(x, map);
        let pairs = mapped.data().iter().zip(y.data());
        pairs.map(|(a, b)| f64::from(a - b) * f64::from(a - b)).sum()
    }

    #[test]
    fn a_map_that_was_applied_is_found_again() {
        let x = noise(1);
        let map = [[0.9, 0.2, -0.1, 0.05], [-0.3, 1.4, 0.0, -0.2], [0.1, 0.1, 0.4, 0.3]];
        let found = affine_fit(&x, &map_colours(&x, &map)).unwrap();
        for (f, m) in found.as_flattened().iter().zip(map.as_flattened()) {
            assert!((f - m).abs() < 1e-6, "{found:?}");
        }
    }

    #[test]
    fn no_map_nearby_and_no_gain_comes_closer() {
        let (x, y) = (noise(2), noise(3));
        let found = affine_fit(&x, &y).unwrap();
        let least = square(&x, &y, &found);
        for k in 0..12 {
            for step in [1e-3, -1e-3] {
                let mut other = found;
                other.as_flattened_mut()[k] += step;
                assert!(square(&x, &y, &other) > least, "coefficient {k}");
            }
        }
        let gains = crate::exposure_gain(&x, &y, crate::ExposureFit::PerChannel).unwrap();
        let diagonal: ColourMap =
            std::array::from_fn(|c| std::array::from_fn(|k| if k == c { gains[c] } else { 0.0 }));
        assert!(square(&x, &y, &diagonal) > least);
    }

    #[test]
    fn colours_that_do_not_vary_leave_the_map_finite_and_best() {
        // A grey image has one direction, which is enough if y follows it.
        let mut grey = noise(4);
        let plane = grey.plane(0).to_vec();
        (1..3).for_each(|c| grey.plane_mut(c).copy_from_slice(&plane));
        let wanted = map_colours(&grey, &[[0.5, 0.0, 0.0, 0.1], [0.0, 0.7, 0.0, 0.2], [0.2, 0.0, 0.3, 0.0]]);
        let found = affine_fit(&grey, &wanted).unwrap();
        assert!(square(&grey, &wanted, &found) < 1e-9, "{found:?}");
        // A single colour is mapped to the mean of the other image.
        let y = noise(5);
        let flat = affine_fit(&Image::filled(31, 17, 0.3), &y).unwrap();
        let mean = y.plane(1).iter().map(|v| f64::from(*v)).sum::<f64>() / y.pixels() as f64;
        assert_eq!(flat[1][..3], [0.0; 3]);
        assert!((flat[1][3] - mean).abs() < 1e-9);
        assert!(affine_fit(&Image::new(3, 3), &y).is_err());
        assert!(affine_fit(&Image::filled(31, 17, f32::NAN), &y).is_err());
    }
}
