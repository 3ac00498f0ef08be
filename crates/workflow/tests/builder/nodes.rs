//! One cache and two machines, with other names, clocks a year apart, and a file system that shows new files
//! late and loses replies. They share the work, nothing is computed twice, and the bytes are those of one
//! machine.

use std::collections::{BTreeMap, HashMap};
use std::fs;
use std::io::{self, ErrorKind, Read};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{self, Receiver, Sender};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use serde_json::json;
use use3d_workflow::files::Files;
use use3d_workflow::node::{Clock, Node};
use use3d_workflow::run::{NodeResult, RunOptions};
use use3d_workflow::{Batch, Builder, Cache, Event, Graph, Listener, Summary};

use super::stages::{Fast, batch, builder, payload, registry, run};

/// The rate of these machines' clocks: their minutes are seconds. It is no higher, because a holder without a
/// pulse for five of their minutes counts as ended, and a thread may be suspended for a second or two.
const RATE: f64 = 20.0;
/// The clock rate of a machine that no other machine waits for.
pub(super) const HASTE: f64 = 200.0;

/// A machine's view of the files. For the time `late` after an artifact was looked up and not found, it stays
/// invisible, unless the machine refreshes its view and `stubborn` is not set. Every `nth` rename and
/// creation succeeds but reports a failure.
struct Network {
    late: Duration,
    stubborn: bool,
    nth: u64,
    count: AtomicU64,
    absent: Mutex<HashMap<PathBuf, Instant>>,
}

impl Network {
    fn new(late: u64, stubborn: bool, nth: u64) -> Arc<Self> {
        let late = Duration::from_millis(late);
        Arc::new(Self { late, stubborn, nth, count: AtomicU64::new(0), absent: Mutex::default() })
    }

    /// The artifact folder that a path is, or lies in.
    fn artifact(path: &Path) -> Option<PathBuf> {
        let below = path.ancestors().find(|a| a.parent().is_some_and(|p| p.ends_with("artifacts")))?;
        let key = path.strip_prefix(below).ok()?.components().next()?;
        Some(below.join(key))
    }

    fn is_hidden(&self, path: &Path) -> bool {
        let Some(artifact) = Self::artifact(path) else { return false };
        let mut absent = self.absent.lock().expect("lock");
        match absent.get(&artifact) {
            Some(since) if since.elapsed() < self.late => true,
            Some(_) => {
                absent.remove(&artifact);
                false
            }
            None => {
                if !artifact.exists() {
                    absent.insert(artifact, Instant::now());
                }
                false
            }
        }
    }

    fn seen<T>(&self, path: &Path, look: impl FnOnce() -> io::Result<T>) -> io::Result<T> {
        if self.is_hidden(path) { Err(ErrorKind::NotFound.into()) } else { look() }
    }

    fn answer_is_lost(&self) -> bool {
        self.nth > 0 && self.count.fetch_add(1, Ordering::SeqCst) % self.nth == self.nth - 1
    }
}

impl Files for Network {
    fn read(&self, path: &Path) -> io::Result<Vec<u8>> {
        self.seen(path, || Fast.read(path))
    }
    fn open(&self, path: &Path) -> io::Result<Box<dyn Read>> {
        self.seen(path, || Fast.open(path))
    }
    fn exists(&self, path: &Path) -> io::Result<bool> {
        Ok(!self.is_hidden(path) && path.exists())
    }
    fn look_again(&self, folder: &Path) {
        if !self.stubborn {
            self.absent.lock().expect("lock").retain(|path, _| !path.starts_with(folder));
        }
    }
    fn write(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        Fast.write(path, bytes)
    }
    fn append(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        Fast.append(path, bytes)
    }
    fn create_new(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        Fast.create_new(path, bytes)?;
        if self.answer_is_lost() { Err(ErrorKind::AlreadyExists.into()) } else { Ok(()) }
    }
    fn create_dir_all(&self, path: &Path) -> io::Result<()> {
        Fast.create_dir_all(path)
    }
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        Fast.rename(from, to)?;
        if let Some(artifact) = Self::artifact(to) {
            self.absent.lock().expect("lock").remove(&artifact);
        }
        if self.answer_is_lost() { Err(ErrorKind::NotFound.into()) } else { Ok(()) }
    }
    fn sync(&self, _: &Path) -> io::Result<()> {
        Ok(())
    }
    fn remove_file(&self, path: &Path) -> io::Result<()> {
        Fast.remove_file(path)
    }
    fn remove_dir_all(&self, path: &Path) -> io::Result<()> {
        Fast.remove_dir_all(path)
    }
}

