//! A store beside the cache: one machine fetches the bytes that another one computed. Wrong, incomplete, late
//! or missing data of a store never become an artifact, and end no run.

use std::collections::BTreeMap;
use std::fs;
use std::io::{self, Read};
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use use3d_workflow::cache::Lookup;
use use3d_workflow::manifest::{FileRecord, Manifest, content_digest};
use use3d_workflow::remote::{FolderStore, Listed, Memory, Remote, RemoteError, RemoteStore, Sent};
use use3d_workflow::{Batch, Builder, Digest, Graph, Listener, Silent, Transferred};

use super::faulty_store::{Fault, Faulty};
use super::stages::{batch, builder, payload, run};

fn store(remote: impl Remote + 'static) -> Arc<RemoteStore> {
    quick(Arc::new(remote))
}

pub(crate) fn shared(remote: &Arc<impl Remote + 'static>) -> Arc<RemoteStore> {
    quick(remote.clone())
}

fn quick(remote: Arc<dyn Remote>) -> Arc<RemoteStore> {
    let mut store = RemoteStore::new(remote);
    store.pause = Duration::from_millis(1);
    Arc::new(store)
}

/// A folder with captures, and the artifacts that a run of one machine makes of them.
pub(crate) struct World {
    dir: tempfile::TempDir,
    pub(crate) batch: Batch,
    pub(crate) whole: BTreeMap<String, Vec<u8>>,
}

impl World {
    fn new() -> Self {
        Self::of(&["reef", "wreck"])
    }

    pub(crate) fn of(scenes: &[&str]) -> Self {
        let dir = tempfile::tempdir().expect("a folder");
        let batch = batch(dir.path(), scenes);
        let alone = builder(&dir.path().join("alone"));
        assert_eq!(run(&alone, &batch).0.exit_code(), 0);
        let whole = payload(&alone.cache);
        Self { dir, batch, whole }
    }

    pub(crate) fn builder(&self, name: &str) -> Builder {
        builder(&self.dir.path().join(name))
    }

    fn pull(&self, builder: &Builder, store: &RemoteStore) -> Result<Transferred, RemoteError> {
        let listener: Arc<dyn Listener> = Arc::new(Silent);
        let graph = Graph::new(&builder.registry, &self.batch).expect("graph");
        builder.pull(&graph, store, &AtomicBool::new(false), &listener)
    }

    pub(crate) fn push(
        &self,
        builder: &Builder,
        store: &RemoteStore,
        check: bool,
    ) -> Result<Transferred, RemoteError> {
        let listener: Arc<dyn Listener> = Arc::new(Silent);
        let graph = Graph::new(&builder.registry, &self.batch).expect("graph");
        builder.push(&graph, store, check, &AtomicBool::new(false), &listener)
    }

    /// Checks that no unfinished file is left in a cache.
    fn assert_tidy(builder: &Builder) {
        let tmp = fs::read_dir(builder.cache.root().join("tmp")).expect("folder").count();
        assert!(tmp == 0 && !builder.cache.root().join("damaged").exists(), "{tmp}");
    }
}

fn manifests(builder: &Builder) -> BTreeMap<String, Vec<u8>> {
    let read = |path: &Path| fs::read(path.join("manifest.json")).expect("a manifest");
    builder
        .cache
        .artifacts()
        .iter()
        .map(|(stage, key, path)| (format!("{stage} {key}"), read(path)))
        .collect()
}

