//! Tests of the changes that make a stage run again, and of those that do not.

use std::collections::BTreeMap;
use std::fs;
use std::sync::atomic::Ordering;
use std::time::{Duration, SystemTime};

use serde_json::json;
use use3d_workflow::gc::CleanOptions;
use use3d_workflow::plan::State;
use use3d_workflow::run::{NodeResult, RunOptions};
use use3d_workflow::status::Standing;
use use3d_workflow::{Graph, Variant};

use super::stages::{STEPS, batch, builder, code, payload, run, run_with};

const ALL: [&str; 7] = [
    "calibrate",
    "reef · enhance",
    "reef · evaluate",
    "reef · import",
    "reef · reconstruct",
    "reef · targets",
    "report",
];

#[test]
fn a_second_run_computes_nothing() {
    let dir = tempfile::tempdir().expect("folder");
    let batch = batch(&dir.path().join("data"), &["reef"]);
    let builder = builder(&dir.path().join("cache"));
    let (first, started, warnings) = run(&builder, &batch);
    assert_eq!(started, ALL);
    assert_eq!((first.done(), first.cached(), first.exit_code()), (7, 0, 0));
    assert!(warnings.is_empty(), "{warnings:?}");
    let start = std::time::Instant::now();
    let (second, started, _) = run(&super::stages::builder(&dir.path().join("cache")), &batch);
    println!("a cached run of 7 stages: {:.1} ms", start.elapsed().as_secs_f64() * 1e3);
    assert!(started.is_empty());
    assert_eq!((second.done(), second.cached(), second.exit_code()), (0, 7, 0));
    assert!(dir.path().join("cache/CACHEDIR.TAG").is_file());
    let artifact = second.artifact("reef", "", "enhance").expect("there");
    assert_eq!(artifact.manifest.ingredients.parameters, json!({"strength": 1.0, "proposer": "fusion"}));
    assert!(artifact.manifest.ingredients.code.contains_key("use3d-ubaf"));
    assert!(artifact.path.join("deep/value.txt").is_file());
}

#[test]
fn a_parameter_reruns_its_stage_and_what_reads_its_changed_output() {
    let below_import = &ALL[1..];
    let cases: [(&str, serde_json::Value, &[&str]); 9] = [
        ("reconstruct", json!({"log_every": 7}), &[]),
        ("import", json!({"every": 2}), below_import),
        // The import comes out the same, so only the import runs.
        ("import", json!({"size": "3x2"}), &["reef · import"]),
        (
            "calibrate",
            json!({"strength": 0.5}),
            &["calibrate", "reef · enhance", "reef · evaluate", "reef · targets", "report"],
        ),
        (
            "reconstruct",
            json!({"rate": 0.25}),
            &["reef · enhance", "reef · evaluate", "reef · reconstruct", "reef · targets", "report"],
        ),
        (
            "targets",
            json!({"strength": 0.5}),
            &["reef · enhance", "reef · evaluate", "reef · targets", "report"],
        ),
        ("enhance", json!({"strength": 0.5}), &["reef · enhance", "reef · evaluate", "report"]),
        ("evaluate", json!({"strength": 0.5}), &["reef · evaluate", "report"]),
        ("report", json!({"strength": 0.5}), &["report"]),
    ];
    let dir = tempfile::tempdir().expect("folder");
    let base = batch(&dir.path().join("data"), &["reef"]);
    let builder = builder(&dir.path().join("cache"));
    run(&builder, &base);
    for (stage, change, expected) in cases {
        let mut changed = base.clone();
        changed.defaults.insert(stage.to_string(), change.clone());
        let graph = Graph::new(&builder.registry, &changed).expect("graph");
        let plan = builder.plan(&graph, None);
        let may_run = plan.nodes.iter().filter(|n| n.state != State::Cached).count();
        let (summary, started, _) = run(&builder, &changed);
        assert_eq!(started, expected, "{stage} {change}");
        assert!(may_run >= started.len());
        assert_eq!(summary.cached(), 7 - expected.len());
        // Back to the old parameters: everything is still there.
        assert!(run(&builder, &base).1.is_empty());
    }
    let mut seed = base.clone();
    seed.seed = 43;
    assert_eq!(run(&builder, &seed).1.len(), 6, "all that draw random numbers, and below");
    let mut other = builder;
    other.numeric_class = "another machine".to_string();
    assert_eq!(run(&other, &base).1.len(), 7);
}

