//! The pipeline files that come with the project, read for the real stages; and the schema of such files.

use std::path::Path;

use use3d_config::{LoadOptions, Pipeline, from_text, load, parameters, presets, shipped, shipped_names};
use use3d_stages::registry;
use use3d_workflow::Graph;

/// A pipeline that comes with the program.
fn part(name: &str) -> Pipeline {
    let text = shipped(name).expect("a shipped pipeline");
    let registry = registry().expect("the stage table");
    let file = Path::new(name).with_extension("toml");
    from_text(&registry, &text, &file, &LoadOptions::default()).unwrap_or_else(|e| panic!("{e}"))
}

#[test]
fn every_shipped_pipeline_fits_the_stages() {
    let registry = registry().expect("the stage table");
    for name in shipped_names() {
        let graph = Graph::new(&registry, &part(name).batch).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert!(!graph.nodes.is_empty());
    }
}

#[test]
fn a_scene_learnt_from_proposals_has_no_second_stage() {
    let registry = registry().expect("the stage table");
    let pipeline = part("ablation-stage2");
    let graph = Graph::new(&registry, &pipeline.batch).expect("a graph");
    let stages = |variant: &str| -> Vec<&str> {
        let nodes = graph.nodes.iter().filter(|n| n.scene == "Panama" && n.variant == variant);
        nodes.map(|n| n.stage_name).collect()
    };
    let without = stages("enhance-then-reconstruct");
    let second = ["targets", "enhance"];
    assert!(without.contains(&"propose") && !without.iter().any(|s| second.contains(s)), "{without:?}");
    let full = stages("full");
    assert!(full.contains(&"enhance") && !full.contains(&"propose"), "{full:?}");
}

/// A calibrator is made only if a scene's targets are calibrated.
#[test]
fn without_calibration_there_are_neither_pairs_nor_a_calibrator() {
    use use3d_config::for_capture;

    let registry = registry().expect("the stage table");
    let dir = tempfile::tempdir().expect("folder");
    let reef = dir.path().join("reef");
    std::fs::create_dir(&reef).expect("folder");
    let graph = |sets: &[&str]| {
        let sets = sets.iter().map(ToString::to_string).collect();
        let options = LoadOptions { sets, ..LoadOptions::default() };
        let pipeline = for_capture(&registry, &reef, &options).unwrap_or_else(|e| panic!("{e}"));
        Graph::new(&registry, &pipeline.batch).expect("a graph")
    };
    let stages = |graph: &Graph| -> Vec<&str> { graph.nodes.iter().map(|n| n.stage_name).collect() };
    let calibrated = stages(&graph(&["targets.calibrated=true"]));
    assert!(calibrated.contains(&"pairs") && calibrated.contains(&"calibrate"), "{calibrated:?}");
    for words in [&[][..], &["targets.source=photographs"], &["targets.source=clear"]] {
        let own = stages(&graph(words));
        assert!(!own.contains(&"pairs") && !own.contains(&"calibrate"), "{words:?}: {own:?}");
        assert!(own.contains(&"targets") && own.contains(&"enhance"), "{words:?}: {own:?}");
    }

    // Only one of two scenes is calibrated: the other one needs no calibrator.
    let file = dir.path().join("p.toml");
    let text = "name = \"p\"\n[defaults.targets]\ncalibrated = true\n[[scene]]\nname = \"own\"\ncapture = \"reef\"\n[scene.targets]\ncalibrated = false\n\
                [[scene]]\nname = \"other\"\ncapture = \"reef\"\n";
    std::fs::write(&file, text).expect("written");
    let needs = |scene: &str| {
        let options = LoadOptions { scenes: vec![scene.into()], ..LoadOptions::default() };
        let pipeline = load(&registry, &file, &options).unwrap_or_else(|e| panic!("{e}"));
        let graph = Graph::new(&registry, &pipeline.batch).expect("a graph");
        let wanted = graph.wanted(Some(&["targets".into()]));
        graph.nodes.iter().zip(wanted).any(|(n, w)| w && n.stage_name == "calibrate")
    };
    assert!(needs("other") && !needs("own"));
}

