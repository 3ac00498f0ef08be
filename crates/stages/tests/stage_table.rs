//! The real table of stages: the content of its keys, and what they leave out.
//!
//! The builder is tested on stages of its own. This file tests that the real table describes itself
//! correctly.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde_json::{Value, json};
use use3d_stages::code::{RULES, built_in};
use use3d_stages::registry;
use use3d_workflow::code::CodeTable;
use use3d_workflow::{
    Batch, BatchScene, Builder, Cache, Graph, Listener, Registry, RunOptions, Silent, Variant,
};

fn table() -> Registry {
    registry().expect("the stage table")
}

/// Modules of the crate of the stages that write no byte of an artifact: the users of the build system.
const WITHOUT_ARTIFACTS: [&str; 6] =
    ["src/lib.rs", "src/code.rs", "src/engines/", "src/parts/mod.rs", "src/planning/", "build.rs"];

/// Without this agreement, a scene that a card has drawn would count as damaged on another machine.
#[test]
fn every_stage_that_may_use_a_card_says_how_its_artifacts_agree_with_the_processors() {
    let table = table();
    let on_cards: Vec<&str> =
        table.stages().iter().filter(|stage| stage.device.is_some()).map(|stage| stage.name()).collect();
    assert_eq!(on_cards, ["reconstruct", "targets", "enhance", "render", "evaluate"]);
    for stage in table.stages() {
        assert_eq!(stage.agreement.is_some(), stage.device.is_some() || stage.varies, "{}", stage.name());
    }
}

#[test]
fn every_stage_is_made_of_the_files_it_uses_and_of_no_others() {
    let table = table();
    let has = |stage: &str, code: &str| table.code_of(stage).expect("a stage").ours.contains_key(code);
    for stage in table.stages() {
        let name = stage.name();
        assert!(has(name, &format!("src/{name}.rs")), "{name}");
        // An edit of the table or of another stage's own file must not make hours of training stale.
        assert!(!has(name, "src/lib.rs"), "{name}");
    }
    for (stage, used) in [
        ("import", "src/parts/files.rs"),
        ("reconstruct", "src/parts/files.rs"),
        ("reconstruct", "src/parts/contact_sheet.rs"),
        ("reconstruct", "use3d-medium"),
        ("enhance", "use3d-chart"),
        ("enhance", "src/parts/proposer.rs"),
        ("enhance", "use3d-ubaf"),
        ("evaluate", "use3d-judge"),
        ("evaluate", "use3d-metrics"),
        ("evaluate", "use3d-render"),
        ("render", "use3d-render"),
        ("photographs", "use3d-photographs"),
        ("report", "use3d-report"),
    ] {
        assert!(has(stage, used), "{stage} is not made of {used}");
    }
    for (stage, unused) in [
        ("import", "use3d-splat"),
        ("import", "use3d-scene"),
        ("calibrate", "use3d-synth"),
        ("calibrate", "use3d-scene"),
        ("calibrate", "use3d-nets"),
        ("calibrate", "src/parts/proposer.rs"),
        ("reconstruct", "use3d-atc"),
        ("reconstruct", "use3d-nets"),
        ("reconstruct", "use3d-enhance"),
        ("reconstruct", "use3d-synth"),
        ("targets", "use3d-reconstruct"),
        ("enhance", "use3d-reconstruct"),
        // The words and the layout of the report are no part of a training or of scores.
        ("enhance", "use3d-report"),
        ("evaluate", "use3d-report"),
        // The way pictures are drawn is no part of a training, and the course of training is no part of
        // pictures of a scene.
        ("reconstruct", "use3d-render"),
        ("targets", "use3d-render"),
        ("targets", "use3d-enhance"),
        ("enhance", "use3d-render"),
        ("render", "use3d-atc"),
        ("render", "use3d-training"),
        ("render", "use3d-reconstruct"),
        ("render", "use3d-enhance"),
        ("evaluate", "use3d-reconstruct"),
        ("evaluate", "use3d-enhance"),
        // The code that decides if a stage runs is no part of its result.
        ("import", "use3d-workflow"),
        ("report", "use3d-workflow"),
    ] {
        assert!(!has(stage, unused), "{stage} needs not be made of {unused}");
    }
    assert!(table.code_of("report").expect("a stage").third_party.contains_key("askama"));
    // Every new file of this crate belongs to a stage, or is known to write no artifact.
    let reached: BTreeSet<&str> = table
        .stages()
        .iter()
        .flat_map(|s| table.code_of(s.name()).expect("a stage").ours.keys())
        .map(String::as_str)
        .collect();
    let forgotten: Vec<&str> = built_in()
        .files()
        .filter(|file| {
            !reached.contains(file) && !WITHOUT_ARTIFACTS.iter().any(|known| file.starts_with(known))
        })
        .collect();
    assert!(forgotten.is_empty(), "no stage is made of {forgotten:?}");
}

