//! Human-made objects on the sea floor: a colour chart, a rope on a concrete block, the ribs of a wreck, a
//! drum, a jar.

use glam::{Mat3, Vec2, Vec3};
use use3d_numerics::math;

use super::draws::Draws;
use super::surface::{Palette, Surface};
use super::terrain::Terrain;
use crate::geometry::mesh::{Mesh, Ring, rings_along};
use crate::geometry::noise::Noise;

/// sRGB values of a 24-patch colour chart, `0xRRGGBB`, row by row.
const CHART: [u32; 24] = [
    0x735244, 0xC29682, 0x627A9D, 0x576C43, 0x8580B1, 0x67BDAA, 0xD67E2C, 0x505BA6, 0xC15A63, 0x5E3C6C,
    0x9DBC40, 0xE0A32E, 0x383D96, 0x469449, 0xAF363C, 0xE7C71F, 0xBB5695, 0x0885A1, 0xF3F3F2, 0xC8C8C8,
    0xA0A0A0, 0x7A7A79, 0x555555, 0x343434,
];

/// A board with 24 patches, `width` metres wide, leaning back so that a swimmer sees it.
pub(crate) fn chart(mesh: &mut Mesh, palette: &mut Palette, base: Vec3, turn: f32, width: f32) {
    let (sin, cos) = math::sin_cos(turn);
    let right = Vec3::new(cos, sin, 0.0);
    let back = Vec3::new(-sin, cos, 0.0);
    let up = (0.8 * back + 0.6 * Vec3::Z).normalize();
    let normal = right.cross(up);
    let height = width * 0.7;
    let board = palette.plain([28, 28, 30], 0.05);
    let center = base + 0.5 * height * up + 0.02 * Vec3::Z;
    mesh.beam(&[center - 0.5 * height * up, center + 0.5 * height * up], right, [0.5 * width, 0.008], board);
    let (cell, gap) = (width / 6.3, 0.16);
    for (i, color) in CHART.into_iter().enumerate() {
        let [_, red, green, blue] = color.to_be_bytes();
        let (column, row) = ((i % 6) as f32 - 2.5, 1.5 - (i / 6) as f32);
        let middle = center + cell * (column * right + row * up) + 0.010 * normal;
        let half = 0.5 * cell * (1.0 - gap);
        let patch = palette.plain([red, green, blue], 0.0);
        mesh.beam(&[middle - half * up, middle + half * up], right, [half, 0.003], patch);
    }
    // A prop behind the board.
    let metal = palette.add(Surface::Metal);
    let prop = [center + 0.3 * height * up, base + 0.75 * height * back - 0.02 * Vec3::Z];
    mesh.beam(&prop, right, [0.012, 0.006], metal);
}

/// Reflectances of a board's patches, left to right, top to bottom.
const GREYS: [f32; 6] = [0.60, 0.42, 0.29, 0.20, 0.13, 0.08];

/// A board with six grey patches, `width` metres wide, leaning back and facing an approaching swimmer.
pub(crate) fn greys(mesh: &mut Mesh, palette: &mut Palette, base: Vec3, width: f32) {
    let (right, up) = (Vec3::X, Vec3::new(0.0, 0.6, 0.8));
    let normal = right.cross(up);
    let height = 0.7 * width;
    let board = palette.plain([28, 28, 30], 0.05);
    let center = base + (0.5 * height + 0.06) * up;
    let half = 0.5 * height * up;
    mesh.beam(&[center - half, center + half], right, [0.5 * width, 0.008], board);
    let cell = width / 3.2;
    for (i, value) in GREYS.into_iter().enumerate() {
        let (column, row) = ((i % 3) as f32 - 1.0, 0.5 - (i / 3) as f32);
        let middle = center + cell * (column * right + row * up) + 0.010 * normal;
        let patch = palette.add(Surface::Grey { value });
        let half = 0.44 * cell;
        mesh.beam(&[middle - half * up, middle + half * up], right, [half, 0.003], patch);
    }
}

