//! Reading a `transforms.json`.

use std::cell::LazyCell;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use glam::{DMat3, DVec3};
use serde_json::{Map, Value};
use use3d_capture::FileName;
use use3d_numerics::math;
use use3d_survey::{
    Distortion, ImageFiles, Lens, PosedImage, Projection, ReadError, RotationFault, Survey, SurveyCamera,
    check_rotation, is_last_row, json, ply, read_at_most, unread,
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
/// The fields that are read, and others that change nothing here.
const KNOWN: &str = "frames file_path transform_matrix mask_path depth_file_path colmap_im_id applied_transform \
    applied_scale ply_file_path train_filenames val_filenames test_filenames camera_model is_fisheye w h \
    fl_x fl_y cx cy camera_angle_x camera_angle_y k1 k2 k3 k4 k5 k6 p1 p2 aabb_scale aabb scale offset \
    up near far n_frames fps time timestamp sharpness rotation orientation_override \
    auto_scale_poses_override integer_depth_scale depth_unit_scale_factor enable_depth_loading \
    enable_ray_loading from_na camera_index camera_label colmap_camera_id name";
/// Beginnings of fields that change the pictures: parts that do not count, and how they were taken.
const CHANGES: [&str; 4] = ["crop", "fisheye_crop_radius", "rolling_shutter", "linear_colors"];
/// The two files of a capture that states its split.
const TRAIN: &str = "transforms_train.json";
const TEST: &str = "transforms_test.json";

/// A file that was read.
#[derive(Clone, Debug)]
pub struct Transforms {
    /// Cameras, images, masks and depth maps, in the coordinates of the model behind the file. File names are
    /// relative to the file's folder.
    pub survey: Survey,
    /// The file of points that `ply_file_path` names.
    pub points: Option<FileName>,
    /// The ids of the images that the file holds out.
    pub held_out: Vec<u32>,
    /// The files that were read.
    pub files: Vec<PathBuf>,
    applied: Applied,
}

impl Transforms {
    /// Adds the points of the file that [`points`](Self::points) names; `path` is for messages.
    ///
    /// # Errors
    /// A file that is no PLY file of points.
    pub fn add_points(&mut self, bytes: &[u8], path: &Path) -> Result<()> {
        let mut points = ply::points(bytes, path)?;
        self.survey.faults.extend(ply::coarse(&points, path));
        for point in &mut points {
            point.position = self.applied.undo(DVec3::from_array(point.position)).to_array();
        }
        self.survey.take_points(points);
        self.survey.check(path, REMEDY)
    }
}

/// The width and height of the photograph of a name, which may lack its extension; `None` if it is not there.
pub type PhotographSize<'a> = &'a dyn Fn(&FileName) -> Option<(usize, usize)>;

/// Reads a file, without its points. Beside `transforms_train.json`, `transforms_test.json` is read too, and
/// its images are held out. `size` is asked if the file does not state the size of images.
///
/// # Errors
/// A file that cannot be read, is no JSON, or holds something that cannot be used; the message names the
/// frame and field.
pub fn read(path: &Path, size: PhotographSize<'_>) -> Result<Transforms> {
    let bytes = |path: &Path| read_at_most(path, LARGEST, "split the capture");
    let mut all = object(&bytes(path)?, path)?;
    let beside = path.with_file_name(TEST);
    let Some(Value::Array(train)) =
        all.get_mut("frames").filter(|_| path.ends_with(TRAIN) && beside.is_file())
    else {
        return of_object(&all, path, size);
    };
    let mut test = object(&bytes(&beside)?, &beside)?;
    let frames = match test.remove("frames") {
        Some(Value::Array(frames)) if frames.iter().all(Value::is_object) => frames,
        _ => return Err(ReadError::broken(&beside, "top level", "`frames` is no list of objects")),
    };
    let first = train.len();
    // The fields of the second file hold for its own frames.
    train.extend(frames.into_iter().map(|frame| {
        let mut fields = test.clone();
        fields.extend(frame.as_object().cloned().unwrap_or_default());
        Value::Object(fields)
    }));
    let mut read = of_object(&all, path, size)?;
    read.held_out = read.survey.images[first..].iter().map(|image| image.id).collect();
    read.files.push(beside);
    read.survey.notes.push(format!(
        "{TRAIN} and {TEST} are read as one capture; the {} photographs of the second are held out",
        read.held_out.len()
    ));
    Ok(read)
}

/// Reads the bytes of a file that states the sizes of its images; `path` is for messages.
///
/// # Errors
/// As [`read`].
pub fn parse(bytes: &[u8], path: &Path) -> Result<Transforms> {
    of_object(&object(bytes, path)?, path, &|_| None)
}

fn object(bytes: &[u8], path: &Path) -> Result<Map<String, Value>> {
    match json(bytes, path, "damaged or cut short", "write it again with ns-process-data")? {
        Value::Object(all) => Ok(all),
        _ => Err(ReadError::broken(path, "JSON", "expected an object with `frames`")),
    }
}

fn of_object(all: &Map<String, Value>, path: &Path, size: PhotographSize<'_>) -> Result<Transforms> {
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
    // A photograph that is not there has the size of another one: the import leaves it out.
    let usual = LazyCell::new(|| {
        let names = frames.iter().filter_map(|frame| FileName::new(frame.get("file_path")?.as_str()?).ok());
        names.filter_map(|name| size(&name)).next()
    });
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
        let camera = camera(&fields, || size(&name).or_else(|| *usual))?;
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
    let (changing, others): (Vec<&str>, Vec<&str>) =
        fields(all, frames).into_iter().partition(|name| CHANGES.iter().any(|start| name.starts_with(start)));
    let file = path.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
    survey.faults.extend(unread(&file, changing, KNOWN).map(|fields| {
        format!("{fields}; they change the pictures: paint masks where pixels do not count (docs/guide/pictures.md)")
    }));
    survey.notes.extend(unread(&file, others, KNOWN));
    survey.check(path, REMEDY)?;
    Ok(Transforms { survey, points, held_out: Vec::new(), files: vec![path.to_path_buf()], applied })
}

/// The fields of a file and of its frames that are not empty.
fn fields<'a>(all: &'a Map<String, Value>, frames: &'a [Value]) -> BTreeSet<&'a str> {
    let fields = all.iter().chain(frames.iter().filter_map(Value::as_object).flatten());
    fields.filter(|(_, value)| !value.is_null()).map(|(name, _)| name.as_str()).collect()
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
    fn side(&self, name: &str) -> Result<Option<usize>> {
        match self.number(name)? {
            None => Ok(None),
            Some(v) if v >= 1.0 && v <= f64::from(u32::MAX) && v.fract() == 0.0 => Ok(Some(v as usize)),
            Some(v) => self.fail(format!("`{name}` is {v}; expected a whole number of pixels above 0")),
        }
    }

    /// Width and height: those of the fields, or else of the photograph.
    fn sides(&self, photograph: impl FnOnce() -> Option<(usize, usize)>) -> Result<(usize, usize)> {
        if let (Some(w), Some(h)) = (self.side("w")?, self.side("h")?) {
            return Ok((w, h));
        }
        let missing = if self.side("w")?.is_none() { "w" } else { "h" };
        photograph().map_or_else(
            || {
                self.fail(format!(
                    "`{missing}` is missing; expected the image's size in pixels as `w` and `h`, or the photograph \
                     in the place that `file_path` names"
                ))
            },
            Ok,
        )
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
        for (i, row) in (1..).zip(rows.into_iter().flatten()) {
            if let Some(j) = row.as_array().and_then(|row| row.iter().position(|v| v.as_str() == Some("NaN")))
            {
                return self.fail(format!(
                    "row {i}, column {} of `{name}` is not a finite number (it is NaN or infinite): leave this frame out, or \
                     find its camera again",
                    j + 1
                ));
            }
        }
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

fn camera(fields: &Fields<'_>, photograph: impl FnOnce() -> Option<(usize, usize)>) -> Result<SurveyCamera> {
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
    let (width, height) = fields.sides(photograph)?;
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
