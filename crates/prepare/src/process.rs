//! Runs another program: its lines go to a log file, its progress to the caller, and it ends with the caller.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{BufReader, Read, Write};
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::time::Duration;

use crate::error::PrepareError;

/// The progress of a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StepProgress {
    /// The step, in words.
    pub step: &'static str,
    /// Finished units.
    pub done: u64,
    /// All units; 0 if the number is not known.
    pub total: u64,
    /// The name of the units.
    pub unit: &'static str,
}

/// The caller's view of the work.
pub struct StepWatch<'a> {
    /// Set by the caller to stop the work.
    pub stop: &'a AtomicBool,
    /// Receives progress.
    pub progress: &'a dyn Fn(StepProgress),
    /// Receives one line for every finished step and every remark.
    pub note: &'a dyn Fn(&str),
}

impl StepWatch<'_> {
    pub(crate) fn check(&self) -> Result<(), PrepareError> {
        check(self.stop)
    }

    /// Tells the progress of a step.
    pub(crate) fn tell(&self, step: &'static str, (done, total): (u64, u64), unit: &'static str) {
        (self.progress)(StepProgress { step, done, total, unit });
    }
}

fn check(stop: &AtomicBool) -> Result<(), PrepareError> {
    if stop.load(Ordering::Relaxed) { Err(PrepareError::Interrupted) } else { Ok(()) }
}

/// A child process that is ended when it is dropped.
pub(crate) struct Ended(pub(crate) Child);

impl Ended {
    /// Starts a command without input.
    pub(crate) fn spawn(command: &mut Command) -> Result<Self, PrepareError> {
        let child = command.stdin(Stdio::null()).spawn();
        child.map(Self).map_err(PrepareError::run(Path::new(command.get_program())))
    }
}

