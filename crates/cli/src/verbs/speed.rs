//! Measures the frames per second of a scene, and prints the protocol with the figure.

use serde::Serialize;
use use3d_capture::{Camera, FileName};
use use3d_judge::speed::{SHORTEST, Speed, measure};
use use3d_pipeline::scene_views::held_out;
use use3d_render::Mode;
use use3d_scene::Scene;
use use3d_stages::Drawn;

use crate::App;
use crate::args::RenderArgs;
use crate::error::{Done, WorkError};
use crate::interrupt;
use crate::output::json;
use crate::verbs::drawing::{cameras, renderer};

/// The figures and the conditions of the measurement.
#[derive(Serialize)]
struct Measured<'a> {
    /// The engine that drew.
    engine: &'a str,
    width: usize,
    height: usize,
    /// True if all views have that size.
    one_size: bool,
    views: usize,
    /// `held-out` or `given`.
    which: &'static str,
    gaussians: usize,
    threads: usize,
    protocol: &'static str,
    modes: Vec<Speed>,
}

const PROTOCOL: &str = "median over all timed views; 2 warm-up passes, then whole passes until 3 are done and 5 s have gone; \
    camera to image in memory, no files";

/// `use3d render --fps`.
pub(crate) fn run(app: &App, args: &RenderArgs, scene: &Scene, drawn: &Drawn<'_>) -> Done {
    let given = cameras(args, scene)?;
    let held_out = args.cameras.as_deref().and_then(|capture| held_out(capture).ok()).unwrap_or_default();
    let is_held_out = |name: &FileName| held_out.iter().any(|held| name == held);
    let any = given.iter().any(|(name, _)| is_held_out(name));
    let chosen: Vec<Camera> =
        given.iter().filter(|(name, _)| !any || is_held_out(name)).map(|(_, camera)| *camera).collect();
    let mut renderer = renderer(args, drawn)?;
    let mut modes = vec![Mode::Reconstruction];
    if renderer.is_enhanced() {
        modes.extend([Mode::Enhanced, Mode::EnhancedClear]);
    }
    let mut speeds = Vec::new();
    for mode in modes {
        remark!(app, "timing {} of {} views", mode.name(), chosen.len());
        let speed = measure(&mut renderer, &chosen, mode, SHORTEST, &interrupt::requested);
        let speed = speed.map_err(WorkError::failed)?;
        speeds.push(speed.ok_or(WorkError::Stopped)?);
    }
    let size = chosen.first().map_or((0, 0), |c| (c.intrinsics.width, c.intrinsics.height));
    let measured = Measured {
        engine: &drawn.told,
        width: size.0,
        height: size.1,
        one_size: chosen.iter().all(|c| (c.intrinsics.width, c.intrinsics.height) == size),
        views: chosen.len(),
        which: if any { "held-out" } else { "given" },
        gaussians: scene.gaussians.len(),
        threads: app.host.threads,
        protocol: PROTOCOL,
        modes: speeds,
    };
    if args.json {
        return json(&measured);
    }
    print(&measured);
    Ok(())
}

fn print(measured: &Measured<'_>) {
    println!("{:<16} {:>8} {:>10} {:>10} {:>10}", "mode", "FPS", "median ms", "fastest", "slowest");
    for s in &measured.modes {
        println!(
            "{:<16} {:>8.2} {:>10.2} {:>10.2} {:>10.2}",
            s.mode, s.fps, s.milliseconds, s.fastest, s.slowest
        );
    }
    let Measured { engine, width, height, views, which, gaussians, threads, .. } = measured;
    let others = if measured.one_size { "" } else { " (the first; others differ)" };
    let passes = measured.modes.iter().map(|s| s.passes).min().unwrap_or(0);
    println!(
        "{width}x{height}{others}, {views} {which} views, {gaussians} Gaussians, {engine}, {threads} threads, {passes} passes"
    );
    println!("{}", measured.protocol);
}
