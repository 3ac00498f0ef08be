//! The training images as the loop stores them, and the target that a step reads.
//!
//! Photographs stay in their stored form (8 or 16 bits), priors and masks as 16 and 8 bits, so that
//! hundreds of views fit in memory. A step's target is computed when it is needed: `divisor × divisor`
//! means of the stored values (R11), over the pixels that count if there is a mask. A pixel counts if its
//! mask is at least one half, and a box if at least half of its pixels count (R30).

use std::error::Error;

use rayon::prelude::*;
use use3d_capture::{Camera, Image, Map, Pixels, Raster, View};

use crate::ReconstructError;

/// Smallest mask of a pixel that counts.
const COUNTS: f32 = 0.5;

/// A view's files after reading. All sizes must be that of the view's camera.
#[derive(Clone, Debug)]
pub struct LoadedView {
    /// The photograph.
    pub pixels: Pixels,
    /// Mask, in `[0, 1]`: pixels of at least one half count.
    pub mask: Option<Map>,
    /// Disparity-like prior: larger is nearer, 0 is unknown.
    pub depth_prior: Option<Map>,
}

/// Reads a view's photograph, mask and prior, so that the loop does not depend on file formats.
pub type ViewLoader<'a> = dyn Fn(&View) -> Result<LoadedView, Box<dyn Error + Send + Sync>> + Sync + 'a;

/// A training view in memory.
#[derive(Clone, Debug)]
pub struct TrainingView {
    /// Its name.
    pub name: String,
    /// Its camera at full size.
    pub camera: Camera,
    /// The photograph in its stored form, at full size.
    pub pixels: Pixels,
    /// Its mask: 255 counts, 0 does not; `None` if every pixel counts.
    pub mask: Option<Raster<u8, 1>>,
    /// The depth prior, stretched to 1…65535, 0 where unknown; `None` if there is none.
    pub prior: Option<Raster<u16, 1>>,
    #[cfg(test)]
    exact: Option<(Image, Map)>,
}

/// The target of a step for a view; its memory is reused from step to step.
#[derive(Clone, Debug, Default)]
pub struct Target {
    /// The photograph at the step's size.
    pub image: Image,
    /// 1 for pixels that count, else 0.
    pub mask: Option<Map>,
    /// The depth prior, 0 where it is unknown or the pixel does not count.
    pub prior: Option<Map>,
}

impl TrainingView {
    /// Checks sizes and camera, and packs the data. A prior without information is dropped; the reason is
    /// returned.
    pub fn new(view: &View, loaded: LoadedView) -> Result<(Self, Option<&'static str>), ReconstructError> {
        let camera = view.camera;
        camera
            .validate()
            .map_err(|source| ReconstructError::Camera { view: view.name.to_string(), source })?;
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let fits = |what, found: (usize, usize)| {
            if found == (width, height) {
                return Ok(());
            }
            let (found_width, found_height) = found;
            let view = view.name.to_string();
            Err(ReconstructError::Size { view, what, found_width, found_height, width, height })
        };
        fits("image", loaded.pixels.size())?;
        for (what, map) in [("mask", &loaded.mask), ("depth prior", &loaded.depth_prior)] {
            if let Some(map) = map {
                fits(what, (map.width(), map.height()))?;
            }
        }
        // NaN does not count.
        let mask = loaded
            .mask
            .as_ref()
            .map(|m| m.map(|v| if v >= COUNTS { 255 } else { 0 }))
            .filter(|m| m.data().contains(&0));
        let (mut prior, dropped) = match loaded.depth_prior.as_ref().map(pack_prior) {
            None => (None, None),
            Some(Ok(prior)) => (Some(prior), None),
            Some(Err(reason)) => (None, Some(reason)),
        };
        if let (Some(prior), Some(mask)) = (&mut prior, &mask) {
            let hidden = prior.data_mut().iter_mut().zip(mask.data()).filter(|(_, counts)| **counts == 0);
            hidden.for_each(|(prior, _)| *prior = 0);
        }
        let view = Self {
            name: view.name.to_string(),
            camera,
            pixels: loaded.pixels,
            mask,
            prior,
            #[cfg(test)]
            exact: None,
        };
        Ok((view, dropped))
    }

    /// A view whose target is exactly these floats, at full size only, because goldens are not 8-bit.
    #[cfg(test)]
    pub(crate) fn exact(camera: Camera, image: Image, prior: Map) -> Self {
        let (w, h) = (image.width(), image.height());
        let pixels = Pixels::Eight(Raster::new(w, h));
        let exact = Some((image, prior));
        Self { name: "exact".into(), camera, pixels, mask: None, prior: None, exact }
    }

