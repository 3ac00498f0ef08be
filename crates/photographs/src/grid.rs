//! The small grid of a photograph: its pixels as the file has them, through its lens, scaled down.
//!
//! The scene is drawn by a pinhole that covers the whole field of the lens, and its smooth pictures are read
//! there for each pixel of the grid (bilinear). So only factors are resampled, never the photograph. A ray
//! further than [`WIDEST`] from the axis is not drawn; such pixels take the nearest drawn ones and count as
//! unknown. Rays are computed at every fourth pixel and read between these, which errs by less than 0.05
//! pixels for the lenses of underwater cameras.

use use3d_capture::{Camera, Intrinsics, Map, Pose, Raster};
use use3d_numerics::math;
use use3d_survey::Lens;

/// Largest slope of a ray that is drawn: 80 degrees from the axis.
const WIDEST: f64 = 5.67;
/// Largest side of the drawn picture over that of the grid.
const LARGEST: f64 = 2.5;
/// Pixels between computed rays.
const STEP: usize = 4;

/// The small grid of a photograph.
#[derive(Clone, Debug)]
pub struct Grid {
    size: (usize, usize),
    /// The pinhole that draws the scene for it.
    pub camera: Camera,
    /// The position in the drawn picture for each pixel of the grid; `None` if both are the same.
    table: Option<Vec<[f32; 2]>>,
    /// 1 where the pixel's ray is drawn, else 0.
    field: Option<Map>,
}

/// The size of the small grid of a picture: its longer side has at most `side` pixels.
pub fn small_size((width, height): (usize, usize), side: usize) -> (usize, usize) {
    let longer = width.max(height);
    if longer <= side {
        return (width, height);
    }
    let scale = side as f64 / longer as f64;
    let of = |n: usize| ((n as f64 * scale).round() as usize).max(1);
    (of(width), of(height))
}

impl Grid {
    /// The grid of a pinhole camera at its own size.
    pub fn pinhole(camera: Camera) -> Self {
        let size = (camera.intrinsics.width, camera.intrinsics.height);
        Self { size, camera, table: None, field: None }
    }

    /// The grid for files of a pinhole, with at most `side` pixels along its longer side.
    pub fn straight(file: &Intrinsics, pose: Pose, side: usize) -> Self {
        let (w, h) = small_size((file.width, file.height), side);
        let (sx, sy) = (w as f64 / file.width as f64, h as f64 / file.height as f64);
        Self::pinhole(Camera { intrinsics: file.scaled(sx, sy, w, h), pose })
    }