#[test]
fn touching_and_moving_inputs_and_other_thread_counts_rerun_nothing() {
    let dir = tempfile::tempdir().expect("folder");
    let mut batch = batch(&dir.path().join("data"), &["reef"]);
    let builder = builder(&dir.path().join("cache"));
    run(&builder, &batch);
    let words = dir.path().join("data/reef/images/words.txt");
    let old = SystemTime::now() - Duration::from_secs(5000);
    fs::File::options().write(true).open(&words).and_then(|f| f.set_modified(old)).expect("touched");
    let fresh = || super::stages::builder(&dir.path().join("cache"));
    assert!(run(&fresh(), &batch).1.is_empty());
    fs::write(dir.path().join("data/reef/notes.txt"), "still not read").expect("file");
    assert!(run(&fresh(), &batch).1.is_empty(), "a file that the stage does not read");
    fs::create_dir_all(dir.path().join("elsewhere")).expect("folder");
    fs::rename(dir.path().join("data/reef"), dir.path().join("elsewhere/kept")).expect("moved");
    batch.scenes[0].externals.insert("capture".to_string(), Ok(dir.path().join("elsewhere/kept")));
    assert!(run(&fresh(), &batch).1.is_empty());
    for (jobs, cores) in [(1, 1), (4, 8), (3, 2)] {
        let options = RunOptions { jobs, cores, ..RunOptions::default() };
        assert!(run_with(&fresh(), &batch, &options).1.is_empty());
    }
    // Other bytes with the same meaning: the import runs, nothing below it (early cut-off).
    fs::write(dir.path().join("elsewhere/kept/images/words.txt"), "some  words\nof reef").expect("file");
    assert_eq!(run(&fresh(), &batch).1, ["reef · import"]);
    fs::write(dir.path().join("elsewhere/kept/images/words.txt"), "other words").expect("file");
    assert_eq!(run(&fresh(), &batch).1.len(), 6);
}

#[test]
fn another_length_goes_on_from_the_checkpoints() {
    let dir = tempfile::tempdir().expect("folder");
    let mut batch = batch(&dir.path().join("data"), &["reef"]);
    let builder = builder(&dir.path().join("cache"));
    let mut steps = |iterations: u64, rate: f64| {
        batch.defaults.insert("reconstruct".to_string(), json!({"iterations": iterations, "rate": rate}));
        let before = STEPS.load(Ordering::Relaxed);
        let (summary, ..) = run_with(
            &builder,
            &batch,
            &RunOptions { until: Some(vec!["reconstruct".to_string()]), ..RunOptions::default() },
        );
        let artifact = summary.artifact("reef", "", "reconstruct").expect("there");
        let scene = fs::read(artifact.path.join("scene.bin")).expect("file");
        (STEPS.load(Ordering::Relaxed) - before, scene, artifact.manifest.resumed)
    };
    // Other tests of this binary count steps too, so the numbers here are unusual and compared as bounds.
    let (long, from_nothing, _) = steps(4000, 0.125);
    assert!(long >= 4000);
    steps(3000, 0.375);
    let (more, extended, resumed) = steps(4000, 0.375);
    assert!((1000..2000).contains(&more), "{more}");
    assert!((resumed - 0.75).abs() < 1e-6);
    assert_ne!(extended, from_nothing);
    let (_, shorter, _) = steps(2995, 0.375);
    assert_ne!(shorter, extended);
    // An extended run and an uninterrupted run have the same bytes.
    let fresh = super::stages::builder(&dir.path().join("other-cache"));
    batch.defaults.insert("reconstruct".to_string(), json!({"iterations": 4000, "rate": 0.375}));
    let (summary, ..) = run(&fresh, &batch);
    let whole = fs::read(summary.artifact("reef", "", "reconstruct").expect("there").path.join("scene.bin"));
    assert_eq!(whole.expect("file"), extended);
}

