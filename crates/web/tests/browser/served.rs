//! The page as the program serves it: pictures drawn by the program, a training that is watched, and a
//! visitor without the token.

use std::sync::Arc;

use serde_json::{Value, json};
use use3d_capture::{Camera, Intrinsics, Pose};
use use3d_render::{Mode, SceneRenderer};
use use3d_viewer::{Live, Server, Shown};

use crate::chromium::Chromium;
use crate::{page_views, scenes};

#[test]
fn the_program_draws_for_the_page_and_a_training_is_watched() {
    let Some(mut browser) = Chromium::start() else { return };
    browser.scheme("dark");
    browser.resize(640, 360, false);
    let scene = Arc::new(scenes::scene("rbf", 3));
    let live = Arc::new(Live::new("Waiting for the training to begin", Some(Arc::default())));
    let server = Server::start(None, &live).expect("a server");
    let views = Arc::new(page_views());
    let shown = |step: u64| Shown {
        name: "reef".into(),
        scene: scene.clone(),
        views: views.clone(),
        metres_per_unit: None,
        saved: None,
        white: None,
        step: Some(step),
        points: false,
    };

    // There is no scene yet: the page shows what it waits for, and continues by itself.
    browser.go(&server.address());
    browser.until("document.getElementById('waiting')?.textContent.startsWith('Waiting for the training')");
    live.show(shown(1));
    browser.ready();
    assert_eq!(browser.evaluate("document.title"), json!("reef"));
    assert_eq!(
        browser.evaluate("document.getElementById('photo').hidden"),
        json!(false),
        "beside its photograph"
    );

    // A still picture equals the program's own to the byte.
    browser.evaluate("use3d.viewer.setLook({ mode: 'enhanced', strength: 0.5, water: 0.5 })");
    browser.evaluate("new Promise(done => { use3d.viewer.on('frame', () => use3d.settled().then(done)); use3d.viewer.invalidate(); }).then(() => true)");
    browser.until("document.getElementById('view').width === document.getElementById('view').clientWidth");
    let camera = browser.evaluate(
        "(() => { const v = document.getElementById('view'), c = use3d.viewer.camera.pinhole(v.clientWidth, v.clientHeight); return { ...c, pixels: [...v.getContext('2d').getImageData(0, 0, v.width, v.height).data] }; })()",
    );
    let row = |r: usize| glam::DVec3::from_array(std::array::from_fn(|k| number(&camera["rotation"][r][k])));
    let rotation = glam::DMat3::from_cols(row(0), row(1), row(2)).transpose();
    let eye = glam::DVec3::from_array(std::array::from_fn(|k| number(&camera["eye"][k])));
    let [fx, fy, cx, cy] = std::array::from_fn(|k| number(&camera["lens"][k]));
    let (width, height) = (number(&camera["width"]) as usize, number(&camera["height"]) as usize);
    let camera_ = Camera {
        intrinsics: Intrinsics { width, height, fx, fy, cx, cy },
        pose: Pose::from_center(rotation, eye),
    };
    let mut renderer = SceneRenderer::new(&scene, 0.5).and_then(|r| r.with_water(0.5)).expect("a renderer");
    let truth = renderer.color(&camera_, Mode::Enhanced).expect("a picture").to_8bit().to_interleaved();
    let pixels: Vec<u8> =
        camera["pixels"].as_array().expect("pixels").iter().map(|v| number(v) as u8).collect();
    let drawn: Vec<u8> = pixels.chunks_exact(4).flat_map(|rgba| [rgba[0], rgba[1], rgba[2]]).collect();
    assert!(
        drawn == truth,
        "{} of {} bytes differ",
        drawn.iter().zip(&truth).filter(|(a, b)| a != b).count(),
        truth.len()
    );

    // Figures become curves; pause reaches the training; the surface under a click has a position.
    for step in 1..60 {
        live.figures(
            "reef/reconstruct",
            step,
            100,
            &[
                ("loss", 1.0 / step as f64),
                ("psnr", 20.0 + step as f64 / 10.0),
                ("held-out psnr", 19.0 + (step / 20) as f64),
                ("gaussians", 400.0),
            ],
        );
    }
    live.show(shown(59));
    browser
        .until("!document.getElementById('tab-training').hidden && use3d.training.status.shownStep === 59");
    browser.evaluate("use3d.panel.open('training')");
    assert!(
        text(&mut browser, "training-step").starts_with("59 of 100")
            && text(&mut browser, "figure-psnr") == "25.90 dB"
    );
    browser.until(
        "document.querySelector('#chart-loss polyline').getAttribute('points').split(' ').length === 59",
    );
    // The value is measured three times, but sent with every step.
    browser.until(
        "document.querySelector('#chart-held-out polyline').getAttribute('points').split(' ').length === 3",
    );
    assert_eq!(text(&mut browser, "figure-held-out"), "21.00 dB");
    browser.evaluate("document.getElementById('pause').click()");
    browser
        .until("use3d.training.status.paused && document.getElementById('pause').textContent === 'Resume'");
    browser.evaluate("document.getElementById('pause').click()");
    browser.until("!use3d.training.status.paused");
    let point = browser.evaluate("use3d.viewer.pointAt(150, 180)");
    assert!(point.is_null() || point.as_array().is_some_and(|p| p.len() == 3), "{point}");
    // Every control has a name, and at 320 px nothing is wider than the screen.
    for tab in ["look", "training"] {
        browser.evaluate(&format!("use3d.panel.open('{tab}')"));
        let nameless = browser.evaluate("[...document.querySelectorAll('button, input, select, [role=tab], [role=img]')].filter(e => e.checkVisibility() && !(e.textContent.trim() || e.ariaLabel || e.title || e.labels?.length)).map(e => e.id || e.outerHTML)");
        assert_eq!(nameless, json!([]), "{tab}");
    }
    browser.resize(320, 640, true);
    browser.until("document.documentElement.scrollWidth <= 320 && innerWidth === 320");
    let bar = number(&browser.evaluate("document.getElementById('training-bar').offsetHeight"));
    assert!(bar >= 8.0, "the bar is {bar} px high");

    // A picture that was refused for now is requested again.
    browser.evaluate(
        "(() => { const real = window.fetch; [window.refused, window.frames] = [0, 0];
          window.fetch = (path, how) => (path === '/frame' && !window.refused++ ? Promise.resolve(new Response(null, { status: 204 })) : real(path, how));
          use3d.viewer.on('frame', () => { window.frames++; }); use3d.viewer.invalidate(); })()",
    );
    browser.until("window.refused > 1 && window.frames > 0");
    // If the page is cut off, it shows a message of its own; when the server answers again, it continues by
    // itself.
    let state = "document.getElementById('training-state').textContent";
    browser.until(&format!("{state} === 'Training'"));
    browser.offline(true);
    let said = browser.evaluate("use3d.viewer.pointAt(1, 1).catch(error => error.message)");
    assert_eq!(said, json!("The program does not answer"));
    browser.evaluate("use3d.viewer.invalidate()");
    browser.until(&format!("{state}.includes('does not answer')"));
    browser.offline(false);
    live.show(shown(60));
    browser.evaluate("window.frames = 0");
    browser.until(&format!(
        "{state} === 'Training' && use3d.training.status.shownStep === 60 && window.frames > 0"
    ));
    // If the training was stopped and the server is gone, the page shows that it was stopped; the final state
    // stays.
    browser.evaluate("document.getElementById('stop').click(), document.getElementById('do-stop').click()");
    browser.until("use3d.training.status.stopping");
    browser.offline(true);
    browser.until(&format!("{state}.startsWith('The training was stopped')"));
    browser.offline(false);
    live.end("Done.");
    browser.until(&format!("{state} === 'Done.'"));
    browser.offline(true);
    browser.evaluate("new Promise(done => setTimeout(() => done(true), 3000))");
    assert_eq!(browser.evaluate(state), json!("Done."));
    drop(server);
    assert_eq!(
        browser.complaints.iter().filter(|c| !c.contains("net::ERR_")).count(),
        0,
        "{:?}",
        browser.complaints
    );
}