#[test]
fn without_depth_is_there_as_the_authors_ran_it_and_with_the_prior_alone_off() {
    let registry = registry().expect("the stage table");
    let pipeline = part("ablation-stage1");
    let graph = Graph::new(&registry, &pipeline.batch).expect("graph");
    for (variant, prior, gradient) in [
        ("rbf-without-depth", "off", false),
        ("rbf-without-prior", "off", true),
        ("full", "depth-anything-v2", true),
    ] {
        let node = graph.find("Panama", variant, "reconstruct").expect("a node");
        let p = graph.nodes[node].parameters.json();
        let found = (p["medium"].as_str(), p["depth_prior"].as_str(), p["depth_gradient"].as_bool());
        assert_eq!(found, (Some("rbf"), Some(prior), Some(gradient)), "{variant}");
    }
}

/// The network makes a scene's depth priors if the parameters request them, or if none are next to the
/// photographs.
#[test]
fn depth_priors_are_made_where_the_weights_are_and_the_capture_has_none() {
    use use3d_config::for_capture;
    use use3d_workflow::plan::State;
    use use3d_workflow::{Builder, Cache};

    let dir = tempfile::tempdir().expect("folder");
    let at = |name: &str| {
        let path = dir.path().join(name);
        std::fs::create_dir_all(&path).expect("folder");
        path
    };
    let (bare, own, empty, small) = (at("bare"), at("own"), at("empty"), at("small"));
    at("own/depth");
    // The content of the file counts when it is read; here only its existence matters.
    std::fs::write(small.join("depth_anything_v2_vits.pth"), "weights").expect("written");
    let state = |stage: &str, capture: &Path, models: &Path, sets: &[&str]| {
        let builder =
            Builder::new(registry().expect("table"), Cache::open(&at("cache"), false).expect("cache"));
        let sets = sets.iter().map(ToString::to_string).collect();
        let options = LoadOptions { sets, models: Some(models.to_path_buf()), ..LoadOptions::default() };
        let pipeline = for_capture(&builder.registry, capture, &options).expect("a pipeline");
        let graph = Graph::new(&builder.registry, &pipeline.batch).expect("a graph");
        let plan = builder.plan(&graph, None);
        plan.nodes.into_iter().find(|n| n.stage == stage).map(|n| n.state)
    };
    let plan = |capture: &Path, models: &Path, sets: &[&str]| state("depth", capture, models, sets);
    let (asked, off) = ("reconstruct.depth_prior=depth-anything-v2", "reconstruct.depth_prior=off");
    for (capture, models, sets, made) in [
        (&bare, &small, &[][..], true),
        (&own, &small, &[], false),
        (&bare, &empty, &[], false),
        (&bare, &small, &["depth.encoder=vitl"], false),
        (&bare, &small, &[off], false),
        (&bare, &small, &["reconstruct.depth_prior=folder"], false),
        (&own, &small, &[asked], true),
        (&bare, &empty, &[asked], true),
    ] {
        assert_eq!(
            plan(capture, models, sets).is_some(),
            made,
            "{} {} {sets:?}",
            capture.display(),
            models.display()
        );
    }
    // Weights that are requested by name and missing are reported by the plan, with the file to get. (This
    // capture has a model, so that the plan reaches this point.)
    let capture = at("synthetic").join("reef");
    let params = use3d_synth::CaptureParams {
        views: 5,
        width: 64,
        height: 48,
        ..use3d_synth::CaptureParams::default()
    };
    use3d_synth::write_capture(&params, &capture, &mut |_, _| {}).expect("a capture");
    let Some(State::Unavailable(why)) = plan(&capture, &empty, &[asked, "depth.encoder=vitb"]) else {
        panic!("{:?}", plan(&capture, &empty, &[asked, "depth.encoder=vitb"]))
    };
    assert!(why.contains("put depth_anything_v2_vitb.pth there"), "{why}");
    // A proposer that is requested by name is treated the same way; a proposer without weights reads none.
    let named = ["input", "target"].map(|kind| format!("calibrator.pairs.{kind}={}", empty.display()));
    let pairs = |proposer: &str| state("pairs", &capture, &empty, &[&named[0], &named[1], proposer]);
    let Some(State::Unavailable(why)) = pairs("calibrator.proposer=nu2net") else {
        panic!("{:?}", pairs("calibrator.proposer=nu2net"))
    };
    assert!(why.contains("put uie_proposer.pth or NU2Net_ckpt.pth there"), "{why}");
    assert!(matches!(pairs("calibrator.proposer=fusion"), Some(State::Run(_))));
}

