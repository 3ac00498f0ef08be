//! The positions of objects: organisms on the reef, objects on the sand, and a free corridor for the swimmer.

use glam::{Vec2, Vec3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_numerics::math;

use super::artefacts;
use super::draws::Draws;
use super::organisms;
use super::surface::{Palette, Surface, linear};
use super::terrain::Terrain;
use crate::geometry::mesh::Mesh;
use crate::geometry::noise::Noise;

/// The place of the photographs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Location {
    /// A coral reef with a wreck.
    #[default]
    Reef,
    /// A tiled pool: flat, even surfaces of nearly one colour.
    Pool,
    /// The same pool with tiles of the colour of open water: surfaces and water cannot be distinguished by
    /// colour.
    VeilPool,
}

impl Location {
    /// All places.
    pub const ALL: [Self; 3] = [Self::Reef, Self::Pool, Self::VeilPool];

    /// Its name in parameter files.
    pub fn name(self) -> &'static str {
        ["reef", "pool", "veil-pool"][self as usize]
    }
}

/// The description of a scene to build.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Layout {
    /// The kind of scene.
    pub(crate) place: Location,
    /// The seed of positions and shapes.
    pub(crate) seed: u64,
    /// Triangle density, in (0, 1]; a coarse scene is also less crowded.
    pub(crate) detail: f32,
    /// Number of organisms, relative to the default.
    pub(crate) density: f32,
    /// True if the scene contains the wreck with its rope.
    pub(crate) wreck: bool,
    /// True if there are boards with grey patches near and far.
    pub(crate) greys: bool,
    /// Colour of the tiles of the pool with the veil's colour, linear.
    pub(crate) veil: Vec3,
}

/// Largest height of an object under the swimmer's path, metres above the sand.
const LOW: f32 = 0.55;

/// Foot and tip colours of staghorn corals.
const BRANCHES: [([u8; 3], [u8; 3]); 6] = [
    ([176, 128, 74], [238, 224, 196]),
    ([122, 88, 168], [206, 186, 234]),
    ([92, 116, 178], [190, 206, 240]),
    ([158, 164, 70], [232, 232, 170]),
    ([196, 104, 124], [246, 206, 210]),
    ([206, 140, 66], [250, 226, 160]),
];
const BRAINS: [([u8; 3], [u8; 3]); 3] =
    [([176, 158, 92], [84, 108, 56]), ([188, 140, 96], [104, 72, 58]), ([150, 160, 104], [62, 98, 84])];
const FANS: [([u8; 3], [u8; 3]); 4] = [
    ([124, 52, 148], [184, 108, 200]),
    ([184, 44, 44], [226, 92, 70]),
    ([220, 144, 44], [246, 196, 84]),
    ([196, 60, 112], [236, 128, 160]),
];
const PLATES: [([u8; 3], [u8; 3]); 3] =
    [([140, 124, 78], [226, 212, 160]), ([112, 128, 92], [206, 218, 168]), ([150, 100, 96], [232, 190, 176])];
const SPONGES: [[u8; 3]; 4] = [[232, 112, 36], [236, 196, 56], [156, 84, 164], [214, 66, 58]];
const STARS: [[u8; 3]; 3] = [[232, 104, 40], [196, 52, 56], [72, 96, 190]];

