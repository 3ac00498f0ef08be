//! Tests of a new user's first attempts: a results folder in place of a scene or a capture, common flags,
//! earlier results, two runs side by side, and colours balanced by hand.

mod tiny;

use std::path::Path;
use std::process::Output;

use tiny::{Place, command};

/// Exit code, stdout and stderr.
fn said(place: &Place, arguments: &[&str]) -> (Option<i32>, String, String) {
    let Output { status, stdout, stderr } =
        command().args(arguments).current_dir(place.dir.path()).output().expect("the command starts");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (status.code(), text(&stdout), text(&stderr))
}

fn expect(place: &Place, code: i32, arguments: &[&str]) -> String {
    let (found, out, err) = said(place, arguments);
    assert_eq!(found, Some(code), "use3d {arguments:?}\n{out}{err}");
    out + &err
}

fn run(place: &Place, extra: &[&str]) -> String {
    let mut arguments = vec!["run", "tiny", "--cache", "cache", "-o", "out"];
    let sets: Vec<String> = tiny::TINY[1..].iter().map(ToString::to_string).collect();
    arguments.extend(sets.iter().flat_map(|set| ["--set", set]));
    arguments.extend(extra);
    expect(place, 0, &arguments)
}

#[test]
fn results_stand_for_what_they_were_made_from_and_earlier_ones_come_back() {
    let place = Place::new();
    let first = run(&place, &["--iterations", "30"]);
    assert!(!first.contains("replace those of"), "{first}");
    let scene = "out/tiny/enhanced-scene/scene.json";
    let read = |name: &str| std::fs::read(place.at(name)).expect("there");
    let before = read(scene);
    let shorter = run(&place, &["--steps", "20"]);
    assert!(shorter.contains("run 1 (") && shorter.contains("use3d results out 1"), "{shorter}");
    assert_ne!(read("out/tiny/scene/gaussians.ply").len(), 0);

    // Both are listed, and the first one is restored without any work.
    let listed = expect(&place, 0, &["results", "out"]);
    assert!(listed.contains("iterations=30") && listed.contains("iterations=20"), "{listed}");
    assert_eq!(listed.matches("shown now").count(), 1);
    // A restored run keeps the date on which it was made.
    let record = place.at("out/runs/0001.json");
    let text = std::fs::read_to_string(&record).expect("the record");
    let made = text.split("\"made\": ").nth(1).and_then(|rest| rest.split(',').next()).expect("a time");
    std::fs::write(&record, text.replace(&format!("\"made\": {made}"), "\"made\": 1000000000"))
        .expect("written");
    let back = expect(&place, 0, &["results", "out", "1"]);
    assert!(back.contains("run 2 (") && back.contains("kept from before"), "{back}");
    assert_eq!(read(scene), before);
    let line = |text: &str, run: &str| {
        text.lines().find(|l| l.trim_start().starts_with(run)).unwrap_or_default().to_string()
    };
    let first = line(&expect(&place, 0, &["results", "out"]), "1");
    assert!(first.contains("shown now") && first.contains("2001-09-09"), "{first}");
    assert!(expect(&place, 2, &["results", "out", "7"]).contains("there are: 1, 2"));
    assert!(expect(&place, 2, &["results", "nothing"]).contains("no results of `use3d run`"));

    // The two runs side by side.
    let told = expect(&place, 0, &["compare", "out:1", "out:2", "-o", "ab.html"]);
    assert!(
        told.contains("kept back: A ") && told.contains("1 setting differs: reconstruct.iterations"),
        "{told}"
    );
    let page = std::fs::read_to_string(place.at("ab.html")).unwrap();
    assert!(page.contains("reconstruct.iterations: 30 in A, 20 in B"), "the parameter that differs is named");
    assert!(page.matches("data:image/jpeg").count() >= 4);
    expect(&place, 0, &["compare", "out", "out:2", "-o", "b.html"]);
    assert!(expect(&place, 2, &["compare", "out:9", "out"]).contains("use3d results out"));

    // A results folder stands for its scene, with the photographs of its capture and its own look.
    let told = expect(&place, 0, &["export", "out", "--web", "page.html", "--ply", "a.ply"]);
    assert!(told.contains("enhanced-scene") && told.contains("9 photographs"), "{told}");
    assert!(told.contains("what: enhanced"), "the look that the page opens with: {told}");
    expect(&place, 0, &["render", "out/tiny", "-o", "r", "--held-out"]);
    assert!(
        place
            .dir
            .path()
            .join("r")
            .read_dir()
            .unwrap()
            .flatten()
            .any(|e| e.file_name().to_string_lossy().starts_with("enhanced"))
    );
    // It also stands for its capture, with the settings of its run.
    let plan = expect(&place, 0, &["plan", "out"]);
    assert!(plan.contains("0 to run"), "{plan}");

    // Another capture's cameras are refused, whatever the names of its photographs.
    let other = [
        "synth", "capture", "-o", "other", "--views", "9", "--size", "96x64", "--seed", "7", "--place",
        "pool",
    ];
    expect(&place, 0, &other);
    let told = expect(&place, 2, &["export", "out", "--web", "other.html", "--cameras", "other"]);
    assert!(
        told.contains("give the capture of this scene") && !Path::new(&place.at("other.html")).exists(),
        "{told}"
    );

    white(&place);
}

