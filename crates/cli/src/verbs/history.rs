//! The history of a results folder: one small file for each run, `RESULTS/runs/0001.json` and so on.
//!
//! A run replaces the results of the run before in its folder; the work itself stays in the cache. The record
//! stores the arguments of the run and the artifacts it delivered. So `use3d results` can distinguish runs
//! and restore one, and `use3d run` takes a results folder in place of a capture or a pipeline.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use use3d_workflow::{Digest, Summary, machine};

use crate::args::{CalibrationArgs, CommonArgs, EngineArgs, PipelineArgs};
use crate::destination::{absolute, entries, path_text, word, write_text};
use crate::error::CliError;
use crate::verbs::loaded::Loaded;

const FORMAT: &str = "3d-use run";
const VERSION: u32 = 1;
/// The folder of the records below the results.
const FOLDER: &str = "runs";
/// The largest size of a record in bytes, more than any needs.
const MOST_BYTES: u64 = 1 << 24;
/// The most records that are read from a folder.
const MOST: usize = 100_000;

/// A run into a results folder.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct RunRecord {
    format: String,
    version: u32,
    /// Time when its results were last written into the folder, in seconds since 1970.
    pub(crate) delivered: u64,
    /// The command line.
    pub(crate) command: String,
    /// The pipeline file or capture folder.
    pub(crate) target: PathBuf,
    /// All settings in the form of `--set`.
    pub(crate) sets: Vec<String>,
    /// Only these scenes; all if empty.
    pub(crate) scenes: Vec<String>,
    /// Up to these stages; all where `None`.
    pub(crate) until: Option<Vec<String>>,
    /// The two folders of pairs.
    pub(crate) pairs: Option<(PathBuf, PathBuf)>,
    /// The finished calibrator.
    pub(crate) calibrator: Option<PathBuf>,
    /// The cache.
    pub(crate) cache: PathBuf,
    /// The models folder.
    pub(crate) models: Option<PathBuf>,
    /// The delivered artifacts.
    pub(crate) artifacts: Vec<DeliveredArtifact>,
}

/// An artifact of a run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct DeliveredArtifact {
    /// The stage.
    pub(crate) stage: String,
    /// The scene; empty for an artifact over all scenes.
    pub(crate) scene: String,
    /// The variant; empty where there are none.
    pub(crate) variant: String,
    /// Its key.
    pub(crate) key: Digest,
}

impl RunRecord {
    /// Makes the record of a finished run.
    pub(crate) fn of(
        args: &PipelineArgs,
        scenes: &[String],
        until: Option<&[String]>,
        loaded: &Loaded,
        summary: &Summary,
        command: String,
    ) -> Self {
        let made = summary.nodes.iter().filter_map(|node| {
            let key = node.artifact.as_ref()?.manifest.key;
            let (scene, variant) = (node.scene.clone(), node.variant.clone());
            Some(DeliveredArtifact { stage: node.stage.to_string(), scene, variant, key })
        });
        Self {
            format: FORMAT.into(),
            version: VERSION,
            delivered: machine::now(),
            command,
            target: absolute(&args.target),
            sets: args.sets(),
            scenes: scenes.to_vec(),
            until: until.map(<[String]>::to_vec),
            pairs: args.calibration.pairs().map(|(input, target)| (absolute(&input), absolute(&target))),
            calibrator: args.calibration.calibrator.as_deref().map(absolute),
            cache: absolute(&loaded.pipeline.cache),
            models: args.cache.models.as_deref().map(absolute),
            artifacts: made.collect(),
        }
    }

    fn read(path: &Path) -> Result<Self, String> {
        let size = std::fs::metadata(path).map_err(|e| e.to_string())?.len();
        if size > MOST_BYTES {
            return Err("it is too large to be the record of a run".into());
        }
        let bytes = std::fs::read(path).map_err(|e| e.to_string())?;
        let record: Self = serde_json::from_slice(&bytes).map_err(|e| e.to_string())?;
        if record.format != FORMAT || record.version != VERSION {
            return Err(format!("it is not a `{FORMAT}` of version {VERSION}"));
        }
        Ok(record)
    }

