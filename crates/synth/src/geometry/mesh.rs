//! Triangle meshes and the few builders that every object of the scene is made of: displaced spheres, swept
//! tubes, beams.

use glam::{Vec2, Vec3};
use use3d_numerics::math;

/// Triangles with smooth normals, two texture parameters per vertex, and a surface (material) per triangle.
#[derive(Clone, Debug, Default)]
pub(crate) struct Mesh {
    /// Vertex positions, metres.
    pub(crate) positions: Vec<Vec3>,
    /// Unit vertex normals, outwards.
    pub(crate) normals: Vec<Vec3>,
    /// Two numbers per vertex; their meaning depends on the surface (e.g. the distance along a branch).
    pub(crate) parameters: Vec<Vec2>,
    /// Vertex indices.
    pub(crate) triangles: Vec<[u32; 3]>,
    /// Surface index of each triangle.
    pub(crate) surfaces: Vec<u16>,
}

/// One ring of a swept surface.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Ring {
    pub(crate) center: Vec3,
    /// The plane of the ring.
    pub(crate) axes: [Vec3; 2],
    pub(crate) radius: f32,
    /// Second texture parameter (the first is the angle over 2π).
    pub(crate) parameter: f32,
}

impl Mesh {
    fn vertex(&mut self, position: Vec3, normal: Vec3, parameter: Vec2) -> u32 {
        self.positions.push(position);
        self.normals.push(normal);
        self.parameters.push(parameter);
        self.positions.len() as u32 - 1
    }

    fn triangle(&mut self, a: u32, b: u32, c: u32, surface: u16) {
        self.triangles.push([a, b, c]);
        self.surfaces.push(surface);
    }

    fn quad(&mut self, a: u32, b: u32, c: u32, d: u32, surface: u16) {
        self.triangle(a, b, c, surface);
        self.triangle(a, c, d, surface);
    }

    /// The quads over the vertices from `start` on, which are `rows + 1` lines of `columns + 1`.
    fn grid(&mut self, start: u32, columns: usize, rows: usize, surface: u16) {
        let index = |i: usize, j: usize| start + (j * (columns + 1) + i) as u32;
        for j in 0..rows {
            for i in 0..columns {
                self.quad(index(i, j), index(i + 1, j), index(i + 1, j + 1), index(i, j + 1), surface);
            }
        }
    }

    /// A closed surface `shape(direction)` over the unit sphere, made from a cube whose faces of `n × n`
    /// cells are projected onto the sphere. `shape` must also be defined slightly off the sphere's points;
    /// normals are computed from differences of it, so that seams are invisible.
    pub(crate) fn displaced_sphere(&mut self, n: usize, surface: u16, shape: impl Fn(Vec3) -> (Vec3, Vec2)) {
        let faces = [
            (Vec3::X, Vec3::Y, Vec3::Z),
            (Vec3::NEG_X, Vec3::Z, Vec3::Y),
            (Vec3::Y, Vec3::Z, Vec3::X),
            (Vec3::NEG_Y, Vec3::X, Vec3::Z),
            (Vec3::Z, Vec3::X, Vec3::Y),
            (Vec3::NEG_Z, Vec3::Y, Vec3::X),
        ];
        for (normal, right, up) in faces {
            let start = self.positions.len() as u32;
            for j in 0..=n {
                for i in 0..=n {
                    // The tangent spreads the vertices evenly over the sphere.
                    let at = |k: usize| math::tan((k as f32 / n as f32 - 0.5) * std::f32::consts::FRAC_PI_2);
                    let d = (normal + at(i) * right + at(j) * up).normalize();
                    let (position, parameter) = shape(d);
                    let (t, h) = (d.any_orthonormal_vector(), 0.5 / n as f32);
                    let b = d.cross(t);
                    let moved = |v: Vec3| shape((d + h * v).normalize()).0;
                    let n = (moved(t) - moved(-t)).cross(moved(b) - moved(-b));
                    self.vertex(position, n.normalize_or(d), parameter);
                }
            }
            self.grid(start, n, n, surface);
        }
    }