#[test]
fn variants_share_what_they_do_not_change() {
    let dir = tempfile::tempdir().expect("folder");
    let mut batch = batch(&dir.path().join("data"), &["reef"]);
    let variant = |name: &str, stage: &str, value: serde_json::Value| Variant {
        name: name.to_string(),
        overrides: [(stage.to_string(), value)].into_iter().collect(),
        ..Variant::default()
    };
    batch.variants = vec![
        Variant { name: "full".to_string(), ..Variant::default() },
        variant("mlp", "reconstruct", json!({"medium": "mlp"})),
        variant("weak", "enhance", json!({"strength": 0.5})),
        Variant { name: "seed-7".to_string(), seed: Some(7), ..Variant::default() },
    ];
    let builder = builder(&dir.path().join("cache"));
    let graph = Graph::new(&builder.registry, &batch).expect("graph");
    let plan = builder.plan(&graph, None);
    // full: 6; mlp: reconstruct, targets, enhance, evaluate; weak: enhance, evaluate; seed-7: all but import;
    // report.
    assert_eq!(plan.to_run(), 6 + 4 + 2 + 5 + 1);
    let (summary, started, _) = run(&builder, &batch);
    assert_eq!(started.len(), 18);
    assert_eq!((summary.done(), summary.exit_code()), (18, 0));
    let table = fs::read_to_string(summary.artifact("", "", "report").expect("made").path.join("table.txt"));
    let table = table.expect("file");
    let lines: Vec<&str> = table.lines().collect();
    assert_eq!(lines.len(), 4, "{table}");
    assert!(lines[1].starts_with("Group reef mlp "));
    let same = |a: &str, b: &str, stage: &str| {
        summary.artifact("reef", a, stage).expect("a").path
            == summary.artifact("reef", b, stage).expect("b").path
    };
    assert!(
        same("full", "mlp", "import")
            && same("full", "weak", "reconstruct")
            && !same("full", "mlp", "targets")
    );
    let plan = builder.plan(&graph, None);
    assert_eq!((plan.to_run(), plan.status().count(Standing::Cached)), (0, 4 * 6 + 1));
    assert!(use3d_workflow::picture::mermaid(&graph, &plan).contains(":::cached"));
}

#[test]
fn optional_stages_are_there_when_asked_for() {
    let dir = tempfile::tempdir().expect("folder");
    let mut batch = batch(&dir.path().join("data"), &["reef"]);
    let builder = builder(&dir.path().join("cache"));
    run(&builder, &batch);
    batch.defaults.insert("reconstruct".to_string(), json!({"depth_prior": "network"}));
    let (_, started, _) = run(&builder, &batch);
    assert!(
        started.contains(&"reef · depth".to_string()) && started.contains(&"reef · reconstruct".to_string())
    );
    // After weights appear, the depth stage reads them.
    fs::create_dir_all(dir.path().join("models")).expect("folder");
    fs::write(dir.path().join("models/weights"), "w").expect("file");
    batch.externals.insert("models".to_string(), Ok(dir.path().join("models")));
    assert!(run(&builder, &batch).1.contains(&"reef · depth".to_string()));
}

#[test]
fn why_names_the_ingredients_that_changed() {
    let dir = tempfile::tempdir().expect("folder");
    let mut batch = batch(&dir.path().join("data"), &["reef"]);
    let builder = builder(&dir.path().join("cache"));
    let graph = Graph::new(&builder.registry, &batch).expect("graph");
    let why = builder.why(&graph, "reef", "", "enhance").expect("why");
    assert_eq!((why.standing, why.earlier), (Standing::Missing, None));
    run(&builder, &batch);
    let why = builder.why(&graph, "reef", "", "enhance").expect("why");
    assert_eq!((why.standing, why.changes.len()), (Standing::Cached, 0));
    batch.defaults.insert("enhance".to_string(), json!({"strength": 0.1}));
    let graph = Graph::new(&builder.registry, &batch).expect("graph");
    let why = builder.why(&graph, "reef", "", "enhance").expect("why");
    assert_eq!(why.standing, Standing::Stale);
    assert_eq!(why.changes.len(), 1);
    assert_eq!(why.changes[0].to_string(), "parameter strength: 1 → 0.1");
    let below = builder.why(&graph, "reef", "", "evaluate").expect("why");
    assert_eq!(below.standing, Standing::Stale);
    assert_eq!(below.upstream.len(), 1);
    assert_eq!(below.upstream[0].0, "reef · enhance");
    assert!(below.to_string().contains("strength"));
    run(&builder, &batch);
    let after = builder.why(&graph, "reef", "", "evaluate").expect("why");
    assert_eq!(after.standing, Standing::Cached);
    assert_eq!(after.changes[0].ingredient, "input scene", "the last change is remembered");
    let wrong = builder.why(&graph, "ref", "", "enhance").expect_err("no such scene").to_string();
    assert!(wrong.contains("did you mean `reef`"), "{wrong}");
    let wrong = builder.why(&graph, "reef", "", "enhanse").expect_err("no such stage").to_string();
    assert!(wrong.contains("did you mean `enhance`"), "{wrong}");
    // After one run, every stage has a forecast.
    batch.seed = 1;
    let graph = Graph::new(&builder.registry, &batch).expect("graph");
    let plan = builder.plan(&graph, None);
    assert_eq!(plan.forecast().1, 0, "{plan}");
    let json = serde_json::to_value(&plan).expect("JSON");
    assert_eq!(json["nodes"][0]["state"], "run");
}

