//! From a cameras file to a survey.
//!
//! **The part that is used.** The enabled chunk with the most aligned cameras, and of it the component with
//! the most: components have no common coordinates. Cameras that are disabled or have no transform are left
//! out. The notes of the survey name all that was left out.
//!
//! **Names.** A camera's name is the path of its photograph where the file has one, else its label; where
//! labels repeat, the labels of its groups come before it. The name need not have an extension.
//!
//! **Metres.** A component's transform `x_world = s R x + t` gives metres: those of the local system, or of
//! the earth's centre where the reference system is geographic or projected. A scale of 0 is refused. Without
//! a transform the scale bars give the metres; without either the unit stays unknown.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use glam::{DMat3, DVec3};
use roxmltree::Document;
use use3d_capture::{FileName, Pose, shown};
use use3d_survey::{
    Mark, Marker, PosedImage, ReadError, RotationFault, ScaleBar, Survey, World, check_rotation, first_bytes,
    is_last_row, read_at_most, text, tidy_name, unread,
};

use crate::calibration;
use crate::xml::Element;

type Result<T> = std::result::Result<T, ReadError>;

/// The largest file that is read, bytes: about 100,000 cameras with their covariances.
const LARGEST: u64 = 1 << 29;
/// The newest version whose files are known.
const NEWEST: u64 = 2;
/// The next step for a survey that is not usable.
pub(crate) const REMEDY: &str = "check the project in Metashape and export the cameras again";
/// A rotation may be off orthonormal by this: files have eight digits after the point at least.
const ORTHONORMAL: f64 = 1e-4;
/// Scale bars and a transform may differ by this share before a note says so.
const AGREE: f64 = 0.01;

/// The elements of a chunk, a camera and a sensor that are read, and others that change nothing here.
const KNOWN: &str = "sensors components cameras frames markers scalebars reference transform region settings images meta \
    label component group rotation_covariance location_covariance orientation rolling_shutter accuracy \
    rotation location resolution calibration property bands data_type covariance black_level sensitivity \
    reflectance_panels shapes attributes elevations orthomosaics depth_maps_sets master_channel";

/// True if a file's first bytes are those of a document of Metashape or PhotoScan.
pub fn is_cameras_file(path: &Path) -> bool {
    first_bytes(path, 4096).is_some_and(|head| String::from_utf8_lossy(&head).contains("<document"))
}

/// Reads a cameras file.
///
/// # Errors
/// A file that cannot be read, is no cameras file, has no aligned camera, or holds something that cannot be
/// used; the message names the element and the next step.
pub fn read(path: &Path) -> Result<Survey> {
    parse(&read_at_most(path, LARGEST, "export fewer cameras")?, path)
}

/// Reads the bytes of a cameras file; `path` is for messages.
///
/// # Errors
/// As [`read`].
pub fn parse(bytes: &[u8], path: &Path) -> Result<Survey> {
    let text =
        text(bytes).map_err(|(line, reason)| ReadError::broken(path, format!("line {line}"), reason))?;
    let document = Document::parse(text).map_err(|e| {
        let reason = format!("it is damaged or cut short ({e}); export the cameras again as Agisoft XML");
        ReadError::broken(path, "XML", reason)
    })?;
    let root = Element { node: document.root_element(), path };
    check_version(root)?;
    let (chunk, others) = choose_chunk(root)?;
    let mut survey = read_chunk(chunk)?;
    survey.notes.extend(others);
    survey.check(path, REMEDY)?;
    Ok(survey)
}

fn check_version(root: Element<'_>) -> Result<()> {
    let name = root.node.tag_name().name();
    if name != "document" {
        return root.fail(format!(
            "the file begins with <{name}>; expected <document>: export with File > Export > Export Cameras, \
             format Agisoft XML"
        ));
    }
    let version = root.attribute("version").unwrap_or_default();
    match version.split('.').next().and_then(|major| major.parse::<u64>().ok()) {
        Some(major) if major <= NEWEST => Ok(()),
        _ => root.fail(format!(
            "the attribute `version` is {version:?}; expected 0.8 to {NEWEST}.x: export with Metashape {NEWEST}, or in \
             COLMAP's format"
        )),
    }
}

