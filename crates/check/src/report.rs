//! The report of a check: findings with their remedies, the gravest first.

use std::fmt;

use serde::Serialize;
use use3d_capture::shown;

use crate::measure::Figures;

/// The weight of a finding. Graver ones come first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// The scene will be visibly worse.
    Serious,
    /// Something is lost.
    Minor,
    /// Nothing is lost, but it is worth knowing.
    Note,
    /// Nothing to do.
    Good,
}

impl Severity {
    /// One word for people.
    pub fn word(self) -> &'static str {
        match self {
            Self::Serious => "serious",
            Self::Minor => "minor",
            Self::Note => "note",
            Self::Good => "good",
        }
    }
}

/// A finding.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Finding {
    /// Its weight.
    pub severity: Severity,
    /// Its subject, one word for scripts.
    pub subject: &'static str,
    /// The finding, one or two sentences.
    pub text: String,
    /// The next step; empty if there is none.
    pub remedy: String,
    /// The views that it is about.
    pub views: Vec<String>,
}

/// The report on a capture.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CheckReport {
    /// The capture's name.
    pub capture: String,
    /// The findings, the gravest first.
    pub findings: Vec<Finding>,
    /// The figures behind them.
    pub figures: Figures,
}

/// Subjects that a picture does not suffer from.
const LIGHT: [&str; 3] = ["masks", "unmasked", "split"];

/// The names of views that a line of text holds.
const NAMES: usize = 6;

impl Finding {
    /// The names of its views in one line; empty if there are none.
    pub fn names(&self) -> String {
        let first: Vec<_> = self.views.iter().take(NAMES).map(|n| shown(n)).collect();
        match self.views.len().saturating_sub(NAMES) {
            0 => first.join(", "),
            more => format!("{} and {more} more", first.join(", ")),
        }
    }
}

impl CheckReport {
    /// The findings that need something to be done.
    pub fn faults(&self) -> impl Iterator<Item = &Finding> {
        self.findings.iter().filter(|f| f.severity <= Severity::Minor)
    }

    /// The gravest faults in one line each, at most `most`. Things that a capture may lack without any loss
    /// to its pictures, such as its scale, are left out.
    pub fn gravest(&self, most: usize) -> Vec<String> {
        let heavy = self.faults().filter(|f| !LIGHT.contains(&f.subject));
        let line = |f: &Finding| {
            let named = |what: &str, text: &str| match text {
                "" => String::new(),
                text => format!(" {what}: {text}."),
            };
            let (views, remedy) = (named("Photographs", &f.names()), named("Do this", &f.remedy));
            format!("{}: {}{views}{remedy}", f.severity.word(), f.text)
        };
        heavy.take(most).map(line).collect()
    }

    /// The judgement in one line.
    pub fn summary(&self) -> String {
        let count = |severity| self.findings.iter().filter(|f| f.severity == severity).count();
        let many = |n: usize, what: &str| match n {
            1 => format!("1 {what} problem"),
            n => format!("{n} {what} problems"),
        };
        match (count(Severity::Serious), count(Severity::Minor)) {
            (0, 0) => "nothing stands in the way of a good scene".into(),
            (0, minor) => format!("{}, none of which spoils the scene", many(minor, "minor")),
            (serious, 0) => many(serious, "serious"),
            (serious, minor) => format!("{} and {}", many(serious, "serious"), many(minor, "minor")),
        }
    }
}

impl fmt::Display for CheckReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}: {}", shown(&self.capture), self.summary())?;
        for (i, finding) in self.faults().enumerate() {
            writeln!(f, "\n{:>2}. {}: {}", i + 1, finding.severity.word(), finding.text)?;
            if !finding.views.is_empty() {
                writeln!(f, "    photographs: {}", finding.names())?;
            }
            if !finding.remedy.is_empty() {
                writeln!(f, "    do this: {}", finding.remedy)?;
            }
        }
        for (severity, lead) in [(Severity::Note, "\nnotes:\n"), (Severity::Good, "\ngood:\n")] {
            for (i, finding) in self.findings.iter().filter(|f| f.severity == severity).enumerate() {
                write!(f, "{}  * {}", if i == 0 { lead } else { "" }, finding.text)?;
                match finding.remedy.is_empty() {
                    true => writeln!(f)?,
                    false => writeln!(f, " Do this: {}.", finding.remedy)?,
                }
            }
        }
        Ok(())
    }
}
