//! Writes a scene as a page for a browser, and as files for other 3D Gaussian splatting viewers.
//!
//! The looks of these files have the names of `use3d render`'s modes. The files hold Gaussians and no water,
//! so a look with water is baked into the colours as the cameras saw it, with a sphere of Gaussians for open
//! water behind the scene. The file's header says so (SPZ has no room for text).

use std::path::Path;

use clap::ValueEnum;
use glam::{DMat3, DVec3};
use use3d_capture::{Camera, Frame};
use use3d_pipeline::baked::difference;
use use3d_pipeline::scene_page::is_held_out;
use use3d_pipeline::scene_views::placed;
use use3d_render::white::balanced;
use use3d_render::{InWater, Look, Mode, bake_in_water};
use use3d_scene::white::Gains;
use use3d_scene::{Origin, Scene, similarity};
use use3d_splat::{Gaussians, ply};
use use3d_stages::CAMERAS;
use use3d_web::foreign::{NO_WATER, compressed_ply, glb, spz};
use use3d_workflow::machine::bytes;

use crate::App;
use crate::args::{ExportArgs, ExportFrame, ExportWhat};
use crate::error::{Done, WorkError};
use crate::interrupt::ends_soon;
use crate::verbs::{web, white};
use use3d_pipeline::destination::{check_file, path_text, write_file};
use use3d_pipeline::found::capture_in;

pub(crate) fn run(app: &App, args: &ExportArgs) -> Done {
    for OutputFile { flag, extension, path, .. } in files(args) {
        check_file(flag, path, args.replace.force, &[extension])?;
    }
    if let Some(path) = &args.web {
        web::check_metres(args.metres_per_unit)?;
        check_file("--web", path, args.replace.force, &["html"])?;
    }
    if args.web.is_none() && files(args).next().is_none() {
        return Err(WorkError::input(
            "choose an output: --web FILE.html, --ply FILE, --compressed-ply FILE, --glb FILE or --spz FILE",
        ));
    }
    if !(0.0..=1.0).contains(&args.water) {
        return Err(WorkError::Input(format!("--water {}: expected 0 to 1", args.water)));
    }
    if let Some(frame) = &args.frame
        && args.ply.is_none()
        && args.compressed_ply.is_none()
    {
        return Err(WorkError::Input(format!(
            "--frame {}: only a PLY has a choice of frames (GLB and SPZ have y up, in units of the model); leave it out, \
             or write a PLY",
            name(frame)
        )));
    }
    let _ends_soon = ends_soon();
    let cameras = args.cameras.clone().or_else(|| capture_in(&args.scene));
    let args = &ExportArgs { scene: app.scene_in(&args.scene)?, cameras, ..args.clone() };
    let scene = Scene::load(&args.scene).map_err(WorkError::input)?;
    let white = white::of(app, &args.white, &args.scene, &scene, args.cameras.as_deref())?;
    if let Some(path) = &args.web {
        web::write(app, args, path, &scene, white.as_ref())?;
    }
    if files(args).next().is_none() {
        return Ok(());
    }
    let (what, gaussians) = baked(app, args, &scene)?;
    let gains = white.map_or(Gains::ONE, |white| white.gains);
    let gaussians = match Mode::from_name(&what).and_then(|mode| mode.gains(&gains)) {
        Some(gains) => balanced(gaussians, gains),
        None => gaussians,
    };
    let gaussians = similarity::invert(&gaussians, &scene.frame);
    files(args).try_for_each(|file| write(app, args, &file, (&what, &gaussians), &scene))
}

/// A file for other viewers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Format {
    Ply,
    CompressedPly,
    Glb,
    Spz,
}

/// A requested file besides the page.
struct OutputFile<'a> {
    format: Format,
    flag: &'static str,
    extension: &'static str,
    path: &'a Path,
}

/// The requested files besides the page.
fn files(args: &ExportArgs) -> impl Iterator<Item = OutputFile<'_>> {
    let all = [
        (Format::Ply, "--ply", "ply", &args.ply),
        (Format::CompressedPly, "--compressed-ply", "ply", &args.compressed_ply),
        (Format::Glb, "--glb", "glb", &args.glb),
        (Format::Spz, "--spz", "spz", &args.spz),
    ];
    all.into_iter().filter_map(|(format, flag, extension, path)| {
        Some(OutputFile { format, flag, extension, path: path.as_deref()? })
    })
}

