//! The time left of a whole run: one bar for all of its stages.
//!
//! With the seconds `r` that a running stage has left and the seconds `p` that a pending stage will take,
//!
//! ```text
//! left = max( longest r or p,  (Σ r + Σ p) / jobs )
//! ```
//!
//! `r` is the estimate of the stage itself, or else its `p` less the time since its start. `p` is the
//! forecast from earlier runs, or else the usual cost that the stage states times the seconds that one unit
//! of cost takes in this run. There is no time left until one stage has given its own.
//!
//! The listener also counts the stages that are over, for logs without a bar.
//!
//! Limits: the usual costs were measured on four captures with the default parameters. A stage that waits for
//! another process counts as pending.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use use3d_workflow::plan::{Plan, State};
use use3d_workflow::{Event, Listener};

/// The least time between two updates of the bar.
const INTERVAL: Duration = Duration::from_millis(500);

/// A silence of a stage that told its time is a pause of the process if it is this long, and this many times
/// longer than the silence before it.
const PAUSE: (Duration, u32) = (Duration::from_secs(20), 10);

#[derive(Clone, Copy, Debug, PartialEq)]
enum Turn {
    Pending,
    /// Its start without pauses, and what it told last.
    Running(Instant, Option<Told>),
    /// The seconds that it took.
    Over(f64),
    /// It needs no time: it is cached, not requested or shared.
    Absent,
}

/// The seconds left that a stage told, the time at which it did, and the time since it did so before.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Told {
    left: f64,
    at: Instant,
    since: Duration,
}

/// A stage of a whole run.
#[derive(Clone, Debug)]
struct Share {
    cost: f64,
    forecast: Option<f64>,
    turn: Turn,
    /// The parts whose results it needs; they come before it.
    needs: Vec<usize>,
}

impl Share {
    /// Seconds that the part takes from start to end, as far as the part itself tells.
    fn whole(&self, now: Instant) -> Option<f64> {
        match self.turn {
            Turn::Running(start, Some(Told { left, at, .. })) => {
                Some((at - start).as_secs_f64() + left.max((now - at).as_secs_f64()))
            }
            Turn::Over(seconds) => Some(seconds),
            _ => self.forecast,
        }
    }
}

/// The turn of a stage that was told to have these seconds left. A pause of the process, as if a notebook was
/// closed, moves the start of the stage.
fn told(start: Instant, before: Option<Told>, left: Option<f64>, now: Instant) -> Turn {
    let Some(left) = left else { return Turn::Running(start, before) };
    let Some(before) = before else {
        return Turn::Running(start, Some(Told { left, at: now, since: now - start }));
    };
    let since = now - before.at;
    let pause = since > PAUSE.0 && since > PAUSE.1 * before.since;
    let start = if pause { start + since } else { start };
    Turn::Running(start, Some(Told { left, at: now, since: if pause { before.since } else { since } }))
}

/// Takes the bar away when the run is over.
struct Bar(Arc<dyn Listener>);

impl Drop for Bar {
    fn drop(&mut self) {
        self.0.event(&Event::WholeRun { percent: 100, seconds: 0.0, seconds_left: 0.0 });
    }
}

/// The stages of a run and their times.
pub struct WholeRun {
    parts: Vec<Share>,
    /// The number of parts that the run has to compute.
    total: usize,
    jobs: usize,
    started: Instant,
    drawn: Option<Instant>,
    /// The largest percentage that was shown.
    shown: u64,
}

impl WholeRun {
    /// The stages that `plan` will run; with `only`, those of these scenes and variants, and of no scene.
    pub fn new(plan: &Plan, only: Option<&[(String, String)]>, jobs: usize) -> Self {
        let only: Option<BTreeSet<(&str, &str)>> =
            only.map(|cells| cells.iter().map(|(scene, variant)| (&**scene, &**variant)).collect());
        let parts = plan.nodes.iter().map(|planned| {
            let runs = matches!(planned.state, State::Run(_) | State::Waiting(_));
            let cell = (&*planned.scene, &*planned.variant);
            let wanted = planned.scene.is_empty() || only.as_ref().is_none_or(|only| only.contains(&cell));
            Share {
                cost: planned.usual_cost,
                forecast: planned.forecast.as_ref().map(|forecast| forecast.seconds),
                needs: planned.needs.clone(),
                turn: match runs && wanted && planned.shared_with.is_none() {
                    true => Turn::Pending,
                    false => Turn::Absent,
                },
            }
        });
        let parts: Vec<Share> = parts.collect();
        let total = parts.iter().filter(|part| part.turn == Turn::Pending).count();
        Self { parts, total, jobs: jobs.max(1), started: Instant::now(), drawn: None, shown: 0 }
    }

