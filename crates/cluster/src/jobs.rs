//! The jobs for the missing stages of a plan: their commands, their dependencies, and the resources they
//! request.
//!
//! There are two layouts. *Workers*: one array of equal tasks that share the batch, whatever its graph. It
//! does not depend on limits of arrays or on failures of dependencies, and every task requests the resources
//! of the largest stage. *Stages*: one task for every missing artifact, in arrays of one stage and variant,
//! each with a request for its own stage, such as a GPU. Both end with one task that runs after all others,
//! even after failures, makes the report and fills the results folder; it computes nothing else.
//!
//! In the arrays of the second layout a scene has the same number everywhere. So a task starts when the tasks
//! of that number in the arrays before it are done. Variants that share an artifact share its task, and a
//! stage that compares variants waits for the same scene of the reference variant.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use use3d_workflow::Killed;
use use3d_workflow::gc::parse_bytes;
use use3d_workflow::graph::cell_name;
use use3d_workflow::plan::{PlannedNode, State};
use use3d_workflow::{Plan, Registry, Scope};

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

impl Asks {
    /// Processors and memory in words.
    pub fn words(&self) -> String {
        let are = if self.cpus == 1 { "processor" } else { "processors" };
        format!("{} {are}, {} MB", self.cpus, self.memory.div_ceil(1_000_000))
    }
}

/// A job: one task, or an array of them.
#[derive(Clone, Debug, PartialEq)]
pub struct Job {
    /// Its name: a stage, `workers`, or `finish`.
    pub name: String,
    /// Its description in a sentence.
    pub about: String,
    /// The numbers of its tasks, if it is an array.
    pub tasks: Option<Vec<usize>>,
    /// The most tasks that run at the same time.
    pub at_once: usize,
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

impl Job {
    /// The number of its tasks.
    pub fn count(&self) -> usize {
        self.tasks.as_ref().map_or(1, Vec::len)
    }

    /// The list of its tasks: number, scene and variant of each.
    pub fn list(&self) -> String {
        let numbers = self.tasks.iter().flatten();
        numbers.zip(&self.cells).map(|(number, cell)| format!("{number} {cell}\n")).collect()
    }
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
    let todo: Vec<&PlannedNode> = plan.nodes.iter().filter(|n| is_todo(n)).collect();
    if todo.is_empty() {
        return Ok(Vec::new());
    }
    let cells = cells(&todo)?;
    let scope = |stage: &str| registry.stage(stage).map_or(Scope::Batch, |s| s.scope());
    let mut jobs = match layout {
        Layout::Workers if todo.iter().all(|n| scope(n.stage) == Scope::Batch) => Vec::new(),
        Layout::Workers => vec![workers_of(&todo, site, &cells, workers.unwrap_or(site.at_once))?],
        Layout::Stages => stages_of(plan, registry, site),
    };
    let last: Vec<&PlannedNode> = todo.iter().copied().filter(|n| scope(n.stage) == Scope::Batch).collect();
    jobs.push(Job {
        name: "finish".to_string(),
        about: "Makes the report from the results that exist, fills the results folder, and names what is \
             missing."
            .to_string(),
        tasks: None,
        at_once: 1,
        cells: Vec::new(),
        after: (0..jobs.len()).map(After::Over).collect(),
        words: ["--keep-going", "--gather"]
            .map(String::from)
            .into_iter()
            .chain(site.needs(WORKERS).arguments)
            .collect(),
        delivers: true,
        asks: asks(&last, site, WORKERS, |nodes| nodes.iter().filter_map(|n| longest(n)).sum()),
    });
    Ok(jobs)
}

/// True if a node's artifact is missing and no other node makes it.
fn is_todo(node: &PlannedNode) -> bool {
    node.shared_with.is_none() && matches!(node.state, State::Run(_) | State::Waiting(_))
}

/// The scenes and variants with missing stages, in the plan's order.
fn cells(todo: &[&PlannedNode]) -> Result<Vec<String>, ClusterError> {
    let (mut cells, mut known) = (Vec::new(), BTreeSet::new());
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
        let cell = cell(node);
        if known.insert(cell.clone()) {
            cells.push(cell);
        }
    }
    Ok(cells)
}

/// A node's scene and variant in the form of `--only`.
fn cell(node: &PlannedNode) -> String {
    cell_name(&node.scene, &node.variant)
}

