//! Prints the events of stages on stderr: progress bars on a terminal, else a plain line about every ten
//! seconds.

use std::collections::BTreeMap;
use std::io::IsTerminal;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use indicatif::{MultiProgress, ProgressBar, ProgressDrawTarget, ProgressStyle};
use use3d_capture::name::{shown, shown_lines};
use use3d_workflow::machine::seconds;
use use3d_workflow::{Event, Listener};

/// Time between two plain lines when stderr is not a terminal.
const PLAIN_INTERVAL: Duration = Duration::from_secs(10);

/// The label of the bar of all stages together.
const WHOLE_RUN: &str = "whole run";

/// A remaining time that is longer than the pace so far predicts by this factor gets an explanation.
const SLOWER: f64 = 1.5;

/// Draws events.
pub(crate) struct Terminal {
    quiet: bool,
    /// True if details are shown.
    verbose: bool,
    bars: Option<MultiProgress>,
    nodes: Mutex<BTreeMap<String, NodeProgress>>,
    /// The numbers of stages that are over and of all stages, as words for the next line of a log.
    counted: Mutex<String>,
}

struct NodeProgress {
    bar: Option<ProgressBar>,
    started: Instant,
    /// Work done at the first report: a run may resume from a checkpoint.
    first: u64,
    /// Work done at the last report; a smaller value marks the start of another piece of work.
    last: u64,
    last_line: Instant,
}

impl NodeProgress {
    fn new(bar: Option<ProgressBar>, first: u64, now: Instant) -> Self {
        Self { bar, started: now, first, last: first, last_line: now }
    }

    /// Records the progress of the work; a second fit of the same stage is timed by itself.
    fn reached(&mut self, done: u64, now: Instant) {
        if done < self.last {
            (self.started, self.first) = (now, done);
        }
        self.last = done;
    }

    /// `[12 s, about 3 min 20 s left]`; computed from the pace since the start if the stage gives no
    /// estimate.
    fn times(&self, done: u64, total: u64, known: Option<f64>) -> String {
        let elapsed = self.started.elapsed().as_secs_f64();
        let since = done.saturating_sub(self.first);
        let by_pace = (since > 0).then(|| elapsed * total.saturating_sub(done) as f64 / since as f64);
        let (elapsed, left) = (seconds(elapsed), known.or(by_pace).map(seconds));
        // If the remaining work is heavier, a rate beside the time would contradict it.
        let slower = known.zip(by_pace).is_some_and(|(known, by_pace)| known > SLOWER * by_pace);
        match left {
            Some(left) if slower => format!("[{elapsed}, about {left} left: later steps take longer]"),
            Some(left) => format!("[{elapsed}, about {left} left]"),
            None => format!("[{elapsed}]"),
        }
    }
}

impl Terminal {
    /// Uses progress bars if stderr is a terminal.
    pub(crate) fn new(quiet: bool, verbose: bool) -> Self {
        let bars = (!quiet && std::io::stderr().is_terminal())
            .then(|| MultiProgress::with_draw_target(ProgressDrawTarget::stderr_with_hz(8)));
        Self { quiet, verbose, bars, nodes: Mutex::default(), counted: Mutex::default() }
    }

    /// Prints a line above the bars, with terminal control characters escaped.
    fn line(&self, text: &str) {
        let text: &str = &shown_lines(text);
        match &self.bars {
            Some(bars) => {
                if bars.println(text).is_err() {
                    eprintln!("{text}");
                }
            }
            None => eprintln!("{text}"),
        }
    }

    fn bar(&self, label: &str) -> Option<ProgressBar> {
        let bar = self.bars.as_ref()?.add(ProgressBar::new(0));
        let template = match label == WHOLE_RUN {
            true => "{prefix:<24} {bar:24} {pos} % {msg}",
            false => "{prefix:<24} {bar:24} {pos}/{len} {msg}",
        };
        if let Ok(style) = ProgressStyle::with_template(template) {
            bar.set_style(style);
        }
        bar.set_prefix(label.to_string());
        Some(bar)
    }

    fn progress(&self, label: &str, done: u64, total: u64, words: &str, left: Option<f64>) {
        let words = &shown(words);
        self.draw(label, done, total, |node| {
            let times = node.times(done, total, left);
            let counted = if node.bar.is_some() { String::new() } else { format!("{done}/{total} ") };
            format!("{counted}{words} {times}")
        });
    }

    /// Shows the progress of the whole run. Its clock is that of the run and not of this display.
    fn whole_run(&self, percent: u64, passed: f64, left: f64) {
        let times = format!("[{}, about {} left]", seconds(passed), seconds(left));
        self.draw(WHOLE_RUN, percent, 100, |node| match &node.bar {
            Some(_) => times,
            None => format!("{percent} % {times}"),
        });
    }

