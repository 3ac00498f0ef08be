//! Measurements of the water in a capture's photographs, made by the import at the files' own size.
//!
//! The estimate of the water must not depend on the size that a scene is learnt at: small pictures average
//! surfaces, veil and compression together, and on one reef the attenuation of blue fell fivefold from 1280
//! to 256 pixels. The import is the last stage that reads the files. So it samples every tracked point and
//! all open water in the training views, undistorted and otherwise unchanged, and also at half of that size;
//! the comparison shows how far an estimate can be trusted. Without tracks it keeps the distance and colour
//! of the points in the views.
//!
//! `sights.safetensors`, n sightings of points and m cells of open water, for `whole` and `half`:
//!
//! | tensor | shape | what |
//! |---|---|---|
//! | `SIZE/points` | n × 2, u32 | point, view |
//! | `SIZE/values` | n × 6, f32 | mean and spread of the surface's R, G, B, display range; −1: clipped |
//! | `SIZE/open_views` | m, u32 | view |
//! | `SIZE/open` | m × 6, f64 | unit direction x, y, z in the capture's frame, mean colour R, G, B |
//! | `point_colors` | k × 4, f32 | distance in the capture's frame, colour R, G, B; only without tracks |

use std::path::{Path, PathBuf};

use use3d_capture::{Image, Map};
use use3d_import::{ImportError, Imported, load_mask, load_pixels};
use use3d_tensors::{TensorError, TensorFile, TensorWriter};
use use3d_water::{Observation, ObserveError, OpenWater, PointColor, Sights, observe_sizes, point_colors};

/// The file's name, in the import's folder.
pub(crate) const SIGHTS: &str = "sights.safetensors";

/// The stored value of a channel that the camera clipped.
const CLIPPED: f32 = -1.0;

/// Point colours of one view are thinned to about this many.
const POINT_COLORS: usize = 4000;

/// The measurements in a capture's photographs.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct CaptureSights {
    /// Those in the photographs at their own size, and at half that size.
    pub(crate) sizes: [Sights; 2],
    /// Colours of views at points; only if the model has no tracks.
    pub(crate) point_colors: Vec<PointColor>,
}

/// The error of measuring a capture.
#[derive(Debug, thiserror::Error)]
pub enum SightsError {
    /// An image or mask cannot be read.
    #[error(transparent)]
    Import(#[from] ImportError),
    /// The tracks do not fit the views.
    #[error(transparent)]
    Observe(#[from] ObserveError),
    /// The file has another format, or is damaged.
    #[error("{}: {source}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// The problem.
        source: TensorError,
    },
    /// The file cannot be read.
    #[error("{}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The measurements belong to another capture.
    #[error("{}: it names point {point} and view {view}, which the capture does not have; import the capture again", path.display())]
    Other {
        /// The file.
        path: PathBuf,
        /// Index of the point.
        point: usize,
        /// Index of the view.
        view: usize,
    },
    /// The user stopped the work.
    #[error("stopped")]
    Stopped,
}

impl CaptureSights {
    /// Measures a capture. `view` returns a training view's image and mask at the size of its camera, or an
    /// error that stops the work.
    fn measure(
        imported: &Imported,
        view: impl Fn(usize) -> Result<(Image, Option<Map>), SightsError>,
    ) -> Result<Self, SightsError> {
        let capture = &imported.capture;
        let tracks = imported.tracks();
        let cameras: Vec<_> = capture.views.iter().map(|v| v.camera).collect();
        let trains = |v: usize| capture.split.train.binary_search(&v).is_ok();
        if tracks.iter().any(|track| track.sightings.len() > 1) {
            let sizes =
                observe_sizes::<SightsError>(&cameras, &tracks, |v| trains(v).then(|| view(v)).transpose())?;
            return Ok(Self { sizes, point_colors: Vec::new() });
        }
        let mut seen = Self::default();
        for v in (0..cameras.len()).filter(|v| trains(*v)) {
            let (image, mask) = view(v)?;
            let found = point_colors(&cameras[v], &capture.points, &image, mask.as_ref());
            seen.point_colors.extend(found.iter().step_by(found.len().div_ceil(POINT_COLORS).max(1)));
        }
        Ok(seen)
    }

