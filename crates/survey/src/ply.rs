//! Points of a PLY file, as photogrammetry programs export them: `x y z`, and colours where they are there.
//!
//! Colours are `red green blue` or `r g b`, 8-bit or 16-bit integers, or floats in `[0, 1]`; without them a
//! point is grey.

use std::path::Path;

use use3d_ply::{PlyError, Vertices};

use crate::read::ReadError;
use crate::survey::SurveyPoint;

/// The most points of a file. A dense cloud is larger and no start for a reconstruction.
const MOST: u64 = 50_000_000;
/// Number of points for which memory is reserved before any has arrived.
const ROWS: u64 = 1 << 14;

/// Reads the points of a PLY file; ids count from 1, tracks are empty, errors unknown. Coordinates may be
/// NaN. `path` is for messages.
///
/// # Errors
/// A file without points, or cut short.
pub fn points(bytes: &[u8], path: &Path) -> Result<Vec<SurveyPoint>, ReadError> {
    let wrong = |place: String, reason: String| ReadError::broken(path, place, reason);
    let broken = |error: PlyError| wrong("points".into(), format!("{error}; export the points again as PLY"));
    let mut vertices = Vertices::open(bytes).map_err(broken)?;
    let count = vertices.count();
    if count > MOST {
        let reason = format!(
            "{count} points, more than the {MOST} that are read; export the tie points (sparse cloud), not the dense cloud"
        );
        return Err(wrong("vertex".into(), reason));
    }
    let [Some(x), Some(y), Some(z)] = ["x", "y", "z"].map(|name| vertices.place(&[name])) else {
        let reason = "the points have no x, y and z; export the points again as PLY";
        return Err(wrong("vertex".into(), reason.into()));
    };
    let colors =
        [["red", "r", "diffuse_red"], ["green", "g", "diffuse_green"], ["blue", "b", "diffuse_blue"]];
    let colors = colors.map(|names| vertices.place(&names).map(|at| (at, vertices.full(at))));
    let mut out = Vec::with_capacity(count.min(ROWS) as usize);
    let mut values = vec![0.0; vertices.properties().len()];
    for index in 0..count {
        vertices.next(|i, value| values[i] = value).map_err(broken)?;
        let position = [values[x], values[y], values[z]];
        let color = colors.map(|found| match found {
            Some((at, full)) => (values[at] / full * 255.0 + 0.5).clamp(0.0, 255.0) as u8,
            None => 128,
        });
        out.push(SurveyPoint { id: index + 1, position, color, error: -1.0, track: Vec::new() });
    }
    Ok(out)
}

/// A sentence on points far from zero whose numbers have too large steps, as those with 32 bits have; `None`
/// if the steps are small against the distances of neighbours. `file` is for the sentence.
///
/// By axis, the step is the smallest difference of two coordinates, and neighbours of `n` points on a surface
/// of width `w` (that of the middle nine tenths) are `w / √n` apart. Points are far beyond `100 w`.
pub fn coarse(points: &[SurveyPoint], file: &Path) -> Option<String> {
    const FAR: f64 = 100.0;
    const STEP: f64 = 0.05;
    let axis = |i: usize| {
        let mut values: Vec<f64> = points.iter().map(|p| p.position[i]).filter(|v| v.is_finite()).collect();
        values.sort_unstable_by(f64::total_cmp);
        let at = |share: f64| values.get((share * values.len() as f64) as usize).copied();
        let (low, middle, high) = (at(0.05)?, at(0.5)?, at(0.95)?);
        let step =
            values.windows(2).map(|pair| pair[1] - pair[0]).filter(|gap| *gap > 0.0).reduce(f64::min)?;
        let apart = (high - low) / (values.len() as f64).sqrt();
        (middle.abs() > FAR * (high - low) && step > STEP * apart).then_some((middle, step, apart))
    };
    let (at, step, apart) = (0..3).filter_map(axis).max_by(|a, b| (a.1 / a.2).total_cmp(&(b.1 / b.2)))?;
    let name = file.file_name().unwrap_or(file.as_os_str()).to_string_lossy();
    Some(format!(
        "the points of {} lie near {at:.0}, where their numbers have steps of {step:.2e}, and neighbours are {apart:.2e} \
         apart, so that they are moved by up to half a step: export them in local coordinates, or as numbers of 64 bits",
        use3d_capture::shown(&name)
    ))
}