#[test]
fn a_finished_scene_is_drawn_by_the_browser_and_a_wrong_key_opens_nothing() {
    let Some(mut browser) = Chromium::start() else { return };
    browser.resize(480, 320, false);
    let live = Arc::new(Live::new("", None));
    let server = Server::start(None, &live).expect("a server");
    let scene = Arc::new(scenes::scene("mlp", 2));
    let shown = Shown {
        name: "reef".into(),
        scene,
        views: Arc::default(),
        metres_per_unit: Some(0.5),
        saved: None,
        white: None,
        step: None,
        points: false,
    };
    live.hand_over(shown).expect("data");
    browser.go(&format!("{},webgl", server.address()));
    browser.ready();
    let colours = "(() => { const gl = use3d.viewer.renderer.gl, p = new Uint8Array(4 * gl.drawingBufferWidth * gl.drawingBufferHeight); gl.readPixels(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight, gl.RGBA, gl.UNSIGNED_BYTE, p); return new Set(p).size; })()";
    browser.evaluate("use3d.settled()");
    assert!(number(&browser.evaluate(colours)) > 50.0);
    assert_eq!(browser.evaluate("document.getElementById('tab-training').hidden"), json!(true));
    // The program's own picture replaces the page's, as similar as the renderers are, until the camera moves.
    browser.evaluate("use3d.viewer.setLook({ mode: 'reconstruction' }), use3d.settled()");
    browser.evaluate("use3d.reference.show().then(() => true)");
    assert_eq!(browser.evaluate("document.getElementById('reference-picture').hidden"), json!(false));
    let difference = browser.evaluate("use3d.reference.difference");
    let [mean, most] = ["mean", "most"].map(|name| number(&difference[name]));
    assert!(mean < 2e-3 && most < 0.02, "{difference}");
    let own = browser.evaluate("(() => { const c = document.getElementById('reference-picture'); return new Set(new Uint32Array(c.getContext('2d').getImageData(0, 0, c.width, c.height).data.buffer)).size; })()");
    assert!(number(&own) > 50.0, "a picture, {own} colours");
    browser.evaluate("use3d.viewer.camera.move(0.1, 0, 0), use3d.viewer.moved()");
    browser.until("document.getElementById('reference-picture').hidden");
    assert_eq!(browser.complaints, Vec::<String>::new());

    let address = server.address();
    browser.go("about:blank");
    browser.go(&format!("{}0", &address[..address.len() - 1]).replace("#", "#0"));
    browser.until("document.getElementById('problem')?.textContent.includes('token')");
}

fn number(value: &Value) -> f64 {
    value.as_f64().expect("a number")
}

fn text(browser: &mut Chromium, id: &str) -> String {
    browser
        .evaluate(&format!("document.getElementById('{id}').textContent"))
        .as_str()
        .unwrap_or_default()
        .into()
}
