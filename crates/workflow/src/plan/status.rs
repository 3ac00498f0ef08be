//! The state of every node, and the changes since its last artifact: `status` and `why`.

use std::collections::{BTreeMap, HashMap};

use serde::Serialize;

use crate::cache::artifacts::Lookup;
use crate::cache::key::{Difference, Key};
use crate::error::BuildError;
use crate::plan::builder::Builder;
use crate::plan::graph::Graph;
use crate::plan::history::Made;
use crate::plan::planning::{Plan, PlannedNode, State};
use crate::plan::resolve::{Outcome, Unresolved};
use crate::share::lease::Working;

/// The state of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Standing {
    /// Its artifact exists and is up to date.
    Cached,
    /// It had an artifact, but something changed.
    Stale,
    /// It was never made.
    Missing,
    /// Its last run failed, and nothing changed since.
    Failed,
}

impl Standing {
    /// The state as one word.
    pub fn word(self) -> &'static str {
        match self {
            Self::Cached => "cached",
            Self::Stale => "stale",
            Self::Missing => "missing",
            Self::Failed => "failed",
        }
    }
}

/// One cell of the table.
#[derive(Clone, Debug, Serialize)]
pub struct Cell {
    /// The stage.
    pub stage: &'static str,
    /// Its state.
    pub standing: Standing,
    /// The reason, in one line; empty for a cached node.
    pub reason: String,
    /// The ingredients that changed, if they are known.
    pub changes: Vec<Difference>,
    /// The process that computes it now.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub working: Option<Working>,
}

impl Cell {
    /// Its state as one word, with `running` for a node in work.
    pub fn word(&self) -> &'static str {
        if self.working.is_some() { "running" } else { self.standing.word() }
    }
}

/// One row: a scene and variant, or the stages that all scenes share.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    /// The scene; empty for stages over all scenes.
    pub scene: String,
    /// The variant; empty where there are none.
    pub variant: String,
    /// Its stages.
    pub cells: Vec<Cell>,
}

/// The table of scenes × stages.
#[derive(Clone, Debug, Serialize)]
pub struct Status {
    /// The pipeline's name.
    pub pipeline: String,
    /// The rows in the pipeline's order.
    pub rows: Vec<Row>,
    /// The progress of the whole batch.
    pub batch: BatchProgress,
}

/// The progress of a whole batch, without stages that share the work of others.
#[derive(Clone, Debug, Default, Serialize)]
pub struct BatchProgress {
    /// Number of stages.
    pub stages: usize,
    /// Number of stages whose artifacts exist.
    pub cached: usize,
    /// Number of stages that some process computes now.
    pub running: usize,
    /// Seconds left with as many stages at a time as are running now, or one at a time if none is; `None` if
    /// no stage ran before.
    pub seconds_left: Option<f64>,
}

impl BatchProgress {
    /// The share of the stages whose artifacts exist, in whole percent.
    pub fn percent(&self) -> usize {
        100 * self.cached / self.stages.max(1)
    }
}

impl Plan {
    /// The plan as a table.
    pub fn status(&self) -> Status {
        let mut rows: Vec<Row> = Vec::new();
        let mut places: HashMap<(&str, &str), usize> = HashMap::new();
        for node in self.nodes.iter().filter(|n| n.state != State::Unwanted) {
            let cell = cell(node);
            let place = *places.entry((&node.scene, &node.variant)).or_insert(rows.len());
            if place == rows.len() {
                let (scene, variant) = (node.scene.clone(), node.variant.clone());
                rows.push(Row { scene, variant, cells: Vec::new() });
            }
            rows[place].cells.push(cell);
        }
        Status { pipeline: self.pipeline.clone(), rows, batch: self.progress() }
    }

