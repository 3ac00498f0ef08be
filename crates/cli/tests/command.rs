//! Tests of the command from a user's view: exit codes, messages, golden renders, and the whole chain on a
//! tiny capture.

mod tiny;

use std::path::Path;
use std::process::{Command, Output};

use use3d_io_image::read_image;
use use3d_numerics::math;

use tiny::TINY;

fn use3d(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_use3d"))
        .args(arguments)
        .env_remove("USE3D_CACHE")
        .env_remove("USE3D_MODELS")
        .env_remove("RUST_LOG")
        .output()
        .expect("the command starts")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Runs the command, expects an exit code, and returns stdout and stderr.
fn expect(code: i32, arguments: &[&str]) -> (String, String) {
    let output = use3d(arguments);
    let (out, err) = (text(&output.stdout), text(&output.stderr));
    assert_eq!(output.status.code(), Some(code), "use3d {arguments:?}\n{out}\n{err}");
    (out, err)
}

fn path(parts: &[&Path]) -> String {
    parts.iter().collect::<std::path::PathBuf>().to_string_lossy().into_owned()
}

#[test]
fn wrong_usage_exits_with_2_and_names_the_next_step() {
    let dir = tempfile::tempdir().unwrap();
    let missing = path(&[dir.path(), Path::new("nowhere")]);
    let out = path(&[dir.path(), Path::new("out")]);
    let (_, err) = expect(2, &["import", &missing, "--out", &out]);
    assert!(err.contains("nowhere"), "{err}");
    let (_, err) = expect(2, &["reconstruct", &missing, "--out", &out, "--set", "itertions=3"]);
    assert!(err.contains("did you mean `iterations`"), "{err}");
    let (_, err) = expect(2, &["render", &missing, "--cameras", &missing, "--out", &out]);
    assert!(err.contains("there is no such folder"), "{err}");
    let (_, err) = expect(2, &["run", &missing]);
    assert!(err.contains("no such file or folder"), "{err}");
    expect(2, &["no-such-verb"]);
    let (help, _) = expect(0, &["render", "--help"]);
    assert!(help.contains("Examples:"), "{help}");
}

#[test]
fn an_installed_program_has_the_pipeline_files_of_the_paper() {
    let (list, _) = expect(0, &["pipelines"]);
    assert!(list.contains("use26") && list.contains("All 26 scenes of the paper"), "{list}");
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../pipelines");
    for name in ["paper", "demo"] {
        let (text, _) = expect(0, &["pipelines", name]);
        assert_eq!(text, std::fs::read_to_string(folder.join(format!("{name}.toml"))).unwrap(), "{name}");
    }
    // Editors get the schema of these files from the program too.
    let (text, _) = expect(0, &["pipelines", "schema"]);
    let schema: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    assert!(schema["properties"]["defaults"]["properties"]["reconstruct"].is_object());
    let (_, err) = expect(2, &["pipelines", "use62"]);
    assert!(err.contains("did you mean `use26`"), "{err}");
}

#[test]
fn golden_scene_mini_renders_to_its_images_from_both_forms_of_its_model() {
    let golden = use3d_golden::root().join("scene-mini");
    let dir = tempfile::tempdir().unwrap();
    for form in ["binary", "text"] {
        let out = path(&[dir.path(), Path::new(form)]);
        let (scene, cameras) =
            (path(&[&golden, Path::new("scene")]), path(&[&golden, Path::new("sparse"), Path::new(form)]));
        expect(0, &["render", &scene, "--cameras", &cameras, "--out", &out, "--format", "exr"]);
        let mut compared = 0;
        for entry in std::fs::read_dir(golden.join("exr")).unwrap() {
            let name = entry.unwrap().file_name();
            let expected = read_image(&golden.join("exr").join(&name)).unwrap();
            let actual = read_image(&Path::new(&out).join("reconstruction").join(&name)).unwrap();
            let (mut square, mut worst) = (0.0f64, 0.0f32);
            for (a, e) in actual.data().iter().zip(expected.data()) {
                worst = worst.max((a - e).abs());
                square += math::powi(f64::from(a - e), 2);
            }
            let psnr = -10.0 * math::log10(square / actual.data().len() as f64);
            assert!(worst <= 4e-3 && psnr > 90.0, "{name:?}: off by {worst}, {psnr} dB");
            compared += 1;
        }
        assert_eq!(compared, 12);
    }
}

/// A capture so small that the whole chain takes seconds.
fn tiny(dir: &Path) -> String {
    let capture = path(&[dir, Path::new("tiny")]);
    tiny::capture(&capture);
    capture
}

#[test]
fn water_is_told_as_a_table_and_as_json_also_where_a_capture_cannot_tell() {
    let dir = tempfile::tempdir().unwrap();
    let capture = tiny(dir.path());
    let (table, _) = expect(0, &["-q", "water", &capture]);
    assert!(table.starts_with("water of tiny: ") && table.contains("attenuation /unit"), "{table}");
    let (json, _) = expect(0, &["-q", "water", &capture, "--json"]);
    let told: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!((&told["format"], &told["channels"][2]["channel"]), (&"3d-use water".into(), &"blue".into()));
    // The size at which a scene is learnt does not affect the water.
    let (small, _) = expect(0, &["-q", "water", &capture, "--json", "--set", "import.max_side=24"]);
    assert_eq!(small, json);
    assert!(table.contains(told["told"].as_str().unwrap()), "one judgement in both: {table}");
    // Without tracks the water cannot be estimated; this is reported, not guessed.
    let model = Path::new(&capture).join("sparse/0");
    let mut untracked = use3d_io_colmap::read_model(&model).unwrap();
    untracked.points.iter_mut().for_each(|p| p.track.clear());
    use3d_io_colmap::write_model_binary(&model, &untracked).unwrap();
    let (table, _) = expect(0, &["-q", "water", &capture]);
    assert_eq!(table.matches("not observable: too few points").count(), 3, "{table}");
    let (json, _) = expect(0, &["-q", "water", &capture, "--json"]);
    let told: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!(told["channels"][0]["verdict"], "too-few-points");
    assert!(told["channels"][0]["attenuation"]["error"].is_null(), "{json}");
    let (_, err) = expect(2, &["water", &path(&[dir.path(), Path::new("nowhere")])]);
    assert!(err.contains("nowhere"), "{err}");
}

#[test]
fn the_whole_chain_runs_once_and_a_change_reruns_only_what_it_touches() {
    let dir = tempfile::tempdir().unwrap();
    let capture = tiny(dir.path());
    let (cache, out) = (path(&[dir.path(), Path::new("cache")]), path(&[dir.path(), Path::new("out")]));
    let run = |extra: &[&str]| {
        let mut arguments = vec!["-q", "run", &capture, "--cache", &cache, "--out", &out];
        TINY.iter().for_each(|set| arguments.extend(["--set", set]));
        arguments.extend(extra);
        expect(0, &arguments).0
    };
    let first = run(&[]);
    let stages = first
        .split(" stages done, 0 kept from before")
        .next()
        .and_then(|text| text.rsplit(|c: char| !c.is_ascii_digit()).next())
        .unwrap_or_default();
    let stages: usize = stages.trim().parse().unwrap_or_else(|_| panic!("{first}"));
    for file in [
        "report.html",
        "tables/reconstruction.md",
        "tables/truth.tex",
        "tables/truth-scene.csv",
        "tiny/scene/scene.json",
        "tiny/scene/contact.png",
        "tiny/enhanced-scene/ubaf.safetensors",
        "tiny/renders/enhanced",
        "tiny/scores/proposal",
        "tiny/scores/scores.json",
        "tiny/scores/strip.png",
    ] {
        assert!(Path::new(&out).join(file).exists(), "{file} is missing");
    }
    // Its colours were learnt through water, so this look is too strong and no part of the results.
    assert!(!Path::new(&out).join("tiny/renders/enhanced-clear").exists());
    // Both scenes know the photographs that they were made from.
    let originals = |scene: &str| {
        let scene = Path::new(&out).join(scene);
        use3d_import::Originals::read(&scene).unwrap().expect("a scene knows its photographs")
    };
    let known = originals("tiny/scene");
    assert_eq!(known, originals("tiny/enhanced-scene"));
    assert!(known.photographs.iter().all(|o| o.file == format!("images/{}", o.relative)), "{known:?}");
    assert!(known.photographs.iter().any(|o| o.held_out) && known.photographs.iter().any(|o| o.train));
    // The capture is synthetic: every view and the water were compared with the truth.
    let text = std::fs::read_to_string(Path::new(&out).join("tiny/scores/scores.json")).unwrap();
    let scores: use3d_judge::scores::SceneScores = serde_json::from_str(&text).unwrap();
    use use3d_judge::scores::Method;
    for method in [
        Method::Captured,
        Method::Proposal,
        Method::Photograph,
        Method::Clear,
        Method::Enhanced,
        Method::EnhancedClear,
    ] {
        for metric in ["truth_psnr", "truth_delta_e"] {
            let value = scores.mean(method, metric).and_then(|s| s.value()).unwrap();
            assert!(value > 0.0 && value < 60.0, "{method:?} {metric}: {value}");
        }
    }
    // Consistency has the fair baseline, with one warp, over the path and over neighbours, with the share
    // that was compared.
    assert_eq!(scores.warp, use3d_judge::scores::Warp::Reference);
    for method in [Method::ProposalOfRender, Method::Clear, Method::Enhanced, Method::EnhancedClear] {
        for metric in ["w_delta_e", "coverage", "path_w_delta_e", "path_coverage"] {
            assert!(scores.mean(method, metric).and_then(|s| s.value()).is_some(), "{method:?} {metric}");
        }
        assert_eq!(scores.method(method).unwrap().path.len(), 8);
    }
    assert!(
        scores.mean(Method::Proposal, "path_w_delta_e").is_none(),
        "there are no photographs on the path"
    );
    // Times are in the results and in no artifact.
    let table = |file: &str| std::fs::read_to_string(Path::new(&out).join("tables").join(file)).unwrap();
    let (csv, json) = (table("reconstruction.csv"), table("reconstruction.json"));
    let fps = csv.lines().last().unwrap().rsplit(',').next().unwrap().parse::<f64>();
    assert!(fps.is_ok_and(|fps| fps > 0.0) && csv.lines().next().unwrap().ends_with("FPS"), "{csv}");
    assert!(json.contains("96×") && json.contains("threads"), "{json}");
    assert!(!text.contains("fps"), "a time in an artifact");
    let page = std::fs::read_to_string(Path::new(&out).join("report.html")).unwrap();
    // The captions show the same look; the table of costs shows the source of a cell; and the page names the
    // program and machine.
    assert!(page.contains("UCIQE enhanced ") && !page.contains("UCIQE enhanced-clear"));
    let source = page.split("from the scores of tiny ").nth(1).and_then(|s| s.split('"').next()).unwrap();
    assert!(source.len() == 12 && page.contains(&format!("<code>{source}</code>")), "{source}");
    assert!(page.contains(" cores). This page was written by ") && page.contains(" run "), "who made it");
    assert!(page.matches("<title>frame_").count() > 2, "dots tell their views");
    assert!(page.contains("path_pairs") && page.contains("FPS") && page.contains("training view"));
    assert!(page.contains("href=\"tiny/view.html\""), "the report links to the scene's own page");
    assert!(
        page.find("data-label=").unwrap() < page.find("id=\"tables\"").unwrap(),
        "pictures come before tables"
    );
    let label = |name: &str| page.find(&format!("data-label=\"{name}\"")).unwrap_or_else(|| panic!("{name}"));
    let [first, truth, last] =
        ["the photograph", "the truth (simulated)", "the photograph, enhanced alone"].map(label);
    let looks =
        ["the photograph, enhanced", "the scene, enhanced", "the scene without water (true for near things)"]
            .map(label);
    assert!(looks.iter().all(|look| (first..last).contains(look)), "the page leads with what is asked for");
    assert!(
        looks.iter().filter(|look| **look < truth).count() == 1,
        "the truth stands beside the nearest look"
    );
    assert!(
        !page.contains("data-label=\"the scene, enhanced, without water\""),
        "a look that is not for others to see"
    );
    one_word_for_each_look(&path(&[Path::new(&out), Path::new("tiny/enhanced-scene")]), &capture, dir.path());
    let depth = scores.mean(Method::Reconstruction, "depth_error").and_then(|s| s.value()).unwrap();
    assert!(depth < 0.5, "depth off by {depth}");
    let water = scores.water.expect("the scene has water");
    assert!(water.attenuation.iter().chain(&water.true_backscatter).all(|v| *v > 0.0), "{water:?}");
    // Stage 2 does not change the files of stage 1.
    let bytes =
        |scene: &str, file: &str| std::fs::read(Path::new(&out).join("tiny").join(scene).join(file)).unwrap();
    for file in ["gaussians.ply", "medium.safetensors"] {
        assert_eq!(bytes("scene", file), bytes("enhanced-scene", file), "{file}");
    }
    // A page of a scene that another program wrote is written again.
    let view = Path::new(&out).join("tiny/view.html");
    let written = std::fs::read_to_string(&view).unwrap();
    let (_, by) = written.rsplit_once("<!-- of ").and_then(|(_, rest)| rest.split_once(" by ")).unwrap();
    let other = written.replace(by.split(' ').next().unwrap(), "another");
    let stamp = other.rfind("<!-- written by use3d, blake3 ").unwrap();
    let digest = use3d_workflow::Digest::of(&other.as_bytes()[..stamp]);
    let other = format!("{}<!-- written by use3d, blake3 {digest} -->\n", &other[..stamp]);
    std::fs::write(&view, other).unwrap();
    let second = run(&[]);
    assert_eq!(std::fs::read_to_string(&view).unwrap(), written, "by this program again");
    assert!(second.contains(&format!("0 stages done, {stages} kept from before")), "{second}");
    // The printed summary uses the look that leads the report.
    let mut aloud = vec!["run", &capture, "--cache", &cache, "--out", &out];
    TINY.iter().for_each(|set| aloud.extend(["--set", set]));
    let (told, _) = expect(0, &aloud);
    let line = told.lines().find(|line| line.contains("likeness to the true scene")).unwrap_or_default();
    assert!(line.contains(", enhanced ") && !line.contains("enhanced-clear"), "{told}");
    for setting in ["render.water=1.5", "render.water=-0.1"] {
        let (_, err) = expect(2, &["run", &capture, "--cache", &cache, "--out", &out, "--set", setting]);
        assert!(err.contains("water") && err.contains("expected 0 to 1"), "{err}");
    }
    // For programs: one document with the path and the scores of everything.
    let told: serde_json::Value = serde_json::from_str(&run(&["--json"])).unwrap();
    assert_eq!(told["nodes"].as_array().unwrap().len(), stages);
    for (what, scene, place) in [
        ("report", "", "report.html"),
        ("tables", "", "tables"),
        ("view", "tiny", "tiny/view.html"),
        ("reconstruct", "tiny", "tiny/scene"),
        ("enhance", "tiny", "tiny/enhanced-scene"),
        ("evaluate", "tiny", "tiny/scores"),
    ] {
        let results = told["results"].as_array().unwrap();
        let result = results.iter().find(|r| r["what"] == what).unwrap_or_else(|| panic!("{what}: {told}"));
        let place = Path::new(&out).join(place);
        assert_eq!(
            (result["scene"].as_str(), result["path"].as_str()),
            (Some(scene), place.to_str()),
            "{what}"
        );
        assert!(place.exists());
    }
    let means = &told["scores"][0];
    assert_eq!(
        (means["scene"].as_str(), means["file"].as_str().map(Path::new)),
        (Some("tiny"), Some(Path::new(&out).join("tiny/scores/scores.json").as_path()))
    );
    let methods = means["methods"].as_array().unwrap();
    assert_eq!(methods.len(), scores.methods.len());
    for told in methods {
        let method: Method = serde_json::from_value(told["method"].clone()).unwrap();
        let mean: use3d_judge::scores::Scores = serde_json::from_value(told["mean"].clone()).unwrap();
        assert_eq!(mean, scores.method(method).unwrap().mean, "{method:?}");
    }
    let changed = run(&["--set", "enhance.lambda_variation=0.001"]);
    assert!(!changed.contains(" 0 kept") && !changed.contains("0 stages done"), "{changed}");
    let threads = run(&["--threads", "1"]);
    assert!(threads.contains(&format!("0 stages done, {stages} kept from before")), "{threads}");
}

/// The name of a look means the same pictures in `render`, in `export` and at every share of water.
fn one_word_for_each_look(scene: &str, capture: &str, dir: &Path) {
    let at = |name: &str| path(&[dir, Path::new(name)]);
    let render = |out: &str, modes: &str, more: &[&str]| {
        let mut arguments =
            vec!["-q", "render", scene, "--cameras", capture, "--held-out", "--format", "exr"];
        let out = at(out);
        arguments.extend(["--out", &out, "--modes", modes]);
        arguments.extend(more);
        expect(0, &arguments);
    };
    let all = "reconstruction,clear,enhanced,enhanced-clear";
    render("whole", all, &[]);
    render("all", all, &["--water", "1"]);
    render("none", all, &["--water", "0"]);
    render("half", all, &["--water", "0.5"]);
    render("only", "enhanced-clear", &[]);
    let frames = |out: &str, mode: &str| -> Vec<Vec<u8>> {
        let mut files: Vec<_> =
            std::fs::read_dir(Path::new(&at(out)).join(mode)).unwrap().map(|e| e.unwrap().path()).collect();
        files.sort();
        assert!(!files.is_empty());
        files.iter().map(|file| std::fs::read(file).unwrap()).collect()
    };
    for (mode, clear) in [("reconstruction", "clear"), ("enhanced", "enhanced-clear")] {
        assert_eq!(frames("whole", mode), frames("all", mode), "{mode}: all of the water");
        assert_eq!(frames("none", mode), frames("whole", clear), "{mode}: none of the water");
        assert_ne!(frames("half", mode), frames("none", mode));
        assert_ne!(frames("half", mode), frames("all", mode));
        assert_eq!(frames("half", clear), frames("whole", clear), "{clear} knows no water");
    }
    assert_ne!(frames("whole", "clear"), frames("whole", "enhanced-clear"));
    assert_eq!(frames("only", "enhanced-clear"), frames("whole", "enhanced-clear"));
    let export = |what: &str| {
        let ply = at(&format!("{what}.ply"));
        let (_, said) = expect(0, &["-q", "export", scene, "--ply", &ply, "--what", what]);
        (std::fs::read(&ply).unwrap(), said)
    };
    // A look with water is baked as the cameras saw it, with a backdrop of open water.
    let count = |ply: &[u8]| {
        let header = String::from_utf8_lossy(&ply[..600]).into_owned();
        let count = header.lines().find_map(|line| line.strip_prefix("element vertex ")).expect("a count");
        (count.parse::<usize>().expect("a number"), header)
    };
    for (mode, clear) in [("reconstruction", "clear"), ("enhanced", "enhanced-clear")] {
        let ((with, header), (without, _)) = (count(&export(mode).0), count(&export(clear).0));
        assert!(with > without, "{mode}: {with} Gaussians, {clear}: {without}");
        assert!(header.contains(&format!("comment what: {mode}\n")), "{header}");
        let ply = at(&format!("{mode}-dry.ply"));
        expect(0, &["-q", "export", scene, "--ply", &ply, "--what", mode, "--water", "0"]);
        let dry = std::fs::read(&ply).unwrap();
        assert_eq!(count(&dry).0, without, "{mode} without water");
    }
    // Without an argument it is the look with which the page opens.
    let ply = at("opening.ply");
    let (_, said) = expect(0, &["export", scene, "--ply", &ply]);
    assert!(count(&std::fs::read(&ply).unwrap()).1.contains("comment what: enhanced\n"));
    assert!(said.contains("the colours of the file are fixed") && said.contains("ΔE00"), "{said}");
    // With the capture's cameras, the held-out views are not baked. The file is compared with the scene
    // there.
    let (_, said) = expect(0, &["export", scene, "--ply", &at("seen.ply"), "--cameras", capture]);
    assert!(said.contains("those that were kept back"), "{said}");
    // After these few steps Gaussians are large and faint, so one colour for all distances is a coarse fit.
    let figures = ["scene by ", "and by "].map(|before| said.split(before).nth(1).expect("a figure"));
    let apart: Vec<f64> = figures.iter().map(|s| s[..3].parse().expect("a number")).collect();
    assert!(apart.len() == 2 && apart.iter().all(|apart| (0.0..4.0).contains(apart)), "{said}");
    let bare = at("bare.ply");
    expect(0, &["-q", "export", scene, "--ply", &bare, "--no-backdrop"]);
    assert_eq!(count(&std::fs::read(&bare).unwrap()).0, count(&std::fs::read(at("clear.ply")).unwrap()).0);
    let written = |what: &str| std::fs::read(at(&format!("{what}.ply"))).unwrap();
    assert_ne!(written("clear"), written("enhanced-clear"));
}

#[test]
fn a_scene_can_be_learnt_from_proposals_and_is_scored_as_such() {
    let dir = tempfile::tempdir().unwrap();
    tiny(dir.path());
    let at = |name: &str| path(&[dir.path(), Path::new(name)]);
    let file = at("compare.toml");
    let text = r#"
        name = "compare"
        [[scene]]
        name = "tiny"
        capture = "tiny"
        [[variant]]
        name = "first"
        reconstruct = { images = "proposed", medium = "none" }
        [[variant]]
        name = "plain"
    "#;
    std::fs::write(&file, text).unwrap();
    let out = at("out");
    let cache = at("cache");
    let mut arguments = vec!["-q", "run", &file, "--cache", &cache, "--out", &out, "--until", "evaluate"];
    TINY.iter().for_each(|set| arguments.extend(["--set", set]));
    expect(0, &arguments);
    let text = std::fs::read_to_string(Path::new(&out).join("tiny@first/scores/scores.json")).unwrap();
    let scores: use3d_judge::scores::SceneScores = serde_json::from_str(&text).unwrap();
    use use3d_judge::scores::Method;
    assert!(scores.mean(Method::EnhanceThenReconstruct, "truth_psnr").and_then(|s| s.value()).is_some());
    assert!(scores.mean(Method::Reconstruction, "psnr").is_none());
    // Both variants are compared by the depth of the one that was trained on photographs, although it is
    // listed last.
    let text = std::fs::read_to_string(Path::new(&out).join("tiny@plain/scores/scores.json")).unwrap();
    let plain: use3d_judge::scores::SceneScores = serde_json::from_str(&text).unwrap();
    assert_eq!(scores.warp, use3d_judge::scores::Warp::Reference);
    let photographs = |scores: &use3d_judge::scores::SceneScores| {
        scores.method(Method::Captured).unwrap().neighbours.clone()
    };
    assert!(!photographs(&plain).is_empty());
    assert_eq!(photographs(&scores), photographs(&plain), "the same photographs, judged by other depths");
    // The stages by hand make the same scene.
    let scene = at("scene");
    let steps = TINY.iter().find_map(|set| set.strip_prefix("reconstruct.")).unwrap();
    let sets = ["--set", "images=proposed", "--set", "medium=none", "--set", steps];
    let mut arguments = vec!["-q", "reconstruct", &at("tiny"), "--out", &scene]
        .into_iter()
        .map(String::from)
        .collect::<Vec<_>>();
    arguments.extend(sets.map(String::from));
    expect(0, &arguments.iter().map(String::as_str).collect::<Vec<_>>());
    let read = |folder: &str| std::fs::read(Path::new(folder).join("gaussians.ply")).unwrap();
    assert_eq!(read(&scene), read(&path(&[Path::new(&out), Path::new("tiny@first/scene")])));
    // By hand it is also scored under its own name.
    let (rows, _) = expect(0, &["-q", "evaluate", &scene, &at("tiny"), "--format", "csv"]);
    assert!(rows.contains("\nenhance-then-reconstruct,") && !rows.contains("\nreconstruction,"), "{rows}");
}

#[test]
fn a_black_held_out_photograph_and_anothers_truth_folder_do_not_end_a_run() {
    let dir = tempfile::tempdir().unwrap();
    tiny(dir.path());
    let at = |name: &str| path(&[dir.path(), Path::new(name)]);
    std::fs::remove_dir_all(at("tiny/truth")).unwrap();
    std::fs::create_dir_all(at("tiny/truth/clean")).unwrap();
    std::fs::write(at("tiny/truth/clean/readme.txt"), "another project's truth").unwrap();
    // Every eighth view is held out, beginning with the first.
    let mut images: Vec<_> =
        std::fs::read_dir(at("tiny/images")).unwrap().map(|e| e.unwrap().path()).collect();
    images.sort();
    let black = use3d_capture::Image::new(96, 64);
    use3d_io_image::write_png(&images[0], &black).unwrap();
    let text = r#"
        name = "black"
        [[scene]]
        name = "tiny"
        capture = "tiny"
        [[variant]]
        name = "first"
        reconstruct = { images = "proposed", medium = "none" }
    "#;
    std::fs::write(at("black.toml"), text).unwrap();
    let out = at("out");
    let (toml, cache) = (at("black.toml"), at("cache"));
    let mut arguments = vec!["-q", "run", &toml, "--cache", &cache, "--out", &out];
    TINY.iter().for_each(|set| arguments.extend(["--set", set]));
    expect(0, &arguments);
    let text = std::fs::read_to_string(Path::new(&out).join("tiny@first/scores/scores.json")).unwrap();
    assert!(!text.contains("\"value\": null") && text.contains("the images are equal"), "{text}");
    let scores: use3d_judge::scores::SceneScores = serde_json::from_str(&text).unwrap();
    let proposal = scores.method(use3d_judge::scores::Method::Proposal).unwrap();
    assert_eq!(proposal.left_out.get("psnr"), Some(&1));
    assert!(proposal.mean["psnr"].value().is_some(), "the other held-out view has one");
    // Equal images by hand give a reason, not null.
    let (json, _) =
        expect(0, &["evaluate", "--images", &at("tiny/images"), "--reference", &at("tiny/images"), "--json"]);
    assert!(json.contains("undefined") && !json.contains("null"), "{json}");
}

#[test]
fn stages_by_hand_make_the_same_scene_and_export_opens_again() {
    let dir = tempfile::tempdir().unwrap();
    let capture = tiny(dir.path());
    let at = |name: &str| path(&[dir.path(), Path::new(name)]);
    let (one, two) = (at("one"), at("two"));
    for (scene, threads, profile) in [(&one, "1", None), (&two, "3", Some("--profile"))] {
        let mut arguments = vec![
            "-q",
            "--threads",
            threads,
            "reconstruct",
            &capture,
            "--out",
            scene,
            "--set",
            "iterations=20",
        ];
        arguments.extend(profile);
        let (out, _) = expect(0, &arguments);
        assert_eq!(out.contains("20 steps") && out.contains("compose backward"), profile.is_some(), "{out}");
    }
    for file in ["scene.json", "gaussians.ply", "medium.safetensors", "training.jsonl", "contact.png"] {
        let read = |scene: &str| std::fs::read(Path::new(scene).join(file)).unwrap();
        assert_eq!(read(&one), read(&two), "{file} depends on the number of threads");
    }
    // The scene says which water it started from, with the errors of the estimate.
    let read = |file: &str| -> serde_json::Value {
        serde_json::from_slice(&std::fs::read(Path::new(&one).join(file)).unwrap()).unwrap()
    };
    let (scene, choices) = (read("scene.json"), read("choices.json"));
    let (started, chosen) = (scene["origin"]["water"].as_str().unwrap(), choices["water"].as_str().unwrap());
    assert!(started.starts_with(chosen) && started.contains("attenuation red "), "{started}");
    assert!(started.contains(" ± ") && started.ends_with(" per unit of the model"), "{started}");
    let ply = at("scene.ply");
    expect(0, &["export", &one, "--ply", &ply]);
    let exported =
        use3d_splat::ply::read(std::fs::File::open(&ply).map(std::io::BufReader::new).unwrap()).unwrap();
    assert!(!exported.is_empty());
    let (measured, _) = expect(0, &["-q", "render", &one, "--cameras", &capture, "--fps", "--json"]);
    let measured: serde_json::Value = serde_json::from_str(&measured).unwrap();
    assert_eq!(
        (&measured["width"], &measured["views"], &measured["which"]),
        (&96.into(), &2.into(), &"held-out".into())
    );
    assert!(measured["modes"][0]["fps"].as_f64().unwrap() > 0.0, "{measured}");
    for mode in ["enhanced", "enhanced-clear"] {
        let (_, err) =
            expect(2, &["render", &one, "--cameras", &capture, "--out", &at("r"), "--modes", mode]);
        assert!(err.contains(&format!("--modes {mode}:")) && err.contains("use3d enhance"), "{err}");
    }
    for water in ["1.5", "-0.1", "nan"] {
        let flag = format!("--water={water}");
        let (_, err) = expect(2, &["render", &one, "--cameras", &capture, "--out", &at("r"), &flag]);
        assert!(err.contains("--water") && err.contains("expected 0 to 1"), "{err}");
    }
    expect(
        0,
        &[
            "-q",
            "render",
            &one,
            "--cameras",
            &capture,
            "--path",
            "interpolate",
            "--frames",
            "3",
            "--video",
            &at("swim.y4m"),
        ],
    );
    assert!(std::fs::read(at("swim.y4m")).unwrap().starts_with(b"YUV4MPEG2 W96 H64"));
}
