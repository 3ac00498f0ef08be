//! COLMAP's files and lenses.
//!
//! [`read_model`], [`write_model_binary`] and [`write_model_text`] are COLMAP's models in and out, in both of
//! their forms ([`binary`], [`text`]); [`Lens`] is where a ray lands on the sensor, and back, for each of
//! COLMAP's camera models. What a capture is made of beside a model, and what becomes of its pictures, is the
//! import's.

pub mod binary;
mod error;
mod lens;
mod model;
mod survey;
pub mod text;

pub use error::ModelError;
pub use lens::LensModel;
pub use model::{
    Model, ModelCamera, ModelForm, count_images, fits_single, form_of, read_model, read_model_as,
    write_model_binary, write_model_text,
};
pub use use3d_survey::{Keypoint, Lens, PosedImage as ModelImage, SurveyPoint as ModelPoint};
