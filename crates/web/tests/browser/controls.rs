//! The controls of the page: drag, press, touch, compare, measure, follow a path; and their accessibility.

use serde_json::{Value, json};

use use3d_web::path::CameraPath;
use use3d_web::{Page, SavedViews};

use crate::{opened, page_views, scenes};

fn number(value: &Value) -> f64 {
    value.as_f64().expect("a number")
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().expect("a list").iter().map(number).collect()
}

#[test]
fn one_looks_around_by_mouse_keys_and_touch() {
    let Some((mut browser, _dir)) = opened(&scenes::scene("rbf", 3)) else { return };
    let eye = "(use3d.settled().then(() => use3d.viewer.camera.state().eye))";
    let focus = "use3d.viewer.camera.state().focus";
    // The remembered state of the camera, and the test that the camera has moved.
    let remember = "window.before = JSON.stringify(use3d.viewer.camera.state()), null";
    let moved = "JSON.stringify(use3d.viewer.camera.state()) !== window.before";
    let start = numbers(&browser.evaluate(eye));

    // Orbiting keeps the position of the point of interest, and its distance.
    let target = numbers(&browser.evaluate("use3d.viewer.camera.target()"));
    browser.evaluate(remember);
    browser.drag([300.0, 300.0], [380.0, 320.0]);
    browser.until(moved);
    let kept = numbers(&browser.evaluate("use3d.viewer.camera.target()"));
    assert!(target.iter().zip(&kept).all(|(a, b)| (a - b).abs() < 1e-9), "{target:?} {kept:?}");

    // The wheel zooms in, towards the pointer.
    let far = number(&browser.evaluate(focus));
    let wheel = json!({ "type": "mouseWheel", "x": 300, "y": 300, "deltaX": 0, "deltaY": -240 });
    browser.ask("Input.dispatchMouseEvent", wheel);
    browser.until(&format!("{focus} < {far}"));

    // F frames the whole scene, R returns to the start, from the keyboard; keys also change looks and their
    // strength.
    browser.key("f", "KeyF");
    browser.evaluate("use3d.settled()");
    let seen = browser.evaluate(
        "(() => { const { low, high } = use3d.scene.bounds, v = document.getElementById('view'); let all = true;
          for (let i = 0; i < 8; i++) { const p = use3d.viewer.camera.project([0, 1, 2].map(a => (i >> a & 1 ? high : low)[a]), v.clientWidth, v.clientHeight);
            all &&= p && p[0] >= 0 && p[1] >= 0 && p[0] <= v.clientWidth && p[1] <= v.clientHeight; } return all; })()",
    );
    assert_eq!(seen, json!(true), "framed, every corner is in the picture");
    browser.key("r", "KeyR");
    let back = numbers(&browser.evaluate(eye));
    assert!(start.iter().zip(&back).all(|(a, b)| (a - b).abs() < 1e-6), "{start:?} {back:?}");
    let mode = "use3d.viewer.look.mode";
    let before = browser.evaluate(mode);
    browser.key(".", "Period");
    assert_ne!(browser.evaluate(mode), before);
    browser.key("[", "BracketLeft");
    assert!((number(&browser.evaluate("use3d.viewer.look.strength")) - 0.9).abs() < 1e-9);
    browser.key("2", "Digit2");
    assert_eq!(
        browser.evaluate("document.getElementById('do-fly').getAttribute('aria-pressed')"),
        json!("true")
    );
    browser.key("1", "Digit1");

    // The camera flies while a key is pressed.
    browser.evaluate("document.getElementById('view').focus()");
    browser.evaluate(remember);
    browser.ask("Input.dispatchKeyEvent", json!({ "type": "keyDown", "key": "w", "code": "KeyW" }));
    browser.until(moved);
    browser.ask("Input.dispatchKeyEvent", json!({ "type": "keyUp", "key": "w", "code": "KeyW" }));

    // A levelled horizon has no roll.
    browser.evaluate("use3d.viewer.camera.roll(0.4)");
    browser.key("l", "KeyL");
    browser.evaluate("use3d.settled()");
    assert!(number(&browser.evaluate("use3d.viewer.camera.state().rotation[0][2]")).abs() < 1e-9);

    // One finger orbits; two fingers that move apart zoom in.
    browser.resize(390, 780, true);
    browser.evaluate(remember);
    browser.touch(&[([100.0, 200.0], [180.0, 220.0])]);
    browser.until(moved);
    let far = number(&browser.evaluate(focus));
    browser.touch(&[([150.0, 200.0], [80.0, 200.0]), ([200.0, 200.0], [290.0, 210.0])]);
    browser.until(&format!("{focus} < {far}"));
    assert_eq!(browser.complaints, Vec::<String>::new());
}

