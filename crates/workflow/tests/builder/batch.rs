//! Batches of many scenes.

use std::collections::BTreeMap;
use std::fs;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use serde_json::json;
use use3d_workflow::run::{NodeResult, RunOptions};
use use3d_workflow::status::Standing;
use use3d_workflow::{Batch, Digest, Figure, Graph, Listener, Registry, Scope, Silent, Stage, Variant};

use super::stages::{Strength, batch, builder, code, registry, run_with, scene};

/// The scenes of the large batch.
fn names() -> Vec<String> {
    (1..=26).map(|i| format!("A{i}")).collect()
}

#[test]
fn the_digest_of_a_scene_follows_its_own_keys_and_no_other_scene() {
    let dir = tempfile::tempdir().expect("folder");
    let table = registry(0);
    let parts = |batch: &Batch| -> BTreeMap<(String, String), Digest> {
        Graph::new(&table, batch).expect("graph").parts(&table)
    };
    /// The names of the parts that are in both and differ.
    fn apart(a: &BTreeMap<(String, String), Digest>, b: &BTreeMap<(String, String), Digest>) -> Vec<String> {
        a.iter()
            .filter(|(cell, part)| b.get(*cell).is_some_and(|p| p != *part))
            .map(|(c, _)| c.0.clone())
            .collect()
    }
    let before = batch(dir.path(), &["b", "c"]);
    let known = parts(&before);
    assert_eq!(known.keys().map(|(scene, _)| scene.as_str()).collect::<Vec<_>>(), ["", "b", "c"]);
    // Another scene, also a first one, and another order change nothing.
    let mut grown = before.clone();
    grown.scenes.insert(0, scene(dir.path(), "a"));
    grown.scenes.swap(1, 2);
    assert_eq!((apart(&known, &parts(&grown)), parts(&grown).len()), (Vec::new(), 4));
    // A setting of one scene, and one of all.
    let mut edited = before.clone();
    edited.scenes[1].overrides.insert("enhance".into(), json!({"strength": 0.25}));
    assert_eq!(apart(&known, &parts(&edited)), ["c"]);
    let mut edited = before.clone();
    edited.defaults.insert("reconstruct".into(), json!({"log_every": 7}));
    assert!(apart(&known, &parts(&edited)).is_empty(), "it is in no key");
    edited.defaults.insert("reconstruct".into(), json!({"iterations": 7}));
    assert_eq!(apart(&known, &parts(&edited)), ["b", "c"]);
    // The calibrator is shared by all scenes, and the report concerns no scene.
    edited.defaults = json!({"calibrate": {"strength": 0.25}}).as_object().cloned().expect("a table");
    assert_eq!(apart(&known, &parts(&edited)), ["", "b", "c"]);
    edited.defaults = json!({"report": {"strength": 0.25}}).as_object().cloned().expect("a table");
    assert_eq!(apart(&known, &parts(&edited)), [""]);
    let mut moved = before.clone();
    moved.scenes[0].externals.insert("capture".into(), Ok(dir.path().join("c")));
    assert_eq!(apart(&known, &parts(&moved)), ["b"]);
    moved.seed = 7;
    assert_eq!(apart(&known, &parts(&moved)), ["", "b", "c"]);
    // A variant more leaves the others.
    let variant = |name: &str| Variant { name: name.into(), ..Variant::default() };
    let one = Batch { variants: vec![variant("x")], ..before.clone() };
    let two = Batch { variants: vec![variant("x"), variant("y")], ..before };
    let (one, two) = (parts(&one), parts(&two));
    assert!(one.iter().all(|(cell, part)| cell.0.is_empty() || two[cell] == *part) && two.len() == 5);
}

#[test]
fn a_stage_that_varies_is_compared_by_its_figures_and_the_versions_of_its_programs_are_in_its_key() {
    static FIGURES: [Figure; 1] = [Figure { file: "figures.json", at: "/found", within: 1.0 }];
    let dir = tempfile::tempdir().expect("folder");
    let batch = batch(dir.path(), &["a"]);
    let run = |version: &'static str, varies: bool| {
        let stage = Stage::new("find", Scope::Scene, |context, _: &Strength| {
            static NEXT: AtomicUsize = AtomicUsize::new(0);
            let next = NEXT.fetch_add(1, Ordering::Relaxed);
            fs::write(
                context.output().join("figures.json"),
                json!({ "found": next % 2, "run": next }).to_string(),
            )?;
            Ok(())
        });
        let stage =
            stage.external("in", "capture").made_of(&[], &[]).made_with(move |_: &Strength| version.into());
        let stage = if varies { stage.agrees_from_run_to_run(&FIGURES) } else { stage };
        let mut builder = builder(&dir.path().join("cache"));
        builder.registry = Registry::new(vec![stage], code()).expect("table");
        let graph = Graph::new(&builder.registry, &batch).expect("graph");
        let listener: Arc<dyn Listener> = Arc::new(Silent);
        let options = RunOptions::default();
        let done = builder.run(&graph, &options, &listener).done();
        let checked = builder.verify_sample(&graph, 1.0, &options, &listener).expect("a check");
        (done, checked.varied, checked.problems.len())
    };
    assert_eq!(run("finder 1", true), (1, 1, 0));
    assert_eq!(run("finder 1", true), (0, 1, 0));
    assert_eq!(run("finder 2", true), (1, 1, 0));
    assert_eq!(run("finder 2", false), (0, 0, 1), "without the declaration it is an alarm");
}