/// A machine on the cache in `folder`; its stages take `delay` milliseconds.
fn machine(folder: &Path, host: &str, files: Arc<dyn Files>, delay: u64) -> Builder {
    machine_at(RATE, folder, host, files, delay)
}

pub(super) fn machine_at(rate: f64, folder: &Path, host: &str, files: Arc<dyn Files>, delay: u64) -> Builder {
    let year = Duration::from_secs(31_536_000);
    let clock = Clock::other(if host == "west" { year } else { Duration::ZERO }, rate);
    let cache = Cache::with_files(folder, false, files).expect("cache");
    Builder::new(registry(delay), cache.as_node(Node::elsewhere(host, clock)))
}

#[derive(Default)]
pub(super) struct Told {
    pub(super) started: Vec<String>,
    pub(super) waited: Vec<String>,
    pub(super) warnings: Vec<String>,
}

/// Runs a batch; `meddle` gets every event first.
pub(super) fn run_told(
    builder: &Builder,
    batch: &Batch,
    options: &RunOptions,
    meddle: impl Fn(&Event<'_>) + Send + Sync + 'static,
) -> (Summary, Told) {
    let graph = Graph::new(&builder.registry, batch).expect("graph");
    let told: Arc<Mutex<Told>> = Arc::default();
    let into = told.clone();
    let listener: Arc<dyn Listener> = Arc::new(move |event: &Event<'_>| {
        match event {
            Event::Started { label, .. } => into.lock().expect("lock").started.push((*label).to_string()),
            Event::Waiting { label, .. } => into.lock().expect("lock").waited.push((*label).to_string()),
            Event::Warning { label, text } => {
                into.lock().expect("lock").warnings.push(format!("{label}: {text}"));
            }
            _ => {}
        }
        meddle(event);
    });
    let summary = builder.run(&graph, options, &listener);
    let told = std::mem::take(&mut *told.lock().expect("lock"));
    (summary, told)
}

fn undisturbed(folder: &Path, batch: &Batch) -> BTreeMap<String, Vec<u8>> {
    let alone = builder(&folder.join("alone"));
    assert_eq!(run(&alone, batch).0.exit_code(), 0);
    payload(&alone.cache)
}

#[test]
fn two_machines_share_the_work_and_compute_nothing_twice() {
    let dir = tempfile::tempdir().expect("folder");
    let batch = batch(&dir.path().join("data"), &["reef", "wreck", "wall", "cave"]);
    let expected = undisturbed(dir.path(), &batch);
    for (late, nth) in [(0, 0), (150, 0), (150, 3)] {
        let folder = dir.path().join(format!("cache-{late}-{nth}"));
        let both: Vec<(Summary, Told)> = std::thread::scope(|scope| {
            let start = |host: &'static str| {
                let builder = machine(&folder, host, Network::new(late, false, nth), 12);
                let batch = &batch;
                scope.spawn(move || run_told(&builder, batch, &RunOptions::default(), |_| ()))
            };
            let threads = ["east", "west"].map(start);
            threads.into_iter().map(|thread| thread.join().expect("runs")).collect()
        });
        let mut started: Vec<&String> = both.iter().flat_map(|(_, told)| &told.started).collect();
        let all = started.len();
        started.sort();
        started.dedup();
        assert_eq!((started.len(), all), (22, 22), "{late} {nth}: {started:?}");
        for (summary, told) in &both {
            assert_eq!((summary.exit_code(), told.warnings.len()), (0, 0), "{summary}{:?}", told.warnings);
            assert!(!told.started.is_empty(), "both have worked");
        }
        let cache = machine(&folder, "east", Arc::new(Fast), 0).cache;
        assert_eq!(payload(&cache), expected, "{late} {nth}");
        assert!(!cache.root().join("damaged").exists(), "nothing good was taken for damaged");
        // The artifacts of a summary are protected while the summary exists.
        drop(both);
        assert_eq!(fs::read_dir(cache.root().join("leases")).expect("leases").count(), 0);
        assert_eq!(fs::read_dir(cache.root().join("tmp")).expect("tmp").count(), 0);
    }
}

