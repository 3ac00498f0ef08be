//! Faults of the model: poses, lenses, points and tracks that are not those of the photographs.

use glam::{DMat3, DVec3};
use image::{Rgb, RgbImage};
use use3d_capture::Pose;
use use3d_io_colmap::{Keypoint, LensModel, ModelCamera, ModelPoint, write_model_binary, write_model_text};
use use3d_numerics::math;

use super::folder::{Done, Spoiler, some};
use super::tracks::{self, extent, place};
use crate::error::SynthError;

pub(super) fn turn_poses(s: &Spoiler<'_>) -> Done {
    s.edit_model(|model, chance| {
        model.images.iter_mut().for_each(|image| tracks::turn(image, chance.direction(), s.strength));
    })
}

pub(super) fn shift_poses(s: &Spoiler<'_>) -> Done {
    s.edit_model(|model, chance| {
        let step = 0.01 * s.strength * extent(model);
        model.images.iter_mut().for_each(|image| tracks::shift(image, step * chance.direction()));
    })
}

pub(super) fn turn_one(s: &Spoiler<'_>) -> Done {
    s.edit_model(|model, chance| {
        let middle = model.images.len() / 2;
        if let Some(image) = model.images.get_mut(middle) {
            tracks::turn(image, chance.direction(), s.strength);
        }
    })
}

/// Moves one camera away, by so many times the extent of all cameras.
pub(super) fn stray_camera(s: &Spoiler<'_>) -> Done {
    s.edit_model(|model, _| {
        let (far, middle) = (s.strength * extent(model), model.images.len() / 2);
        if let Some(image) = model.images.get_mut(middle) {
            tracks::shift(image, DVec3::new(0.0, 0.0, far));
        }
    })
}

pub(super) fn nan_pose(s: &Spoiler<'_>) -> Done {
    s.edit_model(|model, _| {
        let middle = model.images.len() / 2;
        if let Some(image) = model.images.get_mut(middle) {
            image.translation[1] = f64::NAN;
        }
    })
}

/// Changes the focal lengths and the principal point of every camera.
pub(super) fn edit_lens(s: &Spoiler<'_>, change: impl Fn(&mut [f64], &mut [f64], [f64; 2])) -> Done {
    s.edit_model(|model, _| {
        for camera in &mut model.cameras {
            let size = [camera.width as f64, camera.height as f64];
            let count = focal_lengths(camera);
            let (focal, rest) = camera.parameters.split_at_mut(count);
            change(focal, &mut rest[..2], size);
        }
    })
}

/// The number of focal lengths at the beginning of a camera's parameters.
fn focal_lengths(camera: &ModelCamera) -> usize {
    use LensModel as M;
    let single = [M::SimplePinhole, M::SimpleRadial, M::Radial, M::SimpleRadialFisheye, M::RadialFisheye];
    if single.contains(&camera.model) { 1 } else { 2 }
}

pub(super) fn focal_length(s: &Spoiler<'_>) -> Done {
    edit_lens(s, |focal, _, _| focal.iter_mut().for_each(|f| *f *= 1.0 + 0.01 * s.strength))
}

pub(super) fn principal_point(s: &Spoiler<'_>) -> Done {
    edit_lens(s, |_, principal, [w, h]| {
        principal[0] += 0.01 * s.strength * w;
        principal[1] -= 0.007 * s.strength * h;
    })
}

/// Halves lens and keypoints, and leaves the size: the numbers of a model of smaller photographs.
pub(super) fn half_size(s: &Spoiler<'_>) -> Done {
    edit_lens(s, |focal, principal, _| focal.iter_mut().chain(principal).for_each(|v| *v *= 0.5))?;
    s.edit_model(|model, _| {
        for keypoint in model.images.iter_mut().flat_map(|image| &mut image.keypoints) {
            (keypoint.x, keypoint.y) = (0.5 * keypoint.x, 0.5 * keypoint.y);
        }
    })
}