#[test]
fn cleaning_keeps_what_is_wanted_and_verifying_finds_flipped_bytes() {
    let dir = tempfile::tempdir().expect("folder");
    let mut batch = batch(&dir.path().join("data"), &["reef", "wreck"]);
    let builder = builder(&dir.path().join("cache"));
    run(&builder, &batch);
    let graph = Graph::new(&builder.registry, &batch).expect("graph");
    let keep = builder.plan(&graph, None).keys().collect();
    let old = payload(&builder.cache);
    batch.defaults.insert("reconstruct".to_string(), json!({"rate": 0.75}));
    run(&builder, &batch);
    let options = CleanOptions { max_bytes: Some(0), keep, dry_run: true, ..CleanOptions::default() };
    let dry = builder.cache.clean(&options);
    assert_eq!(dry.removed.iter().filter(|r| r.kind == "artifact").count(), 2 * 4 + 1);
    assert!(dry.removed.iter().any(|r| r.name == "reconstruct of synthetic · wreck"), "{dry}");
    assert_eq!(payload(&builder.cache).len(), old.len() + 2 * 7 + 1, "a dry run touches nothing");
    let real = builder.cache.clean(&CleanOptions { dry_run: false, ..options });
    assert_eq!(real.removed.len(), dry.removed.len());
    assert_eq!(payload(&builder.cache), old);
    let nothing = CleanOptions { older_than: Some(Duration::from_secs(3600)), ..CleanOptions::default() };
    assert!(builder.cache.clean(&nothing).removed.is_empty());

    assert!(builder.cache.verify_all(false).problems.is_empty());
    let (name, _) = old.iter().find(|(name, _)| name.starts_with("targets")).expect("a file");
    let path = builder.cache.root().join("artifacts").join(name);
    let times = fs::metadata(&path).and_then(|m| m.modified()).expect("times");
    let mut bytes = fs::read(&path).expect("bytes");
    bytes[3] ^= 1;
    fs::write(&path, bytes).expect("flipped");
    fs::File::options().write(true).open(&path).and_then(|f| f.set_modified(times)).expect("times");
    let found = builder.cache.verify_all(true);
    assert_eq!((found.problems.len(), found.repaired), (1, 1), "{found}");
    assert!(found.problems[0].what.contains("bytes of"), "{found}");
    batch.defaults.clear();
    assert_eq!(run(&builder, &batch).1.len(), 1, "only what was damaged is made again");
    assert_eq!(payload(&builder.cache), old);
}

#[test]
fn a_sample_is_computed_again_and_compared() {
    let dir = tempfile::tempdir().expect("folder");
    let batch = batch(&dir.path().join("data"), &["reef"]);
    let builder = builder(&dir.path().join("cache"));
    run(&builder, &batch);
    let graph = Graph::new(&builder.registry, &batch).expect("graph");
    let listener: std::sync::Arc<dyn use3d_workflow::Listener> = std::sync::Arc::new(use3d_workflow::Silent);
    let all = builder.verify_sample(&graph, 1.0, &RunOptions::default(), &listener).expect("sample");
    assert_eq!((all.recomputed, all.problems.len()), (Some(7), 0), "{all}");
    let one = builder.verify_sample(&graph, 0.0, &RunOptions::default(), &listener).expect("sample");
    assert_eq!(one.recomputed, Some(1));
}

