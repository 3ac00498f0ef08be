//! The cost of bookkeeping, counted in system calls: it does not grow with the number of scenes, and a run
//! that finds all results delivered reads no large file of them.
//!
//! It counts with `strace`. Larger numbers of scenes are for the figures in `docs/science/performance.md`:
//!
//! ```text
//! apt-get install --no-install-recommends strace
//! USE3D_SCENES=1000 cargo test -p use3d --test economy -- --nocapture
//! ```

mod tiny;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Instant;

use tiny::{TINY, files};

/// The calls that are counted: those that look for a name, read a link, or open a file.
const CALLS: &str = "trace=readlink,statx,openat";
/// The most of these calls for an artifact that a run computes, in `--until import`.
const COMPUTED: f64 = 600.0;
/// The same for an artifact that a run finds. Its capture has eleven files, and the artifact seventeen.
const FOUND: f64 = 85.0;
/// The most bytes that a run without work reads for an artifact: 50 MB for 26 scenes of ten variants, which
/// have about 900 artifacts.
const READ: f64 = 55_000.0;

/// Captures that differ in one image each, and pipeline files for the first of them.
struct Captures {
    dir: tempfile::TempDir,
}

impl Captures {
    fn new(count: usize) -> Self {
        let dir = tempfile::tempdir().expect("a folder");
        let first = dir.path().join("first");
        let mut synth = tiny::command();
        synth.args(["-q", "synth", "capture", "--views", "4", "--size", "48x32", "--out"]).arg(&first);
        let output = synth.output().expect("the command starts");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let all = files(&first);
        for i in 0..count {
            for (k, (path, bytes)) in all.iter().filter(|(path, _)| !path.starts_with("truth")).enumerate() {
                let to = dir.path().join(format!("s{i:04}")).join(path);
                fs::create_dir_all(to.parent().expect("a folder")).expect("folder");
                let is_image = path.extension().is_some_and(|e| e == "png");
                // Readers ignore what follows the end of an image, and the content has another digest.
                let more = if is_image { format!("{i} {k}") } else { String::new() };
                fs::write(to, [&bytes[..], more.as_bytes()].concat()).expect("written");
            }
        }
        // Digests of files that are younger than two seconds are not kept.
        std::thread::sleep(std::time::Duration::from_millis(2100));
        Self { dir }
    }