/// The dotted names of the values in a table.
fn names(value: &serde_json::Value, base: &str, into: &mut Vec<String>) {
    match value.as_object().filter(|fields| !fields.is_empty()) {
        Some(fields) => fields.iter().for_each(|(key, inner)| names(inner, &format!("{base}.{key}"), into)),
        None => into.push(base.to_string()),
    }
}

/// The list of the parameters is made from the schema, which editors read.
#[test]
fn the_schema_has_every_parameter_of_every_stage() {
    let registry = registry().expect("the stage table");
    let listed = parameters(&registry, None, None).expect("parameters");
    for (stage, listed) in registry.sections().zip(listed) {
        let (mut there, mut said) = (Vec::new(), Vec::new());
        names(stage.parameters(&serde_json::json!({})).expect("defaults").json(), stage.name(), &mut there);
        for parameter in listed.parameters {
            said.push(format!("{}.{}", listed.stage, parameter.name));
            assert!(parameter.meaning.len() > 10, "{}.{}: no meaning", listed.stage, parameter.name);
        }
        there.sort();
        said.sort();
        assert_eq!(there, said);
    }
}

/// The graph of a pipeline file with these lines, for one scene without variants unless the text lists
/// others.
fn graph_of(text: &str, sets: &[&str]) -> Result<Graph, String> {
    let registry = registry().expect("the stage table");
    let text = format!("name = \"x\"\n{text}\n[[scene]]\nname = \"a\"\ncapture = \"a\"\n");
    let sets = sets.iter().map(ToString::to_string).collect();
    let options = LoadOptions { sets, ..LoadOptions::default() };
    let pipeline = from_text(&registry, &text, Path::new("x.toml"), &options).map_err(|e| e.to_string())?;
    Graph::new(&registry, &pipeline.batch).map_err(|e| e.to_string())
}

#[test]
fn what_variants_share_follows_the_evaluation_and_has_no_settings_of_its_own() {
    let text = "models = { dir = \"m\" }\n[defaults.evaluate]\npath_pairs = 3\n[[variant]]\nname = \"v\"\n\
                evaluate = { published_clear = \"clamped\" }\n[[variant]]\nname = \"w\"\n\
                evaluate = { path_pairs = 5 }\n[[variant]]\nname = \"full\"";
    let graph = graph_of(text, &[]).unwrap();
    let of = |variant: &str| {
        let node = graph.find("a", variant, "baseline").expect("a node");
        graph.nodes[node].parameters.json().clone()
    };
    assert_eq!(of("full"), of("v"), "the clear view of a method is none of its parameters");
    assert_eq!((&of("full")["path_pairs"], &of("w")["path_pairs"]), (&3.into(), &5.into()));
    let refused = graph_of("models = { dir = \"m\" }", &["baseline.path_pairs=3"]).unwrap_err();
    assert!(refused.contains("baseline"), "{refused}");
    let refused = graph_of("models = { dir = \"m\" }\n[defaults.baseline]\npath_pairs = 3", &[]).unwrap_err();
    assert!(refused.contains("unknown key `baseline`"), "{refused}");
    assert_eq!(graph_of("", &[]).unwrap().find("a", "", "baseline"), None, "without a models folder");
}

