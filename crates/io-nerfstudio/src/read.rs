//! Reading a `transforms.json`.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use glam::{DMat3, DVec3};
use serde_json::{Map, Value};
use use3d_capture::FileName;
use use3d_numerics::math;
use use3d_survey::{
    Distortion, ImageFiles, Lens, PosedImage, Projection, ReadError, RotationFault, Survey, SurveyCamera,
    check_rotation, is_last_row, ply, read_at_most,
};

use crate::frame::Applied;

type Result<T> = std::result::Result<T, ReadError>;

/// The largest file that is read, bytes: several 100,000 frames.
const LARGEST: u64 = 1 << 28;
/// The next step for a survey that is not usable.
const REMEDY: &str = "write the file again with ns-process-data";
/// A rotation may be off orthonormal by this: some writers keep single precision.
const ORTHONORMAL: f64 = 1e-3;
/// The camera models without a bend that no polynomial describes.
const PERSPECTIVE: [&str; 6] =
    ["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"];
const FISHEYE: &str = "OPENCV_FISHEYE";
/// Fields whose values a lens of this format cannot have other than 0.
const UNKNOWN: [&str; 2] = ["k5", "k6"];

/// A file that was read.
#[derive(Clone, Debug)]
pub struct Transforms {
    /// Cameras, images, masks and depth maps, in the coordinates of the model behind the file. File names are
    /// relative to the file's folder.
    pub survey: Survey,
    /// The file of points that `ply_file_path` names.
    pub points: Option<FileName>,
    applied: Applied,
}

impl Transforms {
    /// Adds the points of the file that [`points`](Self::points) names; `path` is for messages.
    ///
    /// # Errors
    /// A file that is no PLY file of points.
    pub fn add_points(&mut self, bytes: &[u8], path: &Path) -> Result<()> {
        let mut points = ply::points(bytes, path)?;
        for point in &mut points {
            point.position = self.applied.undo(DVec3::from_array(point.position)).to_array();
        }
        self.survey.points = points;
        self.survey.check(path, REMEDY)
    }
}

/// Reads a file, without its points.
///
/// # Errors
/// A file that cannot be read, is no JSON, or holds something that cannot be used; the message names the
/// frame and field.
pub fn read(path: &Path) -> Result<Transforms> {
    parse(&read_at_most(path, LARGEST, "split the capture")?, path)
}

/// Reads the bytes of a file; `path` is for messages.
///
/// # Errors
/// As [`read`].
pub fn parse(bytes: &[u8], path: &Path) -> Result<Transforms> {
    let json: Value = serde_json::from_slice(bytes).map_err(|e| {
        let reason = format!("it is damaged or cut short ({e}); write it again with ns-process-data");
        ReadError::broken(path, "JSON", reason)
    })?;
    let Value::Object(all) = &json else {
        return Err(ReadError::broken(path, "JSON", "expected an object with `frames`"));
    };
    let whole = Fields { own: all, shared: None, path, place: "top level".into() };
    let frames = match all.get("frames") {
        Some(Value::Array(frames)) if !frames.is_empty() => frames,
        Some(Value::Array(_)) => return whole.fail("`frames` is empty; expected one entry per photograph"),
        Some(_) => return whole.fail("`frames` is no list; expected one entry per photograph"),
        None => {
            return whole
                .fail("`frames` is missing; this is no transforms.json: write it with ns-process-data");
        }
    };
    let applied = applied(&whole)?;
    let points = whole.file("ply_file_path")?;

    let mut survey = Survey::default();
    let mut cameras: BTreeMap<Vec<u64>, u32> = BTreeMap::new();
    let ids = image_ids(frames);
    for (i, frame) in frames.iter().enumerate() {
        let Value::Object(own) = frame else {
            return whole.fail(format!("frame {i} is no object; expected file_path and transform_matrix"));
        };
        let place = match own.get("file_path").and_then(Value::as_str) {
            Some(name) => format!("frame {i} ({name})"),
            None => format!("frame {i}"),
        };
        let fields = Fields { own, shared: Some(all), path, place };
        let Some(name) = fields.file("file_path")? else {
            return fields.fail("`file_path` is missing; expected the photograph's path");
        };
        if !own.contains_key("transform_matrix") {
            return fields.fail("`transform_matrix` is missing; expected 4 rows of 4 numbers");
        }
        // Camera-to-world rotation with OpenGL's axes, and the camera's centre.
        let (rotation, center) = fields.transform("transform_matrix")?;
        let camera = camera(&fields)?;
        let next = cameras.len() as u32 + 1;
        let id = *cameras.entry(bits(&camera)).or_insert(next);
        if id == next {
            survey.cameras.push(SurveyCamera { id, ..camera });
        }
        let pose = applied.pose(rotation, center);
        survey.images.push(PosedImage::at(ids[i], name, id, &pose));
        let files =
            ImageFiles { mask: fields.own_file("mask_path")?, depth: fields.own_file("depth_file_path")? };
        if files != ImageFiles::default() {
            survey.files.insert(ids[i], files);
        }
    }
    if all.contains_key("train_filenames") || all.contains_key("test_filenames") {
        let note =
            "the split in transforms.json is not used; put the names into train_list.txt and test_list.txt";
        survey.notes.push(note.into());
    }
    survey.check(path, REMEDY)?;
    Ok(Transforms { survey, points, applied })
}

