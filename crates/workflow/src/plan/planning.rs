//! The plan of a run: the nodes that would run, the cached ones, and the reasons. It is exact and computes
//! nothing.
//!
//! A node below one that has to run has no key yet, because its inputs do not exist: it *waits*. It will run
//! unless its inputs come out the same as before (early cut-off).

use std::path::PathBuf;

use serde::Serialize;

use crate::cache::artifacts::Lookup;
use crate::cache::key::{Difference, Key};
use crate::plan::builder::Builder;
use crate::plan::graph::{Graph, SceneVariant};
use crate::plan::history::{Forecast, Record};
use crate::plan::resolve::{self, Outcome, Unresolved};
use crate::share::killed::Killed;
use crate::share::lease::Working;
use crate::stage::expected::Expected;

/// The planned state of a node.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase", tag = "state", content = "detail")]
pub enum State {
    /// Its artifact is in the cache.
    Cached,
    /// It would run, for this reason.
    Run(String),
    /// It waits for inputs that would run, and runs unless they come out the same as before.
    Waiting(Vec<String>),
    /// It cannot run: an input outside the pipeline is missing or unreadable.
    Unavailable(String),
    /// It cannot run because of another node.
    Blocked(String),
    /// It was not requested.
    #[default]
    Unwanted,
}

/// A node of a plan.
#[derive(Clone, Debug, Default, Serialize)]
pub struct PlannedNode {
    /// The stage.
    pub stage: &'static str,
    /// The scene; empty for stages over all scenes.
    pub scene: String,
    /// The variant; empty where there are none.
    pub variant: String,
    /// Its planned state.
    #[serde(flatten)]
    pub state: State,
    /// Its key, if it is known.
    pub key: Option<Key>,
    /// Its artifact, if it exists.
    pub artifact: Option<PathBuf>,
    /// The key of the checkpoints from which it would resume, for a stage with checkpoints.
    #[serde(skip)]
    pub checkpoints: Option<Key>,
    /// The changes since its last artifact.
    pub changes: Vec<Difference>,
    /// Its estimated cost.
    pub forecast: Option<Box<Forecast>>,
    /// Its likely cost, if it never ran.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub expected: Option<Expected>,
    /// Its usual cost, in the unit of [`Stage::usually_costs`](crate::Stage::usually_costs).
    #[serde(skip)]
    pub usual_cost: f64,
    /// Estimated memory in bytes, from those of its inputs that exist; `None` where there is no estimate.
    pub memory: Option<u64>,
    /// The node that does the same work, for display.
    pub shared_with: Option<String>,
    /// The reason of the last failure, if nothing has changed since.
    pub failed: Option<String>,
    /// True if it ever had an artifact.
    pub had: bool,
    /// The process that was killed while it computed the artifact last.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub killed: Option<Box<Killed>>,
    /// The process that computes it now.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub working: Option<Box<Working>>,
    /// The nodes of the plan whose artifacts it reads. For a node that repeats the work of another, this is
    /// that node.
    #[serde(skip)]
    pub needs: Vec<usize>,
}

/// A plan.
#[derive(Clone, Debug, Serialize)]
pub struct Plan {
    /// The pipeline's name.
    pub pipeline: String,
    /// The nodes, inputs first.
    pub nodes: Vec<PlannedNode>,
    /// Time that planning took, in seconds.
    pub seconds: f64,
}

impl Plan {
    /// Number of nodes that would run or may have to, without those that share another's work.
    pub fn to_run(&self) -> usize {
        self.count(|state| matches!(state, State::Run(_) | State::Waiting(_)))
    }

    /// Number of cached nodes, without those that share another's work.
    pub fn cached(&self) -> usize {
        self.count(|state| *state == State::Cached)
    }

    /// Number of nodes that cannot run because an input that the pipeline names is missing or unreadable,
    /// without those that share another's work.
    pub fn unavailable(&self) -> usize {
        self.count(|state| matches!(state, State::Unavailable(_)))
    }

    /// Number of nodes that cannot run because of other nodes, without those that share another's work.
    pub fn blocked(&self) -> usize {
        self.count(|state| matches!(state, State::Blocked(_)))
    }

    fn count(&self, which: impl Fn(&State) -> bool) -> usize {
        self.own().filter(|node| which(&node.state)).count()
    }

    /// The sum of the forecasts, and the number of nodes to run without a forecast.
    pub fn forecast(&self) -> (f64, usize) {
        let would_run = self.own().filter(|n| matches!(n.state, State::Run(_) | State::Waiting(_)));
        would_run.fold((0.0, 0), |(sum, without), node| match &node.forecast {
            Some(forecast) => (sum + forecast.seconds, without),
            None => (sum, without + 1),
        })
    }

    /// The sum of the likely costs of stages that never ran; `None` if there is none.
    pub fn expected(&self) -> Option<Expected> {
        let each = self.own().filter_map(|node| node.expected);
        each.reduce(|a, b| Expected { seconds: a.seconds + b.seconds, bytes: a.bytes + b.bytes })
    }

    pub(crate) fn own(&self) -> impl Iterator<Item = &PlannedNode> {
        self.nodes.iter().filter(|n| n.shared_with.is_none())
    }
}

impl Builder {
    /// Plans the nodes of `graph` up to the named stages, or all nodes.
    pub fn plan(&self, graph: &Graph, until: Option<&[String]>) -> Plan {
        self.plan_of(graph, until, None)
    }

