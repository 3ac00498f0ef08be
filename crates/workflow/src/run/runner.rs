//! Runs a batch: starts every node whose inputs exist, within the limits of cores and memory.
//!
//! One thread decides, and each job works on a thread of its own. Nodes are started in the graph's order, so
//! that scenes finish one after another. A failed node blocks only the nodes that read its artifact;
//! stages over the whole batch use the results that exist. A lease protects the artifacts that the run needs
//! until it ends. The end of a scene's last stage is reported at once, so that its results need not wait for
//! the other scenes.
//!
//! Any number of processes, on one machine or on many, may run the same batch on one cache at once. A node
//! that another process computes is put back, and this process takes another one; the artifact is found once
//! it exists. So the processes share the work without direct contact, and all end with the same results.
//!
//! The cost of a node does not depend on the number of nodes. A node is examined when the last of its inputs
//! exists. Its key is resolved once and kept until an input changes. It is examined again only when it may
//! start.

mod need;
mod others;
mod records;

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::thread;
use std::time::{Duration, Instant};

use crate::cache::artifacts::{Artifact, Lookup};
use crate::cache::key::Key;
use crate::cache::machine;
use crate::error::{FileError, StageError};
use crate::plan::builder::Builder;
use crate::plan::graph::{Graph, SceneVariant};
use crate::plan::history::Timings;
use crate::plan::resolve::{Outcome, Resolved, Unresolved};
use crate::run::job::{Job, JobResult};
use crate::run::summary::{NodeResult, RanNode, Summary};
use crate::share::lease::RunLease;
use crate::stage::definition::Scope;
use crate::stage::events::{Event, Listener};
use need::Need;
use others::{Held, LEAVING};
use records::LastResult;

/// Options of a run.
#[derive(Clone, Debug)]
pub struct RunOptions {
    /// Most stages at the same time.
    pub jobs: usize,
    /// Most cores for all stages together.
    pub cores: usize,
    /// Most memory for all stages together, in bytes.
    pub memory: u64,
    /// Continue with the other scenes when one fails.
    pub keep_going: bool,
    /// Stop after these stages; `None` runs all.
    pub until: Option<Vec<String>>,
    /// Run only these scenes and variants, and the nodes they need; `None` runs all.
    pub only: Option<Vec<SceneVariant>>,
    /// The flag that ends the run: stages save their checkpoints and stop.
    pub stop: Arc<AtomicBool>,
    /// The time limit since the start of the run: before it, stages save their checkpoints, and the rest of
    /// the work is left for another run.
    pub limit: Option<Duration>,
    /// A flag that is set before `stop` if another run will continue the work and the exit code should report
    /// that.
    pub leave: Arc<AtomicBool>,
    /// Stop waiting for other processes after this long idle; `None` waits until they finish.
    pub until_empty: Option<Duration>,
    /// Compute only stages over the whole batch, from the artifacts that exist; other stages are only looked
    /// up.
    pub gather: bool,
    /// Compute only the stages of `until`: what they lack is left to others.
    pub alone: bool,
}

impl Default for RunOptions {
    fn default() -> Self {
        Self {
            jobs: 1,
            cores: machine::cores(),
            memory: machine::available_memory().unwrap_or(u64::MAX),
            keep_going: false,
            until: None,
            only: None,
            stop: Arc::default(),
            limit: None,
            leave: Arc::default(),
            until_empty: None,
            gather: false,
            alone: false,
        }
    }
}

