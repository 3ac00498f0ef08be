//! Tests that no file of the user is lost and that nothing is written outside the given folders: hostile
//! names, folders of other programs, results of this program.

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use use3d_synth::{CaptureParams, write_capture};

/// A temporary folder, in which the commands run.
struct Place(tempfile::TempDir);

impl Place {
    fn new() -> Self {
        Self(tempfile::tempdir().expect("a folder"))
    }

    fn at(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn write(&self, name: &str, text: &str) {
        let path = self.at(name);
        std::fs::create_dir_all(path.parent().expect("a parent")).expect("a folder");
        std::fs::write(path, text).expect("written");
    }

    fn read(&self, name: &str) -> String {
        String::from_utf8_lossy(&std::fs::read(self.at(name)).unwrap_or_default()).into_owned()
    }

    /// Makes a capture of a few tiny views.
    fn capture(&self, name: &str) {
        let params = CaptureParams {
            views: 4,
            width: 48,
            height: 32,
            detail: 0.1,
            points: 200,
            ..CaptureParams::default()
        };
        write_capture(&params, &self.at(name), &mut |_, _| ()).expect("a capture");
    }

    fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_use3d"));
        command.args(arguments).current_dir(self.0.path());
        command.env_remove("USE3D_CACHE").env_remove("USE3D_MODELS").env_remove("RUST_LOG");
        command
    }

    /// Runs the command, expects an exit code, and returns its output.
    fn expect(&self, code: i32, arguments: &[&str]) -> String {
        let (found, said) = self.run(arguments);
        assert_eq!(found, Some(code), "use3d {arguments:?}\n{said}");
        said
    }

    /// Runs the command, expects an error, and returns its output.
    fn refused(&self, arguments: &[&str]) -> String {
        let (found, said) = self.run(arguments);
        assert!(matches!(found, Some(1 | 2)), "use3d {arguments:?}\n{said}");
        said
    }

    fn run(&self, arguments: &[&str]) -> (Option<i32>, String) {
        let Output { status, stdout, stderr } = self.command(arguments).output().expect("the command starts");
        let said = format!("{}{}", String::from_utf8_lossy(&stdout), String::from_utf8_lossy(&stderr));
        assert!(!said.contains('\u{1b}'), "a name commands the terminal: {said:?}");
        (status.code(), said)
    }

    /// Everything below the folder, with its bytes; links with the path that they point to.
    fn all(&self) -> Vec<(PathBuf, Vec<u8>)> {
        let mut all = Vec::new();
        let mut open = vec![self.0.path().to_path_buf()];
        while let Some(path) = open.pop() {
            let kind = path.symlink_metadata().expect("there").file_type();
            if kind.is_dir() {
                let inside = std::fs::read_dir(&path).expect("readable");
                open.extend(inside.map(|entry| entry.expect("an entry").path()));
            } else if kind.is_symlink() {
                let target = path.read_link().expect("a link");
                all.push((path, target.into_os_string().into_encoded_bytes()));
            } else if kind.is_file() {
                let bytes = std::fs::read(&path).expect("readable");
                all.push((path, bytes));
            } else {
                all.push((path, b"special".to_vec()));
            }
        }
        all.sort();
        all
    }
}

fn text(path: &Path) -> String {
    path.to_string_lossy().into_owned()
}

fn scene() -> String {
    text(&use3d_golden::root().join("scene-mini/scene"))
}

