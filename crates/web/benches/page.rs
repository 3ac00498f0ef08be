//! Measures a large scene's page: `cargo bench -p use3d-web --bench page -- [GAUSSIANS]` (600,000 by
//! default).
//!
//! It measures the time to make the page and its size. In Chromium, from a local file, it measures the time
//! until the first Gaussians are unpacked and in order (the time to the first picture apart from drawing it),
//! and the sort of all (the median over turns of the camera).

#![allow(dead_code, reason = "the browser's tests use more of what is shared")]

#[path = "../tests/browser/chromium.rs"]
mod chromium;
#[path = "../tests/browser/scenes.rs"]
mod scenes;

use std::time::Instant;

use chromium::Chromium;
use scenes::Draws;
use use3d_scene::Scene;
use use3d_web::Page;

/// Number of turns of the camera, each of which sorts again.
const TURNS: usize = 31;

fn main() {
    let count = std::env::args().skip(1).find_map(|word| word.parse().ok()).unwrap_or(600_000);
    let scene = scene(count);
    let page = Page {
        name: "large",
        scene: &scene,
        views: Vec::new(),
        metres_per_unit: None,
        saved: None,
        white: None,
    };
    let dir = tempfile::tempdir().expect("a folder");
    let started = Instant::now();
    let written = use3d_web::write(&page, "large_files").expect("a page");
    let path = dir.path().join("large.html");
    std::fs::write(&path, &written.html).expect("written");
    std::fs::create_dir(dir.path().join("large_files")).expect("a folder");
    for (name, text) in &written.parts {
        std::fs::write(dir.path().join("large_files").join(name), text).expect("written");
    }
    let parts = match written.parts.len() {
        0 => "one file".to_string(),
        parts => format!("{parts} parts beside it"),
    };
    println!(
        "{count} Gaussians: page made in {:.2} s, {:.1} MB, harmonics to degree {}, {parts}",
        started.elapsed().as_secs_f64(),
        written.bytes() as f64 / 1e6,
        written.degree
    );
    let Some(mut browser) = Chromium::start() else { return };
    // Drawn in software, and only once, so the window is small.
    browser.resize(160, 120, false);
    browser.open(&path);
    let ordered = browser.evaluate("performance.getEntriesByName('use3d ordered')[0].startTime");
    println!("the first Gaussians are in order after {:.2} s", ordered.as_f64().unwrap_or(f64::NAN) / 1e3);
    let turn = format!(
        "(async () => {{ use3d.viewer.held = true; const took = [];
          for (let i = 0; i < {TURNS}; i++) {{ use3d.viewer.camera.look(0.3, 0); use3d.viewer.sorter.ask(use3d.viewer.camera.state());
            while (!use3d.viewer.sorter.settled()) await new Promise(done => setTimeout(done, 1)); took.push(use3d.viewer.sorter.milliseconds); }}
          return took.sort((a, b) => a - b)[{TURNS} >> 1]; }})()"
    );
    println!("sorted in {:.1} ms", browser.evaluate(&turn).as_f64().unwrap_or(f64::NAN));
}

/// A scene with water, enhancement and harmonics of every degree, of Gaussians as small as those of a trained
/// one.
fn scene(count: usize) -> Scene {
    let mut scene = scenes::scene("rbf", 3);
    let mut draw = Draws::new("large scene", 17);
    let gaussians = &mut scene.gaussians;
    gaussians.means = (0..count).map(|_| std::array::from_fn(|_| draw.normal())).collect();
    gaussians.log_scales = (0..count).map(|_| std::array::from_fn(|_| -5.5 + 0.5 * draw.normal())).collect();
    gaussians.quaternions = (0..count).map(|_| std::array::from_fn(|_| draw.normal())).collect();
    gaussians.opacity_logits = (0..count).map(|_| draw.normal()).collect();
    gaussians.sh = (0..count)
        .map(|_| {
            std::array::from_fn(|k| std::array::from_fn(|_| if k == 0 { 0.9 } else { 0.1 } * draw.normal()))
        })
        .collect();
    scene
}