impl Builder {
    /// Runs `graph`. Failures of stages are in the summary.
    pub fn run(&self, graph: &Graph, options: &RunOptions, listener: &Arc<dyn Listener>) -> Summary {
        let start = Instant::now();
        self.cache.contents.look_again();
        let swept = self.cache.sweep();
        if swept > 0 {
            let text = format!("removed {swept} unfinished result(s) of earlier runs that were cut off");
            listener.event(&Event::Note { label: &graph.name, text: &text });
        }
        let mut runner = Runner::new(self, graph, options, listener);
        if self.remote.is_some() {
            // Machines that share only a store see no leases, so each begins with other scenes.
            runner.spread();
        }
        thread::scope(|scope| runner.drive(scope));
        let (nodes, lease, left) = (runner.nodes, runner.lease, runner.left);
        if let Err(error) = self.cache.contents.save() {
            listener.event(&Event::Warning { label: &graph.name, text: &error.to_string() });
        }
        let interrupted = options.stop.load(Ordering::Relaxed);
        Summary {
            pipeline: graph.name.clone(),
            nodes,
            interrupted,
            left: left || options.leave.load(Ordering::Relaxed),
            seconds: start.elapsed().as_secs_f64(),
            lease: Some(Arc::new(lease)),
        }
    }
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Phase {
    Pending,
    Running,
    Over,
}

struct Running {
    cores: usize,
    memory: u64,
    key: Key,
}

struct Runner<'r> {
    builder: &'r Builder,
    graph: &'r Graph,
    options: &'r RunOptions,
    listener: &'r Arc<dyn Listener>,
    phase: Vec<Phase>,
    outcomes: Vec<Outcome>,
    nodes: Vec<RanNode>,
    /// The nodes that read the artifact of each node.
    children: Vec<Vec<usize>>,
    /// The number of unfinished inputs of each node.
    open: Vec<usize>,
    /// The position of each node in the order of trials.
    rank: Vec<usize>,
    /// Nodes that must be examined, by rank.
    due: BTreeSet<(usize, usize)>,
    /// Nodes that were examined and must be computed, by rank, with their keys.
    waiting: BTreeMap<(usize, usize), Box<Resolved>>,
    /// Shared nodes that may not be needed by any other node.
    unsure: Vec<usize>,
    /// True if no waiting node can start before another one ends.
    full: bool,
    running: HashMap<usize, Running>,
    /// Estimated memory of the nodes that could be started, in bytes.
    memory: Vec<Option<u64>>,
    /// Number of times that an artifact was found damaged, so that a bad disk cannot keep the run going for
    /// ever.
    damaged: HashMap<usize, usize>,
    halted: bool,
    lease: RunLease,
    spread: bool,
    held: HashMap<usize, Held>,
    /// Nodes that failed in another task of this submission, by label, each with the reason.
    left_alone: HashMap<String, String>,
    start: Duration,
    leave_at: Option<Duration>,
    /// Past durations, if the time is limited.
    timings: Option<Timings>,
    /// True if a node was not started because it would not have finished in time.
    untimely: bool,
    left: bool,
    /// The time since which this process has nothing to do.
    idle: Option<Duration>,
    /// The last records of each node, from earlier runs.
    known: Vec<LastResult>,
    /// The nodes of each scene and variant, with the number of unfinished ones.
    scenes: Vec<OwnNodes>,
    scene_of: Vec<Option<usize>>,
    /// The requested nodes that all scenes of a variant share.
    shared: Vec<usize>,
    /// Finished scenes that are not reported yet.
    unreported: BTreeSet<usize>,
    sender: mpsc::Sender<(usize, JobResult)>,
    receiver: mpsc::Receiver<(usize, JobResult)>,
}

/// The nodes of a scene and variant.
#[derive(Default)]
struct OwnNodes {
    nodes: Vec<usize>,
    open: usize,
}

/// The threads of a run's jobs.
type Threads<'s, 'r> = &'s thread::Scope<'s, 'r>;

/// The number of waiting nodes that are tried before the others are taken as too large.
const LOOK_AHEAD: usize = 64;