/// A gate at which the first machine waits for the second: it has begun a stage, and continues after a
/// message, or when the sender is dropped. Drop the sender inside the scope of the threads: otherwise a
/// failing test would wait for ever.
fn gate(stage: &'static str) -> (impl Fn(&Event<'_>) + Send + Sync, Receiver<()>, Sender<()>) {
    let ((begun, begins), (go, goes)) = (mpsc::channel(), mpsc::channel::<()>());
    let goes = Mutex::new(goes);
    let meddle = move |event: &Event<'_>| {
        if matches!(event, Event::Started { label, .. } if *label == stage) {
            begun.send(()).expect("heard");
            // A failing test drops the other end.
            let _ = goes.lock().expect("lock").recv();
        }
    };
    (meddle, begins, go)
}

#[test]
fn what_another_machine_has_made_is_waited_for_until_it_is_seen() {
    let dir = tempfile::tempdir().expect("folder");
    let batch = batch(&dir.path().join("data"), &["reef"]);
    let expected = undisturbed(dir.path(), &batch);
    let folder = dir.path().join("cache");
    let east = machine(&folder, "east", Arc::new(Fast), 0);
    let west = machine(&folder, "west", Network::new(250, true, 0), 0);
    let (meddle, begins, go) = gate("reef · import");
    let options = RunOptions { until: Some(vec!["import".to_string()]), ..RunOptions::default() };
    std::thread::scope(|scope| {
        let first = scope.spawn(|| run_told(&east, &batch, &options, meddle));
        begins.recv().expect("it begins");
        let go = Mutex::new(go);
        let second = move |event: &Event<'_>| {
            if matches!(event, Event::Waiting { .. }) {
                // The second machine looked it up too early, and cannot see the artifact for a while.
                go.lock().expect("lock").send(()).expect("goes on");
            }
        };
        let (summary, told) = run_told(&west, &batch, &options, second);
        assert_eq!((summary.exit_code(), told.started.len()), (0, 0), "{summary}{:?}", told.started);
        assert_eq!((told.waited.as_slice(), summary.cached()), (&["reef · import".to_string()][..], 1));
        assert_eq!(first.join().expect("runs").0.exit_code(), 0);
    });
    run(&west, &batch);
    assert_eq!(payload(&west.cache), expected);
}

#[test]
fn while_another_one_computes_something_else_is_done() {
    let dir = tempfile::tempdir().expect("folder");
    let batch = batch(&dir.path().join("data"), &["reef", "wreck", "wall"]);
    let expected = undisturbed(dir.path(), &batch);
    let folder = dir.path().join("cache");
    let (east, west) =
        (machine(&folder, "east", Arc::new(Fast), 0), machine(&folder, "west", Arc::new(Fast), 0));
    let (meddle, begins, go) = gate("reef · import");
    std::thread::scope(|scope| {
        let first = scope.spawn(|| run_told(&east, &batch, &RunOptions::default(), meddle));
        begins.recv().expect("it begins");
        // With one job at a time, it computes the other scenes, and leaves this one to the first machine.
        let options = RunOptions { until_empty: Some(Duration::ZERO), ..RunOptions::default() };
        let (summary, told) = run_told(&west, &batch, &options, |_| ());
        assert_eq!(summary.exit_code(), 0, "{summary}");
        assert!(told.started.iter().all(|label| !label.starts_with("reef")), "{:?}", told.started);
        for scene in ["wreck", "wall"] {
            assert!(told.started.contains(&format!("{scene} · evaluate")), "{:?}", told.started);
        }
        let theirs = |n: &&use3d_workflow::run::RanNode| matches!(n.result, NodeResult::Elsewhere(_));
        let left: Vec<&str> = summary.nodes.iter().filter(theirs).map(|n| n.stage).collect();
        assert!(left.contains(&"import") && left.contains(&"report"), "{left:?}");
        assert!(summary.to_string().contains("left to other processes"), "{summary}");
        let of = |n: &&use3d_workflow::run::RanNode| n.scene == "reef" && n.stage == "import";
        let import = summary.nodes.iter().find(of).expect("there");
        assert!(matches!(&import.result, NodeResult::Elsewhere(who) if who.contains("east")), "{import:?}");
        go.send(()).expect("goes on");
        drop(go);
        let (summary, told) = first.join().expect("runs");
        assert_eq!(summary.exit_code(), 0, "{summary}");
        assert!(told.started.iter().all(|l| l.starts_with("reef") || l == "report"), "{:?}", told.started);
    });
    assert_eq!(payload(&east.cache), expected);
}

