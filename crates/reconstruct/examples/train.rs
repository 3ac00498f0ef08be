//! Trains one capture without the command line:
//! `train CAPTURE OUT [image_dir=images_2] [every=8] [key=value ...]`, where the keys are the parameters of
//! stage 1 (JSON values). Writes the log and the held-out views as PNG; prints the profile of a
//! step.

use std::path::Path;
use std::time::Instant;

use use3d_capture::{Lattice, MediumMaps, View};
use use3d_import::{ImportParams, import, load_depth_prior, load_mask, load_pixels};
use use3d_reconstruct::engine::CpuEngine;
use use3d_reconstruct::{Known, LoadedView, ReconstructParams, reconstruct};
use use3d_splat::{Colors, Options, Prepared, Rasterizer, Rendered};
use use3d_training::{Observer, TrainingProgress};

struct Lines {
    last: Instant,
    started: Instant,
}

impl Observer for Lines {
    fn progress(&mut self, p: &TrainingProgress) {
        if self.last.elapsed().as_secs_f64() > 10.0 || p.step == p.steps {
            self.last = Instant::now();
            println!(
                "{}/{} loss {:.4} psnr {:.2} gaussians {} {:.1} s",
                p.step,
                p.steps,
                p.loss.unwrap_or(f64::NAN),
                p.psnr.unwrap_or(f64::NAN),
                p.gaussians.unwrap_or(0),
                self.started.elapsed().as_secs_f64()
            );
        }
    }

    fn notice(&mut self, message: &str) {
        println!("note: {message}");
    }
}

fn load(view: &View) -> Result<LoadedView, Box<dyn std::error::Error + Send + Sync>> {
    let mask = load_mask(view)?;
    Ok(LoadedView { pixels: load_pixels(view)?, mask, depth_prior: load_depth_prior(view)? })
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let (Some(capture), Some(out)) = (arguments.next(), arguments.next()) else {
        return Err("usage: train CAPTURE OUT [image_dir=DIR] [every=N] [key=value ...]".into());
    };
    let mut importing = ImportParams::default();
    let mut params = serde_json::to_value(ReconstructParams::default())?;
    for argument in arguments {
        let (key, value) = argument.split_once('=').ok_or("expected key=value")?;
        match key {
            "image_dir" => importing.image_dir = Some(value.into()),
            "every" => importing.split.every = value.parse()?,
            "normalise" => importing.normalise = value.parse()?,
            _ => {
                let mut at = &mut params;
                for part in key.split('.') {
                    at = at.get_mut(part).ok_or_else(|| format!("no parameter {key}"))?;
                }
                *at = serde_json::from_str(value).unwrap_or_else(|_| value.into());
            }
        }
    }
    let params: ReconstructParams = serde_json::from_value(params)?;
    let imported = import(Path::new(&capture), &importing)?;
    let capture = &imported.capture;
    println!(
        "{}: {} training views, {} held out, {} points",
        capture.name,
        capture.split.train.len(),
        capture.split.test.len(),
        capture.points.len()
    );
    let started = Instant::now();
    let mut lines = Lines { last: started, started };
    let outcome =
        reconstruct(capture, &Known::default(), &load, &params, &mut CpuEngine::default(), None, &mut lines)?;
    println!("{:.1} s", started.elapsed().as_secs_f64());
    print!("{}", outcome.profile.table());
    println!(
        "{} -> {} Gaussians, {} MiB",
        outcome.initial_gaussians,
        outcome.scene.gaussians.len(),
        outcome.memory >> 20
    );
    if let Some(e) = &outcome.evaluation {
        let text = |score: &use3d_metrics::Score, decimals| match score.value() {
            Some(value) => format!("{value:.decimals$}"),
            None => format!("none ({})", score.reason().unwrap_or_default()),
        };
        println!("held out: PSNR {} dB, SSIM {}", text(&e.psnr, 2), text(&e.ssim, 4));
    }
    let out = Path::new(&out);
    std::fs::create_dir_all(out)?;
    std::fs::write(out.join("log.jsonl"), outcome.log_lines())?;
    let (mut prepared, mut rasterizer, mut rendered) = (Prepared::new(), Rasterizer::new(), Rendered::new());
    let mut maps = MediumMaps::zeros(0, 0);
    let scene = &outcome.scene;
    for view in capture.test_views() {
        let lattice = Lattice::full(&view.camera.intrinsics);
        scene.medium.maps(&view.camera, &lattice, scene.medium_degree, &mut maps);
        prepared.prepare(
            &scene.gaussians,
            &view.camera,
            &lattice,
            Colors::Sh { degree: params.active_degree(params.iterations) },
        );
        let water = (!scene.medium.is_none()).then_some(&maps);
        rasterizer.forward(&prepared, water, &Options { layers: true, ..Options::default() }, &mut rendered);
        let name = |mode: &str| out.join(format!("{}-{mode}.png", view.flat_stem()));
        use3d_io_image::write_png(&name("reconstruction"), &rendered.image)?;
        if let Some(layers) = &rendered.layers {
            use3d_io_image::write_png(&name("clear"), &layers.clear)?;
        }
        let far = rendered.depth.data().iter().fold(1e-6f32, |m, d| m.max(*d));
        use3d_io_image::write_png_map(&name("depth"), &rendered.depth.map(|d| d / far))?;
    }
    Ok(())
}
