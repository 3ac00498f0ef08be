//! Runs a batch: starts every node whose inputs exist, within the limits of cores and memory.
//!
//! One thread decides, an [executor](super::executor) does the work. Nodes are started in the graph's order,
//! so that scenes finish one after another. A failed node blocks only the nodes that read its artifact;
//! stages over the whole batch use the results that exist. A lease protects the artifacts that the run needs
//! until it ends. The end of a scene's last stage is reported at once, so that its results need not wait for
//! the other scenes.
//!
//! Any number of processes, on one machine or on many, may run the same batch on one cache at once. A node
//! that another process computes is put back, and this process takes another one; the artifact is found once
//! it exists. So the processes share the work without direct contact, and all end with the same results.

mod need;
mod others;
mod records;

use std::collections::{BTreeMap, HashMap};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};

use super::Builder;
use super::cache::{Artifact, Lookup};
use super::error::FileError;
use super::events::{Event, Listener};
use super::executor::{Executor, Starter, Task, Threads};
use super::graph::Graph;
use super::history::Timings;
use super::job::{Ended, Job};
use super::key::{Ingredients, Key};
use super::lease::RunLease;
use super::machine;
use super::resolve::{self, Outcome, Unresolved};
use super::stage::Scope;
pub use super::summary::{Became, RanNode, Summary};
use need::Need;
use others::{Held, LEAVING};

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
    pub only: Option<Vec<(String, String)>>,
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
    /// The executor of the jobs.
    pub executor: Arc<dyn Executor>,
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
            executor: Arc::new(Threads),
        }
    }
}

