//! Promises of messages and pages about the data and the results of others.

use std::path::Path;

fn page(path: &str) -> String {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(path);
    std::fs::read_to_string(&file).unwrap_or_else(|e| panic!("{path}: {e}"))
}

/// The message on missing pairs and the recipes send people to this page for addresses.
#[test]
fn the_page_on_data_sets_has_the_address_of_each() {
    let text = page("docs/reference/datasets.md");
    for name in ["SeaThru-NeRF", "Sea-Thru", "DRUVA", "UIEB", "LSUI", "EUVP"] {
        let row = text.lines().find(|line| line.starts_with(&format!("| {name} | <https://")));
        assert!(row.is_some(), "{name} has no address");
    }
}

#[test]
fn the_shipped_commands_make_their_tables() {
    for entry in
        std::fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("../../pipelines")).expect("pipelines")
    {
        let text = std::fs::read_to_string(entry.expect("an entry").path()).expect("a file");
        assert!(!text.contains("--until"), "a run up to a stage leaves the tables out: {text}");
    }
}

#[test]
fn pages_say_what_was_tried_and_what_is_needed() {
    // Only one of the tests with stand-ins has weights of every network: crates/cli/tests/paper_runs.rs.
    assert!(page("docs/science/not-run.md").contains("stand-in weights of Nu2Net alone"));
    let outputs = page("docs/reference/outputs.md");
    assert!(
        ["appearance", "kept_water"].iter().all(|field| outputs.contains(field)),
        "fields of enhancement"
    );
    let python = page("docs/reference/python.md");
    let (before, _) = python.split_once("python3 -m unittest").expect("the command");
    assert!(before.contains("pip install numpy"), "the tests need NumPy");
    assert!(
        !page("docs/science/determinism.md").contains("every kernel and"),
        "not every kernel has all numbers"
    );
}
