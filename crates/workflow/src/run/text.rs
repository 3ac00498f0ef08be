//! Plans, summaries and tables as plain text for the command line.
//!
//! Names and paths come from outside: terminal control characters in them are escaped.

use std::fmt::{self, Display, Formatter, Write};

use use3d_capture::name::{shown, shown_lines};

use crate::cache::joined;
use crate::cache::key::Difference;
use crate::cache::machine::{bytes, seconds};
use crate::plan::planning::{Plan, PlannedNode, State};
use crate::plan::status::{BatchProgress, Cell, Counts, Row, Standing, Status, Why};
use crate::run::gc::{Cleaning, Removed};
use crate::run::summary::{NodeResult, Summary};
use crate::run::verify::Verification;
use crate::share::killed::Killed;
use crate::share::lease::Working;
use crate::stage::expected::Expected;

/// Most items that a line names.
const SHOWN: usize = 3;

/// A writer that escapes the control characters of a terminal. The plan of a large batch has many megabytes
/// of text, so nothing is collected.
struct Printable<'a, 'f>(&'a mut Formatter<'f>);

impl Write for Printable<'_, '_> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        self.0.write_str(&shown_lines(text))
    }
}

/// Prints the text that `fill` writes, with terminal control characters escaped.
fn printable(f: &mut Formatter<'_>, fill: impl FnOnce(&mut Printable<'_, '_>) -> fmt::Result) -> fmt::Result {
    fill(&mut Printable(f))
}

/// Prints the counts that are not 0.
fn count(f: &mut impl Write, counts: &[(usize, &str)]) -> fmt::Result {
    let mut counts = counts.iter().filter(|(count, _)| *count > 0);
    counts.try_for_each(|(count, words)| write!(f, ", {count} {words}"))
}

impl Display for Plan {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        printable(f, |f| {
            for node in self.own().filter(|n| !matches!(n.state, State::Cached | State::Unwanted)) {
                let (mark, text) = describe(node);
                write!(f, "{mark:<8} {}: {text}", label(node))?;
                if let Some(forecast) = &node.forecast {
                    write!(f, " (about {})", seconds(forecast.seconds))?;
                }
                if let Some(expected) = &node.expected {
                    write!(f, " (likely {expected})")?;
                }
                writeln!(f)?;
            }
            self.count_all(f)?;
            writeln!(f)
        })
    }
}

impl Plan {
    /// One line: the stages to run, the others, and the forecast of the time.
    pub fn totals(&self) -> String {
        let mut line = String::new();
        // Writing to a text does not fail.
        let _ = self.count_all(&mut line);
        line
    }

    /// One line, with the reason, for each stage that lacks an input of the pipeline.
    pub fn lacking(&self) -> impl Iterator<Item = String> {
        self.own().filter_map(|node| match &node.state {
            State::Unavailable(reason) => Some(format!("{} {}: {reason}", node.scene, node.stage)),
            _ => None,
        })
    }

    fn count_all(&self, f: &mut impl Write) -> fmt::Result {
        let shared = self.nodes.len() - self.own().count();
        write!(f, "{}: {} to run, {} kept from before", self.pipeline, self.to_run(), self.cached())?;
        count(f, &[(shared, "shared between variants")])?;
        count(f, &[(self.unavailable(), "cannot run"), (self.blocked(), "not run because of these")])?;
        let (sum, without) = self.forecast();
        if self.to_run() > without {
            write!(f, "; about {}", seconds(sum))?;
            let guessed = self.own().filter_map(|n| n.forecast.as_ref()).any(|forecast| !forecast.own);
            if guessed {
                write!(f, ", estimated from other scenes of any size")?;
            }
            if without > 0 {
                write!(f, " plus {without} that never ran before")?;
            }
        }
        match self.expected() {
            Some(expected) => write!(f, "; about {expected}, a guess from the sizes of the pictures"),
            None => Ok(()),
        }
    }

    /// One line, with the reason, for each stage that has results and runs again all the same.
    pub fn reruns(&self) -> Vec<String> {
        let again = self.own().filter(|node| node.had && matches!(node.state, State::Run(_)));
        again.map(|node| format!("{}: runs again: {}", label(node), describe(node).1)).collect()
    }
}

fn label(node: &PlannedNode) -> String {
    joined(&[&node.scene, &node.variant, node.stage], " · ")
}

/// The first items, and the number of the others.
fn few(all: &[impl Display], between: &str) -> String {
    let mut named: Vec<String> = all.iter().take(SHOWN).map(ToString::to_string).collect();
    if all.len() > SHOWN {
        named.push(format!("and {} more", all.len() - SHOWN));
    }
    named.join(between)
}

/// The changes for a reader who knows no digests; `why` has these.
fn changes(all: &[Difference]) -> String {
    let (mut said, mut inputs, mut program) = (Vec::new(), Vec::new(), false);
    for change in all {
        match change.ingredient.split_once(' ') {
            Some(("input", name)) => inputs.push(name),
            Some(("code" | "third-party" | "artifact", _)) => program = true,
            Some(("parameter", name)) => {
                let [old, new] = [&change.old, &change.new].map(|v| v.as_deref().unwrap_or("not set"));
                said.push(format!("the setting {name} was {old} and is {new} now"));
            }
            _ => said.push(change.to_string()),
        }
    }
    if !inputs.is_empty() {
        said.push(format!("the results that it starts from are new: {}", few(&inputs, ", ")));
    }
    if program {
        said.push("the program is another version".into());
    }
    few(&said, "; ")
}

