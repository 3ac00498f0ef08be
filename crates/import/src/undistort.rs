//! Resamples the image of a distorting lens to that of a pinhole camera.
//!
//! **Choice of the pinhole.** It keeps the lens's focal lengths, so that the centre of the picture keeps its
//! resolution. It shows the largest field whose every pixel the photograph covers, so there are no black
//! borders (like COLMAP's undistorter without blank pixels, and OpenCV with `alpha = 0`). The field is found
//! on the plane `z = 1`: from the ray of the image's centre outwards, in 720 directions and those of the four
//! corners, up to the point where the lens leaves the sensor, folds, or exceeds 80°. The rectangle is bounded
//! by the innermost points of the left, right, top and bottom borders. If folds cut into it, it shrinks about
//! the centre until it is free of them. A side is at most twice as long as the photograph's (very wide
//! fisheyes are cropped).
//!
//! **Resampling.** Each pinhole pixel centre is mapped through the lens to a position in the photograph, and
//! the photograph is read there: colours and masks bilinearly, depths at the nearest pixel.

use std::sync::OnceLock;

use use3d_capture::{Intrinsics, Raster};
#[cfg(test)]
use use3d_io_colmap::LensModel;
use use3d_numerics::math;
use use3d_survey::Lens;

const DIRECTIONS: usize = 720;
const STEPS: usize = 256;
/// Rays at a larger angle to the image centre's ray than this are not shown.
const WIDEST: f64 = 80.0 * std::f64::consts::PI / 180.0;
/// A lens that moves no pixel by more than this is treated as a pinhole, pixels.
const NEGLIGIBLE: f64 = 0.01;

/// The reason why the field ends in one direction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum End {
    Left,
    Right,
    Top,
    Bottom,
    Fold,
}

/// True if the lens is a pinhole for images of this size, within [`NEGLIGIBLE`] pixels.
pub(crate) fn is_pinhole(lens: &Lens, width: usize, height: usize) -> bool {
    if lens.is_pinhole() {
        return true;
    }
    let ([fx, fy], [cx, cy]) = (lens.focal, lens.principal);
    (0..=32usize).all(|i| {
        (0..=32usize).all(|j| {
            let (x, y) = (width as f64 * i as f64 / 32.0, height as f64 * j as f64 / 32.0);
            let (px, py) = lens.project((x - cx) / fx, (y - cy) / fy);
            math::hypot(px - x, py - y) < NEGLIGIBLE
        })
    })
}

/// A lens whose images cannot be undistorted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum LensFault {
    /// The model has no such lens.
    #[error("it is not there")]
    Absent,
    /// No ray reaches the middle of the image.
    #[error("its distortion parameters are unusable: no ray reaches the middle of the image")]
    NoRay,
    /// The lens maps two rays near the middle to one pixel.
    #[error("its distortion parameters are unusable: the lens folds in the middle of the image")]
    Folds,
    /// No pixel is left.
    #[error("its distortion parameters are unusable: they leave no field of view")]
    NoField,
}

