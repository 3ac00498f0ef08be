//! `synth capture`: a swim over a reef as a COLMAP project, together with the truth.
//!
//! ```text
//! images/frame_0001.png …      8-bit, through water, with noise
//! sparse/0/*.bin               COLMAP model (arbitrary frame and scale, as after structure from motion)
//! depth/frame_0001.png …       16-bit depth priors: nearer is larger, monotone but not linear in disparity,
//!                              0 is unknown
//! truth/clean/frame_0001.png   J: the same pictures without water and noise; black where there is only water
//! truth/pinhole/frame_0001.png the same as clean, through a pinhole; only with a distorting lens
//! truth/depth/frame_0001.exr   z-depth in COLMAP units, channel Z; 0 where there is only water
//! truth/water.json             coefficients, veiling light, frame, each view's gains (`CaptureTruth`)
//! truth/greys/frame_0001.png … white counts: the inside of grey patches; only if there are boards of greys
//! masks/frame_0001.png …       white counts, 0 is a fish; only if there are fish
//! ```
//!
//! With a distorting [`Optics`] every file has the pixels of the photographs, through the lens, except
//! `truth/pinhole`. Keypoints are distorted pixels, and depths are still along the optical axis.
//!
//! With [`Physics::Spectral`] the photographs follow [`crate::physics`], and `truth/clean` is the scene under
//! white light with one exposure for the whole capture.

use std::path::Path;

use glam::{DMat3, DVec3, Vec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use use3d_capture::{Camera, FileName, Frame, Image, Map};
use use3d_io_colmap::ModelCamera;
use use3d_io_image::{write_exr_map, write_png_map, write_png_map16, write_png8};
use use3d_numerics::math;
use use3d_numerics::random::{Purpose, Stream};
use use3d_survey::Lens;

use crate::error::{Answer, SynthError, whole_folder};
use crate::faults::ChosenFault;
use crate::params::CaptureParams;
use crate::physics::spectral::{Lamps, Spectral};
use crate::physics::{Development, Physics, camera, passers, sideways};
use crate::prior::depth_prior;
use crate::render::{Condition, RayColor, Shot, add_noise, expose, render};
use crate::scene::{Caustics, Draws, Layout, MeshScene, linear};
use crate::sparse::{self, Corner};
use crate::swim;
use crate::water::Water;

/// The truth of a synthetic capture (`truth/water.json`). All values except `*_per_metre` are in COLMAP's
/// frame and unit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CaptureTruth {
    /// The fixed text `"3d-use synthetic capture"`.
    pub format: String,
    /// The version of the format, 1.
    pub version: u32,
    /// The parameters of the capture.
    pub parameters: CaptureParams,
    /// Coefficients per COLMAP unit, and veiling light over ray directions in COLMAP's frame. Absent for
    /// spectral water, which has no such coefficients.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub water: Option<Water>,
    /// `β_attn`, 1/m.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub attenuation_per_metre: Option<[f32; 3]>,
    /// `β_bs`, 1/m.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub backscatter_per_metre: Option<[f32; 3]>,
    /// Spectral water: mean attenuation of white light over the first five metres, per channel of linear
    /// light, 1/m. A model of display values should not find these numbers (its exponent is about 1/2.2 of
    /// them), and they are no constants of the water.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub effective_attenuation_per_metre: Option<[f32; 3]>,
    /// The camera's gains for every view, if it set them automatically.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub gains: Vec<ViewGains>,
    /// COLMAP units per metre.
    pub units_per_metre: f64,
    /// Metres to COLMAP: `x_colmap = units_per_metre R x_metres + t`, R row-major. In the frame of metres, z
    /// is up and the swim runs along y.
    pub rotation: [f64; 9],
    /// `t`, COLMAP units.
    pub translation: [f64; 3],
    /// Colour of the daylight times the exposure, linear.
    pub daylight: [f32; 3],
}

/// The factors by which the camera multiplied a view's linear light.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewGains {
    /// The image's file name.
    pub view: String,
    /// Exposure times white balance: red, green, blue.
    pub gains: [f32; 3],
}

/// Number of views rendered at a time: it bounds memory, and keeps the threads busy while others write files.
const BATCH: usize = 4;

/// An arbitrary frame, as after structure from motion: y roughly down, some tilt, any heading, scale and
/// origin.
fn colmap_frame(seed: u64) -> Frame {
    let stream = Stream::new(seed, Purpose::new("COLMAP frame"), 0);
    let number = |i: u64| 2.0 * stream.uniform(i) - 1.0;
    let y_down = DMat3::from_cols(DVec3::X, DVec3::Z, DVec3::NEG_Y);
    let heading = DMat3::from_rotation_y(std::f64::consts::PI * number(0));
    let tilt = DMat3::from_rotation_x(0.25 * number(1)) * DMat3::from_rotation_z(0.25 * number(2));
    let scale = math::exp(0.5 * number(3)) * 0.6;
    let translation = 1.5 * DVec3::new(number(4), number(5), number(6));
    Frame { scale, rotation: tilt * heading * y_down, translation }
}

