//! Every input that a pipeline names must exist: a named input that is missing fails the stages that need it,
//! and is never skipped.

use std::fs;
use std::path::Path;

use use3d_config::{LoadOptions, from_text};
use use3d_workflow::plan::State;
use use3d_workflow::run::{NodeResult, RunOptions};
use use3d_workflow::{Batch, Builder, Cache, Graph, Registry, Scope, Stage, StageContext, Variant};

use super::stages::{Strength, batch, builder, code, registry, run, run_with};

#[test]
fn an_optional_input_that_is_named_and_missing_fails_what_needs_it_and_nothing_else() {
    let dir = tempfile::tempdir().expect("folder");
    let mut batch = batch(&dir.path().join("data"), &["reef"]);
    let builder = builder(&dir.path().join("cache"));
    let places =
        [Err("the environment variable UIEB is not set".to_string()), Ok(dir.path().join("typo/raw-890"))];
    for (place, reason) in places.into_iter().zip(["UIEB is not set", "raw-890 does not exist"]) {
        batch.name_external("pairs.input", place, "`calibrator.pairs.input` in reefs.toml");
        let graph = Graph::new(&builder.registry, &batch).expect("graph");
        let plan = builder.plan(&graph, None);
        let planned = plan.nodes.iter().find(|n| n.stage == "calibrate").expect("planned");
        let State::Unavailable(why) = &planned.state else { panic!("{:?}", planned.state) };
        assert!(why.contains(reason) && why.contains("`calibrator.pairs.input` in reefs.toml"), "{why}");
        assert_eq!(plan.unavailable(), 1);
        assert!(plan.blocked() >= 2 && plan.to_string().contains("1 cannot run"), "{plan}");

        let options = RunOptions { keep_going: true, ..RunOptions::default() };
        let (summary, ..) = run_with(&builder, &batch, &options);
        assert_eq!(summary.exit_code(), 1);
        let became =
            |stage: &str| summary.nodes.iter().find(|n| n.stage == stage).expect("ran").result.clone();
        assert!(matches!(became("calibrate"), NodeResult::Failed { .. }), "{summary}");
        assert_eq!(became("targets"), NodeResult::Blocked("calibrate".to_string()));
        assert!(matches!(became("reconstruct"), NodeResult::Done | NodeResult::Cached), "{summary}");
    }
    // An input that is not named is skipped. An input that exists is read.
    batch.externals.remove("pairs.input");
    assert_eq!(run(&builder, &batch).0.exit_code(), 0);
    fs::create_dir_all(dir.path().join("raw")).expect("folder");
    fs::write(dir.path().join("raw/a.txt"), "a").expect("file");
    batch.name_external("pairs.input", Ok(dir.path().join("raw")), "--pairs");
    assert!(run(&builder, &batch).1.contains(&"calibrate".to_string()));
}

