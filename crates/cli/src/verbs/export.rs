//! A scene as a page for a browser, and as a PLY that other 3D Gaussian splatting viewers open.
//!
//! The colours are asked for by the names of `use3d render`'s modes. A PLY holds Gaussians and no water, so a mode with water is written
//! as the one without, said aloud and in the file's header.

use std::path::Path;

use clap::ValueEnum;
use glam::{DMat3, DVec3};
use use3d_build::machine::bytes;
use use3d_capture::Frame;
use use3d_scene::{Scene, similarity};
use use3d_splat::ply;

use crate::App;
use crate::args::{ExportArgs, ExportFrame, ExportWhat};
use crate::destination::{check_file, path_text, write_file};
use crate::error::{CliError, Done};
use crate::verbs::web;

pub(crate) fn run(app: &App, args: &ExportArgs) -> Done {
    if let Some(path) = &args.ply {
        check_file("--ply", path, args.replace.force, &["ply"])?;
    }
    if let Some(path) = &args.web {
        web::check(path, args)?;
    }
    let scene = Scene::load(&args.scene).map_err(CliError::input)?;
    if let Some(path) = &args.web {
        web::write(app, args, path, &scene)?;
    }
    args.ply.as_deref().map_or(Ok(()), |path| write_ply(app, args, path, &scene))
}

fn write_ply(app: &App, args: &ExportArgs, path: &Path, scene: &Scene) -> Done {
    let what = match args.what {
        ExportWhat::Reconstruction | ExportWhat::Clear => ExportWhat::Clear,
        ExportWhat::Enhanced | ExportWhat::EnhancedClear => ExportWhat::EnhancedClear,
    };
    if what == ExportWhat::Clear && scene.enhancement.is_some() {
        eprintln!(
            "the scene is enhanced; `--what enhanced-clear` has that in the colours, `--what clear` is stage 1's radiance"
        );
    }
    if what != args.what {
        eprintln!(
            "a PLY holds no water: instead of `{}` this is `{}`, the same without it; `use3d render` shows it with water",
            name(&args.what),
            name(&what)
        );
    }
    let gaussians = match what {
        ExportWhat::Reconstruction | ExportWhat::Clear => scene.gaussians.clone(),
        ExportWhat::Enhanced | ExportWhat::EnhancedClear => {
            let (baked, report) = use3d_render::bake(scene, 1.0).map_err(CliError::input)?;
            eprintln!(
                "baked: the colour clamp is active in {:.2} % of samples; mean colour error {:.5}, there {:.5}, largest {:.4}",
                100.0 * report.clamped_share,
                report.mean_error,
                report.mean_error_clamped,
                report.max_error
            );
            baked
        }
    };
    let gaussians = match args.frame {
        ExportFrame::Colmap => similarity::invert(&gaussians, &scene.frame),
        ExportFrame::Normalised => gaussians,
        ExportFrame::YUp => {
            // Half a turn about x: COLMAP's y points down and its z away from the viewer.
            let turn = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
            let half_turn = Frame { scale: 1.0, rotation: turn, translation: DVec3::ZERO };
            similarity::apply(&similarity::invert(&gaussians, &scene.frame), &half_turn)
        }
    };
    let comments = [
        format!("use3d {}", env!("CARGO_PKG_VERSION")),
        format!("what: {}", name(&what)),
        format!("frame: {}", name(&args.frame)),
    ];
    write_file("--ply", path, |writer| ply::write_with_comments(&gaussians, &comments, writer))?;
    if !app.quiet {
        let [_, what, frame] = &comments;
        let size = std::fs::metadata(path).map_or(0, |m| m.len());
        eprintln!("{}: {} Gaussians, {what}, {frame}, {}", path_text(path), gaussians.len(), bytes(size));
    }
    Ok(())
}

/// A choice as it is written on the command line.
fn name(choice: &impl ValueEnum) -> String {
    choice.to_possible_value().map_or_else(String::new, |value| value.get_name().to_string())
}
