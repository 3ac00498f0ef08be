//! `use3d results`: lists the runs whose results were written into a folder, and restores one of them.

use std::path::{Path, PathBuf};

use use3d_pipeline::destination::{OUT, path_text, word};
use use3d_pipeline::history::{self, RunLine};

use crate::App;
use crate::args::ResultsArgs;
use crate::error::{Done, WorkError};
use crate::output::json;
use crate::verbs::run;

/// `use3d results`.
pub(crate) fn run(app: &App, args: &ResultsArgs) -> Done {
    let folders = match &args.name {
        Some(name) => vec![history::folder(name)?],
        None => history::all(),
    };
    if let (Some(number), [results]) = (args.run, &folders[..]) {
        return bring_back(app, results, number);
    }
    if folders.is_empty() && !args.json {
        return Err(WorkError::Input(format!(
            "there are no results in ./{OUT}; `use3d run CAPTURE_DIR` makes some, or name their folder"
        )));
    }
    if args.json {
        let document =
            |results: &PathBuf| serde_json::json!({ "results": results, "runs": history::lines(results) });
        return json(&folders.iter().map(document).collect::<Vec<_>>());
    }
    for results in &folders {
        println!("{}", path_text(results));
        for RunLine { run, shown, delivered, settings, kept, psnr, .. } in history::lines(results) {
            let mark = if shown { "shown now" } else { "" };
            let psnr = psnr.map_or_else(String::new, |psnr| format!("{psnr:.2} dB"));
            let gone = if kept { "" } else { "   (no longer complete in the cache)" };
            println!("  {run:>3}  {delivered}  {psnr:>8}  {mark:<9}  {settings}{gone}");
        }
    }
    Ok(())
}

/// Writes the results of an earlier run into their folder again; nothing is computed.
fn bring_back(app: &App, results: &Path, number: usize) -> Done {
    let records = history::records(results);
    let Some((_, record)) = records.iter().find(|(known, _)| *known == number) else {
        let known: Vec<String> = records.iter().map(|(number, _)| number.to_string()).collect();
        return Err(WorkError::Input(format!(
            "{}: there is no run {number}; there are: {}",
            path_text(results),
            known.join(", ")
        )));
    };
    run::again(app, record, results, false).map_err(|error| match error {
        WorkError::Input(what) => WorkError::Input(format!("run {number} of {}: {what}", word(results))),
        other => other,
    })
}
