//! A newcomer's first day in more than 40 commands: version, demo, own capture, wrong folders and flags,
//! quick look, pairs, second experiment, compare, white balance, view, export. Each message is compared word
//! for word with `snapshots/newcomer.txt`; `USE3D_UPDATE_SNAPSHOTS=1` writes that file again.
//!
//! Amounts of time, memory and disk differ from run to run, so `#` stands for them.

mod steady;
mod viewer;

use std::process::{Command, Stdio};

use steady::{compare, steady};
use viewer::{Ended, Viewer};

/// Settings with which a run takes seconds.
const QUICK: [&str; 6] = ["--iterations", "30", "--max-side", "96", "--set", "enhance.iterations=10"];

/// The commands of one day in one folder, with what they printed.
struct Day {
    folder: tempfile::TempDir,
    printed: String,
}

impl Day {
    fn new() -> Self {
        Self { folder: tempfile::tempdir().expect("a folder"), printed: String::new() }
    }

    fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_use3d"));
        // The newcomer's machine has no other programs on its path.
        let home = self.folder.path();
        command.args(arguments).current_dir(home).env_clear().env("HOME", home).env("PATH", home.join("bin"));
        command
    }

    /// Runs a command and keeps its exit code, stdout and stderr.
    fn step(&mut self, code: i32, arguments: &[&str]) {
        let output = self.command(arguments).output().expect("the command starts");
        let said = [&output.stdout, &output.stderr].map(|bytes| String::from_utf8_lossy(bytes).into_owned());
        let said = steady(&said.concat(), self.folder.path());
        assert_eq!(output.status.code(), Some(code), "use3d {arguments:?}\n{said}");
        self.printed += &format!("$ use3d {}\n{said}[{code}]\n\n", arguments.join(" "));
    }

    fn run(&mut self, arguments: &[&str]) {
        self.step(0, &[&["run", "my-reef"], &QUICK[..], arguments].concat());
    }

    fn has(&self, name: &str) -> bool {
        self.folder.path().join(name).exists()
    }
}