/// Builds the mesh and its surfaces.
pub(crate) fn build(layout: &Layout) -> (Mesh, Palette, Terrain) {
    let Layout { seed, detail, density, wreck, greys, .. } = *layout;
    let terrain = Terrain::new(seed);
    let (mut mesh, mut palette) = (Mesh::default(), Palette::default());
    let mut draws = Draws::new(seed, "layout", 0);
    let ground = palette.add(Surface::Ground {
        sand: linear([218, 204, 172]),
        rock: linear([136, 120, 96]),
        algae: linear([120, 122, 66]),
        crust: linear([190, 112, 140]),
        ripples: terrain.ripples,
    });
    terrain.add_to(&mut mesh, 0.055 / detail, ground);
    let mut taken: Vec<(Vec2, f32)> = Vec::new();
    let on_ground = |xy: Vec2| xy.extend(terrain.height(xy.x, xy.y));

    // The chart is at the start of the swim, the wreck at its end.
    let chart = Vec2::new(terrain.channel_center(2.5) + draws.about(0.2), 2.5);
    artefacts::chart(&mut mesh, &mut palette, on_ground(chart), draws.about(0.25), 0.46);
    taken.push((chart, 0.45));
    if greys {
        // One board is at the start of the swim; the swim never reaches the other one.
        for (y, aside, width) in [(1.7, 0.55, 0.42), (6.4, -0.5, 0.9)] {
            let board = Vec2::new(terrain.channel_center(y) + aside, y);
            artefacts::greys(&mut mesh, &mut palette, on_ground(board), width);
            taken.push((board, 0.7 * width));
        }
    }
    if wreck {
        let keel = Vec2::new(terrain.channel_center(8.0) + 0.75, 7.6);
        let mut base = on_ground(keel);
        base.z = base.z.min(terrain.height(keel.x, keel.y + 2.0)) - 0.03;
        let heading = Draws::new(seed, "wreck", 0).range(-0.35, 0.05);
        let rib = artefacts::wreck(&mut mesh, &mut palette, &mut draws, base, heading);
        for i in 0..7 {
            taken.push((keel + Vec2::new(0.0, 0.75 * i as f32), 1.35));
        }
        let block = Vec2::new(terrain.channel_center(3.6) - 0.75, 3.7);
        artefacts::rope(&mut mesh, &mut palette, &mut draws, &terrain, block, rib);
        taken.push((block, 0.35));
    }
    let drum = Vec2::new(terrain.channel_center(5.2) + 1.05, 5.1);
    artefacts::drum(&mut mesh, &mut palette, on_ground(drum), draws.range(-0.4, 0.9));
    taken.push((drum, 0.6));
    let jar = Vec2::new(terrain.channel_center(1.3) - 0.75, 1.5);
    let turn = draws.range(0.0, 6.0);
    artefacts::jar(&mut mesh, &mut palette, &mut draws, on_ground(jar), turn, 0.62);
    taken.push((jar, 0.4));

    let mut plant =
        Planter { mesh: &mut mesh, palette: &mut palette, terrain: &terrain, taken, seed, detail };
    let crowd = density * (0.4 + 0.6 * detail);
    plant.reef((150.0 * crowd) as u64);
    plant.sand((46.0 * crowd) as u64, (320.0 * detail * density) as u64);
    (mesh, palette, terrain)
}

struct Planter<'a> {
    mesh: &'a mut Mesh,
    palette: &'a mut Palette,
    terrain: &'a Terrain,
    /// Occupied circles.
    taken: Vec<(Vec2, f32)>,
    seed: u64,
    detail: f32,
}

