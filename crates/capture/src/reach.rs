//! The parts of the pictures that tracks reach, over all views of a camera.
//!
//! The picture is divided into a grid of cells, and each sighting of a sparse point counts in its cell. A
//! cell that fewer than one view in ten reaches is bare: nothing there was found again in another picture, so
//! the scene cannot be learnt there.

use serde::Serialize;

use crate::Intrinsics;

/// Columns and rows of the grid.
const GRID: [usize; 2] = [20, 12];
/// A cell is bare if it has fewer sightings than this share of the views.
const BARE: f64 = 0.1;
/// A column or row is bare if this share of its cells is.
const WHOLE: f64 = 0.9;
/// Fewer views say nothing about a camera.
const VIEWS: usize = 3;
/// Fewer sightings per cell, as a multiple of the number that makes a cell bare, say nothing either.
const ENOUGH: f64 = 5.0;
/// An angle of view, degrees, above which bare parts of the pictures may come from a wrong lens.
const WIDE: f64 = 90.0;
/// A bare side of at least this share of the picture is a sign of a wrong lens.
const SIDE: f64 = 0.1;

/// A side of a picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Side {
    /// The left edge.
    Left,
    /// The right edge.
    Right,
    /// The upper edge.
    Top,
    /// The lower edge.
    Bottom,
}

/// The reach of the tracks in the pictures of one camera.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Reach {
    /// Width and height of the pictures, pixels.
    pub size: [usize; 2],
    /// The horizontal [angle of view](Intrinsics::angle), degrees.
    pub angle: f64,
    /// The number of views.
    pub views: usize,
    /// Sightings in each cell, row by row from the top.
    pub cells: Vec<Vec<usize>>,
    /// The share of the cells that are bare.
    pub bare: f64,
    /// The bare borders, the widest first, with their widths as shares of the picture.
    pub borders: Vec<(Side, f64)>,
}

impl Reach {
    /// True if a cell is bare.
    pub fn is_bare(&self, column: usize, row: usize) -> bool {
        (self.cells[row][column] as f64) < (BARE * self.views as f64).max(1.0)
    }

    /// True if a border other than the upper one is bare over at least the share `width` of the picture. Open
    /// water and sky are usually at the top, and have no points anywhere.
    pub fn has_bare_side(&self, width: f64) -> bool {
        self.borders.iter().any(|(side, bare)| *bare >= width && *side != Side::Top)
    }

    /// True if the lens is probably too wide: the angle of view is above 90 degrees, and at least a tenth of
    /// the picture is bare at a side. A path along the scene hardly determines the lens, and a wrong one fits
    /// a part of the pictures only.
    pub fn is_too_wide(&self) -> bool {
        self.angle > WIDE && self.has_bare_side(SIDE)
    }

    /// The first with the largest bare share.
    pub fn worst(reaches: &[Self]) -> Option<&Self> {
        reaches.iter().reduce(|a, b| if b.bare > a.bare { b } else { a })
    }

    fn new(camera: &Intrinsics, views: usize, cells: Vec<Vec<usize>>) -> Self {
        let size = [camera.width, camera.height];
        let mut reach = Self { size, angle: camera.angle(), views, cells, bare: 0.0, borders: Vec::new() };
        let [columns, rows] = GRID;
        let count = (0..rows).flat_map(|r| (0..columns).map(move |c| (c, r)));
        reach.bare = count.filter(|&(c, r)| reach.is_bare(c, r)).count() as f64 / (columns * rows) as f64;
        let column =
            |c: usize| (0..rows).filter(|&r| reach.is_bare(c, r)).count() as f64 >= WHOLE * rows as f64;
        let row =
            |r: usize| (0..columns).filter(|&c| reach.is_bare(c, r)).count() as f64 >= WHOLE * columns as f64;
        let borders = [
            (Side::Left, (0..columns).take_while(|&c| column(c)).count(), columns),
            (Side::Right, (0..columns).rev().take_while(|&c| column(c)).count(), columns),
            (Side::Top, (0..rows).take_while(|&r| row(r)).count(), rows),
            (Side::Bottom, (0..rows).rev().take_while(|&r| row(r)).count(), rows),
        ];
        let widths = borders.map(|(side, bare, of)| (side, bare as f64 / of as f64));
        reach.borders = widths.into_iter().filter(|(_, width)| *width > 0.0).collect();
        reach.borders.sort_by(|a, b| b.1.total_cmp(&a.1));
        reach
    }
}