#[test]
fn each_input_from_outside_is_named_by_its_key_and_its_file() {
    let text = "name = \"x\"\n[models]\ndir = \"${USE3D_TEST_UNSET}\"\n[calibrator]\npairs = { input = \"a\", target = \"b\" }\n\
        [[scene]]\nname = \"reef\"\ncapture = \"c\"\n[[scene]]\nname = \"own\"\ncapture = \"d\"\ncalibrator = { file = \"e.pth\" }\n\
        [[variant]]\nname = \"plain\"\n[[variant]]\nname = \"theirs\"\ncalibrator = { file = \"v.pth\" }\n";
    let load = |sets: &[&str], options: LoadOptions| {
        let sets = sets.iter().map(ToString::to_string).collect();
        from_text(&registry(0), text, Path::new("dir/p.toml"), &LoadOptions { sets, ..options })
            .map(|p| p.batch)
            .map_err(|e| e.to_string())
    };
    let batch = load(&[], LoadOptions::default()).expect("loaded");
    let unset = batch.externals["models"].clone().expect_err("not set");
    assert!(unset.contains("USE3D_TEST_UNSET is not set"), "{unset}");
    assert_eq!(batch.named["models"], "`models.dir` in dir/p.toml");
    assert_eq!(batch.named["pairs.target"], "`calibrator.pairs.target` in dir/p.toml");
    assert_eq!(batch.scenes[0].named["capture"], "`capture` of scene reef in dir/p.toml");
    assert_eq!(batch.scenes[1].externals["calibrator"], Ok("dir/e.pth".into()));
    assert_eq!(batch.scenes[1].named["calibrator"], "`calibrator.file` of scene own in dir/p.toml");
    assert_eq!(batch.variants[1].externals["calibrator"], Ok("dir/v.pth".into()));
    assert_eq!(batch.variants[1].named["calibrator"], "`calibrator.file` of variant theirs in dir/p.toml");
    assert!(batch.variants[0].externals.is_empty());

    // The command line overrides the file as a whole: pairs replace a calibrator file, and a file replaces
    // pairs. Its paths are relative to the current folder.
    let set = load(&["calibrator.file=f.pth"], LoadOptions::default()).expect("loaded");
    assert_eq!(
        (set.externals["calibrator"].clone(), set.externals.get("pairs.input")),
        (Ok("f.pth".into()), None)
    );
    assert!(!set.scenes[1].externals.contains_key("calibrator"));
    assert!(!set.variants[1].externals.contains_key("calibrator"));
    let set = load(&["calibrator.pairs.input=q"], LoadOptions::default()).expect("loaded");
    assert_eq!(
        (set.externals["pairs.input"].clone(), set.externals["pairs.target"].clone()),
        (Ok("q".into()), Ok("dir/b".into()))
    );
    assert_eq!(set.named["pairs.input"], "--set calibrator.pairs.input");
    let pairs = Some(("in".into(), "out".into()));
    let given = load(&[], LoadOptions { pairs, ..LoadOptions::default() }).expect("loaded");
    assert_eq!(
        (given.externals["pairs.target"].clone(), given.named["pairs.target"].as_str()),
        (Ok("out".into()), "--pairs")
    );
    let calibrator = Some("g.safetensors".into());
    let given = load(&[], LoadOptions { calibrator, ..LoadOptions::default() }).expect("loaded");
    assert_eq!(given.externals["calibrator"], Ok("g.safetensors".into()));
    let set = load(&["scene.own.calibrator.file=h.pth"], LoadOptions::default()).expect("loaded");
    assert_eq!(set.scenes[1].externals["calibrator"], Ok("h.pth".into()));
    let set = load(&["variant.plain.calibrator.file=i.pth"], LoadOptions::default()).expect("loaded");
    assert_eq!(set.variants[0].externals["calibrator"], Ok("i.pth".into()));

    for (set, expected) in [
        ("calibrator.pair.input=a", "calibrator.pairs.input, calibrator.pairs.target, calibrator.file"),
        ("calibrate.input=a", "give it with `calibrator.pairs.input`"),
    ] {
        let error = load(&[set], LoadOptions::default()).expect_err(set);
        assert!(error.contains(expected), "{set}: {error}");
    }
}

#[test]
fn half_of_the_pairs_is_said_at_the_pairs() {
    let load = |text: &str, sets: &[&str]| {
        let options =
            LoadOptions { sets: sets.iter().map(ToString::to_string).collect(), ..LoadOptions::default() };
        from_text(&registry(0), text, Path::new("p.toml"), &options).expect_err("half").to_string()
    };
    let scene = "[[scene]]\nname = \"a\"\ncapture = \"a\"\n";
    let error = load(&format!("name = \"x\"\n[calibrator]\npairs = {{ input = \"a\" }}\n{scene}"), &[]);
    assert!(error.starts_with("p.toml:3:9: `calibrator.pairs` needs `target`"), "{error}");
    let error = load(&format!("name = \"x\"\n{scene}"), &["calibrator.pairs.input=a"]);
    assert!(error.contains("`calibrator.pairs.input` needs `calibrator.pairs.target` beside it"), "{error}");
    let both = format!(
        "name = \"x\"\n[calibrator]\nfile = \"c\"\npairs = {{ input = \"a\", target = \"b\" }}\n{scene}"
    );
    let error = load(&both, &[]);
    assert!(error.contains("give only one of them"), "{error}");
}

