//! Ctrl-C, SIGTERM and a closed terminal (SIGHUP): the first asks the running work to write a
//! checkpoint and leave, the second leaves at once. SIGUSR1 asks for the same as the first and says
//! that time is over: another run will go on.

use std::ops::ControlFlow;
use std::sync::Arc;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use signal_hook::consts::{SIGINT, SIGTERM};

use crate::error::CliError;

static FLAG: OnceLock<Arc<AtomicBool>> = OnceLock::new();
static LEAVE: OnceLock<Arc<AtomicBool>> = OnceLock::new();

/// How long signals of one kind count as one. Slurm sends SIGTERM to every process of a task, and the task's script
/// passes its own on; a terminal sends to a whole group, and what started us may pass that on.
fn as_one(signal: i32) -> Duration {
    if signal == SIGTERM { Duration::from_secs(2) } else { Duration::from_millis(200) }
}

/// Whether a signal is the second, at which this process leaves at once, and no echo of the first.
fn is_second(earlier: &[(i32, Instant)], signal: i32, now: Instant) -> bool {
    let echoes = |(kind, at): &(i32, Instant)| *kind == signal && now.duration_since(*at) < as_one(signal);
    !earlier.is_empty() && !earlier.iter().any(echoes)
}

/// Installs the handlers and returns the flag that long work polls.
pub(crate) fn install() -> Arc<AtomicBool> {
    FLAG.get_or_init(|| {
        let flag = Arc::new(AtomicBool::new(false));
        let ending: Vec<i32> = [SIGINT, SIGTERM].into_iter().chain(hang_up()).collect();
        for signal in &ending {
            // In the handler itself, so that work hears of it at once.
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
                        std::process::exit(130);
                    }
                    // Echoes have none of their own: whoever goes on sending is heard in the end.
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