/// The medium between the camera and the scene.
enum Between {
    /// The method's own formation, display values.
    Display(Condition),
    /// Spectral transport, and the camera's gains for each view.
    Spectral { water: Box<Spectral>, clean: Box<Spectral>, gains: Vec<Vec3>, middle: f32 },
}

/// All data from which a view is rendered.
struct Studio {
    scene: MeshScene,
    cameras: Vec<Camera>,
    /// The camera of the model.
    camera: ModelCamera,
    /// Its lens, if it is no pinhole.
    lens: Option<Lens>,
    between: Between,
    clean: Condition,
    frame: Frame,
}

impl Studio {
    fn new(params: &CaptureParams) -> Self {
        let layout = Layout {
            place: params.place,
            seed: params.seed,
            detail: params.detail,
            density: 1.0,
            wreck: true,
            greys: params.greys,
            veil: veil_tiles(params),
        };
        let scene = MeshScene::new(&layout);
        let pinhole = swim::lens(params.width, params.height, &mut Draws::new(params.seed, "lens", 0));
        let camera = params.lens.camera(&pinhole, params.seed);
        let lens = camera.lens().filter(|lens| !lens.is_pinhole());
        let pinhole = lens.map_or(pinhole, |lens| lens.intrinsics(params.width, params.height));
        let cameras = swim::path(&scene.terrain, params.seed, params.views, &pinhole);
        let every = params.views.div_ceil(12);
        let some: Vec<Camera> = cameras.iter().copied().step_by(every).collect();
        let (between, light) = match params.physics {
            Physics::Display => {
                let (kind, depth, balance) = (params.water, params.depth, params.white_balance);
                let water = Water::of_type(kind, depth, balance, Vec3::Z, scene.sun());
                let tint = Vec3::from_array(Water::daylight_tint(kind, depth, balance));
                let unexposed = Condition { light: tint, water: Some(water) };
                let light = expose(&scene, &some, &unexposed, 0.41) * tint;
                (Between::Display(Condition { light, water: Some(water) }), light)
            }
            Physics::Spectral => {
                let lamps = (params.lamps > 0.0).then_some(Lamps { strength: params.lamps });
                let mut water = match params.air {
                    true => Spectral::air(scene.sun()),
                    false => Spectral::new(params.water, params.depth, scene.sun(), lamps),
                };
                let reef = params.camera == Development::Action;
                water.reef = reef;
                let water = water.against_light(params.backlight);
                let automatic = camera::Automatic {
                    white_balance: params.white_balance,
                    per_view: params.auto_exposure,
                    seed: params.seed,
                    development: params.camera,
                };
                let look = |camera: &Camera| Box::new(water.seen_from(sideways(camera))) as Box<dyn RayColor>;
                let gains = camera::gains(&scene, &cameras, &look, automatic);
                let middle = camera::middle_gain(&gains);
                // White light, without a veil that brightens the picture.
                let white = Condition { light: Vec3::ONE, water: None };
                let light = Vec3::splat(expose(&scene, &some, &white, 0.36));
                let mut clean = Spectral::air(scene.sun());
                (clean.reef, clean.background) = (reef, Vec3::ZERO);
                (Between::Spectral { water: Box::new(water), clean: Box::new(clean), gains, middle }, light)
            }
        };
        let frame = colmap_frame(params.seed);
        Self { scene, cameras, camera, lens, between, clean: Condition { light, water: None }, frame }
    }

    fn truth(&self, params: &CaptureParams) -> CaptureTruth {
        let (water, effective, gains) = match &self.between {
            Between::Display(condition) => (condition.water, None, Vec::new()),
            Between::Spectral { water, gains, .. } => {
                let (near, far) = (water.white(0.0), water.white(5.0));
                let views = gains.iter().enumerate();
                let gains =
                    views.map(|(view, gains)| ViewGains { view: file(view), gains: gains.to_array() });
                (None, Some(std::array::from_fn(|c| math::ln(near[c] / far[c]) / 5.0)), gains.collect())
            }
        };
        CaptureTruth {
            format: "3d-use synthetic capture".into(),
            version: 1,
            parameters: params.clone(),
            water: water.map(|water| water.in_frame(&self.frame)),
            attenuation_per_metre: water.map(|water| water.attenuation),
            backscatter_per_metre: water.map(|water| water.backscatter),
            effective_attenuation_per_metre: effective,
            gains,
            units_per_metre: self.frame.scale,
            rotation: self.frame.rotation.transpose().to_cols_array(),
            translation: self.frame.translation.to_array(),
            daylight: self.clean.light.to_array(),
        }
    }

