//! Ctrl-C, SIGTERM and a closed terminal (SIGHUP). The first signal makes the running work write a checkpoint
//! and end; the second one ends the program at once. SIGUSR1 does the same as a first signal and also marks
//! that the time limit is reached: another run will continue the work.

use std::ops::ControlFlow;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{OnceLock, mpsc};
use std::time::Duration;

use signal_hook::consts::{SIGINT, SIGTERM};

use crate::error::CliError;

static FLAG: OnceLock<Arc<AtomicBool>> = OnceLock::new();
static LEAVE: OnceLock<Arc<AtomicBool>> = OnceLock::new();

/// Installs the handlers and returns the flag that long work checks.
pub(crate) fn install() -> Arc<AtomicBool> {
    FLAG.get_or_init(|| {
        let flag = Arc::new(AtomicBool::new(false));
        // Set by signals alone. A run that reaches its time limit sets only the other flag, so that a later
        // first signal does not end the program at once.
        let asked = Arc::new(AtomicBool::new(false));
        for signal in [SIGINT, SIGTERM].into_iter().chain(hang_up()) {
            // Order matters: the second signal finds the flag set and exits; the first only sets it.
            let armed = signal_hook::flag::register_conditional_shutdown(signal, 130, asked.clone())
                .and_then(|_| signal_hook::flag::register(signal, asked.clone()))
                .and_then(|_| signal_hook::flag::register(signal, flag.clone()));
            if let Err(error) = armed {
                tracing::warn!("cannot handle signal {signal}: {error}; interrupting loses work since the last checkpoint");
            }
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
                    let _ = CliError::Stopped.report();
                    std::process::exit(i32::from(CliError::Stopped.code()));
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
pub(crate) fn check() -> Result<(), CliError> {
    if requested() { Err(CliError::Stopped) } else { Ok(()) }
}

/// Does work that leaves no files behind, and returns as soon as a signal arrives: the rest of the work then
/// ends with the program.
pub(crate) fn unless_stopped<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, CliError> {
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
                return Err(CliError::Failed("internal error, please report it".into()));
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
    fn an_ignored_hang_up_stays_ignored() {
        let status = |mask: &str| format!("Name:\tuse3d\nSigIgn:\t{mask}\nSigCgt:\t0000000000000000\n");
        assert_eq!(ignores(&status("0000000000000001"), 1), Some(true));
        assert_eq!(ignores(&status("0000000000001000"), 1), Some(false));
        assert_eq!(ignores("nothing known", 1), None);
    }
}
