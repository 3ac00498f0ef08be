//! The browser's pictures against the program's own renderer.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde_json::{Value, json};
use use3d_capture::{Camera, Lattice};
use use3d_render::white::{gains_of_patches, patch};
use use3d_render::{Look, Mode, Renderer, SceneRenderer};
use use3d_scene::Scene;
use use3d_scene::white::Gains;
use use3d_splat::Rendered;

use crate::chromium::Chromium;
use crate::{opened, page_views, scenes};

/// The program's picture, interleaved RGB in the display range; depth in units of [`DEPTH`].
pub(crate) fn drawn(scene: &Scene, camera: &Camera, mode: &str, strength: f32, water: f32) -> Vec<f32> {
    let look = if mode.starts_with("enhanced") { Look::Enhanced { strength } } else { Look::Reconstruction };
    let share = if mode.ends_with("clear") { 0.0 } else { water };
    let mut renderer = Renderer::new(scene, look).expect("a scene").with_water(share).expect("a share");
    let mut out = Rendered::new();
    renderer
        .render(camera, &Lattice::full(&camera.intrinsics), mode == "medium", &mut out)
        .expect("a picture");
    if mode == "depth" {
        return out.depth.data().iter().flat_map(|&z| [(z / DEPTH).clamp(0.0, 1.0); 3]).collect();
    }
    let mut image = out.image;
    if let Some(layers) = out.layers {
        image = layers.medium;
        image.data_mut().iter_mut().zip(layers.far.data()).for_each(|(m, f)| *m += f);
    }
    image.to_interleaved().into_iter().map(|v| v.clamp(0.0, 1.0)).collect()
}

/// Depths are compared as shares of this, scene units.
const DEPTH: f32 = 4.0;

/// The browser's picture.
pub(crate) fn shown(
    browser: &mut Chromium,
    camera: &Camera,
    mode: &str,
    strength: f32,
    water: f32,
) -> Vec<f32> {
    let (k, pose) = (&camera.intrinsics, &camera.pose);
    let rows: [[f64; 3]; 3] = std::array::from_fn(|r| pose.rotation.row(r).to_array());
    let view = json!({
        "eye": pose.center().to_array(), "rotation": rows, "lens": [k.fx, k.fy, k.cx, k.cy], "width": k.width, "height": k.height,
    });
    shown_as(browser, &view, &json!({ "mode": mode, "strength": strength, "water": water }))
}

/// The browser's picture of a camera and a look, both in the page's format.
fn shown_as(browser: &mut Chromium, view: &Value, look: &Value) -> Vec<f32> {
    let mode = look["mode"].as_str().expect("a mode");
    let scale = if mode == "depth" { 1.0 / DEPTH } else { 1.0 };
    let text = browser.evaluate(&format!(
        "(async () => {{
            const picture = await use3d.picture({view}, {look}), out = new Uint16Array(picture.length / 4 * 3);
            for (let i = 0, to = 0; i < picture.length; i += 4)
                for (let c = 0; c < 3; c++) out[to++] = Math.round(65535 * Math.min(1, Math.max(0, {scale} * picture[i + ({grey} ? 0 : c)])));
            const bytes = new Uint8Array(out.buffer), parts = [];
            for (let i = 0; i < bytes.length; i += 32768) parts.push(String.fromCharCode(...bytes.subarray(i, i + 32768)));
            return btoa(parts.join(''));
        }})()",
        grey = mode == "depth",
    ));
    let bytes = STANDARD.decode(text.as_str().expect("text")).expect("base64");
    bytes.chunks_exact(2).map(|b| f32::from(u16::from_le_bytes([b[0], b[1]])) / 65535.0).collect()
}

