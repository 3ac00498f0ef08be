//! The real stages on a tiny capture: what reruns after each change, what does not, and what is left after a kill at any moment.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

const TINY: [&str; 7] = [
    "reconstruct.iterations=30",
    "enhance.iterations=10",
    "pairs.synthetic.pairs=8",
    "pairs.synthetic.width=64",
    "pairs.synthetic.height=48",
    "calibrate.steps=20",
    // Without it stand-ins correct nothing, and a change of theirs ends at the targets.
    "calibrate.trust=1",
];

struct Place {
    dir: tempfile::TempDir,
}

impl Place {
    fn new() -> Self {
        let place = Self { dir: tempfile::tempdir().expect("a folder") };
        let capture = place.at("tiny");
        let arguments = ["-q", "synth", "capture", "--out", &capture, "--views", "9", "--size", "96x64"]
            .map(String::from);
        let output = command().args(arguments).output().expect("the command starts");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        place
    }

    fn at(&self, name: &str) -> String {
        self.dir.path().join(name).to_string_lossy().into_owned()
    }

    fn run(&self, capture: &str, cache: &str, extra: &[&str]) -> Command {
        let mut command = command();
        command.args(["-q", "run", &self.at(capture), "--cache", &self.at(cache), "--out", &self.at("out")]);
        // A later value wins.
        for set in TINY.iter().chain(extra) {
            command.args(["--set", set]);
        }
        command
    }

    /// The stages (without the capture's name) that a run computed, in alphabetical order.
    fn computed(&self, extra: &[&str]) -> Vec<String> {
        let output = self.run("tiny", "cache", extra).arg("--json").output().expect("the command starts");
        let text = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
        let summary: serde_json::Value = serde_json::from_str(&text).expect("JSON");
        let rows = summary["nodes"].as_array().expect("nodes");
        let mut names: Vec<String> = rows
            .iter()
            .filter(|row| row["result"] == "done")
            .map(|row| row["stage"].as_str().expect("a name").to_string())
            .collect();
        names.sort();
        names
    }
}

fn command() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_use3d"));
    command.env_remove("USE3D_CACHE").env_remove("USE3D_MODELS").env_remove("RUST_LOG");
    command
}

/// Everything under a folder.
fn files(root: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut all = BTreeMap::new();
    let mut folders = vec![root.to_path_buf()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).into_iter().flatten().flatten() {
            let path = entry.path();
            if path.is_dir() {
                folders.push(path);
            } else {
                let name = path.strip_prefix(root).expect("inside").to_path_buf();
                all.insert(name, std::fs::read(&path).expect("readable"));
            }
        }
    }
    all
}

