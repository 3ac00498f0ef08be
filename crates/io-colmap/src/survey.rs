//! A model as a survey.
//!
//! Images, keypoints, points and tracks are the same in both. A camera becomes its lens under the name of its
//! model.

use std::path::Path;

use use3d_survey::{Survey, SurveyCamera, leave_out_points};

use crate::camera::ModelCamera;
use crate::error::ModelError;
use crate::model::{Model, ModelForm, read_unchecked};

/// Reads the model in a folder, in a given format, into a survey. Points without a position are left out.
///
/// # Errors
/// A model that cannot be read or used in single precision.
pub fn read_survey(dir: &Path, form: ModelForm) -> Result<Survey, ModelError> {
    let mut model = read_unchecked(dir, form)?;
    let fault = leave_out_points(&mut model.points, &mut model.images);
    model.check(dir)?;
    model.check_single(dir)?;
    Ok(Survey { faults: fault.into_iter().collect(), ..model.into_survey(dir)? })
}

impl Model {
    /// The model as a survey; `path` is for the message only.
    ///
    /// # Errors
    /// A camera with the wrong number of parameters, which no model has that was read.
    pub fn into_survey(self, path: &Path) -> Result<Survey, ModelError> {
        let camera = |c: &ModelCamera| {
            let lens = c.lens().ok_or_else(|| {
                let (found, expected) = (c.parameters.len(), c.model.parameter_count());
                let reason = format!("{found} parameters, {} has {expected}", c.model.name());
                ModelError::broken(path, format!("camera {}", c.id), reason)
            })?;
            let (id, model) = (c.id, c.model.name().to_string());
            Ok(SurveyCamera { id, model, label: None, width: c.width, height: c.height, lens })
        };
        let cameras = self.cameras.iter().map(camera).collect::<Result<_, ModelError>>()?;
        Ok(Survey { cameras, images: self.images, points: self.points, ..Survey::default() })
    }
}

#[cfg(test)]
mod tests {
    use use3d_capture::{FileName, Pose};
    use use3d_survey::{Lens, PosedImage, Projection};

    use super::*;
    use crate::lens::LensModel;
    use crate::lens::lenses::example;

    use LensModel as M;

    /// The way back: a lens takes the camera model of its name, or else the first that has exactly its
    /// parameters. Lenses with skew, with a polynomial that COLMAP does not have, or equisolid ones have
    /// none.
    fn from_survey(survey: &Survey, path: &Path) -> Result<Model, ModelError> {
        let camera = |c: &SurveyCamera| {
            let (model, parameters) = model_of(&c.lens, &c.model).ok_or_else(|| {
                let place = format!("camera {} ({})", c.id, c.model);
                let reason =
                    "no camera model of COLMAP describes its lens; undistort the images first".into();
                ModelError::broken(path, place, reason)
            })?;
            Ok(ModelCamera { id: c.id, model, width: c.width, height: c.height, parameters })
        };
        let cameras = survey.cameras.iter().map(camera).collect::<Result<_, ModelError>>()?;
        Ok(Model { cameras, images: survey.images.clone(), points: survey.points.clone() })
    }

    /// The model and parameters that describe a lens exactly: the named one if it does, else the first.
    fn model_of(lens: &Lens, name: &str) -> Option<(LensModel, Vec<f64>)> {
        LensModel::from_name(name)
            .into_iter()
            .chain(LensModel::ALL)
            .map(|model| (model, parameters_of(model, lens)))
            .find(|(model, parameters)| model.lens(parameters).as_ref() == Some(lens))
    }

    /// The parameters by which this model comes nearest to a lens, in COLMAP's order.
    fn parameters_of(model: LensModel, lens: &Lens) -> Vec<f64> {
        let ([fx, fy], [cx, cy]) = (lens.focal, lens.principal);
        let d = &lens.distortion;
        let ([n1, n2, n3, n4, n5, n6], [d1, d2, d3]) = (d.numerator, d.denominator);
        let ([p1, p2], [s1, s2]) = (d.tangential, d.prism);
        let mut out = if model.focal_lengths() == 1 { vec![fx, cx, cy] } else { vec![fx, fy, cx, cy] };
        match model {
            M::SimplePinhole | M::Pinhole | M::SimpleFisheye | M::Fisheye => {}
            M::SimpleRadial | M::SimpleRadialFisheye => out.push(n1),
            M::Radial | M::RadialFisheye => out.extend([n1, n2]),
            M::OpenCv => out.extend([n1, n2, p1, p2]),
            M::OpenCvFisheye => out.extend([n1, n2, n3, n4]),
            M::FullOpenCv => out.extend([n1, n2, p1, p2, n3, d1, d2, d3]),
            M::Fov => {
                out.push(if let Projection::FieldOfView { omega } = lens.projection { omega } else { 0.0 });
            }
            M::ThinPrismFisheye => out.extend([n1, n2, p1, p2, n3, n4, s1, s2]),
            M::RadTanThinPrismFisheye => {
                let [t1, t2] = d.after_radial.unwrap_or_default();
                out.extend([n1, n2, n3, n4, n5, n6, p2, p1, s1, t1, s2, t2]);
            }
            M::SimpleDivision | M::Division => {
                out.push(if let Projection::Division { k } = lens.projection { k } else { 0.0 });
            }
            M::Eucm => match lens.projection {
                Projection::Unified { alpha, beta } => out.extend([alpha, beta]),
                _ => out.extend([0.0, 1.0]),
            },
        }
        out
    }

    #[test]
    fn every_camera_model_survives_the_way_through_a_survey() {
        let path = Path::new("model");
        for model in LensModel::ALL {
            for amount in [0.0, 1.0] {
                let lens = example(model, amount);
                let parameters = parameters_of(model, &lens);
                let camera = ModelCamera { id: 3, model, width: 1000, height: 700, parameters };
                let image = PosedImage::at(8, FileName::new("a.png").unwrap(), 3, &Pose::IDENTITY);
                let before = Model { cameras: vec![camera], images: vec![image], points: vec![] };
                let survey = before.clone().into_survey(path).unwrap();
                assert_eq!((survey.cameras[0].lens, survey.cameras[0].model.as_str()), (lens, model.name()));
                let mut after = from_survey(&survey, path).unwrap();
                if model == M::Eucm && amount == 0.0 {
                    // Without a sphere its second parameter has no meaning.
                    after.cameras[0].parameters[5] = before.cameras[0].parameters[5];
                }
                assert_eq!(after, before, "{model:?}");
                // Under a name that COLMAP does not have the first model that fits is taken.
                let mut foreign = survey;
                foreign.cameras[0].model = "frame".into();
                let found = from_survey(&foreign, path).unwrap();
                assert_eq!(found.cameras[0].lens(), Some(lens), "{model:?}");
            }
        }
    }

    #[test]
    fn a_lens_that_colmap_does_not_have_is_refused() {
        let mut survey = Survey::default();
        let lens = Lens { skew: 0.3, ..Lens::pinhole([500.0, 501.0], [320.0, 240.0]) };
        let model = "frame".to_string();
        survey.cameras.push(SurveyCamera { id: 5, model, label: None, width: 640, height: 480, lens });
        let said = from_survey(&survey, Path::new("out")).unwrap_err().to_string();
        assert!(said.contains("camera 5 (frame)") && said.contains("undistort"), "{said}");
    }
}