/// Copies the files that the digests are made of.
fn copy_tree(to: &Path) -> BTreeMap<String, Vec<PathBuf>> {
    let here = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let mut sources: BTreeMap<String, Vec<PathBuf>> = BTreeMap::new();
    for file in ["Cargo.toml", "Cargo.lock"] {
        std::fs::copy(here.join(file), to.join(file)).expect("copied");
    }
    for entry in std::fs::read_dir(here.join("crates")).expect("crates").map(|e| e.expect("entry")) {
        let name = entry.file_name().to_string_lossy().into_owned();
        for part in ["src", "Cargo.toml", "build.rs", "templates"] {
            for file in walkdir::WalkDir::new(entry.path().join(part)).into_iter().filter_map(Result::ok) {
                if file.file_type().is_file() {
                    let relative = file.path().strip_prefix(&here).expect("below");
                    let target = to.join(relative);
                    std::fs::create_dir_all(target.parent().expect("a folder")).expect("folder");
                    std::fs::copy(file.path(), &target).expect("copied");
                    let counts = file.path().extension().is_some_and(|e| e == "rs" || e == "html");
                    if counts && part != "build.rs" {
                        sources.entry(name.clone()).or_default().push(target);
                    }
                }
            }
        }
    }
    sources
}

/// Adds one token to every file of the workspace in turn (one file of every crate at a time): exactly the
/// stages whose code reaches the file become stale.
#[test]
fn a_token_in_any_file_makes_every_stage_stale_that_reaches_it() {
    let dir = tempfile::tempdir().expect("folder");
    let sources = copy_tree(dir.path());
    let read = || CodeTable::of_tree(dir.path(), RULES).expect("digests");
    let stages = table();
    let code = |table: &CodeTable| Registry::new(stages.stages().to_vec(), table).expect("a table");
    let before = code(&read());
    let below = |file: &Path, krate: &str| -> String {
        let folder = dir.path().join("crates").join(krate);
        file.strip_prefix(folder).expect("below").to_string_lossy().into_owned()
    };
    // A crate counts as a whole, so one of its files is changed at a time. Files of the crate of the stages
    // count one by one, and a crate that no stage reaches has nothing to miss. So all of them change at once.
    let reaches = |krate: &str| {
        let key = format!("use3d-{krate}");
        stages.stages().iter().any(|s| before.code_of(s.name()).expect("a stage").ours.contains_key(&key))
    };
    let rounds = sources.iter().filter(|(krate, _)| reaches(krate)).map(|(_, files)| files.len()).max();
    let mut of_no_stage = Vec::new();
    for round in 0..rounds.expect("crates of stages") {
        let mut changed = Vec::new();
        for (krate, files) in &sources {
            let now = match (reaches(krate), round) {
                (false, 0) => files.as_slice(),
                (false, _) => &[],
                (true, _) => files.get(round..=round).unwrap_or_default(),
            };
            for file in now {
                let text = std::fs::read_to_string(file).expect("text");
                let is_rust = file.extension().is_some_and(|e| e == "rs");
                let token = if is_rust { "\nconst _ADDED: u8 = 1;\n" } else { "<hr>" };
                std::fs::write(file, format!("{text}{token}")).expect("written");
                changed.push((krate.clone(), below(file, krate), file, text));
            }
        }
        let after = code(&read());
        for (krate, file, _, _) in &changed {
            let key = if krate == "stages" { file.clone() } else { format!("use3d-{krate}") };
            let mut reached = false;
            for stage in stages.stages() {
                let of = |table: &Registry| table.code_of(stage.name()).expect("a stage").clone();
                let (old, new) = (of(&before), of(&after));
                if old.ours.contains_key(&key) {
                    reached = true;
                    let stale = old.ours.get(&key) != new.ours.get(&key) && old.digest() != new.digest();
                    assert!(stale || is_test_file(file), "{}: {krate}/{file}", stage.name());
                }
            }
            if !reached && !is_test_file(file) {
                of_no_stage.push(format!("{krate}/{file}"));
            }
        }
        // The code that no stage reaches is not read again in every round.
        for (krate, _, file, text) in changed {
            let text = if reaches(&krate) { text } else { String::new() };
            std::fs::write(file, text).expect("written");
        }
    }
    // The command, test support, the build system, and the modules without artifacts; no file of a stage.
    let known = |path: &String| {
        let (krate, file) = path.split_once('/').expect("a crate");
        match krate {
            // The numeric class covers the results of a graphics card: it contains the digest of the kernels.
            "cli" | "config" | "pipeline" | "cluster" | "code" | "golden" | "workflow" | "store" | "web"
            | "viewer" | "gpu" => true,
            // They end before the first stage: one makes captures, the other only speaks about them.
            "prepare" | "check" => true,
            // It only reads results.
            "lab" => true,
            "stages" => WITHOUT_ARTIFACTS.iter().any(|known| file.starts_with(known)),
            _ => false,
        }
    };
    of_no_stage.retain(|path| !known(path));
    assert!(of_no_stage.is_empty(), "{of_no_stage:?}");
}

