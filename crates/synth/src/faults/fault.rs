//! A fault by its name and strength.

use std::fmt::{self, Write};
use std::path::Path;
use std::str::FromStr;

use super::folder::Spoiler;
use super::table::FAULTS;
use crate::error::SynthError;

/// The finding that a check owes a fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Due {
    /// The capture is refused with a message that names the cause.
    Refused,
    /// A serious finding.
    Serious,
    /// A minor finding.
    Minor,
    /// The scene does not suffer, and a note says what was done with it.
    Note,
    /// It is used as it was meant, and nothing needs to be said.
    Right,
}

impl Due {
    /// One word for tables.
    pub fn word(self) -> &'static str {
        match self {
            Self::Refused => "refused",
            Self::Serious => "serious",
            Self::Minor => "minor",
            Self::Note => "note",
            Self::Right => "right",
        }
    }
}

/// The strengths of a fault.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Strengths {
    /// The unit, in words.
    pub unit: &'static str,
    /// Weak, middle and strong.
    pub values: [f64; 3],
}

/// The names of the three strengths.
const LEVELS: [&str; 3] = ["weak", "middle", "strong"];

/// A kind of fault.
#[derive(Debug)]
pub struct CaptureFault {
    /// Its name.
    pub name: &'static str,
    /// The kind of file that carries it: model, lens, photographs, files, names, masks, depth, positions or
    /// transforms.
    pub carrier: &'static str,
    /// One sentence on what is wrong.
    pub wrong: &'static str,
    /// Its strengths, if it has any.
    pub strengths: Option<Strengths>,
    /// The finding that it is owed, at its middle strength.
    pub due: Due,
    /// Changes a sound folder.
    pub(super) spoil: fn(&Spoiler<'_>) -> Result<(), SynthError>,
}

impl CaptureFault {
    /// The fault of a name.
    pub fn named(name: &str) -> Option<&'static Self> {
        FAULTS.iter().find(|fault| fault.name == name)
    }

    /// The fault at one of its strengths, counted from the weakest; without strengths, the fault itself.
    pub fn at(&'static self, level: usize) -> ChosenFault {
        let strength = self.strengths.map_or(1.0, |s| s.values[level.min(2)]);
        ChosenFault { fault: self, strength }
    }
}

/// A fault with its strength.
#[derive(Clone, Copy, Debug)]
pub struct ChosenFault {
    /// The fault.
    pub fault: &'static CaptureFault,
    /// Its strength, in the fault's unit; 1 for a fault without any.
    pub strength: f64,
}

impl ChosenFault {
    /// Puts the fault into a folder of [`crate::write_capture`] that was made with this seed. A fault that
    /// fails leaves a part of its changes.
    ///
    /// # Errors
    /// A file that cannot be read or written.
    pub fn spoil(&self, dir: &Path, seed: u64) -> Result<(), SynthError> {
        let spoiler = Spoiler { dir, seed, name: self.fault.name, strength: self.strength };
        (self.fault.spoil)(&spoiler)
    }
}

/// A text that names no fault, or a strength that the fault does not have.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UnknownFault(String);

impl fmt::Display for UnknownFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for UnknownFault {}

/// All faults, one a line.
fn list() -> String {
    let mut out = String::from("expected NAME or NAME:STRENGTH, with one of these names:");
    for fault in FAULTS {
        let _ = write!(out, "\n  {:24} {}", fault.name, fault.wrong);
        if let Some(Strengths { unit, values: [weak, middle, strong] }) = fault.strengths {
            let _ = write!(out, " [weak {weak}, middle {middle}, strong {strong}: {unit}]");
        }
    }
    out
}

impl FromStr for ChosenFault {
    type Err = UnknownFault;

    /// Reads `NAME` or `NAME:STRENGTH`; the strength is `weak`, `middle`, `strong` or a number.
    fn from_str(text: &str) -> Result<Self, UnknownFault> {
        let (name, strength) = text.split_once(':').map_or((text, None), |(a, b)| (a, Some(b)));
        let fault = CaptureFault::named(name).ok_or_else(|| UnknownFault(list()))?;
        let Some(strength) = strength else { return Ok(fault.at(1)) };
        let Some(Strengths { unit, values }) = fault.strengths else {
            return Err(UnknownFault(format!("`{name}` has no strength; leave out `:{strength}`")));
        };
        if let Some(level) = LEVELS.iter().position(|level| *level == strength) {
            return Ok(fault.at(level));
        }
        let largest = values.into_iter().fold(0.0, f64::max);
        let (low, high) = (0.01 * largest, 2.0 * largest);
        match strength.parse() {
            Ok(strength) if (low..=high).contains(&strength) => Ok(Self { fault, strength }),
            _ => Err(UnknownFault(format!(
                "the strength of `{name}` is weak, middle, strong, or a number from {low} to {high} ({unit})"
            ))),
        }
    }
}