impl<'r> Runner<'r> {
    fn new(
        builder: &'r Builder,
        graph: &'r Graph,
        options: &'r RunOptions,
        listener: &'r Arc<dyn Listener>,
    ) -> Self {
        let wanted = graph.wanted_of(options.until.as_deref(), options.only.as_deref());
        let nodes = graph.nodes.iter().zip(&wanted).map(|(node, wanted)| RanNode {
            stage: node.stage_name,
            scene: node.scene.clone(),
            variant: node.variant.clone(),
            label: node.label(),
            result: if *wanted { NodeResult::NotRun } else { NodeResult::Unwanted },
            seconds: 0.0,
            shared: node.same_as.is_some(),
            parameters: node.parameters.clone(),
            delivered: node.delivered,
            preset: node.preset.clone(),
            seed: node.seed,
            failure: None,
            artifact: None,
        });
        let (sender, receiver) = mpsc::channel();
        let mut lease = RunLease::new(&builder.cache);
        let count = graph.nodes.len();
        let (mut scenes, mut scene_of) = (Vec::<OwnNodes>::new(), vec![None; count]);
        let mut places: HashMap<(&str, &str), usize> = HashMap::new();
        let mut known = vec![LastResult::default(); count];
        let records = builder.cache.records(&graph.name);
        let (mut children, mut open) = (vec![Vec::new(); count], vec![0; count]);
        for (i, node) in graph.nodes.iter().enumerate().filter(|(i, _)| wanted[*i]) {
            // A node's last artifact is likely the one it needs now, also while its inputs are being made.
            known[i] = records(node);
            lease.extend(known[i].last.map(|(key, _)| key));
            if !node.scene.is_empty() {
                let place = *places.entry((&node.scene, &node.variant)).or_insert(scenes.len());
                if place == scenes.len() {
                    scenes.push(OwnNodes::default());
                }
                scenes[place].nodes.push(i);
                scenes[place].open += 1;
                scene_of[i] = Some(place);
            }
            for parent in graph.needs(i) {
                children[parent].push(i);
                open[i] += usize::from(wanted[parent]);
            }
        }
        let scope = |i: &usize| builder.registry.stages()[graph.nodes[*i].stage].scope;
        let shared = (0..count).filter(|i| wanted[*i] && scope(i) == Scope::Shared).collect();
        lease.show();
        let unwanted = Outcome::Unavailable("nobody".to_string());
        let start = builder.cache.node.clock.now();
        let leave_at = options.limit.map(|limit| start + limit - LEAVING.min(limit / 10));
        Self {
            due: (0..count).filter(|i| wanted[*i] && open[*i] == 0).map(|i| (i, i)).collect(),
            rank: (0..count).collect(),
            children,
            open,
            waiting: BTreeMap::new(),
            unsure: Vec::new(),
            full: false,
            spread: false,
            held: HashMap::new(),
            left_alone: HashMap::new(),
            start,
            leave_at,
            timings: options.limit.map(|_| builder.cache.timings()),
            untimely: false,
            left: false,
            idle: None,
            known,
            builder,
            graph,
            options,
            listener,
            phase: wanted.iter().map(|w| if *w { Phase::Pending } else { Phase::Over }).collect(),
            outcomes: wanted.iter().map(|w| if *w { Outcome::Open } else { unwanted.clone() }).collect(),
            nodes: nodes.collect(),
            running: HashMap::new(),
            memory: vec![None; count],
            damaged: HashMap::new(),
            halted: false,
            lease,
            scenes,
            scene_of,
            shared,
            unreported: BTreeSet::new(),
            sender,
            receiver,
        }
    }

    fn drive(&mut self, scope: Threads<'_, 'r>) {
        loop {
            self.watch_time();
            self.ask_again();
            while !self.stopped() && self.step(scope) {
                // Finished jobs make room and are inputs of other nodes.
                while let Ok((i, ended)) = self.receiver.try_recv() {
                    self.finish(i, ended);
                }
                self.lease.keep_alive();
                self.watch_time();
            }
            self.lease.show();
            self.report_scenes();
            if self.running.is_empty() && (self.stopped() || !self.waits_for_others()) {
                self.left |= self.untimely;
                return;
            }
            self.wait();
        }
    }

    /// Starts the first node that can start, or examines the first node that is due, whichever comes first in
    /// the order. Returns false if there was none.
    fn step(&mut self, scope: Threads<'_, 'r>) -> bool {
        let next = self.due.first().copied();
        if self.has_room() && !self.full {
            let before = |at: &(usize, usize)| next.is_none_or(|next| *at < next);
            let candidates: Vec<(usize, usize)> =
                self.waiting.keys().copied().take_while(before).take(LOOK_AHEAD).collect();
            let tried = candidates.len();
            for at in candidates {
                if self.try_waiting(at, scope) {
                    return true;
                }
            }
            self.full = tried == LOOK_AHEAD || next.is_none();
        }
        let Some((_, i)) = next else { return false };
        self.due.pop_first();
        if self.phase[i] == Phase::Pending {
            self.advance(i, scope);
        }
        true
    }

