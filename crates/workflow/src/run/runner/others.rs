//! The time limit of a run, and the work of other processes: the time to end the run, the nodes that others
//! compute and the next request for them, and the waiting time when there is nothing else to do.

use std::sync::atomic::Ordering;
use std::time::Duration;

use super::{Phase, Runner};
use crate::cache::key::Key;
use crate::error::StageError;
use crate::plan::resolve::{Outcome, Resolved};
use crate::run::summary::NodeResult;
use crate::share::lease::{self, HEARTBEAT};
use crate::stage::events::Event;
use use3d_code::digest::Digest;

/// The last part of a run's limit is for writing checkpoints: a tenth, at most this long.
pub(super) const LEAVING: Duration = Duration::from_secs(120);
/// The time between two checks of the stop flag while a run waits for others.
const SLICE: Duration = Duration::from_millis(50);

/// A node that another process computes.
pub(super) struct Held {
    holder: String,
    times: u32,
    /// Time of the next request.
    again: Duration,
    /// The resolved node that waits.
    resolved: Option<Box<Resolved>>,
}

impl Runner<'_> {
    pub(super) fn now(&self) -> Duration {
        self.builder.cache.node.clock.now()
    }

    /// Ends the run when its time limit is reached.
    pub(super) fn watch_time(&mut self) {
        if !self.left && self.leave_at.is_some_and(|at| self.now() >= at) {
            self.left = true;
            let text = "time limit reached: saving checkpoints; run the same command to continue";
            self.listener.event(&Event::Note { label: &self.graph.name, text });
            self.options.stop.store(true, Ordering::Relaxed);
        }
    }

    /// Makes nodes that other processes compute wait for room again, if their next request is due.
    pub(super) fn ask_again(&mut self) {
        let now = self.now();
        let due = self.held.iter_mut().filter(|(_, held)| held.again <= now);
        let due: Vec<(usize, Box<Resolved>)> =
            due.filter_map(|(i, held)| Some((*i, held.resolved.take()?))).collect();
        for (i, resolved) in due {
            if self.phase[i] == Phase::Pending && self.open[i] == 0 {
                self.full = false;
                self.waiting.insert((self.rank[i], i), resolved);
            }
        }
    }

    /// Forgets the resolved inputs of a node that another process held; it is resolved again.
    pub(super) fn forget_resolved(&mut self, i: usize) {
        if let Some(held) = self.held.get_mut(&i) {
            held.resolved = None;
        }
    }

    /// Returns true if the run should wait for other processes, when there is nothing to do here. If not, the
    /// remaining nodes are left to them.
    pub(super) fn waits_for_others(&mut self) -> bool {
        // A node that has finished some other way is no longer held by anyone.
        let phase = &self.phase;
        self.held.retain(|i, _| phase[*i] == Phase::Pending);
        if self.held.is_empty() {
            return false;
        }
        let now = self.now();
        let since = *self.idle.get_or_insert(now);
        if self.options.until_empty.is_none_or(|patience| now.saturating_sub(since) < patience) {
            return true;
        }
        for i in 0..self.phase.len() {
            if self.phase[i] == Phase::Pending {
                let holder = self.held.get(&i).map(|held| held.holder.clone());
                let holder = holder.unwrap_or_else(|| "a process that computes its inputs".to_string());
                self.nodes[i].result = NodeResult::Elsewhere(holder);
            }
        }
        false
    }

    /// Waits until a job ends, the next request for a lease is due, or this run must write its pulse.
    pub(super) fn wait(&mut self) {
        let (clock, now) = (self.builder.cache.node.clock, self.now());
        let waits = self.held.values().filter(|held| held.resolved.is_some());
        let asks = waits.map(|held| held.again).filter(|_| self.has_room());
        let next = asks.chain(self.leave_at.filter(|_| !self.left)).min();
        let until = next.map_or(HEARTBEAT, |at| at.saturating_sub(now).min(HEARTBEAT));
        let mut left = clock.wait_for(until).max(Duration::from_millis(1));
        // If nothing runs, only this loop can notice the stop flag.
        while self.running.is_empty() && left > SLICE && !self.stopped() {
            std::thread::sleep(SLICE);
            left -= SLICE;
        }
        if let Ok((i, ended)) = self.receiver.recv_timeout(left) {
            self.finish(i, ended);
        }
    }

    /// Returns true if another job may be started.
    pub(super) fn has_room(&self) -> bool {
        self.running.len() < self.options.jobs.max(1)
    }

    /// Puts back a node that another process computes: it is requested again later, and meanwhile this run
    /// works on other nodes.
    pub(super) fn put_back(&mut self, i: usize, holder: String, resolved: Box<Resolved>) {
        let (now, node) = (self.now(), &self.builder.cache.node);
        let times = self.held.get(&i).map_or(0, |held| held.times);
        if times == 0 {
            let label = &self.nodes[i].label;
            self.listener.event(&Event::Waiting { node: i, label, holder: &holder });
        }
        let again = now + lease::back_off(times, node.number());
        self.held.insert(i, Held { holder, times: times + 1, again, resolved: Some(resolved) });
        self.phase[i] = Phase::Pending;
        self.spread();
    }

    /// Leaves a node, and what needs it, to the next submission.
    pub(super) fn leave_alone(&mut self, i: usize, reason: &str) {
        let label = self.nodes[i].label.clone();
        self.listener.event(&Event::Note { label: &label, text: &format!("left to {reason}") });
        self.nodes[i].result = NodeResult::Elsewhere(reason.to_string());
        self.outcomes[i] = Outcome::Unavailable(label.clone());
        self.left_alone.insert(label, reason.to_string());
        self.over(i);
    }

    /// Ends a node whose artifact is missing and not to be made. Its last failure stays known.
    pub(super) fn miss(&mut self, i: usize, key: Option<Key>) {
        if self.known[i].failed {
            let record = self.builder.cache.record(&self.graph.name, &self.graph.nodes[i]);
            let failure = record.failed(key);
            self.nodes[i].failure = failure.map(|failure| (failure.reason.clone(), failure.log.clone()));
        }
        self.nodes[i].result = NodeResult::Missing;
        self.outcomes[i] = Outcome::Unavailable(self.nodes[i].label.clone());
        self.over(i);
    }

    /// Ends a node that needs a device which this machine does not have. In a submission, another task has
    /// it.
    pub(super) fn lacks_device(&mut self, i: usize, key: Option<Key>, reason: &str) {
        if self.options.gather {
            self.miss(i, key);
        } else if self.builder.cache.node.submitted().is_some() {
            self.leave_alone(i, reason);
        } else {
            self.fail(i, key, &StageError::bad_input_message(reason));
        }
    }

    /// Tries scenes from now on in an order of this process's own: other processes work on the same batch,
    /// and not all should request the same nodes.
    pub(super) fn spread(&mut self) {
        if std::mem::replace(&mut self.spread, true) {
            return;
        }
        let number = self.builder.cache.node.number();
        let nodes = &self.graph.nodes;
        let place = |i: &usize| {
            let scene = &nodes[*i].scene;
            let place = Digest::of(format!("{number} {scene}").as_bytes());
            if scene.is_empty() { (None, *i) } else { (Some(place), *i) }
        };
        let mut order: Vec<usize> = (0..nodes.len()).collect();
        order.sort_by_cached_key(place);
        order.into_iter().enumerate().for_each(|(rank, i)| self.rank[i] = rank);
        let rank = &self.rank;
        self.due = self.due.iter().map(|(_, i)| (rank[*i], *i)).collect();
        let waiting = std::mem::take(&mut self.waiting).into_iter();
        self.waiting = waiting.map(|((_, i), resolved)| ((rank[i], i), resolved)).collect();
    }

    /// Returns true if the time limit would cut off a stage without checkpoints that could finish in a run
    /// with its whole time left.
    pub(super) fn comes_too_late(&self, i: usize) -> bool {
        let node = &self.graph.nodes[i];
        let stage = &self.builder.registry.stages()[node.stage];
        let (Some(at), Some(timings)) = (self.leave_at, &self.timings) else { return false };
        let forecast = timings.forecast(stage.name, &node.scene, stage.length(&node.parameters));
        let Some(forecast) = forecast.filter(|_| stage.length_like.is_empty()) else { return false };
        let (left, whole) = (at.saturating_sub(self.now()), at.saturating_sub(self.start));
        forecast.seconds > left.as_secs_f64() && forecast.seconds < whole.as_secs_f64()
    }
}
