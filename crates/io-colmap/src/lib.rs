//! COLMAP's files and lenses.
//!
//! [`read_model`], [`write_model_binary`] and [`write_model_text`] read and write COLMAP's models in both of
//! their formats ([`binary`], [`text`]). [`Lens`] maps a ray to a pixel on the sensor, and a pixel back to
//! its ray, for each of COLMAP's camera models except panoramas.
//!
//! This crate does not read the pictures. Pictures and the other parts of a capture are in the crate
//! `import`.

pub mod binary;
mod camera;
mod error;
mod lens;
mod model;
mod survey;
pub mod text;

pub use camera::ModelCamera;
pub use error::ModelError;
pub use lens::LensModel;
pub use model::{
    Model, ModelForm, count_images, form_of, read_model, read_model_as, write_model_binary, write_model_text,
};
pub use survey::read_survey;
pub use use3d_survey::{
    Keypoint, Lens, PosedImage as ModelImage, Projection, SurveyPoint as ModelPoint, fits_single,
};
