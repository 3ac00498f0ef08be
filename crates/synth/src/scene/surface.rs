//! The appearance of surfaces: albedo (linear light) and bumps, as procedural textures limited to the
//! resolution of a pixel.

use glam::{Vec2, Vec3};
use use3d_numerics::math;

use super::organisms::groove;
use super::terrain::Ripples;
use crate::geometry::noise::{Noise, resolvable, smooth_step};

/// A material. Colours are linear reflectances.
#[derive(Clone, Debug)]
pub(crate) enum Surface {
    /// The sea floor; first parameter 0 on sand, 1 on reef.
    Ground { sand: Vec3, rock: Vec3, algae: Vec3, crust: Vec3, ripples: Ripples },
    /// One colour with some grain.
    Plain { color: Vec3, grain: f32 },
    /// A grey patch, given by its reflectance.
    Grey { value: f32 },
    /// Stone, clay or concrete with algae on it.
    Stone { color: Vec3 },
    /// Old planks; first parameter runs along the grain, metres.
    Wood,
    /// Rusty steel.
    Metal,
    /// Three strands; parameters are angle over 2π and length, metres.
    Rope,
    /// Brain coral.
    Brain { ridge: Vec3, valley: Vec3, grooves: Noise },
    /// Staghorn coral and sea fans; second parameter 0 at the foot, 1 at the tips.
    Branch { foot: Vec3, tip: Vec3 },
    /// Plate coral; first parameter 0 in the middle, 1 at the rim.
    Plate { middle: Vec3, rim: Vec3 },
    /// Sponge; second parameter above 1 inside the pipe.
    Sponge { outside: Vec3 },
    /// Starfish; first parameter 0 in the middle, 1 at the arms' ends.
    Starfish { color: Vec3 },
    /// Glazed square tiles of `side` metres with light joints; parameters are metres along the wall. A dark
    /// line of half width `line` runs where the first parameter is 0.
    Tiles { color: Vec3, side: f32, line: f32 },
}

/// Linear light from an sRGB byte triple.
pub(crate) fn linear(rgb: [u8; 3]) -> Vec3 {
    let decode = |v: u8| {
        let v = f32::from(v) / 255.0;
        if v <= 0.04045 { v / 12.92 } else { math::powf((v + 0.055) / 1.055, 2.4) }
    };
    Vec3::from_array(rgb.map(decode))
}

/// Display value (sRGB) from linear light, with a soft shoulder instead of a clip: values stay below 1.
pub(crate) fn display(light: Vec3) -> Vec3 {
    let encode = |x: f32| {
        let x = if x < 0.75 { x } else { 0.75 + 0.25 * (1.0 - math::exp(-(x - 0.75) / 0.25)) };
        if x <= 0.003_130_8 { 12.92 * x.max(0.0) } else { 1.055 * math::powf(x, 1.0 / 2.4) - 0.055 }
    };
    Vec3::from_array(light.to_array().map(encode))
}

/// The surfaces of a scene, by index.
#[derive(Clone, Debug, Default)]
pub(crate) struct Palette {
    pub(crate) surfaces: Vec<Surface>,
}

impl Palette {
    pub(crate) fn add(&mut self, surface: Surface) -> u16 {
        self.surfaces.push(surface);
        self.surfaces.len() as u16 - 1
    }

    pub(crate) fn plain(&mut self, rgb: [u8; 3], grain: f32) -> u16 {
        self.add(Surface::Plain { color: linear(rgb), grain })
    }

    pub(crate) fn stone(&mut self, rgb: [u8; 3]) -> u16 {
        self.add(Surface::Stone { color: linear(rgb) })
    }
}