fn workers_of(
    todo: &[&PlannedNode],
    site: &Site,
    cells: &[String],
    most: usize,
) -> Result<Job, ClusterError> {
    let tasks = most.clamp(1, cells.len().clamp(1, site.largest_array));
    // The longest chain is that of one scene; the rest of the work is shared.
    let time = |nodes: &[&PlannedNode]| {
        let sum: f64 = nodes.iter().filter_map(|n| longest(n)).sum();
        let mut chains: BTreeMap<(&str, &str), f64> = BTreeMap::new();
        for node in nodes {
            *chains.entry((&node.scene, &node.variant)).or_default() += longest(node).unwrap_or(0.0);
        }
        chains.into_values().fold(sum / tasks as f64, f64::max)
    };
    let asks = workers_ask(todo, site, time)?;
    let words = ["--keep-going", "--until-empty", "--cache-only"].map(String::from).into_iter();
    Ok(Job {
        name: "workers".to_string(),
        about: format!(
            "{} the missing stages of {}.",
            if tasks == 1 { "One task computes".to_string() } else { format!("{tasks} equal tasks compute") },
            match cells.len() {
                0 => "all scenes together".to_string(),
                1 => "one scene and variant".to_string(),
                n => format!("{n} scenes and variants"),
            }
        ),
        tasks: Some((0..tasks).collect()),
        at_once: site.at_once,
        cells: Vec::new(),
        after: Vec::new(),
        words: words.chain(asks.needs.arguments.clone()).collect(),
        delivers: false,
        asks,
    })
}

/// The request of workers: what `[stage.run]` says, else the largest of what the missing stages need.
fn workers_ask(
    todo: &[&PlannedNode],
    site: &Site,
    seconds: impl Fn(&[&PlannedNode]) -> f64,
) -> Result<Asks, ClusterError> {
    let own = site.needs(WORKERS);
    let mut all = asks(todo, site, WORKERS, seconds);
    let mut needs = Needs::default();
    let mut partitions: BTreeMap<String, &str> = BTreeMap::new();
    let stages: BTreeSet<&str> = todo.iter().map(|node| node.stage).collect();
    for stage in stages {
        let nodes: Vec<&PlannedNode> = todo.iter().copied().filter(|node| node.stage == stage).collect();
        let one =
            asks(&nodes, site, stage, |nodes| nodes.iter().filter_map(|n| longest(n)).fold(0.0, f64::max));
        let stated = one.needs;
        all.cpus = if own.cpus.is_some() { all.cpus } else { all.cpus.max(one.cpus) };
        all.memory = if own.memory.is_some() { all.memory } else { all.memory.max(one.memory) };
        all.time =
            if own.time.is_some() || stated.time.is_none() { all.time } else { all.time.max(one.time) };
        partitions.extend(stated.partition.map(|name| (name, stage)));
        let known = |word: &String| !needs.options.contains(word);
        let fresh: Vec<String> = stated.options.into_iter().filter(known).collect();
        needs.options.extend(fresh);
        needs.arguments.extend(stated.arguments);
        for (name, count) in stated.resources {
            let most = needs.resources.entry(name).or_default();
            *most = count.max(*most);
        }
    }
    if own.partition.is_none() && partitions.len() > 1 {
        let named = partitions.iter().map(|(name, stage)| format!("{name} ({stage})"));
        return Err(ClusterError::Partitions(named.collect::<Vec<_>>().join(", ")));
    }
    needs.partition = own.partition.or_else(|| partitions.into_keys().next());
    needs.resources.extend(own.resources);
    let filled = |own: Vec<String>, others: Vec<String>| if own.is_empty() { others } else { own };
    needs.options = filled(own.options, needs.options);
    needs.arguments = filled(own.arguments, needs.arguments);
    Ok(Asks { needs, ..all })
}

/// An array of tasks of one stage. A scene with an input that exists already waits for fewer jobs than the
/// others, in an array of its own.
struct TaskArray<'a> {
    variant: &'a str,
    after: Vec<After>,
    /// The number and the node of each task.
    tasks: Vec<(usize, usize)>,
}

