//! Pipeline files: their meaning, and the places of their errors.

use std::fs;
use std::path::Path;

use serde_json::json;
use use3d_config::{LoadOptions, from_text, schema, schema_text};
use use3d_workflow::Graph;

use super::stages::registry;

const FILE: &str = r#"
name = "two"
seed = 7
cache = "results/cache"
[models]
dir = "networks"
[calibrator]
pairs = { input = "pairs/raw", target = "pairs/reference" }
proposer = "nu2net"
[defaults.reconstruct]
iterations = 20
medium = "mlp"
[[scene]]
name = "IUI3-RedSea"
capture = "${USE3D_TEST_UNSET_ROOT}/IUI3-RedSea"
group = "SeaThru-4"
size = "1400x933"
[[scene]]
name = "Curasao"
capture = "data/Curasao"
reconstruct = { rate = 0.25 }
[[variant]]
name = "full"
[[variant]]
name = "none"
seed = 8
reconstruct = { medium = "none" }
"#;

fn load(text: &str, sets: &[&str]) -> Result<use3d_config::Pipeline, String> {
    let options =
        LoadOptions { sets: sets.iter().map(ToString::to_string).collect(), ..LoadOptions::default() };
    from_text(&registry(0), text, Path::new("dir/p.toml"), &options).map_err(|e| e.to_string())
}

fn parameters(text: &str, sets: &[&str], scene: &str, variant: &str, stage: &str) -> serde_json::Value {
    let pipeline = load(text, sets).expect("a pipeline");
    let graph = Graph::new(&registry(0), &pipeline.batch).expect("a graph");
    let node = graph.find(scene, variant, stage).expect("a node");
    serde_json::Value::clone(graph.nodes[node].parameters.json())
}

#[test]
fn a_file_means_what_it_says() {
    let pipeline = load(FILE, &[]).expect("a pipeline");
    assert_eq!(pipeline.cache, Path::new("dir/results/cache"));
    let batch = &pipeline.batch;
    assert_eq!((batch.name.as_str(), batch.seed, batch.scenes.len(), batch.variants.len()), ("two", 7, 2, 2));
    assert_eq!(batch.externals["pairs.target"], Ok(Path::new("dir/pairs/reference").to_path_buf()));
    assert_eq!(batch.externals["models"], Ok(Path::new("dir/networks").to_path_buf()));
    let unset = batch.scenes[0].externals["capture"].clone().expect_err("not set");
    assert!(unset.contains("USE3D_TEST_UNSET_ROOT is not set"), "{unset}");
    assert_eq!(batch.scenes[1].externals["capture"], Ok(Path::new("dir/data/Curasao").to_path_buf()));
    let of = |scene: &str, variant: &str, stage: &str| parameters(FILE, &[], scene, variant, stage);
    let full =
        json!({"iterations": 20, "rate": 0.5, "medium": "mlp", "depth_prior": "off", "log_every": 100});
    assert_eq!(of("IUI3-RedSea", "full", "reconstruct"), full);
    assert_eq!(
        of("Curasao", "none", "reconstruct"),
        json!({"iterations": 20, "rate": 0.25, "medium": "none", "depth_prior": "off", "log_every": 100})
    );
    assert_eq!(of("IUI3-RedSea", "full", "import")["size"], "1400x933");
    assert_eq!(of("Curasao", "full", "import")["size"], json!(null));
    assert_eq!(of("", "full", "calibrate")["proposer"], "nu2net");
    assert_eq!(of("Curasao", "none", "targets")["proposer"], "nu2net");
}

