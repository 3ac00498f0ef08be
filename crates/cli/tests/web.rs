//! Tests of exporting a scene for browsers and other viewers, and of drawing a camera path that the page
//! saved.

mod tiny;

use std::path::Path;
use std::process::Output;

use tiny::{Place, command};

fn run(arguments: &[&str]) -> Output {
    command().args(arguments).output().expect("the command starts")
}

fn expect(code: i32, arguments: &[&str]) -> String {
    let output = run(arguments);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(code), "{arguments:?}: {said}");
    said
}

#[test]
fn a_scene_goes_to_browsers_and_viewers_and_follows_a_path() {
    let place = Place::new();
    let (capture, scene) = (place.at("tiny"), place.at("reef/scene"));
    expect(0, &["-q", "reconstruct", &capture, "--out", &scene, "--set", "iterations=5"]);

    let page = place.at("reef.html");
    let said = expect(0, &["export", &scene, "--web", &page, "--cameras", &capture]);
    assert!(said.contains("9 photographs") && said.contains("open it in a browser"), "{said}");
    let html = std::fs::read_to_string(&page).unwrap();
    assert!(html.contains("<title>reef</title>") && html.matches("data:image/jpeg").count() == 9);
    // Every eighth view is held out, beginning with the first.
    assert_eq!(html.matches("\"heldOut\":true").count(), 2);
    assert!(expect(2, &["export", &scene, "--web", &page]).contains("--force"));
    assert!(expect(2, &["export", &scene, "--web", &place.at("reef.htm")]).contains(".html"));
    assert!(expect(2, &["export", &scene]).contains("--web"));

    let [glb, spz, compressed] = ["a.glb", "a.spz", "a.ply"].map(|name| place.at(name));
    expect(0, &["export", &scene, "--glb", &glb, "--spz", &spz, "--compressed-ply", &compressed]);
    let begins = |path: &str, bytes: &[u8]| std::fs::read(path).unwrap().starts_with(bytes);
    assert!(begins(&glb, b"glTF") && begins(&spz, &[0x1f, 0x8b]) && begins(&compressed, b"ply\n"));
    // Every file with room for text says what it cannot contain.
    let plain = place.at("plain.ply");
    let said = expect(0, &["export", &scene, "--ply", &plain, "--what", "reconstruction"]);
    assert!(said.contains("from the places of 7 photographs"), "{said}");
    for path in [&plain, &compressed, &glb] {
        let bytes = std::fs::read(path).unwrap();
        let words = use3d_web::foreign::NO_WATER.as_bytes();
        assert!(bytes.windows(words.len()).any(|w| w == words), "{path}");
    }
    let newer = place.at("b.spz");
    expect(0, &["export", &scene, "--spz", &newer, "--spz-version", "4"]);
    assert!(begins(&newer, b"NGSP\x04"));
    expect(2, &["export", &scene, "--spz", &newer, "--spz-version", "5", "--force"]);

    let path = place.at("path.json");
    let key = |time: f64, mode: &str| {
        format!(
            r#"{{"time": {time}, "center": [{time}, 0, -1], "rotation": [[1,0,0],[0,1,0],[0,0,1]], "vertical_fov_degrees": 50, "mode": "{mode}"}}"#
        )
    };
    let text = |mode: &str| {
        format!(
            r#"{{"format": "3d-use camera path", "version": 1, "frames_per_second": 2, "keys": [{}, {}]}}"#,
            key(0.0, mode),
            key(1.0, "clear")
        )
    };
    std::fs::write(&path, text("reconstruction")).unwrap();
    let (frames, film) = (place.at("frames"), place.at("film.y4m"));
    let size = ["--size", "48x32"];
    let render = |extra: &[&str]| {
        let mut arguments = vec!["render", &scene, "--path", &path];
        arguments.extend(size);
        arguments.extend(extra);
        arguments.into_iter().map(str::to_string).collect::<Vec<_>>()
    };
    let go = |code: i32, extra: &[&str]| {
        let arguments = render(extra);
        expect(code, &arguments.iter().map(String::as_str).collect::<Vec<_>>())
    };
    go(0, &["--out", &frames, "--video", &film]);
    assert_eq!(std::fs::read_dir(Path::new(&frames).join("path")).unwrap().count(), 3);
    assert!(std::fs::metadata(&film).unwrap().len() > 3 * 48 * 32);
    assert!(go(2, &["--out", &frames]).contains("--force"));
    go(0, &["--out", &frames, "--modes", "depth,clear"]);
    assert!(Path::new(&frames).join("depth").is_dir() && Path::new(&frames).join("clear").is_dir());
    // Paths of other programs, recognised by their content and their names.
    let nerfstudio = place.at("camera_path.json");
    let matrix = "[1,0,0,0, 0,-1,0,0, 0,0,-1,-1, 0,0,0,1]";
    std::fs::write(
        &nerfstudio,
        format!(r#"{{"camera_path": [{{"camera_to_world": {matrix}, "fov": 50}}], "fps": 24}}"#),
    )
    .unwrap();
    let drawn = |file: &str, out: &str| {
        let said = expect(0, &["render", &scene, "--path", file, "--size", "48x32", "--out", out]);
        (said, std::fs::read_dir(Path::new(out).join("path")).unwrap().count())
    };
    // A film has the path's own rate unless another is asked for.
    let rate = |path: &str, more: &[&str]| {
        let film = place.at("rate.y4m");
        let mut arguments =
            vec!["render", &scene, "--path", path, "--size", "48x32", "--video", &film, "--force"];
        arguments.extend(more);
        expect(0, &arguments);
        let bytes = std::fs::read(&film).unwrap();
        let head = String::from_utf8_lossy(&bytes[..60]).into_owned();
        head.split(' ').find(|word| word.starts_with('F')).unwrap().to_string()
    };
    assert_eq!([rate(&path, &[]), rate(&nerfstudio, &[])], ["F2:1", "F24:1"]);
    assert_eq!(rate(&nerfstudio, &["--frame-rate", "12"]), "F12:1");
    let (said, frames) = drawn(&nerfstudio, &place.at("nerfstudio"));
    assert!(frames == 1 && said.contains("dataparser_transforms.json"), "{said}");
    std::fs::write(
        place.at("dataparser_transforms.json"),
        r#"{"transform": [[1,0,0,0],[0,1,0,0],[0,0,1,0]], "scale": 0.5}"#,
    )
    .unwrap();
    let (said, _) = drawn(&nerfstudio, &place.at("scaled"));
    assert!(!said.contains("dataparser"), "{said}");
    let images = place.at("images.txt");
    std::fs::write(&images, "1 1 0 0 0 0 0 1 1 b.png\n\n2 1 0 0 0 0.1 0 1 1 a.png\n\n").unwrap();
    assert!(
        expect(2, &["render", &scene, "--path", &images, "--out", &place.at("no")]).contains("cameras.txt")
    );
    std::fs::write(place.at("cameras.txt"), "1 PINHOLE 96 64 80 80 48 32\n").unwrap();
    assert_eq!(drawn(&images, &place.at("colmap")).1, 2);

    std::fs::write(&path, text("enhanced")).unwrap();
    assert!(go(2, &["--out", &place.at("no")]).contains("use3d enhance"));
    std::fs::write(&path, text("sunny")).unwrap();
    assert!(go(2, &["--out", &place.at("no")]).contains("sunny"));
    for (bytes, wrong) in [(&b"\xff"[..], "not UTF-8 text"), (b"{}", "missing field")] {
        std::fs::write(&path, bytes).unwrap();
        let said = go(2, &["--out", &place.at("no")]);
        assert!(
            said.contains("--path") && said.contains(wrong) && said.contains("camera_path.json"),
            "{said}"
        );
    }
    std::fs::remove_file(&path).unwrap();
    assert!(go(2, &["--out", &place.at("no")]).contains("there is no such file"));
    assert!(
        expect(2, &["render", &scene, "--path", "spiral", "--out", &place.at("no")]).contains("--cameras")
    );
}
