//! Backward warping along a flow, and the pixels where a flow can be trusted.
//!
//! For every pixel p of view 1, a flow f12 gives its position in view 2: `p + f12(p)`, in pixel *indices*
//! (the centre of the first pixel is (0, 0)). Backward warping samples view 2 there, bilinearly. The sample
//! is valid if the target lies in `[0, W-1] × [0, H-1]`, and 0 otherwise.
//!
//! Occlusions are found by following the flow forward and back: `e = f12(p) + f21(p + f12(p))` should
//! vanish. Two thresholds are in public use:
//!
//! * Sundaram, Brox & Keutzer (ECCV 2010): `|e|² ≤ 0.01 (|f12|² + |f21(p + f12)|²) + 0.5`, the default;
//! * one pixel: `|e| ≤ 1`.

use rayon::prelude::*;
use use3d_capture::{Image, Raster};
use use3d_numerics::math;

use crate::error::{MetricError, finite, large_enough, same_size};

/// Displacements (dx, dy) in pixels.
pub type Flow = Raster<f32, 2>;
/// A mask of the pixels that count: 1 or 0.
pub type Mask = Raster<u8, 1>;

/// An image warped into another view.
#[derive(Clone, Debug, PartialEq)]
pub struct Warped {
    /// Sampled colours; 0 where the target lies outside.
    pub image: Image,
    /// 1 where the target lies inside the other view.
    pub inside: Mask,
}

/// The position of a pixel's target between four samples: the upper left one, and the shares of the right
/// and lower ones.
struct Target {
    index: usize,
    right: usize,
    below: usize,
    share: [f32; 2],
}

/// The target of a position; `None` outside `[0, W-1] × [0, H-1]`.
#[inline]
fn target(x: f32, y: f32, width: usize, height: usize) -> Option<Target> {
    let (last_x, last_y) = ((width - 1) as f32, (height - 1) as f32);
    if !(x >= 0.0 && y >= 0.0 && x <= last_x && y <= last_y) {
        return None;
    }
    let (column, row) = (x as usize, y as usize);
    Some(Target {
        index: row * width + column,
        right: usize::from(column + 1 < width),
        below: if row + 1 < height { width } else { 0 },
        share: [x - column as f32, y - row as f32],
    })
}

impl Target {
    #[inline]
    fn sample(&self, plane: &[f32]) -> f32 {
        let [u, v] = self.share;
        let (i, below) = (self.index, self.index + self.below);
        let upper = plane[i] + u * (plane[i + self.right] - plane[i]);
        let lower = plane[below] + u * (plane[below + self.right] - plane[below]);
        upper + v * (lower - upper)
    }
}

/// Samples `C` planes of `source` at `p + flow(p)`.
fn sample_along<const C: usize>(source: &Raster<f32, C>, flow: &Flow) -> (Raster<f32, C>, Mask) {
    let (width, height) = (flow.width(), flow.height());
    let mut image = Raster::new(width, height);
    let mut inside = Mask::new(width, height);
    let rows: Vec<(Vec<[f32; C]>, Vec<u8>)> = (0..height)
        .into_par_iter()
        .map(|y| {
            let (dx, dy) = (flow.row(0, y), flow.row(1, y));
            let (mut values, mut valid) = (vec![[0.0; C]; width], vec![0u8; width]);
            for x in 0..width {
                let (u, v) = (x as f32 + dx[x], y as f32 + dy[x]);
                if let Some(target) = target(u, v, source.width(), source.height()) {
                    values[x] = std::array::from_fn(|c| target.sample(source.plane(c)));
                    valid[x] = 1;
                }
            }
            (values, valid)
        })
        .collect();
    for (y, (values, valid)) in rows.into_iter().enumerate() {
        inside.data_mut()[y * width..(y + 1) * width].copy_from_slice(&valid);
        for c in 0..C {
            let line = &mut image.plane_mut(c)[y * width..(y + 1) * width];
            for (o, v) in line.iter_mut().zip(&values) {
                *o = v[c];
            }
        }
    }
    (image, inside)
}

