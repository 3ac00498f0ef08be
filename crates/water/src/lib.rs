//! Water from tracks: attenuation, backscatter and veil of a capture, before the reconstruction.
//!
//! A triangulated point is seen from several distances. The difference between its views is the water in
//! between:
//!
//! ```text
//! I = g_v (J e^{−β_a s} + B(d) (1 − e^{−β_b s}))
//! ```
//!
//! per channel, with s the distance, d the unit direction, J the point's radiance without water, B the veil
//! (a constant and a slope over directions), and g_v a gain of the view where exposure changes. `β_a`,
//! `β_b`, B and the gains are shared by all points; J has a closed form and is eliminated.
//! `docs/science/water.md` explains the whole method: its approximations, its accuracy, and the cases in
//! which it cannot work.
//!
//! [`observe_sizes`] looks tracks up in the images and finds open water; [`estimate`] turns these
//! [`Sights`] into a [`Water`] with standard errors and a [`Verdict`] per channel. Reading order: `patch`
//! (the colour of a surface piece in a view), `open` (cells without a surface), `formation` (the equation and
//! its derivative), `solve` (the robust fit), `noise` (expected errors), `covariance` (errors of the result),
//! `estimate` (all together), `verdict`.
//!
//! Everything is f64 and summed in a fixed order: the same observations give the same bits on any number of
//! threads, in any order of the observations.

mod air;
mod blocks;
mod channel;
mod covariance;
mod data;
mod estimate;
mod formation;
mod jerlov;
mod noise;
mod observe;
mod open;
mod params;
mod patch;
mod solve;
mod verdict;
mod water;

pub use air::{PointColor, point_colors, shows_air};
pub use estimate::{estimate, estimate_sizes};
pub use jerlov::JERLOV;
pub use observe::{Observation, ObserveError, Sights, observe_sizes};
pub use open::OpenWater;
pub use params::WaterParams;
pub use verdict::Verdict;
pub use water::{ChannelWater, Measured, Water};
