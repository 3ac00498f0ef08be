//! Makes a capture folder from films and photographs: `images/` and `sparse/0/`, which the import takes.
//!
//! ```text
//! sources ─▶ film, photographs ─▶ sfm ─▶ verdict
//! inputs       images/              steps    the model in words
//! ```
//!
//! `sources` sorts the inputs. `film` takes the frames that `choose` picks by sharpness and overlap,
//! and `photographs` copies photographs. `sfm` finds the cameras with the program `colmap` or the Python
//! package `pycolmap`, in three steps: features, matches, mapping. `learned` brings features and matches of
//! networks, where COLMAP's own fail. `verdict` says how well this went.
//!
//! `recipes` names the files of data sets that others published, and the choices for them.
//!
//! All work is done in one folder, beside the result (`work`). Each finished step is noted there with the
//! digests of its inputs, choices and files, so an interrupted run continues, and a changed choice or a
//! damaged file repeats only the steps after it. Images are not undistorted: the import does that.

mod attempts;
mod cause;
mod certainty;
mod choose;
mod eight_bit;
mod error;
mod film;
mod footage;
mod learned;
mod left_out;
mod linear;
mod origin;
mod overlay;
mod params;
mod photographs;
mod prepare;
mod probe;
mod process;
mod recipes;
mod sfm;
mod sources;
mod tools;
mod verdict;
mod work;

pub use error::PrepareError;
pub use footage::{
    ColourTags, DisplayMatrix, FilmChoices, FilmFrame, FilmInfo, FilmPath, FilmPose, FilmReader, FilmWriter,
    FilmWritten, Fraction, KnownFrame, LARGEST_GAP, TIMES, known_frames,
};
pub use left_out::{LeftCause, LeftFrame, LookedFilm, looked_films};
pub use linear::check_linear;
pub use origin::{Recipe, SetScene};
pub use params::{Keypoints, Mapper, Matching, PrepareParams};
pub use prepare::{CAPTURE, Input, Prepared, check, key_of, prepare, work_folder};
pub use process::{StepProgress, StepWatch};
pub use recipes::{RecipeWork, balance, publish, unpack};
pub use sources::{PREPARED, Sources, holds_inputs, is_film, is_input, is_photograph};
pub use tools::{Finder, Program, Programs};
pub use verdict::{CameraVerdict, Grade};
pub use work::discard;
