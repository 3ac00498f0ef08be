//! Gaussian and Laplacian pyramids (Burt & Adelson, "The Laplacian pyramid as a compact image code", 1983).
//!
//! One level down: the binomial filter `(1, 4, 6, 4, 1) / 16` along both axes, every second pixel kept,
//! sides rounded up, edges repeated. One level up: its transpose up to scale, `(1, 6, 1) / 8` at even and
//! `(1, 1) / 2` at odd positions. A Laplacian level is an image minus its expanded next level, so summing
//! the levels from the top returns the image.

use rayon::prelude::*;
use use3d_capture::Raster;

/// Computes the next coarser level.
pub(super) fn reduce<const C: usize>(image: &Raster<f32, C>) -> Raster<f32, C> {
    binomial(image, 2)
}

/// The 5 × 5 binomial blur at every `step`-th pixel of every `step`-th row.
fn binomial<const C: usize>(image: &Raster<f32, C>, step: usize) -> Raster<f32, C> {
    let (w, h) = (image.width(), image.height());
    let narrow = horizontal(image, w.div_ceil(step), |row, x| {
        let at = |i: isize| row[((step * x) as isize + i).clamp(0, w as isize - 1) as usize];
        (at(-2) + at(2) + 4.0 * (at(-1) + at(1)) + 6.0 * at(0)) / 16.0
    });
    vertical(&narrow, h.div_ceil(step), |at, y| {
        let row = |i: isize| at(((step * y) as isize + i).clamp(0, h as isize - 1) as usize);
        let rows = [row(-2), row(-1), row(0), row(1), row(2)];
        move |x| (rows[0][x] + rows[4][x] + 4.0 * (rows[1][x] + rows[3][x]) + 6.0 * rows[2][x]) / 16.0
    })
}

/// Expands one level up to a given size (whose `reduce` has the image's own size).
pub(super) fn expand<const C: usize>(image: &Raster<f32, C>, width: usize, height: usize) -> Raster<f32, C> {
    let (w, h) = (image.width(), image.height());
    let wide = horizontal(image, width, |row, x| {
        let at = |i: isize| row[((x / 2) as isize + i).clamp(0, w as isize - 1) as usize];
        if x % 2 == 0 { (at(-1) + 6.0 * at(0) + at(1)) / 8.0 } else { (at(0) + at(1)) / 2.0 }
    });
    vertical(&wide, height, |at, y| {
        let row = |i: isize| at(((y / 2) as isize + i).clamp(0, h as isize - 1) as usize);
        let (rows, even) = ([row(-1), row(0), row(1)], y % 2 == 0);
        move |x| {
            if even {
                (rows[0][x] + 6.0 * rows[1][x] + rows[2][x]) / 8.0
            } else {
                (rows[1][x] + rows[2][x]) / 2.0
            }
        }
    })
}

/// The 5 × 5 binomial blur, same size.
pub(super) fn blur<const C: usize>(image: &Raster<f32, C>) -> Raster<f32, C> {
    binomial(image, 1)
}

fn horizontal<const C: usize>(
    image: &Raster<f32, C>,
    width: usize,
    value: impl Fn(&[f32], usize) -> f32 + Sync,
) -> Raster<f32, C> {
    let mut out = Raster::<f32, C>::new(width, image.height());
    out.data_mut().par_chunks_mut(width).zip(image.data().par_chunks(image.width())).for_each(
        |(out, row)| {
            for (x, o) in out.iter_mut().enumerate() {
                *o = value(row, x);
            }
        },
    );
    out
}

fn vertical<'a, const C: usize, F: Fn(usize) -> f32>(
    image: &'a Raster<f32, C>,
    height: usize,
    rows: impl Fn(&dyn Fn(usize) -> &'a [f32], usize) -> F + Sync,
) -> Raster<f32, C> {
    let width = image.width();
    let mut out = Raster::<f32, C>::new(width, height);
    out.data_mut().par_chunks_mut(width).enumerate().for_each(|(index, out)| {
        let value = rows(&|y| image.row(index / height, y), index % height);
        for (x, o) in out.iter_mut().enumerate() {
            *o = value(x);
        }
    });
    out
}