/// The tasks of all missing artifacts, in arrays no larger than the site allows.
fn stages_of(plan: &Plan, registry: &Registry, site: &Site) -> Vec<Job> {
    let mut scenes: BTreeMap<&str, usize> = BTreeMap::new();
    for node in plan.nodes.iter().filter(|n| !n.scene.is_empty()) {
        let next = scenes.len();
        scenes.entry(&node.scene).or_insert(next);
    }

    // The job of each node, if it has one. Inputs come first in a plan, and in the table of stages.
    let mut job_of: Vec<Option<usize>> = vec![None; plan.nodes.len()];
    let mut jobs: Vec<Job> = Vec::new();
    for stage in registry.stages().iter().filter(|s| s.scope() != Scope::Batch) {
        let (name, in_array) = (stage.name(), stage.scope() == Scope::Scene);
        let mut arrays: Vec<TaskArray<'_>> = Vec::new();
        let mut known: BTreeMap<(&str, usize, Vec<usize>), usize> = BTreeMap::new();
        for (i, node) in plan.nodes.iter().enumerate().filter(|(_, n)| n.stage == name && is_todo(n)) {
            // For a node that shares the work of another node, this is the other node.
            let maker = |need: &usize| match plan.nodes[*need].shared_with {
                Some(_) => plan.nodes[*need].needs.first().copied().unwrap_or(*need),
                None => *need,
            };
            let mut before: Vec<usize> = node.needs.iter().map(maker).filter_map(|n| job_of[n]).collect();
            before.sort_unstable();
            before.dedup();
            let number = scenes.get(node.scene.as_str()).copied().unwrap_or(0);
            let (part, number) = (number / site.largest_array, number % site.largest_array);
            let at = *known.entry((node.variant.as_str(), part, before.clone())).or_insert(arrays.len());
            if at == arrays.len() {
                let after = |of: &usize| match jobs[*of].tasks {
                    Some(_) if in_array => After::Same(*of),
                    _ => After::Done(*of),
                };
                let after = before.iter().map(after).collect();
                arrays.push(TaskArray { variant: &node.variant, after, tasks: Vec::new() });
            }
            arrays[at].tasks.push((number, i));
        }
        // All arrays of a stage together keep the limit of concurrent tasks.
        let (first, parts) = (jobs.len(), arrays.len());
        let side_by_side = parts.min(site.at_once).max(1);
        for (k, TaskArray { variant, mut after, tasks }) in arrays.into_iter().enumerate() {
            if k >= side_by_side && in_array {
                after.push(After::Over(first + k - side_by_side));
            }
            let nodes: Vec<&PlannedNode> = tasks.iter().map(|(_, i)| &plan.nodes[*i]).collect();
            let mut words = ["--until", name, "--alone", "--cache-only"].map(String::from).to_vec();
            words.extend(site.needs(name).arguments);
            let longest =
                |nodes: &[&PlannedNode]| nodes.iter().filter_map(|n| longest(n)).fold(0.0, f64::max);
            let which = match (variant, parts) {
                (_, 1) => String::new(),
                ("", _) => format!(", part {} of {parts}", k + 1),
                (variant, _) => format!(", variant {variant}, part {} of {parts}", k + 1),
            };
            tasks.iter().for_each(|(_, i)| job_of[*i] = Some(jobs.len()));
            jobs.push(Job {
                name: if parts == 1 { name.to_string() } else { format!("{name}-{}", k + 1) },
                about: if in_array {
                    format!("The stage `{name}`, a task for every scene with something to do{which}.")
                } else {
                    format!("The stage `{name}`, which all scenes share.")
                },
                tasks: in_array.then(|| tasks.iter().map(|(number, _)| *number).collect()),
                at_once: site.at_once / side_by_side
                    + usize::from(k % side_by_side < site.at_once % side_by_side),
                cells: if in_array { nodes.iter().map(|n| cell(n)).collect() } else { Vec::new() },
                after,
                words,
                delivers: false,
                asks: asks(&nodes, site, name, longest),
            });
        }
    }
    jobs
}

/// The longest duration of a node so far in seconds, scaled to its present length.
fn longest(node: &PlannedNode) -> Option<f64> {
    node.forecast.as_ref().map(|f| f.most)
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
    let peak = nodes.iter().filter_map(|n| n.forecast.as_ref().map(|f| f.peak_memory).max(n.memory)).max();
    // The memory of a killed task was not enough.
    let killed = nodes.iter().filter_map(|n| n.killed.as_deref()).map(Killed::asks_for).max().unwrap_or(0);
    let memory = match (&needs.memory, peak) {
        (Some(memory), _) => of_bytes(memory),
        (None, Some(peak)) if known => peak.saturating_add(peak / 4).saturating_add(256_000_000),
        (None, peak) => of_bytes(&site.memory).max(peak.unwrap_or(0)),
    };
    Asks {
        time: time.clamp(SHORTEST, of_time(&site.longest)),
        memory: memory.max(killed),
        cpus: needs.cpus.unwrap_or(site.cpus),
        needs,
    }
}