/// The look with which a page of the scene opens; without its water if the scene is not enhanced.
fn opening_look(scene: &Scene) -> ExportWhat {
    match Mode::opening(scene) {
        Mode::Enhanced => ExportWhat::Enhanced,
        Mode::EnhancedClear => ExportWhat::EnhancedClear,
        _ => ExportWhat::Clear,
    }
}

/// The Gaussians in the colours of the look, with the look's name.
fn baked(app: &App, args: &ExportArgs, scene: &Scene) -> Result<(String, Gaussians), WorkError> {
    let what = args.what.unwrap_or_else(|| opening_look(scene));
    let look = match what {
        ExportWhat::Reconstruction | ExportWhat::Clear => Look::Reconstruction,
        ExportWhat::Enhanced | ExportWhat::EnhancedClear => Look::Enhanced { strength: 1.0 },
    };
    let with_water = matches!(what, ExportWhat::Reconstruction | ExportWhat::Enhanced)
        && !scene.medium.is_none()
        && args.water > 0.0;
    if !with_water {
        let dry = bake_in_water(scene, look, 0.0, &[]).map_err(WorkError::input)?;
        said(app, &dry);
        return Ok((name(&what), dry.gaussians));
    }
    let (through, held_out) = cameras(args, scene)?;
    let mut wet = bake_in_water(scene, look, args.water, &through).map_err(WorkError::input)?;
    said(app, &wet);
    if !app.quiet {
        let apart = |cameras: &[Camera]| -> Result<String, WorkError> {
            let apart = difference(scene, look, args.water, &wet, cameras).map_err(WorkError::failed)?;
            Ok(format!("ΔE00 {:.2} on average ({:.2} at the worst camera)", apart.mean, apart.worst))
        };
        let unseen = match held_out.len() {
            0 => String::new(),
            n => format!("; at {n} held-out views by {}", apart(&held_out)?),
        };
        eprintln!(
            "the look is baked for the distances of {} cameras; at these cameras the file differs from the \
             scene by {}{unseen}; closer up it still shows the water of these distances",
            through.len(),
            apart(&through)?
        );
    }
    if args.no_backdrop {
        let scene_alone: Vec<usize> = (0..wet.gaussians.len() - wet.backdrop).collect();
        wet.gaussians = wet.gaussians.select(&scene_alone);
    }
    Ok((name(&what), wet.gaussians))
}

/// Prints the error of the spherical harmonics against the exact colours.
fn said(app: &App, baked: &InWater) {
    let report = &baked.report;
    if report.max_error > 0.0 {
        remark!(
            app,
            "baked: the colours of {:.2} % of the samples are clamped; mean colour error {:.5}, in clamped \
             samples {:.5}, at most {:.4}",
            100.0 * report.clamped_share,
            report.mean_error,
            report.mean_error_clamped,
            report.max_error
        );
    }
}

/// The cameras for a look with water, in the scene's frame: those through whose water the scene is baked, and
/// the held-out views, at which the file is compared with the scene, too. Held-out views are not baked,
/// unless no other cameras are given.
fn cameras(args: &ExportArgs, scene: &Scene) -> Result<(Vec<Camera>, Vec<Camera>), WorkError> {
    let own = args.scene.join(CAMERAS);
    let place = match &args.cameras {
        Some(place) => place.clone(),
        None if own.is_file() => own,
        None => {
            return Err(WorkError::Input(format!(
                "a look with water is baked for the distances of cameras, and {} has no list of its \
                 cameras; give --cameras CAPTURE, or choose a look without water (--what clear)",
                path_text(&args.scene)
            )));
        }
    };
    let cameras = placed(&place, &scene.frame)?;
    let origin = Origin::read(&args.scene).map_err(WorkError::input)?;
    let (mut through, mut held_out) = (Vec::new(), Vec::new());
    for (name, camera) in cameras {
        if is_held_out(origin.as_ref(), name.stem()) { &mut held_out } else { &mut through }.push(camera);
    }
    if through.is_empty() {
        through.clone_from(&held_out);
    }
    Ok((through, held_out))
}

