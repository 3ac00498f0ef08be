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
    fn new(bytes: &'a [u8], path: &'a Path) -> Self {
        Self { rest: bytes, length: bytes.len(), path, record: "header".into() }
    }

    fn fail<T>(&self, reason: String) -> Result<T> {
        let offset = self.length - self.rest.len();
        Err(ModelError::broken(self.path, format!("{}, byte {offset}", self.record), reason))
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N]> {
        match self.rest.split_first_chunk::<N>() {
            Some((head, rest)) => {
                self.rest = rest;
                Ok(*head)
            }
            None => self.fail(format!("the file ends here; {N} more bytes were expected")),
        }
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

    /// A count of records of at least `smallest` bytes each.
    fn count(&mut self, what: &str, smallest: usize) -> Result<usize> {
        let count = self.u64()?;
        let most = (self.rest.len() / smallest) as u64;
        if count > most {
            return self.fail(format!(
                "{count} {what} are announced, but the {} bytes that follow hold at most {most}",
                self.rest.len()
            ));
        }
        Ok(count as usize)
    }

    fn name(&mut self) -> Result<FileName> {
        let Some(end) = self.rest.iter().position(|&b| b == 0) else {
            return self.fail("the image's name does not end".into());
        };
        let (name, rest) = self.rest.split_at(end);
        match std::str::from_utf8(name) {
            Ok(name) => match FileName::new(name) {
                Ok(name) => {
                    self.rest = &rest[1..];
                    Ok(name)
                }
                Err(e) => self.fail(e.to_string()),
            },
            Err(_) => self.fail("the image's name is not UTF-8; rename the image".into()),
        }
    }

    fn finish(self) -> Result<()> {
        if self.rest.is_empty() {
            return Ok(());
        }
        let left = self.rest.len();
        self.fail(format!("{left} bytes are left after the last record that the header announces"))
    }
}

/// Parses `cameras.bin`; `path` is for the messages only.
pub fn cameras(bytes: &[u8], path: &Path) -> Result<Vec<ModelCamera>> {
    let mut c = Cursor::new(bytes, path);
    let count = c.count("cameras", 48)?;
    let mut out = Vec::with_capacity(count);
    for i in 0..count {
        c.record = format!("camera record {i}");
        let id = c.u32()?;
        let code = c.take().map(i32::from_le_bytes)?;
        let Some(model) = LensModel::from_id(code) else {
            return Err(ModelError::unknown_lens(path, c.record, &format!("id {code}"), code));
        };
        let (width, height) = (c.u64()?, c.u64()?);
        let (Ok(width), Ok(height)) = (usize::try_from(width), usize::try_from(height)) else {
            return c.fail(format!("the camera's size is {width}x{height}"));
        };
        let parameters = (0..model.parameter_count()).map(|_| c.f64()).collect::<Result<_>>()?;
        out.push(ModelCamera { id, model, width, height, parameters });
    }
    c.finish()?;
    Ok(out)
}

/// Parses `images.bin`.
pub fn images(bytes: &[u8], path: &Path) -> Result<Vec<ModelImage>> {
    let mut c = Cursor::new(bytes, path);
    let count = c.count("images", 73)?;
    let mut out = Vec::with_capacity(count);
    for i in 0..count {
        c.record = format!("image record {i}");
        let id = c.u32()?;
        let (quaternion, translation) = (c.f64s()?, c.f64s()?);
        let camera = c.u32()?;
        let name = c.name()?;
        let keypoint_count = c.count("keypoints", 24)?;
        let mut keypoints = Vec::with_capacity(keypoint_count);
        for _ in 0..keypoint_count {
            keypoints.push(Keypoint { x: c.f64()?, y: c.f64()?, point: c.u64()? });
        }
        out.push(ModelImage { id, quaternion, translation, camera, name, keypoints });
    }
    c.finish()?;
    Ok(out)
}

/// Parses `points3D.bin`.
pub fn points(bytes: &[u8], path: &Path) -> Result<Vec<ModelPoint>> {
    let mut c = Cursor::new(bytes, path);
    let count = c.count("points", 51)?;
    let mut out = Vec::with_capacity(count);
    for i in 0..count {
        c.record = format!("point record {i}");
        let id = c.u64()?;
        let position = c.f64s()?;
        let color = c.take()?;
        let error = c.f64()?;
        let length = c.count("observations", 8)?;
        let mut track = Vec::with_capacity(length);
        for _ in 0..length {
            track.push((c.u32()?, c.u32()?));
        }
        out.push(ModelPoint { id, position, color, error, track });
    }
    c.finish()?;
    Ok(out)
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
