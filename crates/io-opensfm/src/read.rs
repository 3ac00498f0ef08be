//! From a `reconstruction.json` to a survey.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use glam::{DMat3, DVec3};
use serde::Deserialize;
use serde::de::IgnoredAny;
use serde_json::{Map, Value};
use use3d_capture::{FileName, Pose, shown};
use use3d_numerics::math;
use use3d_survey::{PosedImage, ReadError, Survey, SurveyPoint, World, json, read_at_most, unread};

use crate::lens;

type Result<T> = std::result::Result<T, ReadError>;

/// The largest file that is read, bytes: more than a million points.
const LARGEST: u64 = 1 << 29;

/// The next step for a survey that is not usable.
pub(crate) const REMEDY: &str = "run OpenSfM's `reconstruct` again";

/// A reconstruction as it is stored.
#[derive(Deserialize)]
struct StoredReconstruction {
    cameras: Map<String, Value>,
    shots: Map<String, Value>,
    #[serde(default)]
    points: BTreeMap<String, StoredPoint>,
    #[serde(default)]
    reference_lla: Option<GeoReference>,
    #[serde(flatten)]
    others: BTreeMap<String, IgnoredAny>,
}

#[derive(Deserialize)]
struct StoredPoint {
    /// Anything but a number counts as NaN.
    coordinates: [Value; 3],
    #[serde(default)]
    color: [f64; 3],
}

/// The parts of a reconstruction and of a shot that are not read and change nothing here.
const HARMLESS: &str = "main_shots main_points pano_shots biases rig_cameras rig_instances rig_models camera rotation \
    translation orientation capture_time gps_dop gps_position gps compass accelerometer opk vertices \
    faces scale covariance merge_cc skey sequence_key is_canonical_camera";

#[derive(Deserialize)]
struct GeoReference {
    latitude: f64,
    longitude: f64,
    altitude: f64,
}

/// Reads a file, without the tracks.
///
/// # Errors
/// A file that cannot be read, is no reconstruction, or holds something that cannot be used; the message
/// names the shot, camera or point.
pub fn read(path: &Path) -> Result<Survey> {
    parse(&read_at_most(path, LARGEST, "split the reconstruction")?, path)
}

/// Reads the bytes of a file; `path` is for messages.
///
/// # Errors
/// As [`read`].
pub fn parse(bytes: &[u8], path: &Path) -> Result<Survey> {
    let stored: Vec<StoredReconstruction> = json(
        bytes,
        path,
        "no reconstruction of OpenSfM, or damaged",
        "expected a list of reconstructions with cameras, shots and points: take the file that OpenSfM's `reconstruct` \
         wrote",
    )?;
    let sizes: Vec<usize> = stored.iter().map(|r| r.shots.len()).collect();
    let most = sizes.iter().copied().max().unwrap_or(0);
    if most == 0 {
        let reason = "it has no shots; align the photographs again, with more overlap or features";
        return Err(ReadError::broken(path, "list", reason));
    }
    let mut survey = Survey::default();
    let used = sizes.iter().position(|n| *n == most).unwrap_or(0);
    for (i, size) in sizes.iter().enumerate().filter(|(i, _)| *i != used) {
        survey.notes.push(format!("reconstruction {i} is not used ({size} shots)"));
    }
    let Some(stored) = stored.into_iter().nth(used) else { return Ok(survey) };
    let mut cameras: BTreeMap<&str, u32> = BTreeMap::new();
    for (id, (name, shot)) in (1u32..).zip(&stored.shots) {
        let place = format!("shot {name}");
        let broken = |reason: String| ReadError::broken(path, place.clone(), reason);
        let Some(camera) = shot.get("camera").and_then(Value::as_str) else {
            return Err(broken("`camera` is missing; expected the name of one of the cameras".into()));
        };
        let camera = match cameras.get(camera) {
            Some(id) => *id,
            None => {
                let Some((key, entry)) = stored.cameras.get_key_value(camera) else {
                    let camera = shown(camera);
                    let reason = format!("`camera` is {camera}, which is not there; reconstruct again");
                    return Err(broken(reason));
                };
                let id = survey.cameras.len() as u32 + 1;
                survey.cameras.push(lens::camera(id, key, entry, path)?);
                cameras.insert(key, id);
                id
            }
        };
        let vector = |field: &str| -> Result<DVec3> {
            let list = shot.get(field).and_then(Value::as_array);
            let numbers: Option<Vec<f64>> =
                list.and_then(|l| l.iter().map(|v| v.as_f64().filter(|v| v.is_finite())).collect());
            match numbers.as_deref() {
                Some(&[x, y, z]) => Ok(DVec3::new(x, y, z)),
                _ => Err(broken(format!("`{field}` is missing or wrong; expected three finite numbers"))),
            }
        };
        let pose = Pose { rotation: turn(vector("rotation")?), translation: vector("translation")? };
        let name = FileName::new(name)
            .map_err(|e| broken(format!("{e}; expected the photograph's name in the image folder")))?;
        survey.images.push(PosedImage::at(id, name, camera, &pose));
    }
    let mut ids = BTreeSet::new();
    for (name, point) in &stored.points {
        // Ids are numbers in all versions; the tracks name points by them.
        let broken = |reason: String| ReadError::broken(path, format!("point {name}"), reason);
        let id: u64 = name.parse().map_err(|_| {
            broken(format!("its id is no whole number; expected 0, 1, 2 and so on: {REMEDY}"))
        })?;
        if !ids.insert(id) {
            return Err(broken(format!("the id {id} occurs twice; expected each once: {REMEDY}")));
        }
        let position = [0, 1, 2].map(|i| point.coordinates[i].as_f64().unwrap_or(f64::NAN));
        let color = point.color.map(|v| v.round().clamp(0.0, 255.0) as u8);
        survey.points.push(SurveyPoint { id, position, color, error: -1.0, track: Vec::new() });
    }
    survey.points.sort_by_key(|p| p.id);
    let points = std::mem::take(&mut survey.points);
    survey.take_points(points);
    let of_shots = stored.shots.values().filter_map(Value::as_object).flat_map(Map::keys);
    let fields = of_shots.chain(stored.others.keys()).map(String::as_str);
    survey.notes.extend(unread("reconstruction.json", fields, HARMLESS));
    survey.world = stored.reference_lla.and_then(|r| world(&r));
    survey.check(path, REMEDY)?;
    Ok(survey)
}

/// The rotation by an axis times an angle.
fn turn(v: DVec3) -> DMat3 {
    let angle = v.length();
    let cross =
        DMat3::from_cols(DVec3::new(0.0, v.z, -v.y), DVec3::new(-v.z, 0.0, v.x), DVec3::new(v.y, -v.x, 0.0));
    // Rodrigues: I + sin θ/θ [v] + (1 - cos θ)/θ² [v]², with the limits at 0.
    let (a, b) = if angle < 1e-8 {
        (1.0, 0.5)
    } else {
        let half = math::sin(0.5 * angle) / angle;
        (math::sin(angle) / angle, 2.0 * half * half)
    };
    DMat3::IDENTITY + cross * a + cross * cross * b
}

/// Local metres around a place on the earth; `None` for the place that stands for "not known".
fn world(reference: &GeoReference) -> Option<World> {
    let GeoReference { latitude, longitude, altitude } = *reference;
    if latitude == 0.0 && longitude == 0.0 {
        return None;
    }
    let source = format!(
        "OpenSfM's GPS positions: metres east, north and up of latitude {latitude:.7}, longitude {longitude:.7}, \
         altitude {altitude:.2} m"
    );
    Some(World::scaled(1.0, source))
}