#[test]
fn a_stage_that_is_not_deterministic_raises_an_alarm() {
    use use3d_workflow::{Builder, Cache, Registry, Scope, Stage};
    let dir = tempfile::tempdir().expect("folder");
    let batch = batch(&dir.path().join("data"), &["reef"]);
    let draw = std::sync::atomic::AtomicU64::new(0);
    let stage = Stage::new("dice", Scope::Scene, move |context, _: &super::stages::Strength| {
        let number = draw.fetch_add(1, Ordering::Relaxed);
        Ok(fs::write(context.output().join("number"), number.to_string())?)
    })
    .external("capture", "capture");
    let cache = Cache::open(&dir.path().join("cache"), false).expect("cache");
    let builder = Builder::new(Registry::new(vec![stage], code()).expect("table"), cache);
    let (first, ..) = run(&builder, &batch);
    let graph = Graph::new(&builder.registry, &batch).expect("graph");
    let listener: std::sync::Arc<dyn use3d_workflow::Listener> = std::sync::Arc::new(use3d_workflow::Silent);
    let found = builder.verify_sample(&graph, 1.0, &RunOptions::default(), &listener).expect("sample");
    assert!(found.problems[0].what.contains("number comes out different"), "{found}");
    fs::remove_dir_all(&first.artifact("reef", "", "dice").expect("there").path).expect("removed");
    let (_, _, warnings) = run(&builder, &batch);
    assert!(warnings.iter().any(|w| w.contains("determinism alarm")), "{warnings:?}");
}

#[test]
fn an_interrupted_run_says_so_and_goes_on() {
    let dir = tempfile::tempdir().expect("folder");
    let batch = batch(&dir.path().join("data"), &["reef", "wreck"]);
    let builder = builder(&dir.path().join("cache"));
    let options = RunOptions::default();
    let graph = Graph::new(&builder.registry, &batch).expect("graph");
    let stop = options.stop.clone();
    let listener: std::sync::Arc<dyn use3d_workflow::Listener> =
        std::sync::Arc::new(move |event: &use3d_workflow::Event<'_>| {
            if let use3d_workflow::Event::Done { label, .. } = event {
                stop.fetch_or(label.contains("targets"), Ordering::Relaxed);
            }
        });
    let summary = builder.run(&graph, &options, &listener);
    assert_eq!((summary.exit_code(), summary.interrupted), (130, true));
    assert!(summary.nodes.iter().any(|n| n.result == NodeResult::NotRun));
    let done = summary.done();
    let (second, ..) = run(&builder, &batch);
    assert_eq!((second.exit_code(), second.cached()), (0, done));
    let manifests: BTreeMap<_, _> = payload(&builder.cache);
    assert!(!manifests.is_empty());
}

#[test]
fn an_input_that_changes_while_it_is_read_makes_no_artifact() {
    use use3d_workflow::{Registry, Scope, Stage};
    let dir = tempfile::tempdir().expect("folder");
    let batch = batch(&dir.path().join("data"), &["reef"]);
    let stage = Stage::new("reader", Scope::Scene, |context, _: &super::stages::Strength| {
        let words = context.input("capture")?.join("images/words.txt");
        let text = fs::read_to_string(&words)?;
        if !text.ends_with("more") {
            fs::write(&words, format!("{text} more"))?; // a user copies pictures into the folder
        }
        Ok(fs::write(context.output().join("text"), text)?)
    })
    .external("capture", "capture");
    let mut builder = builder(&dir.path().join("cache"));
    builder.registry = Registry::new(vec![stage], code()).expect("table");
    let (summary, ..) = run(&builder, &batch);
    assert!(summary.to_string().contains("changed while it was being read"), "{summary}");
    assert!(builder.cache.artifacts().is_empty());
    builder.cache = super::stages::builder(&dir.path().join("cache")).cache;
    assert_eq!(run(&builder, &batch).0.exit_code(), 0);
}

#[test]
fn a_given_result_stands_for_the_stage_that_would_make_it() {
    let dir = tempfile::tempdir().expect("folder");
    let mut batch = batch(&dir.path().join("data"), &["reef"]);
    let whole = builder(&dir.path().join("cache"));
    let (summary, ..) = run(&whole, &batch);
    let made = |summary: &use3d_workflow::Summary| {
        let artifact = summary.artifact("reef", "", "reconstruct").expect("a scene");
        fs::read(artifact.path.join("scene.bin")).expect("file")
    };
    let import = summary.artifact("reef", "", "import").expect("there").path.clone();
    let kept = dir.path().join("import");
    use3d_workflow::place::copy_folder(&import, &kept).expect("copied");
    batch.given.insert("capture", Some(kept));
    let other = builder(&dir.path().join("other"));
    let options = RunOptions { until: Some(vec!["reconstruct".into()]), ..RunOptions::default() };
    let (alone, ..) = run_with(&other, &batch, &options);
    assert_eq!(made(&alone), made(&summary));
    assert!(alone.artifact("reef", "", "import").is_none(), "nothing is imported");
}

