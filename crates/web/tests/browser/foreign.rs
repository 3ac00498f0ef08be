//! Exported files in other viewers: drawn by [Spark](https://sparkjs.dev) on three.js, glTF files drawn by
//! three.js itself, SPZ files read by the format's own library. The versions of all three are fixed in
//! `tests/foreign/package-lock.json`.
//!
//! `npm ci --prefix crates/web/tests/foreign` installs them, or `USE3D_FOREIGN_VIEWERS` names a folder whose
//! `node_modules` has them. Spark widens every Gaussian a little and rounds colours, three.js cuts every
//! Gaussian off at two deviations. So pictures are similar, not equal. Pictures that are upside down,
//! mirrored or wrongly decoded are far beyond the tolerance (each picture's mirror image is also compared,
//! and glTF files with deliberate mistakes).

use std::io::{BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use glam::{DMat3, DVec3};
use serde_json::json;
use use3d_capture::{Camera, Frame};
use use3d_scene::{Scene, similarity};
use use3d_splat::Gaussians;
use use3d_web::foreign::{compressed_ply, glb, spz};

use crate::chromium::Chromium;
use crate::{pictures, scenes};

const PAGE: &str = r#"<!doctype html><meta charset="utf-8"><title>foreign</title>
<script type="importmap">{"imports":{"three":"/three/build/three.module.js","three/webgpu":"/three/build/three.webgpu.js","three/tsl":"/three/build/three.tsl.js","three/addons/":"/three/examples/jsm/","@sparkjsdev/spark":"/@sparkjsdev/spark/dist/spark.module.min.js","@adobe/spz":"/@adobe/spz/dist/spz.js"}}</script>
<script type="module">
import * as THREE from "three";
import * as NODES from "three/webgpu";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { GLTFGaussianSplatLoaderExtension } from "three/addons/loaders/GLTFGaussianSplatLoaderExtension.js";
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import spzModule from "@adobe/spz";
const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0));
window.read = async text => {
    const spz = await spzModule();
    const cloud = spz.loadSpzFromBuffer(bytes(text), { to: spz.CoordinateSystem.RUB });
    const names = ["positions", "scales", "rotations", "alphas", "colors", "sh"];
    return { degree: cloud.shDegree, ...Object.fromEntries(names.map(name => [name, Array.from(cloud[name])])) };
};
const placed = (camera, view) => {
    const [fx, fy, cx, cy] = view.lens, [w, h, n, f] = [view.width, view.height, 0.01, 100];
    camera.matrixAutoUpdate = false;
    camera.matrix.set(...view.matrix);
    camera.updateMatrixWorld(true);
    camera.projectionMatrix.set(2 * fx / w, 0, 1 - 2 * cx / w, 0, 0, 2 * fy / h, 2 * cy / h - 1, 0, 0, 0, -(f + n) / (f - n), -2 * f * n / (f - n), 0, 0, -1, 0);
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
    return camera;
};
const copy = document.createElement("canvas"), context = copy.getContext("2d", { willReadFrequently: true });
const settled = async (renderer, view, still, draw) => {
    const [w, h] = [copy.width, copy.height] = [view.width, view.height];
    renderer.setPixelRatio(1);
    renderer.setSize(w, h);
    renderer.setClearColor(0x000000, 1);
    let pixels = null, last = 0, calm = 0;
    // Sorting may be done elsewhere: a picture that stays as it is has been sorted.
    for (let frame = 0; frame < 200 && calm < still; frame++) {
        draw();
        context.drawImage(renderer.domElement, 0, 0);
        pixels = context.getImageData(0, 0, w, h).data;
        let sum = 0;
        for (let i = 0; i < pixels.length; i++) sum = (31 * sum + pixels[i]) | 0;
        const lit = pixels.some((v, i) => i % 4 < 3 && v > 0);
        calm = lit && sum === last ? calm + 1 : 0;
        last = sum;
        await new Promise(done => setTimeout(done, 20));
    }
    let out = "";
    for (let i = 0; i < pixels.length; i++) if (i % 4 < 3) out += String.fromCharCode(pixels[i]);
    return btoa(out);
};
const renderer = new THREE.WebGLRenderer({ antialias: false, preserveDrawingBuffer: true });
document.body.append(renderer.domElement);
window.show = async (name, text, view) => {
    const scene = new THREE.Scene(), spark = new SparkRenderer({ renderer });
    scene.add(spark);
    const mesh = new SplatMesh({ fileBytes: bytes(text), fileName: name });
    await mesh.initialized;
    scene.add(mesh);
    const camera = placed(new THREE.PerspectiveCamera(), view);
    const picture = await settled(renderer, view, 12, () => renderer.render(scene, camera));
    mesh.dispose();
    return { picture, splats: mesh.packedSplats?.numSplats ?? mesh.numSplats };
};
let nodes = null;
window.showGltf = async (text, view) => {
    if (!nodes) {
        // WebGL 2 everywhere, so that a machine with WebGPU draws the same.
        nodes = new NODES.WebGPURenderer({ antialias: false, forceWebGL: true });
        await nodes.init();
        // The file's colours are for the display already (`srgb_rec709_display`), and blend as such.
        nodes.outputColorSpace = NODES.LinearSRGBColorSpace;
        document.body.append(nodes.domElement);
    }
    const loader = new GLTFLoader();
    loader.register(parser => new GLTFGaussianSplatLoaderExtension(parser));
    const file = await loader.parseAsync(bytes(text).buffer, ""), scene = new NODES.Scene();
    scene.add(file.scene);
    let splats = 0;
    file.scene.traverse(object => { if (object.isGaussianSplat) splats += object.splatGeometry.getAttribute("position").count; });
    const camera = new NODES.PerspectiveCamera();
    // The renderer asks for another matrix where it thinks the camera's is of another kind of card.
    camera.coordinateSystem = nodes.coordinateSystem;
    placed(camera, view);
    return { picture: await settled(nodes, view, 1, () => nodes.render(scene, camera)), splats };
};
window.loaded = true;
</script>"#;

