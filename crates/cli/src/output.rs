//! The output of the command: results on stdout, everything else on stderr.
//!
//! A closed reader (`use3d plan … | head -1`) is no failure: the rest of the output is dropped and the work
//! continues. The standard library's macros would panic there, so this crate's `print!`, `println!` and
//! `eprintln!` are those below. Any other failure to write results (a full disk) is kept for [`failure`],
//! which decides the exit code.

use std::fmt;
use std::io::{self, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

use serde::Serialize;

use crate::error::{Done, WorkError};

/// The first failure to write to stdout; nothing is written after it.
static FAILED: Mutex<Option<io::Error>> = Mutex::new(None);
/// True if anything was written to stdout.
static SAID: AtomicBool = AtomicBool::new(false);

/// Writes to a stream until its first failure.
fn write(stream: &mut impl Write, failed: &mut Option<io::Error>, text: fmt::Arguments<'_>) {
    if failed.is_none() {
        *failed = stream.write_fmt(text).and_then(|()| stream.flush()).err();
    }
}

pub(crate) fn to_stdout(text: fmt::Arguments<'_>) {
    SAID.store(true, Ordering::Relaxed);
    let mut failed = FAILED.lock().unwrap_or_else(PoisonError::into_inner);
    write(&mut io::stdout().lock(), &mut failed, text);
}

/// Writes a message; a message that cannot be written is dropped.
pub(crate) fn to_stderr(text: fmt::Arguments<'_>) {
    let _ = io::stderr().lock().write_fmt(text);
}

/// A number with its noun: `1 stage`, `3 stages`.
pub(crate) fn counted(n: usize, one: &str, many: &str) -> String {
    format!("{n} {}", if n == 1 { one } else { many })
}

/// Returns true if anything was written to stdout.
pub(crate) fn said() -> bool {
    SAID.load(Ordering::Relaxed)
}

/// The reason why results did not reach stdout; a closed reader does not count.
pub(crate) fn failure() -> Option<String> {
    let failed = FAILED.lock().unwrap_or_else(PoisonError::into_inner);
    failed.as_ref().filter(|e| e.kind() != io::ErrorKind::BrokenPipe).map(ToString::to_string)
}

/// Like the standard library's macro, without the panic.
macro_rules! print {
    ($($text:tt)*) => { $crate::output::to_stdout(format_args!($($text)*)) };
}

/// Like the standard library's macro, without the panic.
macro_rules! println {
    () => { $crate::output::to_stdout(format_args!("\n")) };
    ($($text:tt)*) => { $crate::output::to_stdout(format_args!("{}\n", format_args!($($text)*))) };
}

/// Like the standard library's macro, without the panic.
macro_rules! eprintln {
    () => { $crate::output::to_stderr(format_args!("\n")) };
    ($($text:tt)*) => { $crate::output::to_stderr(format_args!("{}\n", format_args!($($text)*))) };
}

/// Prints a message on stderr, unless the app prints only errors.
macro_rules! remark {
    ($app:expr, $($text:tt)*) => { if !$app.quiet { eprintln!($($text)*) } };
}

/// Prints one JSON document.
pub(crate) fn json(value: &impl Serialize) -> Done {
    let text = serde_json::to_string_pretty(value).map_err(WorkError::failed)?;
    println!("{text}");
    Ok(())
}

/// Prints a result as one JSON document, or as a text for people.
pub(crate) fn show(value: &(impl Serialize + fmt::Display), as_json: bool) -> Done {
    if as_json {
        return json(value);
    }
    print!("{value}");
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A stream that accepts `room` bytes.
    struct Narrow {
        room: usize,
        taken: usize,
    }

    impl Write for Narrow {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            if self.taken + bytes.len() > self.room {
                return Err(io::ErrorKind::StorageFull.into());
            }
            self.taken += bytes.len();
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn the_first_failure_is_kept_and_nothing_is_written_after_it() {
        let (mut stream, mut failed) = (Narrow { room: 4, taken: 0 }, None);
        for text in ["abc", "defg", "h"] {
            write(&mut stream, &mut failed, format_args!("{text}"));
        }
        assert_eq!(stream.taken, 3, "`h` would have fitted, but the text before it was lost");
        assert_eq!(failed.map(|e| e.kind()), Some(io::ErrorKind::StorageFull));
    }
}
