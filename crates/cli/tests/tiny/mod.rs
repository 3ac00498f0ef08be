//! A tiny capture, the command on it, and all files of a folder.
#![allow(dead_code, reason = "every test program uses its own part of it")]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::LazyLock;

/// Settings with which a run on it takes seconds.
pub(crate) static TINY: LazyLock<[&'static str; 5]> = LazyLock::new(|| {
    let pairs = pairs();
    let named = |kind: &str, folder: &str| -> &'static str {
        format!("calibrator.pairs.{kind}={}", pairs.join(folder).display()).leak()
    };
    [
        "reconstruct.iterations=30",
        "enhance.iterations=10",
        named("input", "input"),
        named("target", "reference"),
        "calibrate.steps=20",
    ]
});

/// No estimate of the water before the training: it takes a third of a tiny run. Tests of what is computed,
/// delivered and shared do without it; tests of one capture's results have it.
pub(crate) const NO_WATER: &str = "reconstruct.medium_prior=off";

/// Eight tiny pairs, made once for all tests.
fn pairs() -> PathBuf {
    synthesised(&["pairs", "--views", "8", "--size", "64x48"])
}

pub(crate) struct Place {
    pub(crate) dir: tempfile::TempDir,
}

impl Place {
    pub(crate) fn new() -> Self {
        let place = Self { dir: tempfile::tempdir().expect("a folder") };
        capture(&place.at("tiny"));
        place
    }

    pub(crate) fn at(&self, name: &str) -> String {
        self.dir.path().join(name).to_string_lossy().into_owned()
    }

    pub(crate) fn run(&self, capture: &str, cache: &str, extra: &[&str]) -> Command {
        self.run_into("out", capture, cache, extra)
    }

    pub(crate) fn run_into(&self, out: &str, capture: &str, cache: &str, extra: &[&str]) -> Command {
        let mut command = command();
        command.args(["-q", "run", &self.at(capture), "--cache", &self.at(cache), "--out", &self.at(out)]);
        // A later value wins.
        for set in TINY.iter().chain([&NO_WATER]).chain(extra) {
            command.args(["--set", set]);
        }
        command
    }

    /// The stages (without the capture's name) that a run computed, in alphabetical order.
    pub(crate) fn computed(&self, extra: &[&str]) -> Vec<String> {
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

/// Makes the tiny capture.
pub(crate) fn capture(out: &str) {
    synthesise(Path::new(out), &["capture", "--views", "9", "--size", "96x64"]);
}

/// Makes a copy of what `use3d synth` makes with these arguments.
pub(crate) fn synthesise(out: &Path, arguments: &[&str]) {
    for (path, bytes) in files(&synthesised(arguments)) {
        let to = out.join(path);
        std::fs::create_dir_all(to.parent().expect("a folder")).expect("a folder");
        std::fs::write(to, bytes).expect("written");
    }
}

/// The folder that `use3d synth` makes with these arguments. The same program makes the same files, so they
/// are made once for all tests, which must not change them.
fn synthesised(arguments: &[&str]) -> PathBuf {
    let program = std::fs::metadata(env!("CARGO_BIN_EXE_use3d")).expect("the program");
    let changed = program.modified().expect("a time").duration_since(std::time::UNIX_EPOCH).expect("later");
    let all = Path::new(env!("CARGO_TARGET_TMPDIR")).join("synthesised");
    let of_program = all.join(changed.as_nanos().to_string());
    let made = of_program.join(arguments.join("_"));
    if !made.is_dir() {
        // Files of earlier programs are of no use any more.
        for earlier in std::fs::read_dir(&all).into_iter().flatten().flatten() {
            if earlier.path() != of_program {
                let _ = std::fs::remove_dir_all(earlier.path());
            }
        }
        std::fs::create_dir_all(&of_program).expect("a folder");
        let working = tempfile::tempdir_in(&of_program).expect("a folder");
        let mut synth = command();
        synth.args(["-q", "synth"]).args(arguments).arg("--out").arg(working.path().join("made"));
        let output = synth.output().expect("the command starts");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        // Another test may have been faster; its files are equal.
        let _ = std::fs::rename(working.path().join("made"), &made);
        assert!(made.is_dir(), "{} cannot be made", made.display());
    }
    made
}

pub(crate) fn command() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_use3d"));
    command.env_remove("USE3D_CACHE").env_remove("USE3D_MODELS").env_remove("RUST_LOG");
    command
}

/// All files of a folder. Leaves out a file that another process removed after it was listed.
pub(crate) fn files(root: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut all = BTreeMap::new();
    let mut folders = vec![root.to_path_buf()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).into_iter().flatten().flatten() {
            let path = entry.path();
            if path.is_dir() {
                folders.push(path);
            } else {
                let name = path.strip_prefix(root).expect("inside").to_path_buf();
                match std::fs::read(&path) {
                    Ok(bytes) => drop(all.insert(name, bytes)),
                    Err(error) if error.kind() == std::io::ErrorKind::NotFound => {}
                    Err(error) => panic!("{}: {error}", path.display()),
                }
            }
        }
    }
    all
}