/// The stages that one more token in a file makes stale.
fn stale_after(file: &str) -> Vec<&'static str> {
    let dir = tempfile::tempdir().expect("folder");
    copy_tree(dir.path());
    let stages = table();
    let code = || {
        let read = CodeTable::of_tree(dir.path(), RULES).expect("digests");
        let table = Registry::new(stages.stages().to_vec(), &read).expect("a table");
        let digest = |name| table.code_of(name).expect("a stage").digest();
        stages.stages().iter().map(|s| (s.name(), digest(s.name()))).collect::<BTreeMap<_, _>>()
    };
    let before = code();
    let path = dir.path().join(file);
    let text = std::fs::read_to_string(&path).expect(file);
    std::fs::write(&path, format!("{text}\nconst _ADDED: u8 = 1;\n")).expect("written");
    let after = code();
    let stale = stages.stages().iter().map(|s| s.name()).filter(|name| before[name] != after[name]);
    stale.collect()
}

#[test]
fn an_edit_of_the_calibrator_leaves_trained_scenes_and_their_pictures_as_they_are() {
    let stale = stale_after("crates/atc/src/calibrator/mod.rs");
    assert!(["calibrate", "targets", "enhance"].iter().all(|s| stale.contains(s)), "{stale:?}");
    assert!(["import", "reconstruct", "render"].iter().all(|s| !stale.contains(s)), "{stale:?}");
}

#[test]
fn an_edit_of_the_colour_maps_trains_nothing_anew() {
    let drawn = ["photographs", "render", "baseline", "evaluate", "report"];
    assert_eq!(stale_after("crates/render/src/pictures.rs"), drawn);
}

/// True if a file holds only tests, by the project's names for such files.
fn is_test_file(file: &str) -> bool {
    ["tests.rs", "golden.rs", "test_support.rs", "test_plain.rs"].iter().any(|name| file.ends_with(name))
        || file.contains("/tests/")
}

#[test]
fn parameters_without_effect_are_in_no_key_and_the_log_is() {
    let table = table();
    for (stage, changed, counts) in [
        ("reconstruct", json!({"checkpoint_minutes": 0.5}), false),
        ("reconstruct", json!({"checkpoint_steps": 7}), false),
        // The numeric class covers the choice of the engine.
        ("reconstruct", json!({"engine": "auto"}), false),
        ("enhance", json!({"engine": "auto"}), false),
        ("targets", json!({"engine": "auto"}), false),
        ("render", json!({"engine": "auto"}), false),
        ("evaluate", json!({"engine": "auto"}), false),
        ("enhance", json!({"checkpoint_every": 7}), false),
        ("enhance", json!({"cache_mib": 7}), false),
        ("pairs", json!({"extractor": {"cells": 8}}), true),
        // The training log is part of the artifact.
        ("reconstruct", json!({"log_every": 7}), true),
        ("enhance", json!({"log_every": 7}), true),
        ("reconstruct", json!({"evaluate_every": 7}), true),
    ] {
        let stage = table.stage(stage).expect("a stage");
        let of = |given: &Value| stage.key_parameters(&stage.parameters(given).expect("parameters"));
        assert_eq!(of(&json!({})) != of(&changed), counts, "{changed}");
    }
}

