//! COLMAP's binary files, little-endian. Every count is checked against the number of bytes that are left
//! before memory is allocated.
//!
//! ```text
//! cameras.bin   u64 count; each: u32 id, i32 model, u64 width, u64 height, f64 parameters[model]
//! images.bin    u64 count; each: u32 id, f64 q[4] (wxyz), f64 t[3], u32 camera, name NUL,
//!                                      u64 n; n × (f64 x, f64 y, u64 point)
//! points3D.bin  u64 count; each: u64 id, f64 xyz[3], u8 rgb[3], f64 error,
//!                                      u64 n; n × (u32 image, u32 keypoint)
//! ```

use std::io::{self, Write};
use std::path::Path;

use use3d_capture::FileName;

use crate::camera::ModelCamera;
use crate::error::ModelError;
use crate::lens::LensModel;
use crate::{Keypoint, ModelImage, ModelPoint};

/// The unread rest of a file.
struct Cursor<'a> {
    rest: &'a [u8],
    length: usize,
    path: &'a Path,
    /// The record that is being read, for messages.
    record: String,
}

type Result<T> = std::result::Result<T, ModelError>;

impl<'a> Cursor<'a> {
    fn place(&self) -> String {
        format!("{}, byte {}", self.record, self.length - self.rest.len())
    }

    fn fail<T>(&self, reason: String) -> Result<T> {
        Err(ModelError::broken(self.path, self.place(), reason))
    }

    fn cut_off<T>(&self, reason: String) -> Result<T> {
        Err(ModelError::CutOff { path: self.path.to_path_buf(), place: self.place(), reason })
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N]> {
        let Some((head, rest)) = self.rest.split_first_chunk::<N>() else {
            let left = self.rest.len();
            let bytes = if left == 1 { "byte" } else { "bytes" };
            return self.cut_off(format!("the next number has {N} bytes, but {left} {bytes} are left"));
        };
        self.rest = rest;
        Ok(*head)
    }

