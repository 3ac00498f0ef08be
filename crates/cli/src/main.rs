//! The `use3d` command: reads the arguments, runs the verbs, and prints progress, results and errors.

#[macro_use]
mod output;

#[cfg(all(target_os = "linux", target_env = "gnu"))]
mod allocator;
mod args;
mod c_functions;
mod error;
mod interrupt;
mod listener;
mod logging;
mod size;
mod verbs;
mod version;

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;

use use3d_pipeline::destination::path_text;
use use3d_pipeline::found::scene_in;
use use3d_pipeline::host::Host;
use use3d_workflow::{Event, Listener};

use args::{Bench, Store, Synth, Verb};
use error::{Done, WorkError};

/// The data that every verb gets.
#[derive(Clone)]
pub(crate) struct App {
    /// True if only errors are printed.
    pub(crate) quiet: bool,
    /// Its stop flag is set by Ctrl-C, SIGTERM and SIGHUP; its listener displays the events of stages.
    pub(crate) host: Host,
}

impl App {
    /// The same app, whose events `hear` gets too.
    pub(crate) fn heard_by(&self, hear: impl Fn(&Event<'_>) + Send + Sync + 'static) -> Self {
        Self { host: self.host.heard_by(hear), ..self.clone() }
    }

    /// The scene that a path names; prints its folder if it is another one.
    pub(crate) fn scene_in(&self, given: &Path) -> Result<PathBuf, WorkError> {
        let scene = scene_in(given)?;
        if scene != given {
            remark!(self, "the scene is {}", path_text(&scene));
        }
        Ok(scene)
    }
}

fn main() -> ExitCode {
    let (cli, wants_json) = args::parse();
    logging::start(cli.verbose, cli.quiet);
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let threads = cli.threads.unwrap_or(cores);
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    allocator::share_arenas(threads);
    if let Err(error) = rayon::ThreadPoolBuilder::new().num_threads(threads).build_global() {
        tracing::debug!("thread pool: {error}");
    }
    let listener: Arc<dyn Listener> = Arc::new(listener::Terminal::new(cli.quiet, cli.verbose > 0));
    let app = App { quiet: cli.quiet, host: Host { threads, stop: interrupt::install(), listener } };
    let done = run(&app, cli.verb).and_then(|()| match output::failure() {
        Some(reason) => Err(WorkError::Failed(format!("cannot write to standard output: {reason}"))),
        None => Ok(()),
    });
    if let Err(error) = &done
        && wants_json
        && !output::said()
    {
        // A program that reads JSON gets one document in any case.
        println!(
            "{}",
            serde_json::json!({ "error": error.to_string(), "exit_code": error::exit_code(error) })
        );
    }
    // A driver may end the process with an error if a device still exists when its library is unloaded.
    use3d_stages::close_devices();
    done.map_or_else(|error| error::report(&error), |()| ExitCode::SUCCESS)
}

fn run(app: &App, verb: Verb) -> Done {
    match verb {
        Verb::Demo(args) => verbs::run::demo(app, &args),
        Verb::Run(args) => verbs::run::run(app, &args),
        Verb::Submit { what } => verbs::submit::run(app, &what),
        Verb::Cancel(args) => verbs::submit::cancel(&args),
        Verb::Push(args) => verbs::remote::push(app, &args),
        Verb::Pull(args) => verbs::remote::pull(app, &args),
        Verb::Results(args) => verbs::results::run(app, &args),
        Verb::Compare(args) => verbs::compare::run(app, &args),
        Verb::Store { what: Store::Ls(args) } => verbs::remote::list(app, &args),
        Verb::Store { what: Store::Gc(args) } => verbs::remote::sweep(app, &args),
        Verb::Plan(args) => verbs::run::plan(&args),
        Verb::Status(args) => verbs::run::status(&args),
        Verb::Why(args) => verbs::run::why(&args),
        Verb::Graph(args) => verbs::run::graph(&args),
        Verb::Prepare(args) => verbs::prepare::run(app, &args),
        Verb::Import(args) => verbs::by_hand::import(app, &args),
        Verb::Reconstruct(args) => verbs::by_hand::reconstruct(app, &args),
        Verb::Calibrate(args) => verbs::by_hand::calibrate(app, &args),
        Verb::Targets(args) => verbs::by_hand::targets(app, &args),
        Verb::Enhance(args) => verbs::by_hand::enhance(app, &args),
        Verb::Evaluate(args) => verbs::evaluate::run(app, &args),
        Verb::Render(args) => verbs::render::run(app, &args),
        Verb::Photographs(args) => verbs::photographs::run(app, &args),
        Verb::View(args) => verbs::view::run(app, &args),
        Verb::White(args) => verbs::keep_white::run(app, &args),
        Verb::Export(args) => verbs::export::run(app, &args),
        Verb::Synth { what: Synth::Capture(args) } => verbs::synth::capture(app, &args),
        Verb::Synth { what: Synth::Pairs(args) } => verbs::synth::pairs(app, &args),
        Verb::Bench { what: Bench::Truth(args) } => verbs::bench::truth(app, &args),
        Verb::Bench { what: Bench::Scene(args) } => verbs::bench_scene::run(app, &args),
        Verb::Bench { what: Bench::Gpu(args) } => verbs::bench_gpu::gpu(app, &args),
        Verb::Check(args) => verbs::check::run(app, &args),
        Verb::Water(args) => verbs::water::run(app, &args),
        Verb::Doctor(args) => verbs::doctor::run(&args),
        Verb::Models(args) => verbs::models::run(&args),
        Verb::Devices(args) => verbs::devices::run(&args),
        Verb::Gc(args) => verbs::cache::gc(&args),
        Verb::Verify(args) => verbs::cache::verify(app, &args),
        Verb::Pipelines(args) => verbs::pipelines::run(&args),
        Verb::Params(args) => verbs::params::run(&args),
        Verb::Completions(args) => verbs::generate::completions(&args),
        Verb::Man(args) => verbs::generate::man(&args),
    }
}
