//! The errors of the command, with their messages and exit codes.
//!
//! The exit codes: 0 done; 1 a stage failed; 2 wrong usage or bad input; 75 time limit reached, the same
//! command continues; 130 interrupted.

use std::process::ExitCode;

use use3d_capture::name::shown_lines;
pub(crate) use use3d_pipeline::WorkError;

/// The return type of every verb.
pub(crate) type Done = Result<(), WorkError>;

/// The refusal of a program without engines for graphics cards.
#[cfg(not(feature = "gpu"))]
pub(crate) const NO_GPU: &str =
    "this program was built without engines for graphics cards (cargo feature `gpu`)";

/// The exit code of an error.
pub(crate) fn exit_code(error: &WorkError) -> u8 {
    match error {
        WorkError::Input(_) => 2,
        WorkError::Failed(_) => 1,
        // A temporary failure by BSD's sysexits.h.
        WorkError::OutOfTime => 75,
        WorkError::Interrupted | WorkError::Stopped => 130,
    }
}

/// Prints the message to stderr and returns the exit code.
pub(crate) fn report(error: &WorkError) -> ExitCode {
    let mark = if matches!(error, WorkError::Input(_) | WorkError::Failed(_)) { "error: " } else { "" };
    eprintln!("{mark}{}", shown_lines(&error.to_string()));
    ExitCode::from(exit_code(error))
}
