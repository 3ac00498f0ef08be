//! The structure of a photograph beside that of its render: energies of the detail of the luma over regions.
//!
//! ```text
//! f(x) = x − mean_m(x),    photograph = mean_n f(P)²,   render = mean_n f(R)²,   both = mean_n f(P) f(R)
//! ```
//!
//! with `m` = [`DETAIL`] and `n` = [`REGION`] of the width, squares of display values.

use use3d_capture::Image;

use crate::boxes::{mean, means};
use crate::known::{DETAIL, REGION, luma, radius};

/// The energies, one plane each.
#[derive(Clone, Debug)]
pub(crate) struct Structure {
    planes: Vec<f32>,
}

impl Structure {
    /// The energies of two pictures of one size.
    pub(crate) fn of(photograph: &Image, render: &Image) -> Self {
        let (w, h, n) = (photograph.width(), photograph.height(), photograph.pixels());
        let fine = |image: &Image| {
            let own = luma(image);
            let mut smooth = own.clone();
            mean(&mut smooth, w, radius(w, DETAIL, 2));
            own.iter().zip(&smooth).map(|(a, b)| a - b).collect::<Vec<f32>>()
        };
        let (p, r) = (fine(photograph), fine(render));
        let mut planes = vec![0.0f32; 3 * n];
        for i in 0..n {
            (planes[i], planes[n + i], planes[2 * n + i]) = (p[i] * p[i], r[i] * r[i], p[i] * r[i]);
        }
        means(&mut planes, w, h, radius(w, REGION, 3));
        Self { planes }
    }

    /// The energies of the photograph, for all pixels.
    pub(crate) fn photograph(&self) -> &[f32] {
        &self.planes[..self.planes.len() / 3]
    }

    /// Photograph, render and both at pixel `i`. The first two are at least 0.
    pub(crate) fn at(&self, i: usize) -> (f32, f32, f32) {
        let n = self.planes.len() / 3;
        (self.planes[i].max(0.0), self.planes[n + i].max(0.0), self.planes[2 * n + i])
    }
}
