//! Cameras whose lenses are known as shares of the longer side, and the survey that they become once the
//! sizes of the photographs are known.

use std::collections::BTreeMap;
use std::path::Path;

use use3d_capture::{FileName, Pose};
use use3d_survey::{Distortion, Lens, PosedImage, Projection, ReadError, Survey, SurveyCamera};

/// The next step for a survey that is not usable.
pub(crate) const REMEDY: &str = "check the project in RealityScan and export the cameras again";

/// A lens in shares of the longer side.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ShareLens {
    /// The focal length.
    pub focal: f64,
    /// The principal point, from the middle of the photograph, y down.
    pub principal: [f64; 2],
    /// `k1` to `k4`.
    pub radial: [f64; 4],
    /// `t1`, `t2`.
    pub tangential: [f64; 2],
}

impl ShareLens {
    /// The lens in pixels of a photograph.
    fn in_pixels(&self, width: usize, height: usize) -> Lens {
        let longer = width.max(height) as f64;
        let [t1, t2] = self.tangential;
        let mut distortion = Distortion { tangential: [t2, t1], ..Distortion::default() };
        distortion.numerator[..4].copy_from_slice(&self.radial);
        let [u, v] = self.principal;
        Lens {
            focal: [self.focal * longer; 2],
            skew: 0.0,
            principal: [0.5 * width as f64 + u * longer, 0.5 * height as f64 + v * longer],
            projection: Projection::Perspective,
            distortion,
        }
    }

    fn name(&self) -> &'static str {
        match (self.radial, self.tangential) {
            ([0.0, 0.0, 0.0, 0.0], [0.0, 0.0]) => "perspective",
            ([_, _, _, 0.0], [0.0, 0.0]) => "brown3",
            (_, [0.0, 0.0]) => "brown4",
            ([_, _, _, 0.0], _) => "brown3t2",
            _ => "brown4t2",
        }
    }
}

/// A photograph with its pose and lens.
#[derive(Clone, Debug, PartialEq)]
pub struct RegisteredShot {
    /// Its name, which may lack the extension.
    pub name: FileName,
    /// World to camera.
    pub pose: Pose,
    /// Its lens.
    pub lens: ShareLens,
}

/// The registered photographs of a project.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Registration {
    /// The photographs, in the order of the files.
    pub shots: Vec<RegisteredShot>,
    /// Sentences for the report.
    pub notes: Vec<String>,
}

impl Registration {
    /// The survey for photographs of these sizes. A photograph without a size gets that of another one: it
    /// is not there, and the import leaves it out. Photographs of one size and lens share a camera. `path` is
    /// for messages.
    ///
    /// # Errors
    /// No photograph has a size, or the survey is not usable.
    pub fn into_survey(
        self,
        sizes: &BTreeMap<FileName, (usize, usize)>,
        path: &Path,
    ) -> Result<Survey, ReadError> {
        let Some(usual) = self.shots.iter().find_map(|shot| sizes.get(&shot.name)).copied() else {
            let example = self.shots.first().map_or("", |shot| shot.name.as_str());
            let reason = format!(
                "none of its {} photographs ({example}, …) is beside it, and the lenses are shares of their sizes: put \
                 the photographs into a folder beside this file, under the names that the project has",
                self.shots.len()
            );
            return Err(ReadError::broken(path, "photographs", reason));
        };
        let mut survey = Survey { notes: self.notes, ..Survey::default() };
        let mut known: Vec<(ShareLens, (usize, usize))> = Vec::new();
        for (id, shot) in (1u32..).zip(self.shots) {
            let size = sizes.get(&shot.name).copied().unwrap_or(usual);
            let kind = (shot.lens, size);
            // Calibrations are mostly shared by all photographs, or by none.
            let near = known.last().is_some_and(|last| *last == kind).then(|| known.len() - 1);
            let at = near.or_else(|| known.iter().position(|other| *other == kind)).unwrap_or_else(|| {
                known.push(kind);
                survey.cameras.push(SurveyCamera {
                    id: known.len() as u32,
                    model: shot.lens.name().into(),
                    label: None,
                    width: size.0,
                    height: size.1,
                    lens: shot.lens.in_pixels(size.0, size.1),
                });
                known.len() - 1
            });
            survey.images.push(PosedImage::at(id, shot.name, at as u32 + 1, &shot.pose));
        }
        survey.check(path, REMEDY)?;
        Ok(survey)
    }
}
