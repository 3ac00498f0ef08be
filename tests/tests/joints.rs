//! Checks the joints at which methods are extended: the number of source files that a further entry touches
//! is counted for an existing entry.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Every source of a crate without its tests: path below the workspace, text.
fn sources() -> Vec<(String, String)> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the workspace");
    let mut open: Vec<PathBuf> = vec![root.join("crates")];
    let mut found = Vec::new();
    while let Some(path) = open.pop() {
        let name = path.file_name().and_then(|n| n.to_str()).unwrap_or_default();
        if path.is_dir() && !["tests", "benches", "examples"].contains(&name) {
            open.extend(std::fs::read_dir(&path).expect("a folder").map(|e| e.expect("an entry").path()));
        } else if name.ends_with(".rs") && !name.ends_with("tests.rs") {
            let text = std::fs::read_to_string(&path).expect("a source");
            let tests = ["#[cfg(test)]\nmod ", "#[cfg(all(test, feature = \"gpu\"))]\nmod "];
            let end = tests.iter().filter_map(|begin| text.find(begin)).min().unwrap_or(text.len());
            let text = &text[..end];
            let code: Vec<&str> = text.lines().filter(|line| !line.trim_start().starts_with("//")).collect();
            let below = path.strip_prefix(root).expect("below the workspace").to_string_lossy();
            // Another engine has kernels of its own, and refuses by name the methods for which it has none.
            if below.replace('\\', "/").starts_with("crates/gpu/") {
                continue;
            }
            found.push((below.replace('\\', "/"), code.join("\n")));
        }
    }
    found
}

/// Files whose code contains any of these words as a whole word.
fn files_with(sources: &[(String, String)], words: &[&str]) -> BTreeSet<String> {
    let part = |c: char| c.is_alphanumeric() || c == '_';
    let has = |text: &str, word: &str| {
        text.match_indices(word)
            .any(|(at, _)| !text[..at].ends_with(part) && !text[at + word.len()..].starts_with(part))
    };
    let files = sources.iter().filter(|(_, text)| words.iter().any(|word| has(text, word)));
    files.map(|(path, _)| path.clone()).collect()
}

fn set(files: &[&str]) -> BTreeSet<String> {
    files.iter().map(|f| (*f).to_string()).collect()
}

#[test]
fn a_term_of_stage_ones_loss_is_one_file_one_row_and_the_parameter_of_its_weight() {
    let sources = sources();
    // Only the term itself defines the name of its value in the log.
    for name in use3d_reconstruct::losses::names() {
        let files = files_with(&sources, &[name]);
        assert_eq!(files.len(), 1, "`{name}` is named in {files:?}");
        assert!(files.iter().all(|f| f.starts_with("crates/reconstruct/src/losses/")), "{files:?}");
    }
    // The depth term, by all of its words. The stage reports if it has no weight.
    let files = files_with(&sources, &["DepthPriorLoss", "depth_loss", "depth_weight", "depth::TERM"]);
    let expected = set(&[
        "crates/reconstruct/src/losses/depth.rs",
        "crates/reconstruct/src/losses/mod.rs",
        "crates/reconstruct/src/params.rs",
        "crates/stages/src/reconstruct.rs",
    ]);
    assert_eq!(files, expected);
}

#[test]
fn a_kind_of_parameters_per_view_is_one_file_and_one_field_of_the_state() {
    // The gains, by the words of their type: their own file, the state, and the step that applies them. The
    // rest (Adam, checkpoints, checks) is the same for every kind, and so is the rate of a phase.
    let files = files_with(&sources(), &["Exposures::new", "log_gains"]);
    let expected = set(&[
        "crates/reconstruct/src/exposure.rs",
        "crates/reconstruct/src/engine/state.rs",
        "crates/reconstruct/src/engine/cpu.rs",
        "crates/reconstruct/src/peek.rs",
    ]);
    assert_eq!(files, expected);
}

#[test]
fn a_colour_field_is_one_file_and_one_row() {
    let files = files_with(&sources(), &["CAUSTICS", "Self::Caustics"]);
    let folder = "crates/reconstruct/src/colors";
    assert_eq!(files, set(&[&format!("{folder}/caustics.rs"), &format!("{folder}/mod.rs")]));
}

#[test]
fn a_phase_of_a_training_is_a_row_and_the_parameter_of_its_start() {
    let files = files_with(&sources(), &["medium_hold", "medium_release"]);
    let expected = set(&["crates/reconstruct/src/phases.rs", "crates/reconstruct/src/params.rs"]);
    assert_eq!(files, expected);
}

