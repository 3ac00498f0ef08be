//! A store beside the cache: `push`, `pull`, and the store that `run` uses.

use std::collections::BTreeSet;
use std::sync::Arc;

use use3d_pipeline::destination::path_text;
use use3d_pipeline::loaded::Loaded;
use use3d_workflow::Transferred;
use use3d_workflow::gc::parse_age;
use use3d_workflow::place::parent;
use use3d_workflow::remote::{RemoteError, RemoteStore};

use crate::App;
use crate::args::{PushArgs, RemoteArgs, StoreGcArgs, StoreLsArgs, TransferArgs};
use crate::error::{Done, WorkError};
use crate::output::{counted, json, show};

/// The store at an address.
fn store(address: &str) -> Result<RemoteStore, WorkError> {
    let remote = use3d_store::open(address).map_err(|e| WorkError::Input(format!("--remote: {e}")))?;
    Ok(RemoteStore::new(remote))
}

/// The store of a run. A store that does not answer now may answer later, so it ends no run. Nothing is sent
/// to it until a test has shown that it works reliably.
pub(crate) fn of_run(app: &App, address: &str, read_only: bool) -> Result<Arc<RemoteStore>, WorkError> {
    let store = store(address)?;
    let tested = (!read_only).then(|| store.probe(&app.host.stop));
    let (writable, warning) = usable(tested)?;
    warning.iter().for_each(|text| eprintln!("warning: --remote: {text}"));
    Ok(Arc::new(if writable { store } else { store.read_only() }))
}

/// Decides from the test of a store if a run may send artifacts to it (`None`: it must not), with a warning.
fn usable(tested: Option<Result<(), RemoteError>>) -> Result<(bool, Option<String>), WorkError> {
    match tested {
        None => Ok((false, None)),
        Some(Ok(())) => Ok((true, None)),
        Some(Err(error @ RemoteError::Refused { passing: true, .. })) => {
            let text = format!(
                "{error}; the run fetches from it nevertheless, and sends nothing to it: `use3d push` does \
                 that later"
            );
            Ok((false, Some(text)))
        }
        Some(Err(error)) => Err(WorkError::Failed(format!("--remote: {error}"))),
    }
}

pub(crate) fn list(app: &App, args: &StoreLsArgs) -> Done {
    existing(&args.store)?;
    let shelf = store(&args.store.remote)?.shelf(&app.host.stop).map_err(WorkError::failed)?;
    if args.json {
        let (files, bytes) = shelf.size();
        return json(&serde_json::json!({ "stages": shelf.stages(), "files": files, "bytes": bytes }));
    }
    print!("{shelf}");
    Ok(())
}

pub(crate) fn sweep(app: &App, args: &StoreGcArgs) -> Done {
    let older_than =
        parse_age(&args.older_than).map_err(|e| WorkError::Input(format!("--older-than: {e}")))?;
    existing(&args.store)?;
    let mut keep = BTreeSet::new();
    for pipeline in &args.sweep.keep {
        let loaded = args.sweep.cache.request(pipeline).look()?;
        let plan = loaded.builder.plan(&loaded.graph, None);
        // An artifact without a key cannot be distinguished from one that no node needs.
        let unknown = plan.to_run() + plan.unavailable() + plan.blocked();
        if unknown > 0 {
            return Err(WorkError::Input(format!(
                "--keep {}: {unknown} of its stages are not in the cache, or their inputs are not on this \
                 machine, so their artifacts in the store are not known; `use3d pull` it or run it first, where \
                 its captures are",
                path_text(pipeline)
            )));
        }
        keep.extend(plan.keys());
    }
    let swept = store(&args.store.remote)?.sweep(older_than, &keep, args.sweep.dry_run, &app.host.stop);
    let swept = swept.map_err(WorkError::failed)?;
    show(&swept, args.sweep.json)?;
    if swept.interrupted { Err(WorkError::Interrupted) } else { Ok(()) }
}

/// Refuses a store folder that does not exist.
fn existing(args: &RemoteArgs) -> Done {
    match use3d_store::folder(&args.remote).filter(|folder| !folder.is_dir()) {
        None => Ok(()),
        Some(folder) => Err(WorkError::Failed(format!(
            "--remote: {}: there is no such folder; give the one that `push` or `run --remote` filled, or mount it",
            folder.display()
        ))),
    }
}

pub(crate) fn push(app: &App, args: &PushArgs) -> Done {
    let Loaded { builder, graph, .. } = args.what.pipeline.request().look()?;
    let store = store(&args.what.store.remote)?;
    store.probe(&app.host.stop).map_err(|e| WorkError::Failed(format!("--remote: {e}")))?;
    let sent = builder.push(&graph, &store, args.check, &app.host.stop, &app.host.listener);
    let sent = sent.map_err(WorkError::failed)?;
    let nothing = sent.moved + sent.already == 0 && sent.problems.is_empty() && !sent.interrupted;
    if nothing && sent.missing > 0 {
        remark!(
            app,
            "warning: the cache at {} has no results of this pipeline; give the same --cache and --set as \
             in its run",
            path_text(parent(builder.cache.root()))
        );
    }
    tell(&sent, &args.what)
}

pub(crate) fn pull(app: &App, args: &TransferArgs) -> Done {
    let Loaded { builder, graph, .. } = args.pipeline.request().look()?;
    // A user who only fetches may have no permission to write.
    let store = store(&args.store.remote)?;
    existing(&args.store)?;
    let done = builder.pull(&graph, &store, &app.host.stop, &app.host.listener).map_err(WorkError::failed)?;
    if done.moved == 0 && done.missing > 0 && done.problems.is_empty() && !done.interrupted {
        let place = store.place();
        remark!(app, "warning: the store at {place} has none of the missing results; check the address");
    }
    tell(&done, args)
}

fn tell(done: &Transferred, args: &TransferArgs) -> Done {
    show(done, args.json)?;
    match (done.interrupted, done.problems.len()) {
        (true, _) => Err(WorkError::Interrupted),
        (false, 0) if args.all_or_fail && done.missing > 0 => Err(WorkError::Failed(format!(
            "{} missing, and --all-or-fail asks for all of the pipeline",
            counted(done.missing, "artifact is", "artifacts are")
        ))),
        (false, 0) => Ok(()),
        (false, n) => {
            let problems = counted(n, "artifact has a problem", "artifacts have problems");
            Err(WorkError::Failed(format!("{problems}, see above")))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_store_that_may_answer_later_ends_no_run_and_one_that_never_will_does() {
        let refused = |passing| RemoteError::Refused {
            place: "s3://lab/use3d".to_string(),
            doing: "create",
            name: "v1/probe/1".to_string(),
            reason: "500 Internal Server Error".to_string(),
            passing,
        };
        assert!(matches!(usable(Some(Ok(()))), Ok((true, None))));
        // A store that is only read is not tested: the test would need permission to write.
        assert!(matches!(usable(None), Ok((false, None))));
        let (writable, warning) = usable(Some(Err(refused(true)))).expect("the run continues");
        let warning = warning.expect("a warning");
        assert!(!writable && warning.contains("500") && warning.contains("`use3d push`"), "{warning}");
        assert!(usable(Some(Err(refused(false)))).is_err());
    }
}