/// The folder of the viewers; `None`, with a printed reason, if they are missing. With `CI=1` that is a
/// failure.
fn modules() -> Option<PathBuf> {
    let named = std::env::var_os("USE3D_FOREIGN_VIEWERS").map(PathBuf::from);
    let folder = named.unwrap_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/foreign"));
    let modules = folder.join("node_modules");
    if ["@sparkjsdev/spark", "three", "@adobe/spz"].iter().all(|name| modules.join(name).is_dir()) {
        return Some(modules);
    }
    let how = "run `npm ci --prefix crates/web/tests/foreign`, or name a folder by USE3D_FOREIGN_VIEWERS";
    assert!(std::env::var("CI").as_deref() != Ok("1"), "no foreign viewers in {}: {how}", folder.display());
    eprintln!("SKIPPED: no foreign viewers in {}; {how}", folder.display());
    None
}

/// Serves the page and the modules to this machine while the test runs, and returns the address.
fn serve(modules: PathBuf) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
    let address = format!("http://{}/", listener.local_addr().expect("an address"));
    std::thread::spawn(move || {
        for stream in listener.incoming().flatten() {
            let modules = modules.clone();
            std::thread::spawn(move || answer(stream, &modules));
        }
    });
    address
}

fn answer(mut stream: TcpStream, modules: &Path) {
    let mut line = String::new();
    if BufReader::new(&stream).read_line(&mut line).is_err() {
        return;
    }
    let path = line.split(' ').nth(1).unwrap_or("/").trim_start_matches('/').to_string();
    let (kind, body) = match path.as_str() {
        "" => ("text/html", PAGE.as_bytes().to_vec()),
        "favicon.ico" => ("image/x-icon", Vec::new()),
        _ => ("text/javascript", std::fs::read(modules.join(path)).unwrap_or_default()),
    };
    let head = format!(
        "HTTP/1.1 200 OK\r\ncontent-type: {kind}\r\ncontent-length: {}\r\nconnection: close\r\n\r\n",
        body.len()
    );
    let _ = stream.write_all(head.as_bytes()).and_then(|()| stream.write_all(&body));
}