#[test]
fn a_medium_is_one_file_and_one_row() {
    let sources = sources();
    for (name, kind) in [
        ("mlp", "Mlp"),
        ("rbf", "Rbf"),
        ("global", "Global"),
        ("seasplat", "Seasplat"),
        ("per_view", "PerView"),
        ("uir", "Uir"),
    ] {
        let file = format!("crates/medium/src/{name}.rs");
        let words: Vec<String> = ["Medium", "Medium::", "MediumKind::", "MediumModel::"]
            .iter()
            .map(|owner| format!("{owner}{kind}"))
            .collect();
        let words: Vec<&str> = words.iter().map(String::as_str).collect();
        let expected = set(&[&file, "crates/medium/src/kinds.rs", "crates/medium/src/lib.rs"]);
        assert_eq!(files_with(&sources, &words), expected, "{words:?}");
    }
    // Water over the image is the same water as `global`, applied at another place. It is a row without a
    // file, and the rows make its names.
    let names = ["MediumKind::Image", "MediumModel::Image", "Medium::Image"];
    assert_eq!(files_with(&sources, &names), BTreeSet::new());
}

#[test]
fn the_rooms_of_splat_stand_one_below_the_other() {
    let below = [("project", &["crate::lists", "crate::compose"][..]), ("lists", &["crate::compose"])];
    for (room, above) in below {
        let place = format!("crates/splat/src/{room}/");
        let files: Vec<(String, String)> =
            sources().into_iter().filter(|(f, _)| f.starts_with(&place)).collect();
        assert!(files.len() >= 3, "{room}: {files:?}");
        assert_eq!(files_with(&files, above), BTreeSet::new(), "{room} looks up");
    }
}

#[test]
fn a_tiles_list_is_walked_in_one_place() {
    let place = "crates/splat/src/compose/lanes/";
    let files: Vec<(String, String)> = sources().into_iter().filter(|(f, _)| f.starts_with(place)).collect();
    let walker = format!("{place}batch.rs");
    // The code that reads the list, and the code that looks up a Gaussian in it.
    assert_eq!(files_with(&files, &["list", "cells_met"]), set(&[&walker]));
    let kernels = ["forward", "backward", "colors", "linear"].map(|file| format!("{place}{file}.rs"));
    let kernels: BTreeSet<String> = kernels.into_iter().collect();
    assert_eq!(files_with(&files, &["walk"]), kernels.into_iter().chain([walker]).collect());
}

#[test]
fn a_term_of_stage_twos_loss_is_one_file_and_one_row() {
    let sources = sources();
    let table = "crates/enhance/src/losses/mod.rs";
    for row in use3d_enhance::losses::TERMS {
        // The row of a term gives its weight, value, line of the log, place in the report and curve.
        let file = format!("crates/enhance/src/losses/{}.rs", row.name);
        let entry = format!("{}::TERM", row.name);
        assert_eq!(files_with(&sources, &[&entry]), set(&[table]), "{entry}");
        // Only its own file contains its name; the stage names the figures by which classes of arithmetic are
        // compared.
        let quoted = format!("\"{}\"", row.name);
        let named: BTreeSet<String> = sources
            .iter()
            .filter(|(path, text)| path.starts_with("crates/enhance/") && text.contains(&quoted))
            .map(|(path, _)| path.clone())
            .collect();
        assert_eq!(named, set(&[&file]), "{}", row.name);
    }
    // The total variation, by all of its words: the formula, its term and the parameter of its weight.
    let files = files_with(&sources, &["lambda_variation", "variation::forward", "variation::backward"]);
    let expected = set(&["crates/enhance/src/losses/variation.rs", "crates/enhance/src/params.rs"]);
    assert_eq!(files, expected);
}

#[test]
fn what_golden_cases_share_is_read_in_one_place() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the workspace").join("crates");
    let (mut open, mut found) = (vec![root.clone()], BTreeSet::new());
    while let Some(path) = open.pop() {
        if path.is_dir() {
            open.extend(std::fs::read_dir(&path).expect("a folder").map(|e| e.expect("an entry").path()));
        } else if path.extension().is_some_and(|e| e == "rs") {
            let text = std::fs::read_to_string(&path).expect("a source");
            if ["in.R_cw", "in.opacity_logits"].iter().any(|name| text.contains(name)) {
                let below = path.strip_prefix(&root).expect("below the crates").to_string_lossy();
                found.insert(below.replace('\\', "/"));
            }
        }
    }
    assert_eq!(
        found,
        set(&["golden/src/fixtures.rs"]),
        "`Case::camera` and `Case::gaussians` are there for it"
    );
}
