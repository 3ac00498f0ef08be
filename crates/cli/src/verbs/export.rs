//! A scene as a PLY that other 3D Gaussian splatting viewers open.

use std::fs::File;
use std::io::{BufWriter, Write};

use use3d_scene::{Scene, similarity};
use use3d_splat::ply;

use crate::args::{ExportArgs, ExportFrame, ExportWhat};
use crate::error::{CliError, Done};

pub(crate) fn run(args: &ExportArgs) -> Done {
    let scene = Scene::load(&args.scene).map_err(CliError::input)?;
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
    };
    let name = args.ply.file_name().unwrap_or_default().to_string_lossy();
    let part = args.ply.with_file_name(format!(".{name}.part"));
    let written = (|| {
        let mut writer = BufWriter::new(File::create(&part)?);
        ply::write(&gaussians, &mut writer)?;
        writer.flush()?;
        writer.get_ref().sync_all()?;
        std::fs::rename(&part, &args.ply)
    })();
    written.map_err(|e: std::io::Error| {
        let _ = std::fs::remove_file(&part);
        CliError::Input(format!("--ply {}: {e}", args.ply.display()))
    })?;
    eprintln!("{}: {} Gaussians", args.ply.display(), gaussians.len());
    Ok(())
}