#[test]
fn without_pairs_proposals_stay_as_they_are() {
    let place = Place::new();
    let mut run = command();
    run.args(["-q", "run", &place.at("tiny"), "--cache", &place.at("cache"), "--until", "calibrate"]);
    for set in TINY.iter().filter(|set| !set.contains("trust")) {
        run.args(["--set", set]);
    }
    let output = run.arg("--out").arg(place.at("out")).output().expect("the command starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let cache = files(Path::new(&place.at("cache")));
    let of_calibrate =
        |path: &Path| path.iter().any(|part| part == "calibrate") && path.ends_with("report.json");
    let (_, report) = cache.iter().find(|(path, _)| of_calibrate(path)).expect("the calibrator's report");
    let report: serde_json::Value = serde_json::from_slice(report).expect("JSON");
    // Nothing is fitted that would be thrown away; the pairs give the scales.
    assert_eq!((report["steps"].as_u64(), report["pairs"].as_u64()), (Some(0), Some(8)), "{report}");
    assert!(report["held_out"].is_null(), "{report}");
}

#[test]
fn a_change_reruns_its_stage_and_what_reads_the_changed_output() {
    let place = Place::new();
    assert_eq!(place.computed(&[]).len(), 9);
    assert!(place.computed(&[]).is_empty(), "a second run computes nothing");
    let after_enhance = ["enhance", "evaluate", "render", "report"];
    let after_targets = ["enhance", "evaluate", "render", "report", "targets"];
    let with = |first: &[&str], rest: &[&str]| {
        let mut all: Vec<String> = first.iter().chain(rest).map(|s| s.to_string()).collect();
        all.sort();
        all
    };
    for (change, stages) in [
        ("pairs.synthetic.pairs=9", with(&["pairs", "calibrate"], &after_targets)),
        ("calibrate.steps=21", with(&["calibrate"], &after_targets)),
        ("import.split.every=4", with(&["import", "reconstruct"], &after_targets)),
        ("reconstruct.iterations=31", with(&["reconstruct"], &after_targets)),
        ("targets.consensus.seed=7", with(&["targets"], &after_enhance)),
        ("enhance.lambda_variation=0.001", with(&[], &after_enhance)),
        ("render.strength=0.5", with(&["render", "report"], &[])),
        ("report.views=1", with(&["report"], &[])),
    ] {
        let computed = place.computed(&[change]);
        // Early cut-off: a stage whose inputs came out with the same bytes does not run again.
        let surplus: Vec<&String> = computed.iter().filter(|s| !stages.contains(s)).collect();
        assert!(surplus.is_empty(), "{change} also reran {surplus:?}");
        let own = change.split('.').next().expect("a stage");
        assert!(computed.iter().any(|s| s == own), "{change} reran {computed:?}");
        if own != "targets" {
            assert_eq!(computed, stages, "{change}");
        }
        assert!(place.computed(&[change]).is_empty(), "{change}, again");
    }

    // Touched files, another place, another number of threads: nothing runs.
    let images = place.dir.path().join("tiny/images");
    for entry in std::fs::read_dir(&images).expect("images").flatten() {
        let bytes = std::fs::read(entry.path()).expect("an image");
        std::fs::write(entry.path(), bytes).expect("written again");
    }
    assert!(place.computed(&[]).is_empty(), "touched files");
    std::fs::create_dir(place.dir.path().join("elsewhere")).expect("a folder");
    std::fs::rename(place.dir.path().join("tiny"), place.dir.path().join("elsewhere/tiny")).expect("moved");
    let moved = place.run("elsewhere/tiny", "cache", &[]).args(["--threads", "1"]).output().expect("runs");
    let text = String::from_utf8_lossy(&moved.stdout);
    assert!(moved.status.success() && text.contains("0 done, 9 cached"), "{text}");
}

#[test]
fn killed_at_any_moment_the_artifacts_are_those_of_an_undisturbed_run() {
    let place = Place::new();
    let started = Instant::now();
    let undisturbed = place.run("tiny", "whole", &[]).output().expect("runs");
    assert!(undisturbed.status.success(), "{}", String::from_utf8_lossy(&undisturbed.stderr));
    let whole = started.elapsed();
    let artifacts = |cache: &str| {
        let mut all = files(&place.dir.path().join(cache).join("v1/artifacts"));
        // Manifests tell times and hosts; everything else must agree to the byte.
        all.retain(|path, _| !path.ends_with("manifest.json"));
        all
    };
    let expected = artifacts("whole");
    assert!(expected.len() > 20, "{} files", expected.len());

    let mut kills = 0;
    for attempt in 0..12u32 {
        let mut child: Child = place
            .run("tiny", "cut", &[])
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .expect("the command starts");
        // Multiples of the golden ratio: every part of the run comes under the knife.
        let share = 0.6 * (0.618_034 * f64::from(attempt + 1)).fract();
        std::thread::sleep(Duration::from_secs_f64(share * whole.as_secs_f64()));
        if child.try_wait().expect("a state").is_some() {
            break;
        }
        child.kill().expect("killed");
        child.wait().expect("gone");
        kills += 1;
        for (path, bytes) in artifacts("cut") {
            assert!(expected.get(&path) == Some(&bytes), "{} after {kills} kills", path.display());
        }
    }
    let last = place.run("tiny", "cut", &[]).output().expect("runs");
    assert!(last.status.success(), "{}", String::from_utf8_lossy(&last.stderr));
    let found = artifacts("cut");
    assert_eq!(found.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>());
    assert!(found == expected, "some artifact differs");
    assert!(kills > 0, "the run was never caught");
    println!("{kills} kills");
}