#[test]
fn settings_of_the_command_line_win() {
    let of =
        |sets: &[&str], scene: &str, variant: &str| parameters(FILE, sets, scene, variant, "reconstruct");
    assert_eq!(of(&["reconstruct.iterations=3000"], "Curasao", "none")["iterations"], 3000);
    let one = ["scene.curasao.reconstruct.iterations=3000", "reconstruct.iterations=9"];
    assert_eq!(of(&one, "Curasao", "full")["iterations"], 3000);
    assert_eq!(of(&one, "IUI3-RedSea", "full")["iterations"], 9);
    assert_eq!(of(&["reconstruct.medium=rbf"], "Curasao", "none")["medium"], "rbf");
    assert_eq!(of(&["variant.none.reconstruct.rate=0.75"], "Curasao", "none")["rate"], 0.75);
    let shorthand = parameters(FILE, &["calibrator.proposer=fusion"], "Curasao", "full", "targets");
    assert_eq!(shorthand["proposer"], "fusion");
    assert_eq!(parameters(FILE, &["size=64x48"], "Curasao", "full", "import")["size"], "64x48");
    // The value is a number in TOML and a text for the stage.
    for text in ["640", "0x0"] {
        let set = format!("size={text}");
        assert_eq!(parameters(FILE, &[set.as_str()], "Curasao", "full", "import")["size"], text);
    }
    assert_eq!(load(FILE, &["seed=9"]).expect("loaded").batch.seed, 9);
    for (set, expected) in [
        ("reconstruct.iteratons=3", "did you mean `iterations`?"),
        ("reconstuct.iterations=3", "did you mean `reconstruct`?"),
        ("reconstruct.iterations=many", "expected a whole number, 0 or more, found \"many\""),
        ("reconstruct.iterations=-5", "expected a whole number, 0 or more, found -5"),
        ("scene.Curasao=1", "scene.Curasao.reconstruct.iterations=3000"),
        ("reconstruct.medium=rbff", "did you mean `rbf`?"),
        ("reconstruct.rate=-1.0", "a positive number"),
        ("scene.Curacao.reconstruct.rate=1.0", "did you mean `Curasao`?"),
        ("scene.Curasao.calibrate.strength=1.0", "made once for all scenes"),
        ("iterations=3", "a key is STAGE.PARAMETER"),
        ("seed=x", "whole number"),
        ("nothing", "KEY=VALUE"),
    ] {
        let error =
            load(FILE, &[set]).and_then(|p| Graph::new(&registry(0), &p.batch).map_err(|e| e.to_string()));
        let error = error.expect_err(set);
        assert!(error.contains(expected), "{set}: {error}");
    }
}