/// A concrete block and a three-strand rope that runs from it over the sand and up to `end`.
pub(crate) fn rope(
    mesh: &mut Mesh,
    palette: &mut Palette,
    draws: &mut Draws,
    terrain: &Terrain,
    start: Vec2,
    end: Vec3,
) {
    let ground = terrain.height(start.x, start.y);
    let block = start.extend(ground + 0.05);
    let concrete = palette.stone([126, 122, 112]);
    let (sin, cos) = math::sin_cos(draws.about(0.6));
    let (along, across) = (Vec3::new(sin, cos, 0.0), Vec3::new(cos, -sin, 0.0));
    mesh.beam(&[block - 0.17 * along, block + 0.17 * along], across, [0.13, 0.11], concrete);
    let radius = 0.017;
    let steps = 260;
    let swing = draws.range(0.35, 0.6);
    let path: Vec<Vec3> = (0..=steps)
        .map(|k| {
            let t = k as f32 / steps as f32;
            let xy = start.lerp(end.truncate(), t)
                + Vec2::new(swing * math::sin(std::f32::consts::TAU * t) * (1.0 - t), 0.0);
            let floor = terrain.height(xy.x, xy.y) + 0.8 * radius;
            // The rope lies on the floor, then rises in a curve to its end.
            let rise = ((t - 0.62) / 0.38).max(0.0);
            let lifted = floor + (end.z - floor) * rise * rise;
            let knot = ground + 0.17;
            let from_block = (1.0 - 14.0 * t).max(0.0);
            xy.extend(lifted.max(floor) + from_block * (knot - floor).max(0.0))
        })
        .collect();
    let mut lengths = vec![0.0];
    for (k, part) in path.windows(2).enumerate() {
        lengths.push(lengths[k] + part[1].distance(part[0]));
    }
    let rings = rings_along(&path, &vec![radius; path.len()], &lengths);
    let surface = palette.add(Surface::Rope);
    mesh.sweep(&rings, 14, surface, |angle, k| 1.0 + 0.16 * math::cos(3.0 * angle - 70.0 * lengths[k]));
}

/// The ribs, keel and a few planks of a wooden wreck in direction `turn`, with its keel at `base`.
pub(crate) fn wreck(
    mesh: &mut Mesh,
    palette: &mut Palette,
    draws: &mut Draws,
    base: Vec3,
    turn: f32,
) -> Vec3 {
    let wood = palette.add(Surface::Wood);
    let (sin, cos) = math::sin_cos(turn);
    let ahead = Vec3::new(-sin, cos, 0.0);
    let right = Vec3::new(cos, sin, 0.0);
    let length = 4.6;
    // Half width and height of the hull along its length: a bow at the far end.
    let hull = |t: f32| (1.15 * (1.0 - t * t * t) + 0.12, 1.15 + 0.35 * t * t);
    let rib_point = |t: f32, side: f32, a: f32| {
        let (w, h) = hull(t);
        let angle = a * 1.75;
        base + t * length * ahead
            + side * w * math::powf(math::sin(angle), 0.8) * right
            + h * (1.0 - math::cos(angle)) * Vec3::Z
    };
    let keel = [base - 0.3 * ahead, base + 0.5 * length * ahead, base + length * ahead];
    mesh.beam(&keel, right, [0.10, 0.13], wood);
    let (_, bow) = hull(1.0);
    let stem: Vec<Vec3> = (0..=8)
        .map(|k| {
            let t = k as f32 / 8.0;
            base + (length + 0.7 * t * t) * ahead + bow * 1.25 * t * Vec3::Z
        })
        .collect();
    mesh.beam(&stem, right, [0.07, 0.10], wood);
    let mut highest = base;
    let ribs = 10;
    for i in 0..ribs {
        let t = i as f32 / (ribs - 1) as f32 * 0.94;
        for side in [-1.0, 1.0] {
            let reach =
                if draws.range(0.0, 1.0) < 0.3 { draws.range(0.4, 0.7) } else { draws.range(0.8, 1.0) };
            let lean = draws.about(0.04);
            let path: Vec<Vec3> = (0..=12)
                .map(|k| rib_point(t + lean * k as f32 / 12.0, side, 0.06 + reach * k as f32 / 12.0))
                .collect();
            mesh.beam(&path, ahead, [0.05, 0.045], wood);
            let top = path[path.len() - 1];
            if side < 0.0 && i < 4 && top.z > highest.z {
                highest = top;
            }
        }
    }
    for _ in 0..11 {
        let side = if draws.below(3) == 0 { 1.0 } else { -1.0 };
        let height = draws.range(0.42, 0.9);
        let (from, span) = (draws.range(0.0, 0.55), draws.range(0.25, 0.5));
        let point = |k: u8| rib_point((from + span * f32::from(k) / 10.0).min(0.97), side, height);
        let path: Vec<Vec3> = (0..=10).map(|k| point(k) + 0.05 * side * right).collect();
        let up = (rib_point(from, side, height + 0.03) - rib_point(from, side, height - 0.03)).normalize();
        mesh.beam(&path, up, [0.085, 0.014], wood);
    }
    highest
}

