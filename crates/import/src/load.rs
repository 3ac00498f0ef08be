//! Loading a view's pixels, mask and depth prior at the size of its camera.

use std::path::Path;

use use3d_capture::{Map, Pixels, View};
use use3d_io_image::{Samples, image_info, photograph_info, read, read_map, read_pixels};

use crate::error::ImportError;
use crate::resample::Resize;

/// Relative difference by which the aspect ratio of masks and depth priors may differ from the image's (their
/// sides are often rounded to multiples of 14).
const SHAPE_TOLERANCE: f64 = 0.04;

/// The view's pixels. Their size must be the camera's.
pub fn load_pixels(view: &View) -> Result<Pixels, ImportError> {
    let pixels = read_pixels(&view.image)?;
    let k = &view.camera.intrinsics;
    if pixels.size() == (k.width, k.height) {
        return Ok(pixels);
    }
    let expected = format!(
        "but its camera is {} x {}; the pixels of this capture must be prepared first (`use3d import`)",
        k.width, k.height
    );
    Err(ImportError::Size { path: view.image.clone(), found: pixels.size(), expected })
}

/// The view's mask in `[0, 1]`: the mask file times the image's alpha channel; `None` if it has neither.
pub fn load_mask(view: &View) -> Result<Option<Map>, ImportError> {
    let size = (view.camera.intrinsics.width, view.camera.intrinsics.height);
    let mask = view.mask.as_ref().map(|path| read_mask_at(path, size, &view.image)).transpose()?;
    if !image_info(&view.image)?.alpha {
        return Ok(mask);
    }
    Ok(times_alpha(mask, read(&view.image)?.alpha()))
}

/// The weights of a mask times those of an alpha channel of the same size, where both are there.
pub(crate) fn times_alpha(mask: Option<Map>, alpha: Option<Map>) -> Option<Map> {
    match (mask, alpha) {
        (Some(mut mask), Some(alpha)) if alpha.data().len() == mask.data().len() => {
            mask.data_mut().iter_mut().zip(alpha.data()).for_each(|(m, a)| *m *= a);
            Some(mask)
        }
        (mask, alpha) => mask.or(alpha),
    }
}

/// The view's depth prior (larger is nearer, 0 is unknown), resized to the camera; `None` if it has none.
pub fn load_depth_prior(view: &View) -> Result<Option<Map>, ImportError> {
    let size = (view.camera.intrinsics.width, view.camera.intrinsics.height);
    view.depth_prior.as_ref().map(|path| read_depth_at(path, size)).transpose()
}

/// A map with the aspect ratio of `size`, or an error that states the mismatch.
fn shaped(map: Map, path: &Path, size: (usize, usize), what: &str) -> Result<Map, ImportError> {
    let (sx, sy) = (map.width() as f64 / size.0 as f64, map.height() as f64 / size.1 as f64);
    if (sx / sy - 1.0).abs() > SHAPE_TOLERANCE {
        let expected = format!(
            "but the {what} of an image of {} x {} must have that shape (any size); write it again from \
             that image",
            size.0, size.1
        );
        let (path, found) = (path.to_path_buf(), (map.width(), map.height()));
        return Err(ImportError::Size { path, found, expected });
    }
    Ok(map)
}

/// A mask file's weights. The largest value of a file with the values 0 and 1 is white, and so is 255 in one
/// with 16 bits. A mask that is in the alpha channel is taken from there.
fn read_weights(path: &Path) -> Result<Map, ImportError> {
    let decoded = read(path)?;
    let mut map = decoded.to_map();
    map.data_mut().iter_mut().filter(|v| !v.is_finite()).for_each(|v| *v = 0.0);
    let whites: &[f32] = match decoded.samples {
        Samples::Eight(_) => &[1.0 / 255.0],
        Samples::Sixteen(_) => &[1.0 / 65535.0, 255.0 / 65535.0],
        Samples::Float(_) => &[],
    };
    let range =
        |map: &Map| map.data().iter().fold((f32::INFINITY, 0.0f32), |(a, b), v| (a.min(*v), b.max(*v)));
    let (least, most) = range(&map);
    if whites.iter().any(|white| (most - white).abs() < 1e-3 * white) {
        map.data_mut().iter_mut().for_each(|v| *v /= most);
    }
    Ok(match decoded.alpha() {
        Some(alpha) if least == most && range(&alpha).0 < range(&alpha).1 => alpha,
        alpha => times_alpha(Some(map), alpha).unwrap_or_else(|| Map::new(decoded.width, decoded.height)),
    })
}

/// A map of a turned picture, in the pixels as they are stored: back by the quarter turn of an EXIF
/// orientation (5 to 8).
fn turned_back(map: &Map, orientation: u16) -> Map {
    let (w, h) = (map.height(), map.width());
    let mut out = Map::new(w, h);
    for (at, value) in out.data_mut().iter_mut().enumerate() {
        let (x, y) = (at % w, at / w);
        let (column, row) = match orientation {
            5 => (y, x),
            6 => (h - 1 - y, x),
            7 => (h - 1 - y, w - 1 - x),
            _ => (y, w - 1 - x),
        };
        *value = map.data()[row * h + column];
    }
    out
}

/// A mask at a size: area means when shrunk, linear when enlarged; clamped to `[0, 1]`. A mask that was
/// painted on the picture as its EXIF data turn it is turned back; `image` is the photograph.
pub(crate) fn read_mask_at(path: &Path, size: (usize, usize), image: &Path) -> Result<Map, ImportError> {
    let mut mask = read_weights(path)?;
    if (mask.width() > mask.height()) != (size.0 > size.1) {
        let orientation = photograph_info(image).map_or(1, |info| info.orientation);
        if orientation > 4 {
            mask = turned_back(&mask, orientation);
        }
    }
    let mut mask = shaped(mask, path, size, "mask")?;
    let from = (mask.width(), mask.height());
    if from != size {
        mask = Resize::whole(from, size.0, size.1).apply(&mask);
    }
    mask.data_mut().iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0));
    Ok(mask)
}

/// A depth prior at a size: means of known values when shrunk, nearest when enlarged.
pub(crate) fn read_depth_at(path: &Path, size: (usize, usize)) -> Result<Map, ImportError> {
    let depth = shaped(read_map(path)?, path, size, "depth prior")?;
    let from = (depth.width(), depth.height());
    Ok(if from == size { depth } else { Resize::whole(from, size.0, size.1).apply_to_depth(&depth) })
}
