//! Tests with the real stages on a tiny capture that each change reruns the expected stages and no others.

mod tiny;

use std::collections::BTreeSet;
use std::path::Path;

use tiny::{Place, TINY, command, files};
use use3d_workflow::Source;

#[test]
fn without_trust_proposals_stay_as_they_are() {
    let place = Place::new();
    let mut run = command();
    run.args(["-q", "run", &place.at("tiny"), "--cache", &place.at("cache"), "--until", "calibrate"]);
    for set in TINY.iter().chain(&["calibrate.trust=0"]) {
        run.args(["--set", set]);
    }
    let output = run.arg("--out").arg(place.at("out")).output().expect("the command starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let cache = files(Path::new(&place.at("cache")));
    let of_calibrate =
        |path: &Path| path.iter().any(|part| part == "calibrate") && path.ends_with("report.json");
    let (_, report) = cache.iter().find(|(path, _)| of_calibrate(path)).expect("the calibrator's report");
    let report: serde_json::Value = serde_json::from_slice(report).expect("JSON");
    // There is no fit whose result would not be used; the pairs give the scales.
    assert_eq!((report["steps"].as_u64(), report["pairs"].as_u64()), (Some(0), Some(8)), "{report}");
    assert!(report["held_out"].is_null(), "{report}");

    // A sample of this cache needs the settings of the run; a sample that checked nothing is no success.
    let verify = |more: &[&str]| {
        let mut verify = command();
        verify
            .args(["verify", &place.at("tiny"), "--sample", "1%", "--cache", &place.at("cache")])
            .args(more);
        let output = verify.output().expect("the command starts");
        let text = [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
        (output.status.code(), text.concat())
    };
    let sets: Vec<&str> = TINY.iter().chain(&["calibrate.trust=0"]).flat_map(|s| ["--set", *s]).collect();
    let (code, said) = verify(&sets);
    assert_eq!(code, Some(0), "{said}");
    assert!(said.contains(" stages of this pipeline 2 are in the cache, 1 computed again"), "{said}");
    let (code, said) = verify(&["--set", "import.downscale=2", "--set", "pairs.extractor.cells=9"]);
    assert_eq!(code, Some(1), "{said}");
    assert!(said.contains("nothing of this pipeline is in the cache"), "{said}");
}

/// A stage and all stages that read its result, directly or not, in alphabetical order.
fn readers(stage: &str) -> Vec<String> {
    let registry = use3d_stages::registry().expect("the stage table");
    let mut found = BTreeSet::from([stage.to_string()]);
    for stage in registry.stages() {
        if stage.inputs.iter().any(|i| matches!(i.source, Source::Stage(from) if found.contains(from))) {
            found.insert(stage.name().to_string());
        }
    }
    found.into_iter().collect()
}

#[test]
fn a_change_reruns_its_stage_and_what_reads_the_changed_output() {
    let place = Place::new();
    let all = place.computed(&[]);
    assert!(place.computed(&[]).is_empty(), "a second run computes nothing");
    for change in [
        "pairs.extractor.cells=8",
        "calibrate.steps=21",
        "import.split.every=4",
        "reconstruct.iterations=31",
        "targets.consensus.measure_order=true",
        "enhance.lambda_variation=0.001",
        "photographs.keep_light=0.5",
        "render.strength=0.5",
        "render.water=0.5",
        "report.views=1",
    ] {
        let own = change.split('.').next().expect("a stage");
        let stages: Vec<String> = readers(own).into_iter().filter(|s| all.contains(s)).collect();
        let computed = place.computed(&[change]);
        // Early cut-off: a stage whose inputs came out with the same bytes does not run again.
        let surplus: Vec<&String> = computed.iter().filter(|s| !stages.contains(s)).collect();
        assert!(surplus.is_empty(), "{change} also reran {surplus:?}");
        assert!(computed.iter().any(|s| s == own), "{change} reran {computed:?}");
        if own != "targets" {
            assert_eq!(computed, stages, "{change}");
        }
        assert!(place.computed(&[change]).is_empty(), "{change}, again");
    }

    // After touched files, another folder or another number of threads, nothing runs.
    let images = place.dir.path().join("tiny/images");
    for entry in std::fs::read_dir(&images).expect("images").flatten() {
        let bytes = std::fs::read(entry.path()).expect("an image");
        std::fs::write(entry.path(), bytes).expect("written again");
    }
    assert!(place.computed(&[]).is_empty(), "touched files");
    std::fs::create_dir(place.dir.path().join("elsewhere")).expect("a folder");
    std::fs::rename(place.dir.path().join("tiny"), place.dir.path().join("elsewhere/tiny")).expect("moved");
    let moved = place.run("elsewhere/tiny", "cache", &[]).args(["--threads", "1"]).output().expect("runs");
    let text = String::from_utf8_lossy(&moved.stdout);
    let cached = format!("0 stages done, {} kept from before", all.len());
    assert!(moved.status.success() && text.contains(&cached), "{text}");
}
