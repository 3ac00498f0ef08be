//! The jobs for the missing stages of a plan: their commands, their dependencies, and the resources they
//! request.
//!
//! There are two layouts. *Workers*: one array of equal tasks that share the batch, whatever its graph. It
//! does not depend on limits of arrays or on failures of dependencies, and every task requests the resources
//! of the largest stage. *Stages*: an array over the scenes and variants for every stage, element after
//! element, each with a request for its own stage, such as a GPU. Both end with one task that runs after all
//! others, even after failures, makes the report and fills the results folder.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use use3d_build::gc::parse_bytes;
use use3d_build::plan::{PlannedNode, State};
use use3d_build::{Plan, Registry, Scope, Source};

use super::ClusterError;
use super::site::{Needs, SHORTEST, Site, WORKERS};
use super::time;

/// The way in which a batch is cut into tasks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    /// Equal tasks that share the work.
    Workers,
    /// An array for every stage.
    Stages,
}

/// The condition for starting a job.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum After {
    /// After all tasks of that job succeeded.
    Done(usize),
    /// Each task after the task with the same number of that job succeeded.
    Same(usize),
    /// After the end of that job, even if it failed.
    Over(usize),
}

/// The resources that a task requests.
#[derive(Clone, Debug, PartialEq)]
pub struct Asks {
    /// The time limit.
    pub time: Duration,
    /// Memory in bytes.
    pub memory: u64,
    /// Number of processors.
    pub cpus: usize,
    /// The site's settings for its stage.
    pub needs: Needs,
}

/// A job: one task, or an array of them.
#[derive(Clone, Debug, PartialEq)]
pub struct Job {
    /// Its name: a stage, `workers`, or `finish`.
    pub name: String,
    /// Its description in a sentence.
    pub about: String,
    /// Number of tasks, if it is an array.
    pub tasks: Option<usize>,
    /// The scene and variant of every task, in the form of `--only`; empty if the tasks are equal.
    pub cells: Vec<String>,
    /// The conditions for starting it.
    pub after: Vec<After>,
    /// Arguments of `use3d run` besides those of all jobs.
    pub words: Vec<String>,
    /// True if it fills the results folder.
    pub delivers: bool,
    /// The resources that each task requests.
    pub asks: Asks,
}

/// The jobs that compute the missing stages, each after the jobs it waits for; empty if nothing is missing.
///
/// # Errors
/// The name of a scene or variant cannot be written in a list of tasks.
pub fn of(
    plan: &Plan,
    registry: &Registry,
    site: &Site,
    layout: Layout,
    workers: Option<usize>,
) -> Result<Vec<Job>, ClusterError> {
    let todo: Vec<&PlannedNode> = plan
        .nodes
        .iter()
        .filter(|n| n.shared_with.is_none() && matches!(n.state, State::Run(_) | State::Waiting(_)))
        .collect();
    if todo.is_empty() {
        return Ok(Vec::new());
    }
    let cells = cells(&todo)?;
    let scope = |stage: &str| registry.stage(stage).map_or(Scope::Batch, |s| s.scope());
    let mut jobs = match layout {
        Layout::Workers => workers_of(&todo, site, &cells, workers.unwrap_or(site.at_once)),
        Layout::Stages => stages_of(&todo, registry, site, &cells),
    };
    let last: Vec<&PlannedNode> =
        todo.iter().copied().filter(|n| jobs.is_empty() || scope(n.stage) == Scope::Batch).collect();
    jobs.push(Job {
        name: "finish".to_string(),
        about: "Computes what is still missing, tries failed stages once more, writes the report and fills \
             the results folder."
            .to_string(),
        tasks: None,
        cells: Vec::new(),
        after: (0..jobs.len()).map(After::Over).collect(),
        words: vec!["--keep-going".to_string()],
        delivers: true,
        asks: asks(&last, site, WORKERS, |nodes| nodes.iter().filter_map(|n| longest(n)).sum()),
    });
    Ok(jobs)
}

/// The scenes and variants with missing stages, in the plan's order.
fn cells(todo: &[&PlannedNode]) -> Result<Vec<String>, ClusterError> {
    let mut cells: Vec<String> = Vec::new();
    for node in todo.iter().filter(|n| !n.scene.is_empty()) {
        for (what, name) in [("scene", &node.scene), ("variant", &node.variant)] {
            let reason = if name.chars().any(char::is_control) {
                "has a control character in it"
            } else if name.contains('@') {
                "has an @ in it, which stands between scene and variant"
            } else {
                continue;
            };
            return Err(ClusterError::Name { what, name: name.clone(), reason });
        }
        let cell = match node.variant.as_str() {
            "" => node.scene.clone(),
            variant => format!("{}@{variant}", node.scene),
        };
        if !cells.contains(&cell) {
            cells.push(cell);
        }
    }
    Ok(cells)
}