#[test]
fn two_looks_are_compared_and_photographs_stand_beside() {
    let scene = scenes::scene("rbf", 3);
    let Some((mut browser, _dir)) = opened(&scene) else { return };
    browser.evaluate("document.getElementById('compare').click()");
    assert_eq!(browser.evaluate("use3d.viewer.compare"), json!("reconstruction"));
    let width = number(&browser.evaluate("document.getElementById('view').clientWidth"));
    browser.drag([width / 2.0, 300.0], [width * 0.25, 300.0]);
    browser.until("Math.abs(use3d.viewer.at - 0.25) < 0.01");
    let at = number(&browser.evaluate("use3d.viewer.at"));
    browser.evaluate("document.getElementById('split').focus()");
    browser.key("ArrowRight", "ArrowRight");
    assert!((number(&browser.evaluate("use3d.viewer.at")) - at - 0.02).abs() < 1e-9);
    // The two looks are left and right of the divider, to the pixel.
    let same = browser.evaluate(
        "(async () => {
          const view = document.getElementById('view'), grab = async () => { await use3d.settled(); const c = document.createElement('canvas');
            c.width = view.width; c.height = view.height; const d = c.getContext('2d'); d.drawImage(view, 0, 0); return d.getImageData(0, 0, c.width, c.height).data; };
          const both = await grab(), cut = Math.round(use3d.viewer.at * view.width), look = use3d.viewer.look.mode;
          use3d.viewer.setCompare(null); const right = await grab();
          use3d.viewer.setLook({ mode: 'reconstruction' }); const left = await grab();
          use3d.viewer.setLook({ mode: look });
          let differ = 0;
          for (let y = 0; y < view.height; y++) for (let x = 0; x < view.width; x++) { const i = 4 * (y * view.width + x), from = x < cut ? left : right;
            differ += Number(both[i] !== from[i] || both[i + 1] !== from[i + 1] || both[i + 2] !== from[i + 2]); }
          return differ; })()",
    );
    assert_eq!(same, json!(0));

    // A look is not compared with itself.
    browser.evaluate("use3d.viewer.setLook({ mode: 'reconstruction' }), document.getElementById('compare-mode').value = 'reconstruction', document.getElementById('compare').click()");
    assert_eq!(browser.evaluate("use3d.viewer.compare"), json!("enhanced"));

    browser.evaluate("use3d.views.go(1)");
    browser.evaluate("use3d.settled()");
    assert_eq!(browser.evaluate("document.getElementById('photo').hidden"), json!(false));
    assert_eq!(browser.evaluate("document.getElementById('photo-image').alt"), json!("Photograph photo_1"));
    // Only the other photograph has an enhanced one beside it, with a divider.
    let hidden = |browser: &mut crate::Chromium, id: &str| {
        browser.evaluate(&format!("document.getElementById('{id}').hidden"))
    };
    assert_eq!(hidden(&mut browser, "photo-enhanced"), json!(true));
    browser.evaluate("use3d.views.go(0)");
    browser.evaluate("use3d.settled()");
    assert_eq!(hidden(&mut browser, "photo-divider"), json!(false));
    assert_eq!(hidden(&mut browser, "photo-enhanced"), json!(false));
    browser.evaluate("document.getElementById('photo-divider').value = 20, document.getElementById('photo-divider').oninput()");
    let cut = browser.evaluate("document.getElementById('photo-enhanced').style.clipPath");
    assert_eq!(cut, json!("inset(0px 0px 0px 20%)"));
    // A named view is saved in a file that the program reads, and is restored from it.
    browser.evaluate("use3d.viewer.setCompare('clear', 0.25), use3d.viewer.camera.up = [0, 0.6, 0.8], use3d.measure.metresPerUnit = 2, use3d.saved.add('mine')");
    assert_eq!(browser.evaluate("document.querySelectorAll('#saved-views li').length"), json!(1));
    let text = browser.evaluate("use3d.saved.json()");
    let saved = SavedViews::read(text.as_str().expect("text")).expect("views");
    let page = Page {
        name: "again",
        scene: &scene,
        views: page_views(),
        metres_per_unit: None,
        saved: Some(&saved),
        white: None,
    };
    let again = tempfile::tempdir().expect("a folder");
    let path = again.path().join("again.html");
    std::fs::write(&path, use3d_web::write(&page, "x").expect("a page").html).expect("written");
    let place = "(({ eye, rotation, fov, focus }) => [...eye, ...rotation.flat(), fov, focus])(use3d.viewer.camera.state())";
    let before = numbers(&browser.evaluate(place));
    browser.open(&path);
    browser.evaluate("document.querySelector('#saved-views button').click()");
    browser.evaluate("use3d.settled()");
    let after = numbers(&browser.evaluate(place));
    assert!(before.iter().zip(&after).all(|(a, b)| (a - b).abs() < 1e-6), "{before:?} {after:?}");
    let state = browser.evaluate("[use3d.viewer.compare, use3d.viewer.at, use3d.measure.metresPerUnit, use3d.viewer.camera.up.map(v => Math.round(1e6 * v) / 1e6)]");
    assert_eq!(state, json!(["clear", 0.25, 2, [0, 0.6, 0.8]]));
    let refused = browser.evaluate("(() => { try { use3d.saved.take({ format: '3d-use camera path' }); } catch (e) { return e.message; } })()");
    assert!(refused.as_str().expect("text").contains("file of views"), "{refused}");
    assert_eq!(browser.complaints, Vec::<String>::new());
}

