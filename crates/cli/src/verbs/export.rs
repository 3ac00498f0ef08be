//! Writes a scene as a page for a browser, and as files for other 3D Gaussian splatting viewers.

use std::path::Path;

use use3d_pipeline::destination::{check_file, path_text};
use use3d_pipeline::export::{ExportLook, ExportedScene, GaussianFormat, GaussianFrame, WrittenFile};
use use3d_pipeline::found::capture_in;
use use3d_scene::Scene;
use use3d_scene::white::Gains;
use use3d_web::foreign::spz::Version;
use use3d_workflow::machine::bytes;

use crate::App;
use crate::args::{ExportArgs, ExportFrame, ExportWhat, check_shares};
use crate::error::{Done, WorkError};
use crate::interrupt::ends_soon;
use crate::verbs::drawing::too_strong;
use crate::verbs::{web, white};

pub(crate) fn run(app: &App, args: &ExportArgs) -> Done {
    for (_, flag, extension, path) in files(args) {
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
    check_shares(&[("--water", args.water)])?;
    if let Some(frame) = &args.frame
        && args.ply.is_none()
        && args.compressed_ply.is_none()
    {
        return Err(WorkError::Input(format!(
            "--frame {}: only a PLY has a choice of frames (GLB and SPZ have y up, in units of the model); leave it out, \
             or write a PLY",
            frame.frame().name()
        )));
    }
    let _ends_soon = ends_soon();
    let cameras = args.cameras.clone().or_else(|| capture_in(&args.scene));
    let args = &ExportArgs { scene: app.scene_in(&args.scene)?, cameras, ..args.clone() };
    let frame = args.frame.map_or(GaussianFrame::default(), ExportFrame::frame);
    frame.check(&args.scene)?;
    let scene = Scene::load(&args.scene).map_err(WorkError::input)?;
    let white = white::of(app, &args.white, &args.scene, &scene, args.cameras.as_deref())?;
    if let Some(path) = &args.web {
        web::write(app, args, path, &scene, white.as_ref())?;
    }
    if files(args).next().is_none() {
        return Ok(());
    }
    let look = ExportLook {
        mode: args.what.map(ExportWhat::mode),
        water: args.water,
        backdrop: !args.no_backdrop,
        gains: white.map_or(Gains::ONE, |white| white.gains),
        cameras: args.cameras.as_deref(),
    };
    let mut tell = |line: String| eprintln!("{line}");
    let tell: Option<&mut dyn FnMut(String)> = if app.quiet { None } else { Some(&mut tell) };
    if let Some(cut_off) = look.cut_off(&scene, &args.scene)? {
        remark!(app, "{}", too_strong(cut_off));
    }
    let exported = ExportedScene::bake((&scene, &args.scene), &look, tell)?;
    files(args).try_for_each(|(format, flag, _, path)| {
        let made_with = format!("use3d {}", crate::version::NUMBER);
        let written = exported.write((flag, path), format, frame, made_with)?;
        let WrittenFile { about, unit, offset, rounding, extent } = written;
        let size = bytes(std::fs::metadata(path).map_or(0, |m| m.len()));
        let positions = match rounding > COARSE.0 * extent {
            true => format!(", positions to {rounding:.1e} {unit}"),
            false => String::new(),
        };
        let count = exported.gaussians.len();
        remark!(app, "{}: {count} Gaussians, {about}{positions}, {size}", path_text(path));
        if let Some([x, y, z]) = offset {
            remark!(
                app,
                "positions lack the offset {x} {y} {z} {unit}: single precision would lose millimetres"
            );
        }
        if rounding > COARSE.1 * extent {
            eprintln!(
                "warning: {}: positions in this file are off by up to {rounding:.1e} {unit}, and the scene is about \
                 {extent:.1e} large; export a PLY, which is finer",
                path_text(path)
            );
        }
        Ok(())
    })
}

/// Errors of positions above these shares of the scene's size are said, and warned of.
const COARSE: (f64, f64) = (1e-5, 3e-4);

/// The requested files besides the page: format, flag, ending, path.
fn files(args: &ExportArgs) -> impl Iterator<Item = (GaussianFormat, &'static str, &'static str, &Path)> {
    let version = if args.spz_version == 4 { Version::Four } else { Version::Three };
    let all = [
        (GaussianFormat::Ply, "--ply", "ply", &args.ply),
        (GaussianFormat::CompressedPly, "--compressed-ply", "ply", &args.compressed_ply),
        (GaussianFormat::Glb, "--glb", "glb", &args.glb),
        (GaussianFormat::Spz(version), "--spz", "spz", &args.spz),
    ];
    all.into_iter().filter_map(|(format, flag, ending, path)| Some((format, flag, ending, path.as_deref()?)))
}
