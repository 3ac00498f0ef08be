//! Remarks before a run: rows that are not comparable, and tables that are left out.

use std::path::Path;

use use3d_config::{LoadOptions, from_text};
use use3d_judge::configuration::Configuration;
use use3d_pipeline::remarks::{unequal, without_tables};
use use3d_stages::registry;
use use3d_workflow::Graph;

/// The warnings of a pipeline with two variants and these lines in the second.
fn warnings(top: &str, second: &str) -> Vec<String> {
    let text = format!(
        "name = \"x\"\n{top}\n[[scene]]\nname = \"a\"\ncapture = \"a\"\n[[variant]]\nname = \"full\"\n\
         [[variant]]\nname = \"other\"\n{second}\n"
    );
    let registry = registry().expect("the stage table");
    let pipeline = from_text(&registry, &text, Path::new("x.toml"), &LoadOptions::default());
    let batch = pipeline.unwrap_or_else(|e| panic!("{e}")).batch;
    unequal(&Graph::new(&registry, &batch).expect("a graph"), &batch)
}

#[test]
fn rows_that_differ_in_steps_split_views_or_pairs_are_named() {
    for same in ["", "preset = \"plenodium\"", "reconstruct = { medium = \"mlp\" }", "stage2 = false"] {
        assert_eq!(warnings("preset = \"paper\"", same), Vec::<String>::new(), "{same}");
    }
    let pairs = "[calibrator]\npairs = { input = \"x\", target = \"y\" }";
    for (line, words) in [
        (
            "reconstruct = { iterations = 7 }",
            "in steps: reconstruct.iterations is 3000 for variant full; 7 for variant other",
        ),
        ("enhance = { iterations = 7 }", "in steps: enhance.iterations"),
        ("calibrate = { steps = 7 }", "in steps: calibrate.steps"),
        (
            "import = { split = { every = 4 } }",
            "in split: import.split.every is 4 for variant other; 8 for variant full",
        ),
        ("import = { max_side = 64 }", "in views: import.max_side"),
        ("evaluate = { neighbour_pairs = 2 }", "in pairs: evaluate.neighbour_pairs"),
        ("calibrator = { file = \"c\" }", "in pairs: the calibrator is"),
    ] {
        let said = warnings(pairs, line);
        assert!(said.len() == 1 && said[0].contains(words), "{line}: {said:?}");
    }
    // Scenes count in one mean, and may differ in size.
    let b = |line: &str| warnings(&format!("[[scene]]\nname = \"b\"\ncapture = \"b\"\n{line}"), "");
    assert!(b("reconstruct = { iterations = 7 }")[0].contains("7 for scene b"));
    assert_eq!(b("size = \"64x48\""), Vec::<String>::new());
}

#[test]
fn a_run_that_leaves_the_tables_out_says_so() {
    let registry = registry().expect("the stage table");
    let text = "name = \"x\"\n[[scene]]\nname = \"a\"\ncapture = \"a\"\n";
    let pipeline =
        from_text(&registry, text, Path::new("x.toml"), &LoadOptions::default()).expect("a pipeline");
    let graph = Graph::new(&registry, &pipeline.batch).expect("a graph");
    let said = |until: &[&str]| {
        let until: Vec<String> = until.iter().map(ToString::to_string).collect();
        without_tables(&graph, (!until.is_empty()).then_some(&until))
    };
    assert!(
        said(&["evaluate"]).is_some_and(|said| said.contains("--until evaluate: this leaves out tables/"))
    );
    assert_eq!((said(&["report"]), said(&[])), (None, None));
}

#[test]
fn tables_name_every_method_but_our_own() {
    for method in use3d_config::METHODS {
        let made = Configuration { preset: (*method).into(), ..Configuration::default() };
        assert_eq!(made.compared_method().is_none(), *method == "3d-use", "{method}");
    }
}
