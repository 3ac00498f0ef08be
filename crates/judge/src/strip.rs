//! The same spot of the scene in neighbouring views, cropped and enlarged. It shows if an appearance flickers
//! or stays the same.
//!
//! The candidates are points on a grid over the middle view, lifted by its rendered depth, that all views see
//! (inside by half a crop, depths agreeing within 5 %). Those whose surroundings have the most contrast in
//! the photograph are compared, and the one that stands best for all pairs of views is shown: there the
//! movements `m_k` of the appearances have most nearly the ratios of their mean scores `e_k`, so that
//! `Σ abs(m_k / Σ m − e_k / Σ e)` is least. Without scores the one with the most contrast is shown.
//!
//! The movement of a spot is that of its mean colour from view to view, CIEDE2000, the largest over pairs of
//! views.

use serde::{Deserialize, Serialize};
use use3d_capture::{Camera, Image, Map};
use use3d_metrics::{delta_e_of_lab, lab_of_srgb};
use use3d_numerics::math;

/// Longest side of a crop, pixels.
const SIDE: usize = 96;
/// Factor by which crops are enlarged.
const ZOOM: usize = 2;
/// White between crops, pixels of the sheet.
const GAP: usize = 6;
/// Candidates that are compared.
const COMPARED: usize = 40;
/// Relative difference of depths that counts as the same surface.
const SAME_SURFACE: f64 = 0.05;

/// The description of a strip's picture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Strip {
    /// Columns: the views' names.
    pub views: Vec<String>,
    /// Rows: appearances, with their mean change of colour between neighbouring views, CIEDE2000, if it is
    /// known.
    pub rows: Vec<(String, Option<f64>)>,
    /// Side of the crops before they are enlarged, pixels.
    pub side: usize,
    /// Upper left corner of each view's crop, pixels.
    pub corners: Vec<(usize, usize)>,
}

/// One view: camera, rendered depth, photograph.
pub struct StripView<'a> {
    /// The camera.
    pub camera: &'a Camera,
    /// Depth along the optical axis.
    pub depth: &'a Map,
    /// The photograph.
    pub photograph: &'a Image,
}

/// The side of crops of views of this size.
fn side(width: usize, height: usize) -> usize {
    (width.min(height) / 3).clamp(1, SIDE)
}

/// The crop's upper left corner around image coordinates, if it lies inside.
fn corner(u: f64, v: f64, side: usize, (width, height): (usize, usize)) -> Option<(usize, usize)> {
    let (x, y) = ((u - 0.5 * side as f64).round(), (v - 0.5 * side as f64).round());
    let inside = x >= 0.0 && y >= 0.0 && x + side as f64 <= width as f64 && y + side as f64 <= height as f64;
    inside.then_some((x as usize, y as usize))
}

/// The upper left corner of the crop in every view, around the spot under pixel `(x, y)` of the middle view;
/// `None` if a view does not see it.
fn track(
    views: &[StripView<'_>],
    middle: usize,
    (x, y): (usize, usize),
    side: usize,
) -> Option<Vec<(usize, usize)>> {
    let StripView { camera, depth, .. } = &views[middle];
    let z = f64::from(depth.pixel(x, y)[0]);
    if !(z.is_finite() && z > 0.0) {
        return None;
    }
    let pose = &camera.pose;
    let point =
        pose.rotation.transpose() * (z * camera.ray(x as f64 + 0.5, y as f64 + 0.5) - pose.translation);
    let place = |view: &StripView<'_>| {
        let (at, expected) = view.camera.project(point)?;
        let size = (view.depth.width(), view.depth.height());
        let place = corner(at.x, at.y, side, size)?;
        let rendered = f64::from(view.depth.pixel(at.x as usize, at.y as usize)[0]);
        ((rendered - expected).abs() <= SAME_SURFACE * expected).then_some(place)
    };
    views.iter().map(place).collect()
}