/// The pinhole for a lens and image size, if the lens leaves a usable field.
pub(crate) fn choose_pinhole(lens: &Lens, width: usize, height: usize) -> Result<Intrinsics, LensFault> {
    let (w, h) = (width as f64, height as f64);
    let center = lens.unproject(0.5 * w, 0.5 * h).ok_or(LensFault::NoRay)?;

    let inside = |u: f64, v: f64| {
        let ((x, y), j) = lens.project_with_jacobian(u, v);
        j[0][0] * j[1][1] - j[0][1] * j[1][0] > 0.0 && (0.0..=w).contains(&x) && (0.0..=h).contains(&y)
    };
    if !inside(center.0, center.1) {
        return Err(LensFault::Folds);
    }
    let corners = [(0.0, 0.0), (w, 0.0), (0.0, h), (w, h)];
    let to_corners = corners
        .iter()
        .filter_map(|&(x, y)| lens.unproject(x, y))
        .map(|(u, v)| math::atan2(v - center.1, u - center.0));
    let around = (0..DIRECTIONS).map(|i| std::f64::consts::TAU * i as f64 / DIRECTIONS as f64);

    let mut ends = Vec::with_capacity(DIRECTIONS + 4);
    for direction in around.chain(to_corners) {
        let (sin, cos) = math::sin_cos(direction);
        let at = |t: f64| {
            let r = math::tan(t * WIDEST);
            (center.0 + r * cos, center.1 + r * sin)
        };
        let step = |i: usize| i as f64 / STEPS as f64;
        let first_out = (1..=STEPS).find(|&i| {
            let (u, v) = at(step(i));
            !inside(u, v)
        });
        let (mut low, mut high) = first_out.map_or((1.0, 1.0), |i| (step(i - 1), step(i)));
        for _ in 0..50 {
            let middle = 0.5 * (low + high);
            let (u, v) = at(middle);
            if inside(u, v) { low = middle } else { high = middle }
        }
        let (u, v) = at(low);
        let (x, y) = lens.project(u, v);
        let near = [(x, End::Left), (w - x, End::Right), (y, End::Top), (h - y, End::Bottom)];
        let (distance, side) = near.into_iter().min_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or((w, End::Fold));
        ends.push((u, v, if distance < 1e-3 { side } else { End::Fold }));
    }

    // The rectangle between the innermost points of the four borders.
    type Axis = fn(&(f64, f64, End)) -> f64;
    let innermost = |side: End, of: Axis, sign: f64| {
        let pick = |all: bool| {
            let values = ends.iter().filter(|e| all || e.2 == side).map(|e| sign * of(e));
            values.reduce(if all { f64::max } else { f64::min })
        };
        sign * pick(false).or(pick(true)).unwrap_or(0.0)
    };
    let (u, v): (Axis, Axis) = (|e| e.0, |e| e.1);
    let left = innermost(End::Left, u, -1.0);
    let right = innermost(End::Right, u, 1.0);
    let top = innermost(End::Top, v, -1.0);
    let bottom = innermost(End::Bottom, v, 1.0);

    // It shrinks until no end of the field is inside it.
    let mut share = 1.0f64;
    for &(u, v, _) in &ends {
        let (du, dv) = (u - center.0, v - center.1);
        let across = du / if du < 0.0 { left - center.0 } else { right - center.0 };
        let down = dv / if dv < 0.0 { top - center.1 } else { bottom - center.1 };
        share = share.min(across.max(down));
    }
    let ([fx, fy], [cx, cy]) = (lens.focal, lens.principal);
    let side = |low: f64, high: f64, middle: f64, focal: f64, principal: f64, most: f64| {
        let middle = middle * focal + principal;
        let low = middle + share * (low * focal + principal - middle);
        let high = middle + share * (high * focal + principal - middle);
        let (low, high) = (low.max(middle - most), high.min(middle + most));
        let pixels = (high - low + 1e-6).floor();
        (pixels, principal - (low + 0.5 * (high - low - pixels)))
    };
    let (out_w, out_cx) = side(left, right, center.0, fx, cx, w);
    let (out_h, out_cy) = side(top, bottom, center.1, fy, cy, h);
    if !(out_w >= 1.0 && out_h >= 1.0) {
        return Err(LensFault::NoField);
    }
    Ok(Intrinsics { width: out_w as usize, height: out_h as usize, fx, fy, cx: out_cx, cy: out_cy })
}

/// The pinhole to which photographs of `width × height` pixels taken through a lens are undistorted: the
/// lens's own if it bends nothing.
///
/// # Errors
/// The lens leaves no usable field.
pub fn pinhole_of(lens: &Lens, width: usize, height: usize) -> Result<Intrinsics, LensFault> {
    if is_pinhole(lens, width, height) {
        return Ok(lens.intrinsics(width, height));
    }
    choose_pinhole(lens, width, height)
}

/// A lens, its images' size, and the pinhole they are resampled to.
#[derive(Debug)]
pub(crate) struct Undistortion {
    lens: Lens,
    source: (usize, usize),
    pub(crate) pinhole: Intrinsics,
    /// The position to read for each pinhole pixel, kept if several images share the lens.
    table: Option<OnceLock<Vec<[f32; 2]>>>,
}

impl Undistortion {
    pub(crate) fn new(lens: Lens, width: usize, height: usize) -> Result<Self, LensFault> {
        let pinhole = choose_pinhole(&lens, width, height)?;
        Ok(Self { lens, source: (width, height), pinhole, table: None })
    }

