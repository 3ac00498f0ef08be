//! Cameras to render from, read from a COLMAP model, a capture, or a JSON list. They are always in COLMAP's
//! frame, sorted by name (a list keeps its order).
//!
//! The JSON is a list, or an object with a list under `cameras`. Each camera has `width`, `height` (or the
//! object has them for all), a lens, and a world-to-camera pose, in either of two notations:
//!
//! ```json
//! [{"name": "a", "width": 640, "height": 360, "fx": 500, "fy": 500, "cx": 320, "cy": 180,
//!   "rotation": [1,0,0, 0,1,0, 0,0,1], "translation": [0,0,4]},
//!  {"name": "b", "width": 640, "height": 360, "K": [[500,0,320],[0,500,180],[0,0,1]],
//!   "world_to_camera": [[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]}]
//! ```
//!
//! `rotation` is row-major; `name` is optional (the default is the index with four digits). Distorting lenses
//! of a model are replaced by their pinholes.

use std::collections::BTreeMap;
use std::path::Path;

use glam::{DMat3, DVec3};
use serde::Deserialize;
use serde_json::{Value, json};
use use3d_capture::{Camera, FileName, Intrinsics, Pose, natural_order};
use use3d_io_colmap::{Model, ModelForm, read_model, read_model_as};
use use3d_survey::Survey;

use crate::error::ImportError;
use crate::folder::is_prepared;
use crate::layout::find_models;
use crate::params::ImportParams;
use crate::prepared::MODEL;
use crate::rows::from_row_major;
use crate::undistort::{LensFault, choose_pinhole, is_pinhole};

/// The places that cameras are read from.
const PLACES: &str = "expected a COLMAP model folder, a capture folder, or a JSON list of cameras";

/// Reads cameras with their names, in COLMAP's frame.
pub fn read_cameras(path: &Path) -> Result<Vec<(FileName, Camera)>, ImportError> {
    if path.is_file() {
        return read_list(path);
    }
    if !path.is_dir() {
        let reason = format!("there is no such file or folder; {PLACES}");
        return Err(ImportError::List { path: path.to_path_buf(), reason });
    }
    let model = if is_prepared(path) {
        read_model(&path.join(MODEL))?
    } else if let Some(form) = ModelForm::of(path) {
        read_model_as(path, form)?
    } else {
        let found = find_models(path, &ImportParams::default())?;
        return from_model(&(found[0].format.read)(&found[0])?.survey);
    };
    model.check_single(path)?;
    from_model(&model.into_survey(path)?)
}

/// The pinhole cameras of one `images.txt`, in its order, with the lenses of the `cameras.txt` in its folder.
/// Points are not needed, so a path of cameras can consist of these two files.
///
/// # Errors
/// A file that cannot be read, and a name that occurs twice.
pub fn read_images_txt(path: &Path) -> Result<Vec<Camera>, ImportError> {
    let read = |path: &Path| std::fs::read(path).map_err(ImportError::file(path));
    let lenses = path.with_file_name("cameras.txt");
    let images = use3d_io_colmap::text::images(&read(path)?, path)?;
    let cameras = use3d_io_colmap::text::cameras(&read(&lenses)?, &lenses)?;
    let names: Vec<FileName> = images.iter().map(|image| image.name.clone()).collect();
    let by_name: BTreeMap<FileName, Camera> =
        from_model(&Model { cameras, images, points: Vec::new() }.into_survey(path)?)?.into_iter().collect();
    Ok(names.iter().filter_map(|name| by_name.get(name).copied()).collect())
}

/// The pinhole cameras of a model's images, sorted by name.
pub(crate) fn from_model(model: &Survey) -> Result<Vec<(FileName, Camera)>, ImportError> {
    let mut lenses: BTreeMap<u32, Intrinsics> = BTreeMap::new();
    let mut out = Vec::with_capacity(model.images.len());
    for image in &model.images {
        let bad = |reason| ImportError::Lens { camera: image.camera, reason };
        let intrinsics = match lenses.get(&image.camera) {
            Some(known) => *known,
            None => {
                let camera = model.camera(image.camera).ok_or_else(|| bad(LensFault::Absent))?;
                let (w, h) = (camera.width, camera.height);
                let lens = camera.lens;
                let pinhole = if is_pinhole(&lens, w, h) {
                    lens.intrinsics(w, h)
                } else {
                    choose_pinhole(&lens, w, h).map_err(bad)?
                };
                lenses.insert(image.camera, pinhole);
                pinhole
            }
        };
        out.push((image.name.clone(), Camera { intrinsics, pose: image.pose() }));
    }
    out.sort_by(|a, b| natural_order(&a.0, &b.0));
    Ok(out)
}