/// Number of levels of a pyramid whose top is at least 8 pixels on its short side, at most 7.
pub(super) fn levels(width: usize, height: usize) -> usize {
    let mut short = width.min(height);
    let mut count = 1;
    while count < 7 && short.div_ceil(2) >= 8 {
        short = short.div_ceil(2);
        count += 1;
    }
    count
}

/// The image and its reductions, finest first.
pub(super) fn gaussian<const C: usize>(image: Raster<f32, C>, levels: usize) -> Vec<Raster<f32, C>> {
    let mut out = vec![image];
    while out.len() < levels {
        let next = reduce(&out[out.len() - 1]);
        out.push(next);
    }
    out
}

/// Adds `weight · (level of the Laplacian pyramid of an image)` to each level of `sum`; both arguments are
/// Gaussian pyramids.
pub(super) fn add_laplacian(sum: &mut [Raster<f32, 3>], image: &[Raster<f32, 3>], weight: &[Raster<f32, 1>]) {
    for level in 0..sum.len() {
        let (w, h) = (image[level].width(), image[level].height());
        let below = image.get(level + 1).map_or_else(|| Raster::new(w, h), |next| expand(next, w, h));
        for c in 0..3 {
            let differences =
                image[level].plane(c).iter().zip(below.plane(c)).map(|(value, below)| value - below);
            for ((out, weight), difference) in
                sum[level].plane_mut(c).iter_mut().zip(weight[level].data()).zip(differences)
            {
                *out += weight * difference;
            }
        }
    }
}

/// The image whose Laplacian pyramid is `levels`.
pub(super) fn collapse(mut levels: Vec<Raster<f32, 3>>) -> Raster<f32, 3> {
    while levels.len() > 1 {
        let Some(top) = levels.pop() else { break };
        let last = levels.len() - 1;
        let below = &mut levels[last];
        let up = expand(&top, below.width(), below.height());
        for (b, u) in below.data_mut().iter_mut().zip(up.data()) {
            *b += u;
        }
    }
    levels.swap_remove(0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_numerics::math;

    fn wave(width: usize, height: usize) -> Raster<f32, 3> {
        let data = (0..3 * width * height).map(|i| math::sin(i as f32 * 0.37) * 0.5 + 0.5).collect();
        Raster::from_planes(width, height, data).unwrap()
    }

    #[test]
    fn a_pyramid_collapses_to_the_image() {
        for (w, h) in [(64, 48), (37, 51), (8, 8), (3, 90), (1, 1)] {
            let image = wave(w, h);
            let count = levels(w, h);
            let pyramid = gaussian(image.clone(), count);
            let ones = gaussian(Raster::<f32, 1>::filled(w, h, 1.0), count);
            assert!(ones.iter().all(|l| l.data().iter().all(|&v| (v - 1.0).abs() < 1e-6)));
            let mut sum: Vec<_> =
                pyramid.iter().map(|l| Raster::<f32, 3>::new(l.width(), l.height())).collect();
            add_laplacian(&mut sum, &pyramid, &ones);
            let back = collapse(sum);
            let error = back.data().iter().zip(image.data()).fold(0.0f32, |m, (a, b)| m.max((a - b).abs()));
            assert!(error < 1e-5, "{w}x{h}: {error}");
        }
    }

    #[test]
    fn filters_keep_constants() {
        let flat = Raster::<f32, 1>::filled(13, 9, 0.7);
        for image in [reduce(&flat), expand(&reduce(&flat), 13, 9), blur(&flat)] {
            assert!(image.data().iter().all(|&v| (v - 0.7).abs() < 1e-6));
        }
    }
}