    /// Measures the files of an import, before they are scaled and cropped. `balance` is the import's white
    /// balance. `go_on` is called before each view and returns false to stop.
    ///
    /// # Errors
    /// Fails if an image cannot be read, or with [`SightsError::Stopped`].
    pub(crate) fn of_files(
        imported: &Imported,
        balance: Option<[f32; 3]>,
        go_on: impl Fn() -> bool,
    ) -> Result<Self, SightsError> {
        let whole = imported.full_size();
        Self::measure(&whole, |v| {
            if !go_on() {
                return Err(SightsError::Stopped);
            }
            let view = whole.view(v)?;
            let mut image = view.pixels.to_image();
            for (c, gain) in balance.into_iter().flatten().enumerate() {
                image.plane_mut(c).iter_mut().for_each(|value| *value = (gain * *value).min(1.0));
            }
            Ok((image, view.mask))
        })
    }

    /// Reads the measurements that the import at `folder` stored. If it stored none (a folder of an older
    /// version), its pictures are measured as they are.
    ///
    /// # Errors
    /// Fails if a file cannot be read or belongs to another capture.
    pub(crate) fn of_import(folder: &Path, imported: &Imported) -> Result<Self, SightsError> {
        let path = folder.join(SIGHTS);
        if path.is_file() {
            return Self::read(&path, imported);
        }
        Self::measure(imported, |v| {
            let view = &imported.capture.views[v];
            Ok((load_pixels(view)?.to_image(), load_mask(view)?))
        })
    }

    /// The content of the file.
    ///
    /// # Errors
    /// Fails for sizes that no file can hold.
    pub(crate) fn bytes(&self) -> Result<Vec<u8>, TensorError> {
        let mut file = TensorWriter::new();
        for (sights, size) in self.sizes.iter().zip(["whole", "half"]) {
            let (n, m) = (sights.points.len(), sights.open.len());
            let points: Vec<u32> =
                sights.points.iter().flat_map(|o| [o.point as u32, o.view as u32]).collect();
            file.u32(&format!("{size}/points"), &[n, 2], &points);
            let values = sights.points.iter().flat_map(|o| o.value.into_iter().chain(o.spread));
            let stored = values.map(|v| if v.is_finite() { v as f32 } else { CLIPPED });
            file.f32(&format!("{size}/values"), &[n, 6], &stored.collect::<Vec<_>>());
            let views: Vec<u32> = sights.open.iter().map(|o| o.view as u32).collect();
            file.u32(&format!("{size}/open_views"), &[m], &views);
            let open = sights.open.iter().flat_map(|o| o.direction.to_array().into_iter().chain(o.value));
            file.f64(&format!("{size}/open"), &[m, 6], &open.collect::<Vec<_>>());
        }
        let point_colors = self.point_colors.iter().flat_map(|g| std::iter::once(g.distance).chain(g.value));
        let point_colors: Vec<f32> = point_colors.map(|v| v as f32).collect();
        file.f32("point_colors", &[self.point_colors.len(), 4], &point_colors);
        file.finish()
    }