    /// The settings that differ from the defaults, in one line.
    pub(crate) fn settings(&self) -> String {
        let mut words = self.sets.clone();
        words.extend(self.pairs.iter().map(|(input, _)| format!("--pairs {}", path_text(input))));
        words.extend(self.calibrator.iter().map(|file| format!("--calibrator {}", path_text(file))));
        words.extend(self.scenes.iter().map(|scene| format!("--scene {scene}")));
        words.extend(self.until.iter().flatten().map(|stage| format!("--until {stage}")));
        if words.is_empty() { "defaults".into() } else { words.join(" ") }
    }

    /// The arguments of the run, for running it again; the settings of `more` come on top.
    pub(crate) fn arguments(&self, more: &PipelineArgs) -> PipelineArgs {
        let mut args = more.clone();
        args.target.clone_from(&self.target);
        args.settings.set = [self.sets.clone(), more.sets()].concat();
        (args.settings.engine, args.common) = (EngineArgs::default(), CommonArgs::default());
        if args.calibration.is_empty() {
            args.calibration = CalibrationArgs::of(self.pairs.clone(), self.calibrator.clone());
        }
        args.cache.cache.get_or_insert_with(|| self.cache.clone());
        if args.cache.models.is_none() {
            args.cache.models.clone_from(&self.models);
        }
        args
    }
}

/// The records of a results folder with their numbers, the oldest first. Unreadable files are left out with a
/// warning.
pub(crate) fn records(results: &Path) -> Vec<(usize, RunRecord)> {
    let read = |path: PathBuf| {
        let number = path.file_name()?.to_str()?.strip_suffix(".json")?.parse::<usize>().ok()?;
        let record = RunRecord::read(&path)
            .inspect_err(|error| tracing::warn!("{}: {error}; this run is not listed", path.display()));
        Some((number, record.ok()?))
    };
    let mut found: Vec<(usize, RunRecord)> =
        entries(&results.join(FOLDER)).take(MOST).filter_map(read).collect();
    found.sort_by_key(|(number, _)| *number);
    found
}

/// The run whose results are in the folder now.
pub(crate) fn current(records: &[(usize, RunRecord)]) -> Option<&(usize, RunRecord)> {
    records.iter().max_by_key(|(number, record)| (record.delivered, *number))
}

/// The run whose results are in a folder, if it is a results folder.
pub(crate) fn of_results(folder: &Path) -> Option<RunRecord> {
    let records = records(folder);
    current(&records).map(|(_, record)| record.clone())
}

/// Stores the record of a run whose results were delivered, and prints which results they replaced and how to
/// restore those.
pub(crate) fn keep(results: &Path, mut record: RunRecord, quiet: bool) -> Result<(), CliError> {
    let known = records(results);
    let before = current(&known);
    if before.is_some_and(|(_, old)| old.artifacts == record.artifacts) {
        // The folder shows these results already.
        return Ok(());
    }
    // Times are whole seconds; results that replace others within one second get the next second.
    if let Some((_, old)) = before {
        record.delivered = record.delivered.max(old.delivered.saturating_add(1));
    }
    let same = known.iter().rfind(|(_, old)| old.artifacts == record.artifacts);
    if let Some((_, old)) = same {
        // A restored run keeps its own record.
        record = RunRecord { delivered: record.delivered, ..old.clone() };
    }
    let number = same
        .map_or_else(|| known.last().map_or(1, |(last, _)| last.saturating_add(1)), |(number, _)| *number);
    let path = results.join(FOLDER).join(format!("{number:04}.json"));
    let text = serde_json::to_string_pretty(&record).map_err(CliError::failed)? + "\n";
    write_text("--out", &path, &text)?;
    if let Some((old, earlier)) = before.filter(|_| !quiet) {
        eprintln!(
            "these results replace those of run {old} ({}), which are still in the cache: `use3d results {} \
             {old}` restores them",
            earlier.settings(),
            word(results)
        );
    }
    Ok(())
}
