//! The frames of films that were looked at and not taken: how many, why, and small pictures of some.

use std::path::Path;

use serde::{Deserialize, Serialize};
use use3d_capture::Image8;
use use3d_io_image::write_png8;

use crate::choose::{Frame, FrameChoice};
use crate::error::PrepareError;
use crate::sources::PREPARED;

/// The folder of the small pictures, in the capture.
const FOLDER: &str = "left-out";
/// The most small pictures of a film for each cause.
const MOST: usize = 12;

/// The cause for which a frame was left out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LeftCause {
    /// It is black or white.
    Dark,
    /// It shows nearly the same as a frame that was taken, or is less sharp.
    Alike,
}

/// A frame that was left out.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LeftFrame {
    /// A small grey picture of it, relative to the capture.
    pub picture: String,
    /// The cause.
    pub cause: LeftCause,
}

/// The frames of a film.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LookedFilm {
    /// The film's name.
    pub film: String,
    /// Frames that were looked at.
    pub looked_at: usize,
    /// Frames that were taken.
    pub taken: usize,
    /// Frames that are black or white.
    pub dark: usize,
    /// Some of the frames that were left out, evenly spread.
    pub left_out: Vec<LeftFrame>,
}

/// Evenly chosen frames that were left out, with their causes.
pub(crate) fn left_out(frames: &[Frame], choice: &FrameChoice) -> Vec<(u64, LeftCause, Image8)> {
    let of = |cause: LeftCause| {
        let left = (0..frames.len()).filter(|i| choice.frames.binary_search(i).is_err());
        let left: Vec<usize> = left.filter(|i| frames[*i].usable == (cause == LeftCause::Alike)).collect();
        let shown = left.len().min(MOST);
        let frame = |i: usize| &frames[left[i * left.len() / shown]];
        (0..shown).map(frame).map(|f| (f.number, cause, f.picture())).collect::<Vec<_>>()
    };
    [LeftCause::Dark, LeftCause::Alike].into_iter().flat_map(of).collect()
}

/// Writes small pictures into a capture. `prefix` is the folder of the film's images.
pub(crate) fn write(
    capture: &Path,
    prefix: &str,
    frames: &[(u64, LeftCause, Image8)],
) -> Result<Vec<LeftFrame>, PrepareError> {
    let folder = capture.join(FOLDER).join(prefix);
    std::fs::create_dir_all(&folder).map_err(PrepareError::write(&folder))?;
    let one = |(number, cause, picture): &(u64, LeftCause, Image8)| {
        let name = format!("{FOLDER}/{prefix}f_{number:06}.png");
        write_png8(&capture.join(&name), picture)?;
        Ok(LeftFrame { picture: name, cause: *cause })
    };
    frames.iter().map(one).collect()
}

/// The films that a prepared capture was made from. It is empty for other captures, and for those of older
/// versions.
pub fn looked_films(capture: &Path) -> Vec<LookedFilm> {
    #[derive(Deserialize)]
    struct Films {
        films: Vec<LookedFilm>,
    }
    let record = std::fs::read(capture.join(PREPARED)).ok();
    record.and_then(|bytes| serde_json::from_slice::<Films>(&bytes).ok()).map_or_else(Vec::new, |r| r.films)
}