#[test]
fn a_run_whose_time_is_over_leaves_its_checkpoints_to_the_next() {
    let dir = tempfile::tempdir().expect("folder");
    let mut batch = batch(&dir.path().join("data"), &["reef"]);
    batch.defaults.insert("reconstruct".to_string(), json!({"iterations": 1200}));
    let expected = undisturbed(dir.path(), &batch);
    // The clock runs two hundred times as fast.
    let east = machine_at(HASTE, &dir.path().join("cache"), "east", Arc::new(Fast), 6);
    let limited =
        |seconds: u64| RunOptions { limit: Some(Duration::from_secs(seconds)), ..RunOptions::default() };
    let (mut codes, mut resumed) = (Vec::new(), 0);
    for _ in 0..200 {
        let (summary, _) = run_told(&east, &batch, &limited(50), |_| ());
        codes.push(summary.exit_code());
        let log = fs::read_to_string(east.cache.root().join("logs/synthetic/reef/_/reconstruct.log"));
        resumed += usize::from(log.is_ok_and(|log| log.contains("resuming from step")));
        if summary.exit_code() == 0 {
            break;
        }
        assert!(summary.to_string().contains("time limit reached"), "{summary}");
    }
    assert_eq!((codes.first(), codes.last()), (Some(&75), Some(&0)), "{codes:?}");
    assert!(codes[..codes.len() - 1].iter().all(|code| *code == 75) && resumed > 0, "{codes:?} {resumed}");
    assert_eq!(payload(&east.cache), expected);
}

#[test]
fn what_would_be_cut_off_is_left_for_a_run_with_more_time() {
    let dir = tempfile::tempdir().expect("folder");
    let batch = batch(&dir.path().join("data"), &["reef"]);
    let folder = dir.path().join("cache");
    let east = machine_at(HASTE, &folder, "east", Arc::new(Fast), 12);
    // All other stages are quick. According to the records, this one takes nearly all of the time, and it has
    // no checkpoints.
    let timing = json!({"stage": "targets", "scene": "reef", "length": 1.0, "bytes": 0, "seconds": 17_999.9,
        "peak_memory": 0, "output": 0});
    fs::create_dir_all(east.cache.root().join("timings")).expect("folder");
    fs::write(east.cache.root().join("timings/known.jsonl"), timing.to_string()).expect("written");
    let limit =
        |seconds: u64| RunOptions { limit: Some(Duration::from_secs(seconds)), ..RunOptions::default() };
    let (summary, told) = run_told(&east, &batch, &limit(18_120), |_| ());
    assert_eq!(summary.exit_code(), 75, "{summary}");
    assert!(told.started.iter().any(|l| l == "reef · reconstruct"), "{:?}", told.started);
    assert!(told.started.iter().all(|l| l != "reef · targets"), "{:?}", told.started);
    // It would not fit in any run with this limit, so it is tried all the same.
    let (summary, told) = run_told(&east, &batch, &limit(3600), |_| ());
    assert_eq!((summary.exit_code(), told.started.iter().any(|l| l == "reef · targets")), (0, true));
}

