//! The page in a browser without a graphics card, which draws on the processor, and the speed of that.

use serde_json::{Value, json};
use use3d_web::{Page, PageView};

use crate::chromium::Chromium;
use crate::pictures::{LOOKS, difference, drawn, shown};
use crate::{exported, page_views, scenes};

/// A coarse picture is at least as near to the final one, dB.
const NEAR: f64 = 20.0;

fn number(value: &Value) -> f64 {
    value.as_f64().expect("a number")
}

/// Opens a page as a browser without a graphics card does.
fn open(browser: &mut Chromium, path: &std::path::Path) {
    browser.go(&format!("file://{}", path.display()));
    browser.ready();
    browser.evaluate("use3d.settled()");
}

#[test]
fn without_a_card_the_page_draws_the_same_and_says_so() {
    let Some(mut browser) = Chromium::start() else { return };
    for (kind, degree, looks) in [("rbf", 3, &LOOKS[..]), ("mlp", 1, &LOOKS[..3]), ("none", 0, &LOOKS[5..6])]
    {
        let scene = scenes::scene(kind, degree);
        let (_dir, path) = exported(&scene);
        browser.resize(400, 300, false);
        open(&mut browser, &path);
        assert_eq!(
            browser.evaluate("[use3d.viewer.software, document.getElementById('slow').hidden]"),
            json!([true, false])
        );
        for camera in scenes::cameras(6, 320, 180) {
            for (mode, strength, water) in looks {
                let ours = drawn(&scene, &camera, mode, *strength, *water);
                let theirs = shown(&mut browser, &camera, mode, *strength, *water);
                let (mean, far) = difference(&ours, &theirs);
                // A tile has one water, and a full pixel is left a thousandth early.
                assert!(
                    mean <= 4e-3 && far <= 0.05,
                    "{kind} {mode} {strength} {water}: mean {mean:.2e}, {:.2} % apart",
                    100.0 * far
                );
            }
        }
    }
    // Two looks, a click, and a divider work as with a card; a moving picture is coarse, a still one sharp.
    let size = "document.getElementById('view').width / document.getElementById('view').clientWidth";
    browser.evaluate("window.least = 1, use3d.viewer.on('frame', () => { window.least = Math.min(window.least, document.getElementById('view').width / document.getElementById('view').clientWidth); })");
    browser.evaluate("use3d.viewer.setCompare('depth', 0.25), use3d.viewer.moved(), use3d.settled()");
    assert!(number(&browser.evaluate("window.least")) < 0.8);
    assert_eq!(browser.evaluate(size), json!(1));
    let point = browser.evaluate("use3d.viewer.pointAt(150, 150)");
    assert!(point.is_null() || point.as_array().is_some_and(|p| p.len() == 3), "{point}");
    assert_eq!(browser.complaints, Vec::<String>::new());
}