impl Surface {
    /// Albedo and bump gradient at a point. `footprint` is the size of a pixel at the point, metres. The bump
    /// is the gradient of a height above the surface; the shader tilts the normal against it.
    pub(crate) fn look(&self, noise: Noise, p: Vec3, parameter: Vec2, footprint: f32) -> (Vec3, Vec3) {
        match self {
            Self::Ground { sand, rock, algae, crust, ripples } => {
                let (ragged, _) = noise.octaves(p, 2.6, 3, footprint);
                let reef = smooth_step(0.16, 0.34, parameter.x + 0.3 * ragged);
                let (fine, slope) = noise.octaves(p, 11.0, 3, footprint);
                if reef <= 0.0 {
                    let grains = noise.octaves(p, 90.0, 2, footprint).0;
                    let broad = noise.value(0.8 * p);
                    let litter = smooth_step(0.42, 0.62, noise.octaves(p, 21.0, 2, footprint).0);
                    let tone = 1.0 + 0.16 * grains + 0.08 * fine + 0.12 * broad - 0.35 * litter;
                    let keep = resolvable(ripples.frequency(), footprint);
                    let (height, across) = if keep > 0.0 {
                        let flat = Vec3::new(p.x, p.y, 0.0);
                        let (height, across) = ripples.at(flat);
                        (keep * height, keep * across)
                    } else {
                        (0.0, Vec3::ZERO)
                    };
                    // Dark grains collect in the troughs.
                    let trough = 1.0 + 9.0 * height.min(0.0);
                    return (*sand * (tone * trough).max(0.2), 0.004 * slope + 1.3 * across);
                }
                let patches = noise.octaves(p + Vec3::splat(40.0), 1.5, 4, footprint).0;
                let spots = noise.octaves(p + Vec3::splat(80.0), 4.3, 3, footprint).0;
                let mut color = rock.lerp(*algae, smooth_step(-0.15, 0.25, patches));
                color = color.lerp(*crust, 0.85 * smooth_step(0.16, 0.34, spots));
                color *= (0.85 + 0.55 * fine).max(0.25);
                let tone = 1.0 + 0.10 * fine;
                (sand.lerp(color, reef) * tone, slope * (0.004 + 0.014 * reef))
            }
            Self::Plain { color, grain } => {
                let tone = 1.0 + grain * noise.octaves(p, 40.0, 3, footprint).0;
                (*color * tone.max(0.1), Vec3::ZERO)
            }
            Self::Grey { value } => (Vec3::splat(*value), Vec3::ZERO),
            Self::Stone { color } => {
                let (fine, slope) = noise.octaves(p, 9.0, 4, footprint);
                let growth = noise.octaves(p + Vec3::splat(20.0), 2.7, 4, footprint).0;
                let algae = linear([96, 104, 62]);
                let pink = linear([168, 98, 120]);
                let mut albedo = color.lerp(algae, 0.75 * smooth_step(0.05, 0.4, growth));
                albedo = albedo.lerp(pink, 0.7 * smooth_step(0.2, 0.45, -growth));
                (albedo * (0.9 + 0.5 * fine).max(0.2), 0.013 * slope)
            }
            Self::Wood => {
                let along = Vec3::new(1.2 * parameter.x, 9.0 * parameter.y, 0.4 * p.z);
                let grain = noise.octaves(along, 3.0, 4, 3.0 * footprint).0;
                let growth = noise.octaves(p, 3.1, 4, footprint).0;
                let (_, slope) = noise.octaves(p, 16.0, 3, footprint);
                let mut albedo = linear([112, 86, 60]) * (1.0 + 0.55 * grain).max(0.2);
                albedo = albedo.lerp(linear([104, 118, 66]), 0.8 * smooth_step(0.0, 0.4, growth));
                albedo = albedo.lerp(linear([186, 110, 96]), 0.8 * smooth_step(0.18, 0.42, -growth));
                (albedo, 0.008 * slope)
            }
            Self::Metal => {
                let (rust, slope) = noise.octaves(p, 6.0, 5, footprint);
                let patches = noise.octaves(p + Vec3::splat(11.0), 2.2, 3, footprint).0;
                let mut albedo =
                    linear([92, 88, 84]).lerp(linear([158, 84, 44]), smooth_step(-0.3, 0.35, rust));
                albedo = albedo.lerp(linear([112, 124, 74]), 0.7 * smooth_step(0.1, 0.45, patches));
                (albedo, 0.006 * slope)
            }
            Self::Rope => {
                let strand = math::cos(3.0 * std::f32::consts::TAU * parameter.x - 70.0 * parameter.y);
                let keep = resolvable(11.0, footprint);
                let fibre = noise.octaves(p, 60.0, 2, footprint).0;
                let tone = 0.82 + keep * 0.25 * strand + 0.2 * fibre;
                let marker = smooth_step(0.46, 0.48, (parameter.y / 0.9).fract())
                    * smooth_step(0.66, 0.64, (parameter.y / 0.9).fract());
                let color = linear([232, 196, 92]).lerp(linear([196, 62, 44]), 0.9 * marker);
                (color * tone.max(0.2), Vec3::ZERO)
            }
            Self::Brain { ridge, valley, grooves } => {
                let keep = resolvable(26.0, footprint);
                let (depth, slope) = groove(*grooves, p);
                let high = smooth_step(0.02, 0.24, depth);
                let broad = 1.0 + 0.25 * noise.octaves(p, 3.0, 3, footprint).0;
                // If the grooves cannot be resolved, their mean colour is used.
                (
                    valley.lerp(*ridge, keep * high + (1.0 - keep) * 0.55) * broad,
                    keep * 0.02 * (1.0 - high) * slope,
                )
            }
            Self::Branch { foot, tip } => {
                let t = parameter.y;
                let blotch = noise.octaves(p, 24.0, 3, footprint).0;
                let body = *foot * (0.7 + 0.45 * t + 0.28 * blotch).max(0.2);
                let (_, slope) = noise.octaves(p, 70.0, 1, footprint);
                (body.lerp(*tip, smooth_step(0.62, 1.0, t)), 0.0025 * slope)
            }
            Self::Plate { middle, rim } => {
                let (knobs, slope) = noise.octaves(p, 48.0, 2, footprint);
                let broad = noise.octaves(p, 4.0, 2, footprint).0;
                let edge = smooth_step(0.72, 1.0, parameter.x + 0.08 * broad);
                (middle.lerp(*rim, edge) * (1.0 + 0.3 * knobs + 0.15 * broad).max(0.2), 0.006 * slope)
            }
            Self::Sponge { outside } => {
                let inside = smooth_step(1.0, 1.25, parameter.y);
                let (pores, slope) = noise.octaves(p, 30.0, 3, footprint);
                let rim = 1.0 + 0.35 * smooth_step(0.8, 1.0, parameter.y) * (1.0 - inside);
                let color = *outside * rim * (1.0 + 0.3 * pores).max(0.2);
                (color * (1.0 - 0.8 * inside), 0.008 * slope)
            }
            Self::Starfish { color } => {
                let (dots, slope) = noise.octaves(p, 70.0, 2, footprint);
                let tone = 1.0 + 0.3 * dots - 0.25 * parameter.x;
                (*color * tone.max(0.2), 0.003 * slope)
            }
            Self::Tiles { color, side, line } => {
                let at = parameter / *side;
                let tile = at.floor();
                // Half a joint's width, as a share of a tile; joints that cannot be resolved are replaced by
                // their mean colour.
                let (joint, keep) = (0.012, resolvable(1.0 / side, footprint));
                let off = (at - tile - Vec2::splat(0.5)).abs().max_element();
                let edge = (footprint / side).max(0.002);
                let share = smooth_step(0.5 - joint - edge, 0.5 - joint + edge, off);
                let share = keep * share + (1.0 - keep) * 4.0 * joint;
                let tone = 1.0 + 0.05 * keep * noise.value(7.3 * tile.extend(*side) + Vec3::splat(5.1));
                let dark = *line > 0.0 && parameter.x.abs() < *line;
                let glaze = if dark { linear([44, 62, 110]) } else { *color };
                ((glaze * tone).lerp(linear([206, 212, 208]), share), Vec3::ZERO)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn display_inverts_linear_below_the_shoulder_and_stays_below_one() {
        for v in [0u8, 3, 40, 128, 200] {
            let back = display(linear([v; 3])).x * 255.0;
            assert!((back - f32::from(v)).abs() < 0.01, "{v} became {back}");
        }
        assert!(display(Vec3::splat(50.0)).max_element() <= 1.0);
    }
}