    /// A surface through rings with `sides` vertices each; `bulge(angle, ring)` multiplies the radius.
    /// Normals are computed from the neighbouring vertices.
    pub(crate) fn sweep(
        &mut self,
        rings: &[Ring],
        sides: usize,
        surface: u16,
        bulge: impl Fn(f32, usize) -> f32,
    ) {
        if rings.len() < 2 {
            return;
        }
        let start = self.positions.len() as u32;
        let point = |k: usize, s: usize| {
            let ring = &rings[k];
            let angle = std::f32::consts::TAU * (s % sides) as f32 / sides as f32;
            let (sin, cos) = math::sin_cos(angle);
            ring.center + ring.radius * bulge(angle, k) * (cos * ring.axes[0] + sin * ring.axes[1])
        };
        for k in 0..rings.len() {
            for s in 0..=sides {
                let around = point(k, s + 1) - point(k, s + sides - 1);
                let along = point((k + 1).min(rings.len() - 1), s) - point(k.saturating_sub(1), s);
                let outwards = (point(k, s) - rings[k].center).normalize_or(Vec3::Z);
                let parameter = Vec2::new(s as f32 / sides as f32, rings[k].parameter);
                let normal = around.cross(along).normalize_or(outwards);
                self.vertex(point(k, s), normal, parameter);
            }
        }
        self.grid(start, sides, rings.len() - 1, surface);
    }

    /// A round tube along a path, closed by a rounded tip; `radii` and `parameters` are per path point.
    pub(crate) fn tube(
        &mut self,
        path: &[Vec3],
        radii: &[f32],
        parameters: &[f32],
        sides: usize,
        surface: u16,
    ) {
        let mut rings = rings_along(path, radii, parameters);
        if let (Some(last), Some(direction)) = (rings.last().copied(), end_direction(path)) {
            // Two rings that close the end like a hemisphere.
            for (out, shrink) in [(0.7, 0.7), (1.0, 0.02)] {
                let center = last.center + out * last.radius * direction;
                rings.push(Ring { center, radius: shrink * last.radius, ..last });
            }
        }
        self.sweep(&rings, sides, surface, |_, _| 1.0);
    }

    /// A bar of rectangular section along a path: flat faces with sharp edges, closed at both ends. `half` is
    /// half the width (along `across`) and half the height; the first texture parameter is the distance along
    /// the bar in metres.
    pub(crate) fn beam(&mut self, path: &[Vec3], across: Vec3, half: [f32; 2], surface: u16) {
        let Some(last) = path.len().checked_sub(1).filter(|&n| n > 0) else { return };
        let frame = |k: usize| {
            let along = (path[(k + 1).min(last)] - path[k.saturating_sub(1)]).normalize_or(Vec3::Y);
            let side = (across - across.dot(along) * along).normalize_or(along.any_orthonormal_vector());
            (side, along.cross(side), along)
        };
        let corner = |k: usize, i: usize| {
            let (side, up, _) = frame(k);
            let (a, b) = [(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)][i % 4];
            path[k] + a * half[0] * side + b * half[1] * up
        };
        for face in 0..4 {
            let (mut length, mut previous) = (0.0, None);
            for k in 0..=last {
                if k > 0 {
                    length += path[k].distance(path[k - 1]);
                }
                let (side, up, _) = frame(k);
                let normal = [up, -side, -up, side][face];
                let a = self.vertex(corner(k, face), normal, Vec2::new(length, 0.0));
                let b = self.vertex(corner(k, face + 1), normal, Vec2::new(length, 1.0));
                if let Some((c, d)) = previous {
                    self.quad(c, d, b, a, surface);
                }
                previous = Some((a, b));
            }
        }
        for k in [0, last] {
            let normal = frame(k).2 * if k == 0 { -1.0 } else { 1.0 };
            let ids: Vec<u32> = (0..4).map(|i| self.vertex(corner(k, i), normal, Vec2::ZERO)).collect();
            self.quad(ids[0], ids[1], ids[2], ids[3], surface);
        }
    }

