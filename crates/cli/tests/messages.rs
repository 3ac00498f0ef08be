//! Tests of the command's error messages and exit codes: limits, closed pipes, signals, wrong folders. Every
//! case takes a second or two; trainings do five steps.

use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::Duration;

fn command(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_use3d"));
    command.args(arguments);
    for name in ["USE3D_CACHE", "USE3D_MODELS", "USE3D_THREADS", "RUST_LOG"] {
        command.env_remove(name);
    }
    command
}

fn use3d(arguments: &[&str]) -> Output {
    command(arguments).output().expect("the command starts")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Runs each case and checks its exit code and that stderr contains every given part.
fn check(cases: &[(&[&str], i32, &[&str])]) {
    for (arguments, code, parts) in cases {
        let output = use3d(arguments);
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(*code), "use3d {arguments:?}\n{said}");
        for part in *parts {
            assert!(said.contains(part), "use3d {arguments:?} does not say {part:?}:\n{said}");
        }
    }
}

#[test]
fn numbers_without_a_sensible_meaning_are_refused() {
    check(&[
        (&["--threads", "0", "models"], 2, &["--threads", "1 to 1024"]),
        (&["--threads", "99999999", "models"], 2, &["1 to 1024"]),
        (&["run", "reef", "--jobs", "0"], 2, &["--jobs", "1 to 256"]),
        (&["run", "reef", "--jobs", "99999999"], 2, &["1 to 256"]),
        (&["render", "s", "--cameras", "c", "--out", "o", "--frames", "0"], 2, &["--frames", "1 to 1000000"]),
        (&["render", "s", "--cameras", "c", "--out", "o", "--frames", "99999999999"], 2, &["1 to 1000000"]),
        (&["synth", "pairs", "--out", "p", "--views", "0"], 2, &["--views is 0", "1 to 100000"]),
    ]);
}

#[test]
fn a_closed_pipe_ends_quietly_and_a_full_disk_does_not() {
    let dir = tempfile::tempdir().unwrap();
    let models = dir.path().to_str().unwrap();
    for arguments in [&["models", "--dir", models][..], &["models", "--json", "--dir", models]] {
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let output = command(arguments).stdout(writer).stderr(Stdio::piped()).output().unwrap();
        assert_eq!((output.status.code(), text(&output.stderr)), (Some(0), String::new()), "{arguments:?}");
    }
    // Without a reader of its messages, the command must not panic.
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let output = command(&["export", "nowhere", "--ply", "x.ply"]).stderr(writer).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
    #[cfg(target_os = "linux")]
    {
        let full = std::fs::File::options().write(true).open("/dev/full").unwrap();
        let output =
            command(&["models", "--dir", models]).stdout(full).stderr(Stdio::piped()).output().unwrap();
        let said = text(&output.stderr);
        assert!(output.status.code() == Some(1) && said.contains("standard output"), "{said}");
    }
}

/// Starts a long command, sends it a signal once `begun` returns true, and returns its exit code.
#[cfg(unix)]
fn interrupted(arguments: &[&str], signal: &str, begun: impl Fn() -> bool) -> Option<i32> {
    let mut child = command(arguments).stderr(Stdio::null()).stdout(Stdio::null()).spawn().unwrap();
    while !begun() {
        assert!(child.try_wait().unwrap().is_none(), "use3d {arguments:?} ended before it was interrupted");
        std::thread::sleep(Duration::from_millis(5));
    }
    let sent = Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap();
    assert!(sent.success());
    // An ignored signal makes the test fail instead of hang.
    for _ in 0..6000 {
        if let Some(status) = child.try_wait().unwrap() {
            return status.code();
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    child.kill().unwrap();
    child.wait().unwrap().code()
}

/// Returns true if this process, and so its child processes, ignores hang-ups, as under `nohup`.
#[cfg(unix)]
fn ignores_hang_ups() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    // The lowest bit is signal 1, SIGHUP.
    ignored.and_then(|bits| u64::from_str_radix(bits.trim(), 16).ok()).is_some_and(|bits| bits & 1 == 1)
}

#[cfg(unix)]
#[test]
fn synthetic_data_that_is_interrupted_leaves_nothing_behind() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let entries = || std::fs::read_dir(dir.path()).unwrap().count();
    let cases = [
        ("pairs", "9999", "-INT"),
        ("pairs", "9999", "-TERM"),
        ("pairs", "9999", "-HUP"),
        ("capture", "99", "-TERM"),
    ];
    for (what, views, signal) in cases {
        if signal == "-HUP" && ignores_hang_ups() {
            println!("skipped: hang-ups are ignored here, and stay so by design");
            continue;
        }
        let arguments =
            ["-q", "synth", what, "--out", out.to_str().unwrap(), "--views", views, "--size", "32x24"];
        assert_eq!(interrupted(&arguments, signal, || entries() > 0), Some(130), "{what} {signal}");
        assert_eq!(entries(), 0, "{what} {signal}");
    }
}