    fn read(path: &Path, imported: &Imported) -> Result<Self, SightsError> {
        let bytes =
            std::fs::read(path).map_err(|source| SightsError::Read { path: path.to_path_buf(), source })?;
        let of_file = |source| SightsError::File { path: path.to_path_buf(), source };
        let file = TensorFile::read(&bytes).map_err(of_file)?;
        let mut seen = Self::default();
        for (sights, size) in seen.sizes.iter_mut().zip(["whole", "half"]) {
            *sights = sights_of(&file, size, imported, path)?;
        }
        let [k, _] = file.sides("point_colors", "k x 4").map_err(of_file)?;
        let rows = file.f32("point_colors", &[k, 4]).map_err(of_file)?;
        seen.point_colors = rows
            .chunks_exact(4)
            .map(|row| PointColor {
                distance: f64::from(row[0]),
                value: [1, 2, 3].map(|c| f64::from(row[c])),
            })
            .collect();
        Ok(seen)
    }
}

/// The measurements at one size. Distances and directions come from the capture's points and cameras.
fn sights_of(
    file: &TensorFile<'_>,
    size: &str,
    imported: &Imported,
    path: &Path,
) -> Result<Sights, SightsError> {
    let of_file = |source| SightsError::File { path: path.to_path_buf(), source };
    let name = |what: &str| format!("{size}/{what}");
    let [n, _] = file.sides(&name("points"), "n x 2").map_err(of_file)?;
    let points = file.u32(&name("points"), &[n, 2]).map_err(of_file)?;
    let values = file.f32(&name("values"), &[n, 6]).map_err(of_file)?;
    let [m] = file.sides(&name("open_views"), "m").map_err(of_file)?;
    let views = file.u32(&name("open_views"), &[m]).map_err(of_file)?;
    let open = file.f64(&name("open"), &[m, 6]).map_err(of_file)?;
    let capture = &imported.capture;
    let other = |point: usize, view: usize| SightsError::Other { path: path.to_path_buf(), point, view };
    let sighting = |(id, row): (&[u32], &[f32])| {
        let (point, view) = (id[0] as usize, id[1] as usize);
        let (Some(at), Some(seen_by)) = (capture.points.get(point), capture.views.get(view)) else {
            return Err(other(point, view));
        };
        let way = at.position - seen_by.camera.pose.center();
        let distance = way.length();
        Ok(Observation {
            point,
            view,
            distance,
            direction: way / distance,
            value: [0, 1, 2].map(|c| if row[c] < 0.0 { f64::NAN } else { f64::from(row[c]) }),
            spread: [3, 4, 5].map(|c| f64::from(row[c])),
        })
    };
    let cell = |(view, row): (&u32, &[f64])| {
        let view = *view as usize;
        if view >= capture.views.len() {
            return Err(other(0, view));
        }
        Ok(OpenWater { view, direction: [row[0], row[1], row[2]].into(), value: [row[3], row[4], row[5]] })
    };
    Ok(Sights {
        points: points.chunks_exact(2).zip(values.chunks_exact(6)).map(sighting).collect::<Result<_, _>>()?,
        open: views.iter().zip(open.chunks_exact(6)).map(cell).collect::<Result<_, _>>()?,
    })
}

#[cfg(test)]
mod tests {
    use use3d_import::{ImportParams, import};
    use use3d_synth::{CaptureParams, write_capture};

    use super::*;

    #[test]
    fn sights_are_those_of_the_files_at_every_size_and_are_read_back() {
        let dir = tempfile::tempdir().unwrap();
        let reef = dir.path().join("reef");
        let small = CaptureParams {
            views: 5,
            width: 80,
            height: 60,
            points: 300,
            detail: 0.12,
            depth_priors: false,
            ..CaptureParams::default()
        };
        write_capture(&small, &reef, &mut |_, _| ()).unwrap();
        let imported =
            |max_side| import(&reef, &ImportParams { max_side, ..ImportParams::default() }).unwrap();
        let (whole, scaled) = (imported(0), imported(32));
        let seen = CaptureSights::of_files(&whole, None, || true).unwrap();
        let [full, half] = &seen.sizes;
        assert!(full.points.len() > 100 && half.points.len() > 50 && seen.point_colors.is_empty());
        let bytes = seen.bytes().unwrap();
        let again = CaptureSights::of_files(&scaled, None, || true).unwrap();
        assert_eq!(again.bytes().unwrap(), bytes, "whatever the size of training");
        let path = dir.path().join(SIGHTS);
        std::fs::write(&path, &bytes).unwrap();
        let read = CaptureSights::read(&path, &scaled).unwrap();
        assert_eq!(read.bytes().unwrap(), bytes);
        for (a, b) in read.sizes[0].points.iter().zip(&full.points) {
            assert_eq!(
                (a.point, a.view, a.distance, a.direction),
                (b.point, b.view, b.distance, b.direction)
            );
            assert!((0..3).all(|c| a.value[c].is_nan() == b.value[c].is_nan()));
        }
        // The values are balanced as in the import, and the work stops when the user stops it.
        let balanced = CaptureSights::of_files(&whole, Some([1.0, 0.5, 1.0]), || true).unwrap();
        let (a, b) = (&balanced.sizes[0].points[0], &full.points[0]);
        assert!((a.value[1] - 0.5 * b.value[1]).abs() < 1e-6, "{a:?} {b:?}");
        assert!(matches!(CaptureSights::of_files(&whole, None, || false), Err(SightsError::Stopped)));
        // The measurements of another capture are refused, and so is a damaged file.
        let mut fewer = imported(0);
        fewer.capture.points.truncate(3);
        assert!(matches!(CaptureSights::read(&path, &fewer), Err(SightsError::Other { .. })));
        std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
        assert!(CaptureSights::read(&path, &whole).unwrap_err().to_string().contains(SIGHTS));
    }
}
