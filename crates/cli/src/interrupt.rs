//! Ctrl-C and SIGTERM: the first asks the running stage to write a checkpoint and leave, the second leaves at once.

use std::sync::Arc;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};

use signal_hook::consts::{SIGINT, SIGTERM};

static FLAG: OnceLock<Arc<AtomicBool>> = OnceLock::new();

/// Installs the handlers and returns the flag that long work polls.
pub(crate) fn install() -> Arc<AtomicBool> {
    FLAG.get_or_init(|| {
        let flag = Arc::new(AtomicBool::new(false));
        for signal in [SIGINT, SIGTERM] {
            // Order matters: the second signal finds the flag set and exits; the first only sets it.
            let armed = signal_hook::flag::register_conditional_shutdown(signal, 130, flag.clone())
                .and_then(|_| signal_hook::flag::register(signal, flag.clone()));
            if let Err(error) = armed {
                tracing::warn!("cannot handle signal {signal}: {error}; interrupting loses work since the last checkpoint");
            }
        }
        flag
    })
    .clone()
}

/// Whether a signal has come.
pub(crate) fn requested() -> bool {
    FLAG.get().is_some_and(|flag| flag.load(Ordering::Relaxed))
}