#[test]
fn what_one_machine_computed_another_one_fetches_to_the_byte() {
    let world = World::new();
    let folder = world.dir.path().join("store");
    for remote in [Arc::new(Memory::default()) as Arc<dyn Remote>, Arc::new(FolderStore::new(&folder))] {
        let place = remote.place();
        let name = |name: &str| format!("{name}-{}", place.len());
        let store = Arc::new(RemoteStore::new(remote));
        store.probe(&AtomicBool::new(false)).expect("a good store");
        let first = world.builder(&name("first")).with_remote(store.clone());
        let (summary, started, warnings) = run(&first, &world.batch);
        assert!(summary.exit_code() == 0 && warnings.is_empty(), "{place}: {warnings:?}");
        assert!(started.len() == summary.done() && payload(&first.cache) == world.whole, "{place}");
        // Another machine computes nothing, and has the same bytes and the same manifests.
        let second = world.builder(&name("second")).with_remote(store.clone());
        let (summary, started, warnings) = run(&second, &world.batch);
        assert!(
            summary.exit_code() == 0 && warnings.is_empty() && started.is_empty(),
            "{place}: {started:?}"
        );
        assert!(payload(&second.cache) == world.whole && manifests(&second) == manifests(&first), "{place}");
        // A third one fetches everything at once, and sends nothing back.
        let third = world.builder(&name("third"));
        let pulled = world.pull(&third, &store).expect("pulled");
        let count = world.push(&first, &store, false).expect("pushed").already;
        let moved = (pulled.moved, pulled.already, pulled.missing, pulled.problems.len());
        assert_eq!(moved, (count, 0, 0, 0), "{place}");
        assert!(payload(&third.cache) == world.whole && run(&third, &world.batch).1.is_empty(), "{place}");
        let again = world.pull(&third, &store).expect("pulled");
        assert_eq!((again.moved, again.already), (0, count), "{place}");
        assert_eq!(world.push(&third, &store, true).expect("pushed").already, count, "{place}");
        World::assert_tidy(&third);
    }
    let tmp = fs::read_dir(folder.join("v1/tmp")).expect("folder").count()
        + fs::read_dir(folder.join("v1/probe")).expect("folder").count();
    assert_eq!(tmp, 0, "nothing half stays in the store");
    // A run without a store can be sent afterwards.
    let late = store(Memory::default());
    let alone = world.builder("alone");
    let pushed = world.push(&alone, &late, false).expect("pushed");
    assert!(pushed.moved > 0 && pushed.already == 0 && pushed.missing == 0, "{pushed:?}");
}

#[test]
fn bytes_that_came_wrong_never_become_an_artifact() {
    let world = World::new();
    let faults = [
        Fault::Truncated,
        Fault::BrokenOff,
        Fault::Wrong,
        Fault::More,
        Fault::Missing,
        Fault::Unavailable,
        Fault::Forbidden,
    ];
    for fault in faults {
        for part in ["v1/blobs/", "v1/artifacts/"] {
            let faulty: Arc<AtomicBool> = Arc::default();
            let on = faulty.clone();
            let remote = Arc::new(Faulty::new(move |doing, name| {
                (on.load(Ordering::Relaxed) && doing == "get" && name.starts_with(part)).then_some(fault)
            }));
            assert!(world.push(&world.builder("alone"), &shared(&remote), false).is_ok());
            faulty.store(true, Ordering::Relaxed);
            let what = format!("{fault:?} {part}");
            let name = what.replace('/', "-");
            // With `pull`, nothing is fetched, and the problem is reported.
            let pulling = world.builder(&format!("pull {name}"));
            let gone = fault == Fault::Missing && part == "v1/artifacts/";
            match world.pull(&pulling, &shared(&remote)) {
                Ok(done) => {
                    assert!(
                        done.moved == 0 && done.missing > 0 && done.problems.is_empty() == gone,
                        "{what}: {done:?}"
                    );
                }
                Err(error) => assert!(
                    error.to_string().contains("50") || error.to_string().contains("403"),
                    "{what}: {error}"
                ),
            }
            assert!(payload(&pulling.cache).is_empty(), "{what}");
            World::assert_tidy(&pulling);
            // In a run, everything is computed.
            let running = world.builder(&format!("run {name}")).with_remote(shared(&remote));
            let (summary, _, warnings) = run(&running, &world.batch);
            assert!(
                summary.exit_code() == 0 && payload(&running.cache) == world.whole,
                "{what}: {warnings:?}"
            );
            assert!(warnings.is_empty() == gone, "{what}: {warnings:?}");
            World::assert_tidy(&running);
        }
    }
}

