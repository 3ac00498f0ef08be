//! Ctrl-C, SIGTERM and a closed terminal (SIGHUP). The first signal makes the running work write a checkpoint
//! and end; the second one ends the program at once. SIGUSR1 does the same as a first signal and also marks
//! that the time limit is reached: another run will continue the work.

use std::ops::ControlFlow;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{OnceLock, mpsc};
use std::time::{Duration, Instant};

use signal_hook::consts::{SIGINT, SIGTERM};

use crate::error::{WorkError, exit_code, report};

static FLAG: OnceLock<Arc<AtomicBool>> = OnceLock::new();
static LEAVE: OnceLock<Arc<AtomicBool>> = OnceLock::new();

/// The time in which signals of one kind count as one. Slurm sends SIGTERM to every process of a task, and
/// the script of the task may forward its own. A terminal signals a whole group, and the parent may forward
/// it.
fn as_one(signal: i32) -> Duration {
    if signal == SIGTERM { Duration::from_secs(2) } else { Duration::from_millis(200) }
}

/// Returns true if a signal is a second one, which ends this process at once, and not an echo of the first.
fn is_second(earlier: &[(i32, Instant)], signal: i32, now: Instant) -> bool {
    let echoes = |(kind, at): &(i32, Instant)| *kind == signal && now.duration_since(*at) < as_one(signal);
    !earlier.is_empty() && !earlier.iter().any(echoes)
}

/// Installs the handlers and returns the flag that long work checks.
pub(crate) fn install() -> Arc<AtomicBool> {
    FLAG.get_or_init(|| {
        let flag = Arc::new(AtomicBool::new(false));
        let ending: Vec<i32> = [SIGINT, SIGTERM].into_iter().chain(hang_up()).collect();
        for signal in &ending {
            // The handler itself sets the flag, so that work notices it at once.
            if let Err(error) = signal_hook::flag::register(*signal, flag.clone()) {
                tracing::warn!("cannot handle signal {signal}: {error}; interrupting loses work since the last checkpoint");
            }
        }
        match signal_hook::iterator::Signals::new(&ending) {
            Ok(mut signals) => drop(std::thread::spawn(move || {
                let mut earlier: Vec<(i32, Instant)> = Vec::new();
                for signal in signals.forever() {
                    let now = Instant::now();
                    if is_second(&earlier, signal, now) {
                        signal_hook::low_level::exit(130);
                    }
                    // Echoes are not stored, so a sender that repeats its signal ends the process in the end.
                    if !earlier.iter().any(|(kind, _)| *kind == signal) {
                        earlier.push((signal, now));
                    }
                }
            })),
            Err(error) => tracing::warn!("a second signal will not end this process at once: {error}"),
        }
        #[cfg(unix)]
        {
            let signal = signal_hook::consts::SIGUSR1;
            let armed = signal_hook::flag::register(signal, leave())
                .and_then(|_| signal_hook::flag::register(signal, flag.clone()));
            if let Err(error) = armed {
                tracing::warn!("cannot handle signal {signal}: {error}");
            }
        }
        flag
    })
    .clone()
}

/// The flag for work that ends because of a time limit.
pub(crate) fn leave() -> Arc<AtomicBool> {
    LEAVE.get_or_init(Arc::default).clone()
}

/// SIGHUP, unless the parent process (`nohup`) made this one ignore it: a handler would undo that. Only Linux
/// reports it.
fn hang_up() -> Option<i32> {
    #[cfg(target_os = "linux")]
    {
        let status = std::fs::read_to_string("/proc/self/status").ok()?;
        (!ignores(&status, signal_hook::consts::SIGHUP)?).then_some(signal_hook::consts::SIGHUP)
    }
    #[cfg(not(target_os = "linux"))]
    None
}

/// Returns true if a signal is ignored, by the text of `/proc/PID/status`; `None` if the text does not show
/// it.
#[cfg(target_os = "linux")]
fn ignores(status: &str, signal: i32) -> Option<bool> {
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"))?;
    let mask = u64::from_str_radix(mask.trim(), 16).ok()?;
    Some(mask >> (signal - 1) & 1 == 1)
}