/// Samples `image` at `p + flow(p)`; the result has the flow's size.
///
/// # Errors
/// The image or flow has no pixels, or values that are not finite.
pub fn backward_warp(image: &Image, flow: &Flow) -> Result<Warped, MetricError> {
    large_enough("warping", image, 1)?;
    large_enough("warping", flow, 1)?;
    finite("the image", image)?;
    finite("the flow", flow)?;
    let (image, inside) = sample_along(image, flow);
    Ok(Warped { image, inside })
}

/// The result of following a flow forward and back.
#[derive(Clone, Debug, PartialEq)]
pub struct ForwardBackward {
    /// `|f12(p) + f21(p + f12(p))|²`, px²; f21 is 0 outside.
    pub error_squared: Raster<f32, 1>,
    /// `|f12|² + |f21(p + f12)|²`, px².
    pub magnitude_squared: Raster<f32, 1>,
    /// 1 where the target lies inside the other view.
    pub inside: Mask,
}

/// Compares a flow with the flow back.
///
/// # Errors
/// The flows have different sizes, no pixels, or values that are not finite.
pub fn forward_backward(f12: &Flow, f21: &Flow) -> Result<ForwardBackward, MetricError> {
    same_size("the backward flow", f12, f21)?;
    large_enough("a flow", f12, 1)?;
    finite("the forward flow", f12)?;
    finite("the backward flow", f21)?;
    let (back, inside) = sample_along(f21, f12);
    let (width, height) = (f12.width(), f12.height());
    let combine = |f: fn([f32; 2], [f32; 2]) -> f32| {
        let mut out = Raster::new(width, height);
        for (p, o) in out.data_mut().iter_mut().enumerate() {
            let at = |flow: &Flow| [flow.plane(0)[p], flow.plane(1)[p]];
            *o = f(at(f12), at(&back));
        }
        out
    };
    Ok(ForwardBackward {
        error_squared: combine(|a, b| math::powi(a[0] + b[0], 2) + math::powi(a[1] + b[1], 2)),
        magnitude_squared: combine(|a, b| a[0] * a[0] + a[1] * a[1] + b[0] * b[0] + b[1] * b[1]),
        inside,
    })
}

impl ForwardBackward {
    /// The mask of targets inside with `|e|² ≤ relative (|f12|² + |f21|²) + absolute`; the usual values are
    /// 0.01 and 0.5.
    pub fn relative_mask(&self, relative: f32, absolute: f32) -> Mask {
        let mut mask = self.inside.clone();
        let pairs = self.error_squared.data().iter().zip(self.magnitude_squared.data());
        for (m, (error, magnitude)) in mask.data_mut().iter_mut().zip(pairs) {
            *m &= u8::from(*error <= relative * magnitude + absolute);
        }
        mask
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shift_is_undone_and_its_border_is_outside() {
        let (width, height) = (12, 9);
        let data = (0..3 * width * height).map(|i| (i % 97) as f32 / 97.0).collect();
        let image = Image::from_planes(width, height, data).unwrap();
        let mut flow = Flow::new(width, height);
        flow.plane_mut(0).fill(2.0);
        flow.plane_mut(1).fill(-1.0);
        let warped = backward_warp(&image, &flow).unwrap();
        for y in 0..height {
            for x in 0..width {
                let inside = x + 2 < width && y >= 1;
                assert_eq!(warped.inside.pixel(x, y), [u8::from(inside)]);
                let expected = if inside { image.pixel(x + 2, y - 1) } else { [0.0; 3] };
                assert_eq!(warped.image.pixel(x, y), expected);
            }
        }
        let back = flow.map(|v| -v);
        let check = forward_backward(&flow, &back).unwrap();
        assert_eq!(check.relative_mask(0.01, 0.5), warped.inside);
        let wrong = forward_backward(&flow, &flow).unwrap();
        assert_eq!(wrong.relative_mask(0.0, 1.0).data().iter().map(|&v| u32::from(v)).sum::<u32>(), 0);
        assert!(forward_backward(&flow, &Flow::new(3, 3)).is_err());
        flow.plane_mut(0)[5] = f32::NAN;
        assert!(backward_warp(&image, &flow).is_err());
    }
}
