//! A cache that other processes use, clean or damage during a run: the run continues, and reports its scenes
//! as they finish.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Barrier, Mutex};

use serde_json::json;
use use3d_workflow::gc::CleanOptions;
use use3d_workflow::run::{NodeResult, RanNode, RunOptions};
use use3d_workflow::{Batch, Builder, Cache, Event, Graph, Listener, Summary};

use super::stages::{batch, builder, in_task, payload, run};

/// Runs a batch and calls `meddle` once, at the first event for which `when` returns true.
fn run_meddled(
    builder: &Builder,
    batch: &Batch,
    options: &RunOptions,
    when: impl Fn(&Event<'_>) -> bool + Send + Sync + 'static,
    meddle: impl Fn() + Send + Sync + 'static,
) -> (Summary, Vec<String>, Vec<String>) {
    let graph = Graph::new(&builder.registry, batch).expect("graph");
    let told: Arc<Mutex<(Vec<String>, Vec<String>)>> = Arc::default();
    let (done, into) = (AtomicBool::new(false), told.clone());
    let listener: Arc<dyn Listener> = Arc::new(move |event: &Event<'_>| {
        match event {
            Event::Started { label, .. } => into.lock().expect("lock").0.push((*label).to_string()),
            Event::Warning { label, text } => into.lock().expect("lock").1.push(format!("{label}: {text}")),
            _ => {}
        }
        if when(event) && !done.swap(true, Ordering::SeqCst) {
            meddle();
        }
    });
    let summary = builder.run(&graph, options, &listener);
    let (started, warnings) = told.lock().expect("lock").clone();
    (summary, started, warnings)
}

fn starts(event: &Event<'_>, stage: &str) -> bool {
    matches!(event, Event::Started { label, .. } if label.ends_with(stage))
}

fn everything() -> CleanOptions {
    CleanOptions { max_bytes: Some(0), ..CleanOptions::default() }
}

fn checkpoints(builder: &Builder) -> usize {
    fs::read_dir(builder.cache.root().join("checkpoints/reconstruct")).into_iter().flatten().count()
}

#[test]
fn cleaning_up_takes_nothing_that_a_run_has_decided_on() {
    let dir = tempfile::tempdir().expect("folder");
    let batch = batch(&dir.path().join("data"), &["reef", "wreck"]);
    let reference = builder(&dir.path().join("reference"));
    run(&reference, &batch);
    let whole = payload(&reference.cache);
    for stage in ["import", "calibrate", "reconstruct", "targets", "enhance", "evaluate", "report"] {
        let folder = dir.path().join(stage);
        let own = builder(&folder);
        let other = builder(&folder).cache;
        let meddle = move || drop(other.clean(&everything()));
        let (summary, started, warnings) =
            run_meddled(&own, &batch, &RunOptions::default(), move |e| starts(e, stage), meddle);
        assert_eq!((summary.exit_code(), started.len()), (0, 12), "{stage}: {summary}{started:?}");
        assert!(warnings.is_empty(), "{stage}: {warnings:?}");
        assert_eq!(payload(&own.cache), whole, "{stage}");
        assert_eq!(checkpoints(&own), 2, "{stage}");
        // Dropping the summary removes the lease of the run.
        drop(summary);
        own.cache.clean(&everything());
        assert!(own.cache.artifacts().is_empty() && checkpoints(&own) == 0, "{stage}");
    }
}

#[test]
fn an_artifact_that_vanishes_during_a_run_is_made_again() {
    let dir = tempfile::tempdir().expect("folder");
    let batch = batch(&dir.path().join("data"), &["reef"]);
    let reference = builder(&dir.path().join("reference"));
    let (summary, ..) = run(&reference, &batch);
    let whole = payload(&reference.cache);
    // Three cases: the artifact was checked earlier and is read later; it is read by the stage that has just
    // checked it; all artifacts so far are removed.
    for (at, stages) in [
        ("targets", &["import"][..]),
        ("targets", &["reconstruct"][..]),
        ("enhance", &["import", "reconstruct", "calibrate", "targets"][..]),
    ] {
        let folder = dir.path().join(format!("{at}-{}", stages.len())).join(stages[0]);
        let own = builder(&folder);
        let paths: Vec<_> = stages
            .iter()
            .map(|stage| {
                let key = summary.artifact("reef", "", stage).expect("there").manifest.key;
                own.cache.artifact_path(stage, &key)
            })
            .collect();
        let meddle = move || paths.iter().for_each(|path| fs::remove_dir_all(path).expect("removed"));
        let (summary, _, warnings) =
            run_meddled(&own, &batch, &RunOptions::default(), move |e| starts(e, at), meddle);
        assert_eq!(summary.exit_code(), 0, "{stages:?}: {summary}");
        assert!(warnings.iter().any(|w| w.contains("removed from the cache (")), "{stages:?}: {warnings:?}");
        let there = payload(&own.cache);
        assert!(there.iter().all(|(path, bytes)| whole.get(path) == Some(bytes)), "{stages:?}");
        run(&own, &batch);
        assert_eq!(payload(&own.cache), whole, "{stages:?}");
    }
}

