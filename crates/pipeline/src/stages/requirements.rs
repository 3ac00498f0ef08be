//! The requirements of each stage, checked before anything runs: weights, pairs, calibrators, compatible
//! objectives, readable truth.
//!
//! The list is added to the table of stages from outside, like the forecasts of memory. It decides whether a
//! run begins, never a result, and is part of no stage's code and of no key. Captures are not in it: a
//! missing capture fails only its own scene, and the others run.

#[cfg(feature = "nets")]
use std::collections::BTreeMap;
use std::path::Path;
#[cfg(feature = "nets")]
use std::sync::Mutex;

use serde_json::Value;
#[cfg(feature = "nets")]
use use3d_nets::{Models, Network};
use use3d_workflow::{AllParameters, Checks, Lacking, Named, Stage};

use super::calibrated::is_calibrated;
use super::calibrator::read_calibrator;
#[cfg(feature = "nets")]
use super::depth;
use super::pairs;
use super::proposer::{ProposerChoice, of_calibrator};
use super::targets;
#[cfg(feature = "nets")]
use super::weights::NU2NET;
use crate::judge::truth;

/// Fewest pairs that show how transitions vary.
const FEWEST_PAIRS: usize = 2;
/// The places where pairs are published.
const PAIRS: &str = "UIEB, LSUI or EUVP, docs/guide/datasets.md says where they are published";

/// The stage with its requirements.
pub(super) fn with_requirements(stage: Stage) -> Stage {
    match stage.name() {
        "pairs" => stage.requires(|all, named, _| {
            weights(all, named, "pairs").into_iter().chain(of_pairs(all, named)).collect()
        }),
        "propose" => stage.requires(|all, named, _| weights(all, named, "propose").into_iter().collect()),
        #[cfg(feature = "nets")]
        "depth" => stage.requires(|all, named, _| of_depth(all, named).into_iter().collect()),
        // A build without networks has no stage that makes the priors.
        #[cfg(not(feature = "nets"))]
        "reconstruct" => stage.requires(|all, _, _| of_reconstruct(all).into_iter().collect()),
        "targets" => stage.requires(|all, named, _| of_targets(all, named).into_iter().collect()),
        "evaluate" => stage.requires(|all, named, checks| {
            let truth = named.path("capture").and_then(|capture| of_truth(capture, checks));
            let network = weights(all, named, "evaluate");
            network.into_iter().chain(of_scores(all, named)).chain(truth).collect()
        }),
        _ => stage,
    }
}

fn lacking(what: impl Into<String>, remedy: impl Into<String>, without: impl Into<String>) -> Lacking {
    Lacking { what: what.into(), remedy: remedy.into(), without: without.into() }
}

fn text<'a>(all: &'a AllParameters, stage: &str, parameter: &str) -> &'a str {
    all.get(stage).and_then(|p| p[parameter].as_str()).unwrap_or_default()
}

/// The setting that uses the classical enhancer in place of Nu2Net.
fn without_nu2net(all: &AllParameters, stage: &str) -> String {
    // A proposer that is set for the targets applies to the other stages, too.
    let stage = if text(all, "targets", "proposer") == "nu2net" { "targets" } else { stage };
    format!("--set {stage}.proposer=fusion")
}

/// Nu2Net's weights if the parameters of a stage name the network and they are missing, or if they are there
/// for `auto` and cannot be used.
fn weights(all: &AllParameters, named: &Named, stage: &str) -> Option<Lacking> {
    match text(all, stage, "proposer") {
        "nu2net" => nu2net(all, named, stage),
        "auto" => nu2net(all, named, stage).filter(|_| has_nu2net(named)),
        _ => None,
    }
}

#[cfg(feature = "nets")]
fn has_nu2net(named: &Named) -> bool {
    folder(named).is_some_and(|folder| NU2NET.iter().any(|network| folder.has(*network)))
}

/// The models folder, if it exists.
#[cfg(feature = "nets")]
fn folder(named: &Named) -> Option<Models> {
    named.path("models").filter(|dir| dir.is_dir()).map(Models::open)
}

#[cfg(not(feature = "nets"))]
fn has_nu2net(_: &Named) -> bool {
    false
}

#[cfg(feature = "nets")]
fn nu2net(all: &AllParameters, named: &Named, stage: &str) -> Option<Lacking> {
    let what = "the weights of Nu2Net, the 2D enhancer of the paper";
    network(named, what, &NU2NET, &without_nu2net(all, stage))
}