    /// A view's photograph and clean picture in display values, its depth, and the mask of fish.
    fn photograph(&self, params: &CaptureParams, view: usize) -> (Shot, Option<Map>) {
        let (camera, lens) = (&self.cameras[view], self.lens.as_ref());
        let caustics = Caustics { strength: params.caustics, time: 0.5 * view as f32 };
        match &self.between {
            Between::Display(underwater) => {
                let mut shot = render(&self.scene, camera, lens, &[underwater, &self.clean], caustics);
                add_noise(&mut shot.images[0], params.noise, params.seed, view as u64);
                (shot, None)
            }
            Between::Spectral { water, clean, gains, middle } => {
                let water = water.seen_from(sideways(camera));
                // The same camera's picture of the scene in air; for the plain camera it is the clean
                // picture.
                let action = params.camera == Development::Action;
                let clean: &dyn RayColor = if action { clean.as_ref() } else { &self.clean };
                let mut shot = render(&self.scene, camera, lens, &[&water, clean], caustics);
                let image = &mut shot.images[0];
                let mut canvas = passers::Canvas { image, depth: &shot.depth, camera, lens, water: &water };
                let mask =
                    (params.fish > 0).then(|| passers::fish(&mut canvas, params.fish, params.seed, view));
                passers::snow(&mut canvas, params.snow, params.seed, view);
                if params.backlight > 0.0 {
                    let sky = shot.depth.data().iter().filter(|z| **z == 0.0).count() as f32;
                    let glare = water.glare(sky / shot.depth.pixels().max(1) as f32);
                    for c in 0..3 {
                        shot.images[0].plane_mut(c).iter_mut().for_each(|v| *v += glare[c]);
                    }
                }
                let settings = camera::Settings {
                    gains: gains[view],
                    middle: *middle,
                    sigma: params.noise,
                    development: params.camera,
                };
                camera::develop(&mut shot.images[0], settings, params.seed, view as u64);
                if action {
                    self.develop_clean(&mut shot.images[1], *middle, params, view);
                }
                (shot, mask)
            }
        }
    }

    /// Develops the picture of the scene in air by an action camera.
    fn develop_clean(&self, image: &mut Image, middle: f32, params: &CaptureParams, view: usize) {
        let (gains, development) = (self.clean.light, params.camera);
        let settings = camera::Settings { gains, middle, sigma: 0.0, development };
        camera::develop(image, settings, params.seed, view as u64);
    }

    /// A view's clean picture through the pinhole with the focal lengths and the principal point of the lens.
    fn straight(&self, params: &CaptureParams, view: usize) -> Option<Image> {
        let camera = &self.cameras[view];
        let caustics = Caustics { strength: params.caustics, time: 0.5 * view as f32 };
        let action = params.camera == Development::Action;
        match &self.between {
            Between::Spectral { clean, middle, .. } if action => {
                let mut image =
                    render(&self.scene, camera, None, &[clean.as_ref()], caustics).images.pop()?;
                self.develop_clean(&mut image, *middle, params, view);
                Some(image)
            }
            _ => render(&self.scene, camera, None, &[&self.clean], caustics).images.pop(),
        }
    }

    /// A map with 1 where a grey patch fills a pixel and all its neighbours.
    fn greys(&self, shot: &Shot) -> Map {
        let (w, h) = (shot.depth.width(), shot.depth.height());
        let mut map = Map::new(w, h);
        for y in 1..h.saturating_sub(1) {
            for x in 1..w.saturating_sub(1) {
                let here = shot.surfaces[y * w + x];
                let alike = |i: usize| shot.surfaces[(y + i / 3 - 1) * w + x + i % 3 - 1] == here;
                if self.scene.is_grey(here) && (0..9).all(alike) {
                    map.set_pixel(x, y, [1.0]);
                }
            }
        }
        map
    }

