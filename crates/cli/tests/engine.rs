//! Tests of the choice of engine on the command line: the messages without a card, with only a software card
//! or with another name, and a training on a software card if this machine has one.

mod tiny;

use std::process::{Command, Output};

use tiny::Place;

/// Steps of the short trainings here.
const STEPS: usize = 12;

fn reconstruct(place: &Place, out: &str, engine: &str, environment: &[(&str, &str)]) -> Output {
    training(place, out, engine, STEPS, environment)
}

/// A training of `steps` steps with a water model that has kernels on every engine.
fn training(place: &Place, out: &str, engine: &str, steps: usize, environment: &[(&str, &str)]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_use3d"));
    command.args(["reconstruct", &place.at("tiny"), "--out", &place.at(out), "--engine", engine]);
    command.args(["--set", "depth_prior=off", "--set", &format!("iterations={steps}")]);
    for name in ["USE3D_CACHE", "USE3D_MODELS", "USE3D_THREADS", "RUST_LOG"] {
        command.env_remove(name);
    }
    command.envs(environment.iter().copied()).output().expect("the command starts")
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn an_engine_that_cannot_be_had_is_refused_and_nothing_is_written() {
    let place = Place::new();
    // The variables hide all drivers of this machine.
    let nothing =
        [("VK_DRIVER_FILES", "/nonexistent/icd.json"), ("VK_ICD_FILENAMES", "/nonexistent/icd.json")];
    for (engine, parts) in [
        ("gpu", &["engine", "no graphics card was found", "--engine cpu"][..]),
        (
            "gpu:vega",
            &["the device `gpu:vega` (for reconstruct of tiny): no adapter", "libvulkan", "--engine cpu"],
        ),
        ("cuda", &["cuda", "gpu"]),
    ] {
        let output = reconstruct(&place, "refused", engine, &nothing);
        let text = said(&output);
        assert_eq!(output.status.code(), Some(2), "{engine}: {text}");
        for part in parts {
            assert!(text.contains(part), "{engine} does not say {part:?}:\n{text}");
        }
        // One message of this program, and no messages of the loader for driver developers.
        assert!(!text.contains("ERROR") && !text.contains("vkCreateInstance"), "{engine}: {text}");
        assert!(!std::path::Path::new(&place.at("refused")).exists(), "{engine}");
    }
    let output = reconstruct(&place, "auto", "auto", &nothing);
    let text = said(&output);
    assert_eq!(output.status.code(), Some(0), "{text}");
    assert!(text.contains("engine: cpu") && text.contains("no graphics card was found"), "{text}");
}

/// Returns true if a run was refused because this machine has no software card: the test is then skipped with
/// a message, or fails where a card is required.
fn no_card(output: &Output) -> bool {
    let text = said(output);
    let missing = text.contains("no graphics card was found") || text.contains("no adapter's name has");
    let refused = output.status.code() == Some(2) && missing;
    if refused {
        assert!(std::env::var("USE3D_REQUIRE_GPU").as_deref() != Ok("1"), "{text}");
        eprintln!("SKIPPED: no software card on this machine (package mesa-vulkan-drivers)");
    }
    refused
}

/// On a software card, if this machine has one: the scene agrees with the processor's to a twentieth of a
/// decibel, and training has clearly improved it.
#[test]
fn a_training_runs_on_a_software_card_by_its_name() {
    let place = Place::new();
    let output = reconstruct(&place, "card", "gpu:llvmpipe", &[]);
    let text = said(&output);
    if no_card(&output) {
        return;
    }
    assert_eq!(output.status.code(), Some(0), "{text}");
    assert!(text.contains("engine: gpu, llvmpipe"), "{text}");
    let processor = reconstruct(&place, "processor", "cpu", &[]);
    assert_eq!(processor.status.code(), Some(0), "{}", said(&processor));
    let psnr = |out: &str| {
        let file =
            std::fs::read_to_string(format!("{}/evaluation.json", place.at(out))).expect("an evaluation");
        let read: serde_json::Value = serde_json::from_str(&file).expect("JSON");
        read["held_out"]["psnr"]["value"].as_f64().expect("a figure")
    };
    let hardly = training(&place, "hardly", "cpu", 1, &[]);
    assert_eq!(hardly.status.code(), Some(0), "{}", said(&hardly));
    let (card, cpu, least) = (psnr("card"), psnr("processor"), psnr("hardly"));
    assert!((card - cpu).abs() < 0.05, "{card} dB on the card, {cpu} dB on the processor");
    assert!(card > least + 0.3, "{card} dB on the card, {least} dB after a single step");

    // Both engines draw the same scene: pictures of 8 bits differ by at most one level.
    let draw = |engine: &str| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_use3d"));
        command.args(["render", &place.at("card"), "--cameras", &place.at("tiny"), "--held-out"]);
        command.args(["--modes", "reconstruction,clear", "--out", &place.at(engine), "--engine", engine]);
        let output = command.output().expect("the command starts");
        assert_eq!(output.status.code(), Some(0), "{}", said(&output));
        said(&output)
    };
    assert!(draw("gpu:llvmpipe").contains("engine: gpu, llvmpipe"));
    draw("cpu");
    let files = |engine: &str| tiny::files(std::path::Path::new(&place.at(engine)));
    let (card, cpu) = (files("gpu:llvmpipe"), files("cpu"));
    assert!(!card.is_empty() && card.keys().eq(cpu.keys()), "{:?}", card.keys());
    for file in card.keys() {
        let read = |engine: &str| {
            let path = std::path::Path::new(&place.at(engine)).join(file);
            use3d_io_image::read_image(&path).expect("a picture")
        };
        let (card, cpu) = (read("gpu:llvmpipe"), read("cpu"));
        let off = card.data().iter().zip(cpu.data()).map(|(a, b)| (a - b).abs()).fold(0.0f32, f32::max);
        assert!(off < 1.5 / 255.0, "{}: {off}", file.display());
    }
}