/// Mean difference, and the share of values that differ by more than 0.01.
pub(crate) fn difference(a: &[f32], b: &[f32]) -> (f64, f64) {
    assert_eq!(a.len(), b.len());
    let n = a.len() as f64;
    let apart = a.iter().zip(b).map(|(a, b)| f64::from((a - b).abs()));
    let far = apart.clone().filter(|d| *d > 0.01).count() as f64;
    (apart.sum::<f64>() / n, far / n)
}

/// The test's looks of a scene with water and enhancement.
pub(crate) const LOOKS: [(&str, f32, f32); 12] = [
    ("reconstruction", 1.0, 1.0),
    ("reconstruction", 1.0, 0.5),
    ("clear", 1.0, 1.0),
    ("enhanced", 0.0, 1.0),
    ("enhanced", 0.5, 1.0),
    ("enhanced", 1.0, 1.0),
    ("enhanced", 1.0, 0.25),
    ("enhanced-clear", 0.0, 1.0),
    ("enhanced-clear", 0.5, 1.0),
    ("enhanced-clear", 1.0, 1.0),
    ("medium", 1.0, 1.0),
    ("depth", 1.0, 1.0),
];

fn compare(browser: &mut Chromium, scene: &Scene, cameras: &[Camera], looks: &[(&str, f32, f32)]) {
    // The page's own picture is not needed here and would only cost time.
    browser.resize(400, 300, false);
    browser.evaluate("use3d.viewer.held = true");
    let mut worst = vec![(0.0f64, 0.0f64); looks.len()];
    for (i, camera) in cameras.iter().enumerate() {
        for ((mode, strength, water), worst) in looks.iter().zip(&mut worst) {
            let ours = drawn(scene, camera, mode, *strength, *water);
            let theirs = shown(browser, camera, mode, *strength, *water);
            let (mean, far) = difference(&ours, &theirs);
            assert!(
                mean <= 1e-3 && far <= 1e-3,
                "{mode} at strength {strength}, water {water}, camera {i}: mean {mean:.2e}, {:.3} % apart",
                100.0 * far
            );
            *worst = (worst.0.max(mean), worst.1.max(far));
        }
    }
    for ((mode, strength, water), (mean, far)) in looks.iter().zip(worst) {
        eprintln!("{mode} {strength} {water}: mean ≤ {mean:.1e}, apart ≤ {:.3} %", 100.0 * far);
    }
    assert_eq!(browser.complaints, Vec::<String>::new());
}

#[test]
fn the_page_draws_what_the_program_draws() {
    let scene = scenes::scene("rbf", 3);
    let Some((mut browser, _dir)) = opened(&scene) else { return };
    compare(&mut browser, &scene, &scenes::cameras(20, 320, 180), &LOOKS);
}

#[test]
fn every_water_and_every_degree_is_drawn_alike() {
    let looks = [("reconstruction", 1.0, 1.0), ("enhanced", 0.5, 1.0), ("medium", 1.0, 0.5)];
    for (kind, degree) in [("global", 2), ("mlp", 1), ("none", 0)] {
        let scene = scenes::scene(kind, degree);
        let Some((mut browser, _dir)) = opened(&scene) else { return };
        let looks = if kind == "none" { &looks[..2] } else { &looks[..] };
        compare(&mut browser, &scene, &scenes::cameras(3, 160, 90), looks);
    }
}

