//! The page in a real browser: its pictures against the program's own renderer, and all of its controls.

mod chromium;
mod controls;
mod foreign;
mod pictures;
mod scenes;
mod served;
mod software;

use std::path::PathBuf;

use use3d_capture::Image;
use use3d_scene::Scene;
use use3d_web::{Page, PageView, Photograph};

use chromium::Chromium;

/// Two photographs with cameras.
fn page_views() -> Vec<PageView> {
    let views = scenes::cameras(2, 160, 120).into_iter().enumerate().map(|(i, camera)| PageView {
        name: format!("photo_{i}"),
        camera,
        day: Some(format!("2026-11-{}", 27 + i)),
        held_out: i == 0,
        enhanced: (i == 0).then(|| Photograph::new("photo", &Image::filled(160, 120, 0.75)).expect("a JPEG")),
        photograph: Some(
            Photograph::new("photo", &Image::filled(160, 120, 0.25 * (1 + i) as f32)).expect("a JPEG"),
        ),
    });
    views.collect()
}

/// A folder with a scene's page.
fn exported(scene: &Scene) -> (tempfile::TempDir, PathBuf) {
    let page = Page {
        name: "reef <test>",
        scene,
        views: page_views(),
        metres_per_unit: None,
        saved: None,
        white: None,
    };
    let written = use3d_web::write(&page, "reef_files").expect("a page");
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("reef.html");
    std::fs::write(&path, written.html).expect("written");
    (dir, path)
}

/// The browser with the page of a scene open; reduced motion is requested, so nothing moves by itself.
fn opened(scene: &Scene) -> Option<(Chromium, tempfile::TempDir)> {
    let (dir, path) = exported(scene);
    let mut browser = Chromium::start()?;
    browser.scheme("light");
    browser.resize(1000, 600, false);
    browser.open(&path);
    Some((browser, dir))
}
