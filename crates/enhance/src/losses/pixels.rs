//! The term of pseudo-labels: compares a rendered image with the pixels of another, as a mean over pixels
//! and channels.

use use3d_capture::Image;

use super::{LossTerm, Pixels, Reads};
use crate::params::PixelLoss;

/// The term's row of the table.
pub(super) const TERM: LossTerm =
    LossTerm { name: "pixels", title: "pseudo-label", weight: |_| 1.0, reads: Reads::Pixels(term) };

fn term(seen: &Pixels<'_>, weight: f64, gradient: &mut Image) -> f64 {
    let Pixels { image, label, compared } = seen;
    let scale = 1.0 / image.data().len().max(1) as f64;
    let mut total = 0.0;
    for ((&value, &wanted), sum) in image.data().iter().zip(label.data()).zip(gradient.data_mut()) {
        let e = f64::from(value) - f64::from(wanted) / 65535.0;
        let (term, slope) = match compared {
            PixelLoss::L1 => (e.abs(), if e == 0.0 { 0.0 } else { e.signum() }),
            PixelLoss::L2 => (e * e, 2.0 * e),
        };
        total += term;
        *sum += (weight * slope * scale) as f32;
    }
    total * scale
}