    /// Like [`plan`](Self::plan), but only of these scenes and variants, and of all that they need.
    pub(crate) fn plan_of(
        &self,
        graph: &Graph,
        until: Option<&[String]>,
        only: Option<&[SceneVariant]>,
    ) -> Plan {
        let start = std::time::Instant::now();
        self.cache.contents.look_again();
        let wanted = graph.wanted_of(until, only);
        let timings = self.cache.timings();
        let mut outcomes = vec![Outcome::Open; graph.nodes.len()];
        let records = self.cache.records(&graph.name);
        let mut nodes: Vec<PlannedNode> = Vec::with_capacity(graph.nodes.len());
        for (i, node) in graph.nodes.iter().enumerate() {
            let record: Record = records(node);
            let mut planned = PlannedNode {
                stage: node.stage_name,
                scene: node.scene.clone(),
                variant: node.variant.clone(),
                had: record.last.is_some(),
                needs: graph.needs(i),
                ..PlannedNode::default()
            };
            if !wanted[i] {
                outcomes[i] = Outcome::Unavailable(String::new());
                nodes.push(planned);
                continue;
            }
            if let Some(first) = node.same_as {
                let PlannedNode { scene, variant, had, needs, .. } = planned;
                let shared_with = Some(graph.nodes[first].label());
                let (changes, forecast, memory) = (Vec::new(), None, None);
                let twin = nodes[first].clone();
                let twin = PlannedNode {
                    scene,
                    variant,
                    had,
                    needs,
                    shared_with,
                    changes,
                    forecast,
                    memory,
                    ..twin
                };
                outcomes[i] = outcomes[first].clone();
                nodes.push(twin);
                continue;
            }
            outcomes[i] = self.plan_node(graph, i, &outcomes, &record, &mut planned);
            if matches!(planned.state, State::Run(_) | State::Waiting(_)) {
                let stage = &self.registry.stages()[node.stage];
                planned.usual_cost = stage.usual_cost(&node.parameters);
                let forecast = timings.forecast(stage.name, &node.scene, stage.length(&node.parameters));
                planned.forecast = forecast.map(Box::new);
                let inputs = resolve::existing_inputs(graph, i, &outcomes);
                planned.memory = stage.known_memory(&node.parameters, &inputs);
                let place = &node.place;
                let expect = stage.expect.as_ref().filter(|_| planned.forecast.is_none());
                planned.expected = expect.and_then(|expect| expect(&place.all, &place.named, &inputs));
            }
            nodes.push(planned);
        }
        if let Err(error) = self.cache.contents.save() {
            tracing::debug!("{error}");
        }
        Plan { pipeline: graph.name.clone(), nodes, seconds: start.elapsed().as_secs_f64() }
    }

    fn plan_node(
        &self,
        graph: &Graph,
        i: usize,
        outcomes: &[Outcome],
        record: &Record,
        planned: &mut PlannedNode,
    ) -> Outcome {
        let label = || graph.nodes[i].label();
        let resolved = match self.resolve(graph, i, outcomes) {
            Ok(resolved) => resolved,
            Err(Unresolved::Waiting(parents)) => {
                planned.failed = record.failed(None).map(|f| f.reason.clone());
                planned.state = State::Waiting(parents.iter().map(|p| graph.nodes[*p].label()).collect());
                return Outcome::Open;
            }
            Err(Unresolved::Blocked(by)) => {
                planned.state = State::Blocked(by.clone());
                return Outcome::Unavailable(by);
            }
            Err(Unresolved::Input(reason)) => {
                planned.failed = record.failed(None).map(|f| f.reason.clone());
                planned.state = State::Unavailable(reason);
                return Outcome::Unavailable(label());
            }
            Err(Unresolved::Device(reason)) => {
                planned.failed = record.failed(None).map(|f| f.reason.clone());
                planned.state = State::Run(reason);
                return Outcome::Open;
            }
        };
        planned.key = Some(resolved.key);
        planned.checkpoints = resolved.checkpoints;
        let reason = match self.cache.lookup(planned.stage, &resolved.key) {
            Ok(Lookup::Whole(artifact)) => {
                planned.state = State::Cached;
                planned.artifact = Some(artifact.path.clone());
                return Outcome::Ready(artifact);
            }
            Ok(Lookup::Missing) => None,
            Ok(Lookup::Damaged(reason)) => Some(format!("its artifact is damaged: {reason}")),
            Err(error) => {
                planned.state = State::Unavailable(error.to_string());
                return Outcome::Unavailable(label());
            }
        };
        planned.working = self.cache.working_on(&resolved.key).map(Box::new);
        if planned.working.is_none() {
            planned.killed = self.cache.killed_at(&resolved.key).map(Box::new);
        }
        planned.failed = record.failed(Some(resolved.key)).map(|f| f.reason.clone());
        if let Some(last) = record.last.as_ref().filter(|last| last.key != resolved.key) {
            planned.changes = last.ingredients.differences(&resolved.ingredients);
        }
        let killed = planned.killed.as_ref().map(ToString::to_string);
        planned.state =
            State::Run(reason.or(killed).unwrap_or_else(|| match (&record.last, &planned.failed) {
                (_, Some(_)) => "the last attempt failed".to_string(),
                (None, _) => "never made".to_string(),
                (Some(last), _) if last.key == resolved.key => "its artifact was removed".to_string(),
                (Some(_), _) => "changed".to_string(),
            }));
        Outcome::Open
    }
}
