//! The errors of the command, with their messages and exit codes.
//!
//! The exit codes: 0 done; 1 a stage failed; 2 wrong usage or bad input; 75 time limit reached, the same
//! command continues; 130 interrupted.

use std::fmt::Display;
use std::process::ExitCode;

use use3d_capture::name::shown_lines;

/// A failure on its way to the terminal.
#[derive(Debug)]
pub(crate) enum CliError {
    /// Wrong usage or bad input: the message names file, field, expectation and next step.
    Input(String),
    /// A stage failed.
    Failed(String),
    /// Interrupted; the work so far is kept.
    Interrupted,
    /// Ended at the time limit; the same command continues.
    OutOfTime,
    /// Interrupted in work that keeps no partial result.
    Stopped,
}

/// The return type of every verb.
pub(crate) type Done = Result<(), CliError>;

/// The refusal of a program without engines for graphics cards.
#[cfg(not(feature = "gpu"))]
pub(crate) const NO_GPU: &str =
    "this program was built without engines for graphics cards (cargo feature `gpu`)";

impl CliError {
    /// Bad input, from any error with a message.
    pub(crate) fn input(error: impl Display) -> Self {
        Self::Input(error.to_string())
    }

    /// A failure of the program's own work, from any error with a message.
    pub(crate) fn failed(error: impl Display) -> Self {
        Self::Failed(error.to_string())
    }

    /// The message.
    pub(crate) fn text(&self) -> &str {
        match self {
            Self::Input(message) | Self::Failed(message) => message,
            Self::Interrupted => {
                "interrupted; the work done so far is kept: run the same command to continue"
            }
            Self::OutOfTime => {
                "time limit reached; the work done so far is kept: run the same command to continue"
            }
            Self::Stopped => "interrupted; nothing was kept: the same command starts from the beginning",
        }
    }

    /// The exit code.
    pub(crate) fn code(&self) -> u8 {
        match self {
            Self::Input(_) => 2,
            Self::Failed(_) => 1,
            // A temporary failure by BSD's sysexits.h.
            Self::OutOfTime => 75,
            Self::Interrupted | Self::Stopped => 130,
        }
    }

    /// Prints the message to stderr and returns the exit code.
    pub(crate) fn report(&self) -> ExitCode {
        let mark = if matches!(self, Self::Input(_) | Self::Failed(_)) { "error: " } else { "" };
        eprintln!("{mark}{}", shown_lines(self.text()));
        ExitCode::from(self.code())
    }
}
