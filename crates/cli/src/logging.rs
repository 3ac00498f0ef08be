//! Log lines on stderr; `-v`, `-q` and `RUST_LOG` set their level, and `NO_COLOR` is honoured.

use std::io::IsTerminal;

use tracing_subscriber::EnvFilter;

/// Starts logging.
pub(crate) fn start(verbose: u8, quiet: bool) {
    let default = match (quiet, verbose) {
        (true, _) => "error",
        (_, 0) => "warn,use3d=info",
        (_, 1) => "info,use3d=debug",
        (_, 2) => "debug",
        _ => "trace",
    };
    let ours = [
        "capture",
        "io_image",
        "survey",
        "io_colmap",
        "io_metashape",
        "io_nerfstudio",
        "io_opensfm",
        "io_realityscan",
        "import",
        "prepare",
        "splat",
        "medium",
        "atc",
        "nets",
        "synth",
        "reconstruct",
        "enhance",
    ];
    let mut filter = String::from(default);
    if !quiet && verbose == 0 {
        for name in ours.iter().chain(&["workflow", "pipeline", "scene", "render", "training"]) {
            filter.push_str(&format!(",use3d_{name}=info"));
        }
    }
    if verbose < 2 {
        // Drivers of graphics cards and their loader log many warnings; the engine reports real errors
        // itself.
        filter.push_str(",wgpu_core=off,wgpu_hal=off");
    }
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(filter));
    let color = std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none();
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_ansi(color)
        .with_target(verbose > 1)
        .without_time()
        // A closed stderr must not cause a panic.
        .log_internal_errors(false)
        .init();
}
