//! The origin of results, for the ends of their pages: the costs of the stages, their parameters, the
//! machines and the command.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use use3d_judge::configuration::Configuration;
use use3d_judge::names::in_variant;
use use3d_report::page::{Costs, StageRow, VariantSettings};
use use3d_workflow::run::{NodeResult, RanNode};

/// The configurations as the top of a page shows them: the parts for all results of a variant.
pub(super) fn settings<'c>(
    made: impl IntoIterator<Item = (&'c str, &'c Configuration)>,
) -> Vec<VariantSettings> {
    let mut variants: BTreeMap<&str, Vec<&Configuration>> = BTreeMap::new();
    for (variant, configuration) in made {
        variants.entry(variant).or_default().push(configuration);
    }
    let parts = |(variant, all): (&str, Vec<&Configuration>)| VariantSettings {
        variant: variant.to_string(),
        parts: Configuration::parts(&all),
    };
    variants.into_iter().map(parts).collect()
}

/// The costs of each of these nodes when it was computed, and their parameters.
pub(super) fn costs(nodes: &[&RanNode], pipeline: &str, command: &str) -> Costs {
    Costs {
        stages: nodes.iter().copied().filter_map(row).collect(),
        made: written(nodes.iter().copied(), pipeline, command),
        parameters: parameters(nodes),
    }
}

/// The costs of a batch, summed by stage: the pages of the results have the single ones.
pub(super) fn costs_by_stage(nodes: &[RanNode], pipeline: &str, command: &str) -> Costs {
    let own = || nodes.iter().filter(|node| !node.shared);
    let mut stages: Vec<(StageRow, usize, usize)> = Vec::new();
    for (node, row) in own().filter_map(|node| Some((node, row(node)?))) {
        let computed = usize::from(node.result == NodeResult::Done);
        match stages.iter_mut().find(|(sum, ..)| sum.stage == row.stage) {
            Some((sum, count, done)) => {
                (sum.seconds, sum.size) = (sum.seconds + row.seconds, sum.size + row.size);
                sum.memory = sum.memory.into_iter().chain(row.memory).reduce(f64::max);
                (*count, *done) = (*count + 1, *done + computed);
            }
            None => stages.push((row, 1, computed)),
        }
    }
    let total = |(row, count, computed): (StageRow, usize, usize)| StageRow {
        scene: format!("{count} artifacts"),
        state: format!("{computed} computed, {} cached", count - computed),
        key: String::new(),
        ..row
    };
    Costs {
        stages: stages.into_iter().map(total).collect(),
        made: written(own(), pipeline, command),
        parameters: String::new(),
    }
}

/// The seconds of computation behind a result, without stages that another result has already.
pub(super) fn seconds(nodes: &[&RanNode]) -> f64 {
    let own = nodes.iter().filter(|node| !node.shared);
    let seconds = own.filter_map(|node| Some(node.artifact.as_ref()?.manifest.full_seconds()));
    seconds.fold(0.0, |sum, seconds| sum + seconds)
}

/// One line with the pipeline, the time, the machines and the command that wrote the results.
fn written<'n>(nodes: impl Iterator<Item = &'n RanNode>, pipeline: &str, command: &str) -> String {
    let (mut machines, mut last) = (BTreeSet::new(), "?");
    for manifest in nodes.filter_map(|node| Some(&node.artifact.as_ref()?.manifest)) {
        let machine = &manifest.machine;
        machines.insert((machine.host.as_str(), machine.system.as_str(), machine.cores));
        last = if last == "?" { &manifest.finished } else { last.max(&manifest.finished) };
    }
    let machines = machines.iter().map(|(host, system, cores)| format!("{host} ({system}, {cores} cores)"));
    format!(
        "Pipeline {pipeline}. The last stage was finished at {last}; computed on {}. This page was written by {command}",
        machines.collect::<Vec<_>>().join(", ")
    )
}

/// The parameters of every stage of the run, as text; equal ones are listed once.
fn parameters(nodes: &[&RanNode]) -> String {
    let mut groups: Vec<(String, Vec<String>)> = Vec::new();
    let mut known: HashMap<String, usize> = HashMap::new();
    for node in nodes {
        let Some(artifact) = &node.artifact else { continue };
        let ingredients = &artifact.manifest.ingredients;
        let seed = ingredients.seed.map_or_else(String::new, |seed| format!(" (seed {seed})"));
        let values = serde_json::to_string_pretty(&ingredients.parameters).unwrap_or_default();
        let text = format!("{}{seed} {values}", node.stage);
        let place = [&*node.scene, &*node.variant].into_iter().filter(|p| !p.is_empty());
        let place = place.collect::<Vec<_>>().join(" · ");
        let place = if place.is_empty() { "all scenes".into() } else { place };
        let at = *known.entry(text.clone()).or_insert(groups.len());
        if at == groups.len() {
            groups.push((text, Vec::new()));
        }
        groups[at].1.push(place);
    }
    let groups = groups.into_iter().map(|(text, places)| format!("{}:\n{text}\n", places.join(", ")));
    groups.collect::<Vec<_>>().join("\n")
}

/// The costs of a stage when it was computed; `None` if it has no artifact.
fn row(node: &RanNode) -> Option<StageRow> {
    let mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
    let manifest = &node.artifact.as_ref()?.manifest;
    let scene = match &*node.scene {
        "" => "all scenes".into(),
        scene => in_variant(scene, &node.variant),
    };
    let state = if matches!(node.result, NodeResult::Done) { "computed" } else { "cached" };
    Some(StageRow {
        scene,
        stage: node.stage.to_string(),
        state: state.into(),
        seconds: manifest.full_seconds(),
        memory: (manifest.peak_memory > 0).then(|| mib(manifest.peak_memory)),
        size: mib(manifest.bytes()),
        key: manifest.key.to_string(),
    })
}
