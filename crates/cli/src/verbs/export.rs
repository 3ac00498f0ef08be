//! Writes a scene as a page for a browser, and as files for other 3D Gaussian splatting viewers.
//!
//! The looks of these files have the names of `use3d render`'s modes. The files hold Gaussians and no water,
//! so a look with water is baked into the colours as the cameras saw it, with a sphere of Gaussians for open
//! water behind the scene. The file's header says so (SPZ has no room for text).

use std::path::Path;

use clap::ValueEnum;
use glam::{DMat3, DVec3};
use use3d_capture::{Camera, Frame};

use use3d_numerics::math;
use use3d_pipeline::baked::difference;
use use3d_pipeline::scene_page::is_held_out;
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
use crate::destination::{check_file, path_text, write_file};
use crate::error::{CliError, Done};
use crate::interrupt::ends_soon;
use crate::verbs::drawing::placed;
use crate::verbs::found::{capture_in, scene_in};
use crate::verbs::{web, white};

pub(crate) fn run(app: &App, args: &ExportArgs) -> Done {
    for OutputFile { flag, extension, path, .. } in files(args) {
        check_file(flag, path, args.replace.force, &[extension])?;
    }
    if let Some(path) = &args.web {
        web::check_metres(args.metres_per_unit)?;
        check_file("--web", path, args.replace.force, &["html"])?;
    }
    if args.web.is_none() && files(args).next().is_none() {
        return Err(CliError::input(
            "choose an output: --web FILE.html, --ply FILE, --compressed-ply FILE, --glb FILE or --spz FILE",
        ));
    }
    if !(0.0..=1.0).contains(&args.water) {
        return Err(CliError::Input(format!("--water {}: expected 0 to 1", args.water)));
    }
    if let Some(frame) = &args.frame
        && args.ply.is_none()
        && args.compressed_ply.is_none()
    {
        return Err(CliError::Input(format!(
            "--frame {}: only a PLY has a choice of frames (GLB and SPZ have y up, in units of the model); leave it out, \
             or write a PLY",
            name(frame)
        )));
    }
    let _ends_soon = ends_soon();
    let cameras = args.cameras.clone().or_else(|| capture_in(&args.scene));
    let args = &ExportArgs { scene: scene_in(app, &args.scene)?, cameras, ..args.clone() };
    let scene = Scene::load(&args.scene).map_err(CliError::input)?;
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
    let (frame, offset) = near(&scene.frame, &gaussians);
    let gaussians = similarity::invert(&gaussians, &frame);
    files(args).try_for_each(|file| write(app, args, &file, (&what, &gaussians), (&frame, offset)))
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
fn baked(app: &App, args: &ExportArgs, scene: &Scene) -> Result<(String, Gaussians), CliError> {
    let what = args.what.unwrap_or_else(|| opening_look(scene));
    let look = match what {
        ExportWhat::Reconstruction | ExportWhat::Clear => Look::Reconstruction,
        ExportWhat::Enhanced | ExportWhat::EnhancedClear => Look::Enhanced { strength: 1.0 },
    };
    let with_water = matches!(what, ExportWhat::Reconstruction | ExportWhat::Enhanced)
        && !scene.medium.is_none()
        && args.water > 0.0;
    if !with_water {
        let dry = bake_in_water(scene, look, 0.0, &[]).map_err(CliError::input)?;
        said(app, &dry);
        return Ok((name(&what), dry.gaussians));
    }
    let (through, held_out) = cameras(args, scene)?;
    let mut wet = bake_in_water(scene, look, args.water, &through).map_err(CliError::input)?;
    said(app, &wet);
    if !app.quiet {
        let apart = |cameras: &[Camera]| -> Result<String, CliError> {
            let apart = difference(scene, look, args.water, &wet, cameras).map_err(CliError::failed)?;
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
fn cameras(args: &ExportArgs, scene: &Scene) -> Result<(Vec<Camera>, Vec<Camera>), CliError> {
    let own = args.scene.join(CAMERAS);
    let place = match &args.cameras {
        Some(place) => place.clone(),
        None if own.is_file() => own,
        None => {
            return Err(CliError::Input(format!(
                "a look with water is baked for the distances of cameras, and {} has no list of its \
                 cameras; give --cameras CAPTURE, or choose a look without water (--what clear)",
                path_text(&args.scene)
            )));
        }
    };
    let cameras = placed(&place, &scene.frame)?;
    let origin = Origin::read(&args.scene).map_err(CliError::input)?;
    let (mut through, mut held_out) = (Vec::new(), Vec::new());
    for (name, camera) in cameras {
        if is_held_out(origin.as_ref(), name.stem()) { &mut held_out } else { &mut through }.push(camera);
    }
    if through.is_empty() {
        through.clone_from(&held_out);
    }
    Ok((through, held_out))
}

/// A model whose middle is this many times its extent from zero loses positions in single precision.
const FAR_EXTENTS: f64 = 1000.0;
/// Errors of positions above these shares of the extent are said, and warned of.
const COARSE: (f64, f64) = (1e-5, 3e-4);

/// The middle half of the Gaussians: their median in each axis, and twice the widest range.
fn middle(gaussians: &Gaussians) -> (DVec3, f64) {
    let mut extent = 0.0f64;
    let median = [0, 1, 2].map(|axis| {
        let mut all: Vec<f32> = gaussians.means.iter().map(|mean| mean[axis]).collect();
        all.sort_unstable_by(f32::total_cmp);
        let at = |share: usize| all.get(share * all.len() / 4).copied().map_or(0.0, f64::from);
        extent = extent.max(2.0 * (at(3) - at(1)));
        at(2)
    });
    (DVec3::from_array(median), extent)
}

/// The frame of a model without a large offset, and that offset in whole units of the model: positions far
/// from zero do not fit into the numbers of the files. `gaussians` are in the scene's frame.
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

/// Half a turn about x, xyzw: COLMAP's y points down and its z away from the viewer.
const HALF_TURN: [f32; 4] = [1.0, 0.0, 0.0, 0.0];

/// Writes one file of Gaussians in COLMAP's frame, which lack `away`; `origin` is their frame.
fn write(
    app: &App,
    args: &ExportArgs,
    &OutputFile { format, flag, path, .. }: &OutputFile<'_>,
    (what, colmap): (&str, &Gaussians),
    (origin, away): (&Frame, DVec3),
) -> Done {
    // glTF gets y up by a rotation of its node, SPZ by its definition.
    let frame = match format {
        Format::Ply | Format::CompressedPly => args.frame.unwrap_or_default(),
        Format::Glb => ExportFrame::Colmap,
        Format::Spz => ExportFrame::YUp,
    };
    let y_up = DVec3::new(1.0, -1.0, -1.0);
    let mut offset = away;
    let turned = match frame {
        ExportFrame::Metric => {
            let (similarity, left_out) = metric(&args.scene, away)?;
            offset = left_out;
            Some(similarity::apply(colmap, &similarity))
        }
        ExportFrame::Colmap => None,
        ExportFrame::Normalised => {
            offset = DVec3::ZERO;
            Some(similarity::apply(colmap, origin))
        }
        ExportFrame::YUp => {
            offset *= y_up;
            let rotation = DMat3::from_diagonal(y_up);
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
    if format == Format::Glb {
        offset *= y_up;
    }
    let unit = if frame == ExportFrame::Metric { "metres" } else { "units" };
    let DVec3 { x, y, z } = offset;
    if offset != DVec3::ZERO {
        comments.push(format!("offset: add {x} {y} {z} {unit} to each position"));
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
    let ((_, extent), error) = (middle(gaussians), rounding(format, gaussians));
    let positions = match error > COARSE.0 * extent {
        true => format!(", positions to {error:.1e} {unit}"),
        false => String::new(),
    };
    let count = gaussians.len();
    remark!(app, "{}: {count} Gaussians, {what}, {frame}{positions}, {}", path_text(path), bytes(size));
    if offset != DVec3::ZERO {
        remark!(app, "positions lack the offset {x} {y} {z} {unit}: single precision would lose millimetres");
    }
    if error > COARSE.1 * extent {
        eprintln!(
            "warning: {}: positions in this file are off by up to {error:.1e} {unit}, and the scene is about \
             {extent:.1e} large; export a PLY, which is finer, or run the capture with a model near zero",
            path_text(path)
        );
    }
    Ok(())
}

/// The error that a format's numbers make of the positions of most Gaussians, units of the file.
fn rounding(format: Format, gaussians: &Gaussians) -> f64 {
    let (at, extent) = middle(gaussians);
    let single = (at.abs().max_element() + extent) * f64::from(f32::EPSILON) / 2.0;
    match format {
        Format::Spz => 0.5 * spz::step(gaussians).unwrap_or(0.0),
        Format::Ply | Format::CompressedPly | Format::Glb => single,
    }
}

/// Coordinates above this many metres lose millimetres in single precision.
const FAR: f64 = 1000.0;

/// The similarity from COLMAP's frame to metres, without a large offset, and that offset in whole metres.
/// `away` is the place of the positions' zero in COLMAP's frame.
fn metric(scene: &Path, away: DVec3) -> Result<(Frame, DVec3), CliError> {
    let Some(world) = Scene::world(scene).map_err(CliError::input)? else {
        return Err(CliError::Input(format!(
            "--frame metric: {} does not know its metres; measure a length or give positions \
             (docs/guide/metres.md), and run again",
            path_text(scene)
        )));
    };
    let translation = DVec3::from_array(world.apply(away.to_array()));
    let offset = if translation.abs().max_element() > FAR { translation.round() } else { DVec3::ZERO };
    let (scale, rotation) = (world.metres_per_unit, world.rotation());
    let similarity = Frame { scale, rotation, translation: translation - offset };
    Ok((similarity, offset))
}

/// A choice with its name on the command line.
fn name(choice: &impl ValueEnum) -> String {
    choice.to_possible_value().map_or_else(String::new, |value| value.get_name().to_string())
}