#[test]
fn a_page_begins_with_the_gaussians_that_matter_and_keeps_to_what_photographs_saw() {
    let Some(mut browser) = Chromium::start() else { return };
    // A Gaussian in the middle, and 40,000 more behind the cameras, which no photograph saw.
    let mut scene = scenes::scene("rbf", 3);
    let g = &mut scene.gaussians;
    while g.len() < 40_000 {
        let i = g.len() % 50;
        let mean: [f32; 3] = std::array::from_fn(|a| 0.001 * (g.len() / 3usize.pow(a as u32) % 97) as f32);
        g.means.push([mean[0], mean[1] - 6.0, mean[2]]);
        g.log_scales.push(g.log_scales[i]);
        g.quaternions.push(g.quaternions[i]);
        g.opacity_logits.push(3.0);
        g.sh.push(g.sh[i]);
    }
    let place = |x: f64| glam::DVec3::new(x, -3.0, 0.0);
    let intrinsics =
        use3d_capture::Intrinsics { width: 160, height: 120, fx: 160.0, fy: 160.0, cx: 80.0, cy: 60.0 };
    let pose = |eye| use3d_capture::Pose::look_at(eye, glam::DVec3::ZERO, glam::DVec3::Z);
    let views: Vec<PageView> = [-0.5, 0.0, 0.5]
        .iter()
        .map(|x| PageView {
            camera: use3d_capture::Camera { intrinsics, pose: pose(place(*x)) },
            held_out: false,
            ..page_views().remove(1)
        })
        .collect();
    let page =
        Page { name: "reef", scene: &scene, views, metres_per_unit: Some(0.8), saved: None, white: None };
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("reef.html");
    std::fs::write(&path, use3d_web::write(&page, "x").expect("a page").html).expect("written");

    for address in ["", "#webgl"] {
        browser.go("about:blank");
        browser.resize(640, 360, false);
        browser.go(&format!("file://{}{address}", path.display()));
        browser.ready();
        browser.evaluate("use3d.settled()");
        assert_eq!(
            browser.evaluate("[use3d.scene.count, use3d.scene.first, use3d.scene.sections.map(s => s.name)]"),
            json!([40_000, 32_768, ["geometry", "rest", "harmonics"]])
        );
        // The guest reads about the photographs; one unit of the model is 0.4 of the scene's and 0.8 m.
        let facts = browser.evaluate("document.getElementById('facts').textContent");
        assert_eq!(facts, json!("3 photographs · 28 November 2026 · a swim of 2.0 m"));
        assert_eq!(
            browser.evaluate("document.querySelectorAll('#modes input').length"),
            json!(4),
            "no looks for experts"
        );
        assert_eq!(browser.evaluate("document.querySelectorAll('#cameras img').length"), json!(3));
        // Behind the cameras nothing is drawn; where they were, the picture is the program's.
        let alpha = |browser: &mut Chromium, eye: glam::DVec3, at: glam::DVec3| {
            let pose = use3d_capture::Pose::look_at(eye, at, glam::DVec3::Z);
            let rows: [[f64; 3]; 3] = std::array::from_fn(|r| pose.rotation.row(r).to_array());
            let view = json!({ "eye": eye.to_array(), "rotation": rows, "lens": [64, 64, 32, 32], "width": 64, "height": 64 });
            number(&browser.evaluate(&format!("use3d.picture({view}, {{ mode: 'clear', strength: 1, water: 0 }}).then(p => p.reduce((sum, v, i) => sum + (i % 4 === 3 ? v : 0), 0) / 4096)")))
        };
        let (behind, before) = (place(0.0) - glam::DVec3::Y, place(0.0));
        let unseen = alpha(&mut browser, behind, behind - glam::DVec3::Y);
        assert!(unseen < 1e-3, "{address}: {unseen}");
        let (seen, aside) = (
            alpha(&mut browser, before, glam::DVec3::ZERO),
            alpha(&mut browser, -3.0 * glam::DVec3::X, glam::DVec3::ZERO),
        );
        assert!(seen > 0.3 && aside < 0.2 * seen, "{address}: {seen} {aside}");
        let camera = use3d_capture::Camera { intrinsics, pose: pose(before) };
        let ours = drawn(&scene, &camera, "enhanced", 1.0, 1.0);
        let (mean, _) = difference(&ours, &shown(&mut browser, &camera, "enhanced", 1.0, 1.0));
        assert!(mean < 4e-3, "{address}: {mean}");
        // From far away the water is that of the photographs, and nobody comes far from them.
        let red = |browser: &mut Chromium, far: f64| {
            let view = json!({ "eye": [0.0, -far, 0.0], "rotation": [[1, 0, 0], [0, 0, -1], [0, 1, 0]], "lens": [32.0 * far, 32.0 * far, 2, 2], "width": 4, "height": 4 });
            number(&browser.evaluate(&format!("use3d.picture({view}, {{ mode: 'reconstruction', strength: 1, water: 1 }}).then(p => p[4 * 5])")))
        };
        let (near, far, farther) = (red(&mut browser, 3.0), red(&mut browser, 6.0), red(&mut browser, 12.0));
        assert!(
            (far - farther).abs() < 0.1 * (near - farther).abs().max(0.05),
            "{address}: {near} {far} {farther}"
        );
        browser.evaluate("use3d.viewer.camera.move(0, 0, -1000), use3d.viewer.moved()");
        let away = "Math.min(...use3d.scene.cameras.map(view => Math.hypot(...view.eye.map((v, i) => v - use3d.viewer.camera.eye[i])))) / use3d.viewer.camera.reach";
        assert!(number(&browser.evaluate(away)) < 2.001);
    }
    // The whole photograph is in the first picture, on a phone as well.
    for (width, height, phone) in [(390, 844, true), (1400, 900, false), (1280, 720, false)] {
        browser.resize(width, height, phone);
        open(&mut browser, &path);
        let inside = browser.evaluate(
            "(() => { const view = use3d.scene.cameras[1], c = document.getElementById('view'), { lens } = use3d.viewer.camera.pinhole(c.clientWidth, c.clientHeight);
              return [c.clientWidth / 2 / lens[0] >= 79.9 / 160, c.clientHeight / 2 / lens[1] >= 59.9 / 160]; })()",
        );
        assert_eq!(inside, json!([true, true]), "{width}x{height}");
    }
    assert_eq!(browser.complaints, Vec::<String>::new());
}