    /// A listener that passes all events to `inner` and adds the progress of the whole run. A run of one
    /// stage has no bar of its own.
    pub fn listener(self, inner: Arc<dyn Listener>) -> Arc<dyn Listener> {
        if self.total < 2 {
            return inner;
        }
        let whole = Mutex::new(self);
        let bar = Bar(inner);
        Arc::new(move |event: &Event<'_>| {
            let (inner, now) = (&bar.0, Instant::now());
            let locked = || whole.lock().unwrap_or_else(PoisonError::into_inner);
            let (news, done, total) = {
                let mut whole = locked();
                (whole.note(event, now), whole.done(), whole.total)
            };
            if matches!(event, Event::Done { cached: false, .. } | Event::Failed { .. }) {
                inner.event(&Event::Counted { done, total });
            }
            inner.event(event);
            let mut whole = locked();
            if news
                && whole.drawn.is_none_or(|drawn| now - drawn >= INTERVAL)
                && let Some(left) = whole.left(now)
            {
                whole.drawn = Some(now);
                let passed = (now - whole.started).as_secs_f64();
                // 100 % is for the end.
                let percent = (100.0 * passed / (passed + left).max(1e-9)).min(99.0) as u64;
                whole.shown = whole.shown.max(percent);
                let percent = whole.shown;
                drop(whole);
                inner.event(&Event::WholeRun { percent, seconds: passed, seconds_left: left });
            }
        })
    }

    /// Number of parts that are over, of those that the run has to compute.
    fn done(&self) -> usize {
        let open = self.parts.iter().filter(|part| matches!(part.turn, Turn::Pending | Turn::Running(..)));
        self.total.saturating_sub(open.count())
    }

    /// Takes the news of an event, and returns true if the event tells about time.
    fn note(&mut self, event: &Event<'_>, now: Instant) -> bool {
        let (node, turn) = match event {
            Event::Started { node, .. } => (*node, Turn::Running(now, None)),
            Event::Progress { node, seconds_left, .. } => match self.parts.get(*node).map(|part| part.turn) {
                Some(Turn::Running(start, before)) => (*node, told(start, before, *seconds_left, now)),
                _ => return false,
            },
            Event::Done { node, cached: false, seconds, .. } => (*node, Turn::Over(*seconds)),
            Event::Done { node, .. } => (*node, Turn::Absent),
            Event::Failed { node, .. } => {
                self.give_up(*node);
                return true;
            }
            _ => return false,
        };
        self.parts.get_mut(node).map(|part| part.turn = turn).is_some()
    }

    /// Takes a failed part away, with all parts that need its result.
    fn give_up(&mut self, failed: usize) {
        let mut gone = vec![false; self.parts.len()];
        for (i, part) in self.parts.iter_mut().enumerate().skip(failed) {
            gone[i] = i == failed || part.needs.iter().any(|need| gone.get(*need) == Some(&true));
            if gone[i] {
                part.turn = Turn::Absent;
            }
        }
    }

    /// Seconds left; `None` while no stage has told its time.
    fn left(&self, now: Instant) -> Option<f64> {
        let told = self.parts.iter().filter_map(|part| Some((part.cost, part.whole(now)?)));
        let (cost, seconds) = told.fold((0.0, 0.0), |(c, s), (cost, whole)| (c + cost, s + whole));
        let unit = (cost > 0.0).then(|| seconds / cost)?;
        let own = |part: &Share| part.forecast.unwrap_or(unit * part.cost);
        let left = self.parts.iter().map(|part| match part.turn {
            Turn::Pending => own(part),
            Turn::Running(_, Some(Told { left, at, .. })) => (left - (now - at).as_secs_f64()).max(0.0),
            Turn::Running(start, None) => (own(part) - (now - start).as_secs_f64()).max(0.0),
            Turn::Over(_) | Turn::Absent => 0.0,
        });
        let (sum, longest) = left.fold((0.0, 0.0f64), |(sum, longest), one| (sum + one, longest.max(one)));
        Some(longest.max(sum / self.jobs as f64))
    }
}

#[cfg(test)]
mod tests;
