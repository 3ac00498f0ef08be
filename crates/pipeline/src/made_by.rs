//! The configuration behind a scene's results, read from the nodes and artifacts of a run: see
//! [`Configuration`].
//!
//! Parameters come from the nodes. The choices that parameters leave open (the depth prior, the water
//! estimated from the tracks, the number of pairs that a calibrator learnt from) come from the artifacts,
//! where the stages recorded them.

use std::collections::BTreeMap;

use serde_json::{Value, json};
use use3d_atc::calibrator::{METHOD_PAIRS, Provenance};
use use3d_atc::consensus::TargetsReport;
use use3d_import::load_prepared;
use use3d_workflow::run::RanNode;
use use3d_workflow::{Stage, Summary, canonical};

use use3d_config::preset_values;
use use3d_judge::configuration::Configuration;
use use3d_stages::{CALIBRATED, CHOICES, Choices, read_json, registry};

/// The preset that lists every parameter with an effect on a result: only these are compared.
const COMPLETE: &str = "paper";
/// The stage whose scores stand beside the configuration. It and the stages that it follows from are
/// compared.
const SCORED_BY: &str = "evaluate";
/// Follows the steps of stage 1 where a pipeline leaves out stage 2.
const WITHOUT_STAGE_2: &str = ", without stage 2 (stage2 = false)";
/// The import's text for views that were counted in the authors' order.
const AUTHORS_SPLIT: &str = "one view in 8 is held out, counted by COLMAP image id from the first";

/// A parameter's value as text.
pub(crate) fn text(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), String::from)
}

/// The parameters of these nodes that differ from their preset, as `stage.parameter = value`.
fn changes(nodes: &[&RanNode]) -> Vec<String> {
    let (Ok(registry), Ok(complete)) = (registry(), preset_values(COMPLETE)) else { return Vec::new() };
    let mut changed = Vec::new();
    for node in nodes {
        let (Ok(stage), Some(counted)) = (registry.stage(node.stage), complete.get(node.stage)) else {
            continue;
        };
        let mut preset = preset_values(&node.preset).unwrap_or_default();
        let given = preset.remove(node.stage).unwrap_or_else(|| json!({}));
        let Ok(base) = stage.parameters(&given) else { continue };
        let [was, is] = [&base, &node.parameters]
            .map(|values| canonical::leaves(values.json()).into_iter().collect::<BTreeMap<_, _>>());
        for (name, _) in canonical::leaves(counted) {
            if let (Some(was), Some(is)) = (was.get(&name), is.get(&name))
                && was != is
            {
                changed.push(format!("{}.{name} = {}", node.stage, text(is)));
            }
        }
    }
    changed
}

/// The node of a stage for a scene in a variant, or the node that serves all scenes.
fn node<'s>(summary: &'s Summary, scene: &str, variant: &str, stage: &str) -> Option<&'s RanNode> {
    let of = |n: &&RanNode| n.stage == stage && n.variant == variant;
    let own = summary.nodes.iter().find(|n| of(n) && n.scene == scene);
    own.or_else(|| summary.nodes.iter().find(|n| of(n) && n.scene.is_empty()))
}

/// The digest of an input's names and content, short.
fn content(node: &RanNode, role: &str) -> Option<String> {
    let inputs = &node.artifact.as_ref()?.manifest.ingredients.inputs;
    inputs.iter().find(|input| input.role == role).map(|input| input.digest.short())
}

/// A text with the calibrator's pairs and shares, and digests of its data: the paper names 800 pairs of UIEB
/// without saying which, so more than their number cannot be compared. The flag is true for a finished
/// calibrator, and for one that learnt from as many pairs as the paper's and keeps its whole correction.
fn calibrator(
    provenance: &Provenance,
    calibrated: bool,
    (targets, pairs): (&RanNode, Option<&RanNode>),
) -> (String, bool) {
    if !calibrated {
        return ("none: proposals are not corrected".into(), false);
    }
    if provenance.pairs == 0 {
        let digest = content(targets, "calibrator").map_or_else(String::new, |d| format!(", content {d}"));
        return (format!("a finished file, {}{digest}", provenance.data), true);
    }
    let kept = provenance.held_out.as_ref().map_or([1.0; 2], |held_out| held_out.kept);
    let [global, local] = kept.map(|share| 100.0 * share);
    let whole = kept == [1.0; 2];
    let enough = provenance.pairs >= METHOD_PAIRS;
    let kept = format!("keeps {global:.0} % (global) and {local:.0} % (local)");
    let mut told = format!("{} pairs, {} steps, {kept}", provenance.pairs, provenance.steps);
    let folders = pairs.and_then(|pairs| Some((content(pairs, "input")?, content(pairs, "target")?)));
    if let Some((input, target)) = folders {
        told += &format!(", input {input}, target {target}");
    }
    if enough {
        told += &format!(" (the paper does not say which {METHOD_PAIRS} of UIEB it took)");
    }
    (told, whole && enough)
}

/// The configuration of a scene in a variant; `None` if the run has no stage 1 for it.
pub(crate) fn configuration(summary: &Summary, scene: &str, variant: &str) -> Option<Configuration> {
    let registry = registry().ok()?;
    let found = |stage: &Stage| node(summary, scene, variant, stage.name());
    let nodes: Vec<&RanNode> = registry.upstream(SCORED_BY).filter_map(found).collect();
    let node = |stage: &str| nodes.iter().find(|node| node.stage == stage);
    let at = |stage: &str| Some(node(stage)?.artifact.as_ref()?.path.as_path());
    let first = node("reconstruct")?;
    let steps = |stage: &str| Some(node(stage)?.parameters.json()["iterations"].to_string());
    let steps = [steps("reconstruct"), steps("enhance")];
    let mut made = Configuration {
        preset: first.preset.clone(),
        changed: changes(&nodes),
        steps: steps.into_iter().flatten().collect::<Vec<_>>().join(" + "),
        seed: first.seed.map(|seed| seed.to_string()).unwrap_or_default(),
        ..Configuration::default()
    };
    let mut papers_split = false;
    if let Some(imported) = at("import").and_then(|path| load_prepared(path).ok()) {
        let report = &imported.report;
        let digest = blake3::hash(report.test.join("\n").as_bytes()).to_hex();
        papers_split = report.split_rule == AUTHORS_SPLIT;
        made.split = format!("{} (held-out list {})", report.split_rule, &digest[..12]);
        made.views = format!("{} training, {} held out", report.train.len(), report.test.len());
    }
    if let Some(choices) = at("reconstruct").and_then(|p| read_json::<Choices>(&p.join(CHOICES)).ok()) {
        (made.depth_prior, made.water) = (choices.depth_prior, choices.water);
    }
    let mut papers_pairs = false;
    if let (Some(folder), Some(targets)) = (at("targets"), node("targets")) {
        if let Ok(report) = read_json::<TargetsReport>(&folder.join("report.json")) {
            made.proposer.clone_from(&report.proposer.name);
            let provenance = read_json::<Provenance>(&folder.join(CALIBRATED)).unwrap_or_default();
            let learnt_from = (*targets, node("pairs").copied());
            (made.calibrator, papers_pairs) = calibrator(&provenance, report.calibrated, learnt_from);
        }
    } else if node("targets").is_none() && node("propose").is_none() {
        // Without stage 2, nothing follows from pairs.
        made.steps += WITHOUT_STAGE_2;
        papers_pairs = true;
    } else if let Some(proposed) = node("propose") {
        made.proposer = format!("{}, on every photograph", text(&proposed.parameters.json()["proposer"]));
    }
    made.data_of_the_paper = papers_split && papers_pairs;
    Some(made)
}