#[test]
fn folders_of_images_that_cannot_be_scored_are_said_by_name() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name).to_str().unwrap().to_string();
    let picture = use3d_capture::Image::filled(16, 12, 0.5);
    use3d_io_image::write_png(Path::new(&at("a/one.png")), &picture).unwrap();
    use3d_io_image::write_png(Path::new(&at("b/two.png")), &picture).unwrap();
    std::fs::create_dir(at("empty")).unwrap();
    let (a, b, empty, nowhere) = (at("a"), at("b"), at("empty"), at("nowhere"));
    check(&[
        (&["evaluate", "--images", &a, "--reference", &b], 2, &["one", "two", "without its extension"]),
        (&["evaluate", "--images", &nowhere], 2, &["--images", "there is no such folder"]),
        (&["evaluate", "--images", &empty], 2, &["--images", "no images here"]),
        (&["evaluate", "--images", &a, "--reference", &nowhere], 2, &["--reference", "no such folder"]),
        (&["evaluate", "--images", &a], 0, &[]),
        (&["models", "--dir", &nowhere], 2, &["--dir", "there is no such folder"]),
    ]);
}

/// The golden scene's photographs and model as a capture folder.
fn capture(dir: &Path) -> String {
    let golden = use3d_golden::root().join("scene-mini");
    let to = dir.join("reef");
    for (from, below) in [("images", "images"), ("sparse/binary", "sparse/0")] {
        std::fs::create_dir_all(to.join(below)).unwrap();
        for entry in std::fs::read_dir(golden.join(from)).unwrap() {
            let entry = entry.unwrap();
            std::fs::copy(entry.path(), to.join(below).join(entry.file_name())).unwrap();
        }
    }
    to.to_str().unwrap().to_string()
}

#[test]
fn a_stage_that_fails_by_hand_exits_with_1_and_bad_input_with_2() {
    let dir = tempfile::tempdir().unwrap();
    let reef = capture(dir.path());
    let at = |name: &str| dir.path().join(name).to_str().unwrap().to_string();
    // The capture is right, but the training diverges.
    let mut arguments = vec!["-q", "reconstruct", &reef, "--out"];
    let failed = at("failed");
    arguments.extend([failed.as_str(), "--set", "iterations=3", "--set", "random_points=200"]);
    arguments.extend(["--set", "learning_rates.means=[1e300, 1e300]"]);
    check(&[(&arguments, 1, &["not finite"])]);
    std::fs::remove_file(Path::new(&reef).join("sparse/0/points3D.bin")).unwrap();
    check(&[
        (&["import", &reef, "--out", &at("out")], 2, &["lacks points3D.bin"]),
        (&["reconstruct", &reef, "--out", &at("out")], 2, &["lacks points3D.bin"]),
        (
            &["export", &at("nowhere"), "--ply", &at("x.ply")],
            2,
            &["there is no such folder", "a scene folder"],
        ),
    ]);
    let help = use3d(&["--help"]);
    assert!(text(&help.stdout).contains("Exit codes: 0 done; 1 a stage failed; 2 wrong usage"));
}