impl Planter<'_> {
    fn is_free(&self, at: Vec2, radius: f32) -> bool {
        self.taken.iter().all(|(other, r)| other.distance(at) > 0.8 * (r + radius))
    }

    /// True if an object of this height can be placed here without touching the swimmer.
    fn clears_path(&self, at: Vec2, height: f32) -> bool {
        let top = self.terrain.height(at.x, at.y) + height;
        let sand = self.terrain.height(self.terrain.channel_center(at.y), at.y);
        let off = (at.x - self.terrain.channel_center(at.y)).abs();
        off > 1.5 || top < sand + LOW + 0.6 * (off - 0.4).max(0.0)
    }

    fn spot(&self, draws: &mut Draws) -> (Vec2, f32) {
        // Denser along the channel's edges, which the swimmer sees from near.
        let y = draws.range(-0.6, 13.5);
        let side = if draws.below(2) == 0 { -1.0 } else { 1.0 };
        let off = 4.6 * math::powf(draws.range(0.0, 1.0), 1.2);
        let at = Vec2::new(self.terrain.channel_center(y) + side * off, y);
        (at, self.terrain.at(at.x, at.y).1)
    }

    /// Takes a free place for an object of this size where the ground `fits`, by its share of reef. The
    /// object keeps others away within `room` of its size.
    fn settle(
        &mut self,
        draws: &mut Draws,
        size: f32,
        room: f32,
        fits: impl Fn(f32) -> bool,
    ) -> Option<Vec3> {
        let place = (0..12).find_map(|_| {
            let (at, reef) = self.spot(draws);
            let free = fits(reef) && self.is_free(at, 0.4 * size) && self.clears_path(at, 0.8 * size);
            free.then_some(at)
        });
        let at = place?;
        self.taken.push((at, room * size));
        Some(at.extend(self.terrain.height(at.x, at.y)))
    }

    fn reef(&mut self, count: u64) {
        for number in 0..count {
            let draws = &mut Draws::new(self.seed, "reef", number);
            let kind = draws.range(0.0, 1.0);
            let size = match kind {
                k if k < 0.34 => draws.range(0.4, 0.95),
                k if k < 0.46 => draws.range(0.4, 1.0),
                k if k < 0.60 => draws.range(0.6, 1.25),
                k if k < 0.74 => draws.range(0.5, 0.95),
                k if k < 0.86 => draws.range(0.35, 0.7),
                _ => draws.range(0.4, 1.1),
            };
            let Some(base) = self.settle(draws, size, 0.4, |reef| reef > 0.45) else { continue };
            // Distant organisms need fewer triangles.
            let detail = self.detail * if base.y > 9.5 || base.x.abs() > 4.0 { 0.6 } else { 1.0 };
            match kind {
                k if k < 0.34 => self.branching(draws, base, size, detail),
                k if k < 0.46 => self.brain(draws, base, size, detail),
                k if k < 0.60 => self.plates(draws, base, size, detail),
                k if k < 0.74 => self.fan(draws, base, size, detail),
                k if k < 0.86 => {
                    let outside = linear(SPONGES[draws.below(SPONGES.len())]);
                    let surface = self.palette.add(Surface::Sponge { outside });
                    organisms::sponge(self.mesh, draws, base, size, detail, surface);
                }
                _ => self.boulder(draws, base, size, detail),
            }
        }
    }

    fn branching(&mut self, draws: &mut Draws, base: Vec3, size: f32, detail: f32) {
        let (foot, tip) = BRANCHES[draws.below(BRANCHES.len())];
        let surface = self.palette.add(Surface::Branch { foot: linear(foot), tip: linear(tip) });
        organisms::branching(self.mesh, draws, base, size, detail, surface);
    }

    fn brain(&mut self, draws: &mut Draws, base: Vec3, size: f32, detail: f32) {
        let (ridge, valley) = BRAINS[draws.below(BRAINS.len())];
        let grooves = Noise::new(draws.bits());
        let surface =
            self.palette.add(Surface::Brain { ridge: linear(ridge), valley: linear(valley), grooves });
        organisms::brain(self.mesh, draws, base, size, detail, surface);
    }

    fn plates(&mut self, draws: &mut Draws, base: Vec3, size: f32, detail: f32) {
        let (middle, rim) = PLATES[draws.below(PLATES.len())];
        let surface = self.palette.add(Surface::Plate { middle: linear(middle), rim: linear(rim) });
        organisms::plates(self.mesh, draws, base, size, detail, surface);
    }

    fn fan(&mut self, draws: &mut Draws, base: Vec3, size: f32, detail: f32) {
        let (foot, tip) = FANS[draws.below(FANS.len())];
        let surface = self.palette.add(Surface::Branch { foot: linear(foot), tip: linear(tip) });
        let facing = Vec2::from_angle(1.57 + draws.about(0.7));
        organisms::fan(self.mesh, draws, base, size, facing, detail, surface);
    }

    fn boulder(&mut self, draws: &mut Draws, base: Vec3, size: f32, detail: f32) {
        let tone = 100 + draws.below(50) as u8;
        let surface = self.palette.stone([tone + 12, tone, tone - 16]);
        organisms::boulder(self.mesh, draws, base, size, 17, detail, surface);
    }

    fn sand(&mut self, count: u64, pebbles: u64) {
        for number in 0..count {
            let draws = &mut Draws::new(self.seed, "sand", number);
            let kind = draws.range(0.0, 1.0);
            let size = match kind {
                k if k < 0.3 => draws.range(0.18, 0.34),
                k if k < 0.62 => draws.range(0.2, 0.65),
                _ => draws.range(0.25, 0.5),
            };
            let Some(base) = self.settle(draws, size, 0.45, |reef| reef < 0.4) else { continue };
            match kind {
                k if k < 0.3 => {
                    let color = linear(STARS[draws.below(STARS.len())]);
                    let surface = self.palette.add(Surface::Starfish { color });
                    organisms::starfish(self.mesh, draws, base, size, self.detail, surface);
                }
                k if k < 0.62 => self.boulder(draws, base, size, self.detail),
                k if k < 0.8 => self.brain(draws, base, size, self.detail),
                _ => self.branching(draws, base, size, self.detail),
            }
        }
        let shades = [[208, 196, 170], [150, 140, 120], [232, 226, 210], [120, 108, 92]]
            .map(|rgb| self.palette.plain(rgb, 0.25));
        for number in 0..pebbles {
            let draws = &mut Draws::new(self.seed, "pebble", number);
            let (at, _) = self.spot(draws);
            let size = draws.range(0.025, 0.09);
            let surface = shades[draws.below(shades.len())];
            let base = at.extend(self.terrain.height(at.x, at.y) - 0.1 * size);
            organisms::boulder(self.mesh, draws, base, size, 4, 1.0, surface);
        }
    }
}
