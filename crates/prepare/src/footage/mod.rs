//! Whole films: every frame with its time and pose, and films that are written again.
//!
//! ```text
//! film ─▶ info, scan ─▶ reader ─▶ (frames) ─▶ writer ─▶ film
//!         properties    words                 matroska, encoder, mp4
//! ```
//!
//! `known` finds the frames of a capture in the film from which they were taken, and `path` the poses between
//! them. `colours` converts between a film's colours and RGB, and `turn` says how a player turns frames.
//!
//! All times are seconds from the begin of a film's file: the earliest time of any of its streams.

mod colours;
mod encoder;
mod info;
mod known;
mod matroska;
mod mp4;
mod path;
mod reader;
mod scan;
mod turn;
mod words;
mod writer;

pub use colours::ColourTags;
pub use info::{FilmInfo, Fraction};
pub use known::{KnownFrame, TIMES, known_frames};
pub use path::{FilmPath, FilmPose, LARGEST_GAP};
pub use reader::{FilmFrame, FilmReader};
pub use turn::DisplayMatrix;
pub use writer::{FilmChoices, FilmWriter, FilmWritten};