fn describe(node: &PlannedNode) -> (&'static str, String) {
    match &node.state {
        State::Cached => ("cached", String::new()),
        State::Unwanted => ("off", String::new()),
        State::Run(reason) if node.changes.is_empty() => ("run", reason.clone()),
        State::Run(_) => ("run", changes(&node.changes)),
        State::Waiting(parents) => {
            let parents = few(parents, ", ");
            // An earlier artifact stays valid unless something upstream changes.
            let again = if node.had { "; runs again only if that result changes" } else { "" };
            ("waits", format!("for {parents}{again}"))
        }
        State::Unavailable(reason) => ("cannot", reason.clone()),
        State::Blocked(by) => ("blocked", format!("by {by}")),
    }
}

impl Display for Expected {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        write!(f, "{} on two processors, {} of disk", seconds(self.seconds), bytes(self.bytes as u64))
    }
}

impl Display for Summary {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        printable(f, |f| {
            for node in self.failed() {
                if let NodeResult::Failed { reason, log, .. } = &node.result {
                    writeln!(f, "failed   {}: {reason}\n         log: {}", node.label, log.display())?;
                }
            }
            let blocked = self.count(|r| matches!(r, NodeResult::Blocked(_)));
            let not_run = self.count(|r| *r == NodeResult::NotRun);
            let stages = if self.done() == 1 { "stage" } else { "stages" };
            write!(
                f,
                "{}: {} {stages} done, {} kept from before",
                self.pipeline,
                self.done(),
                self.cached()
            )?;
            let (failed, missing) = (self.failed().count(), self.missing().count());
            count(f, &[(failed, "failed"), (blocked, "not run because of these"), (not_run, "not run")])?;
            count(f, &[(missing, "missing"), (self.elsewhere(), "left to other processes")])?;
            write!(f, ", in {}", seconds(self.seconds))?;
            if self.left && not_run > 0 {
                write!(f, "; time limit reached: run the same command to continue")?;
            } else if self.interrupted && !self.left {
                write!(f, "; interrupted: run the same command to continue")?;
            }
            writeln!(f)
        })
    }
}

impl Display for Status {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        printable(f, |f| {
            let counts = self.counts();
            let stages: Vec<&str> = counts.stages.iter().map(|(stage, _)| *stage).collect();
            let name = |Row { scene, variant, .. }: &Row| {
                joined(&[if scene.is_empty() { "(all scenes)" } else { scene }, variant], " · ")
            };
            let names: Vec<String> = self.rows.iter().map(name).collect();
            let wide = names.iter().map(|n| n.chars().count()).max().unwrap_or(0).max(5);
            write!(f, "{:<wide$}", "scene")?;
            for stage in &stages {
                write!(f, "  {stage:<w$}", w = stage.len().max(7))?;
            }
            writeln!(f)?;
            for (row, name) in self.rows.iter().zip(&names) {
                let mut line = format!("{name:<wide$}");
                for stage in &stages {
                    let word = row.cells.iter().find(|c| c.stage == *stage).map_or("", Cell::word);
                    line.push_str(&format!("  {word:<w$}", w = stage.len().max(7)));
                }
                writeln!(f, "{}", line.trim_end())?;
            }
            for (row, name) in self.rows.iter().zip(&names) {
                for cell in &row.cells {
                    if let Some(working) = &cell.working {
                        writeln!(f, "{name} · {}: {working}", cell.stage)?;
                    } else if cell.standing == Standing::Failed {
                        writeln!(f, "{name} · {}: {}", cell.stage, cell.reason)?;
                    }
                }
            }
            writeln!(f, "{}: {}", self.pipeline, self.batch)
        })
    }
}

impl Display for BatchProgress {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Self { stages, cached, running, seconds_left } = self;
        write!(f, "{cached} of {stages} stages are there, {} %", self.percent())?;
        match (stages == cached, seconds_left, running) {
            (true, ..) => Ok(()),
            (_, None, _) => write!(f, "; no earlier run to forecast the time from"),
            (_, Some(left), 0) => write!(f, "; about {} of work, and no stage is running", seconds(*left)),
            (_, Some(left), 1) => write!(f, "; about {} left with one stage running", seconds(*left)),
            (_, Some(left), n) => write!(f, "; about {} left with {n} stages running", seconds(*left)),
        }
    }
}

impl Display for Counts {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        const WORDS: [&str; 5] = ["cached", "running", "missing", "stale", "failed"];
        write!(f, "{:<12}", "stage")?;
        WORDS.iter().try_for_each(|word| write!(f, " {word:>8}"))?;
        writeln!(f)?;
        for (stage, counts) in &self.stages {
            write!(f, "{stage:<12}")?;
            for word in WORDS {
                let count = counts.get(word).map_or_else(|| "-".to_string(), usize::to_string);
                write!(f, " {count:>8}")?;
            }
            writeln!(f)?;
        }
        writeln!(f, "{}: {}", shown(&self.pipeline), self.batch)
    }
}

