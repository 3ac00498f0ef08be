//! A scene as a PLY that other 3D Gaussian splatting viewers open.

use std::fs::File;
use std::io::{BufWriter, Write};

use clap::ValueEnum;
use glam::{DMat3, DVec3};
use use3d_capture::Frame;
use use3d_scene::{Scene, similarity};
use use3d_splat::ply;

use crate::args::{ExportArgs, ExportFrame, ExportWhat};
use crate::error::{CliError, Done};

pub(crate) fn run(args: &ExportArgs) -> Done {
    let scene = Scene::load(&args.scene).map_err(CliError::input)?;
    if args.what == ExportWhat::Clear && scene.enhancement.is_some() {
        eprintln!(
            "the scene is enhanced; `--what enhanced` has that in the colours, this is the radiance without water"
        );
    }
    let gaussians = match args.what {
        ExportWhat::Clear => scene.gaussians.clone(),
        ExportWhat::Enhanced => {
            let (baked, report) = use3d_enhance::bake(&scene, 1.0).map_err(CliError::input)?;
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
        format!("what: {}", name(&args.what)),
        format!("frame: {}", name(&args.frame)),
    ];
    let name = args.ply.file_name().unwrap_or_default().to_string_lossy();
    let part = args.ply.with_file_name(format!(".{name}.part"));
    let written = (|| {
        let mut writer = BufWriter::new(File::create(&part)?);
        ply::write_with_comments(&gaussians, &comments, &mut writer)?;
        writer.flush()?;
        writer.get_ref().sync_all()?;
        std::fs::rename(&part, &args.ply)
    })();
    written.map_err(|e: std::io::Error| {
        let _ = std::fs::remove_file(&part);
        CliError::Input(format!("--ply {}: {e}", args.ply.display()))
    })?;
    eprintln!("{}: {} Gaussians, {}, {}", args.ply.display(), gaussians.len(), comments[1], comments[2]);
    Ok(())
}

/// A choice as it is written on the command line.
fn name(choice: &impl ValueEnum) -> String {
    choice.to_possible_value().map_or_else(String::new, |value| value.get_name().to_string())
}