/// Coarse pictures of a page of yours without a graphics card are near to the final ones; it prints their
/// times. Run it on a quiet machine:
///
/// `USE3D_PAGE=use3d-out/demo/reef/view.html cargo test --workspace --test browser speed -- --nocapture`
#[test]
fn speed_without_a_card() {
    let Ok(page) = std::env::var("USE3D_PAGE") else {
        println!("not run: USE3D_PAGE names no page");
        return;
    };
    let page = std::path::absolute(page).expect("a path");
    let Some(mut browser) = Chromium::start() else { return };
    browser.resize(1280, 720, false);
    // A picture that the browser has on its screen, and the psnr of two in dB.
    browser.ask("Page.addScriptToEvaluateOnNewDocument", json!({ "source":
        "window.grab = () => { const view = document.getElementById('view'), c = document.createElement('canvas'); [c.width, c.height] = [960, 720];
           const d = c.getContext('2d', { willReadFrequently: true }); d.drawImage(view, 0, 0, 960, 720); return d.getImageData(0, 0, 960, 720).data; };
         window.psnr = (a, b) => { let sum = 0; for (let i = 0; i < a.length; i++) if (i % 4 < 3) sum += (a[i] - b[i]) ** 2; return 10 * Math.log10(255 ** 2 / (sum / a.length * 4 / 3 + 1e-9)); };
         window.whole = async () => { await use3d.settled(); await new Promise(done => setTimeout(done, 300)); await use3d.settled(); return grab(); };
         const look = () => { const view = document.getElementById('view'); if (view?.width > 1 && !document.getElementById('progress').offsetParent) {
             const data = grab(); if (new Set(new Uint32Array(data.buffer)).size > 500) { window.first = { at: performance.now(), data }; return; } }
           requestAnimationFrame(look); };
         requestAnimationFrame(look);" }));
    for _ in 0..3 {
        browser.go("about:blank");
        browser.go(&format!("file://{}", page.display()));
        browser.ready();
        browser.until("window.first");
        let [at, same] = ["first.at / 1000", "whole().then(all => psnr(first.data, all))"]
            .map(|e| number(&browser.evaluate(e)));
        let settled = number(&browser.evaluate("performance.now() / 1000"));
        println!(
            "first picture after {at:.2} s, {same:.1} dB to the final one, which is there within {settled:.2} s"
        );
        assert!(same >= NEAR, "{same}");
    }
    let moved = browser.evaluate(
        "(async () => { const { viewer } = use3d, frames = [], seen = [];
           viewer.on('frame', () => { const data = seen.length < 12 ? grab() : null, eye = viewer.shown ?? viewer.camera; frames.push(performance.now());
             if (data) seen.push({ data, eye: [...eye.eye], rotation: eye.rotation.map(row => [...row]) }); });
           const start = performance.now();
           while (performance.now() - start < 8000) { viewer.camera.orbit(0.004, 0); viewer.moved(); await new Promise(requestAnimationFrame); }
           const rate = 1000 * frames.filter(t => t < start + 8000).length / 8000, like = [];
           for (const { data, eye, rotation } of seen.slice(2, 12)) { viewer.camera.set({ eye, rotation }); viewer.invalidate(); like.push(psnr(data, await whole())); }
           return { rate, worst: Math.min(...like), measured: like.length }; })()",
    );
    println!(
        "{:.1} pictures a second while moving, the worst of {} at {:.1} dB to its final picture",
        number(&moved["rate"]),
        moved["measured"],
        number(&moved["worst"])
    );
    assert!(number(&moved["worst"]) >= NEAR && moved["measured"] == 10, "{moved}");
}