/// Colours balanced by hand.
fn white(place: &Place) {
    let view =
        std::fs::read_dir(place.at("tiny/images")).unwrap().flatten().map(|e| e.file_name()).min().unwrap();
    let view = view.to_string_lossy().into_owned();
    // Any place that is bright enough: the tiny scene has hardly any grey.
    let spots = ["48,40", "30,50", "60,50", "20,40", "70,40", "48,56"].map(|spot| format!("{view}:{spot}"));
    let grey = spots.iter().find(|spot| said(place, &["white", "out", spot]).0 == Some(0));
    let grey = grey.expect("a place that has a colour");
    let kept = place.at("out/tiny/enhanced-scene.white.json");
    let json: serde_json::Value = serde_json::from_slice(&std::fs::read(&kept).unwrap()).unwrap();
    assert_eq!((json["format"].as_str(), json["method"].as_str()), (Some("3d-use white"), Some("patch")));
    let told = expect(place, 0, &["export", "out", "--ply", "white.ply", "--what", "clear"]);
    assert!(told.contains("white balance: ") && told.contains("--white off"), "{told}");
    expect(place, 0, &["export", "out", "--ply", "off.ply", "--what", "clear", "--white", "off"]);
    let bytes = |name: &str| std::fs::read(place.at(name)).unwrap();
    assert_ne!(bytes("white.ply"), bytes("off.ply"));
    // The page opens with it, and after its removal everything is as before.
    expect(place, 0, &["export", "out", "--web", "white.html"]);
    assert!(String::from_utf8_lossy(&bytes("white.html")).contains("3d-use white"));
    expect(place, 0, &["white", "out", "off"]);
    assert!(!Path::new(&kept).exists());
    expect(place, 0, &["export", "out", "--ply", "again.ply", "--what", "clear"]);
    assert_eq!(bytes("again.ply"), bytes("off.ply"));
    // The same balance by a file, and for one command only.
    expect(place, 0, &["white", "out", grey, "-o", "my.white.json"]);
    expect(place, 0, &["export", "out", "--ply", "file.ply", "--what", "clear", "--white", "my.white.json"]);
    expect(place, 0, &["export", "out", "--ply", "once.ply", "--what", "clear", "--white", grey]);
    assert_eq!((bytes("file.ply"), bytes("once.ply")), (bytes("white.ply"), bytes("white.ply")));

    assert!(expect(place, 2, &["white", "out", "nothing.jpg:1,2"]).contains("no photograph of this name"));
    assert!(expect(place, 2, &["white", "out", &format!("{view}:9999,2")]).contains("outside the picture"));
    assert!(expect(place, 2, &["white", "out/tiny/enhanced-scene", "reef"]).contains("--cameras CAPTURE"));
    assert!(expect(place, 2, &["white", "out", "patch"]).contains("812,430"));
}

#[test]
fn common_flags_are_spellings_of_settings_and_are_refused_by_their_own_names() {
    let place = Place::new();
    let refused = |arguments: &[&str], parts: &[&str]| {
        let told = expect(&place, 2, arguments);
        assert!(parts.iter().all(|part| told.contains(part)), "{arguments:?}: {told}");
    };
    refused(&["plan", "tiny", "--size", "640"], &["--size 640: ", "1400x933"]);
    refused(&["plan", "tiny", "--iterations", "none"], &["--iterations"]);
    refused(&["import", "tiny", "-o", "x", "--size", "640"], &["--size 640: "]);
    refused(&["plan", "tiny", "--size", "64x48", "--max-side", "64"], &["cannot be used with"]);
    let plan = |arguments: &[&str]| {
        let all = [&["plan", "tiny", "--cache", "cache", "--json"], arguments].concat();
        expect(&place, 0, &all)
    };
    let flags = plan(&["--iterations", "77", "--max-side", "64"]);
    let sets = plan(&["--set", "reconstruct.iterations=77", "--set", "import.max_side=64"]);
    let keys = |text: &str| {
        let plan: serde_json::Value = serde_json::from_str(text).unwrap();
        plan["nodes"].as_array().unwrap().iter().map(|node| node["key"].clone()).collect::<Vec<_>>()
    };
    assert_eq!(keys(&flags), keys(&sets));
    // Options of `run` have no effect on verbs that ignore them.
    expect(&place, 0, &["status", "tiny", "--cache", "cache", "--out", "x", "-j", "2", "--keep-going"]);
    // A folder without a model is refused in one line, before anything else.
    std::fs::create_dir(place.at("empty")).unwrap();
    let told = expect(&place, 2, &["run", "empty", "--cache", "cache", "-o", "x"]);
    assert!(told.lines().count() == 1 && told.contains("the folder is empty"), "{told}");
}

