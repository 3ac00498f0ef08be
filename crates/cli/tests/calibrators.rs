//! Tests of finished calibrators, this program's and the authors' (stand-ins with the same layout): in a
//! pipeline, by hand, and in the list of models.
use std::path::Path;
use std::process::Command;

use use3d_golden::torch::{released_calibrator, released_calibrator_tensors, safetensors_file};

#[allow(dead_code, reason = "each test binary uses a part of it")]
mod standin;

/// Runs the command in `dir`, expects an exit code, and returns stdout and stderr.
fn expect(code: i32, dir: &Path, arguments: &[&str]) -> (String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_use3d"));
    command.args(arguments).current_dir(dir).env("USE3D_CACHE", dir.join("cache"));
    let output = command.env_remove("USE3D_MODELS").env_remove("RUST_LOG").output().expect("it starts");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    let (out, err) = (text(&output.stdout), text(&output.stderr));
    assert_eq!(output.status.code(), Some(code), "use3d {arguments:?}\n{out}\n{err}");
    (out, err)
}

/// A folder with a tiny capture, and stand-ins for the authors' proposer and calibrator in `models/`.
fn place() -> tempfile::TempDir {
    let dir = tempfile::tempdir().expect("folder");
    expect(0, dir.path(), &["-q", "synth", "capture", "--out", "reef", "--views", "9", "--size", "64x48"]);
    let models = dir.path().join("models");
    standin::nu2net(&models);
    let file = released_calibrator(5, &released_calibrator_tensors([128, 256]));
    std::fs::write(models.join("transition_calibrator.pth"), file).expect("written");
    dir
}

const QUICK: [&str; 4] = ["--set", "reconstruct.iterations=8", "--set", "enhance.iterations=4"];
const RELEASED: &str = "models/transition_calibrator.pth";

#[test]
fn the_authors_calibrator_serves_a_whole_run_and_by_hand() {
    let dir = place();
    let at = dir.path();
    let run = ["-q", "run", "reef", "--out", "out", "--calibrator", RELEASED];
    let (out, _) = expect(0, at, &[&run[..], &QUICK].concat());
    // No pairs and no fit: the stages from import to report without them, and the baseline.
    assert!(out.contains("reef: 9 stages done, 0 kept from before"), "{out}");
    let page = std::fs::read_to_string(at.join("out/report.html")).expect("the report");
    assert!(page.contains("A finished calibrator: released by the paper"), "the report names the calibrator");

    // The same tensors as safetensors are the same calibrator; a proposer other than the calibrator's own is
    // refused (R25).
    let tensors = released_calibrator_tensors([128, 256]);
    std::fs::write(at.join("c.safetensors"), safetensors_file(&tensors)).expect("written");
    for (file, out) in [(RELEASED, "a.safetensors"), ("c.safetensors", "b.safetensors")] {
        let hand = [
            "-q",
            "targets",
            "out/reef/scene",
            "reef",
            "--models",
            "models",
            "--calibrator",
            file,
            "--out",
            out,
        ];
        expect(0, at, &hand);
    }
    let read = |name: &str| std::fs::read(at.join(name)).expect("targets");
    assert!(read("a.safetensors") == read("b.safetensors"));
    let other = [&run[..], &QUICK, &["--set", "calibrator.proposer=fusion"]].concat();
    // The error comes before anything is computed, and the plan reports the same.
    for verb in ["run", "plan"] {
        let arguments = match verb {
            "run" => other.clone(),
            _ => vec!["plan", "reef", "--calibrator", RELEASED, "--set", "calibrator.proposer=fusion"],
        };
        let (_, err) = expect(2, at, &arguments);
        assert!(err.contains("fitted for the proposer `nu2net`, but `fusion` is requested"), "{err}");
    }

    // A file that is not a calibrator is reported, with the expected kind of file.
    std::fs::write(at.join("not.pth"), "not a calibrator").expect("written");
    std::fs::write(at.join("old.pth"), released_calibrator(4, &tensors)).expect("written");
    let lists =
        ["-q", "targets", "out/reef/scene", "reef", "--models", "models", "--out", "d", "--calibrator"];
    for (file, words) in [
        ("not.pth", "the authors' transition_calibrator.pth"),
        ("old.pth", "its schema version is 4"),
        ("absent", "absent does not exist"),
    ] {
        let output = Command::new(env!("CARGO_BIN_EXE_use3d")).args(lists).arg(file).current_dir(at).output();
        let output = output.expect("it starts");
        let err = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!output.status.success() && err.contains(words), "{file}: {err}");
        assert_eq!(err.matches(file).count(), 1, "named twice: {err}");
    }

    let (list, _) = expect(0, at, &["models", "--dir", "models"]);
    let row = list.split("\n\n").find(|row| row.contains("Calibrator (3D-USE release)")).expect("a row");
    for word in
        ["found", "transition_calibrator.pth", "sha256", "Pi-Lab License", "github.com/bilityniu/3D-USE"]
    {
        assert!(row.contains(word), "{row}");
    }
}