/// Half a turn about x, xyzw: COLMAP's y points down and its z away from the viewer.
const HALF_TURN: [f32; 4] = [1.0, 0.0, 0.0, 0.0];

/// Writes one file of Gaussians in COLMAP's frame.
fn write(
    app: &App,
    args: &ExportArgs,
    &OutputFile { format, flag, path, .. }: &OutputFile<'_>,
    (what, colmap): (&str, &Gaussians),
    scene: &Scene,
) -> Done {
    // glTF gets y up by a rotation of its node, SPZ by its definition.
    let frame = match format {
        Format::Ply | Format::CompressedPly => args.frame.unwrap_or_default(),
        Format::Glb => ExportFrame::Colmap,
        Format::Spz => ExportFrame::YUp,
    };
    let mut offset = None;
    let turned = match frame {
        ExportFrame::Metric => {
            let (similarity, left_out) = metric(&args.scene)?;
            offset = left_out;
            Some(similarity::apply(colmap, &similarity))
        }
        ExportFrame::Colmap => None,
        ExportFrame::Normalised => Some(similarity::apply(colmap, &scene.frame)),
        ExportFrame::YUp => {
            let rotation = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
            Some(similarity::apply(colmap, &Frame { scale: 1.0, rotation, translation: DVec3::ZERO }))
        }
    };
    let gaussians = turned.as_ref().unwrap_or(colmap);
    let frame = if format == Format::Glb { ExportFrame::YUp } else { frame };
    let mut comments = vec![
        format!("use3d {}", crate::version::NUMBER),
        format!("what: {what}"),
        format!("frame: {}", name(&frame)),
    ];
    if let Some([x, y, z]) = offset {
        comments.push(format!("offset: add {x} {y} {z} metres to each position"));
    }
    // The writers of the other formats add this text themselves; SPZ has no room for text.
    if format == Format::Ply {
        comments.push(NO_WATER.into());
    }
    write_file(flag, path, |writer| match format {
        Format::Ply => ply::write_with_comments(gaussians, &comments, writer),
        Format::CompressedPly => compressed_ply::write(gaussians, &comments, writer),
        Format::Glb => glb::write(gaussians, &comments.join("; "), HALF_TURN, writer),
        Format::Spz if args.spz_version == 4 => spz::write(gaussians, spz::Version::Four, writer),
        Format::Spz => spz::write(gaussians, spz::Version::Three, writer),
    })?;
    let (what, frame) = (&comments[1], &comments[2]);
    let size = std::fs::metadata(path).map_or(0, |m| m.len());
    remark!(app, "{}: {} Gaussians, {what}, {frame}, {}", path_text(path), gaussians.len(), bytes(size));
    if let Some([x, y, z]) = offset {
        remark!(app, "positions lack the offset {x} {y} {z} metres: single precision would lose millimetres");
    }
    Ok(())
}

/// Coordinates above this many metres lose millimetres in single precision.
const FAR: f64 = 1000.0;

/// The similarity from COLMAP's frame to metres, without a large offset, and that offset in whole metres.
fn metric(scene: &Path) -> Result<(Frame, Option<[f64; 3]>), WorkError> {
    let Some(world) = Scene::world(scene).map_err(WorkError::input)? else {
        return Err(WorkError::Input(format!(
            "--frame metric: {} does not know its metres; measure a length or give positions \
             (docs/guide/metres.md), and run again",
            path_text(scene)
        )));
    };
    let translation = DVec3::from_array(world.apply([0.0; 3]));
    let offset = if translation.abs().max_element() > FAR { translation.round() } else { DVec3::ZERO };
    let (scale, rotation) = (world.metres_per_unit, world.rotation());
    let similarity = Frame { scale, rotation, translation: translation - offset };
    Ok((similarity, (offset != DVec3::ZERO).then(|| offset.to_array())))
}

/// A choice with its name on the command line.
fn name(choice: &impl ValueEnum) -> String {
    choice.to_possible_value().map_or_else(String::new, |value| value.get_name().to_string())
}
