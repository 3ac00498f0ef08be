//! Organisms and stones of the reef: branching, brain, plate and fan corals, tube sponges, starfish, boulders
//! and pebbles.
//!
//! Every builder adds one object to the mesh, with its foot at `base` (metres) and about `size` large.
//! `detail` in (0, 1] scales the number of triangles. Texture parameters are documented at the surfaces that
//! use them (`Surface`).

use glam::{Vec2, Vec3};
use use3d_numerics::math;

use super::draws::Draws;
use crate::geometry::mesh::{Mesh, Ring, rings_along};
use crate::geometry::noise::Noise;

/// Number of subdivisions scaled by the detail, with a minimum that keeps the shape.
fn subdivide(n: usize, detail: f32) -> usize {
    ((n as f32 * detail).round() as usize).max(3)
}

/// A stone: a sphere displaced by noise, flattened, sunk a little into the ground.
pub(crate) fn boulder(
    mesh: &mut Mesh,
    draws: &mut Draws,
    base: Vec3,
    size: f32,
    n: usize,
    detail: f32,
    surface: u16,
) {
    let noise = Noise::new(draws.bits());
    let stretch = Vec3::new(draws.range(0.8, 1.2), draws.range(0.8, 1.2), draws.range(0.55, 0.85));
    let center = base + Vec3::new(0.0, 0.0, 0.2 * size);
    let octaves = if n > 10 { 4 } else { 2 };
    mesh.displaced_sphere(subdivide(n, detail), surface, |d| {
        let bumps = noise.octaves(d, 1.1, octaves, 0.0).0;
        (center + 0.5 * size * stretch * d * (1.0 + 0.45 * bumps), Vec2::ZERO)
    });
}

/// Brain coral: a dome. Its winding grooves are bumps of the surface, along the zero lines of a noise field.
pub(crate) fn brain(mesh: &mut Mesh, draws: &mut Draws, base: Vec3, size: f32, detail: f32, surface: u16) {
    let shape = Noise::new(draws.bits());
    let squash = draws.range(0.7, 0.9);
    let center = base + Vec3::new(0.0, 0.0, 0.06 * size);
    mesh.displaced_sphere(subdivide(22, detail), surface, |d| {
        let smooth = d * Vec3::new(1.0, 1.0, squash) * (1.0 + 0.12 * shape.value(1.6 * d));
        let p = center + 0.5 * size * smooth;
        (p, Vec2::ZERO)
    });
}

/// Distance of a point from the middle of a brain coral's groove (0 in it, about 0.3 on a ridge), and its
/// gradient.
pub(crate) fn groove(noise: Noise, p: Vec3) -> (f32, Vec3) {
    let (bend, turn) = noise.with_gradient(7.0 * p + Vec3::splat(5.0));
    let (value, slope) = noise.with_gradient(26.0 * p + Vec3::splat(1.3 * bend));
    let gradient = 26.0 * slope + 1.3 * 7.0 * slope.dot(Vec3::ONE) * turn;
    (value.abs(), gradient * value.signum())
}

/// Staghorn coral: stems that fork repeatedly. Second parameter: 0 at the foot, 1 at the tips.
pub(crate) fn branching(
    mesh: &mut Mesh,
    draws: &mut Draws,
    base: Vec3,
    size: f32,
    detail: f32,
    surface: u16,
) {
    struct Branch {
        foot: Vec3,
        direction: Vec3,
        length: f32,
        radius: f32,
        level: u32,
    }
    let levels = if detail < 0.4 { 3 } else { 4 };
    let stems = 5 + draws.below(4);
    let sides = subdivide(7, detail).max(4);
    let mut open: Vec<Branch> = (0..stems)
        .map(|i| {
            let angle = std::f32::consts::TAU * (i as f32 + draws.range(0.0, 0.7)) / stems as f32;
            let lean = draws.range(0.25, 1.0);
            let out = Vec2::from_angle(angle);
            Branch {
                foot: base + (0.06 * size * out).extend(-0.02),
                direction: Vec3::new(lean * out.x, lean * out.y, 1.0).normalize(),
                length: size * draws.range(0.3, 0.42),
                radius: size * draws.range(0.04, 0.055),
                level: 0,
            }
        })
        .collect();
    while let Some(branch) = open.pop() {
        // The many thin outer branches need fewer triangles than the stems.
        let (steps, sides) = if branch.level < 2 { (4, sides) } else { (2, sides.min(5)) };
        let bend = Vec3::new(draws.about(0.25), draws.about(0.25), draws.range(0.0, 0.3));
        let taper = if branch.level + 1 == levels { 0.55 } else { 0.8 };
        let (mut path, mut radii, mut tips) = (Vec::new(), Vec::new(), Vec::new());
        for k in 0..=steps {
            let t = k as f32 / steps as f32;
            let along = (branch.direction + t * bend).normalize();
            path.push(branch.foot + t * branch.length * along);
            radii.push(branch.radius * (1.0 + (taper - 1.0) * t));
            tips.push((branch.level as f32 + t) / levels as f32);
        }
        mesh.tube(&path, &radii, &tips, sides, surface);
        if branch.level + 1 < levels {
            let children = 2 + draws.below(2);
            let turn = draws.range(0.0, std::f32::consts::TAU);
            for c in 0..children {
                // Children start near the end, spread around the stem, and bend upwards.
                let t = if c == 0 { 1.0 } else { draws.range(0.45, 0.95) };
                let k = (t * steps as f32) as usize;
                let along = (path[steps] - path[steps - 1]).normalize();
                let side = along.any_orthonormal_vector();
                let angle = turn + std::f32::consts::TAU * c as f32 / children as f32;
                let out = math::cos(angle) * side + math::sin(angle) * along.cross(side);
                let spread = draws.range(0.35, 0.85);
                open.push(Branch {
                    foot: path[k.min(steps)],
                    direction: (along + spread * out + Vec3::new(0.0, 0.0, 0.15)).normalize(),
                    length: branch.length * draws.range(0.62, 0.85),
                    radius: radii[k.min(steps)] * 0.8,
                    level: branch.level + 1,
                });
            }
        }
    }
}

