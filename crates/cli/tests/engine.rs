//! The choice of engine on the command line: what is said where no card, only a software card or another name is there, and a training on a
//! software card where this machine has one.

mod tiny;

use std::process::{Command, Output};

use tiny::Place;

/// Steps of the short trainings here.
const STEPS: usize = 12;

fn reconstruct(place: &Place, out: &str, engine: &str, environment: &[(&str, &str)]) -> Output {
    training(place, out, engine, STEPS, environment)
}

/// A training of so many steps with a water that has kernels everywhere.
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
    // No driver at all, whatever this machine has.
    let nothing =
        [("VK_DRIVER_FILES", "/nonexistent/icd.json"), ("VK_ICD_FILENAMES", "/nonexistent/icd.json")];
    for (engine, parts) in [
        ("gpu", &["engine", "no graphics card was found", "--engine cpu"][..]),
        ("gpu:vega", &["engine", "vega"]),
        ("cuda", &["cuda", "gpu"]),
    ] {
        let output = reconstruct(&place, "refused", engine, &nothing);
        let text = said(&output);
        assert_eq!(output.status.code(), Some(2), "{engine}: {text}");
        for part in parts {
            assert!(text.contains(part), "{engine} does not say {part:?}:\n{text}");
        }
        assert!(!std::path::Path::new(&place.at("refused")).exists(), "{engine}");
    }
    let output = reconstruct(&place, "auto", "auto", &nothing);
    let text = said(&output);
    assert_eq!(output.status.code(), Some(0), "{text}");
    assert!(text.contains("engine: cpu") && text.contains("no graphics card was found"), "{text}");
}

/// On a software card, if this machine has one: the scene is that of the processor to a twentieth of a decibel, and not one that hardly
/// anything was done to.
#[test]
fn a_training_runs_on_a_software_card_by_its_name() {
    let place = Place::new();
    let output = reconstruct(&place, "card", "gpu:llvmpipe", &[]);
    let text = said(&output);
    if output.status.code() == Some(2)
        && (text.contains("no graphics card was found") || text.contains("no adapter's name has"))
    {
        assert!(std::env::var("USE3D_REQUIRE_GPU").as_deref() != Ok("1"), "{text}");
        eprintln!("SKIPPED: no software card on this machine (package mesa-vulkan-drivers)");
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
}
