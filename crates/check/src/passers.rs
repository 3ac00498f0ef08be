//! Fish, divers and other things that move on their own: what stands before the scene in one view alone.
//!
//! A view `v` is compared with the views around it at the points `X` of the model that land in it, if it saw
//! them or not: a program finds no feature on a fish, and none behind it. `c_v` is the logarithm of the mean
//! colour of 3×3 pixels at `X`, in a picture of about 640 pixels, for each channel.
//!
//! * The *witnesses* of `X` are the views that saw it from nearly the same side: up to six with the smallest
//!   angles from the ray of `v`, of 15 degrees at most. At least three are needed, of which two are on
//!   opposite sides of `v`. `m` is the median of their `c`, and `s` the median of `|c − m|`.
//! * The *change* is `d = c_v − m`, less its median over the points of `v`: exposure and water are no change.
//!   With `σ`, the median of `|d|` over the points, `X` is *odd* if the mean of `d² / (σ² + s²)` over the
//!   channels is above the square of [`ODD`], in units of a standard deviation.
//! * A point is not compared if `v` saw a much nearer one beside it, because the scene itself may hide it.
//! * Something *passes* before an odd point if seven of the eight compared points nearest to it are odd. It
//!   counts itself, and the distances are those in the picture.
//!
//! In sound captures at most 2 % of the points are odd, and they lie alone: by chance, six of seven others
//! are odd once in 10⁹ points.

use glam::DVec3;
use rayon::prelude::*;
use use3d_capture::{Capture, Image8, Map, Track};
use use3d_numerics::math;

use use3d_numerics::order::median;

/// The largest angle between the rays of a view and a witness, radians.
const ANGLE: f64 = 0.26;
/// The fewest witnesses, and the most.
const WITNESSES: (usize, usize) = (3, 6);
/// The change of an odd point, standard deviations.
const ODD: f64 = 3.5;
/// The standard deviation of a normal distribution over its median of absolute values.
const NORMAL: f64 = 1.4826;
/// The number of nearest points that are looked at, and the least number of odd ones among them where
/// something passes.
const NEAREST: usize = 8;
const PASSED: usize = 7;
/// A point this many times as far as one that was seen beside it may be hidden.
const FARTHER: f32 = 1.15;
/// The side of the cells in which points lie beside each other, as a share of the picture's longer side.
const CELL: f64 = 0.015;
/// The fewest compared points of a view.
const ENOUGH: usize = 100;
/// Light that is added before logarithms are taken, display range: below it, grain outweighs colour.
const DIM: f64 = 0.03;
/// Sightings of the compared points in a view, at most on average.
const SIGHTINGS: usize = 2000;

/// A point where it lands in a view.
struct Landing {
    view: usize,
    /// Pixel in the small picture.
    at: [f32; 2],
    /// z-depth, units of the capture.
    depth: f32,
    /// The logarithms of its colour.
    colour: [f32; 3],
    /// True if the view saw it by its track.
    tracked: bool,
}

/// A point of a view beside its witnesses.
#[derive(Clone, Copy)]
struct Compared {
    at: [f32; 2],
    change: [f64; 3],
    spread: [f64; 3],
}

/// The smallest depth that a view saw in each cell and the cells around it.
struct Front {
    cell: f64,
    columns: usize,
    depths: Vec<f32>,
}

/// Collects the colours of points from all views, and compares them.
pub(crate) struct Passers<'a> {
    capture: &'a Capture,
    tracks: &'a [Track],
    /// Every how manieth track is compared.
    step: usize,
    /// The landings of each of these tracks.
    landings: Vec<Vec<Landing>>,
    /// The front of each view; `None` before its picture was there.
    fronts: Vec<Option<Front>>,
}

