//! A store beside the cache: `push`, `pull`, and the store that `run` uses.

use std::sync::Arc;

use use3d_build::place::parent;
use use3d_build::remote::{RemoteStore, Transferred};

use crate::App;
use crate::args::{PushArgs, TransferArgs};
use crate::destination::path_text;
use crate::error::{CliError, Done};
use crate::verbs::run::{Loaded, json, open};

/// The store at an address.
fn store(address: &str) -> Result<RemoteStore, CliError> {
    let remote = use3d_store::open(address).map_err(|e| CliError::Input(format!("--remote: {e}")))?;
    Ok(RemoteStore::new(remote))
}

/// The store at an address, after a test that it works reliably.
pub(crate) fn probed(app: &App, address: &str) -> Result<Arc<RemoteStore>, CliError> {
    let store = store(address)?;
    store.probe(&app.stop).map_err(|e| CliError::Failed(format!("--remote: {e}")))?;
    Ok(Arc::new(store))
}

fn loaded(args: &TransferArgs) -> Result<Loaded, CliError> {
    open(&args.pipeline, &[])
}

pub(crate) fn push(app: &App, args: &PushArgs) -> Done {
    let Loaded { builder, graph, .. } = loaded(&args.what)?;
    let store = probed(app, &args.what.remote)?;
    let cache = &builder.cache;
    let sent = builder.push(&graph, &store, args.check, &app.stop, &app.listener);
    let sent = sent.map_err(CliError::failed)?;
    let nothing = sent.moved + sent.already == 0 && sent.problems.is_empty() && !sent.interrupted;
    if nothing && sent.missing > 0 && !app.quiet {
        eprintln!(
            "warning: the cache at {} has no results of this pipeline; give the same --cache and --set as \
             in its run",
            path_text(parent(cache.root()))
        );
    }
    tell(&sent, &args.what)
}

pub(crate) fn pull(app: &App, args: &TransferArgs) -> Done {
    let Loaded { builder, graph, .. } = loaded(args)?;
    // A user who only fetches may have no permission to write.
    let store = store(&args.remote)?;
    if let Some(folder) = use3d_store::folder(&args.remote).filter(|folder| !folder.is_dir()) {
        return Err(CliError::Failed(format!(
            "--remote: {}: there is no such folder; give the one that `push` or `run --remote` filled, or mount it",
            folder.display()
        )));
    }
    let fetched = builder.pull(&graph, &store, &app.stop, &app.listener);
    let done = fetched.map_err(CliError::failed)?;
    if done.moved == 0 && done.missing > 0 && done.problems.is_empty() && !done.interrupted && !app.quiet {
        eprintln!(
            "warning: the store at {} has none of the missing results; check the address",
            store.place()
        );
    }
    tell(&done, args)
}

fn tell(done: &Transferred, args: &TransferArgs) -> Done {
    if args.json {
        json(done)?;
    } else {
        print!("{done}");
    }
    match (done.interrupted, done.problems.len()) {
        (true, _) => Err(CliError::Interrupted),
        (false, 0) => Ok(()),
        (false, 1) => Err(CliError::Failed("1 artifact has a problem, see above".into())),
        (false, n) => Err(CliError::Failed(format!("{n} artifacts have problems, see above"))),
    }
}
