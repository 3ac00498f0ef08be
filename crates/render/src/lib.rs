//! Every picture that a scene can give.
//!
//! ```text
//! Scene ─▶ Backend ─▶ Renderer ─▶ SceneRenderer ─▶ picture ─▶ file, film
//!          draws      a look      modes            colours for people
//! ```
//!
//! A [`Backend`] holds a scene and draws it from any camera; [`Cpu`] is the one that defines what is right,
//! and [`Looking`] makes one of any device that can compose Gaussians ([`Composer`]). A [`Renderer`] draws
//! one [`Look`] with a share of the water, a [`SceneRenderer`] every [`Mode`] from one camera at a time.
//! [`picture`] turns a mode's numbers into colours, [`cover`] and [`focus`] frame cameras, [`Film`] writes
//! frames one after another. [`bake`] and [`bake_in_water`] write a look into spherical harmonics for viewers
//! that know nothing of enhancement and water, [`white`] measures what is grey, [`medium_profile`] and
//! [`medium_along`] read the water alone.
//!
//! Nothing here trains, and nothing that trains uses it: what a picture looks like changes no trained byte,
//! and how training goes changes no picture of a given scene.

mod backend;
mod bake;
mod cpu;
mod error;
mod film;
mod framing;
mod modes;
mod pictures;
mod profile;
mod renderer;
pub mod white;

pub use backend::{Backend, Composer, Composition, Recolor, Request};
pub use bake::{BakeReport, InWater, bake, bake_in_water};
pub use cpu::{Cpu, Looking, Processor};
pub use error::RenderError;
pub use film::{Film, FilmError};
pub use framing::{cover, focus};
pub use modes::{Mode, Rendering, SceneRenderer};
pub use pictures::{coefficient_picture, depth_picture, picture};
pub use profile::{WaterSample, medium_along, medium_profile};
pub use renderer::{Look, Renderer};