/// The chunk to read, and notes about the others.
fn choose_chunk(root: Element<'_>) -> Result<(Element<'_>, Vec<String>)> {
    let aligned =
        |chunk: &Element<'_>| chunk.below("camera").filter(|c| c.child("transform").is_some()).count();
    let chunks: Vec<Element<'_>> = root.children("chunk").collect();
    // The first of equals.
    let best = chunks.iter().rev().max_by_key(|chunk| (chunk.flag("enabled", true), aligned(chunk)));
    let Some(&best) = best else {
        return root.fail(
            "it has no <chunk>; a project (.psx) holds no cameras: export them with File > Export > Export \
             Cameras, format Agisoft XML",
        );
    };
    let others = chunks.iter().filter(|c| c.node != best.node).map(|chunk| {
        let label = shown(chunk.attribute("label").unwrap_or("without a label"));
        format!("the chunk {label} is not used ({} aligned cameras)", aligned(chunk))
    });
    Ok((best, others.collect()))
}

/// A camera that may be used.
struct Aligned<'a> {
    element: Element<'a>,
    id: u32,
    sensor: u32,
    component: Option<u32>,
    pose: Pose,
}

fn read_chunk(chunk: Element<'_>) -> Result<Survey> {
    let mut survey = Survey::default();
    let Some(cameras) = chunk.child("cameras") else {
        return chunk.fail("it has no <cameras>; align the photos and export the cameras again");
    };
    let components: Vec<Element<'_>> =
        chunk.children("components").flat_map(|c| c.children("component")).collect();
    let mut members: BTreeMap<u32, u32> = BTreeMap::new();
    for component in &components {
        let id: u32 = component.number("id")?;
        for list in component.children("partition").flat_map(|p| p.children("camera_ids")) {
            let ids = list.text().split_ascii_whitespace().filter_map(|word| word.parse().ok());
            members.extend(ids.map(|camera: u32| (camera, id)));
        }
    }
    let only: Option<u32> = match components.as_slice() {
        [one] => Some(one.number("id")?),
        _ => None,
    };

    let (mut aligned, mut without, mut disabled, mut rigs, mut shutters) = (vec![], vec![], vec![], 0, 0);
    for camera in cameras.below("camera") {
        let label = camera.attribute("label").unwrap_or("without a label").to_string();
        if !camera.flag("enabled", true) {
            disabled.push(label);
            continue;
        }
        let Some(transform) = camera.child("transform") else {
            rigs += usize::from(camera.attribute("master_id").is_some());
            without.push(label);
            continue;
        };
        shutters += usize::from(camera.child("rolling_shutter").is_some());
        let id = camera.number("id")?;
        let stated: Option<u32> = camera.optional_number("component_id")?;
        aligned.push(Aligned {
            element: camera,
            id,
            sensor: camera.number("sensor_id")?,
            component: stated.or_else(|| members.get(&id).copied()).or(only),
            pose: pose(transform)?,
        });
    }
    if aligned.is_empty() {
        return cameras.fail(format!(
            "none of its {} cameras has a <transform>; align the photos (Workflow > Align Photos), then export \
             the cameras again",
            without.len() + disabled.len()
        ));
    }

    // The component with the most cameras, the first of equals.
    let mut counts: BTreeMap<Option<u32>, usize> = BTreeMap::new();
    for camera in &aligned {
        *counts.entry(camera.component).or_default() += 1;
    }
    let used = counts.iter().rev().max_by_key(|(_, count)| **count).and_then(|(id, _)| *id);
    let elsewhere = aligned.len() - counts.get(&used).copied().unwrap_or(0);
    aligned.retain(|camera| camera.component == used);
    let names = |list: &[String]| {
        let few: Vec<_> = list.iter().take(6).map(|n| shown(n)).collect();
        let more = if list.len() > 6 { format!(" and {} more", list.len() - 6) } else { String::new() };
        format!("{}{more}", few.join(", "))
    };
    let mut note = |count: usize, text: String| {
        if count > 0 {
            survey.notes.push(format!("{count} {text}"));
        }
    };
    note(without.len(), format!("cameras are not aligned and not used: {}", names(&without)));
    note(disabled.len(), format!("cameras are disabled and not used: {}", names(&disabled)));
    note(elsewhere, "cameras belong to other components and are not used".into());
    note(
        rigs,
        "cameras without a pose of their own follow a master camera; rigs are not read: export each sensor's poses"
            .into(),
    );
    note(shutters, "cameras have a rolling-shutter correction, which is not applied".into());

    // Sensors that a used camera refers to.
    let mut sensors: BTreeMap<u32, Element<'_>> = BTreeMap::new();
    for sensor in chunk.children("sensors").flat_map(|s| s.children("sensor")) {
        if sensors.insert(sensor.number("id")?, sensor).is_some() {
            return sensor.fail("its id occurs twice; export the cameras again");
        }
    }
    let wanted: BTreeSet<u32> = aligned.iter().map(|c| c.sensor).collect();
    for id in wanted {
        let Some(sensor) = sensors.get(&id) else {
            return cameras.fail(format!("a camera refers to sensor {id}, which is not there; export again"));
        };
        survey.cameras.push(calibration::camera(*sensor)?);
    }

    for (camera, name) in aligned.iter().zip(file_names(chunk, &aligned)?) {
        survey.images.push(PosedImage::at(camera.id, name, camera.sensor, &camera.pose));
    }
    let parts = chunk.node.children().chain(aligned.iter().flat_map(|camera| camera.element.node.children()));
    let sensors = sensors.values().flat_map(|sensor| sensor.node.children());
    let names = parts.chain(sensors).filter(roxmltree::Node::is_element).map(|node| node.tag_name().name());
    survey.notes.extend(unread("the cameras file", names, KNOWN));
    read_markers(chunk, &mut survey)?;
    let component = components.iter().find(|c| c.number::<u32>("id").ok() == used && used.is_some());
    let transform = component.and_then(|c| c.child("transform")).or_else(|| chunk.child("transform"));
    read_world(chunk, transform, &mut survey)?;
    Ok(survey)
}