#[test]
fn paths_come_back_as_they_were_and_lengths_become_metres() {
    let scene = scenes::scene("global", 3);
    let Some((mut browser, _dir)) = opened(&scene) else { return };
    let read = browser.evaluate(
        "(async () => {
          use3d.path.add(); use3d.viewer.camera.orbit(0.4, 0.1); use3d.viewer.camera.fov = 40; use3d.viewer.setLook({ mode: 'clear', strength: 0.25 });
          use3d.path.add(); use3d.viewer.camera.move(0.2, 0, 0.1); use3d.path.add();
          const before = structuredClone(use3d.path.keys), text = use3d.path.json();
          use3d.path.read(text);
          const apart = (a, b) => Math.max(...a.flat(9).map((v, i) => Math.abs(v - b.flat(9)[i])));
          const worst = Math.max(...before.map((key, i) => { const other = use3d.path.keys[i];
            return Math.max(apart([key.eye, key.rotation, key.fov, key.focus, key.time, key.strength, key.water], [other.eye, other.rotation, other.fov, other.focus, other.time, other.strength, other.water])); }));
          const modes = use3d.path.keys.map(key => key.mode), file = JSON.parse(text);
          let refused = ''; try { use3d.path.read('{\"format\":\"other\"}'); } catch (e) { refused = e.message; }
          return { worst, modes, center: file.keys[0].center, eye: before[0].eye, refused };
        })()",
    );
    assert!(number(&read["worst"]) < 1e-9, "{read}");
    assert_eq!(read["modes"], json!(["enhanced", "clear", "clear"]));
    assert!(read["refused"].as_str().expect("text").contains("camera path"));
    // Files are in the COLMAP frame.
    let [center, eye] = ["center", "eye"].map(|name| glam::DVec3::from_slice(&numbers(&read[name])));
    assert!((scene.frame.apply(center) - eye).length() < 1e-9);

    // The files that the page saves for nerfstudio and for COLMAP contain the frames that the program draws
    // from the page's own file.
    let saved = browser.evaluate("[use3d.path.json(), use3d.path.foreign('nerfstudio')['camera_path.json'], use3d.path.foreign('colmap')]");
    let frames = |k: usize| {
        let path = CameraPath::read(saved[k].as_str().expect("text")).expect("a path");
        path.frames(192, 108).iter().map(|frame| frame.camera).collect::<Vec<_>>()
    };
    let (own, nerfstudio) = (frames(0), frames(1));
    let dir = tempfile::tempdir().expect("a folder");
    for name in ["images.txt", "cameras.txt"] {
        std::fs::write(dir.path().join(name), saved[2][name].as_str().expect("text")).expect("written");
    }
    let colmap = use3d_import::read_images_txt(&dir.path().join("images.txt")).expect("cameras");
    assert_eq!((own.len(), nerfstudio.len(), colmap.len()), (181, 181, 181));
    for (i, own) in own.iter().enumerate() {
        for other in [&nerfstudio[i], &colmap[i]] {
            let [(a, b), (c, d)] =
                [(own.pose, other.pose), (other.pose, own.pose)].map(|(a, b)| (a.center(), b.rotation));
            assert!(
                (a - c).length() < 1e-6 && (b - d).to_cols_array().iter().all(|v| v.abs() < 1e-6),
                "frame {i}"
            );
            let fov = |camera: &use3d_capture::Camera| camera.intrinsics.height as f64 / camera.intrinsics.fy;
            assert!((fov(own) - fov(other)).abs() < 1e-6, "frame {i}");
        }
    }

    // Times increase whatever the field of seconds contains; the message for a path that only the program can
    // draw says so.
    let times = browser.evaluate(
        "(() => { document.getElementById('key-seconds').value = -5; use3d.path.add(); use3d.path.read(use3d.path.json());
          const times = use3d.path.keys.map(key => key.time); use3d.path.keys.pop(); use3d.path.changed(); return times; })()",
    );
    assert_eq!(times, json!([0, 3, 6, 9]));
    let refused = browser.evaluate(
        "(() => { try { use3d.path.read('{\"camera_path\":[]}'); } catch (e) { return e.message; } })()",
    );
    assert!(refused.as_str().expect("text").contains("use3d render SCENE --path"), "{refused}");

    // Played in the page, it becomes a film.
    let film = browser.evaluate(
        "use3d.path.keys.forEach((key, i) => { key.time = i; }), use3d.recorder.record().then(film => [film.type, film.size > 500])",
    );
    assert_eq!(film, json!(["video/webm", true]));

    // Two clicks measure a distance; one known length converts all distances to metres.
    let text = browser.evaluate(
        "(async () => { await use3d.settled(); use3d.measure.choose('distance'); use3d.measure.take([0, 0, 0]); use3d.measure.take([0, 0.8, 0]);
          const units = document.getElementById('distances').textContent;
          document.getElementById('known-length').value = 3; document.getElementById('known').requestSubmit();
          return [units, document.getElementById('distances').textContent, use3d.measure.metresPerUnit]; })()",
    );
    assert!(text[0].as_str().expect("text").contains("2.00 units"), "{text}");
    assert!(text[1].as_str().expect("text").contains("3.00 m"), "{text}");
    assert!((number(&text[2]) - 1.5).abs() < 1e-9);
    // A click finds the surface from the depth.
    let point = browser.evaluate("(() => { const v = document.getElementById('view'); use3d.viewer.camera.set(use3d.viewer.camera.home()); return use3d.settled().then(() => use3d.viewer.pointAt(v.clientWidth / 2, v.clientHeight / 2)).then(point => window.point = point); })()");
    assert_eq!(numbers(&point).len(), 3);
    // Without a pointer, Enter uses the middle of the picture: it adds a point while measuring, else it moves
    // the camera there.
    browser.evaluate(
        "document.getElementById('view').focus(), use3d.measure.tool ?? use3d.measure.choose('distance')",
    );
    browser.key("Enter", "Enter");
    browser.until("use3d.measure.points.length === 1");
    let apart = browser.evaluate("Math.hypot(...use3d.measure.points[0].map((v, i) => v - window.point[i]))");
    assert!(number(&apart) < 1e-9, "{apart}");
    browser.key("Escape", "Escape");
    browser.evaluate("window.far = use3d.viewer.camera.state().focus");
    browser.key("Enter", "Enter");
    browser.until("use3d.viewer.camera.state().focus < window.far");
    assert_eq!(browser.complaints, Vec::<String>::new());
}

