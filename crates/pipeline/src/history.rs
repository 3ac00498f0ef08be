//! The history of a results folder: one small file for each run, `RESULTS/runs/0001.json` and so on.
//!
//! A run replaces the results of the run before in its folder; the work itself stays in the cache. The record
//! stores the arguments of the run and the artifacts it delivered. So `use3d results` can distinguish runs
//! and restore one, and `use3d run` takes a results folder in place of a capture or a pipeline.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use use3d_judge::scores::{Method, SceneScores};
use use3d_stages::{SCORES, read_json};
use use3d_workflow::cache::Lookup;
use use3d_workflow::{Cache, Digest, Summary, machine};

use crate::WorkError;
use crate::destination::{OUT, absolute, entries, path_text, word, write_text};
use crate::loaded::PipelineRequest;
use use3d_config::LoadOptions;

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
pub struct RunRecord {
    format: String,
    version: u32,
    /// Time when its results were last written into the folder, in seconds since 1970.
    pub delivered: u64,
    /// Time when they were first written there; 0 in records of earlier versions.
    #[serde(default)]
    made: u64,
    /// The command line.
    pub command: String,
    /// The pipeline file or capture folder.
    pub target: PathBuf,
    /// All settings in the form of `--set`.
    pub sets: Vec<String>,
    /// Only these scenes; all if empty.
    pub scenes: Vec<String>,
    /// Up to these stages; all where `None`.
    pub until: Option<Vec<String>>,
    /// The two folders of pairs.
    pub pairs: Option<(PathBuf, PathBuf)>,
    /// The finished calibrator.
    pub calibrator: Option<PathBuf>,
    /// The cache.
    pub cache: PathBuf,
    /// The models folder.
    pub models: Option<PathBuf>,
    /// The delivered artifacts.
    pub artifacts: Vec<DeliveredArtifact>,
}

/// An artifact of a run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DeliveredArtifact {
    /// The stage.
    pub stage: String,
    /// The scene; empty for an artifact over all scenes.
    pub scene: String,
    /// The variant; empty where there are none.
    pub variant: String,
    /// Its key.
    pub key: Digest,
}

impl RunRecord {
    /// Makes the record of a finished run of `request` up to `until`, whose cache is `cache`.
    pub fn of(
        request: &PipelineRequest,
        until: Option<&[String]>,
        cache: &Path,
        summary: &Summary,
        command: String,
    ) -> Self {
        let made = summary.nodes.iter().filter_map(|node| {
            let key = node.artifact.as_ref()?.manifest.key;
            let (scene, variant) = (node.scene.clone(), node.variant.clone());
            Some(DeliveredArtifact { stage: node.stage.to_string(), scene, variant, key })
        });
        let options = &request.options;
        Self {
            format: FORMAT.into(),
            version: VERSION,
            delivered: machine::now(),
            made: machine::now(),
            command,
            target: absolute(&request.target),
            sets: options.sets.clone(),
            scenes: options.scenes.clone(),
            until: until.map(<[String]>::to_vec),
            pairs: options.pairs.as_ref().map(|(input, target)| (absolute(input), absolute(target))),
            calibrator: options.calibrator.as_deref().map(absolute),
            cache: absolute(cache),
            models: options.models.as_deref().map(absolute),
            artifacts: made.collect(),
        }
    }

    fn read(path: &Path) -> Result<Self, WorkError> {
        let size = std::fs::metadata(path).map_err(WorkError::input)?.len();
        if size > MOST_BYTES {
            return Err(WorkError::input("it is too large to be the record of a run"));
        }
        let bytes = std::fs::read(path).map_err(WorkError::input)?;
        let record: Self = serde_json::from_slice(&bytes).map_err(WorkError::input)?;
        if record.format != FORMAT || record.version != VERSION {
            return Err(WorkError::Input(format!("it is not a `{FORMAT}` of version {VERSION}")));
        }
        Ok(record)
    }

    /// The settings that differ from the defaults, in one line.
    pub fn settings(&self) -> String {
        let mut words = self.sets.clone();
        words.extend(self.pairs.iter().map(|(input, _)| format!("--pairs {}", path_text(input))));
        words.extend(self.calibrator.iter().map(|file| format!("--calibrator {}", path_text(file))));
        words.extend(self.scenes.iter().map(|scene| format!("--scene {scene}")));
        words.extend(self.until.iter().flatten().map(|stage| format!("--until {stage}")));
        if words.is_empty() { "defaults".into() } else { words.join(" ") }
    }

    /// The request of the run, for running it again; the settings of `more` come on top.
    pub fn request(&self, more: &PipelineRequest) -> PipelineRequest {
        let given = &more.options;
        let (pairs, calibrator) = match (&given.pairs, &given.calibrator) {
            (None, None) => (self.pairs.clone(), self.calibrator.clone()),
            (pairs, calibrator) => (pairs.clone(), calibrator.clone()),
        };
        let options = LoadOptions {
            sets: [&self.sets[..], &given.sets].concat(),
            cache: given.cache.clone().or_else(|| Some(self.cache.clone())),
            models: given.models.clone().or_else(|| self.models.clone()),
            scenes: given.scenes.clone(),
            pairs,
            calibrator,
        };
        let target = self.target.clone();
        PipelineRequest { target, options, rehash: more.rehash, ..PipelineRequest::default() }
    }