/// Sea fan: branches that fork within one plane facing `facing`. Second parameter: 0 at the foot, 1 at the
/// rim.
pub(crate) fn fan(
    mesh: &mut Mesh,
    draws: &mut Draws,
    base: Vec3,
    size: f32,
    facing: Vec2,
    detail: f32,
    surface: u16,
) {
    let right = facing.perp().normalize().extend(0.0);
    let normal = facing.normalize().extend(0.0);
    let levels = if detail < 0.4 { 5 } else { 7 };
    let sides = subdivide(5, detail).max(3);
    let mut open =
        vec![(base - Vec3::new(0.0, 0.0, 0.03), 0.0f32, 0.17 * size, 0.016f32.min(0.022 * size), 0)];
    while let Some((foot, lean, length, radius, level)) = open.pop() {
        let mut path = vec![foot];
        let mut angle = lean;
        for _ in 0..3 {
            angle += draws.about(0.14);
            let (sin, cos) = math::sin_cos(angle);
            let along = sin * right + cos * Vec3::Z + draws.about(0.06) * normal;
            path.push(path[path.len() - 1] + length / 3.0 * along);
        }
        let tip = |k: usize| (level as f32 + k as f32 / 3.0) / levels as f32;
        let radii: Vec<f32> = (0..4).map(|k| radius * (1.0 - 0.07 * k as f32)).collect();
        mesh.tube(&path, &radii, &[tip(0), tip(1), tip(2), tip(3)], sides, surface);
        if level + 1 < levels {
            let spread = draws.range(0.24, 0.42);
            for side in [-1.0, 1.0] {
                let next = (angle + side * (spread + draws.about(0.1))).clamp(-1.75, 1.75);
                open.push((
                    path[3],
                    next,
                    length * draws.range(0.78, 0.98),
                    (radius * 0.8).max(0.0042),
                    level + 1,
                ));
            }
        }
    }
}

/// Plate (table) coral: wavy plates on a stalk. First parameter of the plate: 0 at its middle, 1 at its rim.
pub(crate) fn plates(mesh: &mut Mesh, draws: &mut Draws, base: Vec3, size: f32, detail: f32, surface: u16) {
    let tiers = 1 + draws.below(3);
    let mut height = 0.22 * size;
    for tier in 0..tiers {
        let noise = Noise::new(draws.bits());
        let radius = 0.5 * size * (1.0 - 0.22 * tier as f32);
        let offset = Vec3::new(draws.about(0.12), draws.about(0.12), 0.0) * size;
        let center = base + offset + Vec3::new(0.0, 0.0, height);
        let tilt = Vec2::new(draws.about(0.22), draws.about(0.22));
        mesh.displaced_sphere(subdivide(18, detail), surface, |d| {
            let flat = Vec2::new(d.x, d.y);
            let out = flat.length();
            let lobes = 1.0 + 0.28 * noise.value(Vec3::new(1.7 * d.x, 1.7 * d.y, 0.0));
            let xy = radius * lobes * flat;
            let dish = 0.16 * out * out + tilt.dot(flat) + 0.05 * noise.value(3.0 * d);
            let thickness = 0.035 * size * d.z.signum() * d.z.abs().sqrt() * (1.2 - out * 0.6);
            let fingers = if d.z > 0.0 { 0.008 * noise.value((55.0 * xy).extend(0.0)).max(0.0) } else { 0.0 };
            (center + xy.extend(radius * dish + thickness + fingers), Vec2::new(out, 0.0))
        });
        let foot = base + 0.6 * offset;
        let path = [foot, foot + Vec3::new(0.0, 0.0, 0.5 * height), center];
        mesh.tube(&path, &[0.1 * size, 0.06 * size, 0.12 * size], &[0.0; 3], 10, surface);
        height += draws.range(0.16, 0.24) * size;
    }
}