/// A list with one camera for each name.
fn cameras(names: &[&str]) -> String {
    let camera = |name: &&str| {
        serde_json::json!({"name": name, "width": 16, "height": 12, "fx": 15, "fy": 15, "cx": 8, "cy": 6,
            "rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "translation": [0, 0, 4]})
    };
    serde_json::Value::from_iter(names.iter().map(camera)).to_string()
}

#[test]
fn a_prepared_capture_of_somebody_else_writes_nowhere_but_in_the_result() {
    let place = Place::new();
    place.capture("cap");
    place.expect(0, &["-q", "import", "cap", "--out", "prepared"]);
    place.write("home/.profile", "good");
    // The second view's result would be `<name>.profile`; its file is a picture followed by other bytes.
    let mut forged: serde_json::Value =
        serde_json::from_str(&place.read("prepared/capture.json")).expect("JSON");
    let image = forged["views"][1]["image"].as_str().expect("a name").to_string();
    let mut bytes = std::fs::read(place.at("prepared").join(image)).expect("an image");
    bytes.extend(b"\ntouch owned\n");
    std::fs::write(place.at("prepared/images/x.profile"), bytes).expect("written");
    forged["views"][1]["image"] = "images/x.profile".into();
    for name in [format!("{}/", text(&place.at("home"))), "../../../home/".into(), "\u{1b}[2Jx.png".into()] {
        forged["views"][1]["name"] = name.clone().into();
        place.write("prepared/capture.json", &forged.to_string());
        let before = place.all();
        let said = place.refused(&["-q", "import", "prepared", "--out", "deep/er/out"]);
        assert!(said.contains("capture.json") && said.contains("the name"), "{said}");
        place
            .command(&["-q", "run", "prepared", "--cache", "cache", "--until", "import"])
            .output()
            .expect("runs");
        std::fs::remove_dir_all(place.at("cache")).expect("a cache");
        let _ = std::fs::remove_dir_all(place.at("use3d-out"));
        let _ = std::fs::remove_dir_all(place.at("deep"));
        assert!(place.all() == before, "{name}");
    }
}

#[test]
fn names_of_cameras_lead_nowhere_else_and_do_not_collide() {
    let place = Place::new();
    place.write("photos/wedding.png", "mine");
    let absolute = text(&place.at("photos/wedding.x"));
    let model = |name: &str| {
        place.write("model/cameras.txt", "1 PINHOLE 16 12 15 15 8 6\n");
        place.write("model/points3D.txt", "");
        place.write("model/images.txt", &format!("1 1 0 0 0 0 0 4 1 {name}\n\n"));
    };
    for evil in ["../../photos/wedding.x", &absolute, "..\\..\\photos\\wedding.x", "a\u{1b}]0;x\u{7}.png"] {
        place.write("cameras.json", &cameras(&["0000.png", evil]));
        model(evil);
        let before = place.all();
        for from in ["cameras.json", "model"] {
            let said =
                place.expect(2, &["render", &scene(), "--cameras", from, "--out", "r", "--modes", "clear"]);
            assert!(said.contains("the name"), "{said}");
        }
        assert!(place.all() == before, "{evil}");
    }
    place.write("cameras.json", &cameras(&["left/a.png", "left/a.jpg"]));
    let said = place.expect(2, &["render", &scene(), "--cameras", "cameras.json", "--out", "r"]);
    assert!(said.contains("left/a.png and left/a.jpg") && !place.at("r").exists(), "{said}");
}

#[test]
fn pictures_films_and_splats_replace_only_what_is_meant() {
    let place = Place::new();
    place.write("cameras.json", &cameras(&["a.png", "b.png"]));
    let render = |code: i32, more: &[&str]| {
        let scene = scene();
        let mut arguments = vec!["render", &scene, "--cameras", "cameras.json"];
        arguments.extend(more);
        place.expect(code, &arguments)
    };
    let said = render(0, &["--out", "r", "--video", "films/f.y4m"]);
    assert!(said.contains("r: 2 frames") && said.contains("films/f.y4m: 2 frames"), "{said}");
    place.write("r/reconstruction/b.png", "mine");
    let before = place.all();
    assert!(render(2, &["--out", "r"]).contains("--force"));
    assert!(render(2, &["--video", "films/f.y4m"]).contains("--force"));
    assert!(place.all() == before);
    render(0, &["--out", "r", "--video", "films/f.y4m", "--force"]);
    assert_ne!(place.read("r/reconstruction/b.png"), "mine");

    let export = |code: i32, ply: &str, force: bool| {
        let scene = scene();
        let mut arguments = vec!["export", &scene, "--ply", ply];
        arguments.extend(force.then_some("--force"));
        place.expect(code, &arguments)
    };
    for water in ["-0.5", "nan", "1.5"] {
        let water = format!("--water={water}");
        let said = place.expect(2, &["export", &scene(), "--web", "a.html", "--ply", "a.ply", &water]);
        assert!(said.contains("--water") && said.contains("expected 0 to 1"), "{said}");
        assert!(!place.at("a.html").exists(), "nothing is written before the check");
    }
    let said = place.expect(2, &["white", &scene(), "--out", "white.json"]);
    assert!(said.contains("no white balance to write"), "{said}");
    assert!(export(0, "no/such/dir/a.ply", false).contains("no/such/dir/a.ply: "));
    assert!(export(2, "no/such/dir/a.ply", false).contains("--force"));
    export(0, "no/such/dir/a.ply", true);
    std::fs::create_dir(place.at("folder.ply")).expect("a folder");
    #[cfg(unix)]
    {
        place.write("precious", "mine");
        std::os::unix::fs::symlink(place.at("precious"), place.at("link.ply")).expect("a link");
        Command::new("mkfifo").arg(place.at("pipe.ply")).status().expect("a pipe");
    }
    let before = place.all();
    for (ply, why) in [
        ("-", "name of a file"),
        ("a.splat", ".ply"),
        ("folder.ply", "folder"),
        ("link.ply", "regular"),
        ("pipe.ply", "regular"),
    ] {
        if place.at(ply).symlink_metadata().is_err() && !["-", "a.splat"].contains(&ply) {
            continue; // systems without links
        }
        let said = export(2, ply, true);
        assert!(said.contains(why), "{said}");
        assert!(place.all() == before, "{ply}");
    }
}

#[test]
fn folders_of_others_are_refused_and_our_own_are_replaced_when_meant() {
    let place = Place::new();
    place.capture("cap");
    // Other programs use these file names too.
    for file in ["scene.json", "capture.json", "scores.json"] {
        place.write(&format!("project/{file}"), "{}");
    }
    place.write("project/src/thesis.txt", "thesis");
    let before = place.all();
    let steps = ["--set", "iterations=2"];
    for out in ["project", "."] {
        for force in [None, Some("--force")] {
            let mut import = vec!["-q", "import", "cap", "--out", out];
            import.extend(force);
            let said = place.expect(2, &import);
            assert!(said.contains("--out"), "{said}");
            let mut reconstruct = vec!["-q", "reconstruct", "cap", "--out", out];
            reconstruct.extend(steps.iter().copied().chain(force));
            place.expect(2, &reconstruct);
        }
    }
    assert!(place.all() == before);

    let make = |code: i32, steps: &str, force: Option<&str>| {
        let mut arguments = vec!["reconstruct", "cap", "--out", "my scene", "--set", steps];
        arguments.extend(force);
        place.expect(code, &arguments)
    };
    let said = make(0, "iterations=2", None);
    assert!(said.contains("my scene: ") && said.contains("next: use3d render 'my scene'"), "{said}");
    place.write("my scene/notes.txt", "mine");
    let before = place.all();
    assert!(make(2, "iterations=3", None).contains("--force"));
    assert!(place.all() == before, "refused and touched");
    make(0, "iterations=3", Some("--force"));
    assert_eq!(place.read("my scene/notes.txt"), "mine");
    let old = before.iter().find(|(path, _)| path.ends_with("gaussians.ply")).expect("a scene");
    assert_ne!(std::fs::read(&old.0).expect("a scene"), old.1, "not replaced");
    // An edited file belongs to the user.
    place.write("my scene/evaluation.json", "edited");
    assert!(make(2, "iterations=2", Some("--force")).contains("evaluation.json"));
    assert_eq!(place.read("my scene/evaluation.json"), "edited");
}

#[test]
fn a_run_replaces_its_own_results_and_refuses_what_others_put_there() {
    let place = Place::new();
    place.capture("dl/cap");
    let run = |code: i32, steps: &str| {
        let out = "dl";
        let arguments =
            ["run", "dl/cap", "--cache", "cache", "--out", out, "--until", "reconstruct", "--set", steps];
        place.expect(code, &arguments)
    };
    // Results would go into the capture's own folder, in which the user keeps a scene of another program.
    place.write("dl/cap/scene/reef.blend", "mine");
    let before = place.all();
    let said = run(2, "reconstruct.iterations=2");
    assert!(said.contains("dl/cap/scene") && !said.contains("reconstruct: learn"), "{said}");
    let without_cache = |all: Vec<(PathBuf, Vec<u8>)>| -> Vec<_> {
        all.into_iter().filter(|(path, _)| !path.starts_with(place.at("cache"))).collect()
    };
    assert!(without_cache(place.all()) == before);

    // The tables of all scenes would lie among the results of this one.
    place.capture("tables");
    let said = place.expect(2, &["run", "tables", "--cache", "cache", "--out", "dl"]);
    assert!(said.contains("rename the scene") && !said.contains("import: read"), "{said}");

    std::fs::remove_dir_all(place.at("dl/cap/scene")).expect("removed");
    run(0, "reconstruct.iterations=2");
    let first = place.read("dl/cap/scene/gaussians.ply");
    place.write("dl/cap/scene/notes.txt", "mine");
    run(0, "reconstruct.iterations=2");
    run(0, "reconstruct.iterations=3");
    assert_eq!(place.read("dl/cap/scene/notes.txt"), "mine");
    assert_ne!(place.read("dl/cap/scene/gaussians.ply"), first);
}

#[test]
fn a_place_that_cannot_be_written_is_named_before_anything_is_computed() {
    let place = Place::new();
    place.capture("cap");
    place.write("file", "mine");
    // Nobody, not even root, can create a folder below a file.
    for arguments in [
        &["run", "cap", "--cache", "cache", "--out", "file/out"][..],
        &["import", "cap", "--out", "file/out/prepared"],
        &["reconstruct", "cap", "--out", "file/out/scene"],
        &["render", &scene(), "--cameras", "cap", "--out", "file/out"],
        &["export", &scene(), "--ply", "file/out/a.ply"],
    ] {
        let said = place.expect(2, arguments);
        assert!(
            said.contains("file/out") && !said.contains("started") && !said.contains("--cache"),
            "{said}"
        );
    }
    assert_eq!(place.read("file"), "mine");
}

#[cfg(target_os = "linux")]
#[test]
fn a_disk_that_fills_while_results_are_written_is_no_wrong_request() {
    let place = Place::new();
    place.capture("cap");
    let run = |out| ["run", "cap", "--cache", "cache", "--out", out, "--until", "reconstruct"];
    let quick = ["--set", "reconstruct.iterations=2"];
    place.expect(0, &[&run("whole")[..], &quick].concat());
    // Files may have 16 kB, as on a full disk: every scene here is larger.
    let cramped = |arguments: &[&str]| {
        let mut shell = Command::new("sh");
        shell.args(["-c", "ulimit -f 32; trap '' XFSZ; exec \"$0\" \"$@\"", env!("CARGO_BIN_EXE_use3d")]);
        shell.args(arguments).current_dir(place.at("")).env_remove("USE3D_CACHE").env_remove("USE3D_MODELS");
        let Output { status, stderr, .. } = shell.output().expect("a shell");
        (status.code(), String::from_utf8_lossy(&stderr).into_owned())
    };
    place.write("cameras.json", &cameras(&["a.png"]).replace("16", "320").replace("12", "240"));
    for arguments in [
        &[&run("out")[..], &quick].concat()[..],
        &["export", "whole/cap/scene", "--ply", "a.ply"],
        &["render", "whole/cap/scene", "--cameras", "cameras.json", "--out", "r", "--format", "exr"],
        &["reconstruct", "cap", "--out", "by-hand", "--set", "iterations=2"],
    ] {
        let (code, said) = cramped(arguments);
        assert_eq!(code, Some(1), "use3d {arguments:?}\n{said}");
        assert!(said.contains("File too large"), "{said}");
    }
    assert!(
        !place.at("a.ply").exists() && !place.at("out/cap/scene").exists() && !place.at("by-hand").exists()
    );
}

#[test]
fn the_demo_leaves_captures_of_others_alone() {
    let place = Place::new();
    place.write("dm/captures/reef/mine.txt", "mine");
    let before = place.all();
    let said = place.expect(2, &["demo", "--out", "dm"]);
    assert!(said.contains("captures/reef"), "{said}");
    assert!(place.all() == before);
}

#[test]
fn the_demo_renders_nothing_where_its_results_cannot_go() {
    for taken in ["dm/reef/scene/mine.txt", "dm/report.html", "dm/tables/mine.txt"] {
        let place = Place::new();
        place.write(taken, "mine");
        let before = place.all();
        let said = place.expect(2, &["demo", "--out", "dm"]);
        assert!(said.contains(taken.trim_end_matches("/mine.txt")), "{taken}: {said}");
        assert!(!said.contains("synth") && place.all() == before, "{taken}: {said}");
    }
}

#[cfg(unix)]
#[test]
fn a_changed_parameter_leaves_the_checkpoint_of_an_interrupted_training() {
    let place = Place::new();
    place.capture("cap");
    let arguments = |rate: &'static str| {
        ["reconstruct", "cap", "--out", "scene", "--set", "checkpoint_steps=20", "--set", rate]
    };
    let mut long = place
        .command(&arguments("iterations=1000000"))
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("the command starts");
    // The checkpoint may be at any depth below the hidden folder.
    let find = || {
        let mut open = vec![place.at(".scene.work/v1/checkpoints")];
        while let Some(folder) = open.pop() {
            for path in std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path()) {
                if path.extension().is_some_and(|e| e == "checkpoint") {
                    return Some(path);
                }
                open.push(path);
            }
        }
        None
    };
    let started = Instant::now();
    while find().is_none() && started.elapsed() < Duration::from_secs(120) {
        std::thread::sleep(Duration::from_millis(50));
    }
    let interrupt = Command::new("kill").args(["-INT", &long.id().to_string()]).status().expect("kill");
    assert!(interrupt.success());
    assert_eq!(long.wait().expect("it ends").code(), Some(130));
    let checkpoint = find().expect("a checkpoint");
    let kept = std::fs::read(&checkpoint).expect("readable");
    let said = place.expect(0, &arguments("iterations=2"));
    assert!(said.contains("checkpoints"), "nothing said: {said}");
    assert!(std::fs::read(&checkpoint).is_ok_and(|bytes| bytes == kept), "the checkpoint is gone");
}
