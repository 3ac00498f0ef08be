//! Runs the paper's pipelines with stand-ins for data that are not available here: 26 tiny scenes, weights of
//! the right shapes, a few pairs. The changes to the paper's settings must be printed beside every number.
use std::path::Path;
use std::process::Command;

use use3d_synth::{CaptureParams, PairsParams, write_capture, write_pairs};

#[allow(dead_code, reason = "each test binary uses a part of it")]
mod standin;

/// Runs the command in `dir` with the variables of the paper's data sets, and expects an exit code.
fn expect(code: i32, dir: &Path, arguments: &[&str]) -> String {
    let mut command = Command::new(env!("CARGO_BIN_EXE_use3d"));
    command.args(arguments).current_dir(dir).env("USE3D_CACHE", dir.join("cache"));
    for (name, folder) in [("SEATHRU", "seathru"), ("SEATHRU_D", "d"), ("DRUVA", "druva"), ("UIEB", "uieb")] {
        command.env(name, dir.join(folder));
    }
    let output = command.env_remove("USE3D_MODELS").env_remove("RUST_LOG").output().expect("it starts");
    let said =
        [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).concat();
    assert_eq!(output.status.code(), Some(code), "use3d {arguments:?}\n{said}");
    said
}

/// The names of the paper's scenes, with the folders in which the pipelines expect them.
fn scenes() -> Vec<String> {
    let seathru = ["IUI3-RedSea", "Curasao", "JapaneseGradens-RedSea", "Panama"];
    let mut all: Vec<String> = seathru.iter().map(|name| format!("seathru/{name}")).collect();
    all.extend((1..=20).map(|i| format!("druva/A{i}")));
    all.extend(["d/D3", "d/D5"].map(String::from));
    all
}

/// A folder with these scenes, pairs under UIEB's names, and stand-in weights of all networks in `models/`.
fn place(scenes: &[String]) -> tempfile::TempDir {
    let dir = tempfile::tempdir().expect("folder");
    for (seed, scene) in (1..).zip(scenes) {
        let params = CaptureParams {
            seed,
            views: 3,
            width: 40,
            height: 40,
            detail: 0.1,
            points: 150,
            ..CaptureParams::default()
        };
        write_capture(&params, &dir.path().join(scene), &mut |_, _| ()).expect("a capture");
    }
    let pairs = PairsParams { pairs: 6, width: 48, height: 32, detail: 0.1, ..PairsParams::default() };
    write_pairs(&pairs, &dir.path().join("pairs"), &mut |_, _| ()).expect("pairs");
    std::fs::create_dir(dir.path().join("uieb")).expect("folder");
    for (from, to) in [("input", "raw-890"), ("reference", "reference-890")] {
        std::fs::rename(dir.path().join("pairs").join(from), dir.path().join("uieb").join(to))
            .expect("moved");
    }
    standin::networks(&dir.path().join("models"));
    dir
}

/// Settings that make it take seconds. Stand-ins for the large encoder of Depth Anything V2 have 1.3 GB, so
/// the small one makes the priors.
const TINY: [&str; 7] = [
    "import.size=40x40",
    "reconstruct.iterations=12",
    "enhance.iterations=4",
    "calibrate.steps=10",
    "calibrate.local_hidden=16",
    "depth.encoder=vits",
    "evaluate.fps_size=40x40",
];
/// Settings that need no weights.
const WITHOUT_WEIGHTS: [&str; 2] = ["reconstruct.depth_prior=folder", "evaluate.scores=available"];

fn pipeline(name: &str) -> String {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../pipelines");
    folder.join(name).to_string_lossy().into_owned()
}

fn read(dir: &Path, file: &str) -> String {
    std::fs::read_to_string(dir.join(file)).unwrap_or_else(|e| panic!("{file}: {e}"))
}

