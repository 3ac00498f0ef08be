//! A camera entry as a lens.

use std::path::Path;

use serde_json::{Map, Value};
use use3d_survey::{Distortion, Lens, Projection, ReadError, SurveyCamera};

type Result<T> = std::result::Result<T, ReadError>;

/// The fields of a camera.
struct CameraFields<'a> {
    fields: &'a Map<String, Value>,
    path: &'a Path,
    place: String,
}

impl CameraFields<'_> {
    fn fail<T>(&self, reason: impl Into<String>) -> Result<T> {
        Err(ReadError::broken(self.path, self.place.clone(), reason))
    }

    /// A number; `None` if it is not there.
    fn optional(&self, name: &str) -> Result<Option<f64>> {
        let Some(value) = self.fields.get(name).filter(|value| !value.is_null()) else { return Ok(None) };
        match value.as_f64() {
            Some(number) if number.is_finite() => Ok(Some(number)),
            _ => self.fail(format!("`{name}` is {value}; expected a finite number")),
        }
    }

    fn number(&self, name: &str) -> Result<f64> {
        let missing = || self.fail(format!("`{name}` is missing; run OpenSfM's `reconstruct` again"));
        self.optional(name)?.map_or_else(missing, Ok)
    }

    fn or_zero(&self, names: &[&str]) -> Result<Vec<f64>> {
        names.iter().map(|name| Ok(self.optional(name)?.unwrap_or(0.0))).collect()
    }

    fn side(&self, name: &str) -> Result<usize> {
        match self.number(name)? {
            v if v >= 1.0 && v <= f64::from(u32::MAX) && v.fract() == 0.0 => Ok(v as usize),
            v => self.fail(format!("`{name}` is {v}; expected a whole number of pixels above 0")),
        }
    }
}

/// The camera of an entry.
pub(crate) fn camera(id: u32, name: &str, entry: &Value, path: &Path) -> Result<SurveyCamera> {
    let place = format!("camera {name}");
    let Value::Object(fields) = entry else {
        return Err(ReadError::broken(path, place, "it is no object; expected projection_type and focal"));
    };
    let entry = CameraFields { fields, path, place };
    // Files of the first versions had no field for the projection.
    let kind = match fields.get("projection_type") {
        None => "perspective",
        Some(Value::String(kind)) => kind.as_str(),
        Some(other) => return entry.fail(format!("`projection_type` is {other}; expected a name")),
    };
    let (width, height) = (entry.side("width")?, entry.side("height")?);
    let projection = match kind {
        "perspective" | "simple_radial" | "radial" | "brown" => Projection::Perspective,
        "fisheye" | "fisheye_opencv" => Projection::Equidistant,
        _ => {
            return entry.fail(format!(
                "`projection_type` is {kind}; expected perspective, simple_radial, radial, brown, fisheye or \
                 fisheye_opencv: cut panoramas into perspective images, or choose another `camera_projection_type`"
            ));
        }
    };
    let focal = match (entry.optional("focal")?, entry.optional("focal_x")?, entry.optional("focal_y")?) {
        (Some(one), None, None) => [one; 2],
        (_, Some(x), Some(y)) => [x, y],
        (_, Some(one), None) | (_, None, Some(one)) => [one; 2],
        (None, None, None) => [entry.number("focal")?; 2],
    };
    if !focal.iter().all(|f| *f > 0.0) {
        return entry.fail(format!(
            "the focal length is {}, {}; expected shares of the longer side above 0",
            focal[0], focal[1]
        ));
    }
    let middle = entry.or_zero(&["c_x", "c_y"])?;
    let radial = entry.or_zero(&["k1", "k2", "k3", "k4"])?;
    let tangential = entry.or_zero(&["p1", "p2"])?;
    if projection == Projection::Equidistant && tangential.iter().any(|p| *p != 0.0) {
        return entry.fail("a fisheye lens has `p1` or `p2`; expected k1 to k4 alone: calibrate again");
    }
    let unknown = ["k5", "k6", "s0", "s1", "s2", "s3"];
    if let Some(name) = unknown.into_iter().zip(entry.or_zero(&unknown)?).find(|(_, v)| *v != 0.0) {
        return entry.fail(format!("`{}` is not 0, and no lens here has it; undistort the images", name.0));
    }
    let longer = width.max(height) as f64;
    let mut distortion = Distortion::default();
    distortion.numerator[..4].copy_from_slice(&radial);
    distortion.tangential.copy_from_slice(&tangential);
    let principal = [0.5 * width as f64 + longer * middle[0], 0.5 * height as f64 + longer * middle[1]];
    let lens = Lens { focal: focal.map(|f| f * longer), skew: 0.0, principal, projection, distortion };
    Ok(SurveyCamera { id, model: kind.into(), label: Some(name.into()), width, height, lens })
}