/// World-to-camera from a camera's transform: sixteen numbers, row by row, camera to component.
fn pose(transform: Element<'_>) -> Result<Pose> {
    let m: [f64; 16] = transform.numbers()?;
    let owner = transform.owner();
    require_last_row(owner, &m)?;
    let row = |i: usize| DVec3::new(m[4 * i], m[4 * i + 1], m[4 * i + 2]);
    // The rows of camera-to-world are the columns of world-to-camera.
    let rotation = DMat3::from_cols(row(0), row(1), row(2));
    require_rotation(owner, &rotation)?;
    Ok(Pose::from_center(rotation, DVec3::new(m[3], m[7], m[11])))
}

fn require_last_row(owner: Element<'_>, matrix: &[f64; 16]) -> Result<()> {
    let last = &matrix[12..];
    if is_last_row(last) {
        return Ok(());
    }
    owner.fail(format!(
        "the last row of its <transform> is {last:?}; expected 0 0 0 1: export the cameras again with Metashape"
    ))
}

fn require_rotation(owner: Element<'_>, rotation: &DMat3) -> Result<()> {
    match check_rotation(rotation, ORTHONORMAL) {
        Ok(()) => Ok(()),
        Err(RotationFault::NotOrthonormal(off)) => {
            owner.fail(format!("its rotation is off orthonormal by {off:.1e}; export the cameras again"))
        }
        Err(RotationFault::Mirrored) => owner.fail(
            "its axes are mirrored (the determinant is -1); expected a right-handed rotation: export the \
             cameras again without changing axes",
        ),
    }
}

