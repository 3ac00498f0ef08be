//! The graph as Mermaid text, coloured by state.

use std::collections::BTreeSet;
use std::fmt::Write;

use crate::plan::graph::Graph;
use crate::plan::planning::Plan;
use crate::plan::status::{Standing, cell};

fn colours(standing: Standing) -> (&'static str, &'static str) {
    match standing {
        Standing::Cached => ("#d7f0dc", "#2e7d4f"),
        Standing::Stale => ("#fdeecb", "#a56a00"),
        Standing::Missing => ("#eceff1", "#607d8b"),
        Standing::Failed => ("#fbd9d5", "#b3261e"),
    }
}

const ALL: [Standing; 4] = [Standing::Cached, Standing::Stale, Standing::Missing, Standing::Failed];

/// The graph as Mermaid text.
pub fn mermaid(graph: &Graph, plan: &Plan) -> String {
    let mut out = String::from("flowchart LR\n");
    for standing in ALL {
        let (fill, stroke) = colours(standing);
        let _ = writeln!(out, "  classDef {} fill:{fill},stroke:{stroke},color:#1b1b1b", standing.word());
    }
    for (i, node) in graph.nodes.iter().enumerate().filter(|(_, n)| n.same_as.is_none()) {
        let label = node.label().replace('"', "'");
        let _ = writeln!(out, "  n{i}[\"{label}\"]:::{}", cell(&plan.nodes[i]).standing.word());
        for parent in arrows(graph, i) {
            let _ = writeln!(out, "  n{parent} --> n{i}");
        }
    }
    out
}

/// The nodes from which an arrow leads to a node, each once, even if it is read in several roles.
fn arrows(graph: &Graph, node: usize) -> BTreeSet<usize> {
    graph.parents(node).map(|parent| root(graph, parent)).collect()
}

/// Replaces a node that repeats the work of another by that other node.
fn root(graph: &Graph, node: usize) -> usize {
    graph.nodes[node].same_as.unwrap_or(node)
}