/// Tube sponges: a cluster of open pipes. Second parameter: height along the pipe, above 1 inside it.
pub(crate) fn sponge(mesh: &mut Mesh, draws: &mut Draws, base: Vec3, size: f32, detail: f32, surface: u16) {
    let pipes = 3 + draws.below(5);
    let sides = subdivide(18, detail).max(8);
    for i in 0..pipes {
        let out = Vec2::from_angle(std::f32::consts::TAU * i as f32 / pipes as f32 + draws.about(0.4));
        let foot = base + (size * draws.range(0.05, 0.2) * out).extend(-0.03);
        let height = size * draws.range(0.5, 1.0);
        let radius = size * draws.range(0.075, 0.115);
        let lean = (draws.range(0.05, 0.4) * out).extend(1.0);
        let bend = Vec3::new(draws.about(0.2), draws.about(0.2), 0.0);
        let profile: [(f32, f32); 11] = [
            (0.0, 0.62),
            (0.12, 0.8),
            (0.3, 0.9),
            (0.5, 0.97),
            (0.7, 1.0),
            (0.9, 1.06),
            (0.98, 1.08),
            (1.0, 0.98),
            (0.97, 0.84),
            (0.8, 0.74),
            (0.45, 0.6),
        ];
        let axis = |t: f32| foot + height * (t * lean + t * t * bend);
        let path: Vec<Vec3> = (0..=10).map(|k| axis(k as f32 / 10.0)).collect();
        let frames = rings_along(&path, &[1.0; 11], &[0.0; 11]);
        let rings: Vec<Ring> = profile
            .iter()
            .enumerate()
            .map(|(k, &(t, r))| Ring {
                center: axis(t),
                axes: frames[(t * 10.0) as usize].axes,
                radius: r * radius,
                parameter: if k < 7 { t } else { 1.0 + (1.0 - t) },
            })
            .collect();
        let ribs = Noise::new(draws.bits());
        mesh.sweep(&rings, sides, surface, |angle, k| {
            let p = Vec3::new(2.0 * math::cos(angle), 2.0 * math::sin(angle), 0.8 * k as f32);
            1.0 + 0.09 * ribs.value(p)
        });
    }
}

/// A starfish lying on the ground, five tapering arms.
pub(crate) fn starfish(mesh: &mut Mesh, draws: &mut Draws, base: Vec3, size: f32, detail: f32, surface: u16) {
    let turn = draws.range(0.0, std::f32::consts::TAU);
    let noise = Noise::new(draws.bits());
    mesh.displaced_sphere(subdivide(16, detail), surface, |d| {
        let flat = Vec2::new(d.x, d.y);
        let angle = math::atan2(flat.y, flat.x) + turn;
        let arm = math::powf(0.5 + 0.5 * math::cos(5.0 * angle), 1.6);
        let reach = 0.24 + 0.76 * arm;
        let out = flat.length();
        let height = 0.16 * d.z * (1.0 - 0.55 * out * out) * (0.5 + 0.5 * arm);
        let knobs = 0.008 * noise.value(30.0 * d).abs();
        let p = Vec3::new(reach * flat.x, reach * flat.y, height + knobs + 0.04);
        (base + 0.5 * size * p, Vec2::new(out, 0.0))
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_organism_is_finite_and_about_as_large_as_asked() {
        let base = Vec3::new(1.0, 2.0, 0.5);
        type Grow = fn(&mut Mesh, &mut Draws, Vec3);
        let grow: [(&str, Grow); 7] = [
            ("boulder", |m, d, b| boulder(m, d, b, 1.0, 12, 0.5, 0)),
            ("brain", |m, d, b| brain(m, d, b, 1.0, 0.5, 0)),
            ("branching", |m, d, b| branching(m, d, b, 1.0, 0.5, 0)),
            ("fan", |m, d, b| fan(m, d, b, 1.0, Vec2::Y, 0.5, 0)),
            ("plates", |m, d, b| plates(m, d, b, 1.0, 0.5, 0)),
            ("sponge", |m, d, b| sponge(m, d, b, 1.0, 0.5, 0)),
            ("starfish", |m, d, b| starfish(m, d, b, 1.0, 0.5, 0)),
        ];
        for (name, grow) in grow {
            let mut mesh = Mesh::default();
            grow(&mut mesh, &mut Draws::new(3, "test", 0), base);
            let reach = mesh.positions.iter().map(|p| (*p - base).length()).fold(0.0, f32::max);
            assert!((0.3..1.8).contains(&reach), "{name} reaches {reach}");
            assert!(mesh.positions.iter().chain(&mesh.normals).all(|v| v.is_finite()), "{name}");
        }
    }
}