#[test]
fn a_store_that_fails_now_and_then_and_is_slow_gives_and_takes_everything() {
    let world = World::new();
    let count = AtomicUsize::new(0);
    let remote = Arc::new(Faulty::new(move |doing, _| {
        let fault =
            [Fault::Unavailable, Fault::Slow, Fault::AnswerLost, Fault::Slow, Fault::BrokenOff, Fault::Slow];
        let fault = fault[count.fetch_add(1, Ordering::Relaxed) % fault.len()];
        (doing == "get" || fault != Fault::BrokenOff).then_some(fault)
    }));
    let first = world.builder("first").with_remote(shared(&remote));
    let (summary, _, warnings) = run(&first, &world.batch);
    assert!(summary.exit_code() == 0, "{warnings:?}");
    let check = Arc::new(Memory::default());
    check.objects().extend(remote.inner.objects().clone());
    let pushed = world.push(&first, &shared(&check), true).expect("a store without faults");
    assert!(warnings.is_empty() && pushed.moved == 0, "{warnings:?} {pushed:?}");
    let second = world.builder("second").with_remote(shared(&remote));
    let (_, started, warnings) = run(&second, &world.batch);
    assert!(started.is_empty() && payload(&second.cache) == world.whole, "{started:?} {warnings:?}");
}

#[test]
fn a_store_that_is_gone_is_given_up_and_the_run_goes_on() {
    let world = World::new();
    let asked = Arc::new(AtomicUsize::new(0));
    let counted = asked.clone();
    let remote = Faulty::new(move |_, _| {
        counted.fetch_add(1, Ordering::Relaxed);
        Some(Fault::Unavailable)
    });
    let builder = world.builder("cache").with_remote(store(remote));
    let (summary, _, warnings) = run(&builder, &world.batch);
    assert!(summary.exit_code() == 0 && payload(&builder.cache) == world.whole);
    assert_eq!(warnings.len(), 4, "three times, and that it is enough: {warnings:?}");
    assert!(warnings[3].contains("continuing without it"), "{warnings:?}");
    assert!(asked.load(Ordering::Relaxed) <= 12, "a few tries each");
}

#[test]
fn a_store_that_cannot_be_relied_on_is_refused_when_it_is_opened() {
    for (fault, words) in [
        (Some(Fault::Careless), "lets a name be created twice"),
        (Some(Fault::Forbidden), "403"),
        (Some(Fault::Unavailable), "503"),
        (Some(Fault::Missing), "not there"),
        (Some(Fault::Wrong), "other bytes"),
        (None, ""),
    ] {
        let remote = Arc::new(Faulty::new(move |_, _| fault));
        match shared(&remote).probe(&AtomicBool::new(false)) {
            Ok(()) => assert_eq!(fault, None),
            Err(error) => {
                assert!(fault.is_some() && error.to_string().contains(words), "{fault:?}: {error}");
            }
        }
        assert!(remote.inner.objects().is_empty(), "{fault:?}: what it was tried with is gone");
    }
    // A reply that is lost once, or that arrives with a wrong byte, is no failure.
    for (fault, at) in [
        (Fault::AnswerLost, "create"),
        (Fault::AskedTwice, "create"),
        (Fault::Wrong, "get"),
        (Fault::Truncated, "get"),
    ] {
        let count = AtomicUsize::new(0);
        let remote = Faulty::new(move |doing, _| {
            (doing == at && count.fetch_add(1, Ordering::Relaxed) == 0).then_some(fault)
        });
        store(remote).probe(&AtomicBool::new(false)).expect("a good store");
    }
}

