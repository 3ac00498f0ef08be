//! What stages tell, on stderr: bars on a terminal, else one plain line about every ten seconds.

use std::collections::BTreeMap;
use std::io::IsTerminal;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use indicatif::{MultiProgress, ProgressBar, ProgressDrawTarget, ProgressStyle};
use use3d_pipeline::engine::{Event, Listener};

/// How often a plain line is printed when stderr is no terminal.
const PLAIN_INTERVAL: Duration = Duration::from_secs(10);

/// Draws events.
pub(crate) struct Terminal {
    quiet: bool,
    bars: Option<MultiProgress>,
    nodes: Mutex<BTreeMap<String, Node>>,
}

struct Node {
    bar: Option<ProgressBar>,
    started: Instant,
    last_line: Instant,
}

impl Terminal {
    /// Bars if stderr is a terminal.
    pub(crate) fn new(quiet: bool) -> Self {
        let bars = (!quiet && std::io::stderr().is_terminal())
            .then(|| MultiProgress::with_draw_target(ProgressDrawTarget::stderr_with_hz(8)));
        Self { quiet, bars, nodes: Mutex::default() }
    }

    /// Prints a line above the bars.
    fn line(&self, text: &str) {
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
        if let Ok(style) =
            ProgressStyle::with_template("{prefix:<24} {bar:24} {pos}/{len} {msg} [{elapsed} < {eta}]")
        {
            bar.set_style(style);
        }
        bar.set_prefix(label.to_string());
        Some(bar)
    }

    fn progress(&self, label: &str, done: u64, total: u64, words: &str) {
        let mut nodes = self.nodes.lock().unwrap_or_else(PoisonError::into_inner);
        let now = Instant::now();
        let node = nodes.entry(label.to_string()).or_insert_with(|| Node {
            bar: self.bar(label),
            started: now,
            last_line: now,
        });
        if let Some(bar) = &node.bar {
            bar.set_length(total);
            bar.set_position(done);
            bar.set_message(words.to_string());
        } else if node.last_line.elapsed() >= PLAIN_INTERVAL {
            node.last_line = now;
            let elapsed = node.started.elapsed().as_secs_f64();
            let left = if done > 0 { elapsed * total.saturating_sub(done) as f64 / done as f64 } else { 0.0 };
            eprintln!("{label}: {done}/{total} {words} [{elapsed:.0} s, about {left:.0} s left]");
        }
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
            Event::Failed { label, reason, log, .. } => {
                self.end(label);
                self.line(&format!("{label}: failed: {reason}\n  log: {}", log.display()));
            }
            // Whoever asked for it listens itself.
            Event::Profile { .. } => {}
            _ if self.quiet => {}
            Event::Started { label, .. } => self.line(&format!("{label}: started")),
            Event::Progress { label, done, total, unit, message, .. } => {
                let words =
                    if message.is_empty() { (*unit).to_string() } else { format!("{unit}, {message}") };
                self.progress(label, *done, *total, &words);
            }
            Event::Waiting { label, holder, .. } => self.line(&format!("{label}: waiting for {holder}")),
            Event::Done { label, cached, seconds, .. } => {
                self.end(label);
                if !cached {
                    self.line(&format!("{label}: done in {seconds:.1} s"));
                }
            }
            Event::Note { label, text } => self.line(&format!("{label}: {text}")),
        }
    }
}
