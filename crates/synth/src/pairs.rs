//! `synth pairs`: the same picture through a body of water and in its desired appearance.
//!
//! `input/pair_0001.png` is taken through one of Jerlov's waters at some depth. `reference/pair_0001.png` is
//! the same view in neutral daylight through very clear water, well exposed, with a little more contrast and
//! colour. It defines the meaning of "enhanced" for a calibrator that is trained on these pairs. With
//! [`Physics::Spectral`] inputs follow [`crate::physics`] instead, and the camera chooses its settings for
//! each of them. Pairs cycle through the water types; each dozen shares a scene.

use std::path::Path;

use glam::Vec3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_capture::Image;
use use3d_io_image::write_png;
use use3d_numerics::range::{OutOfRange, within};

use crate::error::{Answer, SynthError, check, whole_folder};
use crate::physics::camera::{self as develop, Automatic};
use crate::physics::spectral::Spectral;
use crate::physics::{Development, Physics, sideways};
use crate::render::{Condition, add_noise, expose, render};
use crate::scene::{Caustics, Draws, Layout, Location, MeshScene};
use crate::swim;
use crate::water::{Water, WaterType};

/// The number of pairs and their properties.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PairsParams {
    /// The seed of all random numbers. Not read from settings: the caller sets it.
    #[serde(skip)]
    pub seed: u64,
    /// Number of pairs, at least 1.
    pub pairs: usize,
    /// Image width, pixels, 16 to 8192.
    pub width: usize,
    /// Image height, pixels, 16 to 8192.
    pub height: usize,
    /// Sensor noise of a middle tone in the inputs, standard deviation in display range, 0 to 0.2.
    pub noise: f32,
    /// Triangle density of the scenes, 0.1 to 1.
    pub detail: f32,
    /// The image formation of the inputs; `spectral` has a camera that exposes and balances every picture
    /// separately.
    #[serde(skip_serializing_if = "crate::params::is_default")]
    pub physics: Physics,
}

impl Default for PairsParams {
    fn default() -> Self {
        Self {
            seed: 42,
            pairs: 96,
            width: 320,
            height: 240,
            noise: 0.008,
            detail: 0.55,
            physics: Physics::Display,
        }
    }
}

impl PairsParams {
    /// Checks every range.
    pub fn validate(&self) -> Result<(), OutOfRange> {
        within("pairs", self.pairs, 1, 100_000)?;
        for (field, side) in [("width", self.width), ("height", self.height)] {
            check(field, side, (16..=8192).contains(&side), "16 to 8192 pixels")?;
        }
        within("noise", self.noise, 0.0, 0.2)?;
        within("detail", self.detail, 0.1, 1.0)
    }
}

/// Number of pairs that share a scene.
const PER_SCENE: usize = 12;

/// The water of the references, which is almost invisible.
fn clear_water(sun: Vec3) -> Water {
    Water {
        attenuation: [0.030, 0.016, 0.014],
        backscatter: [0.045, 0.050, 0.055],
        veil: [0.36, 0.60, 0.72],
        ..Water::of_type(WaterType::I, 5.0, 1.0, Vec3::Z, sun)
    }
}

/// Adds a little contrast (around the middle) and colour, within display range.
fn grade(image: &mut Image) {
    let n = image.pixels();
    for p in 0..n {
        let rgb: [f32; 3] = std::array::from_fn(|c| image.data()[c * n + p].clamp(0.0, 1.0));
        let luminance = 0.299 * rgb[0] + 0.587 * rgb[1] + 0.114 * rgb[2];
        for (c, v) in rgb.into_iter().enumerate() {
            let v = (luminance + 1.12 * (v - luminance)).clamp(0.0, 1.0);
            let curve = v * v * (3.0 - 2.0 * v);
            image.data_mut()[c * n + p] = v + 0.25 * (curve - v);
        }
    }
}

/// Writes `input/` and `reference/` with equal file names to `out`, a folder that must not exist (or be
/// empty). `progress` is called with the number of finished pairs and the total; its result can stop the
/// work.
///
/// # Errors
/// Fails for a parameter out of range, an output that exists, a file that cannot be written, or a stop
/// requested by `progress`. Then no output is left.
pub fn write_pairs<A: Answer>(
    params: &PairsParams,
    out: &Path,
    progress: &mut dyn FnMut(usize, usize) -> A,
) -> Result<(), SynthError> {
    params.validate()?;
    whole_folder(out, |dir| {
        progress(0, params.pairs).go_on()?;
        let mut done = 0;
        for number in 0..params.pairs.div_ceil(PER_SCENE) {
            let mut draws = Draws::new(params.seed, "pair scene", number as u64);
            let layout = Layout {
                place: Location::Reef,
                seed: u64::from(draws.bits()),
                detail: params.detail,
                density: draws.range(0.5, 1.1),
                wreck: draws.below(2) == 0,
                greys: false,
                veil: Vec3::ZERO,
            };
            let scene = MeshScene::new(&layout);
            for pair in number * PER_SCENE..((number + 1) * PER_SCENE).min(params.pairs) {
                write_pair(params, &scene, pair, dir)?;
                done += 1;
                progress(done, params.pairs).go_on()?;
            }
        }
        Ok(())
    })
}