#[test]
fn checkpoints_of_kept_and_running_pipelines_stay() {
    let dir = tempfile::tempdir().expect("folder");
    let mut batch = batch(&dir.path().join("data"), &["reef"]);
    batch.defaults.insert("reconstruct".to_string(), json!({"iterations": 300}));
    let folder = dir.path().join("cache");
    let own = builder(&folder);
    let graph = Graph::new(&own.registry, &batch).expect("graph");
    let halfway = |e: &Event<'_>| matches!(e, Event::Progress { done: 150, .. });

    // During the run.
    let other = builder(&folder).cache;
    let options = RunOptions::default();
    let stop = options.stop.clone();
    let meddle = move || {
        other.clean(&everything());
        stop.store(true, Ordering::SeqCst);
    };
    let (summary, ..) = run_meddled(&own, &batch, &options, halfway, meddle);
    // (This stage ignores the flag; the run ends after it.)
    assert_eq!((summary.exit_code(), checkpoints(&own)), (130, 1));

    // Interrupted before its artifact existed, and kept.
    let key = summary.artifact("reef", "", "reconstruct").expect("made").manifest.key;
    fs::remove_dir_all(own.cache.artifact_path("reconstruct", &key)).expect("removed");
    drop(summary);
    let keep: BTreeSet<_> = own.plan(&graph, None).keys().collect();
    own.cache.clean(&CleanOptions { keep, ..everything() });
    assert_eq!(checkpoints(&own), 1);
    // The checkpoints of a finished stage are not kept.
    run(&own, &batch);
    let keep: BTreeSet<_> = own.plan(&graph, None).keys().collect();
    own.cache.clean(&CleanOptions { keep, ..everything() });
    assert_eq!(checkpoints(&own), 0);
    assert_eq!(own.plan(&graph, None).to_run(), 0);
}

#[test]
fn a_scene_is_told_when_it_is_over_and_not_when_the_batch_is() {
    let dir = tempfile::tempdir().expect("folder");
    let data = dir.path().join("data");
    let batch = batch(&data, &["reef", "wreck", "wall"]);
    fs::write(data.join("wall/images/words.txt"), "broken").expect("file");
    let builder = builder(&dir.path().join("cache"));
    let graph = Graph::new(&builder.registry, &batch).expect("graph");
    let told: Arc<Mutex<Vec<String>>> = Arc::default();
    let into = told.clone();
    let listener: Arc<dyn Listener> = Arc::new(move |event: &Event<'_>| match event {
        Event::SceneOver { scene, nodes, .. } => {
            // The stages that all scenes share belong to each scene, too.
            let shared: Vec<&str> = nodes.iter().filter(|n| n.scene.is_empty()).map(|n| n.stage).collect();
            assert_eq!(shared, ["calibrate"], "{scene}");
            let own = nodes.iter().filter(|n| n.scene == *scene);
            let scores = own.filter_map(|n| n.artifact.as_ref()).filter(|a| file(&a.path).is_some()).count();
            into.lock().expect("lock").push(format!("{scene}: {scores}"));
        }
        Event::Started { label, .. } => into.lock().expect("lock").push((*label).to_string()),
        Event::Failed { label, .. } => into.lock().expect("lock").push(format!("{label} failed")),
        _ => {}
    });
    let summary = builder.run(&graph, &RunOptions::default(), &listener);
    assert_eq!(summary.exit_code(), 1);
    let told = told.lock().expect("lock").clone();
    let at = |what: &str| told.iter().position(|t| t == what).unwrap_or_else(|| panic!("{what}: {told:?}"));
    assert!(at("reef: 3") < at("wreck · evaluate"), "{told:?}");
    assert!(at("wreck: 3") < at("wall · import failed"), "{told:?}");
    assert!(summary.nodes.iter().any(|n| n.result == NodeResult::Done && n.scene == "wreck"));
}

/// The result file of a stage.
fn file(artifact: &Path) -> Option<Vec<u8>> {
    fs::read(artifact.join("result.txt")).ok()
}

