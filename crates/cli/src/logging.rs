//! Log lines on stderr; `-v`, `-q` and `RUST_LOG` set their level, and `NO_COLOR` is honoured.

use std::io::IsTerminal;

use tracing_subscriber::filter::Targets;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

/// Starts logging.
pub(crate) fn start(verbose: u8, quiet: bool) {
    let default = match (quiet, verbose) {
        (true, _) => "error",
        (_, 0) => "warn",
        (_, 1) => "info,use3d=debug",
        (_, 2) => "debug",
        _ => "trace",
    };
    let mut filter = String::from(default);
    if verbose < 2 {
        // Drivers of graphics cards and their loader log many warnings; the engine reports real errors
        // itself.
        filter.push_str(",wgpu_core=off,wgpu_hal=off");
    }
    let asked = std::env::var("RUST_LOG").ok().filter(|asked| !asked.is_empty());
    let filter: Targets =
        asked.and_then(|asked| asked.parse().ok()).or_else(|| filter.parse().ok()).unwrap_or_default();
    let color = std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none();
    let lines = tracing_subscriber::fmt::layer()
        .with_writer(std::io::stderr)
        .with_ansi(color)
        .with_target(verbose > 1)
        .without_time()
        // A closed stderr must not cause a panic.
        .log_internal_errors(false);
    tracing_subscriber::registry().with(lines).with(filter).init();
}