/// An ascii PLY file of points, with 17 significant digits, so that positions read back to the same bits.
pub fn write(points: &[SurveyPoint]) -> String {
    use std::fmt::Write;
    let mut out = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty double x\nproperty double y\nproperty double z\n\
         property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n",
        points.len()
    );
    for point in points {
        let ([x, y, z], [r, g, b]) = (point.position, point.color);
        let _ = writeln!(out, "{x} {y} {z} {r} {g} {b}");
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn points(bytes: &[u8]) -> Result<Vec<SurveyPoint>, ReadError> {
        super::points(bytes, Path::new("points.ply"))
    }

    fn header(form: &str, count: u64, more: &str) -> Vec<u8> {
        format!(
            "ply\nformat {form} 1.0\ncomment by hand\nelement vertex {count}\nproperty float x\nproperty float y\n\
             property double z\nproperty list uchar int seen\nproperty ushort red\nproperty uchar green\n{more}end_header\n"
        )
        .into_bytes()
    }

    #[test]
    fn every_form_gives_the_same_points() {
        let mut ascii = header("ascii", 2, "property float blue\n");
        ascii.extend(b"1.5 -2 3.25 2 7 8 65535 51 0.5\n0 0 1 0 0 255 1");
        let read = points(&ascii).unwrap();
        assert_eq!((read[0].position, read[0].color), ([1.5, -2.0, 3.25], [255, 51, 128]));
        assert_eq!((read[1].id, read[1].color), (2, [0, 255, 255]));
        for big in [false, true] {
            let name = if big { "binary_big_endian" } else { "binary_little_endian" };
            let mut bytes = header(name, 2, "property float blue\n");
            let mut put = |little: &[u8]| {
                let mut value = little.to_vec();
                if big {
                    value.reverse();
                }
                bytes.extend(value);
            };
            for (x, y, z, seen, r, g, b) in [
                (1.5f32, -2.0f32, 3.25f64, &[7i32, 8][..], 65535u16, 51u8, 0.5f32),
                (0.0, 0.0, 1.0, &[], 0, 255, 1.0),
            ] {
                put(&x.to_le_bytes());
                put(&y.to_le_bytes());
                put(&z.to_le_bytes());
                put(&[seen.len() as u8]);
                seen.iter().for_each(|s| put(&s.to_le_bytes()));
                put(&r.to_le_bytes());
                put(&[g]);
                put(&b.to_le_bytes());
            }
            assert_eq!(points(&bytes).unwrap(), read, "{name}");
            assert!(points(&bytes[..bytes.len() - 1]).unwrap_err().to_string().contains("vertex 1"));
        }
        assert_eq!(points(write(&read).as_bytes()).unwrap(), read);
    }

    #[test]
    fn what_is_no_cloud_is_explained() {
        for (bytes, expected) in [
            (&b""[..], "not a PLY file"),
            (b"solid\n", "not a PLY file"),
            (b"ply\nformat ascii 1.0\nend_header\n", "no `vertex` element"),
            (b"ply\nelement vertex 1\nproperty float x\nend_header\n", "no format line"),
            (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1", "no x, y and z"),
            (b"ply\nformat ascii 1.0\nproperty float x\n", "before any element"),
            (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty quad x\n", "unknown type"),
            (b"ply\nformat ascii 1.0\nelement vertex many\n", "whole number"),
        ] {
            let said = points(bytes).unwrap_err().to_string();
            assert!(said.contains(expected), "{said} lacks {expected}");
        }
        let huge = header("binary_little_endian", u64::MAX, "");
        assert!(points(&huge).unwrap_err().to_string().contains("dense cloud"));
    }

    #[test]
    fn points_far_from_zero_with_few_bits_are_named() {
        let point = |i: u64| {
            let at = [i % 40, i / 40, (7 * i) % 40].map(|v| 0.1 * v as f64 + 0.001 * (i % 17) as f64);
            SurveyPoint { id: i, position: at, color: [0; 3], error: -1.0, track: Vec::new() }
        };
        let near: Vec<SurveyPoint> = (0..1600).map(point).collect();
        let at = |far: f64, single: bool| {
            let mut moved = near.clone();
            for p in &mut moved {
                p.position[0] += far;
                p.position[0] = if single { f64::from(p.position[0] as f32) } else { p.position[0] };
            }
            coarse(&moved, Path::new("dive/tie.ply"))
        };
        assert_eq!((at(0.0, true), at(100.0, true), at(1e6, false)), (None, None, None));
        let said = at(1e6, true).unwrap();
        assert!(said.starts_with("the points of tie.ply lie near 1000002"), "{said}");
        assert_eq!(coarse(&[], Path::new("a")), None);
    }

    #[test]
    fn mutated_files_never_panic() {
        let mut seed = header("binary_little_endian", 3, "property float blue\n");
        seed.extend([1u8; 99]);
        let mut state = 7u64;
        for _ in 0..20_000 {
            let mut bytes = seed.clone();
            for _ in 0..3 {
                state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                let at = (state >> 33) as usize % bytes.len();
                bytes[at] = (state >> 20) as u8;
            }
            let _ = points(&bytes);
        }
    }
}
