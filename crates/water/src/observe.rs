//! Turns tracks and images into observations: the colour of each point in each view, its distance and
//! direction, and open water.

use glam::DVec3;
use rayon::prelude::*;
use use3d_capture::{Camera, Image, Map, Raster, Track};
use use3d_numerics::order::median;

use crate::open::{ObservedPoint, OpenWater, open_water};
use crate::patch::{NARROWEST, Patch, WIDEST, patch};

/// One view's observation of one point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observation {
    /// Index of the point's track.
    pub point: usize,
    /// Index of the view.
    pub view: usize,
    /// Distance from the camera centre to the point, scene units.
    pub distance: f64,
    /// Unit direction from the camera centre to the point, world frame.
    pub direction: DVec3,
    /// Mean of the surface piece around the point, R, G, B, display range; NaN where the camera clipped the
    /// channel.
    pub value: [f64; 3],
    /// The unevenness of the surface piece in this view: standard deviation per channel, display range.
    pub spread: [f64; 3],
}

/// All observations of water in a capture's views.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Sights {
    /// Observations of points, ordered by point, then view.
    pub points: Vec<Observation>,
    /// Cells that show nothing but water, ordered by view.
    pub open: Vec<OpenWater>,
}

/// An error in tracks and cameras.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ObserveError {
    /// A sighting names a view that does not exist.
    #[error(
        "track {track} was seen by view {view}, but there are {views} cameras; tracks and cameras must be of the same capture"
    )]
    View {
        /// Index of the track.
        track: usize,
        /// The named view.
        view: usize,
        /// Number of cameras.
        views: usize,
    },
    /// An image has another size than its camera.
    #[error("the image of view {view} is {}x{}, but its camera is {}x{}; prepare the capture first", found.0, found.1, expected.0, expected.1)]
    Size {
        /// Index of the view.
        view: usize,
        /// The image's size.
        found: (usize, usize),
        /// The camera's size.
        expected: (usize, usize),
    },
}

/// A sighting to be looked up in its view.
struct PatchQuery {
    point: usize,
    x: f64,
    y: f64,
    sigma: f64,
    distance: f64,
    direction: DVec3,
}

/// Looks every track up in the views, in the images at their own size and at half of it. The difference
/// between the two shows the effect of sharpness, compression and keypoints on an estimate, which is not
/// water.
///
/// `load` returns a view's image and mask (1 counts), or `None` to leave the view out. It is called once per
/// view, in order, so that one image is in memory at a time.
///
/// Points seen by fewer than two views, sightings behind a camera, and second sightings by the same view
/// are left out.
///
/// # Errors
/// The errors of `load`, and [`ObserveError`] if tracks, cameras and images do not belong together.
pub fn observe_sizes<E: From<ObserveError>>(
    cameras: &[Camera],
    tracks: &[Track],
    mut load: impl FnMut(usize) -> Result<Option<(Image, Option<Map>)>, E>,
) -> Result<[Sights; 2], E> {
    let mut whole = Lookup::new(cameras, tracks)?;
    let smaller: Vec<Camera> = cameras.iter().map(|camera| camera.downscaled(2)).collect();
    let moved = halved_tracks(tracks);
    let mut half = Lookup::new(&smaller, &moved)?;
    for view in 0..cameras.len() {
        if let Some((image, mask)) = load(view)? {
            whole.view(view, &image, mask.as_ref())?;
            let (image, mask) = halved_view(&image, mask.as_ref());
            half.view(view, &image, mask.as_ref())?;
        }
    }
    Ok([whole.done(), half.done()])
}

fn halved_tracks(tracks: &[Track]) -> Vec<Track> {
    let mut moved = tracks.to_vec();
    for s in moved.iter_mut().flat_map(|track| &mut track.sightings) {
        (s.x, s.y) = (0.5 * s.x, 0.5 * s.y);
    }
    moved
}

/// A view at half of its size. It has no type parameters, so that its loops are compiled here: a caller may
/// be a crate that is not optimised.
fn halved_view(image: &Image, mask: Option<&Map>) -> (Image, Option<Map>) {
    (halved(image), mask.map(halved))
}

/// The means of 2×2 pixels; an odd last row or column is left out.
fn halved<const C: usize>(image: &Raster<f32, C>) -> Raster<f32, C> {
    let (w, h) = ((image.width() / 2).max(1), (image.height() / 2).max(1));
    let (right, down) = (image.width().min(2) - 1, image.height().min(2) - 1);
    let mut out = Raster::new(w, h);
    for y in 0..h {
        for x in 0..w {
            let at = |i: usize, j: usize| image.pixel(2 * x + i, 2 * y + j);
            let four = [at(0, 0), at(right, 0), at(0, down), at(right, down)];
            out.set_pixel(x, y, std::array::from_fn(|c| 0.25 * four.iter().map(|p| p[c]).sum::<f32>()));
        }
    }
    out
}

