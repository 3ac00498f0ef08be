//! All frames of a film in the light and colours of a scene.
//!
//! ```text
//! stored frame ─▶ turned as it is shown ─▶ graded through its lens at its pose ─▶ turned back
//! ```
//!
//! Poses between the frames that the scene was made from come from the caller. A frame without a pose near
//! gets the scene's mean change of colours. The factors of a frame are mixed with those before, so that the
//! film does not flicker and poses come and go softly:
//!
//! ```text
//! F_k = m F_{k−1} + (1 − m) f_k,       m = [`MEMORY`]
//! ```

use std::collections::BTreeMap;

use use3d_capture::Pose;
use use3d_import::{Original, Originals};
use use3d_photographs::{ColourMap, Grid, Photographer, ViewMap, shrink};

use super::{Appearance, balanced, training_cameras};
use crate::WorkError;
use use3d_stages::Drawn;

/// Longer side of the small grid of a frame, pixels.
const SIDE: usize = 480;
/// Share of the factors of the frame before.
const MEMORY: f32 = 0.5;
/// Cameras whose mean change stands for frames without a pose.
const VIEWS: usize = 16;

/// Grades the frames of a film, in their order.
pub struct FilmGrader<'s> {
    photographer: Photographer<'s>,
    /// The photograph whose lens took the film.
    lens: Original,
    /// Width and height of a stored frame, and the quarter turns by which it is shown.
    stored: (usize, usize),
    turns: u8,
    gains: [f32; 3],
    mean: ViewMap,
    grid: Option<Grid>,
    earlier: Option<ColourMap>,
}

impl<'s> FilmGrader<'s> {
    /// A grader for a film with frames of `stored` pixels, shown turned clockwise by so many quarters.
    /// `frames` are names of photographs of the scene that are frames of the film.
    ///
    /// # Errors
    /// No frame belongs to the scene, its shape is not theirs, or the scene cannot be drawn.
    pub fn new(
        scene: &Drawn<'s>,
        originals: &Originals,
        appearance: &Appearance,
        frames: &[&str],
        (stored, turns): ((usize, usize), u8),
    ) -> Result<Self, WorkError> {
        let named: BTreeMap<&str, &Original> =
            originals.photographs.iter().map(|original| (original.relative.as_str(), original)).collect();
        let lens = frames.iter().find_map(|name| named.get(name)).ok_or_else(|| {
            WorkError::Input(
                "none of the film's frames is a photograph of this scene; give the film from which \
                 its capture was prepared"
                    .into(),
            )
        })?;
        let shown = if turns % 2 == 1 { (stored.1, stored.0) } else { stored };
        if shown.0.abs_diff(lens.width * shown.1 / lens.height.max(1)) > 1 + shown.0 / 200 {
            return Err(WorkError::Input(format!(
                "the film shows {} x {} pixels, and its frames in the scene have {} x {}, which is another shape; \
                 give the film from which the capture was prepared; if that one has bars, cut them off it first \
                 (`ffmpeg -vf crop`), as `use3d prepare` did",
                shown.0, shown.1, lens.width, lens.height
            )));
        }
        let training = training_cameras(originals);
        let photographer = appearance.photographer(scene, &training);
        let mut photographer = photographer.map_err(|e| WorkError::Failed(e.to_string()))?;
        let step = training.len().div_ceil(VIEWS).max(1);
        let views: Result<Vec<ViewMap>, _> =
            training.iter().step_by(step).map(|camera| photographer.own(camera)).collect();
        let views = views.map_err(WorkError::failed)?;
        Ok(Self {
            photographer,
            lens: (*lens).clone(),
            stored,
            turns: turns % 4,
            gains: originals.gains.unwrap_or([1.0; 3]),
            mean: ViewMap::mean(&views),
            grid: None,
            earlier: None,
        })
    }

    /// Grades the next frame in place: red, green and blue of each stored pixel. `pose` is that of the frame
    /// as it is shown, if one is near.
    ///
    /// # Errors
    /// The scene cannot be drawn.
    pub fn grade(&mut self, rgb: &mut Vec<u8>, pose: Option<Pose>) -> Result<(), WorkError> {
        let mut size = self.stored;
        for _ in 0..self.turns {
            (*rgb, size) = (turned(rgb, size), (size.1, size.0));
        }
        let map = self.map(rgb, size, pose)?;
        map.apply(rgb, size.0);
        for _ in 0..(4 - self.turns) % 4 {
            (*rgb, size) = (turned(rgb, size), (size.1, size.0));
        }
        Ok(())
    }

    /// The change of a shown frame.
    fn map(&mut self, rgb: &[u8], size: (usize, usize), pose: Option<Pose>) -> Result<ColourMap, WorkError> {
        if self.grid.is_none() {
            let (sx, sy) = (size.0 as f64 / self.lens.width as f64, size.1 as f64 / self.lens.height as f64);
            self.grid = Grid::new(&self.lens.lens.scaled(sx, sy), size, Pose::IDENTITY, SIDE);
        }
        let grid = self.grid.as_ref().ok_or_else(|| {
            WorkError::Input("no ray of the film's lens lies in front of the camera".into())
        })?;
        let small = balanced(shrink(rgb, size.0, grid.size()), self.gains);
        let map = match pose {
            Some(pose) => {
                let graded = self.photographer.grade(&small, &grid.at(pose), None, None);
                graded.map_err(WorkError::failed)?.grade.map
            }
            None => self.mean.grade(&small),
        };
        let map = match &self.earlier {
            Some(earlier) => map.mixed(earlier, MEMORY),
            None => map,
        };
        self.earlier = Some(map.clone());
        Ok(map.after(self.gains))
    }
}

/// A picture of interleaved pixels, turned clockwise by a quarter.
fn turned(rgb: &[u8], (width, height): (usize, usize)) -> Vec<u8> {
    let mut out = Vec::with_capacity(rgb.len());
    for x in 0..width {
        for y in (0..height).rev() {
            out.extend_from_slice(&rgb[3 * (y * width + x)..][..3]);
        }
    }
    out
}

/// Times in seconds, as spans: `0 to 1.2 s, 8 s`.
pub fn spans(times: &[(u64, f64)]) -> String {
    let mut spans: Vec<[(u64, f64); 2]> = Vec::new();
    for time in times {
        match spans.last_mut() {
            Some(last) if last[1].0 + 1 == time.0 => last[1] = *time,
            _ => spans.push([*time, *time]),
        }
    }
    let words = spans.iter().map(|[from, to]| match from == to {
        true => format!("{:.1} s", from.1),
        false => format!("{:.1} to {:.1} s", from.1, to.1),
    });
    words.collect::<Vec<String>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn four_quarters_turn_a_picture_back_and_one_moves_its_corner() {
        let picture: Vec<u8> = (0..3 * 5 * 2).collect();
        let once = turned(&picture, (5, 2));
        // The last row's first pixel comes first.
        assert_eq!(once[..3], picture[15..18]);
        let mut again = once;
        for size in [(2, 5), (5, 2), (2, 5)] {
            again = turned(&again, size);
        }
        assert_eq!(again, picture);
    }

    #[test]
    fn spans_are_named_by_their_ends() {
        let times = [(0, 0.0), (1, 0.04), (2, 0.08), (9, 0.36), (20, 0.8), (21, 0.84)];
        assert_eq!(spans(&times), "0.0 to 0.1 s, 0.4 s, 0.8 to 0.8 s");
    }
}