#[test]
fn settings_are_explained() {
    let dir = tempfile::tempdir().unwrap();
    let reef = capture(dir.path());
    let out = dir.path().join("out").to_str().unwrap().to_string();
    let by_hand =
        |set: &str, parts: &[&str]| check(&[(&["import", &reef, "--out", &out, "--set", set], 2, parts)]);
    by_hand("size=640", &["\"640\" is not a size", "1400x933"]);
    by_hand("size=0x0", &["\"0x0\" is not a size"]);
    by_hand("downscale=-5", &["expected a whole number, 0 or more, found -5"]);
    by_hand("white_balance=blue", &["`blue` is not known here", "set-percentile"]);
    let cache = dir.path().join("cache").to_str().unwrap().to_string();
    let piped =
        |set: &str, parts: &[&str]| check(&[(&["plan", &reef, "--cache", &cache, "--set", set], 2, parts)]);
    piped("iterations=100", &["STAGE.PARAMETER", "`reconstruct.iterations`", "`enhance.iterations`"]);
    piped("anchors=100000", &["did you mean `reconstruct.anchors`"]);
    piped("reconstruct.anchors=100000", &["`anchors` is 100000; expected 1 to 4096"]);
    piped("reconstruct.iterations=many", &["expected a whole number, 0 or more, found \"many\""]);
    piped("calibrate.trust=5", &["`trust` is 5; expected 0 to 1"]);
    // The error comes before a single picture is rendered.
    let demo = dir.path().join("demo").to_str().unwrap().to_string();
    check(&[(&["demo", "--out", &demo, "--set", "iterations=100"], 2, &["`reconstruct.iterations`"])]);
    assert!(!Path::new(&demo).exists());
}

#[test]
fn what_would_have_no_effect_or_lose_something_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let reef = capture(dir.path());
    let at = |name: &str| dir.path().join(name).to_str().unwrap().to_string();
    let (cache, images) = (at("cache"), at("reef/images/out"));
    let with_cache = |arguments: &[&str]| -> Vec<String> {
        arguments.iter().chain(&["--cache", &cache]).map(ToString::to_string).collect()
    };
    check(&[
        (&["evaluate", "a", "b", "--reference", "c"], 2, &["--reference", "cannot be used with"]),
        (&["evaluate", "--images", "a", "--set", "x=1"], 2, &["--set", "cannot be used with"]),
        (&["view", "a", "--scene", "b"], 2, &["--scene", "cannot be used with"]),
        (&["render", "a", "--out", "b", "--json"], 2, &["--json", "cannot be used with"]),
        (&["render", "a", "--out", "b", "--water", "50%"], 2, &["expected a number, such as 0.5"]),
        (&["export", "a", "--glb", &at("a.glb"), "--frame", "metric"], 2, &["only a PLY", "--frame metric"]),
        (&["gc", "--max-bytes", "5"], 2, &["5 has no unit", "5GB"]),
        (&["verify", "--cache", &reef], 2, &["no cache of use3d"]),
        (&["plan", &reef, "--cache", &at("")], 2, &["holds other files", "--cache"]),
        (&["plan", &reef, "--iterations", "-1"], 2, &["expected a whole number from 1"]),
        (
            &["enhance", "a", "b", "--targets", "c", "--out", &at("d"), "--set", "render.modes=x"],
            2,
            &["`render`"],
        ),
    ]);
    let borrowed = |arguments: Vec<String>, parts: &[&str]| {
        let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
        check(&[(&arguments, 2, parts)]);
    };
    let white = at("nowhere.json");
    borrowed(with_cache(&["run", &reef, "--white", &white]), &["nowhere.json", "expected a white balance"]);
    borrowed(with_cache(&["run", &reef, "--out", &images]), &["inside the files of the capture"]);
    assert!(!Path::new(&reef).join("v1").exists() && !Path::new(&reef).join("CACHEDIR.TAG").exists());
}

#[test]
fn what_is_no_capture_is_said_with_the_next_step() {
    let dir = tempfile::tempdir().unwrap();
    let reef = capture(dir.path());
    let at = |name: &str| dir.path().join(name).to_str().unwrap().to_string();
    for name in ["dive.mp4", "dive.MTS", "photo.png", "transforms.json"] {
        std::fs::write(at(name), [0xFF, 0xFE, 0x00]).unwrap();
    }
    let images = Path::new(&reef).join("images").to_str().unwrap().to_string();
    check(&[
        (&["plan", &at("dive.mp4")], 2, &["use3d prepare FILM", "use3d run FILM"]),
        (&["plan", &at("dive.MTS")], 2, &["use3d prepare FILM", "use3d run FILM"]),
        (&["run", &at("photo.png")], 2, &["one picture is not a capture"]),
        (&["run", &at("transforms.json")], 2, &["nerfstudio", "give the folder"]),
        (&["import", &at("dive.mp4"), "--out", &at("out")], 2, &["this is a file"]),
        (&["import", &images, "--out", &at("out")], 2, &["the parent folder contains a model"]),
    ]);
}

