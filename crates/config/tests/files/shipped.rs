//! The pipeline files that come with the project: scenes, sizes, groups and variants of the paper.

use std::collections::BTreeMap;
use std::path::Path;

use use3d_config::{LoadOptions, Pipeline, load};
use use3d_stages::registry;
use use3d_workflow::Graph;

fn shipped(name: &str) -> Pipeline {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../pipelines").join(name);
    let registry = registry().expect("the stage table");
    load(&registry, &file, &LoadOptions::default()).unwrap_or_else(|e| panic!("{e}"))
}

/// The number of scenes for each group and size.
fn census(pipeline: &Pipeline) -> BTreeMap<(String, String), usize> {
    let mut census = BTreeMap::new();
    for scene in &pipeline.batch.scenes {
        let size = scene.overrides["import"]["size"].as_str().unwrap_or_default().to_string();
        *census.entry((scene.group.clone(), size)).or_default() += 1;
    }
    census
}

#[test]
fn all_26_scenes_of_the_paper_are_there() {
    let entry = |group: &str, size: &str, count: usize| ((group.to_string(), size.to_string()), count);
    let seathru = entry("SeaThru-4", "1400x933", 4);
    let druva = entry("DRUVA-20", "1920x1080", 20);
    let (d3, d5) = (entry("D3", "1400x933", 1), entry("D5", "1400x933", 1));
    for (file, expected) in [
        ("seathru4.toml", vec![seathru.clone()]),
        ("druva20.toml", vec![druva.clone()]),
        ("d3-d5.toml", vec![d3.clone(), d5.clone()]),
        ("use26.toml", vec![seathru.clone(), druva, d3, d5]),
        ("ablation-stage1.toml", vec![seathru.clone()]),
        ("ablation-stage2.toml", vec![seathru]),
    ] {
        let pipeline = shipped(file);
        assert_eq!(census(&pipeline), expected.into_iter().collect(), "{file}");
        assert_eq!(format!("{}.toml", pipeline.batch.name), file);
        assert_eq!(pipeline.batch.seed, 42);
        // The ablation of stage 1 learns from no pairs.
        let has_pairs = pipeline.batch.externals.contains_key("pairs.input");
        assert_eq!(has_pairs, file != "ablation-stage1.toml", "{file}");
    }
    assert_eq!(shipped("demo.toml").batch.scenes.len(), 1);
}

#[test]
fn ablations_share_what_they_do_not_change() {
    let own = |file: &str, stage: &str| {
        let graph = Graph::new(&registry().expect("the stage table"), &shipped(file).batch).expect("a graph");
        graph.nodes.iter().filter(|n| n.stage_name == stage && n.same_as.is_none()).count()
    };
    let variants =
        |file: &str| shipped(file).batch.variants.iter().map(|v| v.name.clone()).collect::<Vec<_>>();
    assert_eq!(
        variants("ablation-stage1.toml"),
        ["vanilla", "mlp", "rbf-without-depth", "rbf-without-prior", "full"]
    );
    assert_eq!(
        variants("ablation-stage2.toml"),
        ["local-only", "global-only", "full", "pseudo-labels", "enhance-then-reconstruct"]
    );
    let counts =
        ["pairs", "calibrate", "reconstruct", "targets", "enhance", "photographs", "evaluate", "report"];
    // Table 3 is of stage 1: it needs nothing of stage 2, and the report makes it.
    assert_eq!(counts.map(|stage| own("ablation-stage1.toml", stage)), [0, 0, 20, 0, 0, 0, 20, 1]);
    let counts = ["import", "reconstruct", "enhance"].map(|stage| own("ablation-stage2.toml", stage));
    // Learning from proposals is a different first stage, and needs no second one.
    assert_eq!(counts, [4, 8, 16]);
}
