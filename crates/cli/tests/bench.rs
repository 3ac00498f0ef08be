//! Tests `use3d bench truth` on tiny captures: every figure exists and is finite, an interrupted call
//! continues, and files of the user stay.

mod tiny;

use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, SystemTime};

use serde_json::Value;
use tiny::{TINY, command, files};
use use3d_io_image::read_image;

/// The smallest benchmark; the arguments in `extra` replace its own.
fn bench(out: &Path, extra: &[&str]) -> Command {
    let own = [
        ("--captures", "display-III,spectral"),
        ("--size", "48x32"),
        ("--views", "9"),
        ("--seeds", "7"),
        ("--iterations", "20"),
    ];
    let mut command = command();
    command.args(["-q", "bench", "truth", "--out"]).arg(out);
    for (flag, value) in own.into_iter().filter(|(flag, _)| !extra.contains(flag)) {
        command.args([flag, value]);
    }
    for set in TINY.iter().filter(|set| !set.contains("iterations")) {
        command.args(["--set", set]);
    }
    command.args(extra);
    command
}

fn run(out: &Path, extra: &[&str]) -> (Option<i32>, String, String) {
    let Output { status, stdout, stderr } = bench(out, extra).output().expect("the command starts");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (status.code(), text(&stdout), text(&stderr))
}

/// The time at which every artifact in the cache was finished.
fn made(out: &Path) -> BTreeMap<String, SystemTime> {
    let artifacts = out.join("cache/v1/artifacts");
    let manifests = files(&artifacts).into_keys().filter(|path| path.ends_with("manifest.json"));
    manifests
        .map(|path| {
            let at = std::fs::metadata(artifacts.join(&path)).and_then(|m| m.modified()).expect("a time");
            (path.to_string_lossy().into_owned(), at)
        })
        .collect()
}

fn number(row: &Value, metric: &str) -> f64 {
    row["figures"][metric]["mean"].as_f64().unwrap_or_else(|| panic!("{metric} of {row}"))
}