/// A name for each camera, distinct from the others.
fn file_names(chunk: Element<'_>, cameras: &[Aligned<'_>]) -> Result<Vec<FileName>> {
    // Frames of a project name the photographs; exported files mostly have labels alone.
    let mut photos: BTreeMap<u32, &str> = BTreeMap::new();
    for frame in chunk.children("frames").flat_map(|f| f.children("frame")).take(1) {
        for camera in frame.children("cameras").flat_map(|c| c.children("camera")) {
            let id: u32 = camera.number("camera_id")?;
            if let Some(path) = camera.child("photo").and_then(|p| p.attribute("path")) {
                photos.insert(id, path);
            }
        }
    }
    let plain: Vec<String> = cameras
        .iter()
        .map(|camera| {
            let label = || camera.element.attribute("label").unwrap_or_default();
            tidy_name(photos.get(&camera.id).copied().unwrap_or_else(label))
        })
        .collect();
    let mut seen: BTreeMap<&str, usize> = BTreeMap::new();
    for name in &plain {
        *seen.entry(name).or_default() += 1;
    }
    let mut taken = BTreeSet::new();
    let mut out = Vec::with_capacity(cameras.len());
    for (camera, name) in cameras.iter().zip(&plain) {
        let mut full = name.clone();
        if seen.get(name.as_str()).is_some_and(|count| *count > 1) {
            let groups = camera.element.node.ancestors().filter(|n| n.has_tag_name("group"));
            for label in groups.filter_map(|g| g.attribute("label")) {
                full = format!("{}/{full}", tidy_name(label));
            }
        }
        let parsed = FileName::new(&full).or_else(|e| {
            camera.element.fail(format!("{e}; rename the camera in Metashape and export the cameras again"))
        })?;
        if !taken.insert(parsed.clone()) {
            return camera.element.fail(format!(
                "two cameras are called {parsed}; rename one, or put them into groups that are called as \
                 the folders of their photographs, and export again"
            ));
        }
        out.push(parsed);
    }
    Ok(out)
}

fn read_markers(chunk: Element<'_>, survey: &mut Survey) -> Result<()> {
    let images: BTreeSet<u32> = survey.images.iter().map(|i| i.id).collect();
    let mut marks: BTreeMap<u32, Vec<Mark>> = BTreeMap::new();
    let frames = chunk.children("frames").flat_map(|f| f.children("frame")).take(1);
    for marker in frames.flat_map(|f| f.children("markers")).flat_map(|m| m.children("marker")) {
        let list = marks.entry(marker.number("marker_id")?).or_default();
        for place in marker.children("location") {
            let mark =
                Mark { image: place.number("camera_id")?, x: place.number("x")?, y: place.number("y")? };
            if images.contains(&mark.image) && mark.x.is_finite() && mark.y.is_finite() {
                list.push(mark);
            }
        }
    }
    for marker in chunk.children("markers").flat_map(|m| m.below("marker")) {
        let id = marker.number("id")?;
        let place = marker.child("reference").filter(|r| r.flag("enabled", true));
        let axis = |name: &str| place.map_or(Ok(None), |place| place.optional_number::<f64>(name));
        let reference = axis("x")?.zip(axis("y")?).zip(axis("z")?).map(|((x, y), z)| [x, y, z]);
        let label = marker.attribute("label").unwrap_or_default().to_string();
        survey.markers.push(Marker { id, label, reference, marks: marks.remove(&id).unwrap_or_default() });
    }
    for bar in chunk.children("scalebars").flat_map(|s| s.below("scalebar")) {
        let ends: Vec<u32> = bar
            .children("endpoint")
            .filter(|e| e.attribute("marker_id").is_some())
            .map(|e| e.number("marker_id"))
            .collect::<Result<_>>()?;
        let Some(reference) = bar.child("reference").filter(|r| r.flag("enabled", true)) else { continue };
        let metres: Option<f64> = match reference.optional_number("distance")? {
            Some(metres) => Some(metres),
            None => reference.optional_number("d")?,
        };
        let (&[a, b], Some(metres)) = (ends.as_slice(), metres) else { continue };
        if !(metres.is_finite() && metres > 0.0) {
            return bar.fail(format!("its length is {metres}; expected metres above 0"));
        }
        let label = bar.attribute("label").unwrap_or_default().to_string();
        survey.scale_bars.push(ScaleBar { label, ends: [a, b], metres });
    }
    Ok(())
}

/// True for the reference system of a project that is on no place of the earth, in either of its spellings.
fn is_local(crs: &str) -> bool {
    ["LOCAL_CS", "ENGCRS"].iter().any(|head| crs.starts_with(head))
}

