//! Inputs that a user names: found, or said to be missing before anything is
//! computed. Nothing takes their place.

use std::path::{Path, PathBuf};
use std::process::Command;

/// Runs the command in `dir` without the variables that name data, and expects an exit
/// code; gives stdout and stderr.
fn expect(code: i32, dir: &Path, arguments: &[&str]) -> (String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_use3d"));
    command.args(arguments).current_dir(dir);
    for variable in ["USE3D_CACHE", "USE3D_MODELS", "RUST_LOG", "UIEB", "SEATHRU", "SEATHRU_D", "DRUVA"] {
        command.env_remove(variable);
    }
    let output = command.output().expect("the command starts");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    let (out, err) = (text(&output.stdout), text(&output.stderr));
    assert_eq!(output.status.code(), Some(code), "use3d {arguments:?}\n{out}\n{err}");
    (out, err)
}

#[test]
fn the_plan_of_every_shipped_pipeline_names_the_pairs_that_are_missing() {
    let dir = tempfile::tempdir().expect("folder");
    let pipelines = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../pipelines");
    for name in [
        "use26.toml",
        "seathru4.toml",
        "druva20.toml",
        "d3-d5.toml",
        "ablation-stage1.toml",
        "ablation-stage2.toml",
    ] {
        let file = pipelines.join(name).to_string_lossy().into_owned();
        let (out, _) = expect(1, dir.path(), &["plan", &file, "--cache", "cache"]);
        let line =
            out.lines().find(|l| l.contains("pairs: input")).unwrap_or_else(|| panic!("{name}: {out}"));
        for word in ["cannot", "`calibrator.pairs.input` in ", name, "UIEB is not set"] {
            assert!(line.contains(word), "{name}: {line}");
        }
    }
}

#[test]
fn a_mistyped_folder_fails_the_run_and_is_said_by_the_plan() {
    let dir = tempfile::tempdir().expect("folder");
    let capture = "reef";
    expect(0, dir.path(), &["-q", "synth", "capture", "--out", capture, "--views", "5", "--size", "64x48"]);
    let pipeline: PathBuf = dir.path().join("p.toml");
    let text = "name = \"p\"\n[calibrator]\npairs = { input = \"nope/a\", target = \"nope/b\" }\n[[scene]]\nname = \"reef\"\ncapture = \"reef\"\n";
    std::fs::write(&pipeline, text).expect("written");
    let (json, _) = expect(1, dir.path(), &["plan", "p.toml", "--json", "--cache", "cache"]);
    assert!(json.contains("\"unavailable\"") && json.contains("nope/a does not exist"), "{json}");
    let (out, _) =
        expect(1, dir.path(), &["-q", "run", "p.toml", "--until", "calibrate", "--cache", "cache"]);
    assert!(out.contains("failed   pairs") && out.contains("nope/a does not exist"), "{out}");
    let pairs = ["--pairs", "absent", "reef/images"];
    let plan = ["plan", capture, "--cache", "cache"];
    let (out, _) = expect(1, dir.path(), &[&plan[..], &pairs].concat());
    assert!(out.contains("named by --pairs: absent does not exist"), "{out}");
    let (out, _) = expect(1, dir.path(), &[&plan[..], &["--models", "no-models"]].concat());
    assert!(out.contains("named by --models or USE3D_MODELS: no-models does not exist"), "{out}");
    let by_hand = ["calibrate", "--input", "absent", "--target", "reef/images", "--out", "c.safetensors"];
    let (_, err) = expect(2, dir.path(), &by_hand);
    assert!(err.contains("--input: absent does not exist; correct the path\n"), "{err}");
}

#[test]
fn the_log_says_which_depth_prior_is_in_force_and_why() {
    let dir = tempfile::tempdir().expect("folder");
    let at = dir.path();
    expect(0, at, &["-q", "synth", "capture", "--out", "reef", "--views", "9", "--size", "64x48"]);
    let mut count = 0;
    let mut said = |sets: &[&str]| {
        count += 1;
        let out = format!("scene-{count}");
        let mut arguments = vec!["reconstruct", "reef", "--out", &out, "--set", "iterations=2"];
        sets.iter().for_each(|set| arguments.extend(["--set", set]));
        expect(0, at, &arguments).1
    };
    let own = "depth prior: the capture's own files, 7 of 7 training views";
    assert!(said(&[]).contains(own) && said(&["depth_prior=folder"]).contains(own));
    let off = said(&["depth_prior=off"]);
    assert!(off.contains("depth prior: none, the depth term is off (depth_prior = \"off\")"), "{off}");
    std::fs::remove_dir_all(at.join("reef/depth")).expect("removed");
    let none = said(&[]);
    assert!(none.contains("depth prior: none") && none.contains("Depth Anything V2"), "{none}");
    let asked = said(&["depth_prior=folder"]);
    assert!(
        asked.contains("although depth_prior asks for files: the capture has no depth folder"),
        "{asked}"
    );
}
