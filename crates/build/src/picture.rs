//! The graph as a picture, coloured by state: Mermaid text or a self-contained SVG.

use std::collections::BTreeSet;
use std::fmt::Write;

use super::graph::Graph;
use super::machine::seconds;
use super::plan::Plan;
use super::status::{Standing, cell};

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

const BOX: (usize, usize) = (132, 34);
const STEP: (usize, usize) = (164, 50);
const LEFT: usize = 190;
const TOP: usize = 64;

/// The graph as an SVG picture: a row per scene and variant, a column per stage.
pub fn svg(graph: &Graph, plan: &Plan) -> String {
    let mut stages: Vec<&str> = Vec::new();
    let mut rows: Vec<(&str, &str)> = Vec::new();
    let mut order: Vec<usize> = (0..graph.nodes.len()).collect();
    order.sort_by_key(|i| graph.nodes[*i].stage);
    for node in order.iter().map(|i| &graph.nodes[*i]) {
        if !stages.contains(&node.stage_name) {
            stages.push(node.stage_name);
        }
    }
    for node in &graph.nodes {
        let row = (node.scene.as_str(), node.variant.as_str());
        if !rows.contains(&row) {
            rows.push(row);
        }
    }
    let place = |i: usize| {
        let node = &graph.nodes[i];
        let column = stages.iter().position(|s| *s == node.stage_name).unwrap_or(0);
        let row = rows.iter().position(|r| *r == (node.scene.as_str(), node.variant.as_str())).unwrap_or(0);
        (LEFT + column * STEP.0, TOP + row * STEP.1)
    };
    let (width, height) = (LEFT + stages.len() * STEP.0, TOP + rows.len() * STEP.1 + 34);
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{width}\" height=\"{height}\" \
         font-family=\"system-ui, sans-serif\" font-size=\"12\" role=\"img\" aria-label=\"{}\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\n\
         <text x=\"16\" y=\"26\" font-size=\"16\" font-weight=\"600\">{}</text>\n",
        escape(&graph.name),
        escape(&graph.name)
    );
    for (row, (scene, variant)) in rows.iter().enumerate() {
        let name = [*scene, *variant].into_iter().filter(|p| !p.is_empty()).collect::<Vec<_>>().join(" · ");
        let name = if name.is_empty() { "(all scenes)".to_string() } else { name };
        let y = TOP + row * STEP.1 + BOX.1 / 2 + 4;
        let _ = writeln!(out, "<text x=\"16\" y=\"{y}\">{}</text>", escape(&name));
    }
    for i in (0..graph.nodes.len()).filter(|i| graph.nodes[*i].same_as.is_none()) {
        let (x, y) = place(i);
        for parent in arrows(graph, i) {
            let (px, py) = place(parent);
            let (from, to) = ((px + BOX.0, py + BOX.1 / 2), (x, y + BOX.1 / 2));
            let bend = STEP.0.saturating_sub(BOX.0) / 2;
            let _ = writeln!(
                out,
                "<path d=\"M{} {} C{} {} {} {} {} {}\" fill=\"none\" stroke=\"#90a4ae\" stroke-width=\"1\"/>",
                from.0,
                from.1,
                from.0 + bend,
                from.1,
                to.0.saturating_sub(bend),
                to.1,
                to.0,
                to.1
            );
        }
    }
    for (i, node) in graph.nodes.iter().enumerate() {
        let (x, y) = place(i);
        let shown = cell(&plan.nodes[i]);
        let (fill, stroke) = colours(shown.standing);
        let dashes = if node.same_as.is_some() { " stroke-dasharray=\"4 3\"" } else { "" };
        let time =
            plan.nodes[i].forecast.map(|f| format!(", about {}", seconds(f.seconds))).unwrap_or_default();
        let shared =
            plan.nodes[i].shared_with.as_ref().map(|s| format!(", shared with {s}")).unwrap_or_default();
        let title = format!("{}: {}{time}{shared} {}", node.label(), shown.standing.word(), shown.reason);
        let _ = writeln!(
            out,
            "<g><title>{}</title><rect x=\"{x}\" y=\"{y}\" width=\"{}\" height=\"{}\" rx=\"6\" fill=\"{fill}\" \
             stroke=\"{stroke}\"{dashes}/><text x=\"{}\" y=\"{}\" text-anchor=\"middle\">{}</text></g>",
            escape(&title),
            BOX.0,
            BOX.1,
            x + BOX.0 / 2,
            y + BOX.1 / 2 + 4,
            escape(node.stage_name)
        );
    }
    for (k, standing) in ALL.into_iter().enumerate() {
        let (fill, stroke) = colours(standing);
        let (x, y) = (16 + k * 100, height - 22);
        let _ = writeln!(
            out,
            "<rect x=\"{x}\" y=\"{y}\" width=\"12\" height=\"12\" rx=\"2\" fill=\"{fill}\" stroke=\"{stroke}\"/>\
             <text x=\"{}\" y=\"{}\">{}</text>",
            x + 18,
            y + 10,
            standing.word()
        );
    }
    out.push_str("</svg>\n");
    out
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}