    /// The progress of the whole batch. A stage without a forecast counts by its usual cost, in the seconds
    /// that a unit of cost takes in the forecasts of the others.
    fn progress(&self) -> BatchProgress {
        let own = || self.own().filter(|node| node.state != State::Unwanted);
        let open = || own().filter(|node| matches!(node.state, State::Run(_) | State::Waiting(_)));
        let known = open().filter_map(|node| Some((node.forecast.as_ref()?.seconds, node.usual_cost)));
        let (seconds, cost) = known.fold((0.0, 0.0), |(s, c), (seconds, cost)| (s + seconds, c + cost));
        let left = |node: &PlannedNode| {
            let whole = match &node.forecast {
                Some(forecast) => forecast.seconds,
                None => node.usual_cost * seconds / cost.max(f64::MIN_POSITIVE),
            };
            let working = node.working.as_deref().filter(|working| working.total > 0);
            whole * working.map_or(1.0, |w| 1.0 - (w.done as f64 / w.total as f64).min(1.0))
        };
        let (sum, longest) =
            open().map(left).fold((0.0, 0.0f64), |(sum, longest), one| (sum + one, longest.max(one)));
        let running = own().filter(|node| node.working.is_some()).count();
        let known = cost > 0.0 || open().next().is_none();
        BatchProgress {
            stages: own().count(),
            cached: own().filter(|node| node.state == State::Cached).count(),
            running,
            seconds_left: known.then(|| longest.max(sum / running.max(1) as f64)),
        }
    }
}

/// The state of a planned node.
pub(crate) fn cell(node: &PlannedNode) -> Cell {
    let before = if node.had { Standing::Stale } else { Standing::Missing };
    let killed = node.killed.as_ref().map(ToString::to_string);
    let (standing, reason) = match (&node.state, node.failed.as_ref().or(killed.as_ref())) {
        (State::Cached, _) => (Standing::Cached, String::new()),
        (State::Run(_), Some(reason)) => (Standing::Failed, reason.clone()),
        (State::Unavailable(reason), _) => (Standing::Failed, reason.clone()),
        (State::Run(reason), None) => (before, reason.clone()),
        (State::Waiting(parents), _) => (before, format!("waits for {}", parents.join(", "))),
        (State::Blocked(by), _) => (before, format!("needs {by}")),
        (State::Unwanted, _) => (before, "not requested".to_string()),
    };
    let (changes, working) = (node.changes.clone(), node.working.as_deref().cloned());
    Cell { stage: node.stage, standing, reason, changes, working }
}

/// The number of cells by stage and state.
#[derive(Clone, Debug, Serialize)]
pub struct Counts {
    /// The pipeline's name.
    pub pipeline: String,
    /// The stages in the order of the table, each with the states of its cells and their numbers.
    pub stages: Vec<(&'static str, BTreeMap<&'static str, usize>)>,
    /// The progress of the whole batch.
    pub batch: BatchProgress,
}

impl Status {
    /// Returns the number of cells by stage and state.
    pub fn counts(&self) -> Counts {
        let mut stages: Vec<(&'static str, BTreeMap<&'static str, usize>)> = Vec::new();
        for cell in self.rows.iter().flat_map(|row| &row.cells) {
            let at = stages.iter().position(|(stage, _)| *stage == cell.stage).unwrap_or(stages.len());
            if at == stages.len() {
                stages.push((cell.stage, BTreeMap::new()));
            }
            *stages[at].1.entry(cell.word()).or_default() += 1;
        }
        Counts { pipeline: self.pipeline.clone(), stages, batch: self.batch.clone() }
    }

    /// Number of cells in this state.
    pub fn count(&self, standing: Standing) -> usize {
        self.rows.iter().flat_map(|r| &r.cells).filter(|c| c.standing == standing).count()
    }
}

/// The changes in a node.
#[derive(Clone, Debug, Serialize)]
pub struct Why {
    /// Scene, variant and stage, for display.
    pub label: String,
    /// Its state.
    pub standing: Standing,
    /// The reason, in one line.
    pub reason: String,
    /// Its key now, if it is known.
    pub key: Option<Key>,
    /// The key of the record it is compared with.
    pub earlier: Option<Key>,
    /// Time of that record (UTC).
    pub earlier_at: Option<String>,
    /// The ingredients that differ; without a key, those of inputs that do not exist yet are left out.
    pub changes: Vec<Difference>,
    /// The nodes upstream that have to run first, each with its changes.
    pub upstream: Vec<(String, Vec<Difference>)>,
}