/// The variance of a crop's luma.
fn contrast(image: &Image, (left, top): (usize, usize), side: usize) -> f64 {
    let (mut sum, mut square) = (0.0, 0.0);
    for y in top..top + side {
        for x in left..left + side {
            let [r, g, b] = image.pixel(x, y).map(f64::from);
            let luma = 0.299 * r + 0.587 * g + 0.114 * b;
            sum += luma;
            square += luma * luma;
        }
    }
    let n = (side * side) as f64;
    square / n - math::powi(sum / n, 2)
}

/// An appearance in all views, and its mean change of colour between neighbouring views, if it is known.
pub type StripRow<'a> = (Vec<&'a Image>, Option<f64>);

/// The side of the crops, and the upper left corner of each view's crop; `None` if no spot is seen by all
/// views.
pub fn choose(views: &[StripView<'_>], rows: &[StripRow<'_>]) -> Option<(usize, Vec<(usize, usize)>)> {
    let middle = views.len() / 2;
    let photograph = views.get(middle)?.photograph;
    let (width, height) = (photograph.width(), photograph.height());
    let side = side(width, height);
    let sizes_agree = |v: &StripView<'_>| {
        (v.depth.width(), v.depth.height()) == (v.photograph.width(), v.photograph.height())
            && v.photograph.width().min(v.photograph.height()) >= side
    };
    if !views.iter().all(sizes_agree) {
        return None;
    }
    let step = (side / 4).max(1);
    let mut seen: Vec<(f64, Vec<(usize, usize)>)> = Vec::new();
    for y in (side / 2..height).step_by(step) {
        for x in (side / 2..width).step_by(step) {
            let Some(corners) = track(views, middle, (x, y), side) else { continue };
            seen.push((contrast(photograph, corners[middle], side), corners));
        }
    }
    seen.sort_by(|a, b| b.0.total_cmp(&a.0));
    seen.truncate(COMPARED);
    let expected: Option<Vec<f64>> = rows.iter().map(|(_, mean)| *mean).collect();
    let strangeness = |corners: &[(usize, usize)]| {
        let moved: Vec<f64> = rows.iter().map(|(images, _)| movement(images, corners, side)).collect();
        let expected = expected.as_ref()?;
        let sums = [&moved, expected].map(|of| of.iter().sum::<f64>().max(1e-9));
        let apart = |(m, e): (&f64, &f64)| (m / sums[0] - e / sums[1]).abs();
        Some(moved.iter().zip(expected).map(apart).sum::<f64>())
    };
    let strange = seen.into_iter().map(|(_, corners)| (strangeness(&corners).unwrap_or(0.0), corners));
    // The first of equal ones has the most contrast.
    let best = strange.min_by(|a, b| a.0.total_cmp(&b.0));
    best.map(|(_, corners)| (side, corners))
}

/// The largest CIEDE2000 between the crops' mean colours.
fn movement(images: &[&Image], corners: &[(usize, usize)], side: usize) -> f64 {
    let mean = |(image, (left, top)): (&&Image, &(usize, usize))| {
        let mut sum = [0.0f64; 3];
        for y in *top..top + side {
            for x in *left..left + side {
                let pixel = image.pixel(x, y);
                (0..3).for_each(|c| sum[c] += f64::from(pixel[c].clamp(0.0, 1.0)));
            }
        }
        lab_of_srgb(sum.map(|s| (s / (side * side) as f64) as f32))
    };
    let means: Vec<[f64; 3]> = images.iter().zip(corners).map(mean).collect();
    let pairs =
        means.iter().enumerate().flat_map(|(i, a)| means[i + 1..].iter().map(|b| delta_e_of_lab(*a, *b)));
    pairs.fold(0.0, f64::max)
}

