//! Faults of `transforms.json`: numbers, marks, fields and axes as other programs write them.

use glam::{DMat3, DMat4, DVec3};
use serde_json::{Value, json};
use use3d_numerics::math;
use use3d_survey::ply;

use super::folder::{Done, Spoiler};
use super::measures::metric_depth;
use crate::error::SynthError;

const FILE: &str = "transforms.json";
const POINTS: &str = "sparse_pc.ply";

/// Writes the capture as `transforms.json` with `sparse_pc.ply` in place of the COLMAP model, after a change
/// of the document.
fn convert(s: &Spoiler<'_>, change: impl FnOnce(&mut Value)) -> Result<String, SynthError> {
    let failed = |e: String| SynthError::io(s.dir)(std::io::Error::other(e));
    let survey = s.model()?.into_survey(s.dir)?;
    let export = use3d_io_nerfstudio::export(&survey, "images").map_err(|e| failed(e.to_string()))?;
    let mut document: Value = serde_json::from_str(&export.transforms).map_err(|e| failed(e.to_string()))?;
    change(&mut document);
    export.points.map_or(Ok(()), |points| s.write(POINTS, points))?;
    s.remove("sparse")?;
    let text = format!("{document:#}\n");
    s.write(FILE, &text)?;
    Ok(text)
}

fn frames(document: &mut Value) -> impl Iterator<Item = &mut Value> {
    document["frames"].as_array_mut().into_iter().flatten()
}

/// The pose of a frame, camera to world.
fn matrix(frame: &Value) -> DMat4 {
    let at = |row: usize, column: usize| frame["transform_matrix"][row][column].as_f64().unwrap_or(0.0);
    DMat4::from_cols_array(&std::array::from_fn(|i| at(i % 4, i / 4)))
}

fn put_matrix(frame: &mut Value, matrix: DMat4) {
    let rows = matrix.transpose().to_cols_array_2d();
    frame["transform_matrix"] = json!(rows);
}

/// Changes the poses of all frames.
fn with_poses(s: &Spoiler<'_>, change: impl Fn(DMat4) -> DMat4) -> Done {
    convert(s, |document| {
        for frame in frames(document) {
            let changed = change(matrix(frame));
            put_matrix(frame, changed);
        }
    })
    .map(drop)
}

/// Changes the points of the PLY file.
fn with_points(s: &Spoiler<'_>, change: impl Fn(DVec3) -> DVec3) -> Done {
    convert(s, |_| {})?;
    edit_points(s, change)
}

fn edit_points(s: &Spoiler<'_>, change: impl Fn(DVec3) -> DVec3) -> Done {
    let path = s.path(POINTS);
    if !path.is_file() {
        return Ok(());
    }
    let failed = |e: use3d_survey::ReadError| SynthError::io(&path)(std::io::Error::other(e.to_string()));
    let bytes = std::fs::read(&path).map_err(SynthError::io(&path))?;
    let mut points = ply::points(&bytes, &path).map_err(failed)?;
    for point in &mut points {
        point.position = change(DVec3::from_array(point.position)).to_array();
    }
    s.write(POINTS, ply::write(&points))
}

pub(super) fn exchanged_axes(s: &Spoiler<'_>) -> Done {
    with_points(s, |at| DVec3::new(at.x, at.z, -at.y))
}

pub(super) fn turned_points(s: &Spoiler<'_>) -> Done {
    with_points(s, |at| DMat3::from_rotation_z(std::f64::consts::PI) * at)
}

/// Moves poses and points far away, and writes the points with 32 bits.
pub(super) fn far_float_points(s: &Spoiler<'_>) -> Done {
    let far = DVec3::new(0.11 * s.strength, s.strength, 0.0);
    with_poses(s, |pose| DMat4::from_translation(far) * pose)?;
    edit_points(s, |at| (at + far).as_vec3().as_dvec3())?;
    if !s.path(POINTS).is_file() {
        return Ok(());
    }
    s.edit(&s.path(POINTS), |bytes| {
        let text = String::from_utf8_lossy(bytes).replace("property double", "property float");
        *bytes = text.into_bytes();
    })
}

/// Poses with the camera axes of OpenCV, where the format has those of OpenGL.
pub(super) fn other_camera_axes(s: &Spoiler<'_>) -> Done {
    with_poses(s, |pose| pose * DMat4::from_scale(DVec3::new(1.0, -1.0, -1.0)))
}