    /// Renders and writes one view, and returns the corners for the sparse points.
    fn shoot(&self, params: &CaptureParams, view: usize, dir: &Path) -> Result<Vec<Corner>, SynthError> {
        let stem = stem(view);
        let (shot, mask) = self.photograph(params, view);
        let picture = shot.images[0].to_8bit();
        write_png8(&dir.join(format!("images/{stem}.png")), &picture)?;
        write_png8(&dir.join(format!("truth/clean/{stem}.png")), &shot.images[1].to_8bit())?;
        if let Some(straight) = self.lens.and_then(|_| self.straight(params, view)) {
            write_png8(&dir.join(format!("truth/pinhole/{stem}.png")), &straight.to_8bit())?;
        }
        let scale = self.frame.scale as f32;
        let depth = shot.depth.map(|z| scale * z);
        write_exr_map(&dir.join(format!("truth/depth/{stem}.exr")), &depth, "Z")?;
        if params.greys {
            let greys = self.greys(&shot);
            write_png_map(&dir.join(format!("truth/greys/{stem}.png")), &greys)?;
        }
        if params.depth_priors {
            let prior = depth_prior(&shot.depth, params.seed, view);
            write_png_map16(&dir.join(format!("depth/{stem}.png")), &prior)?;
        }
        // No feature is detected on a fish.
        let mut surfaces = shot.depth;
        if let Some(mask) = &mask {
            write_png_map(&dir.join(format!("masks/{stem}.png")), mask)?;
            let hidden = surfaces.data_mut().iter_mut().zip(mask.data()).filter(|(_, kept)| **kept == 0.0);
            hidden.for_each(|(z, _)| *z = 0.0);
        }
        let wanted = (2 * params.points).div_ceil(params.views);
        Ok(sparse::corners(&picture, &surfaces, params.seed, view, wanted))
    }
}

/// The colour of tiles that look like open water, linear.
fn veil_tiles(params: &CaptureParams) -> Vec3 {
    let water = Water::of_type(params.water, params.depth, params.white_balance, Vec3::Z, Vec3::Z);
    linear(water.veil.map(|v| (255.0 * v.clamp(0.0, 1.0)).round() as u8))
}

fn stem(view: usize) -> String {
    format!("frame_{:04}", view + 1)
}

fn file(view: usize) -> String {
    format!("{}.png", stem(view))
}

/// Writes a synthetic capture to `out`, a folder that must not exist (or be empty). `progress` is called with
/// the number of finished views and the total; its result can stop the work.
///
/// # Errors
/// Fails for a parameter out of range, an output that exists, a file that cannot be written, or a stop
/// requested by `progress`. Then no output is left.
pub fn write_capture<A: Answer>(
    params: &CaptureParams,
    out: &Path,
    progress: &mut dyn FnMut(usize, usize) -> A,
) -> Result<CaptureTruth, SynthError> {
    write_faulty_capture(params, None, out, progress)
}

/// Writes a synthetic capture as [`write_capture`] does, with a fault in it.
///
/// # Errors
/// As [`write_capture`].
pub fn write_faulty_capture<A: Answer>(
    params: &CaptureParams,
    fault: Option<ChosenFault>,
    out: &Path,
    progress: &mut dyn FnMut(usize, usize) -> A,
) -> Result<CaptureTruth, SynthError> {
    params.validate()?;
    whole_folder(out, |dir| {
        let truth = fill(params, dir, progress)?;
        fault.map_or(Ok(()), |fault| fault.spoil(dir, params.seed))?;
        Ok(truth)
    })
}

/// Writes a capture into an empty folder.
fn fill<A: Answer>(
    params: &CaptureParams,
    dir: &Path,
    progress: &mut dyn FnMut(usize, usize) -> A,
) -> Result<CaptureTruth, SynthError> {
    let studio = Studio::new(params);
    tracing::debug!(triangles = studio.scene.mesh.triangles.len(), "built the scene");
    let mut corners = Vec::with_capacity(params.views);
    progress(0, params.views).go_on()?;
    while corners.len() < params.views {
        let batch = corners.len()..(corners.len() + BATCH).min(params.views);
        let shot: Vec<_> = batch.into_par_iter().map(|view| studio.shoot(params, view, dir)).collect();
        for list in shot {
            corners.push(list?);
        }
        progress(corners.len(), params.views).go_on()?;
    }
    let names: Vec<FileName> =
        (0..params.views).map(|i| FileName::new(&file(i))).collect::<Result<_, _>>()?;
    let Studio { scene, cameras, lens, frame, .. } = &studio;
    let swimmer = sparse::Swimmer { scene, cameras, lens: lens.as_ref() };
    let mut model = sparse::model(&swimmer, &studio.camera, &names, frame, &corners, params.seed);
    sparse::keep(&mut model, params.points);
    let folder = dir.join("sparse/0");
    std::fs::create_dir_all(&folder).map_err(SynthError::io(&folder))?;
    use3d_io_colmap::write_model_binary(&folder, &model)?;
    let truth = studio.truth(params);
    let path = dir.join("truth/water.json");
    let text = serde_json::to_string_pretty(&truth).map_err(std::io::Error::other);
    text.and_then(|text| std::fs::write(&path, text + "\n")).map_err(SynthError::io(&path))?;
    Ok(truth)
}

#[cfg(test)]
mod tests;