#[test]
fn words_about_learning_beside_a_finished_calibrator_are_refused() {
    let table = || {
        Registry::new(super::stages::stages(0), code())
            .expect("a table")
            .shorthand("calibrator", "proposer", "calibrate", "proposer")
            .shorthand("calibrator", "proposer", "targets", "proposer")
            .shorthand("calibrator", "strength", "calibrate", "strength")
    };
    let load = |calibrator: &str, sets: &[&str], finished: Option<&str>| {
        let text =
            format!("name = \"x\"\n[calibrator]\n{calibrator}\n[[scene]]\nname = \"a\"\ncapture = \"a\"\n");
        let options = LoadOptions {
            sets: sets.iter().map(ToString::to_string).collect(),
            calibrator: finished.map(Into::into),
            ..LoadOptions::default()
        };
        from_text(&table(), &text, Path::new("p.toml"), &options).map(|_| ()).map_err(|e| e.to_string())
    };
    let pairs = "pairs = { input = \"a\", target = \"b\" }";
    let error = load("file = \"c\"\nstrength = 3", &[], None).expect_err("no effect");
    assert!(error.starts_with("p.toml:4:1: `file` is a finished calibrator"), "{error}");
    assert!(error.contains("`strength` has no effect"), "{error}");
    let error = load("file = \"c\"", &["calibrator.strength=3"], None).expect_err("no effect");
    assert!(error.contains("--set calibrate.strength: `calibrator.file` in p.toml names"), "{error}");
    let error = load(pairs, &["calibrate.strength=3"], Some("d")).expect_err("no effect");
    assert!(error.contains("--calibrator names"), "{error}");
    let error = load("file = \"c\"\n[defaults.calibrate]\nstrength = 3", &[], None).expect_err("no effect");
    assert!(error.contains("[defaults.calibrate] has no effect"), "{error}");
    assert_eq!(load(&format!("{pairs}\n[defaults.calibrate]\nstrength = 3"), &[], None), Ok(()));
    // Settings for the file's own pairs are kept for other runs; the proposer is needed in any case.
    assert_eq!(load(&format!("{pairs}\nstrength = 3"), &[], Some("d")), Ok(()));
    assert_eq!(load(&format!("{pairs}\nstrength = 3"), &["calibrator.strength=4"], None), Ok(()));
    assert_eq!(load("file = \"c\"\nproposer = \"fusion\"", &[], None), Ok(()));
}

#[test]
fn nothing_is_computed_for_scenes_that_have_failed() {
    let dir = tempfile::tempdir().expect("folder");
    let mut batch = batch(&dir.path().join("data"), &["reef", "wall"]);
    let builder = builder(&dir.path().join("cache"));
    let options = RunOptions { keep_going: true, ..RunOptions::default() };
    for scene in &mut batch.scenes {
        scene.name_external("capture", Ok(dir.path().join("typo")), "the command line");
    }
    let (summary, ran, ..) = run_with(&builder, &batch, &options);
    assert_eq!(summary.exit_code(), 1);
    assert!(!ran.contains(&"calibrate".to_string()), "{ran:?}");
    // A single scene that can be computed is enough to run the shared stage.
    batch.scenes[1].name_external("capture", Ok(dir.path().join("data/wall")), "the command line");
    let (summary, ran, ..) = run_with(&builder, &batch, &options);
    assert_eq!(summary.exit_code(), 1);
    assert!(ran.contains(&"calibrate".to_string()), "{ran:?}");
}

#[test]
fn a_finished_artifact_stands_in_for_its_stage_where_it_is_named() {
    let dir = tempfile::tempdir().expect("folder");
    let file = dir.path().join("calibrator.bin");
    fs::write(&file, "finished").expect("file");
    let mut batch = batch(&dir.path().join("data"), &["a", "b"]);
    let builder = builder_with(&dir.path().join("cache"));
    let started = |batch: &Batch| {
        let (summary, started, _) = run(&builder, batch);
        assert_eq!(summary.exit_code(), 0, "{summary}");
        started
    };
    // One scene has its own calibrator: the other one still needs the stage.
    batch.scenes[0].name_external("calibrator", Ok(file.clone()), "`calibrator.file` of scene a");
    assert_eq!(started(&batch), ["a · targets", "b · targets", "calibrate", "report"]);
    // Both scenes have their own: the stage is not needed, and the result for the first one is reused because
    // the file's content is the same.
    batch.scenes[1].name_external("calibrator", Ok(file.clone()), "`calibrator.file` of scene b");
    assert_eq!(started(&batch), ["b · targets", "report"]);
    // A calibrator named for all scenes also serves the report. Its content counts, not its path.
    batch.scenes.iter_mut().for_each(|s| s.externals.retain(|name, _| name == "capture"));
    fs::rename(&file, dir.path().join("moved.bin")).expect("moved");
    batch.name_external("calibrator", Ok(dir.path().join("moved.bin")), "--calibrator");
    assert_eq!(started(&batch), ["report"]);
    assert!(started(&batch).is_empty());
    batch.name_external("calibrator", Ok(dir.path().join("gone.bin")), "--calibrator");
    let graph = Graph::new(&builder.registry, &batch).expect("graph");
    let plan = builder.plan(&graph, None);
    assert_eq!(plan.nodes.iter().filter(|n| matches!(n.state, State::Unavailable(_))).count(), 3);
}