/// Bends the photographs and their keypoints, and leaves the model as it is.
pub(super) fn distortion(s: &Spoiler<'_>) -> Done {
    let mut model = s.model()?;
    let Some(straight) = model.cameras.first().and_then(ModelCamera::lens) else { return Ok(()) };
    let mut bent = straight;
    bent.distortion.numerator[0] += s.strength;
    s.repaint(1.0, |_, picture| {
        warp(&picture, |x, y| match bent.unproject(x, y) {
            Some((u, v)) => straight.project(u, v),
            None => (x, y),
        })
    })?;
    let (w, h) = s.size()?;
    for keypoint in model.images.iter_mut().flat_map(|image| &mut image.keypoints) {
        if let Some((u, v)) = straight.unproject(keypoint.x, keypoint.y) {
            (keypoint.x, keypoint.y) = bent.project(u, v);
        }
    }
    let inside = |x: f64, y: f64| (0.0..f64::from(w)).contains(&x) && (0.0..f64::from(h)).contains(&y);
    tracks::forget(&mut model, |_, x, y| !inside(x, y));
    s.put_model(&model)
}

/// A picture whose pixels are taken from places in another one; beyond its edges stands the nearest pixel.
pub(super) fn warp(picture: &RgbImage, from: impl Fn(f64, f64) -> (f64, f64)) -> RgbImage {
    let (w, h) = picture.dimensions();
    RgbImage::from_fn(w, h, |x, y| {
        let (u, v) = from(f64::from(x) + 0.5, f64::from(y) + 0.5);
        let place = |u: f64, side: u32| (u - 0.5).clamp(0.0, f64::from(side - 1)) as f32;
        image::imageops::interpolate_bilinear(picture, place(u, w), place(v, h)).unwrap_or(Rgb([0; 3]))
    })
}

/// Gives some images the photographs of others.
pub(super) fn shuffle_photographs(s: &Spoiler<'_>) -> Done {
    s.edit_model(|model, _| {
        let count = model.images.len();
        let share = s.strength.max(2.0 / count.max(1) as f64);
        let picked: Vec<usize> = (0..count).filter(|i| some(share, count)[*i]).collect();
        let names: Vec<_> = picked.iter().map(|i| model.images[*i].name.clone()).collect();
        for (k, i) in picked.iter().enumerate() {
            // Half of the round away: never a neighbour, if there are enough.
            model.images[*i].name = names[(k + (names.len() / 2).max(1)) % names.len()].clone();
        }
    })
}

pub(super) fn far_points(s: &Spoiler<'_>) -> Done {
    s.edit_model(|model, chance| {
        let every = (model.points.len() / 20).max(1);
        for point in model.points.iter_mut().step_by(every).take(20) {
            point.position = (1e6 * chance.direction()).to_array();
        }
    })
}

pub(super) fn nan_point(s: &Spoiler<'_>) -> Done {
    s.edit_model(|model, _| {
        let middle = model.points.len() / 2;
        if let Some(point) = model.points.get_mut(middle) {
            point.position = [f64::NAN; 3];
        }
    })
}

pub(super) fn false_errors(s: &Spoiler<'_>) -> Done {
    s.edit_model(|model, _| model.points.iter_mut().for_each(|point| point.error = 0.01))
}

/// Scales the points about the middle of the cameras, and leaves the cameras.
pub(super) fn scale_points(s: &Spoiler<'_>) -> Done {
    s.edit_model(|model, _| {
        let sum: DVec3 = model.images.iter().map(|image| image.pose().center()).sum();
        let middle = sum / model.images.len().max(1) as f64;
        for point in &mut model.points {
            let away = DVec3::from_array(point.position) - middle;
            point.position = (middle + (1.0 + 0.01 * s.strength) * away).to_array();
        }
    })
}

/// Gives a share of the points the positions of others, as wrong matches do.
pub(super) fn mix_tracks(s: &Spoiler<'_>) -> Done {
    s.edit_model(|model, _| {
        let count = model.points.len();
        let mixed = some(s.strength.min(1.0), count);
        let picked: Vec<usize> = (0..count).filter(|i| mixed[*i]).collect();
        let positions: Vec<_> = picked.iter().map(|i| model.points[*i].position).collect();
        for (k, i) in picked.iter().enumerate() {
            model.points[*i].position = positions[(k + picked.len() / 3 + 1) % picked.len()];
        }
    })
}

/// Shakes the keypoints, by a standard deviation in pixels.
pub(super) fn shake_keypoints(s: &Spoiler<'_>) -> Done {
    s.edit_model(|model, chance| {
        for keypoint in model.images.iter_mut().flat_map(|image| &mut image.keypoints) {
            keypoint.x += s.strength * chance.normal();
            keypoint.y += s.strength * chance.normal();
        }
    })
}

pub(super) fn no_tracks(s: &Spoiler<'_>) -> Done {
    s.edit_model(|model, _| {
        model.images.iter_mut().for_each(|image| image.keypoints.clear());
        model.points.iter_mut().for_each(|point| point.track.clear());
    })
}