/// The ids of COLMAP where every frame has one and they are distinct, else 1, 2, 3 and so on.
fn image_ids(frames: &[Value]) -> Vec<u32> {
    let stated: Vec<u32> =
        frames.iter().filter_map(|frame| frame.get("colmap_im_id")?.as_u64()?.try_into().ok()).collect();
    let distinct: BTreeSet<u32> = stated.iter().copied().collect();
    if distinct.len() == frames.len() { stated } else { (1..=frames.len() as u32).collect() }
}

/// The bits of all that makes a camera, so that equal ones are one.
fn bits(camera: &SurveyCamera) -> Vec<u64> {
    let lens = &camera.lens;
    let fisheye = u64::from(lens.projection != Projection::Perspective);
    let numbers = lens.focal.iter().chain(&lens.principal);
    let numbers = numbers.chain(&lens.distortion.numerator).chain(&lens.distortion.tangential);
    [camera.width as u64, camera.height as u64, fisheye]
        .into_iter()
        .chain(numbers.map(|v| v.to_bits()))
        .collect()
}

/// The fields of a frame, with those of the whole file behind them.
struct Fields<'a> {
    own: &'a Map<String, Value>,
    shared: Option<&'a Map<String, Value>>,
    path: &'a Path,
    place: String,
}

impl Fields<'_> {
    fn fail<T>(&self, reason: impl Into<String>) -> Result<T> {
        Err(ReadError::broken(self.path, &self.place, reason))
    }

    fn get(&self, name: &str) -> Option<&Value> {
        let found = self.own.get(name).or_else(|| self.shared?.get(name));
        found.filter(|value| !value.is_null())
    }

    fn number(&self, name: &str) -> Result<Option<f64>> {
        let Some(value) = self.get(name) else { return Ok(None) };
        match value.as_f64() {
            Some(number) if number.is_finite() => Ok(Some(number)),
            _ => self.fail(format!("`{name}` is {}; expected a finite number", short(value))),
        }
    }

    /// A side of the image: a whole number above 0, also when it is written as a float.
    fn side(&self, name: &str) -> Result<usize> {
        match self.number(name)? {
            None => {
                self.fail(format!("`{name}` is missing; expected the image's size in pixels as `w` and `h`"))
            }
            Some(v) if v >= 1.0 && v <= f64::from(u32::MAX) && v.fract() == 0.0 => Ok(v as usize),
            Some(v) => self.fail(format!("`{name}` is {v}; expected a whole number of pixels above 0")),
        }
    }

    fn file(&self, name: &str) -> Result<Option<FileName>> {
        self.named(name, self.get(name))
    }

    /// A file of the frame itself.
    fn own_file(&self, name: &str) -> Result<Option<FileName>> {
        self.named(name, self.own.get(name).filter(|value| !value.is_null()))
    }

    fn named(&self, name: &str, value: Option<&Value>) -> Result<Option<FileName>> {
        let Some(value) = value else { return Ok(None) };
        let Some(text) = value.as_str() else {
            return self.fail(format!("`{name}` is {}; expected a path", short(value)));
        };
        FileName::new(text).map(Some).or_else(|e| {
            self.fail(format!(
                "`{name}`: {e}; expected a path below the folder of transforms.json: put the file there"
            ))
        })
    }

    /// A matrix of 3 or 4 rows of 4 numbers: the rotation in its first three columns, checked, and the last
    /// column.
    fn transform(&self, name: &str) -> Result<(DMat3, DVec3)> {
        let row = |value: &Value| -> Option<[f64; 4]> {
            let numbers = value.as_array()?.iter().map(|v| v.as_f64().filter(|v| v.is_finite()));
            numbers.collect::<Option<Vec<f64>>>()?.try_into().ok()
        };
        let rows = self.get(name).and_then(Value::as_array).filter(|rows| matches!(rows.len(), 3 | 4));
        let Some(m) = rows.and_then(|rows| rows.iter().map(row).collect::<Option<Vec<_>>>()) else {
            return self.fail(format!("`{name}` is no matrix of 3 or 4 rows of 4 finite numbers"));
        };
        if let Some(last) = m.get(3).filter(|row| !is_last_row(&row[..])) {
            return self.fail(format!(
                "the last row of `{name}` is {last:?}; expected 0, 0, 0, 1: write the matrix row by row, with the \
                 translation in its last column"
            ));
        }
        let row = |i: usize| DVec3::new(m[i][0], m[i][1], m[i][2]);
        let rotation = DMat3::from_cols(row(0), row(1), row(2)).transpose();
        match check_rotation(&rotation, ORTHONORMAL) {
            Ok(()) => Ok((rotation, DVec3::new(m[0][3], m[1][3], m[2][3]))),
            Err(RotationFault::NotOrthonormal(off)) => self.fail(format!(
                "`{name}` has a rotation that is off orthonormal by {off:.1e}; expected no scale and no shear"
            )),
            Err(RotationFault::Mirrored) => self.fail(format!(
                "`{name}` mirrors the axes (its determinant is -1); expected a right-handed rotation: write the \
                 file again with ns-process-data"
            )),
        }
    }
}