/// A steel drum lying half buried.
pub(crate) fn drum(mesh: &mut Mesh, palette: &mut Palette, base: Vec3, turn: f32) {
    let (sin, cos) = math::sin_cos(turn);
    let axis = Vec3::new(cos, sin, 0.12).normalize();
    let profile = [
        (0.0, 0.02),
        (0.0, 0.265),
        (0.01, 0.29),
        (0.03, 0.29),
        (0.04, 0.28),
        (0.28, 0.28),
        (0.29, 0.298),
        (0.31, 0.298),
        (0.32, 0.28),
        (0.56, 0.28),
        (0.57, 0.298),
        (0.59, 0.298),
        (0.6, 0.28),
        (0.84, 0.28),
        (0.85, 0.29),
        (0.87, 0.29),
        (0.88, 0.265),
        (0.88, 0.02),
    ];
    revolve(mesh, base + 0.1 * Vec3::Z - 0.44 * axis, axis, 1.0, &profile, 32, palette.add(Surface::Metal));
}

/// A clay jar with two handles lying on its side.
pub(crate) fn jar(
    mesh: &mut Mesh,
    palette: &mut Palette,
    draws: &mut Draws,
    base: Vec3,
    turn: f32,
    size: f32,
) {
    let (sin, cos) = math::sin_cos(turn);
    let axis = Vec3::new(cos, sin, 0.22).normalize();
    let clay = palette.stone([176, 112, 74]);
    let profile = [
        (0.0, 0.01),
        (0.02, 0.05),
        (0.12, 0.11),
        (0.3, 0.19),
        (0.45, 0.225),
        (0.58, 0.215),
        (0.68, 0.16),
        (0.74, 0.09),
        (0.8, 0.06),
        (0.92, 0.058),
        (0.95, 0.085),
        (1.0, 0.09),
        (1.0, 0.06),
        (0.9, 0.045),
    ];
    let foot = base + size * (0.12 * Vec3::Z - 0.5 * axis);
    revolve(mesh, foot, axis, size, &profile, 28, clay);
    let side = Mat3::from_axis_angle(axis, draws.range(0.2, 0.6)) * axis.cross(Vec3::Z).normalize();
    for sign in [-1.0, 1.0] {
        let path: Vec<Vec3> = (0..=8)
            .map(|k| {
                let t = k as f32 / 8.0;
                let out = 0.06 + 0.1 * math::sin(std::f32::consts::PI * t) + 0.1 * t * t;
                foot + size * ((0.9 - 0.28 * t) * axis + sign * out * side)
            })
            .collect();
        mesh.tube(&path, &[0.022 * size; 9], &[0.0; 9], 8, clay);
    }
}

fn revolve(
    mesh: &mut Mesh,
    foot: Vec3,
    axis: Vec3,
    size: f32,
    profile: &[(f32, f32)],
    sides: usize,
    surface: u16,
) {
    let first = axis.any_orthonormal_vector();
    let axes = [first, axis.cross(first)];
    let rings: Vec<Ring> = profile
        .iter()
        .map(|&(t, r)| Ring { center: foot + size * t * axis, axes, radius: size * r, parameter: t })
        .collect();
    let dents = Noise::new(7);
    mesh.sweep(&rings, sides, surface, |angle, k| {
        1.0 + 0.02 * dents.value(Vec3::new(1.5 * math::cos(angle), 1.5 * math::sin(angle), 0.4 * k as f32))
    });
}