#[test]
fn a_sample_that_is_stopped_reports_no_damage() {
    let dir = tempfile::tempdir().expect("folder");
    let batch = batch(&dir.path().join("data"), &["reef"]);
    let quick = builder(&dir.path().join("cache"));
    run(&quick, &batch);
    // The same stages, now slow enough to be stopped.
    let slow = Builder::new(super::stages::registry(200), quick.cache);
    let graph = Graph::new(&slow.registry, &batch).expect("graph");
    let options = RunOptions::default();
    let (stop, count) = (options.stop.clone(), Mutex::new(0));
    let listener: Arc<dyn Listener> = Arc::new(move |event: &Event<'_>| {
        if let Event::Note { text, .. } = event
            && text.contains("computing it again")
        {
            *count.lock().expect("lock") += 1;
            stop.store(*count.lock().expect("lock") == 2, Ordering::SeqCst);
        }
    });
    let found = slow.verify_sample(&graph, 1.0, &options, &listener).expect("sample");
    assert!(found.problems.is_empty(), "{found}");
    assert_eq!((found.interrupted, found.recomputed, found.artifacts), (true, Some(1), 1));
    assert!(found.to_string().contains("interrupted"), "{found}");
}

#[test]
fn what_does_not_belong_into_an_artifact_is_named_and_moved_aside() {
    let dir = tempfile::tempdir().expect("folder");
    let batch = batch(&dir.path().join("data"), &["reef"]);
    let builder = builder(&dir.path().join("cache"));
    let (summary, ..) = run(&builder, &batch);
    let path = summary.artifact("reef", "", "targets").expect("there").path.clone();
    fs::write(path.join("deep/notes.txt"), "mine").expect("written");
    let found = builder.cache.verify_all(false);
    assert_eq!((found.problems.len(), found.repaired), (1, 0), "{found}");
    assert!(found.problems[0].what.contains("deep/notes.txt does not belong there"), "{found}");
    let found = builder.cache.verify_all(true);
    assert_eq!((found.problems.len(), found.repaired), (1, 1), "{found}");
    assert!(builder.cache.verify_all(true).problems.is_empty());
    assert_eq!(run(&builder, &batch).0.cached(), 7, "nothing is made again for it");
    let aside = fs::read_dir(builder.cache.root().join("damaged")).expect("folder").next().expect("one");
    assert_eq!(fs::read(aside.expect("entry").path().join("notes.txt")).expect("kept"), b"mine");
}

#[test]
fn what_failed_in_one_task_is_left_alone_by_the_others_of_its_submission() {
    let dir = tempfile::tempdir().expect("folder");
    let batch = batch(&dir.path().join("data"), &["reef", "wreck"]);
    fs::write(dir.path().join("data/wreck/images/words.txt"), "garbage").expect("written");
    let options = RunOptions { keep_going: true, ..RunOptions::default() };
    let run = |id: &str, submission: &str| {
        let Builder { registry, cache, .. } = builder(&dir.path().join("cache"));
        let builder = Builder::new(registry, cache.as_node(in_task(id, submission)));
        run_meddled(&builder, &batch, &options, |_| false, || {})
    };
    let failing = |started: &[String]| started.iter().filter(|label| *label == "wreck · reconstruct").count();
    let (first, started, _) = run("1", "a");
    assert_eq!((failing(&started), first.failed().count(), first.exit_code()), (1, 1, 1), "{started:?}");
    let (second, started, _) = run("2", "a");
    assert_eq!((failing(&started), second.exit_code()), (0, 0), "{started:?} {second}");
    let left = |node: &&RanNode| matches!(&node.result, NodeResult::Elsewhere(by) if by.contains("slurm 1"));
    let own = second.nodes.iter().filter(|node| node.scene == "wreck" && node.stage != "import");
    assert!(own.clone().count() > 3 && own.clone().all(|node| left(&node)), "{second}");
    // Another submission tries it again, and so does a process that is no task.
    assert_eq!(failing(&run("3", "b").1), 1);
    let (alone, started, _) =
        run_meddled(&builder(&dir.path().join("cache")), &batch, &options, |_| false, || {});
    assert_eq!((failing(&started), alone.exit_code()), (1, 1));
}

/// The first runs of a batch begin at the same moment on a cache that is not there yet.
#[test]
fn a_new_cache_is_made_by_all_that_come_at_once() {
    let dir = tempfile::tempdir().expect("a folder");
    for round in 0..300 {
        let folder = dir.path().join(round.to_string());
        let gate = Barrier::new(4);
        let open = || {
            gate.wait();
            Cache::open(&folder, false).map(drop)
        };
        let opened: Vec<_> = std::thread::scope(|scope| {
            let threads: Vec<_> = (0..4).map(|_| scope.spawn(open)).collect();
            threads.into_iter().map(|thread| thread.join().expect("no panic")).collect()
        });
        assert!(opened.iter().all(Result::is_ok), "round {round}: {opened:?}");
    }
}