    /// The grid for files of `file` pixels taken through `lens` (in pixels of the file), with at most `side`
    /// pixels along its longer side. `None` if no ray of the lens lies in front of the camera.
    pub fn new(lens: &Lens, file: (usize, usize), pose: Pose, side: usize) -> Option<Self> {
        let size = small_size(file, side);
        let lens = lens.scaled(size.0 as f64 / file.0 as f64, size.1 as f64 / file.1 as f64);
        if lens.is_pinhole() {
            let intrinsics = lens.intrinsics(size.0, size.1);
            return Some(Self::pinhole(Camera { intrinsics, pose }));
        }
        let knots = |n: usize| n.div_ceil(STEP) + 2;
        let (columns, rows) = (knots(size.0), knots(size.1));
        let at = |i: usize| (i * STEP) as f64 + 0.5;
        let ray = |x: f64, y: f64| lens.unproject(x, y).filter(|(u, v)| math::hypot(*u, *v) <= WIDEST);
        let rays: Vec<Option<(f64, f64)>> =
            (0..columns * rows).map(|k| ray(at(k % columns), at(k / columns))).collect();
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for (u, v) in rays.iter().flatten() {
            for (axis, value) in [*u, *v].into_iter().enumerate() {
                (low[axis], high[axis]) = (low[axis].min(value), high[axis].max(value));
            }
        }
        if !low[0].is_finite() {
            return None;
        }
        let sides = [size.0 as f64, size.1 as f64];
        let focal: [f64; 2] = std::array::from_fn(|axis| {
            lens.focal[axis].min(LARGEST * sides[axis] / (high[axis] - low[axis]).max(1e-9))
        });
        let pixels: [usize; 2] =
            std::array::from_fn(|axis| ((high[axis] - low[axis]) * focal[axis]).ceil() as usize + 2);
        let principal: [f64; 2] = std::array::from_fn(|axis| 1.0 - low[axis] * focal[axis]);
        let intrinsics = Intrinsics {
            width: pixels[0],
            height: pixels[1],
            fx: focal[0],
            fy: focal[1],
            cx: principal[0],
            cy: principal[1],
        };
        let drawn = |(u, v): (f64, f64)| (u * focal[0] + principal[0], v * focal[1] + principal[1]);
        let mut table = vec![[0.0f32; 2]; size.0 * size.1];
        let mut field = Map::filled(size.0, size.1, 1.0);
        for y in 0..size.1 {
            for x in 0..size.0 {
                let (i, j) = (x / STEP, y / STEP);
                let (fx, fy) = ((x % STEP) as f64 / STEP as f64, (y % STEP) as f64 / STEP as f64);
                let corner = |di: usize, dj: usize| rays[(j + dj) * columns + i + di];
                let place = match (corner(0, 0), corner(1, 0), corner(0, 1), corner(1, 1)) {
                    (Some(a), Some(b), Some(c), Some(d)) => {
                        let mix = |a: f64, b: f64, c: f64, d: f64| {
                            (1.0 - fy) * ((1.0 - fx) * a + fx * b) + fy * ((1.0 - fx) * c + fx * d)
                        };
                        Some((mix(a.0, b.0, c.0, d.0), mix(a.1, b.1, c.1, d.1)))
                    }
                    _ => ray(x as f64 + 0.5, y as f64 + 0.5),
                };
                let (px, py) = place.map_or((f64::NAN, f64::NAN), drawn);
                table[y * size.0 + x] = [px as f32, py as f32];
                if place.is_none() {
                    field.set_pixel(x, y, [0.0]);
                }
            }
        }
        let whole = field.data().iter().all(|v| *v == 1.0);
        let camera = Camera { intrinsics, pose };
        Some(Self { size, camera, table: Some(table), field: (!whole).then_some(field) })
    }

    /// The same grid from another place.
    #[must_use]
    pub fn at(&self, pose: Pose) -> Self {
        let camera = Camera { pose, ..self.camera };
        Self { camera, ..self.clone() }
    }

    /// Width and height of the grid, pixels.
    pub fn size(&self) -> (usize, usize) {
        self.size
    }

    /// 1 where a pixel's ray is drawn, 0 elsewhere; `None` if all are.
    pub fn field(&self) -> Option<&Map> {
        self.field.as_ref()
    }