#[test]
fn the_program_tells_what_it_is_and_what_it_can_do() {
    let place = Place::new();
    let told = expect(&place, 0, &["-V"]);
    assert!(
        told.contains("commit ") && told.contains("features: ") && told.contains("engines: cpu"),
        "{told}"
    );
    let told = expect(&place, 0, &["doctor"]);
    for part in ["processor", "cache", "ffmpeg", "colmap", "programs that help", "graphics cards"] {
        assert!(told.contains(part), "{part}: {told}");
    }
    let (_, json, _) = said(&place, &["doctor", "--json"]);
    let report: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert!(report["machine"].as_array().is_some_and(|list| !list.is_empty()), "{json}");
}

#[test]
fn a_table_of_stage_1_needs_no_stage_2_and_presets_reach_every_verb() {
    let place = Place::new();
    let text = "name = \"t\"\nstage2 = false\n[defaults.reconstruct]\niterations = 20\n[[scene]]\nname = \"tiny\"\n\
                capture = \"tiny\"\n[[variant]]\nname = \"full\"\n[[variant]]\nname = \"plain\"\npreset = \"vanilla\"\n";
    std::fs::write(place.at("t.toml"), text).unwrap();
    let run = |extra: &[&str]| {
        let mut arguments = vec!["run", "t.toml", "--cache", "cache", "-o", "out"];
        arguments.extend(extra);
        expect(&place, 0, &arguments)
    };
    let until = run(&["--until", "evaluate"]);
    assert!(until.contains("--until evaluate: this leaves out tables/ and report.html"), "{until}");
    assert!(!Path::new(&place.at("out/tables")).exists());
    let whole = run(&[]);
    assert!(!whole.contains("leaves out") && !whole.contains("warning: rows"), "{whole}");
    let table = std::fs::read_to_string(place.at("out/tables/ablation-stage1.md")).unwrap();
    for words in ["| full", "| plain", "steps: 20, without stage 2", "preset vanilla"] {
        assert!(table.contains(words), "{words}: {table}");
    }
    // The cost of a training step on the scene.
    let cost =
        expect(&place, 0, &["bench", "scene", "out/tiny@full", "tiny", "--views", "2", "--rounds", "1"]);
    for words in ["contributing pairs", "2 views", "compose backward", "of the limit"] {
        assert!(cost.contains(words), "{words}: {cost}");
    }
    let page = std::fs::read_to_string(place.at("out/tiny@plain/report.html")).unwrap();
    assert!(page.contains("Stage 2 was left out"), "the page of a result");
    let made =
        ["targets", "enhance"].map(|stage| Path::new(&place.at("cache/v1/artifacts")).join(stage).exists());
    assert_eq!(made, [false; 2]);
    let plan = expect(
        &place,
        0,
        &["plan", "t.toml", "--cache", "cache", "--set", "variant.plain.import.max_side=64"],
    );
    assert!(
        plan.contains("warning: rows of one table differ in views: import.max_side is 0 for variant full"),
        "{plan}"
    );
    // Stages by hand take a preset, too.
    expect(&place, 0, &["import", "tiny", "--preset", "paper", "--out", "prepared"]);
    let prepared: serde_json::Value =
        serde_json::from_slice(&std::fs::read(place.at("prepared/report.json")).unwrap()).unwrap();
    assert!(prepared["split_rule"].as_str().unwrap().contains("COLMAP image id"), "{prepared}");
    let scene = ["reconstruct", "prepared", "--preset", "vanilla", "--steps", "10", "--out", "scene"];
    expect(&place, 0, &scene);
    let scene: serde_json::Value =
        serde_json::from_slice(&std::fs::read(place.at("scene/scene.json")).unwrap()).unwrap();
    assert_eq!(scene["medium"]["kind"], "none");
    let wrong = expect(&place, 2, &["reconstruct", "tiny", "--preset", "papre", "--out", "x"]);
    assert!(wrong.contains("--preset papre: no preset `papre`") && wrong.contains("`paper`"), "{wrong}");
}