    /// Starts a node that waits for room, if there is enough for it. If another process has made its artifact
    /// meanwhile, that one is used.
    fn try_waiting(&mut self, at: (usize, usize), scope: Threads<'_, 'r>) -> bool {
        let Some(resolved) = self.waiting.remove(&at) else { return false };
        let i = at.1;
        if self.phase[i] != Phase::Pending {
            return false;
        }
        if !self.fits(i, &resolved) {
            return self.keep_waiting(i, resolved);
        }
        match self.look_up(i, &resolved.key, false) {
            Ok(Lookup::Missing) => self.start(i, resolved, scope),
            found => self.found(i, found, resolved, scope),
        }
    }

    /// Puts a node among the waiting ones, unless there is no time left for it.
    fn keep_waiting(&mut self, i: usize, resolved: Box<Resolved>) -> bool {
        if self.comes_too_late(i) {
            self.untimely = true;
        } else {
            self.waiting.insert((self.rank[i], i), resolved);
        }
        false
    }

    /// Reports every scene whose last node has finished.
    fn report_scenes(&mut self) {
        for place in std::mem::take(&mut self.unreported) {
            let own = &self.scenes[place].nodes;
            let variant = &self.nodes[own[0]].variant;
            let shared = self.shared.iter().filter(|i| self.nodes[**i].variant == *variant);
            let nodes: Vec<RanNode> = own.iter().chain(shared).map(|i| self.nodes[*i].clone()).collect();
            let RanNode { scene, variant, .. } = &nodes[0];
            self.listener.event(&Event::SceneOver { scene, variant, nodes: &nodes });
        }
    }

    /// Marks a node as finished; nodes that read it may now be examined.
    fn over(&mut self, i: usize) {
        if std::mem::replace(&mut self.phase[i], Phase::Over) == Phase::Over {
            return;
        }
        if let Some(place) = self.scene_of[i] {
            self.scenes[place].open -= 1;
            if self.scenes[place].open == 0 {
                self.unreported.insert(place);
            }
        }
        let failed = matches!(self.outcomes[i], Outcome::Unavailable(_));
        for at in 0..self.children[i].len() {
            let child = self.children[i][at];
            self.open[child] -= 1;
            let blocks = failed && self.scope(child) != Scope::Batch;
            if self.phase[child] == Phase::Pending && (self.open[child] == 0 || blocks) {
                self.due.insert((self.rank[child], child));
            }
        }
        for unsure in std::mem::take(&mut self.unsure) {
            self.due.insert((self.rank[unsure], unsure));
        }
    }

    /// Makes a node pending again because its artifact is gone; nodes that read it wait.
    fn reopen(&mut self, i: usize) {
        self.outcomes[i] = Outcome::Open;
        self.nodes[i].artifact = None;
        if std::mem::replace(&mut self.phase[i], Phase::Pending) != Phase::Over {
            return;
        }
        if let Some(place) = self.scene_of[i] {
            self.scenes[place].open += 1;
            self.unreported.remove(&place);
        }
        for at in 0..self.children[i].len() {
            let child = self.children[i][at];
            self.open[child] += 1;
            self.due.remove(&(self.rank[child], child));
            self.waiting.remove(&(self.rank[child], child));
            // What was resolved with the lost artifact must not start later.
            self.forget_resolved(child);
        }
    }

    fn scope(&self, i: usize) -> Scope {
        self.builder.registry.stages()[self.graph.nodes[i].stage].scope
    }

    fn warn(&self, i: usize, text: &str) {
        self.listener.event(&Event::Warning { label: &self.nodes[i].label, text });
    }

    fn stopped(&self) -> bool {
        self.halted || self.options.stop.load(Ordering::Relaxed)
    }

    /// Decides about a pending node, if that is possible now.
    fn advance(&mut self, i: usize, scope: Threads<'_, 'r>) {
        if let Some(first) = self.graph.nodes[i].same_as {
            if self.phase[first] == Phase::Over {
                self.share(i, first);
            }
            return;
        }
        let resolved = match self.builder.resolve(self.graph, i, &self.outcomes) {
            Ok(resolved) => Box::new(resolved),
            // It is examined again when they exist.
            Err(Unresolved::Waiting(_)) => return,
            Err(Unresolved::Blocked(by)) => return self.block(i, by),
            Err(Unresolved::Input(reason)) => {
                return self.fail(i, None, &StageError::bad_input_message(reason));
            }
            Err(Unresolved::Device(reason)) => return self.lacks_device(i, None, &reason),
        };
        self.lease.extend([resolved.key]);
        let found = self.look_up(i, &resolved.key, true);
        self.found(i, found, resolved, scope);
    }

