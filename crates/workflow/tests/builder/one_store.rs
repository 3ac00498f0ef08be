//! Two machines that share nothing but a store: no lease tells them apart, and yet they share the work.

use std::sync::Arc;

use use3d_workflow::node::{Clock, Node};
use use3d_workflow::remote::{Memory, RemoteStore};
use use3d_workflow::{Builder, Cache};

use super::stages::{Fast, batch, builder, payload, registry, run};

#[test]
fn two_machines_with_one_store_begin_with_other_scenes_and_share_the_work() {
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
    // In the same order, both would compute nearly everything.
    let all = alone.cache.artifacts().len();
    assert!(started.iter().sum::<usize>() <= all + all / 2, "{started:?} of {all}");
}
