//! Photographs are judged once for all variants of a scene, and as if each variant had judged them itself.

use std::path::Path;
use std::process::Command;

use serde_json::Value;
use use3d_synth::{CaptureParams, write_capture};

#[allow(dead_code, reason = "each test binary uses a part of it")]
mod standin;

fn run(dir: &Path, arguments: &[&str]) -> String {
    let mut command = Command::new(env!("CARGO_BIN_EXE_use3d"));
    command.args(arguments).current_dir(dir);
    command.env("USE3D_CACHE", dir.join("cache")).env("USE3D_MODELS", dir.join("models"));
    let output = command.env_remove("RUST_LOG").output().expect("the command starts");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    assert!(output.status.success(), "use3d {arguments:?}\n{}", text(&output.stderr));
    text(&output.stdout)
}

fn made(json: &str, stage: &str) -> usize {
    let summary: Value = serde_json::from_str(json).expect("JSON");
    let nodes = summary["nodes"].as_array().expect("nodes");
    nodes.iter().filter(|node| node["result"] == "done" && node["stage"] == stage).count()
}

#[test]
fn networks_see_each_photograph_and_each_pair_once() {
    let folder = tempfile::tempdir().expect("folder");
    let dir = folder.path();
    standin::networks(&dir.join("models"));
    let tiny = CaptureParams { views: 4, width: 128, height: 128, detail: 0.1, ..CaptureParams::default() };
    write_capture(&tiny, &dir.join("reef"), &mut |_, _| ()).expect("a capture");
    let text = r#"
        name = "p"
        stage2 = false
        [defaults.import]
        split = { every = 4 }
        [defaults.reconstruct]
        iterations = 8
        depth_prior = "off"
        [defaults.evaluate]
        neighbour_pairs = 1
        path_pairs = 1
        [[scene]]
        name = "reef"
        capture = "reef"
        [[variant]]
        name = "rbf"
        [[variant]]
        name = "dry"
        reconstruct = { medium = "none" }
    "#;
    std::fs::write(dir.join("p.toml"), text).expect("written");
    let all = ["-q", "run", "p.toml", "--out", "out", "--json"];
    let json = run(dir, &all);
    assert_eq!(["baseline", "evaluate"].map(|stage| made(&json, stage)), [1, 2]);
    // Another view of a method's authors asks no network about a photograph again.
    let json = run(dir, &[&all[..], &["--set", "evaluate.published_clear=clamped"]].concat());
    assert_eq!(["baseline", "evaluate"].map(|stage| made(&json, stage)), [0, 2]);

    let scores = |variant: &str| -> Value {
        let file = dir.join(format!("out/reef@{variant}")).join("scores/scores.json");
        serde_json::from_slice(&std::fs::read(&file).expect("scores")).expect("JSON")
    };
    let [rbf, dry] = ["rbf", "dry"].map(scores);
    let of = |scores: &Value, method: &str| {
        let methods = scores["methods"].as_array().expect("methods").clone();
        methods.into_iter().find(|of| of["method"] == method).unwrap_or_else(|| panic!("{method}"))
    };
    for method in ["captured", "proposal"] {
        assert_eq!(of(&rbf, method), of(&dry, method), "{method}");
        let pair = &of(&rbf, method)["neighbours"][0]["scores"];
        assert!(pair["wlpips"].is_object() && pair["w_ssim"].is_object(), "{pair}");
    }
    // By hand there is no reference, so the evaluation finds the flow between frames itself.
    let scene = dir.join("out/reef@rbf/scene");
    let by_hand = ["-q", "evaluate", &scene.to_string_lossy(), "reef", "--json", "--set", "split.every=4"];
    let sets = ["--set", "neighbour_pairs=1", "--set", "path_pairs=1", "--set", "published_clear=clamped"];
    let hand = run(dir, &[&by_hand[..], &sets].concat());
    let rows: Vec<Value> = serde_json::from_str(&hand).expect("rows");
    let means = rows.iter().filter(|row| row["image"] == "mean");
    let methods = rbf["methods"].as_array().expect("methods");
    assert_eq!(means.clone().count(), methods.len(), "{hand}");
    for row in means {
        let found = methods.iter().any(|own| own["mean"] == row["scores"]);
        assert!(found, "{row}");
    }
}