fn write_pair(params: &PairsParams, scene: &MeshScene, pair: usize, dir: &Path) -> Result<(), SynthError> {
    let mut draws = Draws::new(params.seed, "pair", pair as u64);
    let kind = WaterType::ALL[pair % WaterType::ALL.len()];
    let depth = draws.range(2.0, 16.0);
    let white_balance = draws.range(0.25, 0.95);
    let water = Water::of_type(kind, depth, white_balance, Vec3::Z, scene.sun());
    // In turbid water, objects are photographed from near.
    let nearness = (2.0 * water.backscatter[1]).min(1.0);
    let lens = swim::lens(params.width, params.height, &mut draws);
    let camera = swim::snapshot(&scene.terrain, &mut draws, &lens, nearness);
    let lit = |tint: Vec3, water: Water, luminance: f32| {
        let unexposed = Condition { light: tint, water: Some(water) };
        Condition { light: expose(scene, &[camera], &unexposed, luminance) * tint, ..unexposed }
    };
    let wished = lit(Vec3::ONE, clear_water(scene.sun()), 0.45);
    let mut shot = match params.physics {
        Physics::Display => {
            let tint = Vec3::from_array(Water::daylight_tint(kind, depth, white_balance));
            let seen = lit(tint, water, draws.range(0.28, 0.44));
            let mut shot = render(scene, &camera, None, &[&seen, &wished], Caustics::OFF);
            add_noise(&mut shot.images[0], params.noise, params.seed, pair as u64);
            shot
        }
        Physics::Spectral => {
            let water = Spectral::new(kind, depth, scene.sun(), None).seen_from(sideways(&camera));
            let automatic = Automatic {
                white_balance,
                per_view: 1.0,
                seed: params.seed ^ pair as u64,
                development: Development::Plain,
            };
            let gains = develop::gains(scene, &[camera], &|_| Box::new(water), automatic);
            let mut shot = render(scene, &camera, None, &[&water, &wished], Caustics::OFF);
            let (middle, image) = (develop::middle_gain(&gains), &mut shot.images[0]);
            let (gains, sigma, development) = (gains[0], params.noise, automatic.development);
            let settings = develop::Settings { gains, middle, sigma, development };
            develop::develop(image, settings, params.seed, pair as u64);
            shot
        }
    };
    grade(&mut shot.images[1]);
    let name = format!("pair_{:04}.png", pair + 1);
    write_png(&dir.join("input").join(&name), &shot.images[0])?;
    write_png(&dir.join("reference").join(&name), &shot.images[1])?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::ops::ControlFlow;

    use super::*;

    #[test]
    fn a_stop_is_heard_and_leaves_nothing_behind() {
        let params = PairsParams { pairs: 3, width: 48, height: 36, detail: 0.12, ..PairsParams::default() };
        let dir = tempfile::tempdir().unwrap();
        let mut told = 0;
        let result = write_pairs(&params, &dir.path().join("out"), &mut |done, _| {
            told = done;
            if done == 1 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        });
        assert!(matches!(result, Err(SynthError::Interrupted)) && told == 1, "{result:?} after {told}");
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
    }

    #[test]
    fn pairs_of_the_other_physics_are_other_pairs_of_the_same_views() {
        let small = PairsParams { pairs: 2, width: 48, height: 36, detail: 0.12, ..PairsParams::default() };
        let dir = tempfile::tempdir().unwrap();
        let mut made = Vec::new();
        for physics in Physics::ALL {
            let out = dir.path().join(physics.name());
            write_pairs(&PairsParams { physics, ..small.clone() }, &out, &mut |_, _| ()).unwrap();
            made.push(
                ["input", "reference"].map(|f| std::fs::read(out.join(f).join("pair_0002.png")).unwrap()),
            );
        }
        assert_ne!(made[0][0], made[1][0]);
        assert_eq!(made[0][1], made[1][1], "what is wished for is the same");
    }

    #[test]
    fn pairs_are_deterministic_and_the_input_is_duller_than_its_reference() {
        let params = PairsParams { pairs: 3, width: 48, height: 36, detail: 0.12, ..PairsParams::default() };
        let dir = tempfile::tempdir().unwrap();
        let write = |name: &str, threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let out = dir.path().join(name);
            let mut steps = Vec::new();
            pool.install(|| write_pairs(&params, &out, &mut |done, _| steps.push(done))).unwrap();
            assert_eq!(steps, [0, 1, 2, 3]);
            out
        };
        let (a, b) = (write("a", 1), write("b", 3));
        for i in 1..=3 {
            let file = |root: &Path, folder: &str| root.join(folder).join(format!("pair_{i:04}.png"));
            for folder in ["input", "reference"] {
                let bytes = |root: &Path| std::fs::read(file(root, folder)).unwrap();
                assert_eq!(bytes(&a), bytes(&b));
            }
            let red = |folder: &str| {
                let image = use3d_io_image::read_image(&file(&a, folder)).unwrap();
                let n = image.pixels() as f32;
                (image.plane(0).iter().sum::<f32>() / n, image.data().iter().sum::<f32>() / (3.0 * n))
            };
            let (input, reference) = (red("input"), red("reference"));
            assert!(input.0 / input.1 < reference.0 / reference.1, "{input:?} {reference:?}");
        }
    }
}
