//! A scene as a page for a browser, and as files that other 3D Gaussian splatting viewers open.
//!
//! The colours of the latter are asked for by the names of `use3d render`'s modes. They hold Gaussians and no
//! water, so a mode with water is written as the one without, which is said and stands in the file's header
//! (SPZ has no room for words).

use std::path::Path;

use clap::ValueEnum;
use glam::{DMat3, DVec3};
use use3d_build::machine::bytes;
use use3d_capture::Frame;
use use3d_scene::{Scene, similarity};
use use3d_splat::{Gaussians, ply};
use use3d_web::foreign::{NO_WATER, compressed_ply, glb, spz};

use crate::App;
use crate::args::{ExportArgs, ExportFrame, ExportWhat};
use crate::destination::{check_file, path_text, write_file};
use crate::error::{CliError, Done};
use crate::interrupt::ends_soon;
use crate::verbs::web;

pub(crate) fn run(app: &App, args: &ExportArgs) -> Done {
    for (format, path) in files(args) {
        check_file(format.flag(), path, args.replace.force, &[format.extension()])?;
    }
    if let Some(path) = &args.web {
        web::check(path, args)?;
    }
    if args.web.is_none() && files(args).next().is_none() {
        let what =
            "say what to write: --web FILE.html, --ply FILE, --compressed-ply FILE, --glb FILE or --spz FILE";
        return Err(CliError::Input(what.into()));
    }
    let _ends_soon = ends_soon();
    let scene = Scene::load(&args.scene).map_err(CliError::input)?;
    if let Some(path) = &args.web {
        web::write(app, args, path, &scene)?;
    }
    if files(args).next().is_none() {
        return Ok(());
    }
    let (what, gaussians) = shown(args, &scene)?;
    let gaussians = similarity::invert(&gaussians, &scene.frame);
    for (format, path) in files(args) {
        write(app, args, (format, path), (&what, &gaussians), &scene)?;
    }
    Ok(())
}

/// A file for other viewers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Format {
    Ply,
    CompressedPly,
    Glb,
    Spz,
}

impl Format {
    fn flag(self) -> &'static str {
        match self {
            Self::Ply => "--ply",
            Self::CompressedPly => "--compressed-ply",
            Self::Glb => "--glb",
            Self::Spz => "--spz",
        }
    }

    fn extension(self) -> &'static str {
        match self {
            Self::Ply | Self::CompressedPly => "ply",
            Self::Glb => "glb",
            Self::Spz => "spz",
        }
    }
}

/// What was asked for besides the page.
fn files(args: &ExportArgs) -> impl Iterator<Item = (Format, &Path)> {
    let all = [
        (Format::Ply, &args.ply),
        (Format::CompressedPly, &args.compressed_ply),
        (Format::Glb, &args.glb),
        (Format::Spz, &args.spz),
    ];
    all.into_iter().filter_map(|(format, path)| Some((format, path.as_deref()?)))
}

/// The Gaussians with the colours that were asked for, and the name of these.
fn shown(args: &ExportArgs, scene: &Scene) -> Result<(String, Gaussians), CliError> {
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
            "these files hold no water: instead of `{}` this is `{}`, the same without it; `use3d render` shows it with water",
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
    Ok((name(&what), gaussians))
}

/// Half a turn about x, xyzw: COLMAP's y points down and its z away from the viewer.
const HALF_TURN: [f32; 4] = [1.0, 0.0, 0.0, 0.0];

/// Writes one file of Gaussians in COLMAP's frame.
fn write(
    app: &App,
    args: &ExportArgs,
    (format, path): (Format, &Path),
    (what, colmap): (&str, &Gaussians),
    scene: &Scene,
) -> Done {
    // glTF has y up by a turn of its node, SPZ by its definition.
    let frame = match format {
        Format::Ply | Format::CompressedPly => args.frame,
        Format::Glb => ExportFrame::Colmap,
        Format::Spz => ExportFrame::YUp,
    };
    let turned = match frame {
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
        format!("use3d {}", env!("CARGO_PKG_VERSION")),
        format!("what: {what}"),
        format!("frame: {}", name(&frame)),
    ];
    // The other formats' writers say it themselves; SPZ has no room for words.
    if format == Format::Ply {
        comments.push(NO_WATER.into());
    }
    write_file(format.flag(), path, |writer| match format {
        Format::Ply => ply::write_with_comments(gaussians, &comments, writer),
        Format::CompressedPly => compressed_ply::write(gaussians, &comments, writer),
        Format::Glb => glb::write(gaussians, &comments.join("; "), HALF_TURN, writer),
        Format::Spz => spz::write(gaussians, spz_version(args), writer),
    })?;
    if !app.quiet {
        let (what, frame) = (&comments[1], &comments[2]);
        let size = std::fs::metadata(path).map_or(0, |m| m.len());
        eprintln!("{}: {} Gaussians, {what}, {frame}, {}", path_text(path), gaussians.len(), bytes(size));
    }
    Ok(())
}

fn spz_version(args: &ExportArgs) -> spz::Version {
    if args.spz_version == 4 { spz::Version::Four } else { spz::Version::Three }
}

/// A choice as it is written on the command line.
fn name(choice: &impl ValueEnum) -> String {
    choice.to_possible_value().map_or_else(String::new, |value| value.get_name().to_string())
}