    /// The folder of an artifact of the run, if it is still in the cache.
    pub fn folder_of(&self, made: &DeliveredArtifact) -> Option<PathBuf> {
        let cache = self.cache.is_dir().then(|| Cache::open(&self.cache, false).ok()).flatten()?;
        match cache.lookup(&made.stage, &made.key) {
            Ok(Lookup::Whole(artifact)) => Some(artifact.path.clone()),
            _ => None,
        }
    }
}

/// The records of a results folder with their numbers, the oldest first. Unreadable files are left out with a
/// warning.
pub fn records(results: &Path) -> Vec<(usize, RunRecord)> {
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
pub fn current(records: &[(usize, RunRecord)]) -> Option<&(usize, RunRecord)> {
    records.iter().max_by_key(|(number, record)| (record.delivered, *number))
}

/// The run whose results are in a folder, if it is a results folder.
pub fn of_results(folder: &Path) -> Option<RunRecord> {
    let records = records(folder);
    current(&records).map(|(_, record)| record.clone())
}

/// Stores the record of a run whose results were delivered into `results`. Returns the run whose results they
/// replaced, in words that say how to restore those.
///
/// # Errors
/// The record cannot be written.
pub fn keep(results: &Path, mut record: RunRecord) -> Result<Option<String>, WorkError> {
    let known = records(results);
    let before = current(&known);
    if before.is_some_and(|(_, old)| old.artifacts == record.artifacts) {
        // The folder shows these results already.
        return Ok(None);
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
    let text = serde_json::to_string_pretty(&record).map_err(WorkError::failed)? + "\n";
    write_text("--out", &path, &text)?;
    Ok(before.map(|(old, earlier)| {
        format!(
            "these results replace those of run {old} ({}), which are still in the cache: `use3d results {} \
             {old}` restores them",
            earlier.settings(),
            word(results)
        )
    }))
}

/// The results folder for a name below `./use3d-out` or a path.
///
/// # Errors
/// No run wrote its results there; the message lists the folders that have some.
pub fn folder(named: &Path) -> Result<PathBuf, WorkError> {
    let below = Path::new(OUT).join(named);
    let found = [named.to_path_buf(), below].into_iter().find(|path| !records(path).is_empty());
    found.ok_or_else(|| {
        let there: Vec<String> = all().iter().map(|path| path_text(path)).collect();
        let known = match &there[..] {
            [] => format!("there are none in ./{OUT} either; `use3d run CAPTURE_DIR` makes some"),
            there => format!("there are: {}", there.join(", ")),
        };
        WorkError::Input(format!("{}: no results of `use3d run` are there; {known}", path_text(named)))
    })
}

/// Every results folder below `./use3d-out`.
pub fn all() -> Vec<PathBuf> {
    let mut found: Vec<PathBuf> = entries(Path::new(OUT)).filter(|path| !records(path).is_empty()).collect();
    found.sort();
    found
}

/// A run in the form in which it is printed.
#[derive(Debug, Serialize)]
pub struct RunLine {
    /// The number that restores the run.
    pub run: usize,
    /// True if its results are in the folder now.
    pub shown: bool,
    /// Time when they were first written there, UTC.
    pub delivered: String,
    /// The command line.
    pub command: String,
    /// The settings that differ from the defaults.
    pub settings: String,
    /// True if all of its artifacts are still in the cache.
    pub kept: bool,
    /// PSNR of the held-out views of the first scene, decibels.
    pub psnr: Option<f64>,
}

/// The runs into a results folder, the oldest first.
pub fn lines(results: &Path) -> Vec<RunLine> {
    let records = records(results);
    let current = current(&records).map(|(number, _)| *number);
    let line = |(run, record): &(usize, RunRecord)| {
        let psnr = || {
            let evaluated = record.artifacts.iter().find(|made| made.stage == "evaluate")?;
            let scores: SceneScores = read_json(&record.folder_of(evaluated)?.join(SCORES)).ok()?;
            scores.mean(Method::Reconstruction, "psnr")?.value()
        };
        // A restored run keeps its date.
        let first = if record.made > 0 { record.made } else { record.delivered };
        let mut delivered = machine::utc(first);
        delivered.truncate("2026-01-01 00:00".len());
        RunLine {
            run: *run,
            shown: current == Some(*run),
            delivered,
            command: record.command.clone(),
            settings: record.settings(),
            kept: record.artifacts.iter().all(|made| record.folder_of(made).is_some()),
            psnr: psnr(),
        }
    };
    records.iter().map(line).collect()
}
