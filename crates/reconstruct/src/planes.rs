//! The depth of a place that no triangle of tracked points covers, from the plane of the nearest points.
//!
//! Tracks end where the pictures end and where an even ground has no features, but the ground goes on. The
//! inverse depth of a plane is linear in the image, so near a pixel p with the tracked points i beside it
//!
//! ```text
//! 1/z_i ≈ a + b·(u_i − p)         u_i pixels, z_i depths; a, b by weighted least squares, NEAREST points
//! w_i = r_i / (|u_i − p|²/s² + 1) s one cell of the grid; r_i a Cauchy weight at the scale of the residuals
//! σ_a² = σ² (Xᵀ W X)⁻¹₀₀          σ² the weighted mean square residual
//! ```
//!
//! gives the depth `1/a` at p. It is believed if the residuals are small (σ ≤ [`ROUGH`] a), if the plane is
//! well known there (σ_a ≤ [`UNSURE`] a), if the nearest point is closer than [`FARTHEST`] of the width, and
//! if `a` is within the range of the points' inverse depths, widened by [`WIDER`]. The last rule also ends
//! the ground before its horizon, where inverse depths go to zero.
//!
//! Pixels and depths are in the units of the view's camera. A ground that bends beyond the last points is
//! taken for even there; the views must agree on a place before a Gaussian starts at it.

use glam::{DMat3, DVec2, DVec3};

/// Number of tracked points that a plane is fitted to.
pub(crate) const NEAREST: usize = 24;
/// Number of points that a fit needs.
const FEWEST: usize = 8;
/// Largest residual of the points, as a share of the inverse depth.
const ROUGH: f64 = 0.15;
/// Largest standard error of the inverse depth, as a share of it.
const UNSURE: f64 = 0.1;
/// Largest distance to the nearest tracked point, as a share of the width.
const FARTHEST: f64 = 0.3;
/// Factor by which an inverse depth may leave the range of the points' inverse depths.
const WIDER: f64 = 1.5;
/// Rounds of reweighting.
const ROUNDS: usize = 3;

/// A tracked point: pixel position and inverse depth.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Anchor {
    pub(crate) at: DVec2,
    pub(crate) inverse: f64,
}