#[test]
fn presets_are_the_weakest_layer_and_nothing_but_their_values() {
    let parameters = |graph: &Graph, variant: &str, stage: &str| {
        graph.nodes[graph.find("a", variant, stage).expect("a node")].parameters.json().clone()
    };
    let plain = graph_of("", &[]).unwrap();
    for name in presets() {
        graph_of(&format!("preset = \"{name}\""), &[]).unwrap_or_else(|e| panic!("{name}: {e}"));
    }
    // tests/paper checks the paper's values. Here they are checked to be in force and to be the weakest
    // layer.
    let paper = graph_of("preset = \"paper\"", &[]).unwrap();
    for (stage, parameter, value) in [
        ("reconstruct", "medium_prior", "off"),
        ("reconstruct", "depth_prior", "depth-anything-v2"),
        ("targets", "proposer", "nu2net"),
        ("enhance", "start", "identity"),
        ("evaluate", "scores", "all"),
    ] {
        assert_ne!(parameters(&plain, "", stage)[parameter], value, "{stage}");
        assert_eq!(parameters(&paper, "", stage)[parameter], value, "{stage}");
        let set =
            format!("{stage}.{parameter}={}", parameters(&plain, "", stage)[parameter].as_str().unwrap());
        let set = graph_of("preset = \"paper\"", &[&set]).unwrap();
        assert_eq!(parameters(&set, "", stage)[parameter], parameters(&plain, "", stage)[parameter]);
    }
    // One setting changes the 2D enhancer of the whole pipeline, but a stage's own setting overrides it.
    let enhancers = |text: &str, sets: &[&str]| {
        let graph = graph_of(text, sets).unwrap();
        ["pairs", "targets", "evaluate"].map(|stage| parameters(&graph, "", stage)["proposer"].clone())
    };
    let fusion = "targets.proposer=fusion";
    assert_eq!(enhancers("preset = \"paper\"", &[]), ["nu2net"; 3]);
    assert_eq!(enhancers("preset = \"paper\"", &[fusion]), ["fusion"; 3]);
    let own = ["targets.proposer=fusion", "evaluate.proposer=auto"];
    assert_eq!(enhancers("preset = \"paper\"", &own), ["fusion", "fusion", "auto"]);
    let file = "preset = \"paper\"\n[defaults.targets]\nproposer = \"fusion\"";
    assert_eq!(enhancers(file, &[]), ["fusion"; 3]);
    let medium = |text: &str, sets: &[&str], variant: &str| {
        parameters(&graph_of(text, sets).unwrap(), variant, "reconstruct")["medium"].clone()
    };
    let vanilla = "preset = \"vanilla\"";
    assert_eq!(medium(vanilla, &[], ""), "none");
    assert_eq!(medium("", &["preset=vanilla"], ""), "none");
    assert_eq!(medium(&format!("{vanilla}\n[defaults.reconstruct]\nmedium = \"mlp\""), &[], ""), "mlp");
    assert_eq!(medium(vanilla, &["reconstruct.medium=rbf"], ""), "rbf");
    let variants =
        format!("{vanilla}\n[[variant]]\nname = \"p\"\npreset = \"plenodium\"\n[[variant]]\nname = \"v\"");
    assert_eq!(medium(&variants, &[], "p"), "global");
    assert_eq!(medium(&variants, &[], "v"), "none");
    assert_eq!(medium(&variants, &["variant.v.preset=watersplatting"], "v"), "mlp");
    // The same values under another name give the same pipeline.
    let written = graph_of("method = \"3dgs\"", &[]).unwrap();
    let named = graph_of(vanilla, &[]).unwrap();
    assert_eq!(parameters(&written, "", "reconstruct"), parameters(&named, "", "reconstruct"));
    let wrong = graph_of("preset = \"vanila\"", &[]).unwrap_err();
    assert!(wrong.contains("x.toml:2:10") && wrong.contains("did you mean `vanilla`?"), "{wrong}");
    assert!(graph_of("", &["preset=papers"]).unwrap_err().contains("did you mean `paper`?"));
}