#[cfg(not(feature = "nets"))]
fn nu2net(all: &AllParameters, _: &Named, stage: &str) -> Option<Lacking> {
    Some(no_networks("Nu2Net, the 2D enhancer of the paper", &without_nu2net(all, stage)))
}

#[cfg(not(feature = "nets"))]
fn no_networks(what: &str, without: &str) -> Lacking {
    lacking(what, "this program was built without networks (cargo feature `nets`)", without)
}

/// The reason why the file of a network cannot be used. A file is checked once, for all scenes, until it
/// changes.
#[cfg(feature = "nets")]
fn unusable(folder: &Models, network: Network) -> Option<String> {
    type File = (std::path::PathBuf, u64, Option<std::time::SystemTime>);
    static CHECKED: Mutex<BTreeMap<File, Option<String>>> = Mutex::new(BTreeMap::new());
    let path = folder.find(network)?;
    let metadata = std::fs::metadata(&path).ok()?;
    let file = (path, metadata.len(), metadata.modified().ok());
    let mut checked = CHECKED.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    let check = || folder.check(network).err().map(|error| error.to_string());
    checked.entry(file).or_insert_with(check).clone()
}

/// The missing weights of a network that is available in several files; `None` if one of them is present.
#[cfg(feature = "nets")]
fn network(named: &Named, what: &str, networks: &[Network], without: &str) -> Option<Lacking> {
    if let Some(folder) = folder(named)
        && let Some(network) = networks.iter().find(|network| folder.has(**network))
    {
        return unusable(&folder, *network).map(|reason| {
            let origin = network.known().origin;
            let remedy = format!("{reason}; put the file there that is published at {origin}");
            lacking(format!("{what}, in a file that can be used"), remedy, without)
        });
    }
    let files = networks.iter().map(|network| network.known());
    let files = files.map(|k| format!("{} (published at {})", k.files[0], k.origin));
    let place = match named.path("models") {
        Some(dir) => format!("into {}", dir.display()),
        None => "into a folder, and name that with --models or USE3D_MODELS".into(),
    };
    let mut remedy = format!("put {} {place}", files.collect::<Vec<_>>().join(" or "));
    if let Some(reason) = named.problem("models") {
        remedy += &format!("; the models folder cannot be found: {reason}");
    }
    Some(lacking(what, remedy, without))
}

/// The reason why a named file cannot be used; `None` if it exists.
fn unfound(named: &Named, external: &str) -> Option<String> {
    let by = named.by(external);
    let by = if by.is_empty() { String::new() } else { format!(", named by {by}") };
    if let Some(reason) = named.problem(external) {
        return Some(format!("{reason}{by}"));
    }
    let path = named.path(external)?;
    let gone = || format!("{} does not exist{by}; correct the path or put the data there", path.display());
    (!path.exists()).then(gone)
}

fn of_pairs(all: &AllParameters, named: &Named) -> Vec<Lacking> {
    let what = "the pairs of images that the calibrator learns from";
    if !named.has("pairs.input") {
        let stands_in = all.get("pairs").is_none_or(|p| p["stand_in"] != Value::Bool(false));
        if stands_in {
            return Vec::new();
        }
        let remedy = format!("name two folders with --pairs INPUT TARGET or `calibrator.pairs` ({PAIRS})");
        return vec![lacking(what, remedy, "--set pairs.stand_in=true")];
    }
    let unfound: Vec<String> =
        ["pairs.input", "pairs.target"].iter().filter_map(|name| unfound(named, name)).collect();
    if !unfound.is_empty() {
        return vec![lacking(what, format!("{} ({PAIRS})", unfound.join("; ")), "")];
    }
    let (Some(input), Some(target)) = (named.path("pairs.input"), named.path("pairs.target")) else {
        return Vec::new();
    };
    match pairs::list(input, target) {
        Ok(found) if found.len() >= FEWEST_PAIRS => Vec::new(),
        Ok(found) => {
            let remedy = format!(
                "{} files of {} have a counterpart of the same stem in {}, and at least {FEWEST_PAIRS} are needed; pairs are matched by file stem",
                found.len(),
                input.display(),
                target.display()
            );
            vec![lacking("pairs with equal names", remedy, "")]
        }
        Err(error) => vec![lacking("the pairs of images", error.to_string(), "")],
    }
}

