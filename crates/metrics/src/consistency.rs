//! Measures if two views of a rendered scene agree where they see the same surface.
//!
//! **Along optical flow**, with any distance: view 2 is warped into view 1, both are multiplied by the
//! mask, and the distance of the two masked images is computed, in one direction, without division by the
//! mask's area. With LPIPS this is wLPIPS, whose flows and masks come from the *captured* images and are
//! shared by all methods. Absolute values depend on the masked share.
//!
//! **Along geometry**, without any network: every pixel of view 1 with a known depth z is projected into
//! view 2, `X = o + z Rᵀ d(p)`, `p₂ = π₂(X)`, and is visible there if view 2's depth at p₂ agrees with X's
//! within a relative tolerance. `w∆E` is the mean CIEDE2000 over visible pixels, `wSSIM` the mean SSIM over
//! windows in which all pixels are visible. These have their own masks, and their numbers are not
//! comparable with flow-based ones.

use rayon::prelude::*;
use use3d_capture::{Camera, Image, Map};
use use3d_numerics::sums;

use crate::ciede2000::delta_e_of_lab;
use crate::error::{MetricError, finite, large_enough, same_size};
use crate::lab::difference_of_lab;
use crate::mask::blacked_out;
use crate::ms_ssim::WINDOW;
use crate::ssim::ssim_map;
use crate::warp::{Flow, Mask, Warped, backward_warp};

/// A distance between masked, aligned images. Errors have the caller's type.
///
/// # Errors
/// The rasters have different sizes, the mask is empty ([`MetricError::NothingInCommon`], as `E`), or
/// `distance` fails.
pub fn warped_distance<E: From<MetricError>>(
    first: &Image,
    second: &Image,
    flow: &Flow,
    mask: &Mask,
    distance: impl FnOnce(&Image, &Image) -> Result<f64, E>,
) -> Result<f64, E> {
    same_size("the flow", first, flow)?;
    same_size("the mask", first, mask)?;
    let warped = backward_warp(second, flow)?;
    let nothing = |e| if e == MetricError::NothingCounts { MetricError::NothingInCommon } else { e };
    let masked = |image: &Image| blacked_out(image, mask).map_err(nothing);
    distance(&masked(first)?, &masked(&warped.image)?)
}

/// A view with its geometry.
#[derive(Clone, Copy, Debug)]
pub struct GeometricView<'a> {
    /// Its camera.
    pub camera: &'a Camera,
    /// Depth along the optical axis at pixel centres, scene units; 0 where unknown.
    pub depth: &'a Map,
}

/// The positions of the pixels of one view in another, and the mask of those that are visible there.
///
/// `tolerance` is the largest relative difference of depths that counts as the same surface; 0.02 is a good
/// value for rendered depth.
///
/// # Errors
/// A depth map does not have its camera's size, or has values that are not finite.
pub fn geometric_warp(
    first: GeometricView<'_>,
    second: GeometricView<'_>,
    tolerance: f64,
) -> Result<(Flow, Mask), MetricError> {
    for view in [first, second] {
        let k = &view.camera.intrinsics;
        same_size("the depth map", &Map::new(k.width, k.height), view.depth)?;
        large_enough("geometric warping", view.depth, 1)?;
        finite("the depth map", view.depth)?;
    }
    let (width, height) = (first.depth.width(), first.depth.height());
    let center = first.camera.pose.center();
    let to_world = first.camera.pose.rotation.transpose();
    let carry = |x: usize, y: usize| -> Option<[f32; 2]> {
        let z = f64::from(first.depth.pixel(x, y)[0]);
        if z <= 0.0 {
            return None;
        }
        let (u, v) = (x as f64 + 0.5, y as f64 + 0.5);
        let (pixel, depth) = second.camera.project(center + to_world * (z * first.camera.ray(u, v)))?;
        // Converts pixel coordinates to indices.
        let (i, j) = (pixel.x - 0.5, pixel.y - 0.5);
        let (last_x, last_y) = (second.depth.width() as f64 - 1.0, second.depth.height() as f64 - 1.0);
        if !(i >= 0.0 && j >= 0.0 && i <= last_x && j <= last_y) {
            return None;
        }
        // Every sample from which the colour is interpolated must show the same surface, so that colours do
        // not mix across edges.
        let same = |column: usize, row: usize| {
            let seen = f64::from(second.depth.pixel(column, row)[0]);
            seen > 0.0 && (seen - depth).abs() <= tolerance * depth
        };
        let (left, top) = (i as usize, j as usize);
        let (right, bottom) = (i.ceil() as usize, j.ceil() as usize);
        let visible = same(left, top) && same(right, top) && same(left, bottom) && same(right, bottom);
        visible.then_some([(i - x as f64) as f32, (j - y as f64) as f32])
    };
    let rows: Vec<Vec<Option<[f32; 2]>>> =
        (0..height).into_par_iter().map(|y| (0..width).map(|x| carry(x, y)).collect()).collect();
    let (mut flow, mut mask) = (Flow::new(width, height), Mask::new(width, height));
    for (y, row) in rows.into_iter().enumerate() {
        for (x, displacement) in row.into_iter().enumerate() {
            if let Some(d) = displacement {
                flow.set_pixel(x, y, d);
                mask.set_pixel(x, y, [1]);
            }
        }
    }
    Ok((flow, mask))
}