#[test]
fn a_variants_preset_lies_over_the_pipelines() {
    let text =
        "preset = \"paper\"\n[[variant]]\nname = \"full\"\n[[variant]]\nname = \"v\"\npreset = \"vanilla\"";
    let graph = graph_of(text, &[]).unwrap();
    let node = |variant: &str, stage: &str| &graph.nodes[graph.find("a", variant, stage).expect("a node")];
    let of = |variant: &str, stage: &str| node(variant, stage).parameters.json().clone();
    assert_eq!(of("v", "reconstruct")["medium"], "none");
    for (stage, parameter) in
        [("import", "split"), ("reconstruct", "anchors"), ("evaluate", "neighbour_pairs")]
    {
        assert_eq!(of("v", stage)[parameter], of("full", stage)[parameter], "{stage}.{parameter}");
    }
    assert_eq!(of("v", "reconstruct")["iterations"], 30_000);
    assert!(graph.find("a", "v", "enhance").is_none(), "3DGS has no stage 2");
    assert_eq!((&*node("full", "import").preset, &*node("v", "import").preset), ("paper", "paper + vanilla"));
    // A command that names another preset for the pipeline keeps the variant's above it.
    let other = graph_of(text, &["preset=plenodium"]).unwrap();
    assert_eq!(other.nodes[other.find("a", "v", "import").expect("a node")].preset, "plenodium + vanilla");
}

#[test]
fn a_method_is_below_a_preset_and_one_that_is_missing_is_refused() {
    let made = |text: &str, sets: &[&str]| {
        let graph = graph_of(text, sets)?;
        let node = &graph.nodes[graph.find("a", "", "reconstruct").expect("a node")];
        let json = node.parameters.json();
        Ok::<_, String>((node.preset.clone(), json["medium"].clone(), json["iterations"].clone()))
    };
    let both = ("3dgs + paper".to_string(), serde_json::json!("rbf"), serde_json::json!(15_000));
    assert_eq!(made("method = \"3dgs\"\npreset = \"paper\"", &[]).unwrap(), both);
    assert_eq!(made("preset = \"paper\"", &["method=3dgs"]).unwrap(), both);
    assert_eq!(made("method = \"3dgs\"", &["preset=paper"]).unwrap(), both);
    assert_eq!(made("", &["method=water-splatting"]).unwrap().1, "mlp");
    assert_eq!(made("", &["method=seasplat"]).unwrap().1, "seasplat");
    let missing = made("method = \"3d-uri\"", &[]).unwrap_err();
    assert!(missing.contains("x.toml:2:10") && missing.contains("did you mean `3d-uir`?"), "{missing}");
    assert!(made("", &["method=3dsg"]).unwrap_err().contains("did you mean `3dgs`?"));
}

/// The extractor belongs to the pairs; the stage that fits to them takes theirs.
#[test]
fn a_parameter_that_no_stage_reads_is_refused() {
    assert!(graph_of("", &["calibrate.extractor.cells=8"]).unwrap_err().contains("unknown key `extractor`"));
    assert!(graph_of("", &["pairs.extractor.cells=8"]).is_ok());
}