#[test]
fn a_manifest_from_elsewhere_cannot_write_outside_its_artifact_or_stand_for_another() {
    let world = World::new();
    let alone = world.builder("alone");
    let remote = Arc::new(Memory::default());
    assert!(world.push(&alone, &shared(&remote), false).is_ok());
    let good = remote.objects().clone();
    let names: Vec<String> = good.keys().filter(|n| n.starts_with("v1/artifacts/import/")).cloned().collect();
    // Another key's manifest.
    remote.objects().insert(names[0].clone(), good[&names[1]].clone());
    // Its digests are right, but the file it names is outside the folder.
    let text = String::from_utf8(good[&names[1]].clone()).expect("text");
    let mut evil: Manifest = serde_json::from_str(&text).expect("a manifest");
    for path in ["../../escaped", "/escaped", "a/../../escaped", "words.txt/", "manifest.json", "", "a\\b"] {
        evil.files[0].path = path.to_string();
        evil.content = content_digest(&evil.files);
        remote.objects().insert(names[1].clone(), serde_json::to_vec(&evil).expect("json"));
        let builder = world.builder("cache");
        let pulled = world.pull(&builder, &shared(&remote)).expect("the store answers");
        let says = |words| pulled.problems.iter().filter(|p| p.what.contains(words)).count();
        assert!(says("names a file") > 0 && says("push --check") == 2, "{path}: {pulled:?}");
        let artifacts = builder.cache.artifacts();
        assert!(artifacts.iter().all(|(stage, _, _)| stage != "import"), "{path}: {artifacts:?}");
    }
    let escaped =
        walkdir::WalkDir::new(world.dir.path()).into_iter().flatten().any(|e| e.file_name() == "escaped");
    assert!(!escaped);
}

#[test]
fn what_is_damaged_on_either_side_is_not_sent_and_a_check_repairs_the_store() {
    let world = World::new();
    let builder = world.builder("alone");
    let remote = Arc::new(Memory::default());
    let (stage, key, path) = builder.cache.artifacts().into_iter().next().expect("an artifact");
    let Ok(Lookup::Whole(artifact)) = builder.cache.lookup(&stage, &key) else { panic!("it is there") };
    let (stop, store) = (AtomicBool::new(false), shared(&remote));
    // Changed after the last check, to as many other bytes. All files with these bytes are changed, because
    // of equal files only one is sent.
    builder.cache.verify(&artifact, true).expect("whole");
    let right = fs::read(path.join(&artifact.manifest.files[0].path)).expect("read");
    let equal = artifact.manifest.files.iter().filter(|f| f.digest == artifact.manifest.files[0].digest);
    let write = |bytes: &[u8]| {
        equal.clone().for_each(|f| fs::write(path.join(&f.path), bytes).expect("written"));
    };
    write(&vec![b'x'; right.len()]);
    let error = store.send(&builder.cache, &artifact, None, false, &stop).expect_err("damaged");
    // Several files are sent at a time, so whole ones may be in the store already. Each has the bytes of its
    // name, and no manifest names it.
    assert!(error.to_string().contains("damaged"), "{error}");
    let is_right = |(name, bytes): (&String, &Vec<u8>)| *name == format!("v1/blobs/{}", Digest::of(bytes));
    assert!(remote.objects().iter().all(is_right), "{error}");
    write(&right);
    assert_eq!(store.send(&builder.cache, &artifact, None, false, &stop).expect("sent"), Sent::Now);
    // The store's disk rots; only `check` finds and repairs it.
    let whole = remote.objects().clone();
    let name = format!("v1/blobs/{}", artifact.manifest.files[0].digest);
    remote.objects().insert(name, vec![b'y'; right.len()]);
    assert_eq!(store.send(&builder.cache, &artifact, None, false, &stop).expect("sent"), Sent::Already);
    assert_eq!(store.send(&builder.cache, &artifact, None, true, &stop).expect("sent"), Sent::Now);
    assert!(*remote.objects() == whole);
    // A run that fetched damaged bytes repairs the store as well.
    let name = remote.objects().keys().find(|n| n.starts_with("v1/artifacts")).cloned().expect("a manifest");
    remote.objects().insert(name, b"{".to_vec());
    let running = world.builder("cache").with_remote(store.clone());
    let (_, _, warnings) = run(&running, &world.batch);
    assert_eq!(warnings.len(), 1, "{warnings:?}");
    let third = world.builder("third").with_remote(store);
    let (_, started, warnings) = run(&third, &world.batch);
    assert!(started.is_empty() && warnings.is_empty(), "{started:?} {warnings:?}");
}