pub(super) fn few_views(s: &Spoiler<'_>) -> Done {
    let files = s.photographs()?;
    let kept = some(s.strength / files.len().max(1) as f64, files.len());
    for path in files.iter().zip(&kept).filter(|(_, kept)| !**kept).map(|(path, _)| path) {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        ["images", "depth", "masks"].iter().try_for_each(|folder| s.remove(&format!("{folder}/{name}")))?;
    }
    s.edit_model(|model, _| tracks::leave_out(model, |i| !kept.get(i).is_some_and(|kept| *kept)))
}

/// Writes the views of each half of the swim as a model of its own.
pub(super) fn two_models(s: &Spoiler<'_>) -> Done {
    let whole = s.model()?;
    let half = whole.images.len().div_ceil(2);
    for (number, second) in [(0, false), (1, true)] {
        let mut part = whole.clone();
        tracks::leave_out(&mut part, |i| (i >= half) != second);
        let folder = s.path(&format!("sparse/{number}"));
        std::fs::create_dir_all(&folder).map_err(SynthError::io(&folder))?;
        write_model_binary(&folder, &part)?;
    }
    Ok(())
}

/// Puts two parts that share no point into one model, one of them elsewhere.
pub(super) fn two_parts(s: &Spoiler<'_>) -> Done {
    s.edit_model(|model, _| tracks::split(model, 2, s.strength * extent(model)))
}

/// Views that overlap only in pairs; each pair shows a place of its own.
pub(super) fn no_overlap(s: &Spoiler<'_>) -> Done {
    s.edit_model(|model, _| {
        let (pairs, far) = ((model.images.len() / 2).max(1), 3.0 * extent(model));
        tracks::split(model, pairs, far);
    })
}

/// Writes the model as text in place of binary.
pub(super) fn as_text(s: &Spoiler<'_>) -> Done {
    let model = s.model()?;
    s.remove("sparse/0")?;
    let folder = s.path("sparse/0");
    std::fs::create_dir_all(&folder).map_err(SynthError::io(&folder))?;
    Ok(write_model_text(&folder, &model)?)
}

pub(super) fn single_lines(s: &Spoiler<'_>) -> Done {
    as_text(s)?;
    s.edit(&s.path("sparse/0/images.txt"), |bytes| {
        let text = String::from_utf8_lossy(bytes);
        let lines = text.lines().filter(|line| !line.starts_with('#')).step_by(2);
        *bytes = lines.flat_map(|line| [line, "\n"]).collect::<String>().into_bytes();
    })?;
    s.write("sparse/0/points3D.txt", "")
}

pub(super) fn text_with_mark(s: &Spoiler<'_>) -> Done {
    as_text(s)?;
    s.edit(&s.path("sparse/0/images.txt"), |bytes| {
        let text = String::from_utf8_lossy(bytes);
        // Windows editors begin a file with the mark; other programs write no comments.
        let lines = text.lines().filter(|line| !line.starts_with('#'));
        *bytes = format!("\u{feff}{}\n", lines.collect::<Vec<_>>().join("\r\n")).into_bytes();
    })
}