/// A geometric consistency measure of one pair.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Consistency {
    /// The mean over the visible part; `None` if nothing is visible.
    pub value: Option<f64>,
    /// The share of pixels (of windows, for SSIM) that counted.
    pub coverage: f64,
}

fn aligned(first: &Image, second: &Image, flow: &Flow, mask: &Mask) -> Result<Image, MetricError> {
    same_size("the flow", first, flow)?;
    same_size("the mask", first, mask)?;
    finite("the first image", first)?;
    let Warped { image, .. } = backward_warp(second, flow)?;
    Ok(image)
}

pub(crate) fn mean_where(map: &Map, counts: impl Fn(usize) -> bool + Sync) -> Consistency {
    let n = map.pixels();
    let [sum, count] = sums::sums::<2>(n, |i, t| {
        if counts(i) {
            t[0] += f64::from(map.data()[i]);
            t[1] += 1.0;
        }
    });
    Consistency { value: (count > 0.0).then(|| sum / count), coverage: count / n as f64 }
}

/// `w∆E`: mean CIEDE2000 between view 1 and view 2 warped into it, over visible pixels (see
/// [`geometric_warp`]).
///
/// # Errors
/// The rasters have different sizes, or values that are not finite.
pub fn warped_delta_e(
    first: &Image,
    second: &Image,
    flow: &Flow,
    mask: &Mask,
) -> Result<Consistency, MetricError> {
    let carried = aligned(first, second, flow, mask)?;
    let visible = |i: usize| mask.data()[i] != 0;
    let map = difference_of_lab("CIEDE2000", first, &carried, delta_e_of_lab, visible)?;
    Ok(mean_where(&map, visible))
}

/// `wSSIM`: mean SSIM over the windows whose pixels are all visible (see [`geometric_warp`]).
///
/// # Errors
/// The rasters have different sizes, a side below 11 pixels, or values that are not finite.
pub fn warped_ssim(
    first: &Image,
    second: &Image,
    flow: &Flow,
    mask: &Mask,
) -> Result<Consistency, MetricError> {
    let carried = aligned(first, second, flow, mask)?;
    let map = ssim_map(first, &carried)?;
    let whole = whole_windows(mask);
    Ok(mean_where(&map, |i| whole[i]))
}

