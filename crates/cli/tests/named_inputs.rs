//! Tests of inputs that a user names: they are found, or reported missing before anything is computed. They
//! are never replaced by a default.

use std::path::{Path, PathBuf};
use std::process::Command;

/// Runs the command in `dir` without the variables that name data, expects an exit code, and returns stdout
/// and stderr.
fn expect(code: i32, dir: &Path, arguments: &[&str]) -> (String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_use3d"));
    command.args(arguments).current_dir(dir);
    for variable in
        ["USE3D_CACHE", "USE3D_MODELS", "RUST_LOG", "DATA", "UIEB", "SEATHRU", "SEATHRU_D", "DRUVA"]
    {
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
        std::fs::create_dir_all(dir.path().join("empty")).expect("folder");
        let (_, err) = expect(2, dir.path(), &["plan", &file, "--cache", "cache", "--models", "empty"]);
        let line = |what: &str| {
            let found = err.lines().filter(|l| l.contains(what)).collect::<Vec<_>>();
            assert_eq!(found.len(), 1, "{what} once in {name}: {err}");
            found[0].to_string()
        };
        // The ablation of stage 1 learns from no pairs.
        let learns = name != "ablation-stage1.toml";
        assert!(learns || !err.contains("the pairs of pictures"), "{err}");
        let pairs = learns.then(|| line("the pairs of pictures"));
        for word in ["`calibrator.pairs.input` in ", name, "UIEB is not set", "docs/reference/datasets.md"] {
            assert!(pairs.as_ref().is_none_or(|line| line.contains(word)), "{name}: {pairs:?}");
        }
        // Each missing file is listed once, with its name, its source, and the setting that avoids it.
        for (what, file, without) in [
            ("Nu2Net", "uie_proposer.pth", "--set targets.proposer=fusion"),
            ("Depth Anything V2", "depth_anything_v2_vitl.pth", "--set reconstruct.depth_prior=off"),
            ("LPIPS 0.1 heads", "alex.pth", "--set evaluate.scores=available"),
            ("AlexNet", "alexnet-owt-7be5be79.pth", "--set evaluate.scores=available"),
            ("RAFT-Large", "raft_large", "--set evaluate.scores=available"),
            ("URanker", "URanker_ckpt.pth", "--set evaluate.scores=available"),
            ("MUSIQ", "musiq_koniq_ckpt", "--set evaluate.scores=available"),
        ] {
            let line = line(&format!("the weights of {what}"));
            assert!([file, "published at", without].iter().all(|word| line.contains(word)), "{name}: {line}");
        }
        let made = std::fs::read_dir(dir.path().join("cache/v1/artifacts")).expect("the cache's folder");
        assert_eq!(made.count(), 0, "nothing was computed");
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
    let (json, _) = expect(2, dir.path(), &["plan", "p.toml", "--json", "--cache", "cache"]);
    assert!(json.contains("\"exit_code\":2") && json.contains("nope/a does not exist"), "{json}");
    let (_, err) = expect(2, dir.path(), &["-q", "run", "p.toml", "--cache", "cache"]);
    assert!(err.contains("nope/a does not exist") && err.contains("nope/b does not exist"), "{err}");
    // Stages that do not need them run.
    expect(0, dir.path(), &["-q", "run", "p.toml", "--until", "import", "--cache", "cache"]);
    let pairs = ["--pairs", "absent", "reef/images"];
    let plan = ["plan", capture, "--cache", "cache"];
    let (_, err) = expect(2, dir.path(), &[&plan[..], &pairs].concat());
    assert!(err.contains("absent does not exist, named by --pairs"), "{err}");
    // Two folders without a pair, truth that cannot be read.
    std::fs::create_dir_all(dir.path().join("a")).expect("folder");
    let (_, err) = expect(2, dir.path(), &[&plan[..], &["--pairs", "a", "a"]].concat());
    assert!(err.contains("0 files of a have a counterpart"), "{err}");
    for stage in ["targets", "evaluate", "pairs"] {
        let set = format!("{stage}.proposer=nu2net");
        let (_, err) = expect(2, dir.path(), &[&plan[..], &["--set", &set]].concat());
        assert!(err.contains("the weights of Nu2Net") && err.contains("proposer=fusion"), "{set}: {err}");
    }
    let truth = dir.path().join("reef/truth/clean");
    let image = std::fs::read_dir(&truth).expect("truth").next().expect("an image").expect("one").path();
    let whole = std::fs::read(&image).expect("read");
    std::fs::write(&image, &whole[..whole.len() / 2]).expect("written");
    let (_, err) = expect(2, dir.path(), &plan);
    assert!(err.contains("the truth beside a capture") && err.contains("rename the truth/ folder"), "{err}");
    std::fs::write(&image, whole).expect("written");
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
        let mut arguments = vec!["-v", "reconstruct", "reef", "--out", &out, "--set", "iterations=2"];
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
        asked.contains("although depth_prior requires files: the capture has no depth folder"),
        "{asked}"
    );
}