/// Makes all views from one photograph: a camera that turns by up to an angle on one place, seen through a
/// longer lens so that the views stay inside the photograph; with the angle 0, one that stands still.
fn from_one_place(s: &Spoiler<'_>, zoom: f64, degrees: f64) -> Done {
    let (mut model, files) = (s.model()?, s.photographs()?);
    let middle = model.images.len() / 2;
    let (Some(source), Some(path)) = (model.images.get(middle).cloned(), files.get(middle)) else {
        return Ok(());
    };
    let (picture, pose) = (s.photograph(path)?, source.pose());
    let Some(lens) = model.cameras.first().and_then(ModelCamera::lens) else { return Ok(()) };
    let ([fx, fy], [cx, cy]) = (lens.focal, lens.principal);
    let (focal, count) = ([zoom * fx, zoom * fy], model.images.len());
    let turns: Vec<DMat3> = (0..count)
        .map(|i| {
            let at = 2.0 * i as f64 / (count.max(2) - 1) as f64 - 1.0;
            let (yaw, pitch) = (at * degrees, 0.4 * degrees * math::sin(2.0 * i as f64));
            DMat3::from_rotation_x(pitch.to_radians()) * DMat3::from_rotation_y(yaw.to_radians())
        })
        .collect();
    s.repaint(1.0, |i, _| {
        let mut view = warp(&picture, |x, y| {
            let ray = turns[i].transpose() * DVec3::new((x - cx) / focal[0], (y - cy) / focal[1], 1.0);
            (fx * ray.x / ray.z + cx, fy * ray.y / ray.z + cy)
        });
        let mut grain = s.chance(i);
        view.pixels_mut().flat_map(|p| &mut p.0).for_each(|v| {
            *v = (f64::from(*v) + 2.0 * grain.normal()).round() as u8;
        });
        view
    })?;
    let camera = &mut model.cameras[0];
    camera.model = LensModel::Pinhole;
    camera.parameters = vec![focal[0], focal[1], cx, cy];
    let mut chance = s.chance(count);
    for (image, turn) in model.images.iter_mut().zip(&turns) {
        let off = 1e-3 * chance.direction();
        place(image, &Pose::from_center(*turn * pose.rotation, pose.center() + off));
        image.keypoints.clear();
    }
    // Distances cannot be known, so they are guesses.
    let (width, height) = picture.dimensions();
    let poses: Vec<Pose> = model.images.iter().map(|image| image.pose()).collect();
    for point in std::mem::take(&mut model.points) {
        let away = DVec3::from_array(point.position) - pose.center();
        let position = pose.center() + math::exp(0.4 * chance.normal()) * away;
        let id = model.points.len() as u64 + 1;
        let sight = |pose: &Pose| {
            let at = pose.rotation * position + pose.translation;
            let x = focal[0] * at.x / at.z + cx + 0.3 * chance.normal();
            let y = focal[1] * at.y / at.z + cy + 0.3 * chance.normal();
            let inside = (0.0..f64::from(width)).contains(&x) && (0.0..f64::from(height)).contains(&y);
            (at.z > 0.0 && inside).then_some(Keypoint { x, y, point: id })
        };
        let seen: Vec<Option<Keypoint>> = poses.iter().map(sight).collect();
        if seen.iter().flatten().count() < 2 {
            continue;
        }
        let mut track = Vec::new();
        for (image, keypoint) in model.images.iter_mut().zip(seen) {
            let Some(keypoint) = keypoint else { continue };
            track.push((image.id, image.keypoints.len() as u32));
            image.keypoints.push(keypoint);
        }
        model.points.push(ModelPoint { id, position: position.to_array(), track, ..point });
    }
    s.remove("depth")?;
    s.put_model(&model)
}

pub(super) fn camera_turns(s: &Spoiler<'_>) -> Done {
    from_one_place(s, 1.8, 8.0)
}

pub(super) fn camera_stands(s: &Spoiler<'_>) -> Done {
    from_one_place(s, 1.0, 0.0)
}

/// Every photograph, or a share of them, is there twice, with a place for each.
pub(super) fn duplicates(s: &Spoiler<'_>) -> Done {
    let files = s.photographs()?;
    let twice = some(s.strength.min(1.0), files.len());
    let again = |name: &str| match name.rsplit_once('.') {
        Some((stem, extension)) => format!("{stem} (1).{extension}"),
        None => format!("{name} (1)"),
    };
    for path in files.iter().zip(&twice).filter(|(_, twice)| **twice).map(|(path, _)| path) {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let copy = s.path("images").join(again(&name));
        std::fs::copy(path, &copy).map_err(SynthError::io(&copy))?;
    }
    let mut model = s.model()?;
    let offset = model.images.iter().map(|image| image.id).max().unwrap_or(0);
    let mut copies = Vec::new();
    for (i, image) in model.images.iter().enumerate().filter(|(i, _)| twice.get(*i) == Some(&true)) {
        let mut copy = image.clone();
        copy.id = offset + 1 + i as u32;
        copy.name = use3d_capture::FileName::new(&again(&image.name))?;
        copies.push((image.id, copy));
    }
    for point in &mut model.points {
        let seen = |(id, k): &(u32, u32)| {
            let (_, copy) = copies.iter().find(|(original, _)| original == id)?;
            Some((copy.id, *k))
        };
        let more: Vec<_> = point.track.iter().filter_map(seen).collect();
        point.track.extend(more);
    }
    model.images.extend(copies.into_iter().map(|(_, copy)| copy));
    s.put_model(&model)
}

/// Swaps the red and the blue of the points.
pub(super) fn swapped_point_colors(s: &Spoiler<'_>) -> Done {
    s.edit_model(|model, _| model.points.iter_mut().for_each(|point| point.color.reverse()))
}