/// A command with the tiny settings and the cache of `place`.
fn command_of(place: &Place, verb: &[&str], more: &[&str]) -> Command {
    let mut command = tiny::command();
    command.args(verb).args(["--cache", &place.at("cache")]);
    tiny::TINY.iter().chain(&["evaluate.neighbour_pairs=1", "evaluate.path_pairs=1"]).for_each(|set| {
        command.args(["--set", set]);
    });
    command.args(more);
    command
}

/// Runs a command as on a machine without drivers of graphics cards.
fn without_drivers(mut command: Command) -> Output {
    command.envs(["VK_DRIVER_FILES", "VK_ICD_FILENAMES"].map(|name| (name, "/nonexistent/icd.json")));
    command.output().expect("the command starts")
}

/// A whole run uses the card for both stages and for drawing; stage 2 ends where the processor's does, and
/// both engines draw and score the same scene alike.
#[test]
fn a_whole_run_on_a_software_card_trains_and_draws_there() {
    let place = Place::new();
    let command =
        |verb: &[&str], more: &[&str]| command_of(&place, verb, more).output().expect("the command starts");
    let tiny = place.at("tiny");
    let run = |out: &str, more: &[&str]| command(&["run", &tiny, "--out", &place.at(out)], more);
    let card = run("card", &["--engine", "gpu:llvmpipe"]);
    let text = said(&card);
    if no_card(&card) {
        return;
    }
    assert_eq!(card.status.code(), Some(0), "{text}");
    for stage in ["reconstruct", "targets", "enhance", "render", "evaluate"] {
        assert!(text.contains(&format!("{stage}: engine: gpu, llvmpipe")), "{stage}: {text}");
    }
    // A machine without the card knows what the card has made. It delivers it, and computes nothing in its
    // place.
    let engine = ["--engine", "gpu:llvmpipe"];
    for verb in ["plan", "status"] {
        let output = without_drivers(command_of(&place, &[verb, &tiny], &engine));
        let text = String::from_utf8_lossy(&output.stdout).into_owned() + &said(&output);
        let all = if verb == "plan" { " 0 to run" } else { "cached" };
        assert!(output.status.code() == Some(0) && text.contains(all), "{verb}: {text}");
    }
    let again = without_drivers(command_of(&place, &["run", &tiny, "--out", &place.at("again")], &engine));
    assert_eq!(again.status.code(), Some(0), "{}", said(&again));
    assert!(!said(&again).contains("engine: "), "{}", said(&again));
    // Another machine, without a card, finds no problem in the artifacts of this one.
    let verified = command(&["verify", &tiny, "--sample", "100%"], &[]);
    let found = String::from_utf8_lossy(&verified.stdout).into_owned() + &said(&verified);
    assert_eq!(verified.status.code(), Some(0), "{found}");
    assert!(found.contains("5 in another numeric class: within their stage's tolerances"), "{found}");
    // The same scene, so that only the lifting of its targets and stage 2 differ.
    let processor = run("processor", &["--set", "reconstruct.engine=gpu:llvmpipe", "--until", "enhance"]);
    assert_eq!(processor.status.code(), Some(0), "{}", said(&processor));
    // The same scenes, so that only the drawing differs.
    let trained = ["reconstruct", "targets", "enhance"].map(|stage| format!("{stage}.engine=gpu:llvmpipe"));
    let drawn = run("drawn", &["--set", &trained[0], "--set", &trained[1], "--set", &trained[2]]);
    assert_eq!(drawn.status.code(), Some(0), "{}", said(&drawn));
    let again = said(&drawn);
    assert!(!again.contains("reconstruct: engine") && !again.contains("engine: gpu"), "{again}");
    let scores = |out: &str| {
        let path = format!("{}/tiny/scores/scores.json", place.at(out));
        let read: serde_json::Value =
            serde_json::from_str(&std::fs::read_to_string(path).expect("scores")).expect("JSON");
        let methods = read["methods"].as_array().expect("methods").iter();
        let of = |method: &serde_json::Value| {
            Some((method["method"].to_string(), method["mean"]["psnr"]["value"].as_f64()?))
        };
        methods.filter_map(of).collect::<Vec<_>>()
    };
    let (card, cpu) = (scores("card"), scores("drawn"));
    assert!(card.len() == cpu.len() && card.len() >= 3, "{card:?}");
    for ((method, card), (_, cpu)) in card.iter().zip(&cpu) {
        assert!(
            (card - cpu).abs() < 1e-3,
            "{method}: {card} dB drawn on the card, {cpu} dB on the processor"
        );
    }
    let errors = |out: &str| {
        let path = format!("{}/tiny/enhanced-scene/report.json", place.at(out));
        let file = std::fs::read_to_string(path).expect("a report");
        let read: serde_json::Value = serde_json::from_str(&file).expect("JSON");
        let of = |view: &serde_json::Value| view["after"]["global"]["error"].as_f64().expect("a figure");
        read["views"].as_array().expect("views").iter().map(of).collect::<Vec<f64>>()
    };
    for (card, cpu) in errors("card").iter().zip(errors("processor")) {
        assert!((card - cpu).abs() < 1e-3 * cpu, "{card} on the card, {cpu} on the processor");
    }
}

