//! A full disk, a read-only folder, unreadable sectors, damaged artifacts: each leads to a clear error or a
//! recovery, and nothing is lost.

use std::fs;
use std::io::{self, Read};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};

use use3d_workflow::files::Files;
use use3d_workflow::plan::State;
use use3d_workflow::{Builder, Cache, Graph, Registry, Variant};

use super::stages::{Fast, batch, builder, code, payload, registry, run, stages};

/// The stages that are tested with faults.
const FEW: [&str; 5] = ["import", "depth", "calibrate", "reconstruct", "targets"];

/// Fails the n-th operation: after that all writes (a full disk), or that operation alone (a bad sector).
struct Faulty {
    left: AtomicI64,
    kind: io::ErrorKind,
    stays: bool,
}

impl Faulty {
    fn new(after: i64, kind: io::ErrorKind, stays: bool) -> Arc<Self> {
        Arc::new(Self { left: AtomicI64::new(after), kind, stays })
    }

    fn happened(&self) -> bool {
        self.left.load(Ordering::SeqCst) < 0
    }

    fn gate(&self, writes: bool) -> io::Result<()> {
        if self.stays && !writes {
            return Ok(());
        }
        let left = self.left.fetch_sub(1, Ordering::SeqCst);
        if left == 0 || (self.stays && left < 0) { Err(self.kind.into()) } else { Ok(()) }
    }
}

impl Files for Faulty {
    fn read(&self, path: &Path) -> io::Result<Vec<u8>> {
        self.gate(false)?;
        Fast.read(path)
    }
    fn open(&self, path: &Path) -> io::Result<Box<dyn Read>> {
        self.gate(false)?;
        Fast.open(path)
    }
    fn write(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        if let Err(error) = self.gate(true) {
            // A full disk leaves half of the file.
            let _ = Fast.write(path, &bytes[..bytes.len() / 2]);
            return Err(error);
        }
        Fast.write(path, bytes)
    }
    fn append(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        self.gate(true)?;
        Fast.append(path, bytes)
    }
    fn create_new(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        self.gate(true)?;
        Fast.create_new(path, bytes)
    }
    fn create_dir_all(&self, path: &Path) -> io::Result<()> {
        self.gate(true)?;
        Fast.create_dir_all(path)
    }
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        self.gate(true)?;
        Fast.rename(from, to)
    }
    fn sync(&self, _: &Path) -> io::Result<()> {
        self.gate(true)
    }
    fn remove_file(&self, path: &Path) -> io::Result<()> {
        Fast.remove_file(path)
    }
    fn remove_dir_all(&self, path: &Path) -> io::Result<()> {
        Fast.remove_dir_all(path)
    }
}

/// Fails the first, second, third … operation until a run succeeds, and continues without faults after each.
fn every_operation_fails_once(kind: io::ErrorKind, stays: bool) {
    let dir = tempfile::tempdir().expect("folder");
    let batch = batch(&dir.path().join("data"), &["reef"]);
    // A few stages are enough, one of them shared by all scenes: every operation is tried.
    let table = || {
        Registry::new(stages(0).into_iter().filter(|s| FEW.contains(&s.name())).collect(), code())
            .expect("table")
    };
    let builder = |folder: &Path| Builder::new(table(), builder(folder).cache);
    let reference = builder(&dir.path().join("reference"));
    run(&reference, &batch);
    let expected = payload(&reference.cache);
    let (mut tried, mut failed) = (0, 0);
    for n in 0.. {
        let folder = dir.path().join(format!("cache{n}"));
        let faulty = Faulty::new(n, kind, stays);
        let mut done = 0;
        match Cache::with_files(&folder, false, faulty.clone()) {
            Err(error) => {
                assert!(error.to_string().contains("cache"), "{error}");
                failed += 1;
            }
            Ok(cache) => {
                let (summary, ..) = run(&Builder::new(table(), cache), &batch);
                done = summary.done();
                if summary.exit_code() != 0 {
                    failed += 1;
                    let text = summary.to_string();
                    assert!(text.contains("cannot") && text.contains("log:"), "{text}");
                    assert!(kind != io::ErrorKind::StorageFull || text.contains("use3d gc"), "{text}");
                }
            }
        }
        // The artifacts that were finished before are kept, all artifacts are complete, and the next run
        // succeeds.
        let builder = builder(&folder);
        let (summary, ..) = run(&builder, &batch);
        assert_eq!(summary.exit_code(), 0, "operation {n}: {summary}");
        assert!(summary.cached() >= done, "operation {n}: {done} were done, {} were kept", summary.cached());
        assert_eq!(payload(&builder.cache), expected, "operation {n}");
        fs::remove_dir_all(&folder).expect("removed");
        tried += 1;
        if !faulty.happened() {
            break;
        }
    }
    println!("{kind}: failed at each of {tried} operations, {failed} runs ended with an error");
    assert!(tried > 40 && failed > 20, "{tried} {failed}");
}

#[test]
fn a_full_disk_is_said_and_nothing_is_lost() {
    every_operation_fails_once(io::ErrorKind::StorageFull, true);
}

#[test]
fn a_single_failing_operation_is_said_and_nothing_is_lost() {
    every_operation_fails_once(io::ErrorKind::Other, false);
}