/// Collects the dotted paths of the values in some parameters.
fn leaves(value: &Value, place: &str, found: &mut BTreeSet<String>) {
    match value {
        Value::Object(fields) => {
            for (key, inner) in fields {
                leaves(inner, &if place.is_empty() { key.clone() } else { format!("{place}.{key}") }, found);
            }
        }
        _ => {
            found.insert(place.to_string());
        }
    }
}

/// The words in backticks.
fn code_words(text: &str) -> impl Iterator<Item = &str> {
    text.split('`').skip(1).step_by(2)
}

/// The default values of all parameters whose path ends with a name.
fn defaults_named(table: &Registry, name: &str) -> Vec<Value> {
    let mut found = Vec::new();
    for stage in table.stages() {
        let defaults = Value::clone(stage.parameters(&json!({})).expect("defaults").json());
        let mut paths = BTreeSet::new();
        leaves(&defaults, "", &mut paths);
        for path in paths {
            let whole = format!("{}.{path}", stage.name());
            if path == name || whole == name || path.ends_with(&format!(".{name}")) {
                found.push(path.split('.').fold(defaults.clone(), |value, key| value[key].clone()));
            }
        }
    }
    found
}

/// A row's switch differs from the default, and the value that a row calls the default is the default (R44
/// once said otherwise).
#[test]
fn the_page_of_decisions_tells_defaults_from_switches() {
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/science/decisions.md");
    let page = std::fs::read_to_string(page).expect("docs/science/decisions.md");
    let rows = &page;
    let table = table();
    let same = |found: &Value, said: &Value| match (found.as_f64(), said.as_f64()) {
        (Some(found), Some(said)) => found == said,
        _ => found == said,
    };
    let mut compared = 0;
    for row in rows.lines().filter(|l| l.starts_with("| R")) {
        let (answer, switches) = row.trim_end_matches(" |").rsplit_once(" | ").expect("columns");
        let mut check = |text: &str, is_default: bool| {
            let Some((name, value)) = text.split_once('=') else { return };
            let value: Value = serde_json::from_str(value.trim()).unwrap_or_else(|_| panic!("{text}: {row}"));
            let found = defaults_named(&table, name.trim());
            assert!(!found.is_empty(), "{text} is no parameter: {row}");
            assert!(found.iter().any(|f| same(f, &value)) == is_default, "{text} and {found:?}: {row}");
            compared += 1;
        };
        code_words(switches).for_each(|switch| check(switch, false));
        let parts: Vec<&str> = answer.split("`, the default").collect();
        for part in parts.iter().take(parts.len() - 1) {
            check(part.rsplit('`').next().unwrap_or_default(), true);
        }
    }
    assert!(compared >= 12, "{compared}");
}

#[test]
fn the_switches_of_decisions_are_parameters() {
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/science/decisions.md");
    let page = std::fs::read_to_string(page).expect("docs/science/decisions.md");
    let mut all = BTreeSet::new();
    for stage in table().stages() {
        let mut there = BTreeSet::new();
        leaves(stage.parameters(&json!({})).expect("defaults").json(), "", &mut there);
        all.extend(there.iter().map(|path| format!("{}.{path}", stage.name())));
        all.extend(there);
    }
    // The switches of the rows are parameters of a stage, or of the pipeline file itself.
    let of_the_file = ["seed", "calibrator.pairs", "calibrator.file", "pairs"];
    for row in page.lines().filter(|l| l.starts_with("| R")) {
        let switches = row.trim_end_matches(" |").rsplit(" | ").next().unwrap_or_default();
        for switch in code_words(switches) {
            let name = switch.split('=').next().unwrap_or_default().trim();
            let known = all
                .iter()
                .any(|p| p == name || p.ends_with(&format!(".{name}")) || p.starts_with(&format!("{name}.")));
            assert!(known || of_the_file.contains(&name), "`{switch}` is no parameter: {row}");
        }
    }
}