/// The data of a software card: `devices`, and the smallest benchmark into a file.
#[test]
fn a_software_card_is_listed_and_measured_in_one_file() {
    let listed = tiny::command().args(["devices", "--json"]).output().expect("the command starts");
    let list: serde_json::Value = serde_json::from_slice(&listed.stdout).expect("JSON");
    let adapters = list["adapters"].as_array().expect("adapters");
    let has = |name: &serde_json::Value| name.as_str().is_some_and(|name| name.contains("llvmpipe"));
    let Some(card) = adapters.iter().find(|adapter| has(&adapter["name"])) else {
        assert!(std::env::var("USE3D_REQUIRE_GPU").as_deref() != Ok("1"), "{list}");
        eprintln!("SKIPPED: no software card on this machine (package mesa-vulkan-drivers)");
        return;
    };
    assert!(card["passed"] == true && card["kernels"] == "portable", "{card}");
    let text = tiny::command().arg("devices").output().expect("the command starts");
    assert!(String::from_utf8_lossy(&text.stdout).contains("kernels: portable"), "{text:?}");

    let dir = tempfile::tempdir().expect("a folder");
    let out = dir.path().join("card.json");
    let mut command = tiny::command();
    command.args(["bench", "gpu", "--device", "llvmpipe", "--sizes", "32x24", "--rounds", "2"]);
    let output =
        command.args(["--gaussians", "100", "--steps", "3", "--minutes", "60", "--out"]).arg(&out).output();
    let output = output.expect("the command starts");
    assert_eq!(output.status.code(), Some(0), "{}", said(&output));
    assert!(said(&output).contains("of the time idle"), "{}", said(&output));
    let record = std::fs::read_to_string(&out).expect("a file");
    let record: serde_json::Value = serde_json::from_str(&record).expect("JSON");
    let training = &record["trainings"][0];
    assert!(record["complete"] == true && record["failed"] == serde_json::json!([]), "{record}");
    assert!(training["steps"] == 3 && training["busy_milliseconds_per_step"].is_f64(), "{training}");

    let output = tiny::command().args(["bench", "gpu", "--read"]).arg(&out).output().expect("it starts");
    let read = String::from_utf8_lossy(&output.stdout).into_owned();
    for part in ["32 x 24, 100 Gaussians", "update of colours", "The card computes correctly"] {
        assert!(output.status.success() && read.contains(part), "{part}: {read} {}", said(&output));
    }
    let kernels = dir.path().join("kernels");
    let output =
        tiny::command().args(["bench", "gpu", "--kernels"]).arg(&kernels).output().expect("it starts");
    let texts = std::fs::read_dir(&kernels).expect("a folder").count();
    assert!(output.status.success() && texts > 100, "{texts} texts: {}", said(&output));
    let output =
        tiny::command().args(["bench", "gpu", "--read"]).arg(dir.path()).output().expect("it starts");
    assert!(
        output.status.code() == Some(2) && said(&output).contains("--read: cannot read"),
        "{}",
        said(&output)
    );
}