#[test]
fn mistakes_point_at_line_and_column_with_the_nearest_key() {
    let head = "name = \"x\"\n";
    let scene = "[[scene]]\nname = \"a\"\ncapture = \"a\"\n";
    for (text, place, expected) in [
        (format!("{head}sed = 3\n{scene}"), "dir/p.toml:2:1", "did you mean `seed`?"),
        (
            format!("{head}seed = \"x\"\n{scene}"),
            "dir/p.toml:2:8",
            "expected a whole number, 0 or more, found \"x\"",
        ),
        (
            format!("{head}{scene}[defaults.reconstruct]\niteratons = 3\n"),
            "dir/p.toml:6:1",
            "did you mean `iterations`?",
        ),
        (
            format!("{head}{scene}[defaults.reconstruct]\nrate = \"fast\"\n"),
            "dir/p.toml:6:8",
            "expected a number",
        ),
        (
            format!("{head}{scene}[defaults.reconstruct]\nrate = -1.0\n"),
            "dir/p.toml:6:8",
            "a positive number",
        ),
        (
            format!("{head}{scene}[defaults.reconstruct]\nmedium = \"rbff\"\n"),
            "dir/p.toml:6:10",
            "did you mean `rbf`?",
        ),
        (
            format!("{head}{scene}[defaults.reconstuct]\nrate = 1.0\n"),
            "dir/p.toml:5:11",
            "did you mean `reconstruct`?",
        ),
        (format!("{head}{scene}sizee = \"3x2\"\n"), "dir/p.toml:5:1", "did you mean `size`?"),
        (
            format!("{head}{scene}iteratons = 3\n"),
            "dir/p.toml:5:1",
            "did you mean `reconstruct = { iterations = … }`?",
        ),
        (format!("{head}{scene}size = 3\n"), "dir/p.toml:5:8", "expected text, found 3"),
        (format!("{head}{scene}imprt = {{ every = 2 }}\n"), "dir/p.toml:5:1", "did you mean `import`?"),
        (format!("{head}{scene}import = {{ evry = 2 }}\n"), "dir/p.toml:5:12", "did you mean `every`?"),
        (format!("{head}{scene}{scene}"), "dir/p.toml:6:8", "names must be unique"),
        (format!("{head}[[scene]]\nname = \"a\"\n"), "dir/p.toml:2:", "[[scene]] needs `capture`"),
        (
            format!("{head}[[scene]]\nname = \"../a\"\ncapture = \"a\"\n"),
            "dir/p.toml:3:8",
            "the name of a folder",
        ),
        (format!("{head}[scene]\nname = \"a\"\n"), "dir/p.toml:2:", "[[scene]]"),
        (head.to_string(), "dir/p.toml", "has no scene"),
        (scene.to_string(), "dir/p.toml", "the pipeline needs `name`"),
        (
            format!("{head}{scene}[calibrator]\nproposr = \"fusion\"\n"),
            "dir/p.toml:6:1",
            "did you mean `proposer`?",
        ),
        (format!("{head}{scene}[calibrator]\nproposer = 3\n"), "dir/p.toml:6:12", "expected text, found 3"),
        (format!("{head}{scene}[models]\ndirs = \"x\"\n"), "dir/p.toml:6:1", "did you mean `dir`?"),
        (
            format!("{head}{scene}[[variant]]\nname = \"v\"\nenhance = {{ strenght = 1.0 }}\n"),
            "dir/p.toml:7:13",
            "did you mean `strength`?",
        ),
        (format!("{head}{scene}[[variant]]\nenhance = 3\n"), "dir/p.toml:6:11", "are a table"),
        ("name = \"x\n".to_string(), "dir/p.toml:1:", "not TOML"),
    ] {
        let error = load(&text, &[]).expect_err(&text);
        assert!(error.starts_with(place) && error.contains(expected), "{text}\n→ {error}");
    }
}

#[test]
fn the_schema_knows_every_stage() {
    let schema = schema(&registry(0));
    assert!(schema["properties"]["defaults"]["properties"]["reconstruct"].is_object());
    assert!(schema["properties"]["scene"]["items"]["properties"]["size"].is_object());
    assert!(schema["properties"]["scene"]["items"]["properties"]["calibrate"].is_null());
    assert!(schema["properties"]["variant"]["items"]["properties"]["calibrate"].is_object());
    assert!(schema["$defs"]["ReconstructParameters"]["properties"]["rate"].is_object());
    assert!(schema["$defs"]["Calibrator"]["properties"]["proposer"].is_object());
    assert_eq!(schema_text(&registry(0)), schema_text(&registry(0)));
}

