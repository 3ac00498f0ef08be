//! The pipeline files that come with the project: scenes, sizes, groups and variants of the paper.

use std::collections::BTreeMap;
use std::path::Path;

use use3d_config::{LoadOptions, Pipeline, from_text};
use use3d_stages::registry;
use use3d_workflow::Graph;

fn shipped(name: &str) -> Pipeline {
    let text = use3d_config::shipped(name).expect("a shipped pipeline");
    let registry = registry().expect("the stage table");
    let file = Path::new(name).with_extension("toml");
    from_text(&registry, &text, &file, &LoadOptions::default()).unwrap_or_else(|e| panic!("{e}"))
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
        ("seathru4", vec![seathru.clone()]),
        ("druva20", vec![druva.clone()]),
        ("d3-d5", vec![d3.clone(), d5.clone()]),
        ("paper", vec![seathru.clone(), druva.clone(), d3.clone(), d5.clone()]),
        ("use26", vec![seathru.clone(), druva, d3, d5]),
        ("ablation-stage1", vec![seathru.clone()]),
        ("ablation-stage2", vec![seathru]),
    ] {
        let pipeline = shipped(file);
        assert_eq!(census(&pipeline), expected.into_iter().collect(), "{file}");
        assert_eq!(pipeline.batch.name, file);
        assert!(pipeline.keep_going);
        assert_eq!(pipeline.batch.seed, 42);
        // The ablation of stage 1 learns from no pairs.
        let has_pairs = pipeline.batch.externals.contains_key("pairs.input");
        assert_eq!(has_pairs, file != "ablation-stage1", "{file}");
    }
    assert_eq!(shipped("demo").batch.scenes.len(), 1);
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
        variants("ablation-stage1"),
        ["full", "vanilla", "mlp", "rbf-without-depth", "rbf-without-prior"]
    );
    assert_eq!(
        variants("ablation-stage2"),
        ["full", "local-only", "global-only", "pseudo-labels", "enhance-then-reconstruct"]
    );
    let counts =
        ["pairs", "calibrate", "reconstruct", "targets", "enhance", "photographs", "evaluate", "report"];
    // Table 3 is of stage 1: it needs nothing of stage 2, and the report makes it.
    assert_eq!(counts.map(|stage| own("ablation-stage1", stage)), [0, 0, 20, 0, 0, 0, 20, 1]);
    let counts = ["import", "reconstruct", "enhance"].map(|stage| own("ablation-stage2", stage));
    // Learning from proposals is a different first stage, and needs no second one.
    assert_eq!(counts, [4, 8, 16]);
}

#[test]
fn the_papers_file_computes_ablations_on_their_scenes_alone() {
    let graph = Graph::new(&registry().expect("the stage table"), &shipped("paper").batch).expect("a graph");
    let own =
        |stage: &str| graph.nodes.iter().filter(|n| n.stage_name == stage && n.same_as.is_none()).count();
    // 26 scenes; four more trainings of stage 1 on four of them, and reconstruction from proposals.
    let counts = ["pairs", "import", "reconstruct", "enhance", "evaluate", "report"].map(own);
    assert_eq!(counts, [1, 26, 26 + 4 * 5, 26 + 4 * 3, 26 + 4 * 8, 1]);
    let variants = |scene: &str| {
        let nodes = graph.nodes.iter().filter(|n| n.scene == scene && n.stage_name == "evaluate");
        nodes.map(|n| n.variant.as_str()).collect::<Vec<_>>()
    };
    assert_eq!((variants("A1"), variants("Panama").len()), (vec!["full"], 9));
    let text = "name = \"x\"\n[[scene]]\nname = \"a\"\ncapture = \"a\"\ngroup = \"reefs\"\n\
                [[variant]]\nname = \"v\"\ngroups = [\"reef\"]";
    let file = Path::new("x.toml");
    let registry = registry().expect("the stage table");
    let wrong = from_text(&registry, text, file, &LoadOptions::default()).unwrap_err().to_string();
    assert!(wrong.contains("x.toml:8") && wrong.contains("did you mean `reefs`?"), "{wrong}");
}
