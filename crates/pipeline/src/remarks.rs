//! Remarks on a pipeline before it runs: rows of one table that are not comparable, and tables that are left
//! out.

use std::collections::{BTreeMap, BTreeSet};

use use3d_workflow::{Batch, Graph};

use crate::made_by::text;

/// The parameters that have to agree between the rows of a table, by what they decide.
const ALIKE: [(&str, &str, &str); 12] = [
    ("steps", "calibrate", "steps"),
    ("steps", "reconstruct", "iterations"),
    ("steps", "enhance", "iterations"),
    ("split", "import", "split.every"),
    ("split", "import", "split.order"),
    ("split", "import", "split.lists"),
    ("views", "import", "size"),
    ("views", "import", "downscale"),
    ("views", "import", "max_side"),
    ("pairs", "evaluate", "neighbour_pairs"),
    ("pairs", "evaluate", "path_pairs"),
    ("pairs", "evaluate", "path_steps"),
];
/// The most names that a warning lists for a value.
const SHOWN: usize = 3;

/// Values, each with the names that have it.
type Names<'g> = BTreeMap<String, BTreeSet<&'g str>>;

/// A warning for each parameter in which rows of one table differ: in steps, split, views or pairs. Scenes
/// may differ in size.
pub fn unequal(graph: &Graph, batch: &Batch) -> Vec<String> {
    let mut warnings = Vec::new();
    for (what, stage, parameter) in ALIKE {
        let (mut variants, mut scenes) = (BTreeMap::<&str, Names<'_>>::new(), Names::new());
        for node in graph.nodes.iter().filter(|node| node.stage_name == stage) {
            let at = format!("/{}", parameter.replace('.', "/"));
            let value = node.parameters.json().pointer(&at).map(text).unwrap_or_default();
            let of_scene = variants.entry(&node.scene).or_default();
            of_scene.entry(value.clone()).or_default().insert(&node.variant);
            scenes.entry(value).or_default().insert(&node.scene);
        }
        let parameter = format!("{stage}.{parameter}");
        if let Some(differing) = variants.into_values().find(|values| values.len() > 1) {
            warnings.push(warning(what, &parameter, "variant", &differing));
        } else if scenes.len() > 1 && what != "views" {
            warnings.push(warning(what, &parameter, "scene", &scenes));
        }
    }
    let calibrated = graph.nodes.iter().filter(|node| node.stage_name == "targets");
    let calibrated: BTreeSet<&str> = calibrated.map(|node| node.variant.as_str()).collect();
    let mut calibrators = Names::new();
    for variant in batch.variants.iter().filter(|variant| calibrated.contains(variant.name.as_str())) {
        let own = variant.externals.get("calibrator").and_then(|place| place.as_ref().ok());
        let own = own.map_or_else(|| "the pipeline's".into(), |path| path.display().to_string());
        calibrators.entry(own).or_default().insert(&variant.name);
    }
    if calibrators.len() > 1 {
        warnings.push(warning("pairs", "the calibrator", "variant", &calibrators));
    }
    warnings
}

fn warning(what: &str, parameter: &str, kind: &str, values: &Names<'_>) -> String {
    let each = values.iter().map(|(value, names)| {
        let shown: Vec<&str> = names.iter().copied().take(SHOWN).collect();
        let more = names.len().saturating_sub(SHOWN);
        let more = if more > 0 { format!(" and {more} more") } else { String::new() };
        format!("{} for {kind} {}{more}", if *value == "null" { "not set" } else { value }, shown.join(", "))
    });
    let each = each.collect::<Vec<_>>().join("; ");
    format!(
        "warning: rows of one table differ in {what}: {parameter} is {each}; give all the same value, or do not \
         compare these rows"
    )
}

/// A remark if a run up to some stages leaves out the report and the tables.
pub fn without_tables(graph: &Graph, until: Option<&[String]>) -> Option<String> {
    let stages = until?.join(", ");
    let mut wanted = graph.nodes.iter().zip(graph.wanted(until));
    let made = wanted.any(|(node, wanted)| wanted && node.stage_name == "report");
    (!made).then(|| {
        format!(
            "--until {stages}: this leaves out tables/ and report.html, which the stage `report` makes; leave --until out \
             to get them, and nothing is computed twice"
        )
    })
}