    fn u32(&mut self) -> Result<u32> {
        self.take().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Result<u64> {
        self.take().map(u64::from_le_bytes)
    }

    fn f64(&mut self) -> Result<f64> {
        self.take().map(f64::from_le_bytes)
    }

    fn f64s<const N: usize>(&mut self) -> Result<[f64; N]> {
        let mut out = [0.0; N];
        for v in &mut out {
            *v = self.f64()?;
        }
        Ok(out)
    }

    /// A count, and so many records of one kind, such as `camera`, of at least `smallest` bytes each.
    fn list<R>(
        &mut self,
        kind: &str,
        smallest: usize,
        mut read: impl FnMut(&mut Self, usize) -> Result<R>,
    ) -> Result<Vec<R>> {
        let count = self.u64()?;
        let most = (self.rest.len() / smallest) as u64;
        if count > most {
            let plural = if count == 1 { "" } else { "s" };
            return self
                .cut_off(format!("it announces {count} {kind}{plural}, but its data is enough for {most}"));
        }
        let mut out = Vec::with_capacity(count as usize);
        for i in 0..count as usize {
            out.push(read(self, i)?);
        }
        Ok(out)
    }

    fn name(&mut self) -> Result<FileName> {
        let Some(end) = self.rest.iter().position(|&b| b == 0) else {
            return self.cut_off("the image's name does not end".into());
        };
        let (name, rest) = self.rest.split_at(end);
        let Ok(name) = std::str::from_utf8(name) else {
            return self.fail("the image's name is not UTF-8; rename the image".into());
        };
        let name = FileName::new(name).or_else(|e| self.fail(e.to_string()))?;
        self.rest = &rest[1..];
        Ok(name)
    }
}

/// Parses a file of records of one kind, such as `camera`, of at least `smallest` bytes each.
fn records<R>(
    bytes: &[u8],
    path: &Path,
    kind: &str,
    smallest: usize,
    mut read: impl FnMut(&mut Cursor<'_>) -> Result<R>,
) -> Result<Vec<R>> {
    let mut cursor = Cursor { rest: bytes, length: bytes.len(), path, record: "header".into() };
    let out = cursor.list(kind, smallest, |cursor, i| {
        cursor.record = format!("{kind} record {i}");
        read(cursor)
    })?;
    match cursor.rest.len() {
        0 => Ok(out),
        left => cursor.fail(format!("{left} bytes are left after the last record that the header announces")),
    }
}

/// Parses `cameras.bin`; `path` is for the messages only.
pub fn cameras(bytes: &[u8], path: &Path) -> Result<Vec<ModelCamera>> {
    records(bytes, path, "camera", 48, |c| {
        let id = c.u32()?;
        let code = c.take().map(i32::from_le_bytes)?;
        let Some(model) = LensModel::from_id(code) else {
            return Err(ModelError::unknown_lens(path, c.record.clone(), &format!("id {code}"), code));
        };
        let (width, height) = (c.u64()?, c.u64()?);
        let (Ok(width), Ok(height)) = (usize::try_from(width), usize::try_from(height)) else {
            return c.fail(format!("the camera's size is {width}x{height}"));
        };
        let parameters = (0..model.parameter_count()).map(|_| c.f64()).collect::<Result<_>>()?;
        Ok(ModelCamera { id, model, width, height, parameters })
    })
}

/// Parses `images.bin`.
pub fn images(bytes: &[u8], path: &Path) -> Result<Vec<ModelImage>> {
    records(bytes, path, "image", 73, |c| {
        let id = c.u32()?;
        let (quaternion, translation) = (c.f64s()?, c.f64s()?);
        let camera = c.u32()?;
        let name = c.name()?;
        let keypoint = |c: &mut Cursor<'_>, _| Ok(Keypoint { x: c.f64()?, y: c.f64()?, point: c.u64()? });
        let keypoints = c.list("keypoint", 24, keypoint)?;
        Ok(ModelImage { id, quaternion, translation, camera, name, keypoints })
    })
}

/// Parses `points3D.bin`.
pub fn points(bytes: &[u8], path: &Path) -> Result<Vec<ModelPoint>> {
    records(bytes, path, "point", 51, |c| {
        let id = c.u64()?;
        let position = c.f64s()?;
        let color = c.take()?;
        let error = c.f64()?;
        let track = c.list("observation", 8, |c, _| Ok((c.u32()?, c.u32()?)))?;
        Ok(ModelPoint { id, position, color, error, track })
    })
}

fn put(w: &mut impl Write, values: &[f64]) -> io::Result<()> {
    values.iter().try_for_each(|v| w.write_all(&v.to_le_bytes()))
}

/// Writes `cameras.bin`.
pub fn write_cameras(w: &mut impl Write, cameras: &[ModelCamera]) -> io::Result<()> {
    w.write_all(&(cameras.len() as u64).to_le_bytes())?;
    for camera in cameras {
        w.write_all(&camera.id.to_le_bytes())?;
        w.write_all(&camera.model.id().to_le_bytes())?;
        w.write_all(&(camera.width as u64).to_le_bytes())?;
        w.write_all(&(camera.height as u64).to_le_bytes())?;
        put(w, &camera.parameters)?;
    }
    Ok(())
}

/// Writes `images.bin`.
pub fn write_images(w: &mut impl Write, images: &[ModelImage]) -> io::Result<()> {
    w.write_all(&(images.len() as u64).to_le_bytes())?;
    for image in images {
        w.write_all(&image.id.to_le_bytes())?;
        put(w, &image.quaternion)?;
        put(w, &image.translation)?;
        w.write_all(&image.camera.to_le_bytes())?;
        w.write_all(image.name.as_bytes())?;
        w.write_all(&[0])?;
        w.write_all(&(image.keypoints.len() as u64).to_le_bytes())?;
        for keypoint in &image.keypoints {
            put(w, &[keypoint.x, keypoint.y])?;
            w.write_all(&keypoint.point.to_le_bytes())?;
        }
    }
    Ok(())
}

/// Writes `points3D.bin`.
pub fn write_points(w: &mut impl Write, points: &[ModelPoint]) -> io::Result<()> {
    w.write_all(&(points.len() as u64).to_le_bytes())?;
    for point in points {
        w.write_all(&point.id.to_le_bytes())?;
        put(w, &point.position)?;
        w.write_all(&point.color)?;
        put(w, &[point.error])?;
        w.write_all(&(point.track.len() as u64).to_le_bytes())?;
        for (image, keypoint) in &point.track {
            w.write_all(&image.to_le_bytes())?;
            w.write_all(&keypoint.to_le_bytes())?;
        }
    }
    Ok(())
}