/// A pipeline file's path is printed, and may contain any character.
#[test]
fn a_plan_prints_no_character_that_commands_the_terminal() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("p.toml");
    let pipeline = "name = \"p\"\n[models]\ndir = \"m\\u001b[31m\"\n[[scene]]\nname = \"a\"\ncapture = \"./ca\\u001b[31mp\"\n";
    std::fs::write(&file, pipeline).unwrap();
    let cache = dir.path().join("cache").to_str().unwrap().to_string();
    for verb in ["plan", "status", "run"] {
        let out = dir.path().join("out");
        let results = if verb == "run" { vec!["--out", out.to_str().unwrap()] } else { Vec::new() };
        let output = use3d(&[&[verb, file.to_str().unwrap(), "--cache", &cache], &results[..]].concat());
        let said = text(&output.stdout) + &text(&output.stderr);
        assert!(!said.contains('\u{1b}'), "{verb}: {said:?}");
        assert!(verb == "status" || said.contains("ca\\u{1b}[31mp"), "{verb}: {said:?}");
    }
}

#[test]
fn whoever_asks_for_json_gets_one_document_also_of_an_error() {
    for (arguments, code) in
        [(&["plan", "nowhere", "--json"][..], 2), (&["models", "--dir", "nowhere", "--json"], 2)]
    {
        let output = use3d(arguments);
        let json: serde_json::Value = serde_json::from_slice(&output.stdout).expect("one JSON document");
        assert_eq!((output.status.code(), &json["exit_code"]), (Some(code), &code.into()));
        assert!(json["error"].as_str().unwrap().contains("nowhere"), "{json}");
    }
}

#[test]
fn parameters_completions_and_man_pages_can_be_had() {
    let dir = tempfile::tempdir().unwrap();
    let all = text(&use3d(&["params"]).stdout);
    for part in ["reconstruct.iterations = 3000   (whole number)", "import.split.every = 8", "enhance: "] {
        assert!(all.contains(part), "{part:?} is not in\n{all}");
    }
    let json = use3d(&["params", "reconstruct", "--json"]).stdout;
    let json: serde_json::Value = serde_json::from_slice(&json).unwrap();
    let medium = json[0]["parameters"].as_array().unwrap().iter().find(|p| p["name"] == "medium").unwrap();
    assert!(["rbf", "mlp", "none"].iter().all(|m| medium["kind"].as_str().unwrap().contains(m)), "{medium}");
    assert_eq!(medium["default"], "rbf");
    check(&[(&["params", "reconstuct"], 2, &["did you mean `reconstruct`"])]);
    // Every parameter has a description.
    let json: serde_json::Value = serde_json::from_slice(&use3d(&["params", "--json"]).stdout).unwrap();
    for stage in json.as_array().unwrap() {
        for parameter in stage["parameters"].as_array().unwrap() {
            assert!(!parameter["meaning"].as_str().unwrap().is_empty(), "{} {parameter}", stage["stage"]);
        }
    }
    let completions = text(&use3d(&["completions", "bash"]).stdout);
    assert!(completions.contains("complete") && completions.contains("reconstruct"));
    let out = dir.path().join("man");
    check(&[(&["man", "--out", out.to_str().unwrap()], 0, &["use3d.1"])]);
    assert!(std::fs::read_to_string(out.join("use3d.1")).unwrap().contains("use3d"));
    // Writing the same pages again needs no permission; a page that differs does, and no page is written
    // through a link.
    let man = |more: &[&str]| {
        let mut command = vec!["man", "--out", out.to_str().unwrap()];
        command.extend(more);
        use3d(&command)
    };
    assert!(man(&[]).status.success());
    std::fs::write(out.join("use3d.1"), "my notes").unwrap();
    let refused = man(&[]);
    assert_eq!((refused.status.code(), text(&refused.stderr).contains("--force")), (Some(2), true));
    assert!(man(&["--force"]).status.success());
    #[cfg(unix)]
    {
        let notes = dir.path().join("notes.txt");
        std::fs::write(&notes, "my notes").unwrap();
        std::fs::remove_file(out.join("use3d.1")).unwrap();
        std::os::unix::fs::symlink("../notes.txt", out.join("use3d.1")).unwrap();
        assert_eq!(man(&["--force"]).status.code(), Some(2));
        assert_eq!(std::fs::read_to_string(&notes).unwrap(), "my notes");
    }
}