#[test]
fn who_computes_what_is_seen_from_another_machine() {
    let dir = tempfile::tempdir().expect("folder");
    let batch = batch(&dir.path().join("data"), &["reef", "wreck"]);
    let folder = dir.path().join("cache");
    let (east, west) =
        (machine(&folder, "east", Arc::new(Fast), 0), machine(&folder, "west", Arc::new(Fast), 0));
    let graph = Graph::new(&west.registry, &batch).expect("graph");
    let (meddle, begins, go) = gate("reef · import");
    std::thread::scope(|scope| {
        let first = scope.spawn(|| run_told(&east, &batch, &RunOptions::default(), meddle));
        begins.recv().expect("it begins");
        let status = west.plan(&graph, None).status();
        let cell = |scene: &str| {
            let row = status.rows.iter().find(|r| r.scene == scene).expect("a row");
            row.cells.iter().find(|c| c.stage == "import").expect("a cell")
        };
        assert_eq!(cell("reef").working.as_ref().expect("somebody").host, "east");
        assert!(cell("wreck").working.is_none());
        let text = status.to_string();
        assert!(text.contains("running") && text.contains("reef · import: on east (process 1)"), "{text}");
        go.send(()).expect("goes on");
        drop(go);
        first.join().expect("runs");
    });
    let text = west.plan(&graph, None).status().to_string();
    assert!(!text.contains("running"), "{text}");
}

#[test]
fn a_part_of_a_batch_is_what_was_asked_for_and_what_it_needs() {
    let dir = tempfile::tempdir().expect("folder");
    let batch = batch(&dir.path().join("data"), &["reef", "wreck"]);
    let builder = builder(&dir.path().join("cache"));
    let options = RunOptions {
        only: Some(vec![("wreck".to_string(), String::new())]),
        until: Some(vec!["targets".to_string()]),
        ..RunOptions::default()
    };
    let (summary, told) = run_told(&builder, &batch, &options, |_| ());
    assert_eq!(summary.exit_code(), 0, "{summary}");
    let mut started = told.started;
    started.sort();
    assert_eq!(started, ["calibrate", "wreck · import", "wreck · reconstruct", "wreck · targets"]);
    let (summary, told) = run_told(&builder, &batch, &RunOptions { until: None, ..options }, |_| ());
    let of = |label: &String| label.starts_with("wreck");
    assert!(summary.exit_code() == 0 && told.started.iter().all(of), "{summary}{:?}", told.started);
}

#[test]
fn one_that_only_gathers_computes_nothing_of_a_scene_and_says_what_is_missing() {
    let dir = tempfile::tempdir().expect("folder");
    let batch = batch(&dir.path().join("data"), &["reef", "wreck"]);
    let builder = builder(&dir.path().join("cache"));
    let reef = RunOptions { only: Some(vec![("reef".to_string(), String::new())]), ..RunOptions::default() };
    assert_eq!(run_told(&builder, &batch, &reef, |_| ()).0.exit_code(), 0);
    let gather = RunOptions { gather: true, keep_going: true, ..RunOptions::default() };
    let (summary, told) = run_told(&builder, &batch, &gather, |_| ());
    assert_eq!((summary.exit_code(), told.started.as_slice()), (1, &["report".to_string()][..]), "{summary}");
    let missing: Vec<&str> = summary.missing().map(|n| n.label.as_str()).collect();
    assert_eq!(missing, ["wreck · import"], "{summary}");
    let report = summary.artifact("", "", "report").expect("made").path.join("table.txt");
    let text = fs::read_to_string(report).expect("read");
    assert!(text.contains("Group reef") && text.contains("missing wreck · evaluate"), "{text}");
    // If everything exists, the run succeeds.
    assert_eq!(run(&builder, &batch).0.exit_code(), 0);
    let (summary, told) = run_told(&builder, &batch, &gather, |_| ());
    assert!(summary.exit_code() == 0 && told.started.is_empty(), "{summary}{:?}", told.started);
}