    /// True if its mask leaves no pixel.
    pub fn counts_nothing(&self) -> bool {
        self.mask.as_ref().is_some_and(|m| m.data().iter().all(|v| *v == 0))
    }

    /// Number of bytes held.
    pub fn memory(&self) -> usize {
        let (w, h) = self.pixels.size();
        let pixels = match &self.pixels {
            Pixels::Eight(_) => 3,
            Pixels::Sixteen(_) => 6,
        };
        w * h * (pixels + usize::from(self.mask.is_some()) + 2 * usize::from(self.prior.is_some()))
    }

    /// Adds all data on which training depends to a digest.
    pub(crate) fn fingerprint(&self, hasher: &mut blake3::Hasher) {
        hasher.update(&(self.name.len() as u64).to_le_bytes());
        hasher.update(self.name.as_bytes());
        let there = [self.mask.is_some(), self.prior.is_some()];
        hasher.update(&there.map(u8::from));
        match &self.pixels {
            Pixels::Eight(r) => hasher.update(r.data()),
            Pixels::Sixteen(r) => hasher.update(bytemuck::cast_slice(r.data())),
        };
        if let Some(mask) = &self.mask {
            hasher.update(mask.data());
        }
        if let Some(prior) = &self.prior {
            hasher.update(bytemuck::cast_slice(prior.data()));
        }
    }

    /// The camera divided by `divisor`, and the divisor used; it is smaller if the image is smaller than
    /// `divisor`.
    pub fn camera_over(&self, divisor: usize) -> (Camera, usize) {
        let k = &self.camera.intrinsics;
        let divisor = divisor.clamp(1, k.width.min(k.height));
        (self.camera.downscaled(divisor), divisor)
    }

    /// Computes the view's target divided by `divisor` (less if the image is smaller than that); returns
    /// its camera.
    pub fn target(&self, divisor: usize, out: &mut Target) -> Camera {
        let (camera, divisor) = self.camera_over(divisor);
        let (w, h) = (camera.intrinsics.width, camera.intrinsics.height);
        #[cfg(test)]
        if let Some((image, prior)) = &self.exact {
            (out.image, out.prior) = (image.clone(), Some(prior.clone()));
            return camera;
        }
        let mask = self.mask.as_ref();
        match &self.pixels {
            Pixels::Eight(r) => means(r, mask, divisor, w, h, 255.0, &mut out.image),
            Pixels::Sixteen(r) => means(r, mask, divisor, w, h, 65535.0, &mut out.image),
        }
        match mask {
            Some(raster) => {
                let mask = out.mask.get_or_insert_with(|| Map::new(0, 0));
                means(raster, None, divisor, w, h, 255.0, mask);
                mask.data_mut().iter_mut().for_each(|v| *v = if *v >= COUNTS { 1.0 } else { 0.0 });
            }
            None => out.mask = None,
        }
        match &self.prior {
            Some(raster) => {
                known_means(raster, divisor, w, h, out.prior.get_or_insert_with(|| Map::new(0, 0)));
            }
            None => out.prior = None,
        }
        if let (Some(prior), Some(mask)) = (&mut out.prior, &out.mask) {
            for (prior, counts) in prior.data_mut().iter_mut().zip(mask.data()) {
                if *counts == 0.0 {
                    *prior = 0.0;
                }
            }
        }
        camera
    }
}

/// The prior stretched to 1…65535 (the loss ignores scale and shift), 0 where it is not finite or not
/// positive; the error is the reason why it has no information.
fn pack_prior(map: &Map) -> Result<Raster<u16, 1>, &'static str> {
    let known = |v: f32| v.is_finite() && v > 0.0;
    let (mut low, mut high) = (f32::INFINITY, 0.0f32);
    for &v in map.data() {
        if known(v) {
            (low, high) = (low.min(v), high.max(v));
        }
    }
    if high == 0.0 {
        return Err("has no finite positive pixel");
    }
    if high - low <= 1e-6 * high {
        return Err("is the same everywhere");
    }
    let scale = 65534.0 / f64::from(high - low);
    Ok(map.map(|v| if known(v) { (f64::from(v - low) * scale + 1.5) as u16 } else { 0 }))
}

