//! Lenses for the tests of this crate and of the undistortion.

use super::{Lens, LensModel};

use LensModel as M;

/// A usable lens of every model, for a sensor of about 1000 x 700 pixels.
pub(crate) fn example(model: LensModel, amount: f64) -> Lens {
    let k = |values: &[f64]| values.iter().map(|v| v * amount).collect::<Vec<f64>>();
    let (head, tail) = match model {
        M::SimplePinhole => (vec![800.0, 503.0, 347.0], vec![]),
        M::Pinhole => (vec![800.0, 820.0, 503.0, 347.0], vec![]),
        M::SimpleRadial => (vec![800.0, 503.0, 347.0], k(&[-0.12])),
        M::Radial => (vec![800.0, 503.0, 347.0], k(&[0.30, 0.12])),
        M::OpenCv => (vec![800.0, 820.0, 503.0, 347.0], k(&[-0.15, 0.05, 0.004, -0.003])),
        M::OpenCvFisheye => (vec![500.0, 510.0, 503.0, 347.0], k(&[-0.03, 0.012, -0.004, 0.0006])),
        M::FullOpenCv => {
            (vec![800.0, 820.0, 503.0, 347.0], k(&[0.2, -0.1, 0.003, -0.002, 0.05, 0.3, -0.05, 0.02]))
        }
        M::Fov => (vec![700.0, 710.0, 503.0, 347.0], k(&[0.9])),
        M::SimpleRadialFisheye => (vec![500.0, 503.0, 347.0], k(&[0.05])),
        M::RadialFisheye => (vec![500.0, 503.0, 347.0], k(&[0.03, -0.01])),
        M::ThinPrismFisheye => (
            vec![500.0, 510.0, 503.0, 347.0],
            k(&[-0.02, 0.01, 0.002, -0.001, -0.002, 0.0004, 0.003, -0.002]),
        ),
        M::RadTanThinPrismFisheye => (
            vec![500.0, 510.0, 503.0, 347.0],
            k(&[-0.02, 0.01, -0.004, 0.002, -0.0008, 0.0001, 0.002, -0.001, -0.002, 0.0004, 0.003, -0.0006]),
        ),
        M::SimpleDivision => (vec![800.0, 503.0, 347.0], k(&[-0.12])),
        M::Division => (vec![800.0, 820.0, 503.0, 347.0], k(&[0.1])),
        M::SimpleFisheye => (vec![500.0, 503.0, 347.0], vec![]),
        M::Fisheye => (vec![500.0, 510.0, 503.0, 347.0], vec![]),
        M::Eucm => (vec![600.0, 610.0, 503.0, 347.0], k(&[0.5, 1.0])),
    };
    model.lens(&[head, tail].concat()).unwrap()
}