#[test]
fn a_broken_scene_spoils_no_other_and_another_scene_runs_only_its_stages() {
    let dir = tempfile::tempdir().expect("folder");
    let names = names();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let data = dir.path().join("data");
    let mut batch = batch(&data, &names);
    fs::write(data.join("A7/images/words.txt"), "a broken capture").expect("file");
    let builder = builder(&dir.path().join("cache"));
    let options = RunOptions { jobs: 2, keep_going: true, ..RunOptions::default() };
    let start = Instant::now();
    let (summary, ..) = run_with(&builder, &batch, &options);
    println!("26 scenes, 132 stages: {:.2} s in all", start.elapsed().as_secs_f64());
    // Five stages per whole scene, calibrate, report.
    assert_eq!((summary.done(), summary.failed().count(), summary.exit_code()), (25 * 5 + 2, 1, 1));
    let text = summary.to_string();
    assert!(
        text.contains("A7 · import") && text.contains("a whole word is expected") && text.contains(".log"),
        "{text}"
    );
    let NodeResult::Failed { log, .. } = &summary.failed().next().expect("one").result else {
        panic!("failed")
    };
    assert!(fs::read_to_string(log).expect("a log").contains("found `broken`"));
    assert!(
        summary
            .nodes
            .iter()
            .filter(|n| n.scene == "A7")
            .skip(1)
            .all(|n| n.result == NodeResult::Blocked("A7 · import".to_string()))
    );
    let table = fs::read_to_string(summary.artifact("", "", "report").expect("made").path.join("table.txt"));
    let table = table.expect("file");
    assert_eq!(table.lines().count(), 26);
    assert!(table.ends_with("missing A7 · evaluate"), "{table}");

    let graph = Graph::new(&builder.registry, &batch).expect("graph");
    let plan = builder.plan(&graph, None);
    let status = plan.status();
    assert_eq!(status.count(Standing::Failed), 1);
    assert_eq!(status.count(Standing::Cached), 25 * 5 + 1, "{status}");
    assert!(status.to_string().contains("A7 · import: images/words.txt"), "{status}");

    // Adding a 27th scene runs its stages and the report.
    batch.scenes.push(scene(&data, "A27"));
    let (summary, started, _) = run_with(&builder, &batch, &options);
    let own: Vec<&String> = started.iter().filter(|l| l.starts_with("A27")).collect();
    assert_eq!((own.len(), started.len()), (5, 7), "{started:?}");
    assert_eq!(summary.cached(), 25 * 5 + 1);

    // Repaired: only the failed stages and those that need them run.
    fs::write(data.join("A7/images/words.txt"), "a whole capture").expect("file");
    let (summary, started, _) = run_with(&builder, &batch, &options);
    assert_eq!((started.len(), summary.exit_code()), (6, 0), "{started:?}");
    let status = builder.plan(&Graph::new(&builder.registry, &batch).expect("graph"), None).status();
    assert_eq!(status.count(Standing::Cached), 27 * 5 + 2);
}

#[test]
fn without_keep_going_the_first_failure_ends_the_run() {
    let dir = tempfile::tempdir().expect("folder");
    let data = dir.path().join("data");
    let mut batch = batch(&data, &["a", "b"]);
    fs::write(data.join("a/images/words.txt"), "broken").expect("file");
    let builder = builder(&dir.path().join("cache"));
    let (summary, ..) = run_with(&builder, &batch, &RunOptions::default());
    assert_eq!(summary.exit_code(), 1);
    assert!(summary.nodes.iter().any(|n| n.scene == "b" && n.result == NodeResult::NotRun));
    // A missing capture: the message names the path.
    batch.scenes[0].externals.insert("capture".to_string(), Ok(data.join("absent")));
    batch.scenes[1]
        .externals
        .insert("capture".to_string(), Err("the environment variable REEF is not set".to_string()));
    let options = RunOptions { keep_going: true, ..RunOptions::default() };
    let (summary, ..) = run_with(&builder, &batch, &options);
    let text = summary.to_string();
    assert!(text.contains("absent does not exist") && text.contains("REEF is not set"), "{text}");
    assert_eq!(summary.failed().count(), 2);
    assert!(summary.artifact("", "", "report").is_none());
}