    /// A flat rectangle from `origin` along `across` and `up`, with vertices at most `spacing` apart; its
    /// normal is `across × up`. Texture parameters are metres along both sides, starting at `start`.
    pub(crate) fn panel(
        &mut self,
        origin: Vec3,
        across: Vec3,
        up: Vec3,
        spacing: f32,
        start: Vec2,
        surface: u16,
    ) {
        let normal = across.cross(up).normalize_or(Vec3::Z);
        let cells = |side: Vec3| (side.length() / spacing).ceil().max(1.0) as usize;
        let (columns, rows) = (cells(across), cells(up));
        let first = self.positions.len() as u32;
        for j in 0..=rows {
            for i in 0..=columns {
                let (u, v) = (i as f32 / columns as f32, j as f32 / rows as f32);
                let parameter = start + Vec2::new(u * across.length(), v * up.length());
                self.vertex(origin + u * across + v * up, normal, parameter);
            }
        }
        self.grid(first, columns, rows, surface);
    }

    /// A height field over the product of two ascending coordinate lists. `shape` gives height and texture
    /// parameters. `smooth` gives the height from which the normals are computed (the surface adds the rest
    /// as bumps).
    pub(crate) fn height_field(
        &mut self,
        xs: &[f32],
        ys: &[f32],
        surface: u16,
        shape: impl Fn(f32, f32) -> (f32, Vec2) + Sync,
        smooth: impl Fn(f32, f32) -> f32 + Sync,
    ) {
        use rayon::prelude::*;
        let start = self.positions.len() as u32;
        let vertex = |x: f32, y: f32| {
            let h = 0.015;
            let slope_x = (smooth(x + h, y) - smooth(x - h, y)) / (2.0 * h);
            let slope_y = (smooth(x, y + h) - smooth(x, y - h)) / (2.0 * h);
            let (z, parameter) = shape(x, y);
            (Vec3::new(x, y, z), Vec3::new(-slope_x, -slope_y, 1.0).normalize(), parameter)
        };
        let row = |&y: &f32| xs.iter().map(|&x| vertex(x, y)).collect();
        let rows: Vec<Vec<(Vec3, Vec3, Vec2)>> = ys.par_iter().map(row).collect();
        for (position, normal, parameter) in rows.into_iter().flatten() {
            self.vertex(position, normal, parameter);
        }
        self.grid(start, xs.len() - 1, ys.len() - 1, surface);
    }
}

fn end_direction(path: &[Vec3]) -> Option<Vec3> {
    let n = path.len();
    (n >= 2).then(|| (path[n - 1] - path[n - 2]).normalize_or(Vec3::Z))
}

/// Rings along a path, with axes that rotate as little as possible from one ring to the next.
pub(crate) fn rings_along(path: &[Vec3], radii: &[f32], parameters: &[f32]) -> Vec<Ring> {
    let mut rings: Vec<Ring> = Vec::with_capacity(path.len() + 2);
    let last = path.len() - 1;
    for k in 0..path.len() {
        let along = (path[(k + 1).min(last)] - path[k.saturating_sub(1)]).normalize_or(Vec3::Z);
        let first = match rings.last() {
            Some(ring) => {
                let carried = ring.axes[0] - ring.axes[0].dot(along) * along;
                carried.normalize_or(along.any_orthonormal_vector())
            }
            None => along.any_orthonormal_vector(),
        };
        let axes = [first, along.cross(first)];
        rings.push(Ring { center: path[k], axes, radius: radii[k], parameter: parameters[k] });
    }
    rings
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normals_point_outwards_and_indices_are_in_range() {
        let mut mesh = Mesh::default();
        mesh.displaced_sphere(4, 0, |d| (2.0 * d, Vec2::ZERO));
        let spheres = mesh.positions.len();
        for (p, n) in mesh.positions.iter().zip(&mesh.normals) {
            assert!(n.dot(p.normalize()) > 0.99);
        }
        mesh.tube(&[Vec3::ZERO, Vec3::Z, 2.0 * Vec3::Z], &[0.2; 3], &[0.0; 3], 8, 1);
        for (p, n) in mesh.positions[spheres..].iter().zip(&mesh.normals[spheres..]) {
            assert!(n.dot(Vec3::new(p.x, p.y, 0.0)) >= -1e-3);
            assert!((n.length() - 1.0).abs() < 1e-4);
        }
        mesh.beam(&[Vec3::ZERO, Vec3::Y], Vec3::X, [0.1, 0.2], 2);
        assert!(mesh.triangles.iter().flatten().all(|&i| (i as usize) < mesh.positions.len()));
        assert_eq!(mesh.triangles.len(), mesh.surfaces.len());
    }
}