    /// Keeps the table of positions after its first use (8 bytes per pixel).
    pub(crate) fn keep_table(&mut self) {
        self.table = Some(OnceLock::new());
    }

    /// Maps a position in the photograph to its position in the pinhole's image; `None` outside the lens's
    /// field.
    pub(crate) fn undistort_point(&self, x: f64, y: f64) -> Option<(f64, f64)> {
        let (u, v) = self.lens.unproject(x, y)?;
        Some((u * self.pinhole.fx + self.pinhole.cx, v * self.pinhole.fy + self.pinhole.cy))
    }

    fn position(&self, column: usize, row: usize) -> [f32; 2] {
        let k = &self.pinhole;
        let (u, v) = ((column as f64 + 0.5 - k.cx) / k.fx, (row as f64 + 0.5 - k.cy) / k.fy);
        let (x, y) = self.lens.project(u, v);
        [x as f32, y as f32]
    }

    /// Calls `write(p, x, y)` for every pinhole pixel `p` with the position to read.
    fn for_each_position(&self, mut write: impl FnMut(usize, f32, f32)) {
        let (w, h) = (self.pinhole.width, self.pinhole.height);
        let at = |p: usize| self.position(p % w, p / w);
        let table = self.table.as_ref().map(|table| table.get_or_init(|| (0..w * h).map(at).collect()));
        for p in 0..w * h {
            let [x, y] = table.map_or_else(|| at(p), |table| table[p]);
            write(p, x, y);
        }
    }

    /// Reads bilinearly; beyond the outermost pixel centres the edge values continue. `source` must have the
    /// lens's image size.
    pub(crate) fn apply<T: Copy + Into<f32>, const C: usize>(&self, source: &Raster<T, C>) -> Raster<f32, C> {
        debug_assert_eq!((source.width(), source.height()), self.source);
        let (w, h) = (source.width(), source.height());
        let mut out = Raster::<f32, C>::new(self.pinhole.width, self.pinhole.height);
        let n = out.pixels();
        let planes = source.planes();
        let (last_x, last_y) = ((w - 1) as f32, (h - 1) as f32);
        let data = out.data_mut();
        self.for_each_position(|p, x, y| {
            let (x, y) = ((x - 0.5).clamp(0.0, last_x), (y - 0.5).clamp(0.0, last_y));
            let (x0, y0) = (x as usize, y as usize);
            let (fx, fy) = (x - x0 as f32, y - y0 as f32);
            let (x1, y1) = ((x0 + 1).min(w - 1), (y0 + 1).min(h - 1));
            for c in 0..C {
                let at = |x: usize, y: usize| -> f32 { planes[c][y * w + x].into() };
                let top = at(x0, y0) + fx * (at(x1, y0) - at(x0, y0));
                let bottom = at(x0, y1) + fx * (at(x1, y1) - at(x0, y1));
                data[c * n + p] = top + fy * (bottom - top);
            }
        });
        out
    }

    /// Reads the nearest pixel: for depths, which must not be mixed across edges.
    pub(crate) fn apply_nearest(&self, source: &Raster<f32, 1>) -> Raster<f32, 1> {
        let (w, h) = (source.width(), source.height());
        let mut out = Raster::<f32, 1>::new(self.pinhole.width, self.pinhole.height);
        let data = out.data_mut();
        self.for_each_position(|p, x, y| {
            let x = (x.max(0.0) as usize).min(w - 1);
            let y = (y.max(0.0) as usize).min(h - 1);
            data[p] = source.data()[y * w + x];
        });
        out
    }
}

#[cfg(test)]
#[path = "../../io-colmap/tests/common/lenses.rs"]
mod lenses;

#[cfg(test)]
mod tests {
    use super::lenses::example;
    use super::*;
    use use3d_capture::Image;

