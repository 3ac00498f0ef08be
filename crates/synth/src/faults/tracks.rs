//! Edits of a model that keep its tracks consistent: poses, keypoints that vanish, views that are left out.

use std::collections::{HashMap, HashSet};

use glam::{DMat3, DVec3};
use use3d_capture::Pose;
use use3d_io_colmap::{Keypoint, Model, ModelImage};

/// Gives an image another pose.
pub(super) fn place(image: &mut ModelImage, pose: &Pose) {
    let keypoints = std::mem::take(&mut image.keypoints);
    *image = ModelImage { keypoints, ..ModelImage::at(image.id, image.name.clone(), image.camera, pose) };
}

/// Turns an image about its own centre.
pub(super) fn turn(image: &mut ModelImage, axis: DVec3, degrees: f64) {
    let old = image.pose();
    let rotation = DMat3::from_axis_angle(axis, degrees.to_radians()) * old.rotation;
    place(image, &Pose::from_center(rotation, old.center()));
}

/// Moves an image in space.
pub(super) fn shift(image: &mut ModelImage, by: DVec3) {
    let old = image.pose();
    place(image, &Pose::from_center(old.rotation, old.center() + by));
}

/// The diagonal of the box around all cameras, units of the model.
pub(super) fn extent(model: &Model) -> f64 {
    let centers = || model.images.iter().map(|image| image.pose().center());
    let (low, high) = (centers().reduce(DVec3::min), centers().reduce(DVec3::max));
    low.zip(high).map_or(1.0, |(low, high)| low.distance(high)).max(1e-9)
}

/// Removes keypoints by the number of their image and their place. Points that fewer than two keypoints see
/// are removed too.
pub(super) fn forget(model: &mut Model, gone: impl Fn(usize, f64, f64) -> bool) {
    forget_sightings(model, |i, keypoint| gone(i, keypoint.x, keypoint.y));
}

/// Removes keypoints, as [`forget`] does, by the number of their image and the keypoint.
pub(super) fn forget_sightings(model: &mut Model, gone: impl Fn(usize, &Keypoint) -> bool) {
    let mut kept: HashMap<(u32, u32), u32> = HashMap::new();
    for (i, image) in model.images.iter_mut().enumerate() {
        let all = std::mem::take(&mut image.keypoints);
        for (old, keypoint) in all.into_iter().enumerate().filter(|(_, keypoint)| !gone(i, keypoint)) {
            kept.insert((image.id, old as u32), image.keypoints.len() as u32);
            image.keypoints.push(keypoint);
        }
    }
    for point in &mut model.points {
        let track = std::mem::take(&mut point.track);
        let left = |(image, keypoint)| Some((image, *kept.get(&(image, keypoint))?));
        point.track = track.into_iter().filter_map(left).collect();
    }
    model.points.retain(|point| point.track.len() > 1);
    let ids: HashSet<u64> = model.points.iter().map(|point| point.id).collect();
    let keypoints = model.images.iter_mut().flat_map(|image| &mut image.keypoints);
    keypoints.filter(|k| !ids.contains(&k.point)).for_each(|k| k.point = Keypoint::NONE);
}

/// Leaves out images by their number.
pub(super) fn leave_out(model: &mut Model, gone: impl Fn(usize) -> bool) {
    forget(model, |i, _, _| gone(i));
    let mut number = 0..;
    model.images.retain(|_| number.next().is_some_and(|i| !gone(i)));
}

/// Moves all things by a rotation about the origin, and then by a shift.
pub(super) fn carry(image: &mut ModelImage, rotation: DMat3, by: DVec3) {
    let old = image.pose();
    let center = rotation * old.center() + by;
    place(image, &Pose::from_center(old.rotation * rotation.transpose(), center));
}

/// Splits a model into groups of neighbouring images that share no point, and carries each group away from
/// the one before it by a distance.
pub(super) fn split(model: &mut Model, groups: usize, distance: f64) {
    let count = model.images.len().max(1);
    let group = |i: usize| i * groups / count;
    let number: HashMap<u32, usize> = model.images.iter().enumerate().map(|(i, m)| (m.id, i)).collect();
    // A point stays with the group of most of its track.
    let mut owner: HashMap<u64, usize> = HashMap::new();
    for point in &model.points {
        let mut votes = vec![0; groups];
        point.track.iter().filter_map(|(id, _)| number.get(id)).for_each(|i| votes[group(*i)] += 1);
        owner.insert(point.id, (0..groups).max_by_key(|g| votes[*g]).unwrap_or(0));
    }
    forget_sightings(model, |i, k| owner.get(&k.point).is_some_and(|owner| *owner != group(i)));
    let motion = |g: usize| {
        let rotation = DMat3::from_rotation_z(0.7 * g as f64);
        (rotation, g as f64 * distance * DVec3::new(0.8, 0.6, 0.0))
    };
    for (i, image) in model.images.iter_mut().enumerate() {
        let (rotation, by) = motion(group(i));
        carry(image, rotation, by);
    }
    for point in &mut model.points {
        let (rotation, by) = motion(owner[&point.id]);
        point.position = (rotation * DVec3::from_array(point.position) + by).to_array();
    }
}