/// Computes `divisor × divisor` means over `fine`, per plane; only over pixels that count if there is a mask,
/// and 0 where none does.
fn means<T: Copy + Into<i32> + Sync, const C: usize>(
    fine: &Raster<T, C>,
    mask: Option<&Raster<u8, 1>>,
    divisor: usize,
    w: usize,
    h: usize,
    full: f32,
    out: &mut Raster<f32, C>,
) where
    Raster<T, C>: Sync,
{
    out.resize(w, h);
    let (fw, fh) = (fine.width(), fine.height());
    let scale = 1.0 / (full * (divisor * divisor) as f32);
    out.data_mut().par_chunks_mut(w).enumerate().for_each(|(line, out)| {
        let (c, j) = (line / h, line % h);
        let rows = &fine.data()[(c * fh + j * divisor) * fw..(c * fh + (j + 1) * divisor) * fw];
        if let Some(mask) = mask {
            let mask = &mask.data()[j * divisor * fw..(j + 1) * divisor * fw];
            for (i, o) in out.iter_mut().enumerate() {
                let (mut sum, mut count) = (0i64, 0usize);
                for (row, counts) in rows.chunks_exact(fw).zip(mask.chunks_exact(fw)) {
                    let of_box = i * divisor..(i + 1) * divisor;
                    for (&v, _) in row[of_box.clone()].iter().zip(&counts[of_box]).filter(|(_, m)| **m > 0) {
                        sum += i64::from(Into::<i32>::into(v));
                        count += 1;
                    }
                }
                // A full box has the same bits as without a mask.
                let full_box = count == divisor * divisor;
                *o = if full_box { sum as f32 * scale } else { sum as f32 / (full * count.max(1) as f32) };
            }
            return;
        }
        if divisor == 1 {
            for (o, &v) in out.iter_mut().zip(rows) {
                *o = Into::<i32>::into(v) as f32 * scale;
            }
            return;
        }
        for (i, o) in out.iter_mut().enumerate() {
            // One row of a box fits into 32 bits (at most MOST_DIVISOR 16-bit values); a whole box may not.
            let mut sum = 0i64;
            for row in rows.chunks_exact(fw) {
                sum += i64::from(
                    row[i * divisor..(i + 1) * divisor].iter().map(|&v| Into::<i32>::into(v)).sum::<i32>(),
                );
            }
            *o = sum as f32 * scale;
        }
    });
}

