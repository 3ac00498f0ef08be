//! A diver's own photographs in the light and colours of a scene.
//!
//! A scene gives pictures of itself. People work on their photographs, which are sharper. This crate changes
//! the colours of a photograph `P` by what the scene knows of its view: the stage-1 render `R`, the look `E`
//! (enhanced, clear, or the reconstruction), and the answer of the look to light.
//!
//! ```text
//! P⁺ = E + M (Δ − (1 − κ) L),   Δ = P − R            the scene's own factors on the photograph
//! ```
//!
//! ([`mod@grade`] has the symbols.) All factors are smooth, so they are computed on a small [`Grid`] through
//! the photograph's own lens, and [`ColourMap::apply`] reads them between its pixels. The photograph is never
//! resampled: names, size, lens and detail stay. Only [`straight()`] resamples it, for programs that know no
//! distortion. Colours are display-referred, `[0, 1]`.
//!
//! [`Photographer`] draws a view and grades its photograph. Limits: a developed JPEG is no albedo, and where
//! hardly any red arrives, red is a guess; where the scene knows nothing, it has no say.
//!
//! ```
//! use use3d_capture::Image;
//! use use3d_photographs::{ViewMap, shrink};
//!
//! // Twice as much red in an 8-bit photograph of 4 × 2 pixels.
//! let mut pixels: Vec<u8> = [40, 80, 120].repeat(8);
//! let small: Image = shrink(&pixels, 4, (2, 1));
//! let view = ViewMap { rows: [[2.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]] };
//! view.grade(&small).apply(&mut pixels, 4);
//! assert_eq!(pixels[..3], [80, 80, 120]);
//! ```

mod boxes;
mod coverage;
mod development;
#[cfg(test)]
mod golden_tests;
pub mod grade;
mod grid;
mod highlights;
mod known;
mod map;
mod photographer;
mod pixels;
mod quiet;
mod sample;
mod small;
mod straight;
mod structure;

pub use coverage::Coverage;
pub use development::{ColourPairs, Development, strange};
pub use grade::{Grade, Seen, ViewMap, grade};
pub use grid::{Grid, small_size};
pub use map::ColourMap;
pub use photographer::{Graded, PhotographError, Photographer};
pub use pixels::{PixelSample, shrink, straight};
pub use sample::Sample;
