//! The pipeline files that come with the project, against the real stages; and the schema beside them.

use std::path::{Path, PathBuf};

use use3d_pipeline::config::{LoadOptions, load, schema_text};
use use3d_pipeline::engine::Graph;
use use3d_pipeline::stages::registry;

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../pipelines")
}

#[test]
fn every_shipped_pipeline_fits_the_stages() {
    let registry = registry().expect("the stage table");
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder())
        .expect("pipelines/")
        .map(|e| e.expect("entry").path())
        .filter(|p| p.extension().is_some_and(|x| x == "toml"))
        .collect();
    files.sort();
    assert!(files.len() >= 7, "{files:?}");
    for file in files {
        let pipeline = load(&registry, &file, &LoadOptions::default()).unwrap_or_else(|e| panic!("{e}"));
        let graph =
            Graph::new(&registry, &pipeline.batch).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
        assert!(!graph.nodes.is_empty());
    }
}

#[test]
fn a_scene_learnt_from_proposals_has_no_second_stage() {
    let registry = registry().expect("the stage table");
    let file = folder().join("ablation-stage2.toml");
    let pipeline = load(&registry, &file, &LoadOptions::default()).unwrap_or_else(|e| panic!("{e}"));
    let graph = Graph::new(&registry, &pipeline.batch).expect("a graph");
    let stages = |variant: &str| -> Vec<&str> {
        let nodes = graph.nodes.iter().filter(|n| n.scene == "Panama" && n.variant == variant);
        nodes.map(|n| n.stage_name).collect()
    };
    assert_eq!(
        stages("enhance-then-reconstruct"),
        ["import", "propose", "reconstruct", "render", "evaluate"]
    );
    let full = stages("full");
    assert!(full.contains(&"enhance") && !full.contains(&"propose"), "{full:?}");
}

/// `USE3D_UPDATE_SCHEMA=1 cargo test -p use3d-pipeline --test shipped` writes it anew.
#[test]
fn the_schema_is_current() {
    if cfg!(not(feature = "nets")) {
        eprintln!("skipped: the schema is that of a build with networks");
        return;
    }
    let text = schema_text(&registry().expect("the stage table"));
    let file = folder().join("schema.json");
    if std::env::var_os("USE3D_UPDATE_SCHEMA").is_some() {
        std::fs::write(&file, &text).expect("pipelines/schema.json");
    }
    let written = std::fs::read_to_string(&file).unwrap_or_default();
    assert!(
        written == text,
        "pipelines/schema.json is not that of the stages; write it anew with USE3D_UPDATE_SCHEMA=1"
    );
}
