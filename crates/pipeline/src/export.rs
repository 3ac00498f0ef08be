//! Files of a scene for other 3D Gaussian splatting viewers.
//!
//! The looks of these files are modes of the renderer. The files hold Gaussians and no water, so a look with
//! water is baked into the colours as the cameras saw it, with a sphere of Gaussians for open water behind
//! the scene. The file's header says so (SPZ has no room for text).

use std::path::Path;

use glam::{DMat3, DVec3};
use use3d_capture::{Camera, Frame, World};
use use3d_numerics::math;
use use3d_numerics::order::Ascending;
use use3d_render::white::balanced;
use use3d_render::{InWater, Look, Mode, bake_in_water};
use use3d_scene::white::Gains;
use use3d_scene::{Origin, Scene, similarity};
use use3d_splat::{Gaussians, ply};
use use3d_stages::CAMERAS;
use use3d_web::foreign::{NO_WATER, compressed_ply, glb, spz};

use crate::WorkError;
use crate::baked::{CutOff, cut_off, difference};
use crate::destination::{path_text, write_file};
use crate::scene_page::is_held_out;
use crate::scene_views::placed;

/// A file format of other viewers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GaussianFormat {
    /// The PLY of 3D Gaussian splatting.
    Ply,
    /// The compressed PLY of PlayCanvas and SuperSplat.
    CompressedPly,
    /// glTF with `KHR_gaussian_splatting`.
    Glb,
    /// SPZ of this version.
    Spz(spz::Version),
}

/// The frame of the positions in a file.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum GaussianFrame {
    /// The frame of the COLMAP model, y down.
    #[default]
    Colmap,
    /// The scene's own normalised frame, z up.
    Normalised,
    /// COLMAP's frame turned so that y points up.
    YUp,
    /// Metres along the axes of the capture's world, without a large offset.
    Metric,
}

impl GaussianFrame {
    /// Fails, before anything is computed, if files of the scene in `folder` cannot have this frame.
    ///
    /// # Errors
    /// The scene does not know its metres.
    pub fn check(self, folder: &Path) -> Result<(), WorkError> {
        if self == Self::Metric { world_of(folder).map(drop) } else { Ok(()) }
    }

    /// Its name in the header of a file.
    pub fn name(self) -> &'static str {
        match self {
            Self::Colmap => "colmap",
            Self::Normalised => "normalised",
            Self::YUp => "y-up",
            Self::Metric => "metric",
        }
    }
}

/// The look of the files.
#[derive(Clone, Copy, Debug)]
pub struct ExportLook<'a> {
    /// The mode; `None` for the one with which a page of the scene opens, without the water of a scene that
    /// is not enhanced.
    pub mode: Option<Mode>,
    /// Share of the look's water to keep, 0 to 1.
    pub water: f32,
    /// True if open water is shown by a sphere of Gaussians behind the scene.
    pub backdrop: bool,
    /// The white balance.
    pub gains: Gains,
    /// The cameras through whose water the scene is baked; `None` for those that the scene keeps.
    pub cameras: Option<&'a Path>,
}

impl ExportLook<'_> {
    /// The values of the look that are cut off at white in its cameras, if it is too strong in its scene.
    ///
    /// # Errors
    /// The scene cannot be drawn.
    pub fn cut_off(&self, scene: &Scene, folder: &Path) -> Result<Option<CutOff>, WorkError> {
        let Some(mode) = self.mode.filter(|mode| mode.is_too_strong(scene)) else { return Ok(None) };
        // The look needs no cameras, so a scene without them is exported too.
        let cameras = cameras_of(self.cameras, (scene, folder)).unwrap_or_default().0;
        cut_off(scene, mode, &cameras).map(Some).map_err(WorkError::failed)
    }
}

/// The Gaussians of a scene in the colours of a look, in COLMAP's frame.
pub struct ExportedScene<'a> {
    folder: &'a Path,
    what: &'static str,
    /// The Gaussians, in COLMAP's frame without the offset.
    pub gaussians: Gaussians,
    /// COLMAP's frame without the offset.
    near: Frame,
    /// The offset of a model far from zero, units of the model.
    away: DVec3,
}