    /// Takes the result of the node whose work this one repeats.
    fn share(&mut self, i: usize, first: usize) {
        self.outcomes[i] = self.outcomes[first].clone();
        self.nodes[i].result = match &self.nodes[first].result {
            NodeResult::Done => NodeResult::Cached,
            other => other.clone(),
        };
        self.nodes[i].artifact = self.nodes[first].artifact.clone();
        if let (Outcome::Ready(artifact), NodeResult::Cached) = (&self.outcomes[i], &self.nodes[i].result) {
            let artifact = artifact.clone();
            self.record_made(i, &artifact);
        }
        self.over(i);
    }

    fn block(&mut self, i: usize, by: String) {
        // The task in which the cause failed reports it.
        let reason = self.left_alone.get(&by);
        self.nodes[i].result =
            reason.map_or_else(|| NodeResult::Blocked(by.clone()), |r| NodeResult::Elsewhere(r.clone()));
        self.outcomes[i] = Outcome::Unavailable(by);
        self.over(i);
    }

    /// Continues with the result of the lookup of a node's key. Returns true if the state has changed.
    fn found(
        &mut self,
        i: usize,
        found: Result<Lookup, FileError>,
        resolved: Box<Resolved>,
        scope: Threads<'_, 'r>,
    ) -> bool {
        match found {
            Ok(Lookup::Whole(artifact)) => {
                self.builder.cache.touch(&artifact.path);
                let label = &self.nodes[i].label;
                self.listener.event(&Event::Done { node: i, label, cached: true, seconds: 0.0 });
                self.ready(i, artifact, NodeResult::Cached, 0.0);
                return true;
            }
            Ok(Lookup::Missing) => {}
            Ok(Lookup::Damaged(reason)) => {
                let aside = self.builder.cache.set_aside(self.graph.nodes[i].stage_name, &resolved.key);
                let place = aside.map_or_else(|e| e.to_string(), |p| format!("moved to {}", p.display()));
                self.warn(i, &format!("its artifact is damaged: {reason}; {place}, computing it again"));
            }
            Err(error) => {
                self.fail(i, Some(resolved.key), &error.into());
                return true;
            }
        }
        if self.options.gather && self.scope(i) != Scope::Batch {
            self.miss(i, Some(resolved.key));
            return true;
        }
        let stage = self.graph.nodes[i].stage_name;
        if self.options.alone && !self.options.until.iter().flatten().any(|name| name == stage) {
            self.leave_alone(i, &format!("the tasks of {stage}"));
            return true;
        }
        if let Some(reason) = &resolved.elsewhere {
            self.lacks_device(i, Some(resolved.key), reason);
            return true;
        }
        if self.scope(i) == Scope::Shared {
            match self.need(i) {
                Need::Unasked | Need::Live => {}
                Need::Unknown => {
                    self.unsure.push(i);
                    return false;
                }
                Need::Nobody(by) => {
                    self.block(i, by);
                    return true;
                }
            }
        }
        if self.fits(i, &resolved) { self.start(i, resolved, scope) } else { self.keep_waiting(i, resolved) }
    }

    /// Looks up a node's key. An unexpected result is checked a second time: on a network file system,
    /// another machine's artifact may appear late.
    fn look_up(&self, i: usize, key: &Key, first: bool) -> Result<Lookup, FileError> {
        let (cache, node) = (&self.builder.cache, &self.graph.nodes[i]);
        let found = cache.lookup(node.stage_name, key)?;
        let suspect = match found {
            Lookup::Whole(_) => return Ok(found),
            Lookup::Damaged(_) => true,
            Lookup::Missing => first && self.known[i].last.is_some_and(|(last, _)| last == *key),
        };
        if suspect { cache.lookup_again(node.stage_name, key) } else { Ok(found) }
    }

    /// Returns true if a node can start now: there is room for it, and this process does not compute the same
    /// key already.
    fn fits(&mut self, i: usize, resolved: &Resolved) -> bool {
        if !self.has_room() || self.running.values().any(|r| r.key == resolved.key) {
            return false;
        }
        let stage = &self.builder.registry.stages()[self.graph.nodes[i].stage];
        let memory = *self.memory[i]
            .get_or_insert_with(|| stage.memory_on(&self.graph.nodes[i].parameters, &resolved.inputs));
        let used: u64 = self.running.values().map(|r| r.memory).sum();
        let fits = used.saturating_add(memory) <= self.options.memory;
        // A job that needs more than all memory runs alone.
        (fits || self.running.is_empty()) && !self.comes_too_late(i)
    }

