//! Runs a batch of real scenes, one of them broken: the results of a scene exist as soon as it is finished,
//! and neither a kill nor another scene's failure removes them.
//!
//! The normal run has three scenes; a whole benchmark of tiny ones:
//!
//! ```text
//! USE3D_SCENES=26 cargo test -p use3d --test scenes -- --nocapture
//! ```

mod tiny;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use tiny::{TINY, command, files, synthesise};

struct Batch {
    dir: tempfile::TempDir,
    count: usize,
}

impl Batch {
    fn new(count: usize) -> Self {
        let batch = Self { dir: tempfile::tempdir().expect("a folder"), count };
        let mut text = "name = \"many\"\nseed = 42\n".to_string();
        for scene in batch.scenes() {
            let out = batch.at(&scene);
            let seed = scene.trim_start_matches('s').to_string();
            synthesise(&out, &["capture", "--views", "9", "--size", "64x48", "--seed", &seed]);
            text += &format!("[[scene]]\nname = \"{scene}\"\ncapture = \"{scene}\"\ngroup = \"Tiny\"\n");
        }
        std::fs::write(batch.at("many.toml"), text).expect("written");
        batch
    }

    fn at(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    fn scenes(&self) -> Vec<String> {
        (1..=self.count).map(|n| format!("s{n:02}")).collect()
    }

    fn run(&self, extra: &[&str]) -> Command {
        let mut command = command();
        command.args(["-q", "run"]).arg(self.at("many.toml"));
        command.arg("--cache").arg(self.at("cache")).arg("--out").arg(self.at("out"));
        for set in TINY.iter().chain(&["reconstruct.iterations=6", "enhance.iterations=4"]) {
            command.args(["--set", set]);
        }
        command.args(extra);
        command
    }

    /// The result of a run: its exit code, and the number of computed stages of each scene.
    fn summary(&self, extra: &[&str]) -> (Option<i32>, BTreeMap<String, usize>) {
        let output = self.run(extra).arg("--json").output().expect("the command starts");
        let text = String::from_utf8_lossy(&output.stdout);
        let summary: serde_json::Value =
            serde_json::from_str(&text).unwrap_or_else(|e| panic!("{e}: {text}"));
        let mut done = BTreeMap::new();
        for node in summary["nodes"].as_array().expect("nodes").iter().filter(|n| n["result"] == "done") {
            *done.entry(node["scene"].as_str().expect("a name").to_string()).or_default() += 1;
        }
        (output.status.code(), done)
    }

    /// The delivered results of a scene.
    fn results(&self, scene: &str) -> BTreeMap<PathBuf, Vec<u8>> {
        files(&self.at("out").join(scene))
    }
}

#[test]
fn a_scene_is_delivered_when_it_is_finished_whatever_becomes_of_the_others() {
    let count = std::env::var("USE3D_SCENES").map_or(3, |n| n.parse().expect("a number of scenes"));
    let started = Instant::now();
    let batch = Batch::new(count);
    let scenes = batch.scenes();
    let (first, broken) = (&scenes[0], &scenes[count / 2]);
    let model = batch.at(broken).join("sparse/0/images.bin");
    let good = std::fs::read(&model).expect("a model");
    std::fs::write(&model, b"no model").expect("written");

    // While others still run, the results of the first one exist. Then the process is killed.
    let mut child = batch
        .run(&["--keep-going"])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("the command starts");
    let scores = |scene: &str| batch.at("out").join(scene).join("scores/scores.json");
    while !scores(first).is_file() {
        let state = child.try_wait().expect("a state");
        assert!(state.is_none(), "the batch ended ({state:?}) before its first scene was delivered");
        std::thread::sleep(Duration::from_millis(2));
    }
    child.kill().expect("killed");
    child.wait().expect("gone");
    // The scores are delivered last: everything before them exists and stays.
    let delivered = batch.results(first);
    assert!(delivered.len() > 10, "{:?}", delivered.keys());
    let stays = |when: &str| {
        let now = batch.results(first);
        for (path, bytes) in &delivered {
            assert!(now.get(path) == Some(bytes), "{} {when}", path.display());
        }
    };

    let (code, done) = batch.summary(&["--keep-going"]);
    assert_eq!(code, Some(1), "{done:?}");
    assert!(!done.contains_key(first) && !done.contains_key(broken), "{done:?}");
    stays("after the next run");
    for scene in &scenes {
        assert_eq!(scores(scene).is_file(), scene != broken, "{scene}");
    }
    let table = |batch: &Batch| {
        let all = files(&batch.at("out/tables"));
        let (_, text) =
            all.into_iter().find(|(p, _)| p == Path::new("reconstruction-scenes.md")).expect("a table");
        String::from_utf8(text).expect("text")
    };
    let text = table(&batch);
    let row =
        |scene: &str| text.lines().find(|line| line.starts_with(&format!("| {scene} "))).expect("a row");
    assert!(scenes.iter().all(|s| row(s).contains("| n/a | n/a | n/a | n/a |") == (s == broken)), "{text}");
    assert!(text.contains(&format!("n/a: {broken}: `import` failed")), "{text}");

    // Without --keep-going the run ends there, and removes nothing.
    assert_eq!(batch.summary(&[]).0, Some(1));
    stays("after a run that failed");

    std::fs::write(&model, good).expect("repaired");
    let (code, done) = batch.summary(&["--keep-going"]);
    assert_eq!(code, Some(0));
    let computed: Vec<&String> = done.keys().filter(|scene| !scene.is_empty()).collect();
    assert_eq!(computed, [broken], "only what was missing");
    assert!(scenes.iter().all(|s| table(&batch).contains(s.as_str())));
    assert!(batch.summary(&[]).1.is_empty(), "a second run computes nothing");
    println!("{count} scenes: {:.0} s", started.elapsed().as_secs_f64());
}