#[test]
fn stage_2_can_be_left_out() {
    let stages = |text: &str, sets: &[&str], scene: &str, variant: &str| {
        let graph = graph_of(text, sets).unwrap_or_else(|e| panic!("{text}: {e}"));
        let all =
            ["calibrate", "reconstruct", "targets", "enhance", "photographs", "render", "evaluate", "report"];
        let has = |stage: &str| {
            let mut nodes = graph.nodes.iter();
            nodes.any(|n| {
                n.stage_name == stage && (n.scene.is_empty() || (&*n.scene, &*n.variant) == (scene, variant))
            })
        };
        all.into_iter().filter(|stage| has(stage)).collect::<Vec<_>>()
    };
    let without = ["reconstruct", "render", "evaluate", "report"];
    let pairs = "[calibrator]\npairs = { input = \"x\", target = \"y\" }";
    assert_eq!(stages(&format!("stage2 = false\n{pairs}"), &[], "a", ""), without);
    assert_eq!(stages(pairs, &["stage2=false"], "a", ""), without);
    assert_eq!(stages(pairs, &[], "a", "").len(), 8);
    let b = format!("{pairs}\n[[scene]]\nname = \"b\"\ncapture = \"b\"\nstage2 = false");
    assert_eq!((stages(&b, &[], "a", "").len(), stages(&b, &[], "b", "").len()), (8, 5));
    assert_eq!(stages(&b, &["scene.b.stage2=true"], "b", "").len(), 8);
    assert_eq!(stages(&b, &["scene.a.stage2=false"], "a", ""), without, "no scene needs a calibrator");
    let v = format!("{pairs}\n[[variant]]\nname = \"v\"\nstage2 = false\n[[variant]]\nname = \"w\"");
    assert_eq!((stages(&v, &[], "a", "v").len(), stages(&v, &[], "a", "w").len()), (5, 8));
    let wrong = graph_of("stage2 = 0", &[]).unwrap_err();
    assert!(wrong.contains("x.toml:2:10") && wrong.contains("expected true or false"), "{wrong}");
    assert!(graph_of("", &["stage2=off"]).unwrap_err().contains("expected true or false"));
    assert!(graph_of("stage3 = false", &[]).unwrap_err().contains("did you mean `stage2`?"));
}

#[test]
fn naming_pairs_or_a_calibrator_turns_calibration_on() {
    let calibrated = |text: &str, sets: &[&str], scene: &str, variant: &str| {
        let graph = graph_of(text, sets).unwrap_or_else(|e| panic!("{text}: {e}"));
        let node = &graph.nodes[graph.find(scene, variant, "targets").expect("targets")];
        node.parameters.json()["calibrated"].as_bool().unwrap()
    };
    assert!(!calibrated("", &[], "a", ""));
    let pairs = "[calibrator]\npairs = { input = \"x\", target = \"y\" }";
    for text in [
        pairs,
        "[calibrator]\nfile = \"c\"",
        "[defaults.calibrate]\nsteps = 5",
        "[defaults.pairs]\nextractor = { cells = 8 }",
    ] {
        assert!(calibrated(text, &[], "a", ""), "{text}");
    }
    assert!(calibrated("", &["calibrate.steps=5"], "a", ""));
    assert!(calibrated("", &["targets.calibrated=true"], "a", ""));
    // A calibrator of a scene or a variant applies only there.
    let b = "[[scene]]\nname = \"b\"\ncapture = \"b\"\ncalibrator = { file = \"c\" }";
    assert_eq!((calibrated(b, &[], "a", ""), calibrated(b, &[], "b", "")), (false, true));
    let v = "[[variant]]\nname = \"v\"\n[[variant]]\nname = \"w\"\ncalibrator = { file = \"c\" }";
    assert_eq!((calibrated(v, &[], "a", "v"), calibrated(v, &[], "a", "w")), (false, true));
    // A variant's own preset leaves the pipeline's pairs.
    let w = format!("preset = \"paper\"\n{pairs}\n[[variant]]\nname = \"w\"\nmethod = \"3d-use\"");
    assert!(calibrated(&w, &[], "a", "w"));
    // The parameter itself overrides all; that of a scene also if a variant has a calibrator.
    let own = "[[scene]]\nname = \"b\"\ncapture = \"b\"\ntargets = { calibrated = false }";
    assert!(!calibrated(&format!("{own}\n{v}"), &[], "b", "w"));
    assert!(!calibrated(&format!("{pairs}\n[defaults.targets]\ncalibrated = false"), &[], "a", ""));
}

