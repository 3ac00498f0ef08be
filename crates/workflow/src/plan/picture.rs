//! The graph as Mermaid text, coloured by state.

use std::collections::BTreeSet;
use std::fmt::Write;

use crate::plan::graph::Graph;
use crate::plan::planning::Plan;
use crate::plan::status::{Standing, cell};

/// The colours of the area and of the border of a node.
const COLOURS: [(Standing, &str, &str); 4] = [
    (Standing::Cached, "#d7f0dc", "#2e7d4f"),
    (Standing::Stale, "#fdeecb", "#a56a00"),
    (Standing::Missing, "#eceff1", "#607d8b"),
    (Standing::Failed, "#fbd9d5", "#b3261e"),
];

/// The graph as Mermaid text.
pub fn mermaid(graph: &Graph, plan: &Plan) -> String {
    let mut out = String::from("flowchart LR\n");
    for (standing, fill, stroke) in COLOURS {
        let _ = writeln!(out, "  classDef {} fill:{fill},stroke:{stroke},color:#1b1b1b", standing.word());
    }
    for (i, node) in graph.nodes.iter().enumerate().filter(|(_, n)| n.same_as.is_none()) {
        let label = node.label().replace('"', "'");
        let _ = writeln!(out, "  n{i}[\"{label}\"]:::{}", cell(&plan.nodes[i]).standing.word());
        // A node that repeats the work of another is replaced by that one. An arrow is drawn once, even if
        // the artifact is read in several roles.
        let root = |parent: usize| graph.nodes[parent].same_as.unwrap_or(parent);
        for parent in graph.parents(i).map(root).collect::<BTreeSet<usize>>() {
            let _ = writeln!(out, "  n{parent} --> n{i}");
        }
    }
    out
}
