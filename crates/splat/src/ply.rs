//! Gaussians as PLY files, in the layout that 3D Gaussian Splatting tools share.
//!
//! The file has one `vertex` element per Gaussian with `x y z`, `f_dc_0..2` (band 0), `f_rest_*` (bands 1 and
//! up, channel-major: all of red, then green, then blue; 0, 9, 24 or 45 of them for degree 0 to 3), `opacity`
//! (logit), `scale_0..2` (log), `rot_0..3` (`w x y z`). Normals and other properties, list properties, and
//! elements before `vertex` may be present, in any order and of any type; they are ignored. Binary files of
//! either byte order and ascii files are read ([`use3d_ply`]); binary little-endian is written. Values that
//! are not finite are returned unchanged; [`Gaussians::validate`](crate::Gaussians::validate) finds them.

use std::io::{self, BufWriter, Read, Write};

use use3d_ply::Vertices;

use crate::Gaussians;

/// Number of rows for which memory is reserved before any row has arrived.
const ROWS: usize = 1 << 14;

/// A reason why Gaussians could not be read from a PLY file.
#[derive(Debug, thiserror::Error)]
pub enum PlyError {
    /// The file is no PLY file, or is cut off.
    #[error(transparent)]
    File(#[from] use3d_ply::PlyError),
    /// A property that Gaussians need is missing.
    #[error(
        "the vertices have no property `{0}`; expected the layout of 3D Gaussian Splatting: x y z f_dc_0..2 opacity scale_0..2 rot_0..3"
    )]
    Missing(String),
    /// A number of `f_rest_*` properties that belongs to no degree.
    #[error(
        "the vertices have {0} properties f_rest_*; expected 0, 9, 24 or 45 (spherical-harmonics degree 0 to 3)"
    )]
    Rest(usize),
}

/// Reads Gaussians from a PLY file.
///
/// # Errors
/// The file is no PLY file, is cut off, or has another layout.
pub fn read(reader: impl Read) -> Result<Gaussians, PlyError> {
    let mut vertices = Vertices::open(reader)?;
    let rest = vertices.properties().filter(|name| name.starts_with("f_rest_")).count();
    let sh_degree = match rest {
        0 => 0,
        9 => 1,
        24 => 2,
        45 => 3,
        _ => return Err(PlyError::Rest(rest)),
    };
    // The slots of a row: 0..3 position, 3 opacity, 4..7 scale, 7..11 rotation, 11..59 colour [band][rgb].
    let mut slots = vec![None; vertices.properties().len()];
    let mut place = |name: String, slot: usize| {
        slots[vertices.place(&[&name]).ok_or(PlyError::Missing(name))?] = Some(slot);
        Ok::<_, PlyError>(())
    };
    for (slot, name) in ["x", "y", "z", "opacity"].into_iter().enumerate() {
        place(name.to_string(), slot)?;
    }
    for i in 0..3 {
        place(format!("scale_{i}"), 4 + i)?;
        place(format!("f_dc_{i}"), 11 + i)?;
    }
    for i in 0..4 {
        place(format!("rot_{i}"), 7 + i)?;
    }
    for i in 0..rest {
        let (channel, band) = (i / (rest / 3), 1 + i % (rest / 3));
        place(format!("f_rest_{i}"), 11 + 3 * band + channel)?;
    }
    let mut out = Gaussians::empty(sh_degree);
    let room = vertices.count().min(ROWS as u64) as usize;
    out.means.reserve(room);
    out.log_scales.reserve(room);
    out.quaternions.reserve(room);
    out.opacity_logits.reserve(room);
    out.sh.reserve(room);
    for _ in 0..vertices.count() {
        let mut row = [0.0f32; 59];
        vertices.next(|i, value| {
            if let Some(slot) = slots[i] {
                row[slot] = value as f32;
            }
        })?;
        out.means.push([row[0], row[1], row[2]]);
        out.opacity_logits.push(row[3]);
        out.log_scales.push([row[4], row[5], row[6]]);
        out.quaternions.push([row[7], row[8], row[9], row[10]]);
        out.sh.push(std::array::from_fn(|k| std::array::from_fn(|c| row[11 + 3 * k + c])));
    }
    Ok(out)
}

/// Writes Gaussians as binary little-endian PLY with 45 `f_rest_*` and zero
/// normals, as the common viewers expect.
pub fn write(gaussians: &Gaussians, writer: impl Write) -> io::Result<()> {
    write_with_comments(gaussians, &[], writer)
}

/// Like [`write()`], with comment lines in the header; a line break in a comment becomes a space.
pub fn write_with_comments(gaussians: &Gaussians, comments: &[String], writer: impl Write) -> io::Result<()> {
    let mut out = BufWriter::with_capacity(1 << 18, writer);
    let mut names: Vec<String> = ["x", "y", "z", "nx", "ny", "nz"].map(str::to_string).to_vec();
    names.extend((0..3).map(|i| format!("f_dc_{i}")));
    names.extend((0..45).map(|i| format!("f_rest_{i}")));
    names.push("opacity".to_string());
    names.extend((0..3).map(|i| format!("scale_{i}")));
    names.extend((0..4).map(|i| format!("rot_{i}")));
    write!(out, "ply\nformat binary_little_endian 1.0\n")?;
    // Some readers take the third line for the count.
    writeln!(out, "element vertex {}", gaussians.len())?;
    for comment in comments {
        writeln!(out, "comment {}", comment.replace(['\n', '\r'], " "))?;
    }
    for name in &names {
        writeln!(out, "property float {name}")?;
    }
    out.write_all(b"end_header\n")?;
    let mut row = Vec::with_capacity(names.len() * 4);
    for i in 0..gaussians.len() {
        row.clear();
        let sh = &gaussians.sh[i];
        let rest = (0..3).flat_map(|c| (1..16).map(move |k| sh[k][c]));
        let values = gaussians.means[i]
            .into_iter()
            .chain([0.0; 3])
            .chain(sh[0])
            .chain(rest)
            .chain([gaussians.opacity_logits[i]])
            .chain(gaussians.log_scales[i])
            .chain(gaussians.quaternions[i]);
        for value in values {
            row.extend_from_slice(&value.to_le_bytes());
        }
        out.write_all(&row)?;
    }
    out.flush()
}