fn workers_of(todo: &[&PlannedNode], site: &Site, cells: &[String], most: usize) -> Vec<Job> {
    let tasks = most.clamp(1, cells.len().clamp(1, site.largest_array));
    if cells.is_empty() {
        return Vec::new();
    }
    // The longest chain is that of one scene; the rest of the work is shared.
    let time = |nodes: &[&PlannedNode]| {
        let sum: f64 = nodes.iter().filter_map(|n| longest(n)).sum();
        let mut chains: BTreeMap<(&str, &str), f64> = BTreeMap::new();
        for node in nodes {
            *chains.entry((&node.scene, &node.variant)).or_default() += longest(node).unwrap_or(0.0);
        }
        chains.into_values().fold(sum / tasks as f64, f64::max)
    };
    vec![Job {
        name: "workers".to_string(),
        about: format!(
            "{} the missing stages of {}.",
            if tasks == 1 { "One task computes".to_string() } else { format!("{tasks} equal tasks compute") },
            if cells.len() == 1 {
                "one scene and variant".to_string()
            } else {
                format!("{} scenes and variants", cells.len())
            }
        ),
        tasks: Some(tasks),
        cells: Vec::new(),
        after: Vec::new(),
        words: ["--keep-going", "--until-empty", "--cache-only"].map(String::from).to_vec(),
        delivers: false,
        asks: asks(todo, site, WORKERS, time),
    }]
}

/// The tasks of every stage, in arrays no larger than the site allows. All stages are cut at the same places,
/// so that a task's predecessor has the same number in the array with the same number.
fn stages_of(todo: &[&PlannedNode], registry: &Registry, site: &Site, cells: &[String]) -> Vec<Job> {
    let mut jobs: Vec<Job> = Vec::new();
    let mut made: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
    let parts: Vec<&[String]> = cells.chunks(site.largest_array).collect();
    for stage in registry.stages().iter().filter(|s| s.scope() != Scope::Batch) {
        let name = stage.name();
        let nodes: Vec<&PlannedNode> = todo.iter().copied().filter(|n| n.stage == name).collect();
        if nodes.is_empty() {
            continue;
        }
        let parents: BTreeSet<&str> = stage
            .inputs()
            .iter()
            .filter_map(|input| match input.source {
                Source::Stage(from) | Source::Reference(from) => Some(from),
                Source::External(_) => None,
            })
            .collect();
        let mut words = vec!["--until".to_string(), name.to_string(), "--cache-only".to_string()];
        words.extend(site.needs(name).arguments);
        let asks =
            asks(&nodes, site, name, |nodes| nodes.iter().filter_map(|n| longest(n)).fold(0.0, f64::max));
        let job = Job {
            name: name.to_string(),
            about: format!("The stage `{name}`, which all scenes share."),
            tasks: None,
            cells: Vec::new(),
            after: Vec::new(),
            words,
            delivers: false,
            asks,
        };
        // The jobs of earlier stages. If both are arrays, only the array with the same scenes counts.
        let after = |part: Option<usize>, jobs: &[Job]| {
            let before = parents.iter().filter_map(|parent| made.get(parent));
            let mut waits: Vec<usize> = before
                .flat_map(|own| match part {
                    Some(part) if jobs[own[0]].tasks.is_some() => vec![own[part]],
                    _ => own.clone(),
                })
                .collect();
            waits.sort_unstable();
            let one = |of: usize| match part {
                Some(_) if jobs[of].tasks.is_some() => After::Same(of),
                _ => After::Done(of),
            };
            waits.into_iter().map(one).collect()
        };
        let own = if stage.scope() == Scope::Scene {
            let one = |(part, cells): (usize, &&[String])| {
                let which = if parts.len() > 1 {
                    format!(", part {} of {}", part + 1, parts.len())
                } else {
                    String::new()
                };
                Job {
                    name: if parts.len() > 1 { format!("{name}-{}", part + 1) } else { name.to_string() },
                    about: format!(
                        "The stage `{name}`, a task for every scene and variant with something to do{which}."
                    ),
                    tasks: Some(cells.len()),
                    cells: cells.to_vec(),
                    after: after(Some(part), &jobs),
                    ..job.clone()
                }
            };
            parts.iter().enumerate().map(one).collect()
        } else {
            vec![Job { after: after(None, &jobs), ..job }]
        };
        made.insert(name, (jobs.len()..jobs.len() + own.len()).collect());
        jobs.extend(own);
    }
    jobs
}

/// The longest duration of a node so far in seconds, scaled to its present length.
fn longest(node: &PlannedNode) -> Option<f64> {
    node.forecast.map(|f| f.most)
}

/// The request for tasks of these nodes: 1.5 times the forecast time, and a quarter more memory.
fn asks(nodes: &[&PlannedNode], site: &Site, stage: &str, seconds: impl Fn(&[&PlannedNode]) -> f64) -> Asks {
    let needs = site.needs(stage);
    // The site was checked when it was read, so parsing cannot fail here.
    let of_time = |text: &str| time::parse(text).unwrap_or(SHORTEST);
    let of_bytes = |text: &str| parse_bytes(text).unwrap_or(0);
    let known = !nodes.is_empty() && nodes.iter().all(|n| n.forecast.is_some());
    let forecast = Duration::from_secs_f64((1.5 * seconds(nodes)).clamp(0.0, 1e8)) + SHORTEST;
    let time = match &needs.time {
        Some(time) => of_time(time),
        None if known => forecast,
        None => forecast.max(of_time(&site.time)),
    };
    let peak = nodes.iter().filter_map(|n| n.forecast.map(|f| f.peak_memory).max(n.memory)).max();
    let memory = match (&needs.memory, peak) {
        (Some(memory), _) => of_bytes(memory),
        (None, Some(peak)) if known => peak.saturating_add(peak / 4).saturating_add(256_000_000),
        (None, peak) => of_bytes(&site.memory).max(peak.unwrap_or(0)),
    };
    Asks {
        time: time.clamp(SHORTEST, of_time(&site.longest)),
        memory,
        cpus: needs.cpus.unwrap_or(site.cpus),
        needs,
    }
}