#[test]
fn a_value_out_of_range_is_pointed_at_in_every_stage() {
    let bad = [
        ("depth", "encoder = \"vitx\"", "`encoder`"),
        ("pairs", "extractor.cells = 0", "`extractor.cells` is 0; expected 2 to 256"),
        ("propose", "proposer = \"nowhere\"", "`proposer`"),
        ("targets", "proposer = \"nowhere\"", "`proposer`"),
        ("targets", "kept_water = 1.5", "expected \"auto\", or shares from 0 to 1"),
        ("photographs", "keep_light = 1.5", "`keep_light` is 1.5; expected 0 to 1"),
        ("evaluate", "path_steps = 0", "`path_steps` is 0; expected 1 to 10000"),
        ("report", "views = -1", "`views`"),
        ("reconstruct", "iterations = 0", "`iterations` is 0; expected 1 to"),
        ("reconstruct", "sh_degree = 4", "`sh_degree` is 4; expected 0 to 3"),
        ("reconstruct", "densify.opacity_ceiling = 1.0", "`densify.opacity_ceiling` is 1;"),
        ("reconstruct", "learning_rates.means = [1e-4, 0.0]", "`learning_rates.means[1]` is 0;"),
        ("enhance", "rank = 99", "`rank` is 99; expected 1 to"),
        ("enhance", "log_every = 0", "`log_every` is 0; expected at least 1"),
        ("calibrate", "trust = 5.0", "`trust` is 5; expected 0 to 1"),
        ("import", "downscale = 0", "`downscale` is 0; expected 1"),
        ("render", "strength = 3.0", "`strength` is 3; expected 0 to 1"),
    ];
    // A table is no value of any parameter, and every number has a range.
    for stage in parameters(&registry().expect("the stage table"), None, None).expect("parameters") {
        for parameter in stage.parameters {
            let line = format!("{} = {{ wrong = 1 }}", parameter.name);
            let error = graph_of(&format!("[defaults.{}]\n\n{line}", stage.stage), &[]).unwrap_err();
            assert!(error.starts_with("x.toml:4:") && error.contains('`'), "{line}: {error}");
            if parameter.kind == "number" || parameter.kind == "whole number" {
                let far = |value: &str| {
                    let line = format!("{} = {value}", parameter.name);
                    graph_of(&format!("[defaults.{}]\n\n{line}", stage.stage), &[]).err()
                };
                let refused = far("-1e30").or_else(|| far("1e30"));
                let refused = refused.unwrap_or_else(|| panic!("{}.{line} has no range", stage.stage));
                assert!(refused.starts_with("x.toml:4:") && refused.contains('`'), "{line}: {refused}");
            }
        }
    }
    for (stage, line, words) in bad {
        // The table begins in line 2, so the wrong value is in line 4.
        let error = graph_of(&format!("[defaults.{stage}]\n\n{line}"), &[]).unwrap_err();
        assert!(error.starts_with("x.toml:4:") && error.contains(words), "{stage}: {error}");
    }
}

#[test]
fn defaults_are_shown_as_people_write_them_and_mean_the_same_when_given() {
    let registry = registry().expect("the stage table");
    let mut numbers = 0;
    for stage in parameters(&registry, None, None).expect("parameters") {
        let mut given = serde_json::json!({});
        for parameter in stage.parameters.iter().filter(|p| !p.default.is_null()) {
            let table = parameter.name.split('.').fold(&mut given, |table, key| &mut table[key]);
            *table = parameter.default.clone();
            if let Some(number) = parameter.default.as_f64() {
                numbers += 1;
                let text = number.to_string();
                // The number has 32 bits, or is short in decimal digits.
                let single = f64::from(number as f32) == number;
                assert!(!single || text.len() <= 10, "{}.{} = {text}", stage.stage, parameter.name);
            }
        }
        let stage = registry.stage(stage.stage).expect("a stage");
        let canonical = |given| stage.parameters(given).expect("parameters of the stage");
        // These are the parameters that enter the keys.
        assert_eq!(canonical(&given), canonical(&serde_json::json!({})), "{}", stage.name());
    }
    assert!(numbers > 30, "{numbers}");
}
