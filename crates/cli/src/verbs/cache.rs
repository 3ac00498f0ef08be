//! The cache: cleaning up and verifying.

use std::collections::BTreeSet;
use std::path::Path;

use use3d_config::default_cache;
use use3d_pipeline::aged::clean_results;
use use3d_pipeline::destination::path_text;
use use3d_pipeline::loaded::{real, stages};
use use3d_workflow::Cache;
use use3d_workflow::gc::{AmountError, CleanOptions, parse_age, parse_bytes};
use use3d_workflow::machine::bytes;
use use3d_workflow::place::parent;

use crate::App;
use crate::args::{CacheArgs, GcArgs, VerifyArgs};
use crate::error::{Done, WorkError};
use crate::output::{counted, show};

fn cache(args: &CacheArgs) -> Result<Cache, WorkError> {
    let folder = match &args.cache {
        Some(folder) if !folder.is_dir() => {
            let what = "there is no such folder; expected a cache";
            return Err(WorkError::Input(format!("--cache {}: {what}", path_text(folder))));
        }
        // Looking at a cache must not make one of another folder.
        Some(folder) if !Cache::is_cache(folder) => {
            let what =
                "this folder is no cache of use3d, because it has no folder v1; give the folder of a cache";
            return Err(WorkError::Input(format!("--cache {}: {what}", path_text(folder))));
        }
        Some(folder) => folder.clone(),
        None => default_cache().map_err(WorkError::input)?,
    };
    Ok(Cache::open(&folder, args.rehash).map_err(WorkError::input)?.with_promises(stages()?.promises()))
}

pub(crate) fn gc(args: &GcArgs) -> Done {
    let wrong = |flag: &'static str| move |error: AmountError| WorkError::Input(format!("{flag}: {error}"));
    let max_bytes = args.max_bytes.as_deref().map(parse_bytes).transpose().map_err(wrong("--max-bytes"))?;
    let older_than = args.older_than.as_deref().map(parse_age).transpose().map_err(wrong("--older-than"))?;
    if let (Some(out), Some(age)) = (&args.results, older_than) {
        let cleaning = clean_results(out, age, args.sweep.dry_run).map_err(WorkError::input)?;
        show(&cleaning, args.sweep.json)?;
        return Ok(());
    }
    let mut keep = BTreeSet::new();
    // Without --cache, the cache is the one named by the pipelines to keep.
    let mut named: Option<(&Path, Cache)> = None;
    for pipeline in &args.sweep.keep {
        let loaded = args.sweep.cache.request(pipeline).look()?;
        keep.extend(loaded.builder.plan(&loaded.graph, None).keys());
        let cache = loaded.builder.cache;
        match &named {
            None => named = Some((pipeline, cache)),
            Some((_, first)) if real(first.root()) == real(cache.root()) => {}
            Some((other, first)) => {
                return Err(WorkError::Input(format!(
                    "--keep {}: its cache is {}, but the cache of {} is {}; choose the one to clean with \
                     --cache",
                    path_text(pipeline),
                    path_text(parent(cache.root())),
                    path_text(other),
                    path_text(parent(first.root()))
                )));
            }
        }
    }
    let options = CleanOptions { max_bytes, older_than, keep, dry_run: args.sweep.dry_run };
    let cache = named.map_or_else(|| cache(&args.sweep.cache), |(_, cache)| Ok(cache))?;
    let cleaning = cache.clean(&options);
    if let Some(limit) = max_bytes.filter(|limit| cleaning.left > *limit) {
        eprintln!(
            "warning: {} are left, more than the {} of --max-bytes: they are kept by --keep, in use by \
             running processes, or could not be removed",
            bytes(cleaning.left),
            bytes(limit)
        );
    }
    show(&cleaning, args.sweep.json)?;
    match cleaning.failed.len() {
        0 => Ok(()),
        n => Err(WorkError::Failed(format!(
            "{} could not be removed, see above; run gc as the user who owns {}, or make it writable",
            counted(n, "item", "items"),
            path_text(parent(cache.root()))
        ))),
    }
}

/// Parses a share such as `5%` or `0.05`.
fn share(text: &str) -> Result<f64, WorkError> {
    let number = match text.trim().strip_suffix('%') {
        Some(percent) => percent.trim().parse::<f64>().map(|p| p / 100.0),
        None => text.trim().parse::<f64>(),
    };
    match number {
        Ok(share) if (0.0..=1.0).contains(&share) => Ok(share),
        _ => Err(WorkError::Input(format!("--sample {text}: expected a share such as 5% or 0.05"))),
    }
}

pub(crate) fn verify(app: &App, args: &VerifyArgs) -> Done {
    let share = args.sample.as_deref().map(share).transpose()?;
    let request = args.settings.request(args.target.as_deref().unwrap_or(Path::new("")));
    let loaded = match &args.target {
        Some(_) => Some(request.open()?),
        None => {
            if let Some(sample) = &args.sample {
                let what = "name the pipeline file or capture whose stages should be computed again";
                return Err(WorkError::Input(format!("--sample {sample}: {what}")));
            }
            let given = &request.options;
            if !given.sets.is_empty() || given.pairs.is_some() || given.calibrator.is_some() {
                let what =
                    "--set, --engine, --pairs and --calibrator need a pipeline file or capture: name it too";
                return Err(WorkError::input(what));
            }
            None
        }
    };
    let mut found = match &loaded {
        // The cache that the pipeline file names.
        Some(loaded) => loaded.builder.cache.verify_all(true),
        None => cache(&args.settings.cache)?.verify_all(true),
    };
    if let (Some(loaded), Some(share)) = (&loaded, share) {
        let options = app.host.options();
        let again = loaded.builder.verify_sample(&loaded.graph, share, &options, &app.host.listener);
        let again = again.map_err(WorkError::failed)?;
        (found.held, found.recomputed) = (again.held, again.recomputed);
        (found.agreed, found.varied) = (again.agreed, again.varied);
        found.not_compared = again.not_compared;
        found.problems.extend(again.problems);
        found.interrupted = again.interrupted;
    }
    show(&found, args.json)?;
    if found.held.is_some_and(|held| held.cached == 0) && !found.interrupted {
        return Err(WorkError::failed(
            "nothing of this pipeline is in the cache, so nothing was computed again; was it run with other settings \
             (--set, --engine, --pairs, --calibrator) or into another --cache?",
        ));
    }
    match (found.problems.is_empty(), found.interrupted, found.repaired) {
        (true, true, _) => Err(WorkError::Stopped),
        (true, false, _) => Ok(()),
        (false, _, 0) => Err(WorkError::failed("the cache has problems; nothing was moved or changed")),
        (false, ..) => Err(WorkError::failed(
            "the cache has problems; damaged results were moved aside, and the next run computes them again",
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_are_percentages_or_fractions() {
        assert_eq!(share("5%").unwrap(), 0.05);
        assert_eq!(share("0.25").unwrap(), 0.25);
        assert!(share("150%").is_err() && share("x").is_err());
    }
}