/// The viewer's picture of a file whose y points up, from a camera of the frame with y down. Returns
/// interleaved RGB, and the number of Gaussians that the viewer read.
fn shown(browser: &mut Chromium, name: &str, file: &[u8], camera: &Camera) -> (Vec<f32>, u64) {
    let turn = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    // three's cameras look along −z with y up: the same half turn on both sides.
    let to_world = turn * camera.pose.rotation.transpose() * turn;
    let eye = turn * camera.pose.center();
    let mut matrix = Vec::new();
    for r in 0..3 {
        matrix.extend(to_world.row(r).to_array());
        matrix.push(eye[r]);
    }
    matrix.extend([0.0, 0.0, 0.0, 1.0]);
    let k = &camera.intrinsics;
    let view =
        json!({ "matrix": matrix, "lens": [k.fx, k.fy, k.cx, k.cy], "width": k.width, "height": k.height });
    let file = STANDARD.encode(file);
    let answer = browser.evaluate(&if name.ends_with(".glb") {
        format!("showGltf('{file}', {view})")
    } else {
        format!("show({}, '{file}', {view})", json!(name))
    });
    let bytes = STANDARD.decode(answer["picture"].as_str().expect("a picture")).expect("base64");
    (bytes.into_iter().map(|b| f32::from(b) / 255.0).collect(), answer["splats"].as_u64().unwrap_or(0))
}

/// Largest mean difference between pictures of one scene by two programs.
const BAR: f64 = 0.03;

/// Mean difference of two pictures.
fn apart(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| f64::from((a - b).abs())).sum::<f64>() / a.len() as f64
}

/// The browser with the viewers loaded.
fn opened() -> Option<Chromium> {
    let modules = modules()?;
    let mut browser = Chromium::start()?;
    browser.resize(640, 480, false);
    browser.go(&serve(modules));
    browser.until("window.loaded");
    Some(browser)
}

/// A scene without water, and its Gaussians with y up.
fn scene() -> (Scene, Gaussians) {
    let mut scene = scenes::scene("none", 3);
    // Spark keeps mean colours between black and white, so none may be outside.
    scene.gaussians.sh.iter_mut().flatten().flatten().for_each(|v| *v *= 0.4);
    let up = Frame {
        scale: 1.0,
        rotation: DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)),
        translation: DVec3::ZERO,
    };
    let turned = similarity::apply(&scene.gaussians, &up);
    (scene, turned)
}

#[test]
fn the_formats_own_library_reads_what_is_written() {
    let Some(mut browser) = opened() else { return };
    let (_, g) = scene();
    for version in [spz::Version::Three, spz::Version::Four] {
        let mut file = Vec::new();
        spz::write(&g, version, &mut file).expect("an SPZ");
        let read = browser.evaluate(&format!("read('{}')", STANDARD.encode(&file)));
        let array = |name: &str| -> Vec<f32> {
            let values = read[name].as_array().expect("an array").iter();
            values.map(|v| v.as_f64().map_or(f32::NAN, |v| v as f32)).collect()
        };
        let largest = |name: &str, ours: &[f32]| {
            let theirs = array(name);
            assert_eq!(theirs.len(), ours.len(), "{version:?}, {name}");
            theirs.iter().zip(ours).map(|(a, b)| (a - b).abs()).fold(0.0f32, f32::max)
        };
        assert_eq!(read["degree"], 3);
        assert!(largest("positions", g.means.as_flattened()) < 1.3e-4);
        assert!(largest("scales", g.log_scales.as_flattened()) < 0.032);
        let colours: Vec<f32> = g.sh.iter().flat_map(|sh| sh[0]).collect();
        assert!(largest("colors", &colours) < 0.014);
        let harmonics: Vec<f32> = g.sh.iter().flat_map(|sh| sh[1..].as_flattened().to_vec()).collect();
        assert!(largest("sh", &harmonics) < 0.063);
        let opacity = |logit: &f32| 1.0 / (1.0 + use3d_numerics::math::exp(-logit));
        for (theirs, ours) in array("alphas").iter().zip(&g.opacity_logits) {
            assert!((opacity(theirs) - opacity(ours)).abs() < 0.003);
        }
        for (theirs, [w, x, y, z]) in array("rotations").chunks_exact(4).zip(&g.quaternions) {
            let norm = (w * w + x * x + y * y + z * z).sqrt();
            let cosine = (theirs[0] * x + theirs[1] * y + theirs[2] * z + theirs[3] * w) / norm;
            assert!(cosine.abs() > 1.0 - 1e-5, "{version:?}: {theirs:?}, written {:?}", [x, y, z, w]);
        }
    }
}