#[test]
fn one_that_is_asked_to_stop_leaves_in_the_middle_of_a_file() {
    let world = World::new();
    let stop = Arc::new(AtomicBool::new(false));
    let raise = stop.clone();
    let remote = Arc::new(Faulty::new(move |doing, name| {
        let is_file = doing == "get" && name.starts_with("v1/blobs/");
        if is_file {
            raise.store(true, Ordering::Relaxed);
        }
        is_file.then_some(Fault::Slow)
    }));
    assert!(world.push(&world.builder("alone"), &shared(&remote), false).is_ok());
    let builder = world.builder("cache");
    let graph = Graph::new(&builder.registry, &world.batch).expect("graph");
    let listener: Arc<dyn Listener> = Arc::new(Silent);
    let done = builder.pull(&graph, &shared(&remote), &stop, &listener).expect("no error");
    assert!(done.interrupted && done.moved == 0 && payload(&builder.cache).is_empty(), "{done:?}");
    World::assert_tidy(&builder);
}

#[test]
fn of_all_that_create_a_name_at_once_one_does() {
    let dir = tempfile::tempdir().expect("a folder");
    let remotes: [Arc<dyn Remote>; 2] = [Arc::new(Memory::default()), Arc::new(FolderStore::new(dir.path()))];
    for (remote, round) in remotes.iter().flat_map(|remote| (0..20).map(move |round| (remote, round))) {
        let won: Mutex<Vec<Vec<u8>>> = Mutex::default();
        std::thread::scope(|scope| {
            for who in 0..8_u8 {
                let won = &won;
                scope.spawn(move || {
                    if remote.create(&format!("v1/race-{round}"), &[who]).expect("an answer") {
                        won.lock().expect("lock").push(vec![who]);
                    }
                });
            }
        });
        let mut found = Vec::new();
        assert!(remote.get(&format!("v1/race-{round}"), &mut found).expect("an answer"));
        assert_eq!(*won.lock().expect("lock"), [found], "{}", remote.place());
    }
    // A source that fails while it is read leaves the old object.
    struct Fails;
    impl Read for Fails {
        fn read(&mut self, _: &mut [u8]) -> io::Result<usize> {
            Err(io::Error::other("taken away"))
        }
    }
    for remote in remotes {
        remote.put("v1/file", &mut &b"whole"[..], 5).expect("put");
        assert!(matches!(remote.put("v1/file", &mut Fails, 5), Err(RemoteError::Local(_))));
        let mut found = Vec::new();
        assert!(remote.get("v1/file", &mut found).expect("an answer") && found == b"whole");
        assert_eq!(remote.size("v1/nothing").expect("an answer"), None);
        assert!(!remote.get("v1/nothing", &mut Vec::new()).expect("an answer"));
        remote.remove("v1/nothing").expect("no error");
    }
}

/// Changes the manifest of a stage's first artifact in a store and corrects its digests.
fn forge(store: &Memory, stage: &str, change: impl FnOnce(&mut Manifest)) -> String {
    let prefix = format!("v1/artifacts/{stage}/");
    let (name, mut manifest) = {
        let objects = store.objects();
        let (name, bytes) = objects.iter().find(|(name, _)| name.starts_with(&prefix)).expect("a manifest");
        (name.clone(), serde_json::from_slice::<Manifest>(bytes).expect("a manifest"))
    };
    change(&mut manifest);
    manifest.content = content_digest(&manifest.files);
    store.objects().insert(name.clone(), serde_json::to_vec(&manifest).expect("JSON"));
    name
}