#[test]
fn every_folder_that_a_pattern_matches_is_a_scene_of_its_name() {
    let dir = tempfile::tempdir().expect("a folder");
    // Brackets and stars in the file's own folder are no part of the pattern.
    let root = dir.path().join("survey [2026]*");
    for name in ["dives/b", "dives/a", "dives/.hidden", "dives/c/deep", "more/a", "wrecks/east/x"] {
        std::fs::create_dir_all(root.join(name)).expect("a folder");
    }
    std::fs::write(root.join("dives/notes.txt"), "no folder").expect("a file");
    let load = |scenes: &str| {
        let text = format!("name = \"p\"\ncache = \"c\"\n{scenes}");
        from_text(&registry(0), &text, &root.join("p.toml"), &LoadOptions::default())
    };
    let scenes = |text: &str| {
        let batch = load(text).expect("a pipeline").batch;
        let place = |capture: &Result<std::path::PathBuf, String>| capture.clone().expect("a place");
        let one = |scene: &use3d_workflow::BatchScene| {
            let place = place(scene.externals.values().next().expect("a place"));
            (scene.name.clone(), place.strip_prefix(&root).expect("below it").display().to_string())
        };
        batch.scenes.iter().map(one).collect::<Vec<_>>()
    };
    let named = |pairs: &[(&str, &str)]| -> Vec<(String, String)> {
        pairs.iter().map(|(name, place)| (name.to_string(), place.to_string())).collect()
    };
    let dives = "[[scene]]\nfrom = \"dives/*\"\ngroup = \"G\"\nreconstruct = { iterations = 7 }\n";
    assert_eq!(scenes(dives), named(&[("a", "dives/a"), ("b", "dives/b"), ("c", "dives/c")]));
    let batch = load(dives).expect("a pipeline").batch;
    assert!(batch.scenes.iter().all(|s| s.group == "G" && s.overrides["reconstruct"]["iterations"] == 7));
    assert!(batch.scenes[1].named["capture"].contains("`from` of scene b in"));
    assert_eq!(scenes("[[scene]]\nfrom = \"wrecks/*/*\"\n"), named(&[("x", "wrecks/east/x")]));
    // A scene that is named by hand wins, before the pattern or after it.
    let by_hand = "[[scene]]\nname = \"b\"\ncapture = \"more/a\"\n";
    let others = [("a", "dives/a"), ("c", "dives/c")];
    assert_eq!(scenes(&format!("{by_hand}{dives}")), named(&[&[("b", "more/a")], &others[..]].concat()));
    assert_eq!(scenes(&format!("{dives}{by_hand}")), named(&[&others[..], &[("b", "more/a")]].concat()));
    // Films and folders without cameras are footage; the folder of a film's name has its cameras.
    for name in
        ["films/b.mp4", "films/c.MOV", "films/GL01.LRV", "films/.d.mp4", "films/e.txt", "films/f/1.jpg"]
    {
        fs::create_dir_all(root.join(name).parent().expect("a folder")).expect("a folder");
        fs::write(root.join(name), name).expect("written");
    }
    fs::create_dir(root.join("films/c")).expect("a folder");
    let films = "[[scene]]\nfrom = \"films/*\"\n";
    assert_eq!(scenes(films), named(&[("b", "films/b.mp4"), ("c", "films/c"), ("f", "films/f")]));
    let batch = load(films).expect("a pipeline").batch;
    let footage = batch.scenes.iter().map(|scene| scene.externals.contains_key("footage"));
    assert_eq!(footage.collect::<Vec<_>>(), [true, false, true]);
    for (text, parts) in [
        (
            "[[scene]]\nfrom = \"divs/*\"\n".to_string(),
            &["p.toml:4:8", "no folder or film matches `divs/*`"][..],
        ),
        ("[[scene]]\nfrom = \"dives/*.txt\"\n".to_string(), &["no folder or film matches"]),
        (
            format!("{dives}[[scene]]\nfrom = \"more/*\"\n"),
            &["two folders or films have the name `a`", "more/a"],
        ),
        (format!("{by_hand}{by_hand}"), &["the name `b` is used twice"]),
        (
            format!("{by_hand}footage = \"dive.mp4\"\n"),
            &["`footage` has no cameras yet, and `capture` has them"],
        ),
        (format!("{dives}footage = \"dive.mp4\"\n"), &["`footage` has no place here"]),
        ("[[scene]]\nname = \"x\"\nfrom = \"dives/*\"\n".to_string(), &["`name` has no place here"]),
        ("[[scene]]\nfrom = \"dives/***\"\n".to_string(), &["is no pattern of folders and films"]),
        (
            "[[scene]]\nfrom = \"${USE3D_TEST_UNSET_ROOT}/*\"\n".to_string(),
            &["USE3D_TEST_UNSET_ROOT is not set"],
        ),
    ] {
        let error = load(&text).expect_err(&text).to_string();
        assert!(parts.iter().all(|part| error.contains(part)), "{text}: {error}");
    }
}