impl Builder {
    /// Runs `graph`. Failures of stages are in the summary.
    pub fn run(&self, graph: &Graph, options: &RunOptions, listener: &Arc<dyn Listener>) -> Summary {
        let start = Instant::now();
        self.cache.contents().look_again();
        let swept = self.cache.sweep();
        if swept > 0 {
            let text = format!("removed {swept} unfinished result(s) of earlier runs that were cut off");
            listener.event(&Event::Note { label: &graph.name, text: &text });
        }
        let mut runner = Runner::new(self, graph, options, listener);
        options.executor.serve(&mut |starter| runner.drive(starter));
        let (nodes, lease, left) = (runner.nodes, runner.lease, runner.left);
        if let Err(error) = self.cache.contents().save() {
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
    running: HashMap<usize, Running>,
    /// Estimated memory of the nodes that could be started, in bytes.
    memory: Vec<Option<u64>>,
    /// Number of times that an artifact was found damaged, so that a bad disk cannot keep the run going for
    /// ever.
    damaged: HashMap<usize, usize>,
    halted: bool,
    lease: RunLease,
    /// The order in which nodes are tried.
    order: Vec<usize>,
    spread: bool,
    held: HashMap<usize, Held>,
    /// Keys that were looked up and not found: they are not looked up again before they could be computed.
    missing: HashMap<usize, Key>,
    start: Duration,
    leave_at: Option<Duration>,
    /// Past durations, if the time is limited.
    timings: Option<Timings>,
    /// True if a node was not started because it would not have finished in time.
    untimely: bool,
    left: bool,
    /// The time since which this process has nothing to do.
    idle: Option<Duration>,
    /// The nodes of each scene and variant that is not finished.
    scenes: BTreeMap<(String, String), Vec<usize>>,
    sender: mpsc::Sender<(usize, Ended, Ingredients)>,
    receiver: mpsc::Receiver<(usize, Ended, Ingredients)>,
}

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
            result: if *wanted { Became::NotRun } else { Became::Unwanted },
            seconds: 0.0,
            shared: node.same_as.is_some(),
            parameters: node.parameters.clone(),
            preset: node.preset.clone(),
            seed: node.seed,
            artifact: None,
        });
        let (sender, receiver) = mpsc::channel();
        let mut lease = RunLease::new(&builder.cache);
        let mut scenes: BTreeMap<(String, String), Vec<usize>> = BTreeMap::new();
        for (i, node) in graph.nodes.iter().enumerate().filter(|(i, _)| wanted[*i]) {
            // A node's last artifact is likely the one it needs now, also while its inputs are being made.
            lease.extend(builder.cache.record(&graph.name, node).last.map(|last| last.key));
            if !node.scene.is_empty() {
                scenes.entry((node.scene.clone(), node.variant.clone())).or_default().push(i);
            }
        }
        lease.show();
        let start = builder.cache.node().clock.now();
        let leave_at = options.limit.map(|limit| start + limit - LEAVING.min(limit / 10));
        Self {
            order: (0..graph.nodes.len()).collect(),
            spread: false,
            held: HashMap::new(),
            missing: HashMap::new(),
            start,
            leave_at,
            timings: options.limit.map(|_| builder.cache.timings()),
            untimely: false,
            left: false,
            idle: None,
            builder,
            graph,
            options,
            listener,
            phase: wanted.iter().map(|w| if *w { Phase::Pending } else { Phase::Over }).collect(),
            outcomes: wanted
                .iter()
                .map(|w| if *w { Outcome::Open } else { Outcome::Unavailable("nobody".to_string()) })
                .collect(),
            nodes: nodes.collect(),
            running: HashMap::new(),
            memory: vec![None; graph.nodes.len()],
            damaged: HashMap::new(),
            halted: false,
            lease,
            scenes,
            sender,
            receiver,
        }
    }

    fn drive(&mut self, starter: &dyn Starter<'r>) {
        loop {
            self.watch_time();
            let mut moved = true;
            while moved && !self.stopped() {
                moved = false;
                for at in 0..self.order.len() {
                    let i = self.order[at];
                    if self.phase[i] == Phase::Pending && !self.stopped() && !self.is_held(i) {
                        moved |= self.advance(i, starter);
                    }
                }
            }
            self.lease.show();
            self.tell_scenes();
            if self.running.is_empty() && (self.stopped() || !self.waits_for_others()) {
                self.left |= self.untimely;
                return;
            }
            self.wait();
        }
    }

    /// Reports every scene whose last node has finished.
    fn tell_scenes(&mut self) {
        let (phase, nodes, listener) = (&self.phase, &self.nodes, self.listener);
        self.scenes.retain(|(scene, variant), own| {
            let over = own.iter().all(|i| phase[*i] == Phase::Over);
            if over {
                listener.event(&Event::SceneOver { scene, variant, nodes });
            }
            !over
        });
    }

    fn stopped(&self) -> bool {
        self.halted || self.options.stop.load(Ordering::Relaxed)
    }

    /// Decides about a pending node, if that is possible now.
    fn advance(&mut self, i: usize, starter: &dyn Starter<'r>) -> bool {
        if let Some(first) = self.graph.nodes[i].same_as {
            if self.phase[first] != Phase::Over {
                return false;
            }
            self.outcomes[i] = self.outcomes[first].clone();
            self.nodes[i].result = match &self.nodes[first].result {
                Became::Done => Became::Cached,
                other => other.clone(),
            };
            self.nodes[i].artifact = self.nodes[first].artifact.clone();
            if let (Outcome::Ready(artifact), Became::Cached) = (&self.outcomes[i], &self.nodes[i].result) {
                let (ingredients, content) =
                    (artifact.manifest.ingredients.clone(), artifact.manifest.content);
                self.record_made(i, ingredients, content);
            }
            self.phase[i] = Phase::Over;
            return true;
        }
        let builder = self.builder;
        let resolved = resolve::resolve(
            &builder.registry,
            &builder.cache,
            &builder.numeric_class,
            self.graph,
            i,
            &self.outcomes,
        );
        let resolved = match resolved {
            Ok(resolved) => resolved,
            Err(Unresolved::Waiting(_)) => return false,
            Err(Unresolved::Blocked(by)) => {
                self.nodes[i].result = Became::Blocked(by.clone());
                self.outcomes[i] = Outcome::Unavailable(by);
                self.phase[i] = Phase::Over;
                return true;
            }
            Err(Unresolved::Input(reason)) => {
                self.fail(i, None, reason);
                return true;
            }
        };
        self.lease.extend([resolved.key]);
        if !self.has_room() && self.missing.get(&i) == Some(&resolved.key) {
            return false;
        }
        match self.look_up(i, &resolved.key) {
            Ok(Lookup::Whole(artifact)) => {
                builder.cache.touch(&artifact.path);
                self.listener.event(&Event::Done {
                    node: i,
                    label: &self.nodes[i].label,
                    cached: true,
                    seconds: 0.0,
                });
                self.ready(i, artifact, Became::Cached, 0.0, resolved.ingredients);
                return true;
            }
            Ok(Lookup::Missing) => {}
            Ok(Lookup::Damaged(reason)) => {
                let aside = builder.cache.set_aside(self.graph.nodes[i].stage_name, &resolved.key);
                let place = aside.map_or_else(|e| e.to_string(), |p| format!("moved to {}", p.display()));
                let text = format!("its artifact is damaged: {reason}; {place}, computing it again");
                self.listener.event(&Event::Warning { label: &self.nodes[i].label, text: &text });
            }
            Err(error) => {
                self.fail(i, Some(resolved.key), error.to_string());
                return true;
            }
        }
        if builder.registry.stages()[self.graph.nodes[i].stage].scope == Scope::Shared {
            match self.need(i) {
                Need::Unasked | Need::Live => {}
                Need::Unknown => return false,
                Need::Nobody(by) => {
                    self.nodes[i].result = Became::Blocked(by.clone());
                    self.outcomes[i] = Outcome::Unavailable(by);
                    self.phase[i] = Phase::Over;
                    return true;
                }
            }
        }
        self.start(i, resolved, starter)
    }

    /// Looks up a node's key. An unexpected result is checked a second time: on a network file system,
    /// another machine's artifact may appear late.
    fn look_up(&mut self, i: usize, key: &Key) -> Result<Lookup, FileError> {
        let (cache, node) = (&self.builder.cache, &self.graph.nodes[i]);
        let found = cache.lookup(node.stage_name, key)?;
        let suspect = match found {
            Lookup::Whole(_) => return Ok(found),
            Lookup::Damaged(_) => true,
            Lookup::Missing if self.missing.insert(i, *key) == Some(*key) => false,
            Lookup::Missing => cache.record(&self.graph.name, node).last.is_some_and(|last| last.key == *key),
        };
        if suspect { cache.lookup_again(node.stage_name, key) } else { Ok(found) }
    }

    /// Starts a node if there is room for it and this process does not compute the same key already.
    fn start(&mut self, i: usize, resolved: resolve::Resolved, starter: &dyn Starter<'r>) -> bool {
        let stage = &self.builder.registry.stages()[self.graph.nodes[i].stage];
        let jobs = self.options.jobs.max(1);
        let used_memory: u64 = self.running.values().map(|r| r.memory).sum();
        let used_cores: usize = self.running.values().map(|r| r.cores).sum();
        let memory = *self.memory[i]
            .get_or_insert_with(|| stage.memory_on(&self.graph.nodes[i].parameters, &resolved.inputs));
        let fits = used_memory.saturating_add(memory) <= self.options.memory;
        if self.comes_too_late(i) {
            self.untimely = true;
            return false;
        }
        let twin = self.running.values().any(|r| r.key == resolved.key);
        if twin || self.running.len() >= jobs || (!fits && !self.running.is_empty()) {
            return false;
        }
        if !fits {
            let text = format!(
                "needs about {} of memory, {} are free: running it alone",
                machine::bytes(memory),
                machine::bytes(self.options.memory)
            );
            self.listener.event(&Event::Warning { label: &self.nodes[i].label, text: &text });
        }
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
            resolved,
            threads,
            stop: self.options.stop.clone(),
            listener: self.listener.clone(),
        };
        let sender = self.sender.clone();
        starter.start(Task {
            pipeline: &self.graph.name,
            label: self.nodes[i].label.clone(),
            stage: self.graph.nodes[i].stage_name,
            key: job.resolved.key,
            threads,
            memory,
            work: Box::new(move || {
                let ingredients = job.resolved.ingredients.clone();
                let ended = job.execute();
                // The receiver outlives the executor's service.
                let _ = sender.send((i, ended, ingredients));
            }),
        });
        true
    }

    fn finish(&mut self, i: usize, ended: Ended, ingredients: Ingredients) {
        let key = self.running.remove(&i).map(|r| r.key);
        if !matches!(ended, Ended::Held(_)) {
            self.held.remove(&i);
            self.idle = None;
        }
        match ended {
            Ended::Ready { artifact, computed, seconds } => {
                self.warn_if_changed(i, &artifact);
                let label = &self.nodes[i].label;
                self.listener.event(&Event::Done { node: i, label, cached: !computed, seconds });
                let result = if computed { Became::Done } else { Became::Cached };
                self.ready(i, artifact, result, seconds, ingredients);
            }
            Ended::Failed(reason) => self.fail(i, key, reason),
            Ended::Cancelled => {
                self.phase[i] = Phase::Over;
                self.outcomes[i] = Outcome::Unavailable("the interruption".to_string());
            }
            Ended::Held(holder) => self.put_back(i, holder),
            Ended::DamagedInput(parent) => {
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
                    self.fail(i, key, reason);
                    return;
                }
                for node in [i, parent, maker] {
                    if self.phase[node] == Phase::Over || node == i {
                        self.phase[node] = Phase::Pending;
                        self.outcomes[node] = Outcome::Open;
                    }
                }
            }
        }
    }

    fn ready(
        &mut self,
        i: usize,
        artifact: Box<Artifact>,
        result: Became,
        seconds: f64,
        ingredients: Ingredients,
    ) {
        self.held.remove(&i);
        self.record_made(i, ingredients, artifact.manifest.content);
        self.nodes[i].artifact = Some(artifact.as_ref().clone());
        self.nodes[i].result = result;
        self.nodes[i].seconds += seconds;
        self.outcomes[i] = Outcome::Ready(artifact);
        self.phase[i] = Phase::Over;
    }
}