/// Half a turn about x, a quaternion xyzw: from y down to y up.
const HALF_TURN: [f32; 4] = [1.0, 0.0, 0.0, 0.0];

#[test]
fn another_viewer_draws_what_the_program_draws() {
    let Some(mut browser) = opened() else { return };
    let (scene, turned) = scene();
    let mut files: Vec<(&str, Vec<u8>)> =
        ["scene.ply", "compressed.ply", "scene.spz", "scene.glb"].map(|name| (name, Vec::new())).into();
    use3d_splat::ply::write_with_comments(&turned, &[], &mut files[0].1).expect("a PLY");
    compressed_ply::write(&turned, &[], &mut files[1].1).expect("a compressed PLY");
    spz::write(&turned, spz::Version::Three, &mut files[2].1).expect("an SPZ");
    // The node rotates the Gaussians.
    glb::write(&scene.gaussians, "", HALF_TURN, &mut files[3].1).expect("a GLB");
    let cameras = scenes::cameras(3, 240, 160);
    for camera in &cameras {
        let ours = pictures::drawn(&scene, camera, "clear", 0.0, 0.0);
        let mut mirrored = ours.clone();
        mirrored.chunks_exact_mut(3 * camera.intrinsics.width).for_each(<[f32]>::reverse);
        for (name, file) in &files {
            let (theirs, splats) = shown(&mut browser, name, file, camera);
            assert_eq!(splats, scene.gaussians.len() as u64, "{name}");
            let (same, other) = (apart(&ours, &theirs), apart(&mirrored, &theirs));
            eprintln!("{name}: mean difference {same:.4}; of the mirrored picture {other:.4}");
            assert!(same < BAR && other > 2.5 * same, "{name}: {same:.4}, mirrored {other:.4}");
        }
    }
    let ours = pictures::drawn(&scene, &cameras[2], "clear", 0.0, 0.0);
    for (what, file) in wrong_glbs(&scene.gaussians) {
        let (theirs, _) = shown(&mut browser, "wrong.glb", &file, &cameras[2]);
        let other = apart(&ours, &theirs);
        eprintln!("{what}: mean difference {other:.4}");
        assert!(other > 1.4 * BAR, "{what}: {other:.4}");
    }
    // Errors and warnings of the viewers: unknown fields or invalid files.
    assert_eq!(browser.complaints, Vec::<String>::new());
}

/// glTF files with typical mistakes of exporters; the comparison must detect each of them.
fn wrong_glbs(right: &Gaussians) -> Vec<(&'static str, Vec<u8>)> {
    let mut swapped = right.clone();
    swapped.sh.iter_mut().flatten().for_each(|rgb| rgb.swap(0, 2));
    let mut reordered = right.clone();
    reordered.quaternions.iter_mut().for_each(|q| q.rotate_left(1));
    let mut grown = right.clone();
    grown.log_scales.iter_mut().flatten().for_each(|v| *v *= 0.5);
    let written = |(what, gaussians, turn): (&'static str, &Gaussians, [f32; 4])| {
        let mut file = Vec::new();
        glb::write(gaussians, "", turn, &mut file).expect("a GLB");
        (what, file)
    };
    let files = [
        ("not turned", right, [0.0, 0.0, 0.0, 1.0]),
        ("red and blue exchanged", &swapped, HALF_TURN),
        ("quaternions in another order", &reordered, HALF_TURN),
        ("sizes of another scale", &grown, HALF_TURN),
    ];
    files.map(written).into()
}