#[test]
fn an_artifact_without_the_files_that_its_stage_promises_is_none() {
    let world = World::new();
    type Change = fn(&mut Manifest);
    let changes: [(&str, &str, Change); 3] = [
        ("import", "lists no files", |m| m.files.clear()),
        ("import", "lists no words.txt", |m| m.files[0].path = "frames.txt".to_string()),
        ("targets", "lists no deep/", |m| m.files.retain(|f| !f.path.starts_with("deep/"))),
    ];
    for (i, (stage, words, change)) in changes.into_iter().enumerate() {
        let remote = Arc::new(Memory::default());
        world.push(&world.builder("alone"), &shared(&remote), false).expect("pushed");
        let right = remote.objects().clone();
        let name = forge(&remote, stage, change);
        // A pull refuses it.
        let pulling = world.builder(&format!("pull-{i}"));
        let pulled = world.pull(&pulling, &shared(&remote)).expect("the rest comes");
        assert!(pulled.problems.len() == 1 && pulled.problems[0].what.contains(words), "{pulled:?}");
        World::assert_tidy(&pulling);
        // A run computes it and replaces the one in the store.
        let running = world.builder(&format!("run-{i}")).with_remote(shared(&remote));
        let (summary, _, warnings) = run(&running, &world.batch);
        assert!(summary.exit_code() == 0 && payload(&running.cache) == world.whole, "{warnings:?}");
        assert!(warnings.len() == 1 && warnings[0].contains(words), "{warnings:?}");
        let theirs = |bytes: &[u8]| serde_json::from_slice::<Manifest>(bytes).expect("a manifest").files;
        assert_eq!(theirs(&remote.objects()[&name]), theirs(&right[&name]));
        // An earlier version put it into a cache; a run and `verify` find it there.
        let old = world.builder(&format!("old-{i}"));
        assert_eq!(run(&old, &world.batch).0.exit_code(), 0);
        let (_, _, path) = old.cache.artifacts().into_iter().find(|a| a.0 == stage).expect("an artifact");
        let file = path.join("manifest.json");
        let mut manifest: Manifest = serde_json::from_slice(&fs::read(&file).expect("read")).expect("JSON");
        change(&mut manifest);
        manifest.content = content_digest(&manifest.files);
        fs::write(&file, serde_json::to_vec(&manifest).expect("JSON")).expect("written");
        let problems = old.cache.verify_all(false).problems;
        assert!(problems.iter().any(|p| p.what.contains(words)), "{problems:?}");
        let (summary, started, warnings) = run(&old, &world.batch);
        assert!(summary.exit_code() == 0 && started.len() == 1 && warnings.len() == 1, "{warnings:?}");
        assert!(warnings[0].contains(words) && payload(&old.cache) == world.whole, "{warnings:?}");
    }
}

#[test]
fn what_was_fetched_and_cannot_be_read_is_computed_instead() {
    let world = World::new();
    let remote = Arc::new(Memory::default());
    world.push(&world.builder("alone"), &shared(&remote), false).expect("pushed");
    // Another program made it: all digests fit, but no stage can read it.
    let garbage = b"garbage";
    forge(&remote, "import", |manifest| {
        let digest = Digest::of(garbage);
        manifest.files = vec![FileRecord { path: "words.txt".to_string(), size: 7, digest }];
    });
    remote.objects().insert(format!("v1/blobs/{}", Digest::of(garbage)), garbage.to_vec());
    // With the store, and after a pull without it.
    for (name, asks) in [("asking", true), ("later", false)] {
        let builder = world.builder(name);
        let pulled = world.pull(&builder, &shared(&remote)).expect("it fits");
        assert!(pulled.problems.is_empty() && pulled.moved > 0, "{pulled:?}");
        let builder = if asks { builder.with_remote(shared(&remote)) } else { builder };
        let (summary, _, warnings) = run(&builder, &world.batch);
        assert!(summary.exit_code() == 0 && payload(&builder.cache) == world.whole, "{name}: {warnings:?}");
        assert!(warnings[0].contains("from the store cannot be used"), "{name}: {warnings:?}");
        // An input that was computed here is not suspected.
        assert_eq!(fs::read_dir(builder.cache.root().join("damaged")).expect("folder").count(), 1);
        assert!(run(&builder, &world.batch).1.is_empty(), "{name}");
    }
    // A bad capture fails its stage at once, fetched or not.
    let mut batch = batch(world.dir.path(), &["bad"]);
    fs::write(world.dir.path().join("bad/images/words.txt"), "garbage\n").expect("written");
    batch.name = "bad".to_string();
    let builder = world.builder("asking");
    let (summary, started, _) = run(&builder, &batch);
    assert_eq!((summary.exit_code(), started.iter().filter(|s| s.contains("import")).count()), (1, 1));
}

