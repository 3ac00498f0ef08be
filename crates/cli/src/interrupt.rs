//! Ctrl-C, SIGTERM and a closed terminal (SIGHUP): the first asks the running work to write a
//! checkpoint and leave, the second leaves at once. SIGUSR1 asks for the same as the first and says
//! that time is over: another run will go on.

use std::ops::ControlFlow;
use std::sync::Arc;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};
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

/// How long work of which nothing is kept may go on after a signal.
const MANNERS: Duration = Duration::from_millis(300);

/// As long as it lives, a signal ends this process soon, whatever it does: for work of which nothing is kept.
/// What was being made goes.
#[must_use]
pub(crate) struct EndsSoon(Arc<AtomicBool>);

pub(crate) fn ends_soon() -> EndsSoon {
    let (done, flag) = (Arc::new(AtomicBool::new(false)), install());
    let over = done.clone();
    std::thread::spawn(move || {
        while !over.load(Ordering::Relaxed) {
            if flag.load(Ordering::Relaxed) {
                // Most work looks by itself, and says what became of it.
                std::thread::sleep(MANNERS);
                if !over.load(Ordering::Relaxed) {
                    use3d_files::abandon();
                    let _ = CliError::Stopped.report();
                    std::process::exit(i32::from(CliError::Stopped.code()));
                }
            }
            std::thread::sleep(MANNERS / 6);
        }
    });
    EndsSoon(done)
}

impl Drop for EndsSoon {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
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

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;

    #[test]
    fn an_ignored_hang_up_stays_ignored() {
        let status = |mask: &str| format!("Name:\tuse3d\nSigIgn:\t{mask}\nSigCgt:\t0000000000000000\n");
        assert_eq!(ignores(&status("0000000000000001"), 1), Some(true));
        assert_eq!(ignores(&status("0000000000001000"), 1), Some(false));
        assert_eq!(ignores("nothing known", 1), None);
    }
}
