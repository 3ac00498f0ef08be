//! A synthetic underwater capture with known truth: scene, water, cameras, pairs.
//!
//! A procedural reef (terrain, boulders, corals, sponges, a wreck, a rope, a colour chart) consists of
//! triangles with procedural textures. It is rendered by casting rays, under soft daylight and through one of
//! Jerlov's waters. No part of it is made of Gaussians, so that a reconstruction from these pictures is not
//! an inverse crime. [`Location::Pool`] is a tiled pool instead, with even surfaces of nearly one colour.
//! [`write_capture`] makes a COLMAP project together with the truth about it; [`write_pairs`] makes pairs for
//! training a calibrator without any download.
//!
//! By default the pictures follow the method's image formation exactly, per channel on display values, with
//! the distance s along the ray (see [`Water`]):
//!
//! `I = J e^{-β_attn s} + c_m(d) (1 - e^{-β_bs s})`.
//!
//! [`Physics::Spectral`] follows other physics: ten wavelengths in linear light, daylight that fades with
//! depth, lamps, a camera that sets itself for every view, fish and marine snow. Known limits: opaque
//! surfaces, no forward scattering (blur).
//!
//! A [`ChosenFault`] makes one thing of a finished capture wrong, to test the checks of captures
//! ([`write_faulty_capture`]).
//!
//! A distorting lens ([`Optics`]) bends the rays of the photographs, and the COLMAP model has the same lens.
//!
//! The results are deterministic: a function of the parameters, independent of the number of threads.

mod capture;
mod error;
mod faults;
mod geometry;
mod lens;
mod pairs;
mod params;
mod physics;
mod prior;
mod render;
mod scene;
mod sparse;
mod swim;
mod water;

pub use capture::{CaptureTruth, ViewGains, write_capture, write_faulty_capture};
pub use error::{Answer, SynthError};
pub use faults::{CaptureFault, ChosenFault, Due, FAULTS, Strengths, UnknownFault};
pub use lens::Optics;
pub use pairs::{PairsParams, write_pairs};
pub use params::CaptureParams;
pub use physics::{Development, Physics};
pub use scene::Location;
pub use water::{UnknownWaterType, Water, WaterType};
