//! Processes that are killed at any moment, and two processes at once: the bytes are the same in the end.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use use3d_workflow::run::RunOptions;
use use3d_workflow::{Builder, Cache};

use super::stages::{batch, payload, registry, run, run_with};

const CHILD: &str = "USE3D_TEST_CHILD";
const SCENES: [&str; 2] = ["reef", "wreck"];
/// Milliseconds that every stage takes.
const DELAY: u64 = 12;

/// This is not a test by itself: the other tests start it as a child process.
#[test]
fn child() {
    let Some(folder) = std::env::var_os(CHILD) else { return };
    let folder = Path::new(&folder);
    let builder = Builder::new(registry(DELAY), Cache::open(&folder.join("cache"), false).expect("cache"));
    let options = RunOptions { jobs: 2, ..RunOptions::default() };
    let (summary, _, warnings) = run_with(&builder, &batch(&folder.join("data"), &SCENES), &options);
    println!("summary {} {} {}", summary.done(), summary.cached(), warnings.len());
    assert_eq!(summary.exit_code(), 0, "{summary}");
    assert!(warnings.is_empty(), "{warnings:?}");
}

fn spawn(folder: &Path) -> Child {
    Command::new(std::env::current_exe().expect("this program"))
        .args(["crash::child", "--exact", "--nocapture", "--test-threads=1"])
        .env(CHILD, folder)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("a child")
}

fn undisturbed(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let builder = Builder::new(registry(0), Cache::open(&folder.join("undisturbed"), false).expect("cache"));
    assert_eq!(run(&builder, &batch(&folder.join("data"), &SCENES)).0.exit_code(), 0);
    payload(&builder.cache)
}

/// The keys being computed when a process was killed are left in its leases.
fn interrupted(cache: &Cache, stages: &BTreeMap<String, String>, seen: &mut BTreeMap<String, usize>) {
    for entry in std::fs::read_dir(cache.root().join("leases")).expect("folder").filter_map(Result::ok) {
        if let Some(stage) = stages.get(entry.file_name().to_string_lossy().as_ref()) {
            *seen.entry(stage.clone()).or_default() += 1;
        }
    }
}

#[test]
fn killed_again_and_again_it_ends_with_the_same_bytes() {
    let dir = tempfile::tempdir().expect("folder");
    let expected = undisturbed(dir.path());
    let stages: BTreeMap<String, String> = expected
        .keys()
        .map(|path| {
            let mut parts = path.split('/');
            let stage = parts.next().expect("stage").to_string();
            (parts.next().expect("key").to_string(), stage)
        })
        .collect();
    let folder = dir.path().join("cache");
    let open = || Cache::open(&folder, false).expect("cache");
    let (mut kills, mut whole, mut seen) = (0u64, 0, BTreeMap::new());
    let mut random = 0x2545_f491_4f6c_dd1d_u64;
    let start = Instant::now();
    // A busy machine needs longer for each stage: if kills keep hitting the same few stages, later kills wait
    // longer.
    let (mut reach, mut stalled) = (56, 0);
    while kills < 55 || (seen.len() < 4 && kills < 400) {
        random ^= random << 13;
        random ^= random >> 7;
        random ^= random << 17;
        let mut process = spawn(dir.path());
        std::thread::sleep(Duration::from_millis(4 + random % reach));
        if process.try_wait().expect("a state").is_none() {
            process.kill().expect("killed");
            kills += 1;
        }
        let output = process.wait_with_output().expect("waited");
        let before = seen.len();
        interrupted(&open(), &stages, &mut seen);
        stalled = if seen.len() > before { 0 } else { stalled + 1 };
        if seen.len() < 4 && stalled >= 20 {
            (reach, stalled) = ((2 * reach).min(8000), 0);
        }
        if output.status.success() {
            assert_eq!(payload(&open()), expected);
            whole += 1;
            // A wait that is longer than a run kills nothing.
            reach = (reach / 2).max(56);
            std::fs::remove_dir_all(&folder).expect("from the start again");
        } else {
            assert!(output.status.code().is_none(), "{}", String::from_utf8_lossy(&output.stdout));
            // At every moment, all artifacts that exist are complete.
            for (path, bytes) in payload(&open()) {
                assert_eq!(expected.get(&path), Some(&bytes), "{path}");
            }
        }
    }
    let output = spawn(dir.path()).wait_with_output().expect("the last run");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stdout));
    assert_eq!(payload(&open()), expected);
    assert_eq!(std::fs::read_dir(folder.join("v1/tmp")).expect("tmp").count(), 0, "nothing is left over");
    println!(
        "{kills} kills, {whole} whole runs between, in {:.1} s; while computing {seen:?}",
        start.elapsed().as_secs_f64()
    );
    assert!(seen.len() >= 4, "kills hit too few stages: {seen:?}");
}

#[test]
fn two_processes_at_once_make_one_set_of_artifacts() {
    let dir = tempfile::tempdir().expect("folder");
    let expected = undisturbed(dir.path());
    let children = [spawn(dir.path()), spawn(dir.path()), spawn(dir.path())];
    let mut computed = 0;
    for child in children {
        let output = child.wait_with_output().expect("waited");
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
        let line = text.lines().find_map(|l| l.split_once("summary ")).expect("a summary").1.to_string();
        computed += line.split(' ').next().and_then(|n| n.parse::<usize>().ok()).expect("a number");
    }
    let cache = Cache::open(&dir.path().join("cache"), false).expect("cache");
    assert_eq!(payload(&cache), expected);
    assert!(computed >= 12, "{computed}");
    println!("three processes computed {computed} stages of 12");
    assert_eq!(std::fs::read_dir(cache.root().join("leases")).expect("leases").count(), 0);
    assert_eq!(std::fs::read_dir(cache.root().join("tmp")).expect("tmp").count(), 0);
}