/// The inverse depth at a pixel position, with the weights of the anchors that it comes from (they sum to
/// one); `None` where it is not believed. `step` is the size of a grid cell, pixels.
pub(crate) fn inverse_depth(
    anchors: &[Anchor],
    at: DVec2,
    step: f64,
    width: f64,
) -> Option<(f64, Vec<(usize, f64)>)> {
    let mut nearest: Vec<(f64, usize)> =
        anchors.iter().enumerate().map(|(i, a)| (a.at.distance_squared(at), i)).collect();
    if nearest.len() > NEAREST {
        nearest.select_nth_unstable_by(NEAREST - 1, |a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        nearest.truncate(NEAREST);
    }
    nearest.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let (first, ..) = nearest.first()?;
    if nearest.len() < FEWEST || first.sqrt() > FARTHEST * width {
        return None;
    }
    let mut robust = vec![1.0; nearest.len()];
    let mut fitted = None;
    for _ in 0..ROUNDS {
        let (plane, inverse_normal) = fit(anchors, &nearest, &robust, at, step)?;
        let residual = |i: usize| {
            let off = (anchors[i].at - at) / step;
            anchors[i].inverse - plane.dot(DVec3::new(1.0, off.x, off.y))
        };
        let residuals: Vec<f64> = nearest.iter().map(|(_, i)| residual(*i)).collect();
        let weight = |k: usize| robust[k] / (nearest[k].0 / (step * step) + 1.0);
        let total: f64 = (0..nearest.len()).map(weight).sum();
        let square = (0..nearest.len()).map(|k| weight(k) * residuals[k] * residuals[k]).sum::<f64>() / total;
        fitted = Some((plane.x, square, square * inverse_normal.x_axis.x));
        let scale = 2.0 * median(residuals.iter().map(|r| r.abs()).collect());
        if scale <= 1e-12 * plane.x.abs() {
            break;
        }
        robust = residuals.iter().map(|r| 1.0 / (1.0 + (r / scale) * (r / scale))).collect();
    }
    let (inverse, square, variance) = fitted?;
    let of_points = || nearest.iter().map(|(_, i)| anchors[*i].inverse);
    let (low, high) = (of_points().fold(f64::INFINITY, f64::min), of_points().fold(0.0, f64::max));
    let believed = inverse >= low / WIDER
        && inverse <= high * WIDER
        && square.sqrt() <= ROUGH * inverse
        && variance.max(0.0).sqrt() <= UNSURE * inverse;
    if !believed {
        return None;
    }
    let shares: Vec<f64> = nearest.iter().map(|(d, _)| 1.0 / (d / (step * step) + 1.0)).collect();
    let total: f64 = shares.iter().sum();
    Some((inverse, nearest.iter().zip(shares).map(|((_, i), share)| (*i, share / total)).collect()))
}

/// The weighted least-squares plane (constant, slope per cell along x and y), and the inverse of its normal
/// matrix; `None` if the points do not determine it.
fn fit(
    anchors: &[Anchor],
    nearest: &[(f64, usize)],
    robust: &[f64],
    at: DVec2,
    step: f64,
) -> Option<(DVec3, DMat3)> {
    let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
    for ((square, i), robust) in nearest.iter().zip(robust) {
        let off = (anchors[*i].at - at) / step;
        let row = DVec3::new(1.0, off.x, off.y);
        let weight = robust / (square / (step * step) + 1.0);
        normal += DMat3::from_cols(row * row.x, row * row.y, row * row.z) * weight;
        right += row * (weight * anchors[*i].inverse);
    }
    let scale = normal.x_axis.x * normal.y_axis.y * normal.z_axis.z;
    if normal.determinant() <= 1e-6 * scale {
        return None;
    }
    let inverse = normal.inverse();
    Some((inverse * right, inverse))
}

fn median(mut values: Vec<f64>) -> f64 {
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use use3d_numerics::random::{Purpose, Stream};

    use super::*;

    /// Points of the plane 0.5 + x/400 − y/800 left of x = 120, with relative noise.
    fn anchors(noise: f64) -> Vec<Anchor> {
        let stream = Stream::new(7, Purpose::new("anchors"), 0);
        (0..200u64)
            .map(|i| {
                let at = DVec2::new(120.0 * stream.uniform(4 * i), 240.0 * stream.uniform(4 * i + 1));
                let inverse = 0.5 + at.x / 400.0 - at.y / 800.0;
                Anchor { at, inverse: inverse * (1.0 + noise * stream.normal(4 * i + 2)) }
            })
            .collect()
    }

    #[test]
    fn a_plane_goes_on_beyond_its_points() {
        for x in [60.0, 125.0, 160.0] {
            let at = DVec2::new(x, 100.0);
            let (inverse, shares) = inverse_depth(&anchors(0.0), at, 4.0, 320.0).unwrap();
            assert!((inverse - (0.5 + x / 400.0 - 0.125)).abs() < 1e-9, "{x}: {inverse}");
            assert!((shares.iter().map(|s| s.1).sum::<f64>() - 1.0).abs() < 1e-12);
        }
        let (inverse, _) = inverse_depth(&anchors(0.01), DVec2::new(130.0, 100.0), 4.0, 320.0).unwrap();
        assert!((inverse / 0.7 - 1.0).abs() < 0.05, "{inverse}");
    }

    #[test]
    fn what_is_not_known_is_left_alone() {
        let at = DVec2::new(130.0, 100.0);
        // Too far from the last point, a rough surface, too few points, points on one line.
        assert!(inverse_depth(&anchors(0.0), DVec2::new(230.0, 100.0), 4.0, 320.0).is_none());
        assert!(inverse_depth(&anchors(0.5), at, 4.0, 320.0).is_none());
        assert!(inverse_depth(&anchors(0.0)[..5], at, 4.0, 320.0).is_none());
        let line: Vec<Anchor> =
            (0..40).map(|i| Anchor { at: DVec2::new(110.0, f64::from(5 * i)), inverse: 0.5 }).collect();
        assert!(inverse_depth(&line, at, 4.0, 320.0).is_none());
        assert!(inverse_depth(&[], at, 4.0, 320.0).is_none());
        // Beyond the horizon inverse depths would be negative.
        let steep: Vec<Anchor> = anchors(0.0)
            .into_iter()
            .map(|a| Anchor { inverse: 0.5 - a.at.x / 250.0, ..a })
            .filter(|a| a.inverse > 0.05)
            .collect();
        assert!(inverse_depth(&steep, DVec2::new(150.0, 100.0), 4.0, 320.0).is_none());
    }

    #[test]
    fn single_wrong_points_do_not_bend_the_plane() {
        let mut points = anchors(0.0);
        points.iter_mut().step_by(9).for_each(|p| p.inverse *= 1.3);
        let (inverse, _) = inverse_depth(&points, DVec2::new(125.0, 100.0), 4.0, 320.0).unwrap();
        assert!((inverse / 0.6875 - 1.0).abs() < 0.03, "{inverse}");
    }
}