/// Tracks to be looked up view by view.
struct Lookup<'a> {
    cameras: &'a [Camera],
    wanted: Vec<Vec<PatchQuery>>,
    seen: Vec<Vec<ObservedPoint>>,
    /// The median distance of all sightings.
    middle: f64,
    found: Sights,
}

impl<'a> Lookup<'a> {
    fn new(cameras: &'a [Camera], tracks: &[Track]) -> Result<Self, ObserveError> {
        let mut wanted: Vec<Vec<PatchQuery>> = cameras.iter().map(|_| Vec::new()).collect();
        for (point, track) in tracks.iter().enumerate() {
            plan(cameras, point, track, &mut wanted)?;
        }
        let (seen, middle) = sightings(cameras, tracks);
        Ok(Self { cameras, wanted, seen, middle, found: Sights::default() })
    }

    fn view(&mut self, view: usize, image: &Image, mask: Option<&Map>) -> Result<(), ObserveError> {
        let k = &self.cameras[view].intrinsics;
        let (size, expected) = ((image.width(), image.height()), (k.width, k.height));
        if size != expected {
            return Err(ObserveError::Size { view, found: size, expected });
        }
        let mask = mask.filter(|m| (m.width(), m.height()) == expected);
        let looked: Vec<Option<Observation>> = self.wanted[view]
            .par_iter()
            .map(|w| {
                let Patch { mean: value, spread } = patch(image, mask, w.x, w.y, w.sigma)?;
                let PatchQuery { point, distance, direction, .. } = *w;
                Some(Observation { point, view, distance, direction, value, spread })
            })
            .collect();
        self.found.points.extend(looked.into_iter().flatten());
        let camera = &self.cameras[view];
        self.found.open.extend(open_water(view, camera, image, mask, &self.seen[view], self.middle));
        Ok(())
    }

    fn done(mut self) -> Sights {
        self.found.points.sort_by_key(|o| (o.point, o.view));
        self.found
    }
}

/// The pixel positions and distances at which each view saw points, and the median distance of all
/// sightings.
fn sightings(cameras: &[Camera], tracks: &[Track]) -> (Vec<Vec<ObservedPoint>>, f64) {
    let mut seen: Vec<Vec<ObservedPoint>> = cameras.iter().map(|_| Vec::new()).collect();
    let mut distances = Vec::new();
    for track in tracks {
        for s in &track.sightings {
            let Some(camera) = cameras.get(s.view) else { continue };
            let distance = (track.position - camera.pose.center()).length();
            if distance.is_finite() && s.x.is_finite() && s.y.is_finite() {
                seen[s.view].push(ObservedPoint { x: s.x, y: s.y, distance });
                distances.push(distance);
            }
        }
    }
    (seen, median(distances).unwrap_or(f64::INFINITY))
}

/// Adds a track's sightings to `wanted`, with windows that all cover the same piece of surface.
fn plan(
    cameras: &[Camera],
    point: usize,
    track: &Track,
    wanted: &mut [Vec<PatchQuery>],
) -> Result<(), ObserveError> {
    let mut seen: Vec<(usize, PatchQuery, f64)> = Vec::with_capacity(track.sightings.len());
    for s in &track.sightings {
        let camera = cameras.get(s.view).ok_or(ObserveError::View {
            track: point,
            view: s.view,
            views: cameras.len(),
        })?;
        let way = track.position - camera.pose.center();
        let (distance, k) = (way.length(), &camera.intrinsics);
        let depth = (camera.pose.rotation * way).z;
        let scale = (k.fx * k.fy).sqrt() / depth;
        let usable = depth > 0.0 && scale.is_finite() && distance.is_finite() && s.x.is_finite();
        if usable && !seen.iter().any(|(view, ..)| *view == s.view) {
            let direction = way / distance;
            seen.push((s.view, PatchQuery { point, x: s.x, y: s.y, sigma: 0.0, distance, direction }, scale));
        }
    }
    let smallest = seen.iter().fold(f64::INFINITY, |m, (.., scale)| m.min(*scale));
    if seen.len() < 2 {
        return Ok(());
    }
    for (view, mut one, scale) in seen {
        one.sigma = NARROWEST * scale / smallest;
        if one.sigma <= WIDEST {
            wanted[view].push(one);
        }
    }
    Ok(())
}