/// A file that was written.
#[derive(Clone, Debug)]
pub struct WrittenFile {
    /// Look and frame in words.
    pub about: String,
    /// The unit of its positions: `metres` or `units`.
    pub unit: &'static str,
    /// The offset that its positions lack, if there is one.
    pub offset: Option<[f64; 3]>,
    /// The error that the format's numbers make of most positions, units.
    pub rounding: f64,
    /// The size of the scene without its outer parts, units.
    pub extent: f64,
}

impl<'a> ExportedScene<'a> {
    /// Bakes the scene in `folder`; `tell` gets the errors of the bake in words, if the caller wants them.
    ///
    /// # Errors
    /// The look needs cameras or an enhancement that the scene does not have, or cannot be drawn.
    pub fn bake(
        (scene, folder): (&'a Scene, &'a Path),
        look: &ExportLook<'_>,
        tell: Option<&mut dyn FnMut(String)>,
    ) -> Result<Self, WorkError> {
        let opening = || Some(Mode::opening(scene)).filter(|mode| mode.is_enhanced()).unwrap_or(Mode::Clear);
        let mode = look.mode.unwrap_or_else(opening);
        let gaussians = baked((scene, folder), look, mode, tell)?;
        let gaussians = match mode.gains(&look.gains) {
            Some(gains) => balanced(gaussians, gains),
            None => gaussians,
        };
        let (near, away) = near(&scene.frame, &gaussians);
        let gaussians = similarity::invert(&gaussians, &near);
        Ok(Self { folder, what: mode.name(), gaussians, near, away })
    }

    /// Writes one file, which `flag` names. A PLY has the frame `frame`; the others have their own, with y
    /// up. `made_with` names the program.
    ///
    /// # Errors
    /// The scene does not know its metres, or the file cannot be written.
    pub fn write(
        &self,
        (flag, path): (&str, &Path),
        format: GaussianFormat,
        frame: GaussianFrame,
        made_with: String,
    ) -> Result<WrittenFile, WorkError> {
        // glTF gets y up by a rotation of its node, SPZ by its definition.
        let (stored, frame) = match format {
            GaussianFormat::Ply | GaussianFormat::CompressedPly => (frame, frame),
            GaussianFormat::Glb => (GaussianFrame::Colmap, GaussianFrame::YUp),
            GaussianFormat::Spz(_) => (GaussianFrame::YUp, GaussianFrame::YUp),
        };
        let y_up = DVec3::new(1.0, -1.0, -1.0);
        let (turned, offset) = match stored {
            GaussianFrame::Metric => {
                let (similarity, offset) = metric(self.folder, self.away)?;
                (Some(similarity), offset)
            }
            GaussianFrame::Colmap => (None, self.away),
            GaussianFrame::Normalised => (Some(self.near), DVec3::ZERO),
            GaussianFrame::YUp => {
                let rotation = DMat3::from_diagonal(y_up);
                (Some(Frame { scale: 1.0, rotation, translation: DVec3::ZERO }), self.away * y_up)
            }
        };
        // The node of a glTF turns its positions.
        let offset = if format == GaussianFormat::Glb { offset * y_up } else { offset };
        let turned = turned.map(|frame| similarity::apply(&self.gaussians, &frame));
        let gaussians = turned.as_ref().unwrap_or(&self.gaussians);
        let mut comments =
            vec![made_with, format!("what: {}", self.what), format!("frame: {}", frame.name())];
        let about = comments[1..].join(", ");
        let unit = if frame == GaussianFrame::Metric { "metres" } else { "units" };
        let DVec3 { x, y, z } = offset;
        if offset != DVec3::ZERO {
            comments.push(format!("offset: add {x} {y} {z} {unit} to each position"));
        }
        // The writers of the other formats add this text themselves; SPZ has no room for text.
        if format == GaussianFormat::Ply {
            comments.push(NO_WATER.into());
        }
        write_file(flag, path, |writer| match format {
            GaussianFormat::Ply => ply::write_with_comments(gaussians, &comments, writer),
            GaussianFormat::CompressedPly => compressed_ply::write(gaussians, &comments, writer),
            GaussianFormat::Glb => glb::write(gaussians, &comments.join("; "), HALF_TURN, writer),
            GaussianFormat::Spz(version) => spz::write(gaussians, version, writer),
        })?;
        let (rounding, extent) = (rounding(format, gaussians), middle(gaussians).1);
        let offset = (offset != DVec3::ZERO).then(|| offset.to_array());
        Ok(WrittenFile { about, unit, offset, rounding, extent })
    }
}