#[test]
fn a_variant_may_read_a_finished_calibrator_of_its_own() {
    let dir = tempfile::tempdir().expect("folder");
    let (own, theirs) = (dir.path().join("own.bin"), dir.path().join("theirs.bin"));
    fs::write(&own, "own").expect("file");
    fs::write(&theirs, "theirs").expect("file");
    let mut batch = batch(&dir.path().join("data"), &["a", "b"]);
    batch.variants = ["made", "read"].map(|name| Variant { name: name.into(), ..Variant::default() }).into();
    batch.variants[1].name_external("calibrator", Ok(theirs), "`calibrator.file` of variant read");
    let builder = builder_with(&dir.path().join("cache"));
    let graph = Graph::new(&builder.registry, &batch).expect("graph");
    let reads = |graph: &Graph, scene: &str, variant: &str| {
        let node = graph.find(scene, variant, "targets").expect("targets");
        let plan = builder.plan(graph, None);
        (plan.nodes[node].state.clone(), plan.nodes[node].key)
    };
    // Only the variant that learns needs the stage.
    let made = graph.nodes.iter().filter(|n| n.stage_name == "calibrate").map(|n| n.variant.as_str());
    assert_eq!(made.collect::<Vec<_>>(), ["made"]);
    let (summary, started, _) = run(&builder, &batch);
    assert_eq!(summary.exit_code(), 0, "{summary}");
    assert!(started.contains(&"a · made · targets".into()) && started.contains(&"a · read · targets".into()));
    // The variant's file overrides a scene's.
    let before = reads(&graph, "a", "read");
    batch.scenes[0].name_external("calibrator", Ok(own), "`calibrator.file` of scene a");
    let graph = Graph::new(&builder.registry, &batch).expect("graph");
    assert_eq!(reads(&graph, "a", "read"), before);
    assert!(matches!(reads(&graph, "a", "made").0, State::Run(_)), "it reads the scene's now");
    // The message for a missing file contains the variant's name.
    batch.variants[1].name_external(
        "calibrator",
        Ok(dir.path().join("gone")),
        "`calibrator.file` of variant read",
    );
    let graph = Graph::new(&builder.registry, &batch).expect("graph");
    let State::Unavailable(why) = reads(&graph, "b", "read").0 else { panic!("it is not there") };
    assert!(why.contains("of variant read") && why.contains("gone does not exist"), "{why}");
}

/// A small table in which `targets` and `report` read a calibrator, made or given.
fn builder_with(cache: &Path) -> Builder {
    let write = |context: &StageContext, p: &Strength| {
        let read: Vec<&str> = context.inputs().iter().map(|i| i.role.as_str()).collect();
        Ok(fs::write(context.output().join("read.txt"), format!("{read:?} {}", p.strength))?)
    };
    let stages = vec![
        Stage::new("calibrate", Scope::Shared, write).when_named(|_, named| !named.has("calibrator")),
        Stage::new("targets", Scope::Scene, write)
            .external("capture", "capture")
            .input("calibrator", "calibrate")
            .or_external("calibrator"),
        Stage::new("report", Scope::Batch, write)
            .input("targets", "targets")
            .input("calibrator", "calibrate")
            .or_external("calibrator"),
    ];
    Builder::new(Registry::new(stages, code()).expect("a table"), Cache::open(cache, false).expect("a cache"))
}