#[test]
fn a_click_on_something_grey_balances_what_page_and_program_draw_alike() {
    let scene = scenes::scene("rbf", 3);
    let Some((mut browser, _dir)) = opened(&scene) else { return };
    let camera = page_views()[1].camera;
    let mut renderer = SceneRenderer::new(&scene, 1.0).expect("a renderer");
    // A spot whose colour is near enough to grey; the scene is artificial.
    let spots =
        (0..11).flat_map(|i| (0..8).map(move |k| (20.0 + 12.0 * f64::from(i), 18.0 + 12.0 * f64::from(k))));
    let spot = spots.into_iter().find_map(|(x, y)| {
        let found = patch(&mut renderer, &camera, x, y).ok()?;
        let gains = gains_of_patches(&[found], true).ok()?;
        Some((x, y, found, gains))
    });
    let (x, y, found, gains) = spot.expect("a place that may be grey");

    // Both measure the same colour and depth.
    let number = |value: &Value| value.as_f64().expect("a number");
    let theirs = browser.evaluate(&format!("use3d.white.measure(use3d.scene.cameras[1], {x}, {y})"));
    for (look, color) in found.colors.iter().enumerate() {
        for (c, v) in color.iter().enumerate() {
            let apart = (number(&theirs["colors"][look][c]) - v).abs();
            assert!(apart < 4e-3, "look {look}, channel {c}: {v}, {theirs}");
        }
    }
    assert!((number(&theirs["depth"]) - found.depth).abs() < 0.02 * found.depth, "{found:?} {theirs}");

    // A click on the spot, from the position of the photograph, gives the gains, a status line, and the line
    // to paste.
    browser.evaluate("use3d.viewer.camera.set(use3d.viewer.camera.atView(use3d.scene.cameras[1]))");
    browser.evaluate("document.getElementById('white-pick').click()");
    browser.evaluate(&format!(
        "(async () => {{
            const canvas = document.getElementById('view'), view = use3d.scene.cameras[1];
            use3d.viewer.moved();
            await use3d.settled();
            const [f] = use3d.viewer.camera.pinhole(canvas.clientWidth, canvas.clientHeight).lens;
            await use3d.white.take(canvas.clientWidth / 2 + f * ({x} + 0.5 - view.lens[2]) / view.lens[0], canvas.clientHeight / 2 + f * ({y} + 0.5 - view.lens[3]) / view.lens[1]);
        }})()"
    ));
    let line = browser.evaluate("document.getElementById('white-line').textContent");
    assert_eq!(line, json!(format!("--white photo_1:{x},{y}@160x120")));
    let theirs: Gains = serde_json::from_value(browser.evaluate("use3d.viewer.look.white")).expect("gains");
    let all = |g: &Gains| [g.clear, g.enhanced, g.enhanced_clear].concat();
    for (ours, theirs) in all(&gains).into_iter().zip(all(&theirs)) {
        assert!((ours / theirs - 1.0).abs() < 0.02, "{gains:?} {theirs:?}");
    }
    let told = browser.evaluate("document.getElementById('white-text').textContent");
    assert!(told.as_str().is_some_and(|told| told.contains("It is correct at that distance")), "{told}");

    // Pictures with these gains equal the program's.
    browser.evaluate("use3d.viewer.held = true");
    let mut renderer = renderer.with_white(theirs);
    let (k, pose) = (&camera.intrinsics, &camera.pose);
    let rows: [[f64; 3]; 3] = std::array::from_fn(|r| pose.rotation.row(r).to_array());
    let view = json!({
        "eye": pose.center().to_array(), "rotation": rows, "lens": [k.fx, k.fy, k.cx, k.cy], "width": k.width, "height": k.height,
    });
    for mode in [Mode::Clear, Mode::Enhanced, Mode::EnhancedClear, Mode::Reconstruction] {
        let look = json!({ "mode": mode.name(), "strength": 1.0, "water": 1.0, "white": theirs });
        let shown = shown_as(&mut browser, &view, &look);
        let drawn = renderer.color(&camera, mode).expect("a picture");
        let drawn: Vec<f32> = drawn.to_interleaved().into_iter().map(|v| v.clamp(0.0, 1.0)).collect();
        let (mean, far) = difference(&drawn, &shown);
        assert!(mean <= 1e-3 && far <= 2e-3, "{}: mean {mean:.2e}, {:.3} % apart", mode.name(), 100.0 * far);
    }
    // Switched off, there are no gains.
    browser.evaluate("document.getElementById('white-off').click()");
    assert!(browser.evaluate("use3d.viewer.look.white").is_null());
    assert_eq!(browser.complaints, Vec::<String>::new());
}
