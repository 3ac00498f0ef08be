//! Two machines that share nothing but a store: no lease tells them apart, and yet they share the work and
//! compute nothing twice, because each claims in the store what it computes.

use std::collections::BTreeSet;
use std::fs::File;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, SystemTime};

use use3d_workflow::node::{Clock, Node};
use use3d_workflow::remote::{FolderStore, Memory, Remote, RemoteStore};
use use3d_workflow::run::RunOptions;
use use3d_workflow::{Builder, Cache};

use super::faulty_store::{Fault, Faulty};
use super::nodes::{HASTE, machine_at, run_told};
use super::stages::{Fast, batch, builder, payload, registry, run};

#[test]
fn two_machines_with_one_store_share_the_work_and_compute_nothing_twice() {
    let dir = tempfile::tempdir().expect("a folder");
    let names: Vec<String> = (1..=12).map(|n| format!("s{n:02}")).collect();
    let batch = batch(dir.path(), &names.iter().map(String::as_str).collect::<Vec<_>>());
    let alone = builder(&dir.path().join("alone"));
    assert_eq!(run(&alone, &batch).0.exit_code(), 0);
    let whole = payload(&alone.cache);
    let remote = Arc::new(Memory::default());
    let started: Vec<usize> = std::thread::scope(|scope| {
        let machine = |host: &'static str| {
            let (dir, batch, whole, remote) = (&dir, &batch, &whole, remote.clone());
            scope.spawn(move || {
                let cache =
                    Cache::with_files(&dir.path().join(host), false, Arc::new(Fast)).expect("a cache");
                let cache = cache.as_node(Node::elsewhere(host, Clock::system()));
                let builder =
                    Builder::new(registry(5), cache).with_remote(Arc::new(RemoteStore::new(remote)));
                let (summary, started, _) = run(&builder, batch);
                assert!(summary.exit_code() == 0 && payload(&builder.cache) == *whole);
                started.len()
            })
        };
        let threads = ["west", "east"].map(machine);
        threads.into_iter().map(|thread| thread.join().expect("a machine")).collect()
    });
    let all = alone.cache.artifacts().len();
    assert!(started.iter().all(|count| *count > all / 4), "{started:?} of {all}");
    assert_eq!(started.iter().sum::<usize>(), all, "{started:?}");
    assert_eq!(claims(&remote), 0);
}

/// The number of claims in a store.
fn claims(remote: &Memory) -> usize {
    remote.list("v1/claims/").expect("a list").len()
}

/// A machine whose minutes are much shorter.
fn hasty(folder: &Path, host: &str, remote: Arc<dyn Remote>) -> Builder {
    machine_at(HASTE, &folder.join(host), host, Arc::new(Fast), 0)
        .with_remote(Arc::new(RemoteStore::new(remote)))
}

#[test]
fn the_claim_of_a_lost_machine_is_taken_over() {
    let dir = tempfile::tempdir().expect("a folder");
    let batch = batch(dir.path(), &["reef"]);
    let import = RunOptions { until: Some(vec!["import".to_string()]), ..RunOptions::default() };
    // The first machine is lost before it can remove its claim or send its result.
    let remote = Arc::new(Faulty::new(|doing, name| {
        let late = doing == "remove" && name.starts_with("v1/claims/") || name.starts_with("v1/blobs/");
        late.then_some(Fault::Forbidden)
    }));
    let west = hasty(dir.path(), "west", remote.clone());
    assert_eq!(run_told(&west, &batch, &import, |_| ()).0.exit_code(), 0);
    assert_eq!(claims(&remote.inner), 1);
    let store = Arc::new(Memory::default());
    store.objects().extend(remote.inner.objects().clone());
    let east = hasty(dir.path(), "east", store.clone());
    let (summary, told) = run_told(&east, &batch, &import, |_| ());
    assert_eq!((summary.exit_code(), told.started.len()), (0, 1), "{summary}");
    assert_eq!((told.waited.len(), told.warnings.len()), (1, 0), "{:?}", told.warnings);
    assert_eq!(claims(&store), 0);
    // Its own claim, which it could not remove, is no reason to wait.
    std::fs::remove_dir_all(west.cache.root().join("artifacts")).expect("removed");
    let (summary, told) = run_told(&west, &batch, &import, |_| ());
    assert_eq!((summary.exit_code(), told.waited.len()), (0, 0), "{summary}");
}

#[test]
fn a_store_without_claims_is_no_hindrance() {
    let dir = tempfile::tempdir().expect("a folder");
    let batch = batch(dir.path(), &["reef"]);
    for fault in [Fault::Forbidden, Fault::Unavailable, Fault::AskedTwice, Fault::Wrong] {
        let remote = Arc::new(Faulty::new(move |_, name| name.starts_with("v1/claims/").then_some(fault)));
        let builder = hasty(dir.path(), &format!("{fault:?}"), remote.clone());
        let (summary, told) = run_told(&builder, &batch, &RunOptions::default(), |_| ());
        let said = (summary.exit_code(), told.waited.len(), told.warnings.len());
        assert_eq!(said, (0, 0, 0), "{fault:?}: {:?}", told.warnings);
        assert_eq!(claims(&remote.inner), 0, "{fault:?}");
    }
}

#[test]
fn the_cleaning_of_a_store_removes_old_claims() {
    let dir = tempfile::tempdir().expect("a folder");
    let store = RemoteStore::new(Arc::new(FolderStore::new(dir.path())));
    let folder = dir.path().join("v1/claims");
    std::fs::create_dir_all(&folder).expect("a folder");
    for (name, hours) in [("young", 1), ("old", 25)] {
        let file = File::create(folder.join(name)).expect("a file");
        file.set_modified(SystemTime::now() - Duration::from_secs(hours * 3600)).expect("a time");
    }
    store.sweep(Duration::from_secs(1), &BTreeSet::new(), false, &AtomicBool::new(false)).expect("swept");
    assert!(folder.join("young").exists() && !folder.join("old").exists());
}