#[test]
fn a_newcomer_gets_through_the_first_day() {
    let mut day = Day::new();
    let make = |name: &str, text: &str| std::fs::write(day.folder.path().join(name), text).expect("a file");
    make("notes.txt", "Bring more light.\n");
    make("dive.mp4", "not really a film\n");
    std::fs::create_dir(day.folder.path().join("empty")).expect("a folder");

    // Install, demo.
    day.step(0, &["-V"]);
    let demo = ["demo", "--iterations", "20", "--set", "enhance.iterations=5", "--set", "import.max_side=96"];
    day.step(0, &demo);
    assert!(day.has("use3d-out/demo/report.html"));

    // Wrong folders, files and programs.
    day.step(2, &["run", "my-reef"]);
    day.step(2, &["run", "empty"]);
    day.step(2, &["run", "notes.txt"]);
    day.step(2, &["run", "dive.mp4"]);

    day.step(0, &["run", "dive.mp4", "--dry-run"]);

    // The newcomer's own capture.
    day.step(0, &["synth", "capture", "--out", "my-reef", "--views", "12", "--size", "192x128"]);
    day.step(2, &["my-reef"]);
    day.step(2, &["run", "my-reef/images"]);
    day.step(0, &["check", "my-reef"]);
    day.step(0, &["water", "my-reef"]);

    // Wrong flags and values.
    day.step(2, &["run", "my-reef", "--iteration", "30"]);
    day.step(2, &["run", "my-reef", "--iterations", "0"]);
    day.step(2, &["run", "my-reef", "--set", "reconstruct.itertions=30"]);
    day.step(2, &["run", "my-reef", "--set", "reconstruct.medium=rbff"]);

    // A quick look, and the same again.
    day.step(0, &[&["plan", "my-reef"], &QUICK[..]].concat());
    day.run(&[]);
    assert!(day.has("use3d-out/my-reef/report.html"));
    day.run(&[]);
    day.step(0, &[&["status", "my-reef"], &QUICK[..]].concat());

    // Pairs that are not there, and pairs.
    day.step(2, &["run", "my-reef", "--pairs", "uieb/raw-890", "uieb/reference-890"]);
    day.step(0, &["synth", "pairs", "--out", "pairs", "--views", "8", "--size", "64x48"]);
    day.run(&["--pairs", "pairs/input", "pairs/reference", "--set", "calibrate.steps=20"]);

    // A second experiment, and both side by side.
    day.run(&["--set", "enhance.lambda_variation=0.001", "--out", "second"]);
    day.step(0, &["results", "my-reef"]);
    day.step(0, &["results", "my-reef", "1"]);
    day.step(0, &["results", "my-reef"]);
    day.step(0, &["compare", "use3d-out/my-reef", "second"]);
    day.step(0, &["compare", "my-reef:1", "my-reef:2"]);
    day.step(2, &["compare", "my-reef:3", "second"]);
    day.step(0, &["compare", "use3d-out/demo", "second"]);
    let pages = ["my-reef-second", "my-reef-1-my-reef-2", "demo-second"];
    assert!(pages.iter().all(|name| day.has(&format!("compare-{name}.html"))));

    // Colours. The page of the results has them at once.
    let view = day.folder.path().join("second/my-reef/view.html");
    let page = || std::fs::read_to_string(&view).expect("a page");
    let before = page();
    day.step(2, &["white", "second", "nofoto.jpg:40,30"]);
    day.step(0, &["white", "second", "frame_0002.png:96,100"]);
    assert!(!before.contains(r#""method":"patch""#) && page().contains(r#""method":"patch""#));
    day.step(0, &["white", "second", "grey"]);
    day.step(0, &["white", "second", "off"]);
    assert_eq!(page(), before);

    // View and export.
    for (shown, points) in [("second", false), ("my-reef", true)] {
        let mut view = day.command(&["view", shown, "--no-open"]);
        let mut view = Ended(view.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().expect("it starts"));
        let header = Viewer::of(view.0.stdout.take().expect("a pipe")).header();
        assert_eq!(header["cameras"].as_array().map(Vec::len), Some(12));
        assert_eq!(header["points"], points);
    }
    day.step(0, &["export", "second", "--ply", "reef.ply"]);
    day.step(2, &["export", "second", "--ply", "reef.ply"]);
    day.step(2, &["export", "second", "--ply", "metres.ply", "--frame", "metric"]);
    day.step(0, &["export", "second", "--ply", "strong.ply", "--what", "enhanced-clear"]);
    day.step(0, &["export", "second", "--web", "reef.html"]);
    day.step(0, &["render", "second", "--out", "pictures"]);
    day.step(0, &["render", "second", "--out", "pictures-2", "--modes", "enhanced-clear"]);
    assert!(["reef.ply", "reef.html", "pictures"].iter().all(|name| day.has(name)));
    day.step(2, &["render", "my-reef", "--out", "pictures-3"]);
    day.step(0, &["import", "my-reef", "--out", "prepared", "--max-side", "96"]);

    // A table of lengths by a German spreadsheet: its numbers are read.
    let table = "length;metres;image;x1;y1;x2;y2\nrod;1,00;frame_0001.png;10,5;20;30;20\nrod;1,00;frame_9.png;1;2;3;4\n";
    std::fs::write(day.folder.path().join("my-reef/lengths.csv"), table).expect("a file");
    let refused = day.command(&["check", "my-reef"]).output().expect("the command starts");
    let said = String::from_utf8_lossy(&refused.stderr);
    assert!(said.contains("lengths.csv: line 3: `image` is frame_9.png, which has no camera"), "{said}");

    // No driver speaks in between.
    let doctor = day.command(&["doctor"]).output().expect("the command starts");
    assert!(doctor.status.success() && doctor.stderr.is_empty() && doctor.stdout.starts_with(b"use3d 0."));
    assert!(day.printed.matches("\n$ use3d ").count() >= 40);

    compare("newcomer", &day.printed);
}
