//! Every picture that can be drawn from a scene.
//!
//! ```text
//! Scene ─▶ Composer ─▶ Renderer ─▶ SceneRenderer ─▶ picture ─▶ file, film
//!          a device    a look      modes            colours for people
//! ```
//!
//! A [`Composer`] draws the Gaussians of a scene on some device; [`Processor`] is the reference. A
//! [`Renderer`] draws one [`Look`] with a share of the water, a [`SceneRenderer`] every [`Mode`] from one
//! camera at a time. [`picture`] turns a mode's numbers into colours, [`cover`] and [`focus`] frame cameras,
//! [`Film`] writes frames one after another. [`bake`] and [`bake_in_water`] write a look into spherical
//! harmonics for viewers without enhancement and water, [`Response`] is the answer of a look to a change of
//! light, [`white`] measures grey colours, and [`medium_profile`] and [`medium_along`] evaluate the water
//! alone.
//!
//! This crate does not train, and no training uses it: a change of the pictures changes no trained byte,
//! and a change of the training changes no picture of a given scene.

mod bake;
mod composer;
mod error;
mod film;
mod framing;
mod look;
mod modes;
mod pictures;
mod profile;
mod renderer;
mod response;
pub mod white;

pub use bake::{BakeReport, InWater, bake, bake_in_water};
pub use composer::{Composer, Composition, Processor, Recolor};
pub use error::RenderError;
pub use film::{Film, FilmError};
pub use framing::{cover, focus};
pub use modes::{Mode, Rendering, SceneRenderer};
pub use pictures::{coefficient_picture, depth_picture, picture};
pub use profile::{WaterSample, medium_along, medium_profile};
pub use renderer::{Look, Renderer};
pub use response::Response;
