//! The report of a batch: an overview with a row for each scene, a page for each result, and only what
//! changed is written again. The scenes are one tiny capture, so that they share their artifacts.
//!
//! A large batch prints the figures of `docs/science/performance.md`:
//!
//! ```text
//! USE3D_SCENES=1000 USE3D_VARIANTS=10 cargo test --workspace --test report large -- --nocapture
//! ```

mod tiny;

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, SystemTime};

use tiny::{TINY, files};

/// A capture, and a pipeline file with scenes of it.
struct Batch {
    dir: tempfile::TempDir,
}

impl Batch {
    fn new() -> Self {
        let dir = tempfile::tempdir().expect("a folder");
        tiny::synthesise(&dir.path().join("reef"), &["capture", "--views", "9", "--size", "48x32"]);
        Self { dir }
    }

    fn at(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    /// Writes the pipeline file. The last scene has `more` steps in stage 2 than the others.
    fn pipeline(&self, scenes: usize, variants: usize, more: usize) {
        let mut text = "name = \"many\"\nseed = 42\n[defaults.enhance]\niterations = 6\n".to_string();
        for k in 0..variants {
            text += &format!("[[variant]]\nname = \"v{k}\"\nenhance.rank = {}\n", k + 2);
        }
        for k in 0..scenes {
            let group = if k == 0 { "Calm" } else { "Rough" };
            text += &format!("[[scene]]\nname = \"s{k:04}\"\ncapture = \"reef\"\ngroup = \"{group}\"\n");
        }
        if more > 0 {
            text += &format!("enhance.iterations = {}\n", 6 + more);
        }
        fs::write(self.at("many.toml"), text).expect("written");
    }

    fn run(&self, arguments: &[&str]) -> Command {
        let mut command = tiny::command();
        command.args(["-q", "run"]).arg(self.at("many.toml")).args(["--threads", "1", "--cache"]);
        command.arg(self.at("cache")).args(arguments);
        if !arguments.contains(&"--cache-only") {
            command.arg("--out").arg(self.at("out"));
        }
        for set in TINY.iter().filter(|set| !set.starts_with("enhance.")) {
            command.args(["--set", set]);
        }
        command
    }

    fn done(&self, arguments: &[&str], code: i32) -> String {
        let output = self.run(arguments).output().expect("the command starts");
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(code), "{said}");
        said
    }

    /// The files of the results folder with their times.
    fn times(&self) -> BTreeMap<PathBuf, SystemTime> {
        let time = |path: &PathBuf| fs::metadata(self.at("out").join(path)).and_then(|m| m.modified());
        files(&self.at("out")).into_keys().map(|path| (path.clone(), time(&path).expect("a time"))).collect()
    }

    fn read(&self, path: &str) -> String {
        fs::read_to_string(self.at("out").join(path)).unwrap_or_else(|e| panic!("{path}: {e}"))
    }
}

#[test]
fn every_result_has_a_page_and_only_what_changed_is_written_again() {
    let batch = Batch::new();
    batch.pipeline(3, 2, 0);
    batch.done(&["--report-only"], 0);
    let before = batch.times();
    let folder = |name: &str| before.keys().filter(|path| path.starts_with(name)).count();
    assert_eq!((folder("s0001@v1"), folder("tables") > 4), (2, true), "{before:?}");
    let overview = batch.read("report.html");
    let blocks = overview.split("id=\"results\"").nth(1).and_then(|rest| rest.split("</section>").next());
    assert_eq!(blocks.expect("the overview").matches("<tbody>").count(), 3, "a block for each scene");
    for link in ["s0002%40v1/report.html", "<option>v1</option>", "<small>Rough</small>", "data:image/jpeg"] {
        assert!(overview.contains(link), "{link}");
    }
    let page = batch.read("s0001@v1/report.html");
    for part in ["<h1>s0001 · v1", "../report.html", "How like the photographs?", "Parameters"] {
        assert!(page.contains(part), "{part}");
    }
    let data: serde_json::Value = serde_json::from_str(&batch.read("s0001@v1/report.json")).expect("JSON");
    assert!(data["scores"]["means"]["reconstruction"]["psnr"]["value"].as_f64() > Some(5.0), "{data}");
    let table = batch.read("tables/reconstruction-scenes.csv");
    assert!(table.starts_with("scene,method,") && table.matches("\ns0002,").count() == 2, "{table}");

    // Nothing to do, then another stage 2 for the last scene.
    std::thread::sleep(Duration::from_millis(2100));
    batch.done(&["--report-only"], 0);
    assert!(batch.times() == before, "nothing was computed, but something was written");
    batch.pipeline(3, 2, 2);
    batch.done(&["--report-only"], 0);
    let after = batch.times();
    let written: Vec<&Path> = after
        .iter()
        .filter(|(path, time)| before.get(*path) != Some(time))
        .map(|(path, _)| path.as_path())
        .collect();
    let pages: Vec<&&Path> =
        written.iter().filter(|path| path.starts_with("s0000@v0") || path.starts_with("s0001@v0")).collect();
    assert!(pages.is_empty() && written.contains(&Path::new("s0002@v1/report.html")), "{written:?}");
    assert!(written.contains(&Path::new("report.html")), "{written:?}");

    // A page that somebody edited is not replaced.
    fs::write(batch.at("out/s0002@v1/report.html"), "mine").expect("written");
    batch.pipeline(3, 2, 3);
    let said = batch.done(&["--report-only"], 2);
    assert!(
        said.contains("s0002@v1/report.html") && said.contains("was not written by this program"),
        "{said}"
    );
}