/// The time after a signal in which work may end by itself.
const GRACE: Duration = Duration::from_millis(300);

/// While this value exists, a signal ends the process after [`GRACE`] and removes its unfinished files. It is
/// for work that keeps no partial result.
#[must_use]
pub(crate) struct EndsSoon(Arc<AtomicBool>);

pub(crate) fn ends_soon() -> EndsSoon {
    let (done, flag) = (Arc::new(AtomicBool::new(false)), install());
    let over = done.clone();
    std::thread::spawn(move || {
        while !over.load(Ordering::Relaxed) {
            if flag.load(Ordering::Relaxed) {
                // Most work checks the flag itself, and ends with a better message.
                std::thread::sleep(GRACE);
                if !over.load(Ordering::Relaxed) {
                    use3d_files::abandon();
                    let _ = report(&WorkError::Stopped);
                    std::process::exit(i32::from(exit_code(&WorkError::Stopped)));
                }
            }
            std::thread::sleep(GRACE / 6);
        }
    });
    EndsSoon(done)
}

impl Drop for EndsSoon {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Returns true if a signal has arrived.
pub(crate) fn requested() -> bool {
    FLAG.get().is_some_and(|flag| flag.load(Ordering::Relaxed))
}

/// The same, as the answer of a callback that decides whether work continues.
pub(crate) fn go_on() -> ControlFlow<()> {
    if requested() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
}

/// The same as an error, for loops that keep no partial result.
pub(crate) fn check() -> Result<(), WorkError> {
    if requested() { Err(WorkError::Stopped) } else { Ok(()) }
}

/// Does work that leaves no files behind, and returns as soon as a signal arrives: the rest of the work then
/// ends with the program.
pub(crate) fn unless_stopped<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, WorkError> {
    const LOOK: Duration = Duration::from_millis(50);
    let (sender, receiver) = mpsc::channel();
    std::thread::spawn(move || {
        // After a signal, the receiver is gone.
        let _ = sender.send(work());
    });
    loop {
        match receiver.recv_timeout(LOOK) {
            Ok(done) => return Ok(done),
            Err(mpsc::RecvTimeoutError::Timeout) => check()?,
            Err(mpsc::RecvTimeoutError::Disconnected) => {
                return Err(WorkError::Failed("internal error, please report it".into()));
            }
        }
    }
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;

    #[test]
    fn work_that_ends_is_handed_back_and_one_that_panics_is_an_error() {
        assert_eq!(unless_stopped(|| 3).ok(), Some(3));
        assert!(unless_stopped(|| -> u8 { panic!("on purpose") }).is_err());
    }

    #[test]
    fn a_signal_and_its_echo_are_one() {
        let start = Instant::now();
        let at = |signal, milliseconds| (signal, start + Duration::from_millis(milliseconds));
        let second = |earlier: &[(i32, Instant)], (signal, now)| is_second(earlier, signal, now);
        assert!(!second(&[], at(SIGTERM, 0)));
        assert!(!second(&[at(SIGTERM, 0)], at(SIGTERM, 1900)));
        assert!(second(&[at(SIGTERM, 0)], at(SIGTERM, 2100)));
        assert!(second(&[at(SIGTERM, 0)], at(SIGINT, 100)));
        assert!(!second(&[at(SIGINT, 0)], at(SIGINT, 100)));
        assert!(second(&[at(SIGINT, 0)], at(SIGINT, 300)));
    }

    #[test]
    fn an_ignored_hang_up_stays_ignored() {
        let status = |mask: &str| format!("Name:\tuse3d\nSigIgn:\t{mask}\nSigCgt:\t0000000000000000\n");
        assert_eq!(ignores(&status("0000000000000001"), 1), Some(true));
        assert_eq!(ignores(&status("0000000000001000"), 1), Some(false));
        assert_eq!(ignores("nothing known", 1), None);
    }
}