#[test]
fn one_seed_moves_every_stage_that_draws() {
    let table = table();
    let seeded: Vec<&str> = table.stages().iter().filter(|s| s.seeded).map(|s| s.name()).collect();
    assert_eq!(seeded, ["calibrate", "reconstruct", "targets", "enhance"]);
    // No stage has a seed of its own.
    fn seeds(value: &Value, place: &str, found: &mut Vec<String>) {
        for (key, inner) in value.as_object().into_iter().flatten() {
            if key == "seed" {
                found.push(format!("{place}.{key}"));
            }
            seeds(inner, &format!("{place}.{key}"), found);
        }
    }
    let mut found = Vec::new();
    for stage in table.stages() {
        seeds(stage.parameters(&json!({})).expect("defaults").json(), stage.name(), &mut found);
    }
    assert!(found.is_empty(), "{found:?}");
    // A variant with another seed shares with the others only the stages that draw no random numbers. The
    // batch has a calibrator, so that all stages are present.
    let mut batch = Batch { name: "two".into(), seed: 42, ..Batch::default() };
    batch.defaults.insert("targets".into(), json!({"calibrated": true}));
    let capture = Ok(PathBuf::from("/capture"));
    batch.scenes.push(BatchScene {
        name: "reef".into(),
        externals: [("capture".into(), capture)].into(),
        ..BatchScene::default()
    });
    batch.variants = vec![
        Variant { name: "full".into(), ..Variant::default() },
        Variant { name: "seed-7".into(), seed: Some(7), ..Variant::default() },
    ];
    let graph = Graph::new(&table, &batch).expect("a graph");
    let other = |n: &&use3d_workflow::graph::Node| n.variant == "seed-7";
    let shared: Vec<&str> =
        graph.nodes.iter().filter(other).filter(|n| n.same_as.is_some()).map(|n| n.stage_name).collect();
    assert_eq!(&shared[..2], ["pairs", "import"]);
    // These draw random numbers, or follow a stage that does.
    for drawn in ["calibrate", "reconstruct", "targets", "enhance", "render", "evaluate"] {
        assert!(!shared.contains(&drawn), "{shared:?}");
    }
    assert!(graph.nodes.iter().filter(other).count() >= 7);
}

fn run(cache: &Path, capture: &Path, parameters: &[(&str, Value)]) -> (Vec<String>, usize) {
    let builder = Builder::new(table(), Cache::open(cache, false).expect("a cache"));
    let mut batch = Batch { name: "tiny".into(), seed: 42, ..Batch::default() };
    let externals = [("capture".into(), Ok(capture.to_path_buf()))].into();
    batch.scenes.push(BatchScene { name: "reef".into(), externals, ..BatchScene::default() });
    batch.defaults.insert("reconstruct".into(), json!({"iterations": 3, "schedule": 3}));
    for (stage, value) in parameters {
        batch.forced.insert((*stage).into(), value.clone());
    }
    let graph = Graph::new(&builder.registry, &batch).expect("a graph");
    let listener: Arc<dyn Listener> = Arc::new(Silent);
    let options = RunOptions { until: Some(vec!["reconstruct".into()]), ..RunOptions::default() };
    let summary = builder.run(&graph, &options, &listener);
    assert_eq!(summary.exit_code(), 0, "{summary}");
    let keys = ["import", "reconstruct"].map(|stage| {
        let path = summary.artifact("reef", "", stage).expect("it ran").path.clone();
        path.file_name().expect("a key").to_string_lossy().into_owned()
    });
    (keys.to_vec(), summary.done())
}