#[test]
fn exported_files_say_what_they_are() {
    let dir = tempfile::tempdir().unwrap();
    let scene = use3d_golden::root().join("scene-mini/scene");
    let ply = |frame: &str| {
        let path = dir.path().join(format!("{frame}.ply"));
        let arguments =
            ["export", scene.to_str().unwrap(), "--ply", path.to_str().unwrap(), "--frame", frame];
        check(&[(&arguments, 0, &[frame])]);
        let bytes = std::fs::read(&path).unwrap();
        let header = text(&bytes[..bytes.len().min(600)]);
        assert!(header.contains("comment use3d ") && header.contains("comment what: clear"), "{header}");
        assert!(header.contains(&format!("comment frame: {frame}")), "{header}");
        use3d_splat::ply::read(&bytes[..]).unwrap()
    };
    let (colmap, up) = (ply("colmap"), ply("y-up"));
    for (a, b) in colmap.means.iter().zip(&up.means) {
        let expected = [a[0], -a[1], -a[2]];
        assert!(expected.iter().zip(b).all(|(e, b)| (e - b).abs() < 1e-4), "{a:?} {b:?}");
    }
}

#[test]
fn a_scene_is_not_scored_on_what_it_was_trained_with_nor_on_another_capture() {
    let dir = tempfile::tempdir().unwrap();
    let reef = capture(dir.path());
    let at = |name: &str| dir.path().join(name).to_str().unwrap().to_string();
    let (all, most) = (at("all"), at("most"));
    let quick = ["--set", "iterations=5", "--set", "random_points=200"];
    for (out, split) in [(&all, "split.every=0"), (&most, "split.every=5")] {
        let mut arguments = vec!["-q", "reconstruct", &reef, "--out", out, "--set", split];
        arguments.extend(quick);
        check(&[(&arguments, 0, &[])]);
    }
    check(&[
        (&["evaluate", &all, &reef], 2, &["was trained with", "split.every = 0"]),
        (&["evaluate", &most, &reef], 2, &["was trained with", "--set split.every=N"]),
        (&["-q", "evaluate", &most, &reef, "--set", "split.every=5"], 0, &[]),
    ]);
    // The same swim with other file names is another capture.
    let other = at("other");
    std::fs::rename(&reef, &other).unwrap();
    let model = Path::new(&other).join("sparse/0/images.bin");
    let mut bytes = std::fs::read(&model).unwrap();
    while let Some(at) = bytes.windows(5).position(|w| w == b"view_") {
        bytes[at..at + 5].copy_from_slice(b"wall_");
    }
    std::fs::write(&model, bytes).unwrap();
    for entry in std::fs::read_dir(Path::new(&other).join("images")).unwrap() {
        let from = entry.unwrap().path();
        let name = from.file_name().unwrap().to_str().unwrap().replace("view_", "wall_");
        std::fs::rename(&from, from.with_file_name(name)).unwrap();
    }
    let target = at("t.safetensors");
    check(&[
        (&["evaluate", &most, &other, "--set", "split.every=5"], 2, &["was made from another capture"]),
        (
            &["targets", &most, &other, "--calibrator", &at("c.safetensors"), "--out", &target],
            2,
            &["was made from another capture"],
        ),
        (
            &["-q", "render", &most, "--cameras", &other, "--out", &at("r"), "--size", "24x24"],
            0,
            &["warning: no camera of"],
        ),
    ]);
    assert!(!Path::new(&target).exists());
}