/// Computes means over the known values only; 0 where no value is known.
fn known_means(fine: &Raster<u16, 1>, divisor: usize, w: usize, h: usize, out: &mut Map) {
    out.resize(w, h);
    let fw = fine.width();
    out.data_mut().par_chunks_mut(w).enumerate().for_each(|(j, out)| {
        let rows = &fine.data()[j * divisor * fw..(j + 1) * divisor * fw];
        for (i, o) in out.iter_mut().enumerate() {
            let (mut sum, mut count) = (0u64, 0u64);
            for row in rows.chunks_exact(fw) {
                for &v in &row[i * divisor..(i + 1) * divisor] {
                    sum += u64::from(v);
                    count += u64::from(v > 0);
                }
            }
            *o = if count == 0 { 0.0 } else { sum as f32 / (count as f32 * 65535.0) };
        }
    });
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use use3d_capture::{Intrinsics, Pose};

    use super::*;

    fn view(width: usize, height: usize) -> View {
        let intrinsics = Intrinsics { width, height, fx: 9.0, fy: 9.0, cx: 4.0, cy: 3.0 };
        View {
            name: use3d_capture::FileName::new("a.png").unwrap(),
            id: 1,
            image: PathBuf::new(),
            mask: None,
            depth_prior: None,
            camera: Camera { intrinsics, pose: Pose::IDENTITY },
        }
    }

    fn loaded(w: usize, h: usize) -> LoadedView {
        let data = (0..3 * w * h).map(|i| (i * 7 % 256) as u8).collect();
        let pixels = Pixels::Eight(Raster::from_planes(w, h, data).unwrap());
        LoadedView { pixels, mask: None, depth_prior: None }
    }

    #[test]
    fn targets_are_box_means_of_the_stored_values() {
        let (view, dropped) = TrainingView::new(&view(7, 5), loaded(7, 5)).unwrap();
        assert_eq!(dropped, None);
        let full = view.pixels.to_image();
        let mut target = Target::default();
        view.target(1, &mut target);
        for (a, b) in target.image.data().iter().zip(full.data()) {
            assert!((a - b).abs() < 1e-7);
        }
        let camera = view.target(2, &mut target);
        assert_eq!((target.image.width(), target.image.height()), (3, 2));
        assert_eq!(camera.intrinsics.width, 3);
        for c in 0..3 {
            let mean = (0..4).map(|k| full.pixel(2 + k % 2, 2 + k / 2)[c]).sum::<f32>() / 4.0;
            assert!((target.image.pixel(1, 1)[c] - mean).abs() < 1e-6);
        }
    }

    #[test]
    fn large_boxes_of_sixteen_bits_have_their_mean() {
        let side = 400;
        let pixels = Pixels::Sixteen(Raster::from_planes(side, side, vec![65_000; 3 * side * side]).unwrap());
        let mut prior = Map::filled(side, side, 1.0);
        prior.set_pixel(0, 0, [0.5]);
        let loaded = LoadedView { pixels, mask: None, depth_prior: Some(prior) };
        let (view, _) = TrainingView::new(&view(side, side), loaded).unwrap();
        let mut target = Target::default();
        for divisor in [182, 257, 400] {
            view.target(divisor, &mut target);
            assert!((target.image.pixel(0, 0)[1] - 65_000.0 / 65_535.0).abs() < 1e-4, "{divisor}");
            assert!((target.prior.as_ref().unwrap().pixel(0, 0)[0] - 1.0).abs() < 1e-3, "{divisor}");
        }
    }

    #[test]
    fn unknown_prior_pixels_do_not_pull_a_mean_down() {
        let mut prior = Map::filled(4, 2, 2.0);
        prior.set_pixel(0, 0, [f32::NAN]);
        prior.set_pixel(1, 0, [-3.0]);
        prior.set_pixel(3, 0, [1.0]);
        let (view, dropped) =
            TrainingView::new(&view(4, 2), LoadedView { depth_prior: Some(prior), ..loaded(4, 2) }).unwrap();
        assert_eq!(dropped, None);
        let mut target = Target::default();
        view.target(2, &mut target);
        let prior = target.prior.unwrap();
        assert!((prior.pixel(0, 0)[0] - 1.0).abs() < 1e-3 && (prior.pixel(1, 0)[0] - 0.75).abs() < 1e-3);
    }

    #[test]
    fn pixels_that_do_not_count_are_in_no_mean() {
        let mut mask = Map::filled(4, 2, 1.0);
        // One pixel of the first box is hidden, and three of the second.
        for (x, y, v) in [(1, 0, 0.0), (0, 0, 0.5), (2, 0, 0.49), (3, 0, f32::NAN), (2, 1, 0.0)] {
            mask.set_pixel(x, y, [v]);
        }
        let masked = LoadedView { mask: Some(mask), ..loaded(4, 2) };
        let (view, _) = TrainingView::new(&view(4, 2), masked).unwrap();
        let full = view.pixels.to_image();
        let mut target = Target::default();
        view.target(2, &mut target);
        let mask = target.mask.as_ref().unwrap();
        assert_eq!((mask.pixel(0, 0), mask.pixel(1, 0)), ([1.0], [0.0]));
        for c in 0..3 {
            let mean = [(0, 0), (0, 1), (1, 1)].map(|(x, y)| full.pixel(x, y)[c]).iter().sum::<f32>() / 3.0;
            assert!((target.image.pixel(0, 0)[c] - mean).abs() < 1e-6);
            assert!((target.image.pixel(1, 0)[c] - full.pixel(3, 1)[c]).abs() < 1e-6);
        }
        view.target(1, &mut target);
        let counts = target.mask.as_ref().unwrap().data();
        assert_eq!(counts, [1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 1.0]);
    }

    #[test]
    fn what_does_not_fit_or_says_nothing_is_told() {
        let error = TrainingView::new(&view(4, 2), loaded(2, 4)).unwrap_err().to_string();
        for part in ["a.png", "image", "2x4", "4x2"] {
            assert!(error.contains(part), "{error}");
        }
        let with = |prior: Map| LoadedView { depth_prior: Some(prior), ..loaded(4, 2) };
        let dropped = |prior| TrainingView::new(&view(4, 2), with(prior)).unwrap().1;
        assert_eq!(dropped(Map::filled(4, 2, 0.7)), Some("is the same everywhere"));
        assert_eq!(dropped(Map::filled(4, 2, f32::NAN)), Some("has no finite positive pixel"));
        let error = TrainingView::new(&view(4, 2), with(Map::new(9, 9))).unwrap_err().to_string();
        assert!(error.contains("depth prior"), "{error}");
        let mut skewed = view(4, 2);
        skewed.camera.intrinsics.fx = f64::NAN;
        let error = TrainingView::new(&skewed, loaded(4, 2)).unwrap_err().to_string();
        assert!(error.contains("fx") && error.contains("a.png"), "{error}");
    }
}