/// The targets come from renders without water: a whole run and stages by hand, without a calibrator, and
/// errors for settings that conflict.
#[test]
fn a_scene_is_enhanced_in_clear_radiance() {
    let dir = place();
    let at = dir.path();
    let own = ["--set", "targets.proposer=fusion", "--set", "targets.source=clear"];
    let run = ["-q", "run", "reef", "--out", "out"];
    let (out, _) = expect(0, at, &[&run[..], &QUICK, &own].concat());
    // No pairs and no fit: the stages from import to report without them, and the baseline.
    assert!(out.contains("reef: 9 stages done, 0 kept from before"), "{out}");
    let page = std::fs::read_to_string(at.join("out/report.html")).expect("the report");
    assert!(page.contains("without its water. They are not calibrated."), "the report says what was done");
    let read = |path: &str| -> serde_json::Value {
        let bytes = std::fs::read(at.join(path)).expect("a file");
        serde_json::from_slice(&bytes).expect("JSON")
    };
    assert_eq!(read("out/reef/enhanced-scene/scene.json")["enhancement"]["appearance"], "clear");

    let hand = ["-v", "targets", "out/reef/scene", "reef", "--out", "t.safetensors"];
    // Without a calibrator a 2D enhancer makes the proposals, and nothing is learnt from pairs.
    let (_, err) = expect(0, at, &[&hand[..], &["--set", "proposer=fusion"]].concat());
    assert!(err.contains("`fusion` proposes for ") && err.contains("not calibrated"), "{err}");
    let (_, err) = expect(2, at, &[&hand[..], &["--force", "--set", "calibrated=true"]].concat());
    assert!(err.contains("give --calibrator FILE"), "{err}");
    let clear = ["--force", "--set", "proposer=fusion", "--set", "source=clear"];
    let (_, err) = expect(0, at, &[&hand[..], &clear].concat());
    assert!(err.contains("`fusion` proposes for renders of the scene without its water"), "{err}");
    let enhance = ["enhance", "out/reef/scene", "reef", "--targets", "t.safetensors", "--out", "e", "--set"];
    let (_, err) = expect(0, at, &[&enhance[..], &["iterations=3"]].concat());
    assert!(err.contains("learnt in clear radiance"), "{err}");
    let (_, err) = expect(2, at, &[&enhance[..], &["objective=pseudo-labels", "--force"]].concat());
    assert!(err.contains("these targets are in clear radiance"), "{err}");
}

#[test]
fn a_calibrator_of_our_own_serves_a_pipeline_and_a_scene_of_it() {
    let dir = place();
    let at = dir.path();
    expect(0, at, &["-q", "synth", "pairs", "--out", "pairs", "--views", "6", "--size", "64x48"]);
    let fit = ["calibrate", "--input", "pairs/input", "--target", "pairs/reference", "--proposer", "fusion"];
    let (_, err) = expect(0, at, &[&fit[..], &["--set", "steps=5", "--out", "own.safetensors"]].concat());
    assert!(
        err.contains("6 pairs of pictures (before and after a correction) are few (800 are recommended)"),
        "{err}"
    );

    let pipeline = |calibrator: &str, scene: &str| {
        let text = format!(
            "name = \"p\"\n{calibrator}\n[defaults.reconstruct]\niterations = 8\n[[scene]]\nname = \"own\"\ncapture = \"reef\"\n{scene}\n\
             [[scene]]\nname = \"other\"\ncapture = \"reef\"\n"
        );
        std::fs::write(at.join("p.toml"), text).expect("written");
    };
    let stages = || {
        let (plan, _) = expect(0, at, &["plan", "p.toml", "--json"]);
        ["pairs", "calibrate"].map(|stage| plan.contains(&format!("\"stage\": \"{stage}\"")))
    };
    pipeline("", "calibrator = { file = \"own.safetensors\" }");
    assert_eq!(stages(), [false; 2], "the other scene is not calibrated");
    let pairs = "[calibrator.pairs]\ninput = \"pairs/input\"\ntarget = \"pairs/reference\"";
    pipeline(
        &format!("[defaults.targets]\ncalibrated = true\n{pairs}"),
        "calibrator = { file = \"own.safetensors\" }",
    );
    assert_eq!(stages(), [true; 2], "the other scene needs pairs");
    pipeline("[calibrator]\nfile = \"own.safetensors\"", "");
    assert_eq!(stages(), [false; 2]);
    let (out, _) = expect(0, at, &["-q", "run", "p.toml", "--until", "targets", "--out", "out"]);
    assert!(out.contains("3 stages done") || out.contains("6 stages done"), "{out}");
    // The calibrator was fitted for `fusion`, although the network's weights exist; the other combination is
    // an error.
    pipeline("[calibrator]\nfile = \"own.safetensors\"\nproposer = \"nu2net\"", "");
    let (_, err) = expect(2, at, &["-q", "run", "p.toml", "--until", "targets", "--out", "out"]);
    assert!(err.contains("fitted for the proposer `fusion`, but `nu2net` is requested"), "{err}");
    pipeline("[calibrator]\nfile = \"${USE3D_TEST_UNSET}/own.safetensors\"", "");
    let (_, err) = expect(2, at, &["plan", "p.toml"]);
    let words = ["the environment variable USE3D_TEST_UNSET", "named by `calibrator.file` in p.toml"];
    assert!(words.iter().all(|word| err.contains(word)), "{err}");
    // A damaged file is reported before stage 1 runs, not after it.
    std::fs::write(at.join("damaged.safetensors"), "not a calibrator").expect("written");
    let damaged = ["-q", "run", "reef", "--calibrator", "damaged.safetensors", "--out", "none"];
    let (out, err) = expect(2, at, &damaged);
    assert!(err.contains("a calibrator that can be read") && !out.contains("done"), "{out}{err}");
}