    #[test]
    fn the_pinhole_shows_only_what_the_photograph_covers_and_not_much_less() {
        for model in LensModel::ALL.into_iter().skip(2) {
            for amount in [0.3, 1.0] {
                let (w, h) = (1000usize, 700usize);
                let lens = example(model, amount);
                let k = choose_pinhole(&lens, w, h).unwrap();
                assert!(k.width > 400 && k.height > 300, "{model:?}: {}x{}", k.width, k.height);
                let corner = |x: f64, y: f64| lens.project((x - k.cx) / k.fx, (y - k.cy) / k.fy);
                // Every point of the border is on the photograph, within the sampling of directions.
                let mut slack = [f64::INFINITY; 4];
                for i in 0..=400 {
                    let t = f64::from(i) / 400.0;
                    let (kw, kh) = (k.width as f64, k.height as f64);
                    for (x, y) in
                        [corner(t * kw, 0.0), corner(t * kw, kh), corner(0.0, t * kh), corner(kw, t * kh)]
                    {
                        assert!(
                            x > -0.5 && x < w as f64 + 0.5 && y > -0.5 && y < h as f64 + 0.5,
                            "{model:?} {x} {y}"
                        );
                        let gaps = [x, w as f64 - x, y, h as f64 - y];
                        for (s, g) in slack.iter_mut().zip(gaps) {
                            *s = s.min(g);
                        }
                    }
                }
                // The field reaches at least two opposite borders within a pixel and a half.
                let reached = slack.iter().filter(|s| **s < 1.5).count();
                assert!(reached >= 2, "{model:?} {amount}: gaps {slack:?}");
            }
        }
    }

    #[test]
    fn a_lens_that_does_nothing_is_a_pinhole() {
        let almost = LensModel::SimpleRadial.lens(&[800.0, 500.0, 350.0, 1e-7]).unwrap();
        assert!(is_pinhole(&almost, 1000, 700));
        let real = LensModel::SimpleRadial.lens(&[800.0, 500.0, 350.0, 1e-2]).unwrap();
        assert!(!is_pinhole(&real, 1000, 700));
        let k = choose_pinhole(&LensModel::Pinhole.lens(&[800.0, 800.0, 500.0, 350.0]).unwrap(), 1000, 700);
        let k = k.unwrap();
        assert_eq!((k.width, k.height), (1000, 700));
        assert!((k.cx - 500.0).abs() < 1e-3 && (k.cy - 350.0).abs() < 1e-3);
    }

    #[test]
    fn unusable_lenses_are_refused() {
        let folded = LensModel::SimpleRadial.lens(&[800.0, -4000.0, 350.0, -2.0]).unwrap();
        assert!(choose_pinhole(&folded, 1000, 700).is_err());
    }

    /// A smooth picture of the directions of rays, photographed analytically through the lens, is undistorted
    /// to the picture that the pinhole would have photographed.
    #[test]
    fn a_distorted_picture_comes_out_as_the_pinhole_would_have_taken_it() {
        let picture = |u: f64, v: f64| {
            let s = |x: f64| 0.5 + 0.4 * math::sin(x);
            [s(9.0 * u + 2.0 * v), s(7.0 * v - u), s(5.0 * (u + v)) * s(6.0 * u)]
        };
        for model in LensModel::ALL.into_iter().skip(2) {
            let (w, h) = (500usize, 350usize);
            let lens = example(model, 1.0).scaled(0.5, 0.5);
            let mut photograph = Image::new(w, h);
            for y in 0..h {
                for x in 0..w {
                    let (u, v) = lens.unproject(x as f64 + 0.5, y as f64 + 0.5).unwrap();
                    photograph.set_pixel(x, y, picture(u, v).map(|c| c as f32));
                }
            }
            let mut undistortion = Undistortion::new(lens, w, h).unwrap();
            let out = undistortion.apply(&photograph);
            undistortion.keep_table();
            assert_eq!(out, undistortion.apply(&photograph), "with and without the table");
            let k = undistortion.pinhole;
            let mut worst = 0.0f32;
            for y in 1..k.height - 1 {
                for x in 1..k.width - 1 {
                    let (u, v) = ((x as f64 + 0.5 - k.cx) / k.fx, (y as f64 + 0.5 - k.cy) / k.fy);
                    for (a, b) in out.pixel(x, y).iter().zip(picture(u, v)) {
                        worst = worst.max((a - b as f32).abs());
                    }
                }
            }
            assert!(worst < 6e-3, "{model:?}: {worst}");
            // Points move together with the picture.
            let (x, y) = undistortion.undistort_point(123.4, 210.9).unwrap();
            let (u, v) = lens.unproject(123.4, 210.9).unwrap();
            assert!((x - (u * k.fx + k.cx)).abs() < 1e-9 && (y - (v * k.fy + k.cy)).abs() < 1e-9);
        }
    }
}