impl Builder {
    /// Compares a node's ingredients with those of its most recent earlier record, field by field.
    pub fn why(&self, graph: &Graph, scene: &str, variant: &str, stage: &str) -> Result<Why, BuildError> {
        self.registry.index(stage)?;
        let Some(node) = graph.find(scene, variant, stage) else {
            let scenes = graph.nodes.iter().map(|n| n.scene.as_str()).filter(|s| !s.is_empty());
            let mut known: Vec<&str> = scenes.collect();
            known.dedup();
            if known.contains(&scene) {
                let stages = graph.nodes.iter().filter(|n| n.scene == scene).map(|n| n.stage_name);
                return Err(BuildError::unknown("stage of this scene", stage, stages));
            }
            return Err(BuildError::unknown("scene", scene, known));
        };
        // The other scenes of a large batch say nothing about this one.
        let only = [(scene.to_string(), variant.to_string())];
        let plan = self.plan_of(graph, None, Some(&only));
        let planned = &plan.nodes[node];
        let record = self.cache.record(&graph.name, &graph.nodes[node]);
        let Cell { standing, reason, mut changes, .. } = cell(planned);
        let outcomes = self.outcomes(&plan);
        let now = self.resolve(graph, node, &outcomes);
        let is_now = |last: &Made| now.as_ref().is_ok_and(|now| last.key == now.key);
        let earlier = if record.last.as_ref().is_some_and(is_now) { record.before } else { record.last };
        if let (Ok(now), Some(earlier)) = (&now, &earlier) {
            changes = earlier.ingredients.differences(&now.ingredients);
        }
        let mut upstream = Vec::new();
        if let Err(Unresolved::Waiting(_)) = now {
            let mut open: Vec<usize> = graph.parents(node).collect();
            let mut seen = Vec::new();
            while let Some(parent) = open.pop() {
                if seen.contains(&parent) {
                    continue;
                }
                seen.push(parent);
                open.extend(graph.parents(parent));
                if let State::Run(_) = plan.nodes[parent].state {
                    upstream.push((graph.nodes[parent].label(), plan.nodes[parent].changes.clone()));
                }
            }
        }
        Ok(Why {
            label: graph.nodes[node].label(),
            standing,
            reason,
            key: planned.key,
            earlier: earlier.as_ref().map(|e| e.key),
            earlier_at: earlier.map(|e| e.at),
            changes,
            upstream,
        })
    }

    /// The outcomes that a plan found in the cache, for resolving its nodes.
    pub(crate) fn outcomes(&self, plan: &Plan) -> Vec<Outcome> {
        let of = |node: &PlannedNode| match (&node.state, node.key) {
            (State::Cached, Some(key)) => match self.cache.lookup(node.stage, &key) {
                Ok(Lookup::Whole(artifact)) => Outcome::Ready(artifact),
                _ => Outcome::Open,
            },
            (State::Blocked(by) | State::Unavailable(by), _) => Outcome::Unavailable(by.clone()),
            _ => Outcome::Open,
        };
        plan.nodes.iter().map(of).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::history::Forecast;

    /// A stage that never ran counts by its cost, in the seconds per cost of those that did.
    #[test]
    fn the_time_left_of_a_batch_counts_stages_without_a_forecast_too() {
        let node = |state: State, usual_cost: f64, seconds: Option<f64>| PlannedNode {
            state,
            usual_cost,
            forecast: seconds.map(|seconds| {
                Box::new(Forecast {
                    seconds,
                    least: seconds,
                    most: seconds,
                    output: 0,
                    peak_memory: 0,
                    records: 1,
                    own: true,
                })
            }),
            ..PlannedNode::default()
        };
        let run = || State::Run("changed".into());
        let waiting = || State::Waiting(vec!["import".into()]);
        let nodes = vec![
            node(State::Cached, 0.0, None),
            node(run(), 1.0, Some(10.0)),
            node(waiting(), 2.0, None),
            node(State::Unwanted, 9.0, Some(99.0)),
        ];
        let plan = Plan { pipeline: "reefs".into(), nodes, seconds: 0.0 };
        let batch = plan.status().batch;
        assert_eq!((batch.cached, batch.stages, batch.percent()), (1, 3, 33));
        assert_eq!((batch.running, batch.seconds_left), (0, Some(30.0)));
        assert_eq!(
            batch.to_string(),
            "1 of 3 stages are there, 33 %; about 30 s of work, and no stage is running"
        );
        let nodes = vec![node(run(), 1.0, None)];
        let first = Plan { pipeline: "reefs".into(), nodes, seconds: 0.0 }.status().batch;
        assert_eq!(
            first.to_string(),
            "0 of 1 stages are there, 0 %; no earlier run to forecast the time from"
        );
    }
}