/// The JSON list that [`read_cameras`] reads, for cameras in COLMAP's frame.
pub fn camera_list<'a>(cameras: impl IntoIterator<Item = (&'a str, Camera)>) -> Value {
    let entry = |(name, camera): (&str, Camera)| {
        let Camera { intrinsics: lens, pose } = camera;
        json!({
            "name": name,
            "width": lens.width,
            "height": lens.height,
            "fx": lens.fx,
            "fy": lens.fy,
            "cx": lens.cx,
            "cy": lens.cy,
            "rotation": pose.rotation.transpose().to_cols_array(),
            "translation": pose.translation.to_array(),
        })
    };
    json!({ "cameras": cameras.into_iter().map(entry).collect::<Vec<_>>() })
}

#[derive(Deserialize)]
struct Entry {
    name: Option<String>,
    width: Option<usize>,
    height: Option<usize>,
    fx: Option<f64>,
    fy: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    rotation: Option<[f64; 9]>,
    translation: Option<[f64; 3]>,
    #[serde(rename = "K")]
    matrix: Option<[[f64; 3]; 3]>,
    world_to_camera: Option<[[f64; 4]; 4]>,
}

const EXPECTED: &str = "expected a list of cameras such as {\"width\": 640, \"height\": 360, \"fx\": 500, \"fy\": 500, \
    \"cx\": 320, \"cy\": 180, \"rotation\": [9 numbers, row by row], \"translation\": [3 numbers]}, see docs/reference/captures.md";

fn read_list(path: &Path) -> Result<Vec<(FileName, Camera)>, ImportError> {
    let bytes = std::fs::read(path).map_err(ImportError::file(path))?;
    let bad = |reason: String| ImportError::List { path: path.to_path_buf(), reason };
    let other = |line: usize| bad(format!("{PLACES}; this file is not JSON (line {line})"));
    let text = use3d_survey::text(&bytes).map_err(|(line, _)| other(line))?;
    let json: Value = serde_json::from_str(text).map_err(|e| other(e.line()))?;
    let (list, width, height) = match json {
        Value::Array(list) => (list, None, None),
        Value::Object(mut object) => {
            let side = |name: &str| object.get(name).and_then(Value::as_u64).map(|n| n as usize);
            let sides = (side("width"), side("height"));
            match object.remove("cameras") {
                Some(Value::Array(list)) => (list, sides.0, sides.1),
                _ => return Err(bad(format!("it has no list `cameras`; {EXPECTED}"))),
            }
        }
        _ => return Err(bad(format!("it is not a list; {EXPECTED}"))),
    };
    let parse = |(i, entry): (usize, Value)| -> Result<Entry, ImportError> {
        serde_json::from_value(entry).map_err(|e| bad(format!("camera {i}: {e}; {EXPECTED}")))
    };
    let entries: Vec<Entry> = list.into_iter().enumerate().map(parse).collect::<Result<_, _>>()?;
    if entries.is_empty() {
        return Err(bad("the list has no cameras".into()));
    }
    let entries = entries.into_iter().enumerate();
    entries
        .map(|(i, entry)| {
            let name = match &entry.name {
                Some(name) => FileName::new(name).map_err(|e| bad(format!("camera {i}: {e}")))?,
                None => FileName::numbered(i),
            };
            let camera = entry.camera(width, height).map_err(|e| bad(format!("camera {i} ({name}): {e}")))?;
            Ok((name, camera))
        })
        .collect()
}

impl Entry {
    fn camera(&self, width: Option<usize>, height: Option<usize>) -> Result<Camera, String> {
        fn need<T>(value: Option<T>, field: &str) -> Result<T, String> {
            value.ok_or_else(|| format!("`{field}` is missing"))
        }
        let (width, height) = (need(self.width.or(width), "width")?, need(self.height.or(height), "height")?);
        if (width as u64).saturating_mul(height as u64) > use3d_io_image::MAX_PIXELS {
            return Err(format!("its size {width}x{height} is beyond {} pixels", use3d_io_image::MAX_PIXELS));
        }
        let (fx, fy, cx, cy) = match &self.matrix {
            Some(k) if k[0][1] != 0.0 || k[1][0] != 0.0 => Err("`K` has skew; expected a plain pinhole")?,
            Some(k) => (k[0][0], k[1][1], k[0][2], k[1][2]),
            None => (need(self.fx, "fx")?, need(self.fy, "fy")?, need(self.cx, "cx")?, need(self.cy, "cy")?),
        };
        let pose = match (&self.world_to_camera, &self.rotation, &self.translation) {
            (Some(m), _, _) => {
                let row = |i: usize| DVec3::new(m[i][0], m[i][1], m[i][2]);
                Pose {
                    rotation: DMat3::from_cols(row(0), row(1), row(2)).transpose(),
                    translation: DVec3::new(m[0][3], m[1][3], m[2][3]),
                }
            }
            (None, Some(r), Some(t)) => {
                Pose { rotation: from_row_major(r), translation: DVec3::from_array(*t) }
            }
            _ => Err("it has no pose; expected `rotation` and `translation`, or `world_to_camera`")?,
        };
        let camera = Camera { intrinsics: Intrinsics { width, height, fx, fy, cx, cy }, pose };
        camera.validate().map_err(|e| e.to_string())?;
        Ok(camera)
    }
}