/// The reach of each camera that has enough views and sightings. `of_view` has the index of each view's
/// camera. A sighting is the index of its view with its place in the picture, `x` and `y` in pixels.
pub fn reaches(
    cameras: &[Intrinsics],
    of_view: &[usize],
    sightings: impl Iterator<Item = (usize, [f64; 2])>,
) -> Vec<Reach> {
    let [columns, rows] = GRID;
    let mut cells = vec![vec![vec![0; columns]; rows]; cameras.len()];
    for (view, [x, y]) in sightings {
        let Some(&camera) = of_view.get(view) else { continue };
        let (w, h) = (cameras[camera].width as f64, cameras[camera].height as f64);
        if x >= 0.0 && y >= 0.0 && x < w && y < h {
            let cell =
                |at: f64, side: f64, count: usize| ((at / side * count as f64) as usize).min(count - 1);
            cells[camera][cell(y, h, rows)][cell(x, w, columns)] += 1;
        }
    }
    let found = cameras.iter().zip(cells).enumerate().filter_map(|(i, (camera, cells))| {
        let views = of_view.iter().filter(|&&c| c == i).count();
        let mean = cells.iter().flatten().sum::<usize>() as f64 / (columns * rows) as f64;
        let enough = views >= VIEWS && mean >= ENOUGH * (BARE * views as f64).max(1.0);
        enough.then(|| Reach::new(camera, views, cells))
    });
    found.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cells(reached: impl Fn(usize, usize) -> bool) -> Vec<Vec<usize>> {
        (0..GRID[1]).map(|r| (0..GRID[0]).map(|c| if reached(c, r) { 9 } else { 0 }).collect()).collect()
    }

    const CAMERA: Intrinsics =
        Intrinsics { width: 200, height: 120, fx: 100.0, fy: 100.0, cx: 100.0, cy: 60.0 };

    #[test]
    fn bare_borders_are_found_the_widest_first() {
        let all = Reach::new(&CAMERA, 10, cells(|_, _| true));
        assert_eq!((all.bare, all.borders), (0.0, Vec::new()));
        assert!((all.angle - 90.0).abs() < 1e-9, "{}", all.angle);
        let right = Reach::new(&CAMERA, 10, cells(|c, r| c < 12 && r > 0));
        assert_eq!(right.borders, [(Side::Right, 0.4), (Side::Top, 1.0 / 12.0)]);
        assert!((right.bare - (0.4 + 0.6 / 12.0)).abs() < 1e-12, "{}", right.bare);
        let bottom = Reach::new(&CAMERA, 10, cells(|_, r| r < 9));
        assert_eq!(bottom.borders, [(Side::Bottom, 0.25)]);
        // One stray sighting in many views leaves a cell bare.
        let mut stray = cells(|c, _| c > 9);
        stray[5][0] = 1;
        assert_eq!(Reach::new(&CAMERA, 30, stray).borders, [(Side::Left, 0.5)]);
    }

    #[test]
    fn only_a_wide_angle_with_a_bare_side_is_too_wide() {
        let wide = Intrinsics { fx: 80.0, fy: 80.0, ..CAMERA };
        let of = |camera, reached: fn(usize, usize) -> bool| Reach::new(camera, 10, cells(reached));
        assert!(of(&wide, |c, _| c < 12).is_too_wide());
        assert!(!of(&CAMERA, |c, _| c < 12).is_too_wide());
        assert!(!of(&wide, |_, r| r > 4).is_too_wide(), "open water is above");
        assert!(!of(&wide, |c, _| c < 19).is_too_wide(), "a narrow border");
    }

    #[test]
    fn sightings_count_for_the_camera_of_their_view() {
        let cameras = [CAMERA, Intrinsics { width: 400, ..CAMERA }];
        let of_view = [0, 0, 0, 1, 1, 1];
        let all = (0..6).flat_map(|view| {
            let width = cameras[of_view[view]].width;
            // The second camera sees nothing in its right half.
            let seen = if view < 3 { width } else { width / 2 };
            (0..seen * 12).map(move |k| (view, [(k % seen) as f64, 10.0 * (k / seen) as f64 + 5.0]))
        });
        let stray = [(6, [1.0, 1.0]), (0, [-1.0, 5.0]), (0, [200.0, 5.0])];
        let found = reaches(&cameras, &of_view, all.chain(stray));
        assert_eq!(found.iter().map(|reach| reach.views).collect::<Vec<_>>(), [3, 3]);
        assert_eq!((found[0].bare, found[1].borders.clone()), (0.0, vec![(Side::Right, 0.5)]));
        assert_eq!(found[0].cells[0][0], 30);
    }
}