/// A model whose middle is this many times its extent from zero loses positions in single precision.
const FAR_EXTENTS: f64 = 1000.0;

/// The middle half of the Gaussians: their median in each axis, and twice the widest range.
fn middle(gaussians: &Gaussians) -> (DVec3, f64) {
    let mut extent = 0.0f64;
    let median = [0, 1, 2].map(|axis| {
        let all = Ascending::of(gaussians.means.iter().map(|mean| mean[axis]));
        let at = |share: f64| all.at(share).map_or(0.0, f64::from);
        extent = extent.max(2.0 * (at(0.75) - at(0.25)));
        at(0.5)
    });
    (DVec3::from_array(median), extent)
}

/// The frame of a model without a large offset, and that offset: positions far from zero do not fit into the
/// numbers of the files. `gaussians` are in the scene's frame.
fn near(frame: &Frame, gaussians: &Gaussians) -> (Frame, DVec3) {
    let (median, extent) = middle(gaussians);
    let (at, extent) = (frame.invert(median), extent / frame.scale);
    if at.abs().max_element() <= FAR_EXTENTS * extent {
        return (*frame, DVec3::ZERO);
    }
    // Multiples of a power of ten keep the offset short.
    let unit = (-9..12).map(|power| math::powi(10.0f64, power)).find(|unit| *unit >= extent).unwrap_or(1.0);
    let offset = (at / unit).round() * unit;
    let translation = frame.translation + frame.scale * (frame.rotation * offset);
    (Frame { translation, ..*frame }, offset)
}

/// The error that a format's numbers make of the positions of most Gaussians, units of the file.
fn rounding(format: GaussianFormat, gaussians: &Gaussians) -> f64 {
    let (at, extent) = middle(gaussians);
    let single = (at.abs().max_element() + extent) * f64::from(f32::EPSILON) / 2.0;
    match format {
        GaussianFormat::Spz(_) => 0.5 * spz::step(gaussians).unwrap_or(0.0),
        GaussianFormat::CompressedPly => single.max(0.5 * compressed_ply::step(gaussians)),
        GaussianFormat::Ply | GaussianFormat::Glb => single,
    }
}

/// Half a turn about x, xyzw: COLMAP's y points down and its z away from the viewer.
const HALF_TURN: [f32; 4] = [1.0, 0.0, 0.0, 0.0];