    /// Moves a bar, or prints a line if the last one is old enough.
    fn draw(&self, label: &str, done: u64, total: u64, words: impl FnOnce(&NodeProgress) -> String) {
        let mut nodes = self.nodes.lock().unwrap_or_else(PoisonError::into_inner);
        let (now, label) = (Instant::now(), &*shown(label));
        let node =
            nodes.entry(label.to_string()).or_insert_with(|| NodeProgress::new(self.bar(label), done, now));
        node.reached(done, now);
        if let Some(bar) = &node.bar {
            bar.set_length(total);
            bar.set_position(done);
            bar.set_message(words(node));
        } else if node.last_line.elapsed() >= PLAIN_INTERVAL {
            node.last_line = now;
            eprintln!("{label}: {}", words(node));
        }
    }

    /// The count of stages for the end of a line; empty on a terminal, where a bar shows it.
    fn counted(&self) -> String {
        std::mem::take(&mut *self.counted.lock().unwrap_or_else(PoisonError::into_inner))
    }

    fn end(&self, label: &str) {
        let mut nodes = self.nodes.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(bar) = nodes.remove(label).and_then(|n| n.bar) {
            bar.finish_and_clear();
        }
    }
}

impl Listener for Terminal {
    fn event(&self, event: &Event<'_>) {
        match event {
            Event::Warning { label, text } => self.line(&format!("{label}: warning: {text}")),
            // The summary at the end prints the reason, once.
            Event::Failed { label, log, .. } => {
                self.end(label);
                if !self.quiet {
                    let counted = self.counted();
                    self.line(&format!("{label}: failed{counted}; its log: {}", log.display()));
                }
            }
            // Other listeners handle these events.
            Event::Profile { .. }
            | Event::SceneOver { .. }
            | Event::Figures { .. }
            | Event::AsksForView { .. }
            | Event::View { .. } => {}
            _ if self.quiet => {}
            Event::Started { label, about, .. } => self.line(&format!("{label}: {about}")),
            Event::Progress { label, done, total, unit, message, seconds_left, .. } => {
                let words =
                    if message.is_empty() { (*unit).to_string() } else { format!("{unit}, {message}") };
                self.progress(label, *done, *total, &words, *seconds_left);
            }
            Event::Counted { done, total } if self.bars.is_none() => {
                let counted = format!(" ({done} of {total} stages)");
                *self.counted.lock().unwrap_or_else(PoisonError::into_inner) = counted;
            }
            Event::Counted { .. } => {}
            Event::WholeRun { percent: 100, .. } => self.end(WHOLE_RUN),
            Event::WholeRun { percent, seconds, seconds_left } => {
                self.whole_run(*percent, *seconds, *seconds_left);
            }
            Event::Waiting { label, holder, .. } => self.line(&format!(
                "{label}: another run of this program is at this step ({holder}); this one waits, and then takes its result"
            )),
            Event::Done { label, cached, seconds, .. } => {
                self.end(label);
                if !cached {
                    let counted = self.counted();
                    self.line(&format!("{label}: done in {seconds:.1} s{counted}"));
                }
            }
            Event::Detail { .. } if !self.verbose => {}
            Event::Note { label, text } | Event::Detail { label, text } => {
                self.line(&format!("{label}: {text}"));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn node(first: u64, seconds_ago: u64) -> NodeProgress {
        let now = Instant::now();
        let started = now.checked_sub(Duration::from_secs(seconds_ago)).unwrap_or(now);
        NodeProgress { started, ..NodeProgress::new(None, first, now) }
    }

    #[test]
    fn a_second_fit_is_timed_from_its_own_start() {
        let mut node = node(0, 60);
        node.reached(750, Instant::now());
        node.reached(0, Instant::now());
        assert_eq!(node.times(0, 750, None), "[0.0 s]");
    }

    #[test]
    fn a_run_gone_on_from_a_checkpoint_counts_its_own_steps() {
        // 100 steps in 20 s, after 9000 found; 900 to go.
        assert_eq!(node(9000, 20).times(9100, 10_000, None), "[20 s, about 3 min 00 s left]");
        // The pace is unknown at the first report.
        assert_eq!(node(9000, 20).times(9000, 10_000, None), "[20 s]");
    }

    #[test]
    fn what_the_stage_knows_goes_before_the_pace() {
        assert_eq!(node(0, 20).times(100, 200, Some(25.0)), "[20 s, about 25 s left]");
        // 100 steps took 20 s, and the other 100 will take 45 s.
        assert_eq!(
            node(0, 20).times(100, 200, Some(45.0)),
            "[20 s, about 45 s left: later steps take longer]"
        );
    }
}