/// The factor from a local system's unit to metres; 1 for systems on the earth, whose transforms are in
/// metres from its centre.
fn metres_of_unit(crs: &str) -> Option<f64> {
    if !is_local(crs) {
        return Some(1.0);
    }
    let Some(at) = crs.rfind("UNIT[") else { return Some(1.0) };
    let factor: f64 = crs[at..].split(',').nth(1)?.trim_end_matches(']').trim().parse().ok()?;
    (factor.is_finite() && factor > 0.0).then_some(factor)
}

fn read_world(chunk: Element<'_>, transform: Option<Element<'_>>, survey: &mut Survey) -> Result<()> {
    let crs = chunk.child("reference").map(|r| r.text().to_string()).filter(|text| !text.is_empty());
    let bars = survey.metres_by_scale_bars().map(|(metres, worst, label)| (metres, worst, label.to_string()));
    if let Some((_, worst, label)) = bars.as_ref().filter(|(_, worst, _)| *worst > AGREE) {
        survey.notes.push(format!("the scale bars disagree by up to {:.1} % ({label})", 100.0 * worst));
    }
    let bars = bars.map(|(metres, ..)| metres);
    if let Some((scale, rotation, translation)) = transform.map(similarity).transpose()?.flatten() {
        let Some(unit) = metres_of_unit(crs.as_deref().unwrap_or_default()) else {
            return chunk
                .fail("the unit of its <reference> has no factor to metres; choose metres and export again");
        };
        let metres = scale * unit;
        let local = crs.as_deref().is_none_or(is_local);
        if scale == 1.0 && local {
            survey.notes.push(
                "the chunk's scale is exactly 1: unless the project has a scale bar or references, its unit \
                 is no metre"
                    .into(),
            );
        }
        if let Some(by_bars) = bars.filter(|by_bars| (by_bars / metres - 1.0).abs() > AGREE) {
            survey.notes.push(format!(
                "by the scale bars one unit is {by_bars:.6} m, by the chunk's transform {metres:.6} m: update \
                 the transform (Reference > Update) and export again if the bars are right"
            ));
        }
        let source = "Metashape chunk transform".into();
        survey.world = Some(World { crs, ..World::of(metres, &rotation, translation * unit, source) });
    } else {
        survey.world = bars.map(|metres| World::scaled(metres, "Metashape scale bars".into()));
    }
    Ok(())
}

/// Scale, rotation and translation of a transform; `None` where it states no scale.
fn similarity(transform: Element<'_>) -> Result<Option<(f64, DMat3, DVec3)>> {
    let owner = transform.owner();
    let bad_scale = |scale: f64| {
        owner.fail(format!(
            "its <scale> is {scale}; expected above 0: set a scale bar or references, press Reference > Update, \
             and export the cameras again"
        ))
    };
    let (scale, rotation, translation) = if transform.node.has_children() && !transform.text().is_empty() {
        let m: [f64; 16] = transform.numbers()?;
        require_last_row(owner, &m)?;
        let row = |i: usize| DVec3::new(m[4 * i], m[4 * i + 1], m[4 * i + 2]);
        let scale = row(0).length();
        if !scale.is_finite() || scale <= 0.0 {
            return bad_scale(scale);
        }
        let rotation = DMat3::from_cols(row(0), row(1), row(2)).transpose() * (1.0 / scale);
        (scale, rotation, DVec3::new(m[3], m[7], m[11]))
    } else {
        let Some(scale) = transform.child("scale") else { return Ok(None) };
        let [scale] = scale.numbers()?;
        if scale <= 0.0 {
            return bad_scale(scale);
        }
        let rotation = match transform.child("rotation") {
            Some(rotation) => DMat3::from_cols_array(&rotation.numbers()?).transpose(),
            None => DMat3::IDENTITY,
        };
        let translation = match transform.child("translation") {
            Some(translation) => DVec3::from_array(translation.numbers()?),
            None => DVec3::ZERO,
        };
        (scale, rotation, translation)
    };
    require_rotation(owner, &rotation)?;
    Ok(Some((scale, rotation, translation)))
}