impl<'a> Passers<'a> {
    pub(crate) fn new(capture: &'a Capture, tracks: &'a [Track]) -> Self {
        let sightings: usize = tracks.iter().map(|track| track.sightings.len()).sum();
        let step = sightings.div_ceil(SIGHTINGS * capture.views.len().max(1)).max(1);
        let landings = tracks.iter().step_by(step).map(|_| Vec::new()).collect();
        let fronts = capture.views.iter().map(|_| None).collect();
        Self { capture, tracks, step, landings, fronts }
    }

    /// Adds a view: its small picture, and its mask at the size of its camera.
    pub(crate) fn add(&mut self, view: usize, small: &Image8, mask: Option<&Map>) {
        let camera = &self.capture.views[view].camera;
        let (w, h) = (small.width(), small.height());
        let lens = &camera.intrinsics;
        let scale = [w as f64 / lens.width as f64, h as f64 / lens.height as f64];
        let logs: Vec<f32> = (0..256).map(|v| math::ln(f64::from(v) / 255.0 + DIM) as f32).collect();
        let mut front = Front::new(w, h);
        for (track, landings) in self.tracks.iter().step_by(self.step).zip(&mut self.landings) {
            let Some((at, depth)) = camera.project(track.position) else { continue };
            let (x, y) = (at.x * scale[0], at.y * scale[1]);
            if !(x >= 1.0 && y >= 1.0 && x < w as f64 - 1.0 && y < h as f64 - 1.0) {
                continue;
            }
            if mask.is_some_and(|mask| mask.pixel(at.x as usize, at.y as usize)[0] < 0.5) {
                continue;
            }
            let mut colour = [0.0; 3];
            for row in y as usize - 1..y as usize + 2 {
                for column in x as usize - 1..x as usize + 2 {
                    let pixel = small.pixel(column, row);
                    (0..3).for_each(|c| colour[c] += logs[usize::from(pixel[c])] / 9.0);
                }
            }
            let tracked = track.sightings.iter().any(|sighting| sighting.view == view);
            let (at, depth) = ([x as f32, y as f32], depth as f32);
            if tracked {
                front.see(at, depth);
            }
            landings.push(Landing { view, at, depth, colour, tracked });
        }
        self.fronts[view] = Some(front);
    }

    /// The number of points of each view before which something passes; `None` with too few points.
    pub(crate) fn passed(&self) -> Vec<Option<usize>> {
        let views = self.capture.views.len();
        let centres: Vec<DVec3> = self.capture.views.iter().map(|v| v.camera.pose.center()).collect();
        let tracks: Vec<&Track> = self.tracks.iter().step_by(self.step).collect();
        let compared: Vec<(usize, Compared)> = self
            .landings
            .par_iter()
            .zip(tracks)
            .flat_map_iter(|(landings, track)| self.compared(landings, track.position, &centres))
            .collect();
        let mut of_view: Vec<Vec<Compared>> = vec![Vec::new(); views];
        compared.into_iter().for_each(|(view, compared)| of_view[view].push(compared));
        of_view.par_iter().map(|all| (all.len() >= ENOUGH).then(|| passed(all))).collect()
    }

    /// A point in each view that has enough witnesses of it.
    fn compared(&self, landings: &[Landing], at: DVec3, centres: &[DVec3]) -> Vec<(usize, Compared)> {
        let rays: Vec<DVec3> = landings.iter().map(|l| (centres[l.view] - at).normalize_or_zero()).collect();
        let mut found = Vec::new();
        let mut near: Vec<(f64, usize)> = Vec::with_capacity(landings.len());
        for (own, ray) in landings.iter().zip(&rays) {
            if self.fronts[own.view].as_ref().is_some_and(|front| front.hides(own)) {
                continue;
            }
            near.clear();
            for (i, other) in landings.iter().enumerate() {
                let apart = rays[i].distance_squared(*ray);
                if other.tracked && other.view != own.view && apart < ANGLE * ANGLE {
                    near.push((apart, i));
                }
            }
            near.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
            near.truncate(WITNESSES.1);
            let side = |k: usize| rays[near[k].1] - *ray;
            let opposite = |k: usize| (0..k).any(|l| side(k).dot(side(l)) < 0.0);
            if near.len() < WITNESSES.0 || !(1..near.len()).any(opposite) {
                continue;
            }
            let (mut change, mut spread) = ([0.0; 3], [0.0; 3]);
            for c in 0..3 {
                let all = near.iter().map(|(_, i)| f64::from(landings[*i].colour[c]));
                let usual = median(all.clone()).unwrap_or(0.0);
                change[c] = f64::from(own.colour[c]) - usual;
                spread[c] = median(all.map(|v| (v - usual).abs())).unwrap_or(0.0);
            }
            found.push((own.view, Compared { at: own.at, change, spread }));
        }
        found
    }
}

