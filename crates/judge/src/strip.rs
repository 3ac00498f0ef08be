//! The same spot of the scene in neighbouring views, cropped and enlarged. It shows if an appearance flickers
//! or stays the same.
//!
//! The spot is chosen by geometry and by the photographs alone, never by an enhancement. The candidates are
//! points on a grid over the middle view, lifted by its rendered depth, that all views see (inside by half a
//! crop, depths agreeing within 5 %). The candidate whose surroundings have the most contrast in the
//! photograph is chosen.
//!
//! The movement of a spot's mean colour from view to view is given as CIEDE2000, the largest over pairs of
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
/// Relative difference of depths that counts as the same surface.
const SAME_SURFACE: f64 = 0.05;

/// The description of a strip's picture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Strip {
    /// Columns: the views' names.
    pub views: Vec<String>,
    /// Rows: appearances, with the movement of the mean colour between views, CIEDE2000.
    pub rows: Vec<(String, f64)>,
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

/// The side of the crops, and the upper left corner of each view's crop; `None` if no spot is seen by all
/// views.
pub fn choose(views: &[StripView<'_>]) -> Option<(usize, Vec<(usize, usize)>)> {
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
    let mut best: Option<(f64, Vec<(usize, usize)>)> = None;
    for y in (side / 2..height).step_by(step) {
        for x in (side / 2..width).step_by(step) {
            let Some(corners) = track(views, middle, (x, y), side) else { continue };
            let contrast = contrast(photograph, corners[middle], side);
            if best.as_ref().is_none_or(|(most, _)| contrast > *most) {
                best = Some((contrast, corners));
            }
        }
    }
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

/// Arranges crops, one row per appearance and one column per view, each enlarged by whole pixels. Also
/// returns the movement of the mean colour of each row.
pub fn sheet(rows: &[Vec<&Image>], corners: &[(usize, usize)], side: usize) -> (Image, Vec<f64>) {
    let pitch = side * ZOOM + GAP;
    let [width, height] = [corners.len(), rows.len()].map(|count| (count * pitch).saturating_sub(GAP));
    let mut out = Image::filled(width, height, 1.0);
    for (r, row) in rows.iter().enumerate() {
        for (c, (image, (left, top))) in row.iter().zip(corners).enumerate() {
            for y in 0..side * ZOOM {
                for x in 0..side * ZOOM {
                    out.set_pixel(c * pitch + x, r * pitch + y, image.pixel(left + x / ZOOM, top + y / ZOOM));
                }
            }
        }
    }
    (out, rows.iter().map(|row| movement(row, corners, side)).collect())
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
        let (side, corners) = choose(&seen).expect("a spot");
        assert_eq!(side, 20);
        assert_eq!((corners[0].0 - corners[1].0, corners[1].0 - corners[2].0), (4, 4));
        let x = corners[1].0;
        assert!((36..=46).contains(&x), "the crop at {x} holds the square at 46..56 of the middle view");

        let still: Vec<&Image> = walls.iter().map(|w| &w.2).collect();
        let tinted = walls[1].2.map(|v| 0.8 * v);
        let flickers = vec![still[0], &tinted, still[2]];
        let (sheet, moved) = sheet(&[still, flickers], &corners, side);
        assert_eq!((sheet.width(), sheet.height()), (3 * 40 + 2 * GAP, 2 * 40 + GAP));
        assert!(moved[0] < 1e-9 && moved[1] > 3.0, "{moved:?}");
        assert_eq!(sheet.pixel(0, 0), walls[0].2.pixel(corners[0].0, corners[0].1));
    }

    #[test]
    fn without_a_common_spot_there_is_no_strip() {
        let (camera, depth, image) = wall(0);
        let mut away = camera;
        away.pose.translation.x = -50.0;
        let at = |camera| StripView { camera, depth: &depth, photograph: &image };
        assert_eq!(choose(&[at(&camera), at(&away)]), None);
        let nothing = Map::new(90, 60);
        assert_eq!(choose(&[StripView { camera: &camera, depth: &nothing, photograph: &image }]), None);
        assert_eq!(choose(&[]), None);
    }
}