#[cfg(unix)]
#[test]
fn a_pipe_in_the_place_of_a_file_holds_nobody() {
    let dir = tempfile::tempdir().expect("a folder");
    let folder = dir.path().join("v1/blobs");
    fs::create_dir_all(&folder).expect("folder");
    let made = std::process::Command::new("mkfifo").arg(folder.join("pipe")).status();
    if !made.is_ok_and(|status| status.success()) {
        return; // a system without named pipes
    }
    let store = FolderStore::new(dir.path());
    for answer in [store.get("v1/blobs/pipe", &mut Vec::new()).err(), store.size("v1/blobs/pipe").err()] {
        assert!(answer.expect("refused").to_string().contains("not a plain file"));
    }
    assert!(store.get("v1/blobs", &mut Vec::new()).is_err(), "a folder");
}

#[test]
fn what_a_store_has_is_found_by_a_list_and_what_nobody_keeps_can_go() {
    let world = World::new();
    let asked = Arc::new(AtomicUsize::new(0));
    let counted = asked.clone();
    let remote = Arc::new(Faulty::new(move |_, _| {
        counted.fetch_add(1, Ordering::Relaxed);
        None
    }));
    let (store, alone) = (shared(&remote), world.builder("alone"));
    let pushed = world.push(&alone, &store, false).expect("pushed");
    asked.store(0, Ordering::Relaxed);
    // If there is nothing to do, two lists suffice, whatever the number of artifacts.
    let again = world.push(&alone, &store, false).expect("pushed");
    assert_eq!((again.already, again.moved, asked.swap(0, Ordering::Relaxed)), (pushed.moved, 0, 2));
    let there = world.pull(&alone, &store).expect("pulled");
    assert_eq!((there.already, there.moved, asked.swap(0, Ordering::Relaxed)), (pushed.moved, 0, 2));
    let stop = AtomicBool::new(false);
    let shelf = store.shelf(&stop).expect("listed");
    assert_eq!(shelf.stages().values().sum::<usize>(), pushed.moved);
    assert_eq!(shelf.size().0, remote.inner.objects().keys().filter(|n| n.starts_with("v1/blobs/")).count());
    // A store that permits no list is asked for every artifact.
    let silent = Arc::new(Faulty::new(|doing, _| (doing == "list").then_some(Fault::Forbidden)));
    assert_eq!(world.push(&alone, &shared(&silent), false).expect("pushed").moved, pushed.moved);
    assert_eq!(world.push(&alone, &shared(&silent), false).expect("pushed").already, pushed.moved);
    let other = world.builder("other");
    assert_eq!(world.pull(&other, &shared(&silent)).expect("pulled").moved, pushed.moved);
    assert!(payload(&other.cache) == world.whole);

    // A cleaning leaves the artifacts of a pipeline complete, and removes the others with their files.
    let graph = Graph::new(&alone.registry, &world.batch).expect("graph");
    let plan = alone.plan(&graph, None);
    let kept = plan
        .nodes
        .iter()
        .filter(|n| n.scene != "wreck" && n.stage != "report")
        .filter_map(|n| n.key)
        .collect();
    let day = Duration::from_secs(86_400);
    let would = store.sweep(day, &kept, true, &stop).expect("listed");
    assert!(would.artifacts > 0 && would.files > 0 && would.dry_run, "{would:?}");
    let before = remote.inner.objects().len();
    let swept = store.sweep(day, &kept, false, &stop).expect("swept");
    assert_eq!(before - remote.inner.objects().len(), swept.artifacts + swept.files);
    assert_eq!((swept.artifacts, swept.files, swept.left), (would.artifacts, would.files, would.left));
    let third = world.builder("third");
    let pulled = world.pull(&third, &store).expect("pulled");
    assert!(pulled.problems.is_empty() && pulled.missing > 0 && pulled.moved == swept.left, "{pulled:?}");
}