#[cfg(feature = "nets")]
fn of_depth(all: &AllParameters, named: &Named) -> Option<Lacking> {
    if text(all, "reconstruct", "depth_prior") != "depth-anything-v2" {
        return None;
    }
    let networks = depth::networks(all.get("depth").unwrap_or(&Value::Null));
    let what = "the weights of Depth Anything V2, the depth prior of the paper";
    network(named, what, &networks, "--set reconstruct.depth_prior=off")
}

#[cfg(not(feature = "nets"))]
fn of_reconstruct(all: &AllParameters) -> Option<Lacking> {
    let asked = text(all, "reconstruct", "depth_prior") == "depth-anything-v2";
    let what = "Depth Anything V2, the depth prior of the paper";
    asked.then(|| no_networks(what, "--set reconstruct.depth_prior=off"))
}

/// Checks that the calibrator of the targets was fitted for the requested proposer.
fn of_targets(all: &AllParameters, named: &Named) -> Option<Lacking> {
    let given = all.get("targets").cloned().unwrap_or_default();
    let choice: ProposerChoice = serde_json::from_value(given["proposer"].clone()).unwrap_or_default();
    if named.has("calibrator") {
        if let Some(problem) = unfound(named, "calibrator") {
            return Some(lacking("the calibrator", problem, ""));
        }
        let calibrator = match read_calibrator(named.path("calibrator")?) {
            Ok(calibrator) => calibrator,
            Err(error) => return Some(lacking("a calibrator that can be read", error.to_string(), "")),
        };
        let models = named.path("models").filter(|dir| dir.is_dir());
        if calibrator.proposer.name == "nu2net"
            && matches!(choice, ProposerChoice::Auto | ProposerChoice::Nu2net)
            && let Some(missing) = nu2net(all, named, "targets")
        {
            // A calibrator works only with the enhancer that it was fitted for.
            return Some(Lacking { without: String::new(), ..missing });
        }
        let opened = of_calibrator(choice, &calibrator.proposer.name, models)
            .and_then(|p| calibrator.proposer.require(&p.id()).map_err(|e| e.to_string()));
        return opened.err().map(|problem| lacking("a calibrator for the proposer in use", problem, ""));
    }
    let parameters = serde_json::from_value::<targets::Params>(given).ok();
    if let Some((problem, without)) = parameters.and_then(|parameters| parameters.conflict()) {
        return Some(lacking("parameters of the targets that go together", problem, without));
    }
    if !is_calibrated(all) {
        return None;
    }
    let asked = text(all, "targets", "proposer");
    let fitted = match text(all, "pairs", "proposer") {
        "auto" if nu2net(all, named, "pairs").is_some() => "fusion",
        "auto" => "nu2net",
        other => other,
    };
    if asked == "nu2net" && nu2net(all, named, "targets").is_some() {
        return weights(all, named, "targets");
    }
    if asked == "auto" || asked == fitted {
        return None;
    }
    let remedy = format!(
        "the calibrator is fitted for `pairs.proposer`, which is `{fitted}` here, and `targets.proposer` is `{asked}`; give both the same"
    );
    let without = format!("--set targets.proposer={fitted}");
    Some(lacking("a calibrator for the proposer in use", remedy, without))
}

/// The missing networks of the paper's scores, if all scores are required.
#[cfg(feature = "nets")]
fn of_scores(all: &AllParameters, named: &Named) -> Vec<Lacking> {
    use Network::{AlexNet, LpipsHeads, Musiq, RaftLarge, URanker};
    if text(all, "evaluate", "scores") != "all" {
        return Vec::new();
    }
    let each = [LpipsHeads, AlexNet, RaftLarge, URanker, Musiq].into_iter().filter_map(|net| {
        let known = net.known();
        let what = format!("the weights of {} ({})", known.title, known.used_for);
        network(named, &what, &[net], "--set evaluate.scores=available")
    });
    each.collect()
}

#[cfg(not(feature = "nets"))]
fn of_scores(all: &AllParameters, _: &Named) -> Vec<Lacking> {
    let wanted = text(all, "evaluate", "scores") == "all";
    let networks = || no_networks("the networks of the paper's scores", "--set evaluate.scores=available");
    wanted.then(networks).into_iter().collect()
}

/// Truth that exists next to a capture and cannot be read.
fn of_truth(capture: &Path, checks: &Checks<'_>) -> Option<Lacking> {
    // Reading all images of a truth takes long.
    let fault = checks.once("a truth is readable, 1", capture, || truth::check_readable(capture));
    fault.map(|reason| {
        let remedy = format!("{reason}; write that file again, or rename the truth/ folder");
        lacking("the truth beside a capture", remedy, "")
    })
}