#[test]
fn a_read_only_cache_can_be_planned_from_and_says_so_when_run() {
    let dir = tempfile::tempdir().expect("folder");
    let mut batch = batch(&dir.path().join("data"), &["reef"]);
    run(&builder(&dir.path().join("cache")), &batch);
    // Opening an existing cache creates nothing.
    let faulty = Faulty::new(1, io::ErrorKind::ReadOnlyFilesystem, true);
    let cache = Cache::with_files(&dir.path().join("cache"), false, faulty).expect("opened");
    let builder = Builder::new(registry(0), cache);
    let graph = Graph::new(&builder.registry, &batch).expect("graph");
    assert_eq!(builder.plan(&graph, None).to_run(), 0);
    assert_eq!(run(&builder, &batch).0.exit_code(), 0, "what is cached can be used");
    batch.seed = 7;
    let (summary, ..) = run(&builder, &batch);
    assert!(summary.to_string().contains("--cache"), "{summary}");
}

#[test]
fn damaged_artifacts_are_found_said_and_made_again() {
    let dir = tempfile::tempdir().expect("folder");
    let batch = batch(&dir.path().join("data"), &["reef"]);
    let folder = dir.path().join("cache");
    let (summary, ..) = run(&builder(&folder), &batch);
    let whole = payload(&builder(&folder).cache);
    let path = |stage: &str| summary.artifact("reef", "", stage).expect("there").path.clone();
    type Damage = (&'static str, &'static str, fn(&Path));
    let damages: [Damage; 7] = [
        ("import", "missing", |p| fs::remove_file(p.join("words.txt")).expect("removed")),
        ("targets", "changed", |p| {
            let mut bytes = fs::read(p.join("result.txt")).expect("bytes");
            bytes[5] ^= 4;
            fs::write(p.join("result.txt"), bytes).expect("flipped");
        }),
        ("enhance", "bytes", |p| fs::write(p.join("deep/value.txt"), "short").expect("cut")),
        ("evaluate", "manifest.json is missing", |p| {
            fs::remove_file(p.join("manifest.json")).expect("removed");
        }),
        ("evaluate", "manifest.json is damaged", |p| fs::write(p.join("manifest.json"), "{").expect("cut")),
        ("reconstruct", "own digests", |p| {
            let text = fs::read_to_string(p.join("manifest.json")).expect("text");
            fs::write(p.join("manifest.json"), text.replace("\"rbf\"", "\"mlp\"")).expect("edited");
        }),
        ("calibrate", "missing", |p| fs::remove_dir_all(p.join("deep")).expect("removed")),
    ];
    for (stage, what, damage) in damages {
        damage(&path(stage));
        let builder = builder(&folder);
        let graph = Graph::new(&builder.registry, &batch).expect("graph");
        let plan = builder.plan(&graph, None);
        let damaged = plan.nodes.iter().find(|n| n.stage == stage).expect("planned");
        assert!(
            matches!(&damaged.state, State::Run(reason) if reason.contains(what)),
            "{stage}: {:?}",
            damaged.state
        );
        let (summary, started, warnings) = run(&builder, &batch);
        assert_eq!(started.len(), 1, "{stage}: only this one: {started:?}");
        assert!(warnings.iter().any(|w| w.contains("damaged") && w.contains("moved to")), "{warnings:?}");
        assert_eq!(summary.exit_code(), 0);
        assert_eq!(payload(&builder.cache), whole);
    }
    // A removed artifact folder counts as missing, not as damaged.
    fs::remove_dir_all(path("targets")).expect("removed");
    let (_, started, warnings) = run(&builder(&folder), &batch);
    assert_eq!((started.len(), warnings.len()), (1, 0));
}

#[test]
fn a_byte_flipped_behind_the_systems_back_is_found_when_it_is_read() {
    let dir = tempfile::tempdir().expect("folder");
    let mut batch = batch(&dir.path().join("data"), &["reef"]);
    let folder = dir.path().join("cache");
    let first = builder(&folder);
    let (summary, ..) = run(&first, &batch);
    let path = summary.artifact("reef", "", "targets").expect("there").path.join("result.txt");
    let mut bytes = fs::read(&path).expect("bytes");
    bytes[0] ^= 1;
    fs::write(&path, &bytes).expect("flipped");
    // Size and times appear unchanged: the table claims that this is the known content.
    let table = folder.join("v1/stat-table");
    let text = fs::read_to_string(&table).expect("table");
    let metadata = fs::metadata(&path).expect("metadata");
    #[cfg(unix)]
    let (changed, inode) = {
        use std::os::unix::fs::MetadataExt;
        (i128::from(metadata.ctime()) * 1_000_000_000 + i128::from(metadata.ctime_nsec()), metadata.ino())
    };
    #[cfg(not(unix))]
    let (changed, inode) = (0_i128, 0_u64);
    let modified =
        metadata.modified().expect("time").duration_since(std::time::UNIX_EPOCH).expect("time").as_nanos();
    let name = serde_json::to_string(path.to_str().expect("UTF-8")).expect("JSON");
    let lines: Vec<String> = text
        .lines()
        .map(|line| match line.ends_with(&name) {
            true => format!("{} {} {modified} {changed} {inode} {name}", &line[..64], bytes.len()),
            false => line.to_string(),
        })
        .collect();
    fs::write(&table, lines.join("\n")).expect("table");
    assert!(run(&builder(&folder), &batch).1.is_empty(), "nobody reads it, nobody sees it");
    // A variant reads the artifact that it shares with another one.
    let variant = |name: &str| Variant { name: name.to_string(), ..Variant::default() };
    batch.variants = vec![variant("as-before"), variant("weak")];
    batch.variants[1].overrides.insert("enhance".to_string(), serde_json::json!({"strength": 0.3}));
    let (summary, started, warnings) = run(&builder(&folder), &batch);
    assert_eq!(summary.exit_code(), 0, "{summary}");
    assert!(warnings.iter().any(|w| w.contains("its input targets is damaged")), "{warnings:?}");
    let ran = |label: &str| started.iter().any(|l| l == label);
    assert!(ran("reef · as-before · targets") && ran("reef · weak · enhance"), "{started:?}");
}