    /// The pixels of the grid from a picture of its camera, which may be smaller than the camera's own.
    pub fn read<const C: usize>(&self, drawn: &Raster<f32, C>) -> Raster<f32, C> {
        let (w, h) = (drawn.width(), drawn.height());
        let k = &self.camera.intrinsics;
        if self.table.is_none() && (w, h) == self.size {
            return drawn.clone();
        }
        let mut out = Raster::<f32, C>::new(self.size.0, self.size.1);
        if w == 0 || h == 0 || out.pixels() == 0 {
            return out;
        }
        let (across, down) = (w as f32 / k.width as f32, h as f32 / k.height as f32);
        let along = |at: f32, side: usize| {
            let at = if at.is_nan() { 0.0 } else { (at - 0.5).clamp(0.0, (side - 1) as f32) };
            let first = at as usize;
            (first, (first + 1).min(side - 1), at - first as f32)
        };
        let n = out.pixels();
        let place = |i: usize| match &self.table {
            Some(table) => table[i],
            None => [(i % self.size.0) as f32 + 0.5, (i / self.size.0) as f32 + 0.5],
        };
        for i in 0..n {
            let [x, y] = place(i);
            let ((x0, x1, fx), (y0, y1, fy)) = (along(x * across, w), along(y * down, h));
            for (plane, out) in drawn.planes().into_iter().zip(out.data_mut().chunks_exact_mut(n)) {
                let at = |x: usize, y: usize| plane[y * w + x];
                let top = at(x0, y0) + fx * (at(x1, y0) - at(x0, y0));
                let bottom = at(x0, y1) + fx * (at(x1, y1) - at(x0, y1));
                out[i] = top + fy * (bottom - top);
            }
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use use3d_survey::{Distortion, Projection};

    use super::*;

    fn lenses() -> [Lens; 3] {
        let bent =
            |numerator: [f64; 6], tangential| Distortion { numerator, tangential, ..Distortion::default() };
        let plain = Lens::pinhole([1240.0, 1245.0], [955.0, 548.0]);
        let port = bent([0.36, 0.25, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0]);
        let barrel = bent([-0.2, 0.05, 0.0, 0.0, 0.0, 0.0], [0.002, -0.001]);
        let fisheye =
            Lens { projection: Projection::Equidistant, ..Lens::pinhole([900.0, 900.0], [960.0, 540.0]) };
        [Lens { distortion: port, ..plain }, Lens { distortion: barrel, ..plain }, fisheye]
    }

    #[test]
    fn a_pixel_of_the_grid_sees_along_its_own_ray() {
        for lens in lenses() {
            let grid = Grid::new(&lens, (1920, 1080), Pose::IDENTITY, 640).expect("a field");
            assert_eq!(grid.size(), (640, 360));
            let k = grid.camera.intrinsics;
            assert!(k.width <= 1700 && k.height <= 1000, "{k:?}");
            // A picture of the slopes of its rays, which is linear, so reading it is exact.
            let mut slopes = Raster::<f32, 2>::new(k.width, k.height);
            for y in 0..k.height {
                for x in 0..k.width {
                    let ray = grid.camera.ray(x as f64 + 0.5, y as f64 + 0.5);
                    slopes.set_pixel(x, y, [ray.x as f32, ray.y as f32]);
                }
            }
            let seen = grid.read(&slopes);
            let mut worst = 0.0f64;
            for y in (0..360).step_by(7) {
                for x in (0..640).step_by(7) {
                    let [u, v] = seen.pixel(x, y).map(f64::from);
                    let (px, py) = lens.project(u, v);
                    let (ex, ey) = (3.0 * (x as f64 + 0.5), 3.0 * (y as f64 + 0.5));
                    if grid.field().is_none_or(|field| field.pixel(x, y) == [1.0]) {
                        worst = worst.max(math::hypot(px - ex, py - ey) / 3.0);
                    }
                }
            }
            assert!(worst < 0.05, "{worst}");
        }
    }

    #[test]
    fn a_pinhole_is_read_as_it_is() {
        let lens = Lens::pinhole([500.0, 500.0], [320.0, 240.0]);
        let grid = Grid::new(&lens, (640, 480), Pose::IDENTITY, 320).expect("a field");
        assert_eq!((grid.camera.intrinsics.width, grid.camera.intrinsics.fx), (320, 250.0));
        let map = Map::from_planes(320, 240, (0..320 * 240).map(|i| i as f32).collect()).expect("a map");
        assert_eq!(grid.read(&map), map);
        // A picture at half the size is read between its pixels.
        let slope = |w: usize, h: usize| (0..w * h).map(|i| ((i % w) as f32 + 0.5) / w as f32).collect();
        let (full, half) =
            (Map::from_planes(320, 240, slope(320, 240)), Map::from_planes(160, 120, slope(160, 120)));
        let (full, read) = (full.expect("a map"), grid.read(&half.expect("a map")));
        for x in 1..319 {
            assert!((read.pixel(x, 100)[0] - full.pixel(x, 100)[0]).abs() < 1e-6);
        }
    }

    #[test]
    fn rays_beyond_the_field_are_marked() {
        let lens =
            Lens { projection: Projection::Equidistant, ..Lens::pinhole([200.0, 200.0], [320.0, 240.0]) };
        let grid = Grid::new(&lens, (640, 480), Pose::IDENTITY, 640).expect("a field");
        let field = grid.field().expect("a part of it");
        assert_eq!((field.pixel(320, 240), field.pixel(2, 2)), ([1.0], [0.0]));
        let (w, h) = (grid.camera.intrinsics.width, grid.camera.intrinsics.height);
        assert!(grid.read(&Map::filled(w, h, 0.5)).data().iter().all(|v| *v == 0.5));
    }
}