#[test]
fn everything_has_a_name_and_room_on_every_screen() {
    let Some((mut browser, _dir)) = opened(&scenes::scene("rbf", 3)) else { return };
    for tab in ["look", "views", "path", "measure"] {
        browser.evaluate(&format!("document.getElementById('tab-{tab}').click()"));
        let tree = browser.ask("Accessibility.getFullAXTree", json!({}));
        let mut controls = 0;
        for node in tree["nodes"].as_array().expect("nodes").iter().filter(|n| n["ignored"] != true) {
            let role = node["role"]["value"].as_str().unwrap_or_default();
            if [
                "button",
                "slider",
                "radio",
                "switch",
                "checkbox",
                "combobox",
                "tab",
                "textbox",
                "spinbutton",
                "application",
                "img",
            ]
            .contains(&role)
            {
                controls += 1;
                let name = node["name"]["value"].as_str().unwrap_or_default();
                // Thumbnails are inside a button that has the name.
                assert!(
                    !name.trim().is_empty() || role == "img",
                    "a {role} without a name on the tab {tab}: {node}"
                );
            }
        }
        assert!(controls > 12, "{controls}");
    }
    for scheme in ["light", "dark"] {
        browser.scheme(scheme);
        for (width, height, phone) in
            [(320, 640, true), (390, 780, true), (568, 320, true), (640, 320, true), (1280, 720, false)]
        {
            browser.resize(width, height, phone);
            for tab in ["look", "views", "path", "measure"] {
                browser.evaluate(&format!("document.getElementById('tab-{tab}').click()"));
                let outside = browser.evaluate(
                    "[...document.querySelectorAll('button, input, select, .choice, h1')].filter(e => e.offsetParent && !e.closest('dialog, #cameras'))
                      .filter(e => { const b = e.getBoundingClientRect(); return b.width && (b.left < -1 || b.right > innerWidth + 1); }).map(e => e.id || e.textContent)",
                );
                assert_eq!(outside, json!([]), "{width} px, {tab}");
                assert_eq!(
                    browser.evaluate("document.documentElement.scrollWidth <= innerWidth"),
                    json!(true)
                );
            }
        }
        // Every button below the picture can be reached, and covers nothing; the same holds for the button
        // that unfolds.
        for (width, height) in [(320, 480), (320, 640), (390, 780), (568, 320), (640, 320)] {
            browser.resize(width, height, true);
            browser.evaluate("document.getElementById('tab-path').click(), use3d.viewer.setCompare('clear')");
            for folded in [false, true] {
                browser.evaluate(&format!(
                    "document.body.classList.contains('folded') === {folded} || document.getElementById('fold').click()"
                ));
                let wrong = browser.evaluate(
                    "(() => { const box = e => e.getBoundingClientRect(), main = box(document.querySelector('main')), buttons = [...document.querySelectorAll('#tools button')], wrong = [];
                      const over = (a, b) => a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;
                      const names = [...document.querySelectorAll('p.name')].filter(e => e.offsetParent);
                      if (names.length !== 2) wrong.push('names');
                      for (const e of buttons.filter(e => e.offsetParent)) { const b = box(e);
                        if (b.left < main.left || b.right > main.right || b.top < main.top || b.bottom > main.bottom) wrong.push(`${e.id} outside`); }
                      for (const e of [document.getElementById('tools'), ...(document.body.classList.contains('folded') ? [document.getElementById('panel')] : [])])
                        for (const name of names) if (over(box(e), box(name))) wrong.push(`${e.id} over ${name.id}`);
                      for (const id of ['do-level', 'do-picture', 'do-help']) if (!document.getElementById(id).offsetParent) wrong.push(`${id} hidden`);
                      for (const id of ['save-path', 'play']) if (document.getElementById(id).offsetHeight > 44) wrong.push(`${id} in two lines`);
                      return wrong; })()",
                );
                assert_eq!(wrong, json!([]), "{width}x{height}, folded {folded}");
            }
        }
        browser.resize(1280, 720, false);
        browser.evaluate("document.getElementById('tab-look').click(), use3d.viewer.setCompare(null)");
        // The contrast of text against its background, by the rule of WCAG.
        let faint = browser.evaluate(
            "(() => { const channel = v => { v /= 255; return v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4; };
              const light = c => 0.2126 * channel(c[0]) + 0.7152 * channel(c[1]) + 0.0722 * channel(c[2]);
              const color = text => text.match(/[\\d.]+/g).map(Number), ground = e => { for (; e; e = e.parentElement) { const c = color(getComputedStyle(e).backgroundColor); if (c.length < 4 || c[3] > 0.8) return c; } return [0, 0, 0]; };
              return [...document.querySelectorAll('#panel label, #panel p, #panel button, #panel h2, #panel .choice span')].filter(e => e.offsetParent && !e.matches(':disabled') && !e.closest('.slider:has(:disabled)')).map(e => {
                const a = light(color(getComputedStyle(e).color)), b = light(ground(e)); return [(Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05), e.textContent]; }).filter(([ratio]) => ratio < 4.5); })()",
        );
        assert_eq!(faint, json!([]), "{scheme}");
    }
    assert_eq!(browser.complaints, Vec::<String>::new());
}