#[test]
fn the_26_scenes_run_from_end_to_end_and_every_row_says_what_made_it() {
    let names = scenes();
    assert_eq!(names.len(), 26);
    let dir = place(&names);
    let at = dir.path();
    let file = pipeline("use26.toml");
    // The commands of docs/science/not-run.md say what is missing, and later that nothing is.
    let models = ["models", "--for", "paper", "--dir", "models"];
    let plan = ["plan", &file, "--models", "models"];
    assert!(expect(2, at, &models).contains("missing for the preset paper: Depth Anything V2 Large;"));
    assert!(expect(2, at, &plan).contains("depth_anything_v2_vitl.pth"));
    let large = at.join("models/depth_anything_v2_vitl.pth");
    std::fs::write(&large, "no checkpoint").expect("written");
    assert!(expect(2, at, &models).contains("cannot be used: "));
    assert!(expect(2, at, &plan).contains("depth_anything_v2_vitl.pth"));
    standin::opens(&large);
    expect(0, at, &models);
    assert!(expect(0, at, &plan).contains("use26"), "the plan");
    std::fs::remove_file(&large).expect("removed");
    // 26 scenes would spend minutes in networks: two scenes do that in the other test.
    for entry in std::fs::read_dir(at.join("models")).expect("models") {
        let path = entry.expect("entry").path();
        if !path.ends_with("uie_proposer.pth") {
            std::fs::remove_file(path).expect("removed");
        }
    }
    let mut run = vec!["-q", "run", &file, "--models", "models", "--out", "out"];
    TINY.iter().chain(&WITHOUT_WEIGHTS).for_each(|set| run.extend(["--set", set]));
    let said = expect(0, at, &run);
    // Pairs and calibrator once, the stages of a scene except the report for each scene, one report.
    assert!(said.contains(&format!("use26: {} done", 2 + 26 * 7 + 1)), "{said}");
    let told = [
        "preset paper, changed: ",
        "reconstruct.iterations = 12",
        "reconstruct.depth_prior = folder",
        "evaluate.scores = available",
        "proposer: nu2net",
        "calibrator: 6 pairs, 10 steps, keeps 100 % (global) and 100 % (local)",
        "depth prior: the capture's own files, 2 of 2 training views",
        "water: learnt from the first step on",
        "steps: 12 + 4",
        "one view in 8 is held out, counted by COLMAP image id from the first",
        "views: 2 training, 1 held out",
        "seed: 42",
    ];
    let page = read(at, "out/report.html");
    let first_screen = page.split("<section").next().expect("a beginning");
    let enhancement = ["md", "csv", "json"].map(|form| read(at, &format!("out/tables/enhancement.{form}")));
    for text in [first_screen, &enhancement[0], &enhancement[1], &enhancement[2]] {
        let plain = text.replace("&#39;", "'").replace("</dt><dd>", ": ");
        for word in &told {
            // For values that differ between the 26 scenes, the page shows counts.
            assert!(plain.contains(word) || word.contains("held out, counted"), "{word}: {plain}");
        }
        assert!(plain.contains("changed: "), "{plain}");
    }
    let scores: serde_json::Value =
        serde_json::from_str(&read(at, "out/Panama/scores/scores.json")).expect("JSON");
    let configuration = &scores["configuration"];
    assert_eq!((&configuration["preset"], &configuration["proposer"]), (&"paper".into(), &"nu2net".into()));
    assert!(configuration["split"].as_str().expect("text").starts_with(told[9]), "{configuration}");
    assert!(configuration["changed"].as_array().expect("a list").len() >= TINY.len() - 1, "{configuration}");
    assert!(!page.contains("(published)") && !enhancement[0].contains("(published)"));
    // A second run has nothing to do.
    assert!(expect(0, at, &run).contains("use26: 0 done"));
}

#[test]
fn a_change_of_the_paper_is_said_in_three_places_and_takes_published_rows_away() {
    let dir = place(&["d/D3".to_string(), "d/D5".to_string()]);
    let at = dir.path();
    let file = pipeline("d3-d5.toml");
    // Files that cannot be used are named before anything is computed.
    let planned = ["plan", &file, "--models", "models", "--set", "depth.encoder=vits"];
    expect(0, at, &planned);
    // With stand-ins for all networks the tables have every score of the paper.
    let mut whole = vec!["-q", "run", &file, "--models", "models", "--out", "whole"];
    TINY.iter().for_each(|set| whole.extend(["--set", set]));
    expect(0, at, &whole);
    assert!(
        read(at, "whole/report.html").contains("depth prior: Depth Anything V2, as depth_prior requires")
    );
    let tables = ["reconstruction", "enhancement"].map(|name| read(at, &format!("whole/tables/{name}.md")));
    for score in ["PSNR", "SSIM", "LPIPS", "UCIQE", "URanker", "MUSIQ", "wLPIPS", "UIQM"] {
        assert!(tables.iter().any(|table| table.contains(score)), "{score}: {tables:?}");
    }
    assert!(tables.iter().all(|table| !table.contains("not available")), "{tables:?}");
    for name in ["uie_proposer.pth", "URanker_ckpt.safetensors"] {
        std::fs::write(at.join("models").join(name), "no checkpoint").expect("written");
    }
    let told = expect(2, at, &planned);
    for (name, without) in [
        ("uie_proposer.pth", "--set targets.proposer=fusion"),
        ("URanker_ckpt.safetensors", "--set evaluate.scores=available"),
    ] {
        let lines: Vec<&str> = told.lines().filter(|line| line.contains(name)).collect();
        assert!(lines.len() == 1 && lines[0].contains(without), "{name}: {told}");
    }
    std::fs::remove_dir_all(at.join("models")).expect("removed");
    let plan = expect(2, at, &["plan", &file]);
    assert!(plan.contains("--set targets.proposer=fusion"), "{plan}");
    let mut run = vec!["-q", "run", &file, "--out", "out", "--set", "targets.proposer=fusion"];
    TINY.iter().chain(&WITHOUT_WEIGHTS).for_each(|set| run.extend(["--set", set]));
    expect(0, at, &run);
    let page = read(at, "out/report.html");
    let first_screen = page.split("<section").next().expect("a beginning");
    let table = read(at, "out/tables/reconstruction.md");
    let scores = read(at, "out/D3/scores/scores.json");
    for text in [first_screen, &table, &scores] {
        assert!(text.contains("targets.proposer = fusion"), "{text}");
    }
    assert!(!page.contains("(published)") && !table.contains("(published)"), "{table}");
}