impl Display for Killed {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let task = self.task.as_ref().map_or_else(String::new, |task| format!(", {task}"));
        write!(f, "killed: process {} on {}{task} ended without a word", self.process, shown(&self.host))?;
        write!(f, " after {}", seconds(self.seconds as f64))?;
        if self.peak_memory > 0 {
            write!(f, " with {} of memory", bytes(self.peak_memory))?;
        }
        match self.times {
            0 | 1 => Ok(()),
            times => write!(f, ", {times} times so far"),
        }
    }
}

impl Display for Working {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Self { host, process, done, total, unit, .. } = self;
        write!(f, "on {} (process {process}", shown(host))?;
        let task = self.task.as_ref().map(|task| format!(", {task}")).unwrap_or_default();
        write!(f, "{task})")?;
        if *total > 0 {
            write!(f, ", {done} of {total} {}", shown(unit))?;
        }
        let (running, silent) = (seconds(self.seconds as f64), seconds(self.silent as f64));
        write!(f, ", running for {running}, last update {silent} ago")
    }
}

impl Display for Why {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        printable(f, |f| {
            write!(f, "{}: {}", self.label, self.standing.word())?;
            if !self.reason.is_empty() {
                write!(f, " ({})", self.reason)?;
            }
            writeln!(f)?;
            match (&self.earlier_at, self.changes.is_empty()) {
                (Some(at), false) => writeln!(f, "since the record of {at} UTC:")?,
                (Some(at), true) if self.upstream.is_empty() => {
                    writeln!(f, "no ingredient changed since {at} UTC")?;
                }
                (None, _) if self.standing != Standing::Cached => {
                    writeln!(f, "there is no earlier record to compare with")?;
                }
                _ => {}
            }
            self.changes.iter().try_for_each(|change| writeln!(f, "  {change}"))?;
            for (label, changes) in &self.upstream {
                writeln!(f, "upstream {label} has to run:")?;
                changes.iter().try_for_each(|change| writeln!(f, "  {change}"))?;
                if changes.is_empty() {
                    writeln!(f, "  never computed, or its artifact was removed")?;
                }
            }
            Ok(())
        })
    }
}

impl Display for Cleaning {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        printable(f, |f| {
            let verb = if self.dry_run { "would remove" } else { "removed" };
            for item in &self.removed {
                let (size, Removed { kind, name, reason, .. }) = (bytes(item.bytes), item);
                writeln!(f, "{verb} {size:>9}  {kind}: {name} ({reason})")?;
            }
            for (name, reason) in &self.failed {
                writeln!(f, "cannot remove {name}: {reason}")?;
            }
            let (count, freed) = (self.removed.len(), bytes(self.removed.iter().map(|r| r.bytes).sum()));
            let state = if self.dry_run { "would be left" } else { "left" };
            writeln!(f, "{verb} {freed} in {count} items; {} {state}", bytes(self.left))
        })
    }
}

impl Display for Verification {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        printable(f, |f| {
            for problem in &self.problems {
                writeln!(f, "{}: {}", problem.name, problem.what)?;
            }
            write!(f, "{} artifacts, {} read and compared", self.artifacts, bytes(self.bytes))?;
            if let Some(held) = self.held {
                write!(f, "; of {} stages of this pipeline {} are in the cache", held.stages, held.cached)?;
            }
            if let Some(recomputed) = self.recomputed {
                write!(f, ", {recomputed} computed again")?;
            }
            if self.agreed > 0 {
                write!(f, " ({} in another numeric class: within their stage's tolerances)", self.agreed)?;
            }
            if self.varied > 0 {
                write!(
                    f,
                    " ({} with other bytes on every run: within their stage's tolerances)",
                    self.varied
                )?;
            }
            if self.not_compared > 0 {
                write!(f, " ({} could not be compared: see above)", self.not_compared)?;
            }
            let aside =
                if self.repaired > 0 { format!(", {} moved aside", self.repaired) } else { String::new() };
            if self.interrupted {
                write!(f, ", interrupted before the rest")?;
            }
            match self.problems.len() {
                0 => writeln!(f, ": all as written"),
                n => writeln!(f, ": {n} problem(s){aside}"),
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn changes_are_told_without_digests() {
        let change = |ingredient: &str, old: &str, new: &str| Difference {
            ingredient: ingredient.into(),
            old: Some(old.into()),
            new: Some(new.into()),
        };
        let all = [
            change("code use3d-splat", "52c8a7d7ae5e", "a22fdf8b302a"),
            change("parameter iterations", "200", "3000"),
            change("input scene", "52c8a7d7ae5e", "a22fdf8b302a"),
            change("input import", "a", "b"),
        ];
        let said = changes(&all);
        let wanted = "the setting iterations was 200 and is 3000 now; the results that it starts from are new: \
                      scene, import; the program is another version";
        assert_eq!(said, wanted);
    }
}