/// The Gaussians in the colours of a mode, in the scene's frame.
fn baked(
    (scene, folder): (&Scene, &Path),
    look: &ExportLook<'_>,
    mode: Mode,
    tell: Option<&mut dyn FnMut(String)>,
) -> Result<Gaussians, WorkError> {
    let ExportLook { water, backdrop, cameras, .. } = *look;
    let look = if mode.is_enhanced() { Look::Enhanced { strength: 1.0 } } else { Look::Reconstruction };
    let with_water = mode.shows_water() && !scene.medium.is_none() && water > 0.0;
    if !with_water {
        let dry = bake_in_water(scene, look, 0.0, &[]).map_err(WorkError::input)?;
        log_error(&dry);
        return Ok(dry.gaussians);
    }
    let (through, held_out) = cameras_of(cameras, (scene, folder))?;
    let mut wet = bake_in_water(scene, look, water, &through).map_err(WorkError::input)?;
    log_error(&wet);
    if let Some(tell) = tell {
        let apart = |cameras: &[Camera]| -> Result<f64, WorkError> {
            let apart = difference(scene, look, water, &wet, cameras).map_err(WorkError::failed)?;
            tracing::info!(
                "colours of the file and the scene: ΔE00 {:.2}, worst camera {:.2}",
                apart.mean,
                apart.worst
            );
            Ok(apart.mean)
        };
        let unseen = match held_out.len() {
            0 => String::new(),
            _ => format!(", and by {:.1} at the places of those that were kept back", apart(&held_out)?),
        };
        tell(format!(
            "the colours of the file are fixed, as they are seen from the places of {} photographs: there it differs from the \
             scene by {:.1} (ΔE00){unseen}; 1 can just be seen. When you come closer, the file cannot take more water \
             away; view.html can",
            through.len(),
            apart(&through)?
        ));
    }
    if !backdrop {
        let scene_alone: Vec<usize> = (0..wet.gaussians.len() - wet.backdrop).collect();
        wet.gaussians = wet.gaussians.select(&scene_alone);
    }
    Ok(wet.gaussians)
}

/// Logs the error of the spherical harmonics against the exact colours.
fn log_error(baked: &InWater) {
    let report = &baked.report;
    tracing::info!(
        "baked: the colours of {:.2} % of the samples are clamped; mean colour error {:.5}, in clamped samples {:.5}, at \
         most {:.4}",
        100.0 * report.clamped_share,
        report.mean_error,
        report.mean_error_clamped,
        report.max_error
    );
}

/// The cameras for a look with water, in the scene's frame: those through whose water the scene is baked, and
/// the held-out views, at which the file is compared with the scene, too. Held-out views are not baked,
/// unless no other cameras are given.
fn cameras_of(
    given: Option<&Path>,
    (scene, folder): (&Scene, &Path),
) -> Result<(Vec<Camera>, Vec<Camera>), WorkError> {
    let own = folder.join(CAMERAS);
    let place = match given {
        Some(place) => place.to_path_buf(),
        None if own.is_file() => own,
        None => {
            return Err(WorkError::Input(format!(
                "a look with water needs the places of the photographs, and {} has no list of its \
                 cameras; give --cameras CAPTURE, or choose a look without water (--what clear)",
                path_text(folder)
            )));
        }
    };
    let cameras = placed(&place, &scene.frame)?;
    let origin = Origin::read(folder).map_err(WorkError::input)?;
    let (mut through, mut held_out) = (Vec::new(), Vec::new());
    for (name, camera) in cameras {
        if is_held_out(origin.as_ref(), name.stem()) { &mut held_out } else { &mut through }.push(camera);
    }
    if through.is_empty() {
        through.clone_from(&held_out);
    }
    Ok((through, held_out))
}

/// The world of a scene folder, for its metres.
fn world_of(scene: &Path) -> Result<World, WorkError> {
    let world = Scene::world(scene).map_err(WorkError::input)?;
    world.ok_or_else(|| {
        WorkError::Input(format!(
            "--frame metric: {} does not know how long a metre is; measure one length, or give the positions of photographs \
             (docs/guide/metres.md), and run again",
            path_text(scene)
        ))
    })
}

/// Coordinates above this many metres lose millimetres in single precision.
const FAR: f64 = 1000.0;

/// The similarity from COLMAP's frame to metres, without a large offset, and that offset in whole metres.
/// `away` is the place of the positions' zero in COLMAP's frame.
fn metric(scene: &Path, away: DVec3) -> Result<(Frame, DVec3), WorkError> {
    let world = world_of(scene)?;
    let translation = DVec3::from_array(world.apply(away.to_array()));
    let offset = if translation.abs().max_element() > FAR { translation.round() } else { DVec3::ZERO };
    let (scale, rotation) = (world.metres_per_unit, world.rotation());
    let similarity = Frame { scale, rotation, translation: translation - offset };
    Ok((similarity, offset))
}