/// Poses from the world to the camera, where the format has the way back.
pub(super) fn inverse_poses(s: &Spoiler<'_>) -> Done {
    with_poses(s, |pose| pose.inverse())
}

pub(super) fn nan(s: &Spoiler<'_>) -> Done {
    // JSON has no NaN: a text stands for it until the file is written.
    let text = convert(s, |document| {
        let middle = document["frames"].as_array().map_or(0, Vec::len) / 2;
        document["frames"][middle]["transform_matrix"][0][3] = json!("NOT A NUMBER");
    })?;
    s.write(FILE, text.replace("\"NOT A NUMBER\"", "NaN"))
}

pub(super) fn mark(s: &Spoiler<'_>) -> Done {
    let text = convert(s, |_| {})?;
    s.write(FILE, format!("\u{feff}{text}"))
}

pub(super) fn comments(s: &Spoiler<'_>) -> Done {
    let text = convert(s, |_| {})?;
    s.write(FILE, text.replacen('{', "{\n  // written by hand\n", 1))
}

/// The form of NeRF's synthetic captures: an angle in place of focal length and size, names without endings.
fn synthetic_form(document: &mut Value) {
    let number = |document: &Value, field: &str| document[field].as_f64().unwrap_or(1.0);
    let angle = 2.0 * math::atan(0.5 * number(document, "w") / number(document, "fl_x"));
    for frame in frames(document) {
        let name = frame["file_path"].as_str().map(|name| format!("./{}", use3d_capture::stem(name)));
        *frame = json!({ "file_path": name, "transform_matrix": frame["transform_matrix"] });
    }
    let mut rest = json!({ "camera_angle_x": angle });
    for field in ["frames", "applied_transform", "ply_file_path"] {
        rest[field] = document[field].take();
    }
    *document = rest;
}

pub(super) fn no_size(s: &Spoiler<'_>) -> Done {
    convert(s, synthetic_form).map(drop)
}

/// The same in two files, `transforms_train.json` and `transforms_test.json`.
pub(super) fn two_lists(s: &Spoiler<'_>) -> Done {
    let mut both = Value::Null;
    convert(s, |document| {
        synthetic_form(document);
        both = document.clone();
    })?;
    s.remove(FILE)?;
    for (name, test) in [("train", false), ("test", true)] {
        let mut part = both.clone();
        let list = both["frames"].as_array().cloned().unwrap_or_default();
        let kept = list.into_iter().enumerate().filter(|(i, _)| (i % 8 == 0) == test);
        part["frames"] = kept.map(|(_, frame)| frame).collect();
        s.write(&format!("transforms_{name}.json"), format!("{part:#}\n"))?;
    }
    Ok(())
}

/// A radius beyond which pixels do not count, and the black rim that it describes.
pub(super) fn crop_radius(s: &Spoiler<'_>) -> Done {
    let (w, h) = s.size()?;
    let radius = 0.47 * f64::from(w.min(h));
    s.cover(|_, x, y| {
        let (x, y) = (f64::from(x) + 0.5 - 0.5 * f64::from(w), f64::from(y) + 0.5 - 0.5 * f64::from(h));
        (math::hypot(x, y) > radius).then_some([0; 3])
    })?;
    convert(s, |document| document["fisheye_crop_radius"] = json!(radius)).map(drop)
}

/// Fields that change the picture, and that hardly any reader knows.
pub(super) fn unknown_fields(s: &Spoiler<'_>) -> Done {
    convert(s, |document| {
        document["rolling_shutter_time"] = json!(0.03);
        document["crop"] = json!({ "center": [0.0, 0.0, 0.0], "scale": [0.5, 0.5, 0.5] });
        frames(document).for_each(|frame| frame["crop_rect"] = json!([8, 4, 80, 56]));
    })
    .map(drop)
}

/// Metric depth maps that the file names, in the folder of priors.
pub(super) fn named_depth(s: &Spoiler<'_>) -> Done {
    metric_depth(s)?;
    convert(s, |document| {
        for frame in frames(document) {
            let name = frame["file_path"].as_str().map(use3d_capture::stem).unwrap_or_default();
            let name = name.trim_start_matches("images/").to_string();
            frame["depth_file_path"] = json!(format!("depth/{name}.png"));
        }
    })
    .map(drop)
}