    /// Starts a node.
    fn start(&mut self, i: usize, resolved: Box<Resolved>, scope: Threads<'_, 'r>) -> bool {
        let stage = &self.builder.registry.stages()[self.graph.nodes[i].stage];
        let jobs = self.options.jobs.max(1);
        let memory = self.memory[i].unwrap_or(0);
        if memory > self.options.memory {
            let [needs, free] = [memory, self.options.memory].map(machine::bytes);
            self.warn(i, &format!("needs about {needs} of memory, {free} are free: running it alone"));
        }
        let used_cores: usize = self.running.values().map(|r| r.cores).sum();
        let share = self.options.cores.saturating_sub(used_cores) / (jobs - self.running.len());
        let most = if stage.cores == 0 { usize::MAX } else { stage.cores };
        let threads = share.clamp(1, most.max(1));
        self.lease.extend(resolved.checkpoints);
        self.lease.show();
        self.phase[i] = Phase::Running;
        self.running.insert(i, Running { cores: threads, memory, key: resolved.key });
        let job = Job {
            builder: self.builder,
            pipeline: &self.graph.name,
            id: i,
            node: &self.graph.nodes[i],
            label: self.nodes[i].label.clone(),
            resolved,
            threads,
            stop: self.options.stop.clone(),
            listener: self.listener.clone(),
        };
        let sender = self.sender.clone();
        scope.spawn(move || {
            // The receiver outlives the scope.
            let _ = sender.send((i, job.execute()));
        });
        true
    }

    fn finish(&mut self, i: usize, ended: JobResult) {
        let key = self.running.remove(&i).map(|r| r.key);
        self.full = false;
        if !matches!(ended, JobResult::Held(..)) {
            self.held.remove(&i);
            self.idle = None;
        }
        match ended {
            JobResult::Ready { artifact, computed, seconds } => {
                self.warn_if_changed(i, &artifact);
                let label = &self.nodes[i].label;
                self.listener.event(&Event::Done { node: i, label, cached: !computed, seconds });
                let result = if computed { NodeResult::Done } else { NodeResult::Cached };
                self.ready(i, artifact, result, seconds);
            }
            JobResult::Failed(error) => self.fail(i, key, &error),
            JobResult::Cancelled => {
                self.outcomes[i] = Outcome::Unavailable("the interruption".to_string());
                self.over(i);
            }
            JobResult::LeftAlone(reason) => self.leave_alone(i, &reason),
            JobResult::Held(holder, resolved) => self.put_back(i, holder, resolved),
            JobResult::DamagedInput(parent) => {
                // A node that shares another node's work is made again by that node.
                let maker = self.graph.nodes[parent].same_as.unwrap_or(parent);
                let times = self.damaged.entry(maker).or_default();
                *times += 1;
                if *times > 2 {
                    let whose = self.graph.nodes[maker].label();
                    let root = self.builder.cache.root().display();
                    let reason = format!(
                        "{whose} was damaged or removed repeatedly; check the disk, and look for another \
                         program that removes files in {root}"
                    );
                    self.fail(i, key, &StageError::message(reason));
                    return;
                }
                self.phase[i] = Phase::Pending;
                for node in BTreeSet::from([parent, maker]) {
                    // A running or pending input will be made.
                    if self.phase[node] == Phase::Over {
                        self.reopen(node);
                    }
                }
                // Another process that noticed it first may have made it again.
                for node in [i, maker] {
                    if self.phase[node] == Phase::Pending && self.open[node] == 0 {
                        self.due.insert((self.rank[node], node));
                    }
                }
            }
        }
    }

    fn ready(&mut self, i: usize, artifact: Arc<Artifact>, result: NodeResult, seconds: f64) {
        self.held.remove(&i);
        self.record_made(i, &artifact);
        self.nodes[i].artifact = Some(artifact.clone());
        self.nodes[i].result = result;
        self.nodes[i].seconds += seconds;
        self.outcomes[i] = Outcome::Ready(artifact);
        self.over(i);
    }
}