#[test]
fn a_panicking_and_an_idle_stage_fail_alone() {
    let dir = tempfile::tempdir().expect("folder");
    let batch = batch(&dir.path().join("data"), &["a"]);
    let stages = vec![
        Stage::new("panics", Scope::Scene, |_, p: &Strength| {
            assert!(p.strength < 0.0, "strength is {}", p.strength);
            Ok(())
        })
        .external("capture", "capture"),
        Stage::new("idles", Scope::Scene, |_, _: &Strength| Ok(())).external("capture", "capture"),
    ];
    let mut builder = builder(&dir.path().join("cache"));
    builder.registry = Registry::new(stages, code()).expect("table");
    let options = RunOptions { keep_going: true, ..RunOptions::default() };
    let (summary, ..) = run_with(&builder, &batch, &options);
    let text = summary.to_string();
    assert!(text.contains("strength is 1") && text.contains("but wrote nothing"), "{text}");
    assert_eq!(summary.failed().count(), 2);
}

#[test]
fn jobs_and_memory_bound_what_runs_at_once() {
    let dir = tempfile::tempdir().expect("folder");
    let names = names();
    let names: Vec<&str> = names.iter().take(8).map(String::as_str).collect();
    let batch = batch(&dir.path().join("data"), &names);
    let (now, most) = (Arc::new(AtomicUsize::new(0)), Arc::new(AtomicUsize::new(0)));
    let threads = Arc::new(Mutex::new(Vec::new()));
    // A stage waits until `expected` stages run at the same time, which can take long on a busy machine, and
    // then checks that no more start.
    let stage = |memory: u64, expected: usize| {
        let (now, most, threads) = (now.clone(), most.clone(), threads.clone());
        Stage::new("busy", Scope::Scene, move |context, _: &Strength| {
            most.fetch_max(now.fetch_add(1, Ordering::SeqCst) + 1, Ordering::SeqCst);
            threads.lock().expect("lock").push((context.threads(), rayon::current_num_threads()));
            let begun = Instant::now();
            while most.load(Ordering::SeqCst) < expected && begun.elapsed() < Duration::from_secs(20) {
                std::thread::sleep(Duration::from_millis(1));
            }
            std::thread::sleep(Duration::from_millis(20));
            now.fetch_sub(1, Ordering::SeqCst);
            Ok(fs::write(context.output().join("x"), "x")?)
        })
        .external("capture", "capture")
        .cost(0, memory)
    };
    let run = |folder: &str, memory: u64, jobs: usize, expected: usize| {
        most.store(0, Ordering::SeqCst);
        threads.lock().expect("lock").clear();
        let mut builder = builder(&dir.path().join(folder));
        builder.registry = Registry::new(vec![stage(memory, expected)], code()).expect("table");
        let options = RunOptions { jobs, cores: 8, memory: 1000, ..RunOptions::default() };
        let (summary, ..) = run_with(&builder, &batch, &options);
        assert_eq!(summary.done(), 8);
        (most.load(Ordering::SeqCst), threads.lock().expect("lock").clone())
    };
    let (at_once, threads) = run("one", 10, 4, 4);
    assert_eq!(at_once, 4);
    assert!(threads.iter().all(|(given, pool)| *given == 2 && pool == given), "{threads:?}");
    assert_eq!(run("two", 400, 4, 2).0, 2, "two fit into the memory");
    assert_eq!(run("three", 5000, 4, 1).0, 1, "too large for the memory: alone");
    // A stage's inputs may give a better estimate of its memory than its fixed figure.
    let told = |folder: &str, known: Option<u64>, expected: usize| {
        most.store(0, Ordering::SeqCst);
        let mut builder = builder(&dir.path().join(folder));
        let stage = stage(5000, expected).memory(move |_: &Strength, inputs| {
            assert!(inputs.iter().any(|i| i.role == "capture" && i.path.exists()));
            known
        });
        builder.registry = Registry::new(vec![stage], code()).expect("table");
        let options = RunOptions { jobs: 4, cores: 8, memory: 1000, ..RunOptions::default() };
        assert_eq!(run_with(&builder, &batch, &options).0.done(), 8);
        let graph = Graph::new(&builder.registry, &batch).expect("graph");
        let mut fresh = super::stages::builder(&dir.path().join(format!("{folder}-plan")));
        fresh.registry = builder.registry;
        let plan = fresh.plan(&graph, None);
        // The fixed figure is no estimate, so a site's own figure can take its place.
        assert!(plan.nodes.iter().all(|n| n.memory == known), "{plan:?}");
        most.load(Ordering::SeqCst)
    };
    assert_eq!(told("four", Some(400), 2), 2, "two fit into the memory");
    assert_eq!(told("five", None, 1), 1, "the fixed figure stands");
}