#[test]
fn every_row_has_its_figures_and_an_interrupted_call_goes_on() {
    let dir = tempfile::tempdir().expect("a folder");
    let out = dir.path().join("bench");
    // Killed as soon as a scene is trained.
    let mut child = bench(&out, &[]).stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("starts");
    let trained = || made(&out).keys().any(|path| path.starts_with("reconstruct"));
    while !trained() {
        assert!(child.try_wait().expect("a state").is_none(), "it ended before a scene was trained");
        std::thread::sleep(Duration::from_millis(2));
    }
    child.kill().expect("killed");
    child.wait().expect("gone");
    assert!(!out.join("truth.md").exists());
    let before = made(&out);

    let (code, stdout, stderr) = run(&out, &["--json"]);
    assert_eq!(code, Some(0), "{stdout}{stderr}");
    let after = made(&out);
    for (path, at) in &before {
        assert_eq!(after.get(path), Some(at), "{path} was made again");
    }
    assert!(after.len() > before.len());

    let figures: Value = serde_json::from_str(&stdout).expect("JSON");
    assert_eq!(figures["format"], "3d-use bench truth");
    assert!(!stdout.contains("null"), "{stdout}");
    let captures = figures["captures"].as_array().expect("captures");
    assert_eq!(captures.len(), 2);
    for capture in captures {
        let rows = capture["rows"].as_array().expect("rows");
        let labels: Vec<&str> = rows.iter().filter_map(|r| r["label"].as_str()).collect();
        let simple = [
            "photographs",
            "2D enhancer on photographs",
            "2D enhancer on stage-1 renders",
            "enhance, then reconstruct",
            "pseudo-labels",
        ];
        assert_eq!(labels[..5], simple);
        for ours in ["`clear`", "`enhanced`", "`clear`, `medium_prior = \"off\"`"] {
            assert!(labels[5..].contains(&ours), "{labels:?}");
        }
        for (row, label) in rows.iter().zip(&labels) {
            for suffix in ["_raw", "", "_channel", "_affine"] {
                let psnr = number(row, &format!("truth_psnr{suffix}"));
                let delta_e = number(row, &format!("truth_delta_e{suffix}"));
                assert!(psnr > 0.0 && psnr < 60.0, "{label}: {psnr}");
                assert!(delta_e > 0.0 && delta_e < 100.0, "{label}: {delta_e}");
            }
            // Photographs exist at captured cameras only.
            if !label.contains("photograph") || label.starts_with("2D enhancer on stage") {
                assert!(number(row, "path_w_delta_e") >= 0.0, "{label}");
                // Such small pictures may share no whole window; then the document gives the reason.
                let similarity = &row["figures"]["path_w_ssim"];
                let why = similarity["of"]["7"]["undefined"].as_str();
                assert!(similarity["mean"].as_f64().is_some_and(|v| v <= 1.0) || why.is_some(), "{row}");
            }
        }
        let scenes = capture["scenes"].as_array().expect("scenes");
        let water: usize =
            scenes.iter().filter(|s| s["figures"].get("attenuation_error_worst").is_some()).count();
        let stage1 = scenes.last().expect("stage 1");
        assert!(number(stage1, "held_out_psnr") > 0.0 && number(stage1, "depth_error") > 0.0);
        if capture["name"] == "display-III" {
            assert_eq!((scenes.len(), water), (3, 2), "no water is learnt from enhanced photographs");
            assert!(number(stage1, "backscatter_error_median") <= number(stage1, "backscatter_error_worst"));
        } else {
            assert_eq!(water, 0, "spectral water has no true coefficient");
        }
        let name = capture["name"].as_str().expect("a name");
        let picture = read_image(&out.join("pictures").join(format!("{name}.png"))).expect("a picture");
        assert_eq!((picture.width(), picture.height()), (5 * 48 + 4 * 6, 32));
    }
    let page = std::fs::read_to_string(out.join("truth.md")).expect("a page");
    assert!(page.contains("--captures display-III,spectral --seeds 7 --size 48x32"), "{page}");

    // A second call: the same to the byte, and nothing is computed; the same with fewer baselines.
    let whole = files(&out.join("pictures"));
    let (code, again, stderr) = run(&out, &["--json"]);
    assert_eq!((code, again == stdout), (Some(0), true), "{stderr}");
    assert_eq!(std::fs::read_to_string(out.join("truth.md")).expect("a page"), page);
    let (code, fewer, stderr) = run(&out, &["--json", "--baselines", "simple"]);
    assert_eq!(code, Some(0), "{stderr}");
    let fewer: Value = serde_json::from_str(&fewer).expect("JSON");
    let row = |figures: &Value, label: &str| {
        let rows = figures["captures"][0]["rows"].as_array().expect("rows").clone();
        rows.into_iter().find(|r| r["label"] == label)
    };
    assert!(row(&fewer, "pseudo-labels").is_none());
    assert_eq!(row(&fewer, "`clear`"), row(&figures, "`clear`"));
    assert_eq!(made(&out), after, "nothing was computed again");
    assert_eq!(files(&out.join("pictures")).len(), whole.len());
}

#[test]
fn what_is_foreign_or_wrong_is_refused_before_anything_is_made() {
    let dir = tempfile::tempdir().expect("a folder");
    for theirs in ["truth.md", "truth.json", "pictures/holiday.png", "captures/spectral-seed-7/notes.txt"] {
        let out = dir.path().join(theirs.replace('/', "-"));
        let file = out.join(theirs);
        std::fs::create_dir_all(file.parent().expect("a folder")).expect("made");
        std::fs::write(&file, "mine").expect("written");
        let (code, _, stderr) = run(&out, &[]);
        assert_eq!(code, Some(2), "{theirs}: {stderr}");
        let left = files(&out);
        assert_eq!(left.len(), 1, "{theirs}: {:?}", left.keys());
        assert_eq!(left.values().next().map(Vec::as_slice), Some(b"mine".as_slice()));
    }
    let out = dir.path().join("bench");
    for (extra, word) in [
        (["--captures", "reef"], "display-I, display-II"),
        (["--set", "reconstruct.medium_prior=off"], "variant.default.reconstruct.medium_prior"),
        (["--set", "reconstruct.itertions=3"], "did you mean"),
        (["--seeds", "one"], "one"),
        (["--size", "8x8"], "16 to 8192"),
        (["--views", "1"], "2 to 10000"),
    ] {
        let (code, _, stderr) = run(&out, &extra);
        assert!(code == Some(2) && stderr.contains(word), "{extra:?}: {code:?} {stderr}");
        assert!(!out.exists(), "{extra:?}");
    }
}