#[test]
fn forecasts_of_memory_follow_the_size_of_the_pictures_and_change_no_key() {
    let dir = tempfile::tempdir().expect("folder");
    let planned = |side: usize| {
        let capture = dir.path().join(format!("capture-{side}"));
        let params = use3d_synth::CaptureParams {
            views: 9,
            width: side,
            height: side * 3 / 4,
            points: 200,
            detail: 0.1,
            ..use3d_synth::CaptureParams::default()
        };
        use3d_synth::write_capture(&params, &capture, &mut |_, _| ()).expect("a capture");
        let builder = Builder::new(table(), Cache::open(&dir.path().join("cache"), false).expect("a cache"));
        let mut batch = Batch { name: "sizes".into(), seed: 42, ..Batch::default() };
        let externals = [("capture".into(), Ok(capture))].into();
        batch.scenes.push(BatchScene { name: format!("reef-{side}"), externals, ..BatchScene::default() });
        let graph = Graph::new(&builder.registry, &batch).expect("a graph");
        let of = |plan: &use3d_workflow::Plan| -> BTreeMap<&'static str, Option<u64>> {
            plan.nodes.iter().map(|n| (n.stage, n.memory)).collect()
        };
        let before = of(&builder.plan(&graph, None));
        let options = RunOptions { until: Some(vec!["import".into()]), ..RunOptions::default() };
        let summary = builder.run(&graph, &options, &(Arc::new(Silent) as Arc<dyn Listener>));
        assert_eq!(summary.exit_code(), 0, "{summary}");
        (before, of(&builder.plan(&graph, None)))
    };
    let ((before, small), (_, large)) = (planned(64), planned(256));
    for stage in ["reconstruct", "targets", "enhance", "photographs", "render", "evaluate"] {
        // Before the import nothing is known of the pictures. After it, larger ones need more memory.
        assert_eq!(before[stage], None, "{stage}");
        let [small, large] = [&small, &large].map(|plan| plan[stage].expect("a forecast"));
        assert!(large > small, "{stage}: {large} after {small}");
        assert!((32 << 20..1 << 30).contains(&small), "{stage}: {small}");
    }
    assert_eq!(small["import"], None, "it is made");
}

/// All files of the artifacts in a cache except their manifests, which contain times and hosts.
fn payload(cache: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let artifacts = cache.join("v1/artifacts");
    let files = walkdir::WalkDir::new(&artifacts).into_iter().map(|e| e.expect("entry"));
    files
        .filter(|e| e.file_type().is_file() && e.file_name() != "manifest.json")
        .map(|e| {
            (
                e.path().strip_prefix(&artifacts).expect("below").to_path_buf(),
                std::fs::read(e.path()).expect("file"),
            )
        })
        .collect()
}

#[test]
fn a_capture_under_another_name_with_other_things_beside_it_has_the_same_keys_and_bytes() {
    let dir = tempfile::tempdir().expect("folder");
    let (reef, copy) = (dir.path().join("reef"), dir.path().join("Other name"));
    let params =
        use3d_synth::CaptureParams { views: 5, width: 40, height: 32, detail: 0.12, ..Default::default() };
    use3d_synth::write_capture(&params, &reef, &mut |_, _| {}).expect("a capture");
    let files: Vec<_> = walkdir::WalkDir::new(&reef).into_iter().map(|e| e.expect("entry")).collect();
    for file in files.iter().filter(|e| e.file_type().is_file()) {
        let target = copy.join(file.path().strip_prefix(&reef).expect("below"));
        std::fs::create_dir_all(target.parent().expect("a folder")).expect("folder");
        std::fs::copy(file.path(), target).expect("copied");
    }
    // Adds a smaller model and another image folder; neither is used.
    for (from, to) in [("sparse/0", "colmap/sparse/0"), ("images", "images_wb")] {
        std::fs::create_dir_all(copy.join(to)).expect("folder");
        for file in std::fs::read_dir(reef.join(from)).expect("files").map(|e| e.expect("entry")) {
            std::fs::copy(file.path(), copy.join(to).join(file.file_name())).expect("copied");
        }
    }
    // Adds a photograph that the model does not name, to the folder of those that it names.
    std::fs::copy(copy.join("images/frame_0001.png"), copy.join("images/not_in_the_model.png"))
        .expect("copied");
    let caches = [dir.path().join("a"), dir.path().join("b")];
    let (keys, done) = run(&caches[0], &reef, &[]);
    assert!(done >= 2);
    assert_eq!(run(&caches[1], &copy, &[]).0, keys);
    let (first, second) = (payload(&caches[0]), payload(&caches[1]));
    assert!(first.len() > 10 && first.keys().eq(second.keys()));
    for (file, bytes) in &first {
        assert!(second[file] == *bytes, "{} differs", file.display());
    }

    // The interval between checkpoints reruns nothing.
    let often = json!({"iterations": 3, "schedule": 3, "checkpoint_steps": 1, "checkpoint_minutes": 0.1});
    assert_eq!(run(&caches[0], &reef, &[("reconstruct", often)]), (keys, 0));
}