#[test]
fn planning_a_cached_batch_is_quick() {
    let dir = tempfile::tempdir().expect("folder");
    let names = names();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let mut batch = batch(&dir.path().join("data"), &names);
    // Ten stages per scene, ten files each.
    let mut stages = vec![
        Stage::new("stage0", Scope::Scene, |context, _: &Strength| {
            for i in 0..10 {
                fs::write(context.output().join(format!("{i}")), context.label_for_test())?;
            }
            Ok(())
        })
        .external("in", "capture"),
    ];
    const NAMES: [&str; 10] =
        ["stage0", "stage1", "stage2", "stage3", "stage4", "stage5", "stage6", "stage7", "stage8", "stage9"];
    for i in 1..10 {
        let stage = Stage::new(NAMES[i], Scope::Scene, |context, _: &Strength| {
            for i in 0..10 {
                fs::write(context.output().join(format!("{i}")), context.label_for_test())?;
            }
            Ok(())
        });
        stages.push(stage.input("in", NAMES[i - 1]).made_of(&["use3d-nets", "use3d-splat"], &[]));
    }
    batch.defaults.insert("stage3".to_string(), json!({"strength": 0.5}));
    let mut builder = builder(&dir.path().join("cache"));
    builder.registry = Registry::new(stages.clone(), code()).expect("table");
    let graph = Graph::new(&builder.registry, &batch).expect("graph");
    let listener: Arc<dyn Listener> = Arc::new(Silent);
    let options = RunOptions { jobs: 2, ..RunOptions::default() };
    let start = Instant::now();
    let summary = builder.run(&graph, &options, &listener);
    let spent = start.elapsed().as_secs_f64();
    println!("260 empty stages: {:.2} s, {:.1} ms each", spent, spent / 260.0 * 1e3);
    assert_eq!(summary.done(), 260);
    let start = Instant::now();
    let mut fresh = super::stages::builder(&dir.path().join("cache"));
    fresh.registry = Registry::new(stages, code()).expect("table");
    let graph = Graph::new(&fresh.registry, &batch).expect("graph");
    let plan = fresh.plan(&graph, None);
    println!(
        "a cached plan of 26 scenes × 10 stages, 2600 files: {:.0} ms",
        start.elapsed().as_secs_f64() * 1e3
    );
    assert_eq!((plan.cached(), plan.to_run()), (260, 0));
    let start = Instant::now();
    let summary = fresh.run(&graph, &options, &listener);
    println!("a cached run of the same: {:.0} ms", start.elapsed().as_secs_f64() * 1e3);
    assert_eq!(summary.cached(), 260);
}

/// A text that differs between scenes and stages.
trait Label {
    fn label_for_test(&self) -> String;
}

impl Label for use3d_workflow::StageContext {
    fn label_for_test(&self) -> String {
        let input = &self.inputs()[0].path;
        let words = fs::read_to_string(input.join("images/words.txt"))
            .or_else(|_| fs::read_to_string(input.join("0")));
        format!("{}+", words.unwrap_or_default())
    }
}

#[test]
fn one_stage_alone_leaves_what_it_lacks_to_others() {
    let dir = tempfile::tempdir().expect("folder");
    let batch = batch(&dir.path().join("data"), &["reef"]);
    let builder = builder(&dir.path().join("cache"));
    let alone = |stage: &str| {
        let until = Some(vec![stage.to_string()]);
        run_with(&builder, &batch, &RunOptions { until, alone: true, ..RunOptions::default() })
    };
    let (summary, started, _) = alone("reconstruct");
    assert!(started.is_empty() && summary.exit_code() == 0, "{summary}");
    let left =
        |result: &NodeResult| matches!(result, NodeResult::Elsewhere(by) if by == "the tasks of import");
    assert_eq!(summary.nodes.iter().filter(|node| left(&node.result)).count(), 2, "{summary}");
    assert_eq!(alone("import").1, ["reef · import"]);
    assert_eq!(alone("reconstruct").1, ["reef · reconstruct"]);
}
