//! Writing a survey as `transforms.json`.
//!
//! Poses and points are turned so that z points up, as `ns-process-data` does, and `applied_transform` says
//! so. One camera's lens stands at the top, those of several stand in their frames. Numbers read back to the
//! same bits.

use glam::DVec3;
use serde_json::{Map, Value, json};
use use3d_survey::{Lens, Projection, Survey, SurveyCamera, ply};

use crate::error::UnknownLens;
use crate::frame::Applied;

/// The name by which a file refers to its points.
const POINTS: &str = "sparse_pc.ply";

/// The texts of a written survey; both belong into one folder.
#[derive(Clone, Debug, PartialEq)]
pub struct Export {
    /// `transforms.json`.
    pub transforms: String,
    /// `sparse_pc.ply`, if the survey has points.
    pub points: Option<String>,
}

/// A survey in nerfstudio's form. `image_folder` is put before the images' names; empty for none.
///
/// # Errors
/// A lens with a term that the format does not have: skew, a denominator, a prism, growing tangential terms,
/// a radial term beyond `k4`, a projection other than perspective and equidistant.
pub fn export(survey: &Survey, image_folder: &str) -> Result<Export, UnknownLens> {
    let applied = Applied::UPRIGHT;
    let mut top = Map::new();
    let shared = match survey.cameras.as_slice() {
        [one] => {
            top.extend(lens(one)?);
            true
        }
        _ => false,
    };
    let (a, t) = (applied.rotation.transpose().to_cols_array_2d(), applied.translation.to_array());
    let row = |i: usize| json!([a[i][0], a[i][1], a[i][2], t[i]]);
    top.insert("applied_transform".into(), json!([row(0), row(1), row(2)]));
    let frames = survey
        .images
        .iter()
        .map(|image| {
            let (rotation, center) = applied.saved(&image.pose());
            let rows = rotation.transpose().to_cols_array_2d();
            let row = |i: usize| json!([rows[i][0], rows[i][1], rows[i][2], center[i]]);
            let name = match image_folder {
                "" => image.name.to_string(),
                folder => format!("{folder}/{}", image.name),
            };
            let mut frame = Map::new();
            frame.insert("file_path".into(), json!(name));
            frame.insert("transform_matrix".into(), json!([row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]));
            frame.insert("colmap_im_id".into(), json!(image.id));
            let files = survey.files.get(&image.id).cloned().unwrap_or_default();
            for (field, file) in [("mask_path", files.mask), ("depth_file_path", files.depth)] {
                if let Some(file) = file {
                    frame.insert(field.into(), json!(file.as_str()));
                }
            }
            if !shared && let Some(camera) = survey.camera(image.camera) {
                frame.extend(lens(camera)?);
            }
            Ok(Value::Object(frame))
        })
        .collect::<Result<Vec<_>, UnknownLens>>()?;
    top.insert("frames".into(), Value::Array(frames));
    let points = (!survey.points.is_empty()).then(|| {
        top.insert("ply_file_path".into(), json!(POINTS));
        let mut moved = survey.points.clone();
        for point in &mut moved {
            point.position = applied.apply(DVec3::from_array(point.position)).to_array();
        }
        ply::write(&moved)
    });
    Ok(Export { transforms: format!("{:#}\n", Value::Object(top)), points })
}

/// The fields of a camera.
fn lens(camera: &SurveyCamera) -> Result<Map<String, Value>, UnknownLens> {
    let fail = |reason| Err(UnknownLens { camera: camera.id, reason });
    let Lens { focal: [fx, fy], skew, principal: [cx, cy], projection, distortion: d } = camera.lens;
    let model = match projection {
        Projection::Perspective => "OPENCV",
        Projection::Equidistant => "OPENCV_FISHEYE",
        _ => return fail("its projection has no name in nerfstudio"),
    };
    if skew != 0.0 {
        return fail("it has skew, for which nerfstudio has no field");
    }
    if d.denominator != [0.0; 3] || d.numerator[4..] != [0.0; 2] {
        return fail("it has radial terms beyond k4, for which nerfstudio has no field");
    }
    if d.prism != [0.0; 2] || d.after_radial.is_some() || d.tangential_growth != [0.0; 2] {
        return fail("it has prism or growing tangential terms, for which nerfstudio has no field");
    }
    let [k1, k2, k3, k4, _, _] = d.numerator;
    let [p1, p2] = d.tangential;
    if projection == Projection::Equidistant && d.tangential != [0.0; 2] {
        return fail("it is a fisheye with tangential terms, for which nerfstudio has no field");
    }
    let fields = json!({
        "camera_model": model, "w": camera.width, "h": camera.height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy,
        "k1": k1, "k2": k2, "k3": k3, "k4": k4, "p1": p1, "p2": p2,
    });
    match fields {
        Value::Object(fields) => Ok(fields),
        _ => Ok(Map::new()),
    }
}