/// Arranges crops, one row per appearance and one column per view, each enlarged by whole pixels.
pub fn sheet(rows: &[StripRow<'_>], corners: &[(usize, usize)], side: usize) -> Image {
    let pitch = side * ZOOM + GAP;
    let [width, height] = [corners.len(), rows.len()].map(|count| (count * pitch).saturating_sub(GAP));
    let mut out = Image::filled(width, height, 1.0);
    for (r, (row, _)) in rows.iter().enumerate() {
        for (c, (image, (left, top))) in row.iter().zip(corners).enumerate() {
            for y in 0..side * ZOOM {
                for x in 0..side * ZOOM {
                    out.set_pixel(c * pitch + x, r * pitch + y, image.pixel(left + x / ZOOM, top + y / ZOOM));
                }
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_capture::{Intrinsics, Pose};

    /// A wall at depth 2 with a bright square, seen while moving sideways by 0.1 (4 pixels) per view.
    fn wall(view: usize) -> (Camera, Map, Image) {
        let intrinsics = Intrinsics { width: 90, height: 60, fx: 80.0, fy: 80.0, cx: 45.0, cy: 30.0 };
        let mut pose = Pose::IDENTITY;
        pose.translation.x = -0.1 * view as f64;
        let mut image = Image::filled(90, 60, 0.3);
        for y in 25..35 {
            for x in 50..60 {
                image.set_pixel(x - 4 * view, y, [0.9, 0.8, 0.1]);
            }
        }
        (Camera { intrinsics, pose }, Map::filled(90, 60, 2.0), image)
    }

    #[test]
    fn the_spot_with_contrast_is_followed_and_flicker_is_seen() {
        let walls: Vec<_> = (0..3).map(wall).collect();
        let seen: Vec<StripView<'_>> =
            walls.iter().map(|(camera, depth, photograph)| StripView { camera, depth, photograph }).collect();
        let (side, corners) = choose(&seen, &[]).expect("a spot");
        assert_eq!(side, 20);
        assert_eq!((corners[0].0 - corners[1].0, corners[1].0 - corners[2].0), (4, 4));
        let x = corners[1].0;
        assert!((36..=46).contains(&x), "the crop at {x} holds the square at 46..56 of the middle view");

        let still: Vec<&Image> = walls.iter().map(|w| &w.2).collect();
        let tinted = walls[1].2.map(|v| 0.8 * v);
        let flickers = vec![still[0], &tinted, still[2]];
        assert!(movement(&still, &corners, side) < 1e-9 && movement(&flickers, &corners, side) > 3.0);
        let rows = [(still, None), (flickers, None)];
        let sheet = sheet(&rows, &corners, side);
        assert_eq!((sheet.width(), sheet.height()), (3 * 40 + 2 * GAP, 2 * 40 + GAP));
        assert_eq!(sheet.pixel(0, 0), walls[0].2.pixel(corners[0].0, corners[0].1));
    }

    #[test]
    fn the_spot_stands_for_the_mean_of_all_pairs() {
        let walls: Vec<_> = (0..3).map(wall).collect();
        let seen: Vec<StripView<'_>> =
            walls.iter().map(|(camera, depth, photograph)| StripView { camera, depth, photograph }).collect();
        // One appearance flickers on the right half of the pictures, and another one everywhere.
        let still: Vec<&Image> = walls.iter().map(|w| &w.2).collect();
        let (mut half, all) = (walls[1].2.clone(), walls[1].2.map(|v| 0.8 * v));
        for y in 0..60 {
            (45..90).for_each(|x| half.set_pixel(x, y, all.pixel(x, y)));
        }
        let spot = |mean_of_half: f64| {
            let rows = [
                (vec![still[0], &half, still[2]], Some(mean_of_half)),
                (vec![still[0], &all, still[2]], Some(3.0)),
            ];
            choose(&seen, &rows).expect("a spot").1[1].0
        };
        assert!(spot(3.0) >= 45, "where both flicker alike");
        assert!(spot(0.0) + 20 <= 45, "where only the second one flickers");
    }

    #[test]
    fn without_a_common_spot_there_is_no_strip() {
        let (camera, depth, image) = wall(0);
        let mut away = camera;
        away.pose.translation.x = -50.0;
        let at = |camera| StripView { camera, depth: &depth, photograph: &image };
        assert_eq!(choose(&[at(&camera), at(&away)], &[]), None);
        let nothing = Map::new(90, 60);
        assert_eq!(choose(&[StripView { camera: &camera, depth: &nothing, photograph: &image }], &[]), None);
        assert_eq!(choose(&[], &[]), None);
    }
}