impl Drop for Ended {
    fn drop(&mut self) {
        // A process that has ended already is no problem.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The longest line that is kept, bytes.
const LONGEST: usize = 4096;
/// The number of last lines that a message about a failure can draw from.
const LAST: usize = 12;
/// Time between two looks at the caller's wish to stop.
const LOOK: Duration = Duration::from_millis(100);

/// Splits a stream into lines. `heard` gets each line, with true if a terminal would overwrite it with the
/// next one, as programs do with their progress; it returns false to end the reading.
fn split(stream: impl Read, mut heard: impl FnMut(String, bool) -> bool) {
    let mut line = Vec::new();
    let mut send = |line: &mut Vec<u8>, overwritten: bool| {
        let text = String::from_utf8_lossy(line).trim_end().to_string();
        line.clear();
        heard(text, overwritten)
    };
    // A carriage return ends a line that is overwritten, unless a line end follows it.
    let mut returned = false;
    for byte in BufReader::new(stream).bytes() {
        let Ok(byte) = byte else { break };
        let more = match byte {
            b'\n' => {
                returned = false;
                send(&mut line, false)
            }
            b'\r' => {
                returned = true;
                true
            }
            _ => {
                let ended = returned || line.len() == LONGEST;
                let more = !ended || send(&mut line, returned);
                returned = false;
                line.push(byte);
                more
            }
        };
        if !more {
            return;
        }
    }
    if !line.is_empty() {
        send(&mut line, false);
    }
}

/// Sends the lines of a stream from a thread of its own.
pub(crate) fn forward(stream: impl Read + Send + 'static, lines: Sender<(String, bool)>) {
    std::thread::spawn(move || split(stream, |line, overwritten| lines.send((line, overwritten)).is_ok()));
}

/// The end of a program: its status and its last lines that are not empty.
pub(crate) struct ProgramEnd {
    pub(crate) status: ExitStatus,
    pub(crate) last: Vec<String>,
}

/// A command as it is typed.
pub(crate) fn spelled(command: &Command) -> Vec<String> {
    let words = std::iter::once(command.get_program()).chain(command.get_args());
    words.map(|word| word.to_string_lossy().into_owned()).collect()
}

/// The log file, with a command at its end.
pub(crate) fn open_log(log: &Path, command: &Command) -> Result<File, PrepareError> {
    let file = use3d_files::no_link().create(true).append(true).open(log);
    let written = file.and_then(|mut file| {
        writeln!(file, "$ {}", spelled(command).join(" "))?;
        Ok(file)
    });
    written.map_err(PrepareError::write(log))
}

/// Runs a command to its end. Each line goes to the log file and to `heard`.
pub(crate) fn run(
    command: &mut Command,
    log: &Path,
    stop: &AtomicBool,
    mut heard: impl FnMut(&str),
) -> Result<ProgramEnd, PrepareError> {
    let mut file = open_log(log, command)?;
    let failed = PrepareError::write(log);
    let mut child = Ended::spawn(command.stdout(Stdio::piped()).stderr(Stdio::piped()))?;
    let program = Path::new(command.get_program());
    let (sender, lines) = channel();
    if let Some(out) = child.0.stdout.take() {
        forward(out, sender.clone());
    }
    if let Some(err) = child.0.stderr.take() {
        forward(err, sender);
    }
    let mut last: VecDeque<String> = VecDeque::new();
    loop {
        check(stop)?;
        match lines.recv_timeout(LOOK) {
            Ok((line, true)) => heard(&line),
            Ok((line, false)) => {
                writeln!(file, "{line}").map_err(&failed)?;
                heard(&line);
                if !line.trim().is_empty() {
                    last.push_back(line);
                    if last.len() > LAST {
                        last.pop_front();
                    }
                }
            }
            Err(end) => {
                // A grandchild may keep the streams open after the program has ended, and a program may go on
                // after it has closed them.
                if let Some(status) = child.0.try_wait().map_err(PrepareError::run(program))? {
                    return Ok(ProgramEnd { status, last: last.into() });
                }
                if end == RecvTimeoutError::Disconnected {
                    std::thread::sleep(LOOK);
                }
            }
        }
    }
}

/// The end of a program that failed, in words.
pub(crate) fn reason(outcome: &ProgramEnd) -> String {
    #[cfg(unix)]
    let signal = std::os::unix::process::ExitStatusExt::signal(&outcome.status);
    #[cfg(not(unix))]
    let signal: Option<i32> = None;
    let end = match (signal, outcome.status.code()) {
        (Some(9), _) => "it was killed, probably because memory ran out; close other programs".to_string(),
        (Some(signal), _) => format!("it was ended by signal {signal}"),
        (None, Some(code)) => format!("it ended with code {code}"),
        (None, None) => "it was ended".to_string(),
    };
    let shown = outcome.last.len().saturating_sub(3);
    let last: Vec<&str> = outcome.last[shown..].iter().map(String::as_str).collect();
    if last.is_empty() { end } else { format!("{end}; its last lines:\n  {}", last.join("\n  ")) }
}

/// The counts in a line of COLMAP: `[3/20]`, or `[2/3, 1/3]` for blocks.
pub(crate) fn counts(line: &str) -> Option<(u64, u64)> {
    let inside = line.rsplit_once('[')?.1.split_once(']')?.0;
    let part = |text: &str| -> Option<(u64, u64)> {
        let (a, b) = text.trim().split_once('/')?;
        Some((a.parse().ok()?, b.parse().ok()?))
    };
    match inside.split_once(',') {
        None => part(inside),
        Some((outer, inner)) => {
            let ((a, n), (b, m)) = (part(outer)?, part(inner)?);
            Some((a.checked_sub(1)?.checked_mul(m)?.checked_add(b)?, n.checked_mul(m)?))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_of_every_kind_of_line() {
        for (line, expected) in [
            ("Processed file [3/20]", Some((3, 20))),
            ("I20261124 17:22:29.1 1 x.cc:8] Processed file [3/20]", Some((3, 20))),
            ("Matching block [2/3, 1/3]", Some((4, 9))),
            ("Matching block [1/1, 1/1] in 367.404s", Some((1, 1))),
            ("Matching block [0/3, 1/3]", None),
            ("Elapsed time: 0.434 [minutes]", None),
            ("nothing", None),
            ("[99999999999999999999/1]", None),
        ] {
            assert_eq!(counts(line), expected, "{line}");
        }
    }

    #[test]
    fn progress_that_overwrites_itself_arrives_line_by_line() {
        let long = "x".repeat(LONGEST + 3);
        let text = format!("begin\r\n\nframe= 1 \rframe= 2\r\rframe= 3\r\nerror\n{long}\nlast");
        let mut found = Vec::new();
        split(text.as_bytes(), |line, overwritten| {
            found.push((line, overwritten));
            true
        });
        let expected = [
            ("begin", false),
            ("", false),
            ("frame= 1", true),
            ("frame= 2", true),
            ("frame= 3", false),
            ("error", false),
            (&long[..LONGEST], false),
            ("xxx", false),
            ("last", false),
        ];
        assert_eq!(found, expected.map(|(line, overwritten)| (line.to_string(), overwritten)));
        let mut count = 0;
        split("a\nb\nc\n".as_bytes(), |_, _| {
            count += 1;
            count < 2
        });
        assert_eq!(count, 2);
    }

    #[cfg(unix)]
    #[test]
    fn a_program_that_is_stopped_ends_at_once() {
        let dir = tempfile::tempdir().unwrap();
        let stop = AtomicBool::new(true);
        let begun = std::time::Instant::now();
        let ended = run(Command::new("sleep").arg("30"), &dir.path().join("log.txt"), &stop, |_| {});
        assert!(matches!(ended, Err(PrepareError::Interrupted)));
        assert!(begun.elapsed() < Duration::from_secs(10));
    }
}