impl Front {
    fn new(width: usize, height: usize) -> Self {
        let cell = (CELL * width.max(height) as f64).max(1.0);
        let [columns, rows] = [width, height].map(|side| (side as f64 / cell) as usize + 3);
        Self { cell, columns, depths: vec![f32::INFINITY; columns * rows] }
    }

    /// The cell of a pixel. There is one more cell on each side of the picture.
    fn place(&self, at: [f32; 2]) -> usize {
        let [x, y] = at.map(|v| (f64::from(v) / self.cell) as usize + 1);
        y * self.columns + x
    }

    fn see(&mut self, at: [f32; 2], depth: f32) {
        let place = self.place(at);
        for row in [place - self.columns, place, place + self.columns] {
            self.depths[row - 1..row + 2].iter_mut().for_each(|least| *least = least.min(depth));
        }
    }

    /// True if the scene itself may hide a point.
    fn hides(&self, landing: &Landing) -> bool {
        landing.depth > FARTHER * self.depths[self.place(landing.at)]
    }
}

/// The number of points of a view before which something passes.
fn passed(all: &[Compared]) -> usize {
    let usual = [0, 1, 2].map(|c| median(all.iter().map(|p| p.change[c])).unwrap_or(0.0));
    let off = |c: usize| all.iter().map(move |p| (p.change[c] - usual[c]).abs());
    let sigma = [0, 1, 2].map(|c| median(off(c)).unwrap_or(0.0));
    let is_odd = |p: &&Compared| {
        let square = |c: usize| {
            let d = p.change[c] - usual[c];
            d * d / (sigma[c] * sigma[c] + p.spread[c] * p.spread[c]).max(f64::MIN_POSITIVE)
        };
        (square(0) + square(1) + square(2)) / 3.0 > ODD * ODD * NORMAL * NORMAL
    };
    let (odd, even): (Vec<&Compared>, Vec<&Compared>) = all.iter().partition(is_odd);
    let apart = |a: &Compared, b: &Compared| {
        let [x, y] = [a.at[0] - b.at[0], a.at[1] - b.at[1]];
        x * x + y * y
    };
    let is_passed = |p: &&&Compared| {
        let mut others: Vec<f32> = odd.iter().map(|other| apart(p, other)).collect();
        others.sort_unstable_by(f32::total_cmp);
        // Seven of the eight nearest are odd if at most one that is not odd lies nearer than the seventh.
        let Some(reach) = others.get(PASSED - 1) else { return false };
        even.iter().filter(|other| apart(p, other) < *reach).nth(NEAREST - PASSED).is_none()
    };
    odd.iter().filter(is_passed).count()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DMat3;
    use use3d_capture::{Camera, FileName, Frame, Intrinsics, Pose, Sighting, Split, View};

    const VIEWS: usize = 9;
    const W: usize = 96;
    const H: usize = 64;
    /// The distances of the wall, and of the rod before it.
    const WALL: f64 = 4.0;
    const ROD: f64 = 1.5;

    /// A wall, and cameras that pass it sideways.
    struct Wall {
        capture: Capture,
        tracks: Vec<Track>,
        pictures: Vec<Image8>,
    }

    /// The brightness of the wall, with an uneven share for each view and pixel.
    fn wall(at: [f64; 2], grain: usize) -> f64 {
        let grain = (grain.wrapping_mul(2_654_435_761) >> 7) % 9;
        90.0 + 30.0 * math::sin(5.0 * at[0]) * math::sin(4.0 * at[1] + 1.0) + grain as f64
    }

    impl Wall {
        fn new() -> Self {
            let intrinsics = Intrinsics {
                width: W,
                height: H,
                fx: 80.0,
                fy: 80.0,
                cx: W as f64 / 2.0,
                cy: H as f64 / 2.0,
            };
            let view = |i: usize| {
                let pose = Pose::from_center(DMat3::IDENTITY, DVec3::new(0.15 * i as f64, 0.0, 0.0));
                let name = FileName::new(&format!("v_{i}.png")).unwrap();
                let camera = Camera { intrinsics, pose };
                View { name, id: i as u32, image: "none".into(), mask: None, depth_prior: None, camera }
            };
            let views: Vec<View> = (0..VIEWS).map(view).collect();
            let picture = |view: &View| {
                let mut picture = Image8::new(W, H);
                for (x, y) in (0..W * H).map(|i| (i % W, i / W)) {
                    let at =
                        WALL * view.camera.ray(x as f64 + 0.5, y as f64 + 0.5) + view.camera.pose.center();
                    let grain = (view.id as usize * H + y) * W + x;
                    picture.set_pixel(x, y, [wall([at.x, at.y], grain) as u8; 3]);
                }
                picture
            };
            let pictures = views.iter().map(picture).collect();
            let point = |i: usize| {
                let position = DVec3::new(-2.4 + 0.1 * (i % 60) as f64, -1.6 + 0.1 * (i / 60) as f64, WALL);
                let sightings = views.iter().enumerate().filter_map(|(view, v)| {
                    let at = v.camera.project(position)?.0;
                    let inside = (0.0..W as f64).contains(&at.x) && (0.0..H as f64).contains(&at.y);
                    inside.then_some(Sighting { view, x: at.x, y: at.y })
                });
                Track { position, sightings: sightings.collect() }
            };
            let tracks = (0..60 * 32).map(point).collect();
            let (split, points) = (Split::every(VIEWS, 8), Vec::new());
            let capture = Capture { name: "wall".into(), views, split, points, frame: Frame::IDENTITY };
            Self { capture, tracks, pictures }
        }

        /// Paints a disc into a view, on which the view saw no point.
        fn disc(&mut self, view: usize, centre: [f64; 2], radius: f64, value: u8) {
            let inside = |x: f64, y: f64| math::hypot(x - centre[0], y - centre[1]) < radius;
            for (x, y) in (0..W * H).map(|i| (i % W, i / W)) {
                if inside(x as f64 + 0.5, y as f64 + 0.5) {
                    self.pictures[view].set_pixel(x, y, [value; 3]);
                }
            }
            let sightings = self.tracks.iter_mut().map(|track| &mut track.sightings);
            sightings.for_each(|all| all.retain(|s| s.view != view || !inside(s.x, s.y)));
        }

        fn passed(&self, mask: Option<&Map>) -> Vec<Option<usize>> {
            let mut passers = Passers::new(&self.capture, &self.tracks);
            for (view, picture) in self.pictures.iter().enumerate() {
                passers.add(view, picture, mask);
            }
            passers.passed()
        }
    }

    /// The result if something passes before so many points of the fifth view. The outermost views have no
    /// witnesses on both sides.
    fn only_fifth(points: usize) -> Vec<Option<usize>> {
        let of = |view: usize| match view {
            0 | 8 => None,
            4 => Some(points),
            _ => Some(0),
        };
        (0..VIEWS).map(of).collect()
    }

    #[test]
    fn what_stands_before_the_wall_in_one_view_is_found_and_what_a_mask_hides_is_not() {
        let mut wall = Wall::new();
        assert_eq!(wall.passed(None), only_fifth(0));
        // Another exposure moves nothing.
        wall.pictures[2] = wall.pictures[2].map(|v| (1.4 * f64::from(v)) as u8);
        assert_eq!(wall.passed(None), only_fifth(0));
        wall.disc(4, [50.0, 30.0], 8.0, 170);
        // Points lie every two pixels: about 50 on the disc.
        let found = wall.passed(None);
        let points = found[4].unwrap();
        assert!((45..60).contains(&points) && found == only_fifth(points), "{found:?}");
        let mut mask = Map::filled(W, H, 1.0);
        for (x, y) in (0..W * H).map(|i| (i % W, i / W)) {
            let on_disc = math::hypot(x as f64 - 49.5, y as f64 - 29.5) < 9.0;
            mask.set_pixel(x, y, [f32::from(u8::from(!on_disc))]);
        }
        assert_eq!(wall.passed(Some(&mask)), only_fifth(0));
        // Nothing stands on less than seven points.
        let mut wall = Wall::new();
        wall.disc(4, [50.0, 30.0], 1.3, 170);
        assert_eq!(wall.passed(None), only_fifth(0));
    }

    #[test]
    fn a_rod_of_the_scene_hides_points_and_does_not_pass() {
        let (mut bare, mut seen) = (Wall::new(), Wall::new());
        let rod = |view: usize| 48.0 + 80.0 * (0.6 - 0.15 * view as f64) / ROD;
        for (view, y) in (0..VIEWS).flat_map(|view| (4..14).map(move |i| (view, 4.0 * f64::from(i)))) {
            bare.disc(view, [rod(view), y], 3.0, 170);
            seen.disc(view, [rod(view), y], 3.0, 170);
        }
        let passes = |wall: &Wall| wall.passed(None).iter().flatten().filter(|points| **points > 0).count();
        assert!(passes(&bare) >= 5, "{:?}", bare.passed(None));
        for (across, y) in
            [-2.0, 0.0, 2.0].iter().flat_map(|x| (7..28).map(move |i| (*x, 2.0 * f64::from(i))))
        {
            let position = DVec3::new(0.6 + across * ROD / 80.0, (y - 32.0) * ROD / 80.0, ROD);
            let sighting = |view: usize| Sighting { view, x: rod(view) + across, y };
            seen.tracks.push(Track { position, sightings: (0..VIEWS).map(sighting).collect() });
        }
        assert_eq!(passes(&seen), 0, "{:?}", seen.passed(None));
    }

    #[test]
    fn seven_odd_points_of_eight_beside_each_other_are_passed() {
        // Changes of −1, 0 and 1 give a median of 1, of which 3.5 standard deviations are 5.19.
        let point = |i: usize| {
            let at = [(i % 20) as f32, (i / 20) as f32];
            let change = [(i % 3) as f64 - 1.0; 3];
            Compared { at, change, spread: [0.0; 3] }
        };
        let with = |odd: &[usize], change: [f64; 3], spread: f64| {
            let mut all: Vec<Compared> = (0..200).map(point).collect();
            odd.iter().for_each(|i| (all[*i].change, all[*i].spread) = (change, [spread; 3]));
            passed(&all)
        };
        let corner = [0, 1, 2, 20, 21, 22, 40, 41];
        assert_eq!(with(&corner, [5.2; 3], 0.0), 4);
        assert_eq!(with(&corner, [5.1; 3], 0.0), 0);
        assert_eq!(with(&corner, [0.0, -9.1, 0.0], 0.0), 4);
        assert_eq!(with(&corner, [0.0, -8.9, 0.0], 0.0), 0);
        // Witnesses that differ among themselves say less.
        assert_eq!(with(&corner, [7.3; 3], 1.0), 0);
        assert_eq!(with(&corner, [7.4; 3], 1.0), 4);
        assert_eq!(with(&corner[..6], [9.0; 3], 0.0), 0);
        assert_eq!(with(&corner[..7], [9.0; 3], 0.0), 2);
    }
}
