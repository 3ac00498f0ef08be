//! Ctrl-C, SIGTERM and a closed terminal (SIGHUP): the first asks the running work to write a
//! checkpoint and leave, the second leaves at once. SIGUSR1 asks for the same as the first and says
//! that time is over: another run will go on.

use std::ops::ControlFlow;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{OnceLock, mpsc};
use std::time::Duration;

use signal_hook::consts::{SIGINT, SIGTERM};

use crate::error::CliError;

static FLAG: OnceLock<Arc<AtomicBool>> = OnceLock::new();
static LEAVE: OnceLock<Arc<AtomicBool>> = OnceLock::new();

/// Installs the handlers and returns the flag that long work polls.
pub(crate) fn install() -> Arc<AtomicBool> {
    FLAG.get_or_init(|| {
        let flag = Arc::new(AtomicBool::new(false));
        // Raised by signals alone: a run that leaves by itself raises the other, and
        // is not to be cut off for that.
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

/// The flag that says that work is left for want of time.
pub(crate) fn leave() -> Arc<AtomicBool> {
    LEAVE.get_or_init(Arc::default).clone()
}

/// SIGHUP, unless whoever started us (`nohup`) had it ignored: a handler would undo that. Only Linux tells.
fn hang_up() -> Option<i32> {
    #[cfg(target_os = "linux")]
    {
        let status = std::fs::read_to_string("/proc/self/status").ok()?;
        (!ignores(&status, signal_hook::consts::SIGHUP)?).then_some(signal_hook::consts::SIGHUP)
    }
    #[cfg(not(target_os = "linux"))]
    None
}

/// Whether a signal is ignored, by the text of `/proc/PID/status`.
#[cfg(target_os = "linux")]
fn ignores(status: &str, signal: i32) -> Option<bool> {
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"))?;
    let mask = u64::from_str_radix(mask.trim(), 16).ok()?;
    Some(mask >> (signal - 1) & 1 == 1)
}

/// Whether a signal has come.
pub(crate) fn requested() -> bool {
    FLAG.get().is_some_and(|flag| flag.load(Ordering::Relaxed))
}

/// The same as an answer to work that asks whether to go on.
pub(crate) fn go_on() -> ControlFlow<()> {
    if requested() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
}

/// The same as an error, for loops whose work is not kept.
pub(crate) fn check() -> Result<(), CliError> {
    if requested() { Err(CliError::Stopped) } else { Ok(()) }
}

/// Does work that leaves nothing behind, and returns as soon as a signal comes: what is under way then ends with
/// the program.
pub(crate) fn unless_stopped<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, CliError> {
    const LOOK: Duration = Duration::from_millis(50);
    let (sender, receiver) = mpsc::channel();
    std::thread::spawn(move || {
        // Nobody listens any more where a signal came first.
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
