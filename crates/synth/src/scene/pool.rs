//! A tiled pool: a flat blue floor and walls with almost no features, the hard case for distinguishing
//! surfaces from water.
//!
//! The floor is at z = 0, walls are on the left, on the right and ahead, and the swim follows a lane line. A
//! colour chart, a drum and a jar are on the floor.

use glam::{Vec2, Vec3};

use super::artefacts;
use super::draws::Draws;
use super::surface::{Palette, Surface, linear};
use super::terrain::Terrain;
use crate::geometry::mesh::Mesh;

/// Side of a tile, metres.
const TILE: f32 = 0.25;
/// Half the width of the basin, metres.
const HALF: f32 = 3.0;
/// Positions of the wall at the end of the swim and of the beginning of the basin, metres.
const ENDS: [f32; 2] = [-9.0, 11.0];
/// Height of the walls, metres: above every swim.
const WALL: f32 = 4.0;
/// Spacing of the vertices, at which light is computed, metres.
const SPACING: f32 = 0.25;

/// The colour of the tiles of a typical pool.
pub(crate) fn blue() -> Vec3 {
    linear([150, 196, 214])
}

/// Builds the mesh and its surfaces, with tiles of a colour (linear).
pub(crate) fn build(seed: u64, color: Vec3) -> (Mesh, Palette, Terrain) {
    let terrain = Terrain::flat(seed);
    let (mut mesh, mut palette) = (Mesh::default(), Palette::default());
    let floor = palette.add(Surface::Tiles { color, side: TILE, line: 0.14 });
    let walls = palette.add(Surface::Tiles { color, side: TILE, line: 0.0 });
    let (origin, far) = (Vec3::new(-HALF, ENDS[0], 0.0), ENDS[1] - ENDS[0]);
    mesh.panel(origin, 2.0 * HALF * Vec3::X, far * Vec3::Y, SPACING, Vec2::new(-HALF, 0.0), floor);
    let up = WALL * Vec3::Z;
    mesh.panel(origin, far * Vec3::Y, up, SPACING, Vec2::ZERO, walls);
    mesh.panel(Vec3::new(HALF, ENDS[1], 0.0), -far * Vec3::Y, up, SPACING, Vec2::ZERO, walls);
    mesh.panel(Vec3::new(-HALF, ENDS[1], 0.0), 2.0 * HALF * Vec3::X, up, SPACING, Vec2::ZERO, walls);
    let mut draws = Draws::new(seed, "pool", 0);
    let about =
        |x: f32, y: f32, draws: &mut Draws| Vec3::new(x + draws.about(0.2), y + draws.about(0.3), 0.0);
    let chart = about(-0.5, 2.5, &mut draws);
    artefacts::chart(&mut mesh, &mut palette, chart, draws.about(0.25), 0.46);
    let drum = about(1.2, 5.0, &mut draws);
    artefacts::drum(&mut mesh, &mut palette, drum, draws.range(-0.4, 0.9));
    let (jar, turn) = (about(-1.0, 6.5, &mut draws), draws.range(0.0, 6.0));
    artefacts::jar(&mut mesh, &mut palette, &mut draws, jar, turn, 0.62);
    (mesh, palette, terrain)
}