/// A value as messages show it.
fn short(value: &Value) -> String {
    let text = value.to_string();
    let start: String = text.chars().take(40).collect();
    if start.len() < text.len() { format!("{start}…") } else { start }
}

fn applied(whole: &Fields<'_>) -> Result<Applied> {
    let mut applied = Applied::NONE;
    if whole.get("applied_transform").is_some() {
        (applied.rotation, applied.translation) = whole.transform("applied_transform")?;
    }
    if let Some(scale) = whole.number("applied_scale")? {
        if scale <= 0.0 {
            return whole.fail(format!("`applied_scale` is {scale}; expected a number above 0"));
        }
        applied.scale = scale;
    }
    Ok(applied)
}

fn camera(fields: &Fields<'_>) -> Result<SurveyCamera> {
    let stated = match fields.get("camera_model") {
        None => "OPENCV",
        Some(Value::String(name)) => name.as_str(),
        Some(other) => return fields.fail(format!("`camera_model` is {}; expected a name", short(other))),
    };
    let round = fields.get("is_fisheye").and_then(Value::as_bool).unwrap_or(false);
    let fisheye = stated == FISHEYE || round;
    if !fisheye && !PERSPECTIVE.contains(&stated) {
        return fields.fail(format!(
            "`camera_model` is {stated}; expected one of {}, {FISHEYE}: undistort the images or cut panoramas into \
             perspective images first",
            PERSPECTIVE.join(", ")
        ));
    }
    let (width, height) = (fields.side("w")?, fields.side("h")?);
    let focal = |name: &str, angle: &str, side: usize| {
        if let Some(stated) = fields.number(name)? {
            return Ok(Some(stated));
        }
        match fields.number(angle)? {
            None => Ok(None),
            Some(a) if a > 0.0 && a < std::f64::consts::PI => {
                Ok(Some(0.5 * side as f64 / math::tan(0.5 * a)))
            }
            Some(a) => fields.fail(format!("`{angle}` is {a}; expected radians between 0 and π")),
        }
    };
    let fx = focal("fl_x", "camera_angle_x", width)?;
    let fy = focal("fl_y", "camera_angle_y", height)?;
    let (Some(fx), Some(fy)) = (fx.or(fy), fy.or(fx)) else {
        return fields
            .fail("the focal length is missing; expected `fl_x` (pixels) or `camera_angle_x` (radians)");
    };
    if !(fx > 0.0 && fy > 0.0) {
        return fields.fail(format!("the focal length is {fx}, {fy}; expected pixels above 0"));
    }
    let or = |name: &str, default: f64| fields.number(name).map(|v| v.unwrap_or(default));
    let principal = [or("cx", 0.5 * width as f64)?, or("cy", 0.5 * height as f64)?];
    let mut distortion = Distortion::default();
    for (slot, name) in distortion.numerator.iter_mut().zip(["k1", "k2", "k3", "k4"]) {
        *slot = or(name, 0.0)?;
    }
    distortion.tangential = [or("p1", 0.0)?, or("p2", 0.0)?];
    for name in UNKNOWN {
        if or(name, 0.0)? != 0.0 {
            return fields
                .fail(format!("`{name}` is not 0, and nerfstudio has no such term; undistort the images"));
        }
    }
    if fisheye && distortion.tangential != [0.0; 2] {
        return fields.fail("a fisheye lens has `p1` or `p2`; expected k1 to k4 alone: calibrate again");
    }
    let projection = if fisheye { Projection::Equidistant } else { Projection::Perspective };
    let lens = Lens { focal: [fx, fy], skew: 0.0, principal, projection, distortion };
    let model = if fisheye { FISHEYE } else { stated };
    Ok(SurveyCamera { id: 0, model: model.to_string(), label: None, width, height, lens })
}