#[test]
fn the_methods_of_other_authors_stand_side_by_side() {
    let batch = Batch::new();
    let mut text = "name = \"rivals\"\nseed = 42\n[defaults.reconstruct]\niterations = 20\n".to_string();
    for method in ["3dgs", "water-splatting", "3d-use"] {
        text += &format!("[[variant]]\nname = \"{method}\"\nmethod = \"{method}\"\n");
    }
    for name in ["reef.1", "reef.2"] {
        text += &format!("[[scene]]\nname = \"{name}\"\ncapture = \"reef\"\n");
    }
    fs::write(batch.at("many.toml"), text).expect("written");
    batch.done(&["--set", "variant.3d-use.enhance.iterations=3"], 0);

    let page = batch.read("report.html");
    assert!(page.contains("href=\"tables/methods-reef.1.html\""), "a link to the pictures");
    let table = batch.read("tables/methods.md");
    assert!(table.contains("3DGS, in this program") && table.contains("| processor seconds↓"), "{table}");
    let told = "reproduces the kept-back photographs";
    assert!(table.contains(told) || table.contains("reproduce the kept-back photographs"), "{table}");
    assert!(batch.read("tables/methods-reef.1.html").contains("<h1>reef.1: the methods side by side</h1>"));
    let pictures = batch.read("tables/methods-reef.2.html");
    for label in ["3dgs: without water", "water-splatting: without water", "3d-use: enhanced"] {
        assert!(pictures.contains(label), "{label}");
    }
    assert!(
        pictures.contains("water-splatting: as photographed, ") && pictures.contains("the truth (simulated)")
    );
    assert!(pictures.contains("href=\"../report.html\""));
}

#[test]
fn a_failure_has_its_reason_and_its_log_in_the_overview_and_on_its_page() {
    let batch = Batch::new();
    batch.pipeline(2, 0, 0);
    let text = fs::read_to_string(batch.at("many.toml")).expect("read");
    fs::write(batch.at("many.toml"), format!("{text}[[scene]]\nname = \"broken\"\ncapture = \"broken\"\n"))
        .expect("written");
    for (path, bytes) in files(&batch.at("reef")) {
        let to = batch.at("broken").join(&path);
        fs::create_dir_all(to.parent().expect("a folder")).expect("a folder");
        let model = path.ends_with("images.bin");
        fs::write(to, if model { b"no model".to_vec() } else { bytes }).expect("written");
    }
    for arguments in [&["--report-only", "--keep-going"][..], &["--report-only", "--gather"]] {
        let said = batch.done(arguments, 1);
        let overview = batch.read("report.html");
        let row =
            overview.lines().find(|line| line.contains(">broken</a>")).unwrap_or_else(|| panic!("{said}"));
        for part in ["class=\"failed\"", "import: ", "images.bin", "import.log</code>"] {
            assert!(row.contains(part), "{arguments:?}, {part}: {row}");
        }
        assert!(
            overview.contains("1 scene failed or is not complete: broken. The list below"),
            "{arguments:?}"
        );
        assert!(batch.read("broken/report.html").contains("<code>import</code> failed: "), "{arguments:?}");
    }
}

#[test]
fn a_large_batch_has_a_small_overview_and_a_change_of_one_scene_costs_little() {
    let asked =
        |name: &str, usual: usize| std::env::var(name).map_or(usual, |n| n.parse().expect("a number"));
    let (scenes, variants) = (asked("USE3D_SCENES", 20), asked("USE3D_VARIANTS", 3));
    let batch = Batch::new();
    batch.pipeline(scenes, variants, 0);
    let time = |name: &str, arguments: &[&str]| {
        let run = batch.run(arguments);
        // The shell's `time` has the processor time of its child.
        let mut timed = Command::new("bash");
        timed
            .args(["-c", "TIMEFORMAT='%U %S'; time \"$@\"", "time"])
            .arg(run.get_program())
            .args(run.get_args());
        let output = timed.output().expect("bash starts");
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{said}");
        let spent: f64 =
            said.split_whitespace().rev().take(2).filter_map(|word| word.parse::<f64>().ok()).sum();
        println!("{scenes} scenes × {variants} variants, {name}: {spent:.1} s of processor time");
        spent
    };
    time("everything computed", &["--cache-only"]);
    let bare = time("nothing to compute", &["--cache-only"]);
    let whole = time("the whole report written", &["--report-only"]);
    std::thread::sleep(Duration::from_millis(2100));
    time("nothing to do", &["--report-only"]);
    let idle = time("nothing to do, once more", &["--report-only"]);
    let overview = fs::metadata(batch.at("out/report.html")).expect("the overview").len();
    println!("the overview has {:.2} MB; the report took {:.1} s", overview as f64 / 1e6, whole - bare);
    batch.pipeline(scenes, variants, 2);
    time("another stage 2 for the last scene", &["--cache-only"]);
    let changed = time("the report after it", &["--report-only"]);
    println!("a change of one scene costs the report {:.1} s", changed - idle);
    assert!(overview as usize <= 300_000 + scenes * (2_500 + 350 * variants), "{overview}");
}