#[test]
fn artifacts_of_another_class_are_compared_as_their_stage_says() {
    use std::sync::Arc;
    use std::sync::atomic::AtomicU64;

    use use3d_workflow::{AskedDevice, Builder, Cache, DeviceClass, Digest, Figure, Registry, Scope, Stage};

    const FIGURES: [Figure; 1] = [Figure { file: "score.json", at: "/psnr", within: 0.1 }];
    let dir = tempfile::tempdir().expect("folder");
    let batch = batch(&dir.path().join("data"), &["reef"]);
    let driver = Arc::new(AtomicU64::new(1));
    let off = Arc::new(AtomicU64::new(0));
    let builder = |figures: &'static [Figure]| {
        let (here, noise) = (driver.clone(), off.clone());
        // It trains on a device: the score differs with every driver.
        let train = Stage::new("train", Scope::Scene, move |context, _: &super::stages::Strength| {
            let psnr = 30.0 + 0.01 * noise.load(Ordering::Relaxed) as f64;
            Ok(fs::write(context.output().join("score.json"), json!({ "psnr": psnr }).to_string())?)
        })
        .external("capture", "capture")
        .agrees_across_classes(figures)
        .computes_on(
            "device",
            |_: &super::stages::Strength| {
                let programs = Digest::of(b"kernels");
                Some(AskedDevice { name: "a card".into(), required: true, programs })
            },
            move |_| {
                Ok(Some(DeviceClass {
                    engine: "wgpu".into(),
                    adapter: "a card".into(),
                    driver: here.load(Ordering::Relaxed).to_string(),
                    kernels: Digest::of(b"kernels"),
                }))
            },
        );
        // It computes on the processor, from the result of the device.
        let judge = Stage::new("judge", Scope::Scene, |context, _: &super::stages::Strength| {
            let score = fs::read(context.input("train")?.join("score.json"))?;
            Ok(fs::write(context.output().join("verdict"), score)?)
        })
        .input("train", "train");
        let cache = Cache::open(&dir.path().join("cache"), false).expect("cache");
        Builder::new(Registry::new(vec![train, judge], code()).expect("table"), cache)
    };
    let tolerant = builder(&FIGURES);
    let (first, ..) = run(&tolerant, &batch);
    let class = |stage: &str| {
        first.artifact("reef", "", stage).expect("there").manifest.ingredients.numeric_class.clone()
    };
    assert!(class("train").starts_with("wgpu on a card, driver 1, kernels "), "{}", class("train"));
    assert!(class("train").ends_with(&class("judge")), "{} {}", class("train"), class("judge"));

    let graph = Graph::new(&tolerant.registry, &batch).expect("graph");
    let listener: Arc<dyn use3d_workflow::Listener> = Arc::new(use3d_workflow::Silent);
    let verify = |builder: &Builder, noise: u64| {
        off.store(noise, Ordering::Relaxed);
        builder.verify_sample(&graph, 1.0, &RunOptions::default(), &listener).expect("sample")
    };
    // In its own class every byte must agree, even if the figures are near.
    assert_eq!(verify(&tolerant, 0).problems, []);
    assert!(verify(&tolerant, 1).problems[0].what.contains("determinism alarm"));
    // Another driver is another class: none of its artifacts is cached, and those of the first class are
    // compared by their figures. The stage after it is computed from the cached artifact, to the byte.
    driver.store(2, Ordering::Relaxed);
    assert_eq!(tolerant.plan(&graph, None).cached(), 0);
    let near = verify(&tolerant, 9);
    assert_eq!((near.recomputed, near.agreed, near.problems.len()), (Some(2), 1, 0), "{near}");
    assert!(
        near.to_string()
            .contains("2 computed again (1 in another numeric class: within their stage's tolerances)"),
        "{near}"
    );
    let far = verify(&tolerant, 11);
    assert_eq!(far.problems.len(), 1, "{far}");
    let what = &far.problems[0].what;
    assert!(what.contains("driver 1") && what.contains("driver 2") && what.contains("/psnr is 30"), "{what}");
    // A stage without such a declaration promises the same bytes in every class.
    let strict = builder(&[]);
    let found = verify(&strict, 9);
    assert!(found.problems.iter().any(|p| p.what.contains("promises the same bytes everywhere")), "{found}");
}