/// For every window, true if all its pixels are in the mask (computed by counts along rows, then columns).
pub(crate) fn whole_windows(mask: &Mask) -> Vec<bool> {
    let (width, height) = (mask.width(), mask.height());
    let (columns, rows) = (width + 1 - WINDOW, height + 1 - WINDOW);
    let along: Vec<bool> = (0..height)
        .flat_map(|y| {
            let row = mask.row(0, y);
            (0..columns).map(move |x| row[x..x + WINDOW].iter().all(|&m| m != 0))
        })
        .collect();
    (0..rows * columns)
        .map(|i| (0..WINDOW).all(|k| along[(i / columns + k) * columns + i % columns]))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DMat3, DVec3};
    use use3d_capture::{Intrinsics, Pose};
    use use3d_numerics::math;

    const SIZE: (usize, usize) = (60, 44);

    fn camera(x: f64) -> Camera {
        let intrinsics = Intrinsics { width: SIZE.0, height: SIZE.1, fx: 50.0, fy: 50.0, cx: 30.0, cy: 22.0 };
        Camera { intrinsics, pose: Pose::from_center(DMat3::IDENTITY, DVec3::new(x, 0.0, 0.0)) }
    }

    /// A plane at z = 5 with a smooth pattern, and optionally a nearer square in front of it.
    fn view(camera: &Camera, square: bool) -> (Image, Map) {
        let (mut image, mut depth) = (Image::new(SIZE.0, SIZE.1), Map::new(SIZE.0, SIZE.1));
        let center = camera.pose.center();
        for y in 0..SIZE.1 {
            for x in 0..SIZE.0 {
                let ray = camera.ray(x as f64 + 0.5, y as f64 + 0.5);
                let near = center + 2.0 * ray;
                let hit = square && near.x.abs() < 0.3 && near.y.abs() < 0.3;
                let z = if hit { 2.0 } else { 5.0 };
                let p = center + z * ray;
                let value = if hit { 0.9 } else { 0.5 + 0.3 * math::sin(2.0 * p.x) * math::cos(1.5 * p.y) };
                image.set_pixel(x, y, [value as f32, 0.4, 1.0 - value as f32]);
                depth.set_pixel(x, y, [z as f32]);
            }
        }
        (image, depth)
    }

    #[test]
    fn a_consistent_scene_agrees_and_what_is_hidden_does_not_count() {
        let (a, b) = (camera(0.0), camera(0.4));
        for square in [false, true] {
            let ((image_a, depth_a), (image_b, depth_b)) = (view(&a, square), view(&b, square));
            let first = GeometricView { camera: &a, depth: &depth_a };
            let second = GeometricView { camera: &b, depth: &depth_b };
            let (flow, mask) = geometric_warp(first, second, 0.02).unwrap();
            // The plane moves by f b / z = 4 pixels.
            assert!((flow.pixel(50, 5)[0] + 4.0).abs() < 1e-4);
            let delta = warped_delta_e(&image_a, &image_b, &flow, &mask).unwrap();
            let similarity = warped_ssim(&image_a, &image_b, &flow, &mask).unwrap();
            assert!(delta.value.unwrap() < 0.3 && similarity.value.unwrap() > 0.99);
            assert!(delta.coverage > 0.6 && delta.coverage < 0.95);
            let everywhere = Mask::filled(SIZE.0, SIZE.1, 1);
            if square {
                let unmasked = warped_delta_e(&image_a, &image_b, &flow, &everywhere).unwrap();
                assert!(unmasked.value.unwrap() > 10.0 * delta.value.unwrap());
            }
            let mut changed = image_b.clone();
            changed.plane_mut(1).fill(0.6);
            let other = warped_delta_e(&image_a, &changed, &flow, &mask).unwrap();
            assert!(other.value.unwrap() > 5.0);
            let nothing = warped_delta_e(&image_a, &image_b, &flow, &Mask::new(SIZE.0, SIZE.1)).unwrap();
            assert_eq!(nothing, Consistency { value: None, coverage: 0.0 });
        }
        let wrong = Map::new(3, 3);
        let bad = GeometricView { camera: &a, depth: &wrong };
        assert!(geometric_warp(bad, bad, 0.02).is_err());
    }

    #[test]
    fn any_distance_sees_the_masked_pair() {
        let image = Image::filled(20, 16, 0.5);
        let (flow, mut mask) = (Flow::new(20, 16), Mask::filled(20, 16, 1));
        mask.data_mut()[..20].fill(0);
        let sum = |image: &Image| image.data().iter().map(|&v| f64::from(v)).sum::<f64>();
        let distance = |a: &Image, b: &Image| Ok::<f64, MetricError>(sum(a) + sum(b));
        let found = warped_distance(&image, &image, &flow, &mask, distance).unwrap();
        assert_eq!(found, 3.0 * 15.0 * 20.0);
        let none = warped_distance(&image, &image, &flow, &Mask::new(20, 16), distance);
        assert_eq!(none, Err(MetricError::NothingInCommon), "not a perfect 0 between two black images");
        let small = Mask::new(2, 2);
        assert!(warped_distance(&image, &image, &flow, &small, distance).is_err());
    }
}