    fn at(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    /// Writes a pipeline file of the first `scenes` captures in so many variants.
    fn pipeline(&self, scenes: usize, variants: usize) -> PathBuf {
        let mut text = format!("name = \"p{scenes}\"\nseed = 42\n");
        for i in 0..scenes {
            text += &format!("[[scene]]\nname = \"s{i:04}\"\ncapture = \"s{i:04}\"\n");
        }
        for k in (0..variants).filter(|_| variants > 1) {
            text += &format!("[[variant]]\nname = \"v{k}\"\nenhance.iterations = {}\n", k + 1);
        }
        let path = self.at(&format!("p{scenes}.toml"));
        fs::write(&path, text).expect("written");
        path
    }
}

/// Runs the command under `strace`; returns its output and the lines of the trace.
fn traced(options: &[&str], log: &Path, command: &Command) -> (String, String) {
    let mut strace = Command::new("strace");
    strace.args(["-f", "-o"]).arg(log).args(options).arg("--").arg(command.get_program());
    strace.args(command.get_args()).env_remove("USE3D_CACHE").env_remove("USE3D_MODELS");
    let output = strace.output().expect("strace starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    (String::from_utf8_lossy(&output.stdout).into_owned(), fs::read_to_string(log).expect("a trace"))
}

/// The calls in a summary of `strace -c`.
fn calls(trace: &str) -> f64 {
    let total = trace.lines().rfind(|line| line.ends_with("total")).expect("a total");
    total.split_whitespace().nth(3).and_then(|calls| calls.parse().ok()).expect("a number of calls")
}

/// The bytes that the calls of a trace have read.
fn bytes_read(trace: &str) -> f64 {
    let of = |line: &str| line.rsplit_once(" = ")?.1.split_whitespace().next()?.parse::<f64>().ok();
    trace.lines().filter_map(of).filter(|bytes| *bytes > 0.0).sum()
}

fn skipped() -> bool {
    let there = Command::new("strace").args(["-c", "true"]).output().is_ok_and(|o| o.status.success());
    if !there {
        println!("SKIPPED, no call was counted: strace is not installed, or this system forbids it");
    }
    !there
}

#[test]
fn an_imported_capture_costs_the_same_in_a_large_batch() {
    if skipped() {
        return;
    }
    let most: usize = std::env::var("USE3D_SCENES").map_or(40, |n| n.parse().expect("a number of scenes"));
    let captures = Captures::new(most);
    let cost = |scenes: usize| {
        let pipeline = captures.pipeline(scenes, 1);
        let run = |cache: &str| {
            let mut run = tiny::command();
            run.args(["-q", "run"]).arg(&pipeline).args(["--until", "import", "--cache-only"]);
            run.args(["--threads", "1", "--cache"]).arg(captures.at(&format!("{cache}{scenes}")));
            run
        };
        let log = captures.at("trace");
        let counted = ["-c", "-e", CALLS];
        let computed = calls(&traced(&counted, &log, &run("counted")).1) / scenes as f64;
        // Digests of files that are younger than two seconds are not kept.
        std::thread::sleep(std::time::Duration::from_millis(2100));
        let found = calls(&traced(&counted, &log, &run("counted")).1) / scenes as f64;
        let start = Instant::now();
        assert!(run("timed").output().expect("the command starts").status.success());
        let seconds = start.elapsed().as_secs_f64() / scenes as f64;
        println!(
            "{scenes} scenes: {computed:.0} calls an artifact computed, {found:.0} an artifact \
             found, {seconds:.3} s an artifact"
        );
        (computed, found)
    };
    let (small, large) = (cost(8), cost(most));
    // The start of the program is a part of the cost of a small batch.
    assert!(large.0 <= small.0 && large.0 < COMPUTED, "{small:?} {large:?}");
    assert!(large.1 <= small.1 && large.1 < FOUND, "{small:?} {large:?}");
}

#[test]
fn a_run_that_finds_everything_delivered_reads_none_of_it() {
    let captures = Captures::new(2);
    let pipeline = captures.pipeline(2, 3);
    let run = || {
        let mut run = tiny::command();
        run.args(["-q", "run"]).arg(&pipeline).args(["--threads", "1", "--json", "--cache"]);
        run.arg(captures.at("cache")).arg("--out").arg(captures.at("out"));
        for set in TINY.iter().filter(|set| !set.starts_with("enhance.")) {
            run.args(["--set", set]);
        }
        run
    };
    let output = run().output().expect("the command starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let changed = || {
        let all = files(&captures.at("out"));
        let time =
            |path: &PathBuf| fs::metadata(captures.at("out").join(path)).and_then(|m| m.modified()).ok();
        all.into_keys().map(|path| (time(&path), path)).collect::<Vec<_>>()
    };
    // The first run without work may note what was made a moment before the end of the run that made it.
    std::thread::sleep(std::time::Duration::from_millis(2100));
    assert!(run().output().expect("the command starts").status.success());
    let before = changed();
    assert!(run().output().expect("the command starts").status.success());
    assert!(changed() == before, "the results were written again");
    if skipped() {
        return;
    }
    let log = captures.at("trace");
    let (said, trace) = traced(&["-e", "trace=openat,open"], &log, &run());
    let summary: serde_json::Value = serde_json::from_str(&said).expect("JSON");
    let nodes = summary["nodes"].as_array().expect("nodes");
    assert!(nodes.iter().all(|node| node["result"] == "cached"), "{said}");
    let artifacts = nodes.len() as f64;
    let out = captures.at("out").to_string_lossy().into_owned();
    let opened: Vec<&str> = trace.lines().filter(|line| line.contains(&out)).collect();
    // A file without a name shows that the folder can be written. The record of the run and the scores are
    // read, once each, for the answer on the terminal.
    let is_file = |line: &&&str| !line.contains("O_DIRECTORY") && !line.contains("O_TMPFILE");
    let mut read: Vec<&str> =
        opened.iter().filter(is_file).filter_map(|line| line.split('"').nth(1)).collect();
    let kept = |path: &&str| !path.ends_with("/scores/scores.json") && !path.contains("/runs/");
    assert_eq!(read.iter().copied().find(kept), None);
    let count = read.len();
    read.sort_unstable();
    read.dedup();
    assert_eq!(read.len(), count, "{read:?}");
    let (_, trace) = traced(&["-e", "trace=read,pread64,readv"], &log, &run());
    let bytes = bytes_read(&trace) / artifacts;
    let (_, trace) = traced(&["-c", "-e", CALLS], &log, &run());
    println!("nothing to do: {bytes:.0} bytes read, {:.0} calls, per artifact", calls(&trace) / artifacts);
    assert!(bytes < READ, "{bytes}");
    assert!(changed() == before, "the results were written again");
}

/// The most calls for a stage of a scene and variant that a command looks at, with no result there: by `plan`
/// and `status`, and by `submit`, which also examines the results folder. A capture has eleven files, and ten
/// variants share it.
const LOOKED_AT: [f64; 3] = [4.0, 4.0, 6.0];
/// The most calls of a task of `--layout stages` for each other scene of the batch.
const BY_A_TASK: f64 = 5.0;

/// Commands that look at a large batch: none costs more for a stage than in a small batch, and a task that
/// computes one scene hardly looks at the others.
#[test]
fn looking_at_a_stage_costs_the_same_in_a_large_batch() {
    if skipped() {
        return;
    }
    let most: usize = std::env::var("USE3D_SCENES").map_or(30, |n| n.parse().expect("a number of scenes"));
    let captures = Captures::new(most);
    let log = captures.at("trace");
    let variants = 10;
    let costs = |scenes: usize| {
        let pipeline = captures.pipeline(scenes, variants);
        let cache = captures.at(&format!("cache{scenes}"));
        let command = |verbs: &[&str], words: &[&str]| {
            let mut command = tiny::command();
            command.args(verbs).arg(&pipeline).arg("--cache").arg(&cache).args(words);
            command
        };
        let planned = command(&["plan"], &["--json"]).output().expect("the command starts");
        let plan: serde_json::Value = serde_json::from_slice(&planned.stdout).expect("JSON");
        let nodes = plan["nodes"].as_array().expect("nodes").len() as f64;
        let out = captures.at("out").to_string_lossy().into_owned();
        let only = ["--only", "s0000@v0", "--until", "import", "--cache-only", "--threads", "1"];
        let submit = ["--layout", "stages", "--dry-run", "--out", &out];
        let counted = |name: &str, command: Command, of: f64| {
            let start = Instant::now();
            let (said, trace) = traced(&["-c", "-e", CALLS], &log, &command);
            let (all, seconds) = (calls(&trace), start.elapsed().as_secs_f64());
            println!(
                "{scenes} scenes × {variants}, {name}: {all:.0} calls, {:.2} of {of}, {seconds:.1} s",
                all / of
            );
            (said, all / of)
        };
        let (said, submitted) =
            counted("submit --dry-run", command(&["-q", "submit", "slurm"], &submit), nodes);
        // There is one task for every artifact: the variants differ in stage 2, and share what comes before.
        let tasks: usize = said
            .lines()
            .filter(|line| line.contains(" tasks, ") || line.contains(" 1 task, "))
            .filter_map(|line| line.split_whitespace().nth(1)?.parse::<usize>().ok())
            .sum();
        println!("{scenes} scenes × {variants}: {nodes} stages, {tasks} tasks");
        let shared = plan["nodes"].as_array().expect("nodes").iter().filter(|n| !n["shared_with"].is_null());
        assert_eq!(tasks, nodes as usize - shared.count());
        let looks = [
            counted("plan", command(&["-q", "plan"], &[]), nodes).1,
            counted("status", command(&["-q", "status"], &["--summary"]), nodes).1,
            submitted,
        ];
        let task = counted("a task", command(&["-q", "run"], &only), 1.0).1;
        let again = counted("a task that is done", command(&["-q", "run"], &only), 1.0).1;
        (looks, [task, again])
    };
    let ((small, few), (large, many)) = (costs(5), costs(most));
    for ((small, large), bound) in small.into_iter().zip(large).zip(LOOKED_AT) {
        assert!(large <= small && large < bound, "{small} {large}");
    }
    for (few, many) in few.into_iter().zip(many) {
        let others = (many - few) / (most - 5) as f64;
        assert!(others < BY_A_TASK, "{others} calls for each other scene");
    }
}
