//! Faults of depth maps and of positions: measures beside the photographs that are taken for others.

use std::fmt::Write;

use glam::DVec3;
use image::{ImageBuffer, Luma};
use use3d_io_image::{read_map, write_png_map16};
use use3d_numerics::math;

use super::bytes;
use super::folder::{Chance, Done, Spoiler, pixels_error, some};

/// Metres by axis, from a place on the earth: x to the east, y to the north.
const PER_DEGREE: [f64; 2] = [105_900.0, 110_650.0];
const PLACE: [f64; 2] = [146.0, -18.0];

/// True depths in millimetres, where larger is farther, in place of the maps.
pub(super) fn metric_depth(s: &Spoiler<'_>) -> Done {
    for path in s.files("truth/depth")? {
        let map = read_map(&path)?;
        let values = map.data().iter().map(|z| (1000.0 * z).clamp(0.0, 65535.0) as u16).collect();
        let out = s.path("depth").join(path.file_name().unwrap_or_default()).with_extension("png");
        let deep: Option<ImageBuffer<Luma<u16>, Vec<u16>>> =
            ImageBuffer::from_raw(map.width() as u32, map.height() as u32, values);
        std::fs::create_dir_all(s.path("depth")).map_err(crate::SynthError::io(s.dir))?;
        deep.map_or(Ok(()), |deep| deep.save(&out)).map_err(pixels_error(&out))?;
    }
    Ok(())
}

/// Maps with so many steps between black and white.
pub(super) fn coarse_depth(s: &Spoiler<'_>) -> Done {
    for path in s.files("depth")? {
        let map = read_map(&path)?;
        write_png_map16(&path, &map.map(|v| (v * s.strength as f32).round() / 65535.0))?;
    }
    Ok(())
}

/// A share of the maps belongs to other photographs.
pub(super) fn shuffled_depth(s: &Spoiler<'_>) -> Done {
    let files = s.files("depth")?;
    let share = s.strength.max(2.0 / files.len().max(1) as f64);
    let mixed = some(share, files.len());
    let picked: Vec<_> = files.iter().zip(mixed).filter(|(_, mixed)| *mixed).map(|(path, _)| path).collect();
    let maps = picked.iter().map(|path| read_map(path)).collect::<Result<Vec<_>, _>>()?;
    for (k, path) in picked.iter().enumerate() {
        write_png_map16(path, &maps[(k + (maps.len() / 2).max(1)) % maps.len()])?;
    }
    Ok(())
}

pub(super) fn empty_depth(s: &Spoiler<'_>) -> Done {
    s.files("depth")?.first().map_or(Ok(()), |path| s.edit(path, Vec::clear))
}

/// The names of the photographs with their places in the model, which are metres up to a turn.
fn places(s: &Spoiler<'_>) -> Result<Vec<(String, DVec3)>, crate::SynthError> {
    let model = s.model()?;
    Ok(model.images.iter().map(|image| (image.name.to_string(), image.pose().center())).collect())
}

fn table(s: &Spoiler<'_>, head: &str, row: impl Fn(usize, DVec3) -> String) -> Done {
    let mut text = format!("{head}\n");
    for (i, (name, place)) in places(s)?.into_iter().enumerate() {
        let _ = writeln!(text, "{name},{}", row(i, place));
    }
    s.write("positions.csv", text)
}

/// Errors that wander, by so many metres over the whole swim.
fn walk(s: &Spoiler<'_>, count: usize) -> Vec<DVec3> {
    let (mut chance, mut at) = (s.chance(0), DVec3::ZERO);
    let step = s.strength / (count.max(1) as f64).sqrt();
    let next =
        |chance: &mut Chance| step * DVec3::new(chance.normal(), chance.normal(), 0.6 * chance.normal());
    (0..count)
        .map(|_| {
            at += next(&mut chance);
            at
        })
        .collect()
}

pub(super) fn wandering_positions(s: &Spoiler<'_>) -> Done {
    let errors = walk(s, s.photographs()?.len());
    table(s, "image,x,y,z", |i, at| {
        let at = at + errors.get(i).copied().unwrap_or_default();
        format!("{:.3},{:.3},{:.3}", at.x, at.y, at.z)
    })
}

/// The same error in the GPS positions of the photographs.
pub(super) fn wandering_gps(s: &Spoiler<'_>) -> Done {
    let places = places(s)?;
    let errors = walk(s, places.len());
    bytes::with_exif(s, |i| {
        let at =
            places.get(i).map_or(DVec3::ZERO, |(_, at)| *at) + errors.get(i).copied().unwrap_or_default();
        bytes::gps(PLACE[1] + at.y / PER_DEGREE[1], PLACE[0] + at.x / PER_DEGREE[0], at.z)
    })
}

/// The place in the model of a GPS position.
#[cfg(test)]
pub(super) fn position(latitude: f64, longitude: f64, altitude: f64) -> DVec3 {
    let [east, north] = [longitude - PLACE[0], latitude - PLACE[1]];
    DVec3::new(PER_DEGREE[0] * east, PER_DEGREE[1] * north, altitude)
}

pub(super) fn degrees(s: &Spoiler<'_>) -> Done {
    table(s, "image,x,y,z", |_, at| {
        let [x, y] = [PLACE[0] + at.x / PER_DEGREE[0], PLACE[1] + at.y / PER_DEGREE[1]];
        format!("{x:.8},{y:.8},{:.3}", at.z)
    })
}

pub(super) fn swapped_axes(s: &Spoiler<'_>) -> Done {
    table(s, "image,x,y,z", |_, at| format!("{:.4},{:.4},{:.4}", at.y, at.x, at.z))
}

pub(super) fn feet(s: &Spoiler<'_>) -> Done {
    let foot = 0.3048;
    table(s, "image,x_ft,y_ft,z_ft", |_, at| {
        format!("{:.3},{:.3},{:.3}", at.x / foot, at.y / foot, at.z / foot)
    })
}

/// One position is so many metres away.
pub(super) fn one_false_position(s: &Spoiler<'_>) -> Done {
    let middle = s.photographs()?.len() / 2;
    table(s, "image,x,y,z", |i, at| {
        let off = if i == middle { s.strength } else { 0.0 };
        format!("{:.4},{:.4},{:.4}", at.x + 0.8 * off, at.y - 0.6 * off, at.z)
    })
}

/// All positions on one line, as of a tow whose log has only the way along it.
pub(super) fn on_a_line(s: &Spoiler<'_>) -> Done {
    let first = places(s)?.first().map_or(DVec3::ZERO, |(_, at)| *at);
    table(s, "image,x,y,z", |_, at| {
        let way = math::hypot(math::hypot(at.x - first.x, at.y - first.y), at.z - first.z);
        format!("{way:.3},0,0")
    })
}
