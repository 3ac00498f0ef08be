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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_left_out_for_their_causes_and_evenly_shown() {
        // Every fifth frame is black, and every third of the others is taken.
        let level = |number: u64| if number.is_multiple_of(5) { 0 } else { 100 };
        let frames: Vec<Frame> = (0..60).map(|n| Frame::new(n, 8, 6, &[level(n); 48])).collect();
        let taken = (0..60usize).filter(|i| !i.is_multiple_of(5) && i.is_multiple_of(3)).collect();
        let found = left_out(&frames, &FrameChoice { frames: taken, ..FrameChoice::default() });
        let of =
            |cause: LeftCause| found.iter().filter(|(_, own, _)| *own == cause).map(|(n, ..)| *n).collect();
        let (dark, alike): (Vec<u64>, Vec<u64>) = (of(LeftCause::Dark), of(LeftCause::Alike));
        assert_eq!(dark, (0..60).step_by(5).collect::<Vec<_>>());
        assert!(alike.len() == MOST && alike.iter().all(|n| n % 5 > 0 && n % 3 > 0), "{alike:?}");
        assert!(alike[MOST - 1] > 50, "{alike:?}");
        let dir = tempfile::tempdir().unwrap();
        let left_out = write(dir.path(), "film-1/", &found[..1]).unwrap();
        assert_eq!(left_out[0].picture, "left-out/film-1/f_000000.png");
        assert!(dir.path().join(&left_out[0].picture).is_file() && looked_films(dir.path()).is_empty());
        let films = vec![LookedFilm { film: "a.mp4".into(), looked_at: 60, taken: 16, dark: 12, left_out }];
        let record = serde_json::json!({ "films": films }).to_string();
        std::fs::write(dir.path().join(PREPARED), record).unwrap();
        assert_eq!(looked_films(dir.path()), films);
    }
}