/// A store to which another machine sends every artifact again as soon as its manifest is removed. That
/// machine finds the files still there.
#[derive(Default)]
struct Resending {
    inner: Memory,
    removed: Mutex<Vec<(String, Vec<u8>)>>,
}

impl Remote for Resending {
    fn place(&self) -> String {
        "resending".to_string()
    }

    fn get(&self, name: &str, to: &mut (dyn std::io::Write + Send)) -> Result<bool, RemoteError> {
        self.inner.get(name, to)
    }

    fn size(&self, name: &str) -> Result<Option<u64>, RemoteError> {
        self.inner.size(name)
    }

    fn put(&self, name: &str, from: &mut (dyn std::io::Read + Send), size: u64) -> Result<(), RemoteError> {
        self.inner.put(name, from, size)
    }

    fn create(&self, name: &str, bytes: &[u8]) -> Result<bool, RemoteError> {
        self.inner.create(name, bytes)
    }

    fn remove(&self, name: &str) -> Result<(), RemoteError> {
        let bytes = self.inner.objects().get(name).cloned();
        if let Some(bytes) = bytes.filter(|_| !name.starts_with("v1/blobs/")) {
            self.removed.lock().expect("removed").push((name.to_string(), bytes));
        }
        self.inner.remove(name)
    }

    fn list(&self, prefix: &str) -> Result<Vec<Listed>, RemoteError> {
        let again = std::mem::take(&mut *self.removed.lock().expect("removed"));
        self.inner.objects().extend(again);
        self.inner.list(prefix)
    }
}

#[test]
fn artifacts_that_are_sent_again_during_a_cleaning_keep_their_files() {
    let world = World::new();
    let remote = Arc::new(Resending::default());
    let store = shared(&remote);
    let pushed = world.push(&world.builder("alone"), &store, false).expect("pushed");
    let stop = AtomicBool::new(false);
    let swept = store.sweep(Duration::from_secs(86_400), &Default::default(), false, &stop).expect("swept");
    assert_eq!((swept.artifacts, swept.files), (pushed.moved, 0));
    let other = world.builder("other");
    let pulled = world.pull(&other, &store).expect("pulled");
    assert!(pulled.problems.is_empty() && pulled.moved == pushed.moved, "{pulled:?}");
    assert!(payload(&other.cache) == world.whole);
}

#[test]
fn to_a_store_that_is_only_read_nothing_is_sent() {
    let world = World::new();
    let remote = Arc::new(Memory::default());
    world.push(&world.builder("alone"), &shared(&remote), false).expect("pushed");
    let wreck: Vec<String> = remote.objects().keys().filter(|n| n.contains("/evaluate/")).cloned().collect();
    wreck.iter().for_each(|name| drop(remote.objects().remove(name)));
    let before = remote.objects().clone();
    let store = RemoteStore::new(remote.clone()).read_only();
    let builder = world.builder("cache").with_remote(Arc::new(store));
    let (summary, started, warnings) = run(&builder, &world.batch);
    assert!(
        summary.exit_code() == 0 && warnings.is_empty() && started.len() == 2,
        "{started:?} {warnings:?}"
    );
    assert!(payload(&builder.cache) == world.whole && *remote.objects() == before);
}
