//! The last record of every node: the data for `status`, `why` and the forecasts. It is never part of a
//! result.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::cache::artifacts::Cache;
use crate::cache::files;
use crate::cache::key::{Ingredients, Key};
use crate::cache::task::ClusterTask;
use crate::error::FileError;
use crate::plan::graph::Node;
use use3d_code::digest::Digest;

/// An artifact that a node once had.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Made {
    /// Its key.
    pub key: Key,
    /// The ingredients of the key.
    pub ingredients: Ingredients,
    /// Digest of its payload.
    pub content: Digest,
    /// Time of its first use (UTC).
    pub at: String,
}

/// A failure.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Failure {
    /// The key that was to be made; `None` when an input could not be read.
    pub key: Option<Key>,
    /// The reason.
    pub reason: String,
    /// The path of its log.
    pub log: PathBuf,
    /// Time of the failure (UTC).
    pub at: String,
    /// The task of a scheduler in which it failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub task: Option<ClusterTask>,
}

/// The record of a node.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// The artifact it had last.
    pub last: Option<Made>,
    /// The artifact before it, with another key.
    pub before: Option<Made>,
    /// The failure after it, if the last run failed.
    pub failure: Option<Failure>,
}

impl Record {
    /// Returns the failure if it belongs to this key (or to an input).
    pub fn failed(&self, key: Option<Key>) -> Option<&Failure> {
        self.failure.as_ref().filter(|f| f.key.is_none() || key.is_none() || f.key == key)
    }
}

/// The folder of durations, with one file per machine.
const TIMINGS: &str = "timings";

impl Cache {
    /// The path of a node's record or log; `kind` is `history` or `logs`.
    fn node_path(&self, kind: &str, pipeline: &str, node: &Node, extension: &str) -> PathBuf {
        let folder =
            self.root().join(kind).join(safe(pipeline)).join(safe(&node.scene)).join(safe(&node.variant));
        folder.join(format!("{}.{extension}", node.stage_name))
    }

    /// The path of a node's log.
    pub fn log_path(&self, pipeline: &str, node: &Node) -> PathBuf {
        self.node_path("logs", pipeline, node, "log")
    }

    /// Reads the record of a node; an unreadable record counts as an empty one.
    pub fn record(&self, pipeline: &str, node: &Node) -> Record {
        self.record_as(pipeline, node)
    }

    /// Reads the parts of a node's record that `T` has.
    fn record_as<T: Default + DeserializeOwned>(&self, pipeline: &str, node: &Node) -> T {
        let path = self.node_path("history", pipeline, node, "json");
        let bytes = self.files().read(&path).ok();
        bytes.and_then(|bytes| serde_json::from_slice(&bytes).ok()).unwrap_or_default()
    }

    /// Returns a reader of the records of a pipeline's nodes, or of parts of them. A scene without a folder
    /// has none.
    pub(crate) fn records<T>(&self, pipeline: &str) -> impl Fn(&Node) -> T
    where
        T: Default + DeserializeOwned,
    {
        let folder = self.root().join("history").join(safe(pipeline));
        let names = files::entries(&folder).filter_map(|entry| entry.file_name().into_string().ok());
        let scenes: BTreeSet<String> = names.collect();
        move |node| match scenes.contains(&safe(&node.scene)) {
            true => self.record_as(pipeline, node),
            false => T::default(),
        }
    }

    pub(crate) fn write_record(&self, pipeline: &str, node: &Node, record: &Record) -> Result<(), FileError> {
        let bytes = serde_json::to_vec(record).unwrap_or_default();
        files::write_atomic(self.files(), &self.node_path("history", pipeline, node, "json"), &bytes)
    }

    /// Reads all records of all pipelines, to find the artifacts in use.
    pub(crate) fn all_records(&self) -> Vec<Record> {
        let walk = walkdir::WalkDir::new(self.root().join("history")).sort_by_file_name();
        walk.into_iter()
            .filter_map(Result::ok)
            .filter(|e| e.path().extension().is_some_and(|x| x == "json"))
            .filter_map(|e| serde_json::from_slice(&std::fs::read(e.path()).ok()?).ok())
            .collect()
    }

    /// Appends a duration. If the line cannot be written, only the forecast gets worse.
    pub(crate) fn add_timing(&self, timing: &Timing) {
        if let Ok(mut line) = serde_json::to_vec(timing) {
            line.push(b'\n');
            // Appending is safe among the processes of one machine, but not between two machines on a network
            // file system. So every machine has a file of its own.
            let path = self.root().join(TIMINGS).join(format!("{}.jsonl", self.node.machine()));
            let appended = self.files().append(&path, &line);
            if appended.is_err_and(|e| e.kind() == std::io::ErrorKind::NotFound)
                && self.files().create_dir_all(&self.root().join(TIMINGS)).is_ok()
            {
                let _ = self.files().append(&path, &line);
            }
        }
    }

    pub(crate) fn timings(&self) -> Timings {
        let list = files::entries(&self.root().join(TIMINGS));
        // The file of earlier versions comes first, because its lines are older.
        let mut paths: Vec<PathBuf> = list.map(|entry| entry.path()).collect();
        paths.sort();
        paths.insert(0, self.root().join("timings.jsonl"));
        let mut all: Vec<Timing> = Vec::new();
        for text in paths.iter().filter_map(|path| self.files().read(path).ok()) {
            let text = String::from_utf8_lossy(&text);
            all.extend(text.lines().filter_map(|line| serde_json::from_str::<Timing>(line).ok()));
        }
        all.sort_by_key(|timing| timing.at);
        let mut by_stage: BTreeMap<String, Vec<Timing>> = BTreeMap::new();
        for timing in all {
            by_stage.entry(timing.stage.clone()).or_default().push(timing);
        }
        Timings { by_stage }
    }
}

/// Largest number of bytes of a folder's name; file systems allow 255.
const MOST_BYTES: usize = 200;
/// Number of bytes that a longer name keeps before its digest.
const KEPT_BYTES: usize = 150;

/// Converts a name to a folder name: every byte but letters, digits, `-`, `_` and inner dots becomes `%` and
/// two hexadecimal digits. The end of a long name is replaced by its digest.
fn safe(name: &str) -> String {
    if name.is_empty() {
        return "_".to_string();
    }
    let mut out = String::new();
    for (i, byte) in name.bytes().enumerate() {
        let plain = byte.is_ascii_alphanumeric()
            || byte == b'-'
            || (byte == b'_' && name.len() > 1)
            || (byte == b'.' && i > 0);
        out.push_str(&if plain { char::from(byte).to_string() } else { format!("%{byte:02X}") });
    }
    if out.len() > MOST_BYTES {
        out.truncate(KEPT_BYTES);
        out.push_str(&format!("-{}", Digest::of(name.as_bytes()).short()));
    }
    out
}

/// Duration of one run of a stage, without the work that was found in checkpoints.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Timing {
    pub(crate) stage: String,
    pub(crate) scene: String,
    /// Product of the parameters that set the length of the work; 1 if there are none.
    pub(crate) length: f64,
    /// Bytes of its inputs.
    pub(crate) bytes: u64,
    pub(crate) seconds: f64,
    pub(crate) peak_memory: u64,
    /// Bytes of its artifact.
    pub(crate) output: u64,
    /// Time of the run, in seconds since 1970 by the machine's clock; forecasts use the latest runs.
    #[serde(default)]
    pub(crate) at: u64,
}

pub(crate) struct Timings {
    by_stage: BTreeMap<String, Vec<Timing>>,
}

/// The estimated cost of a stage, from earlier records of the same stage.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Forecast {
    /// Seconds (the median).
    pub seconds: f64,
    /// The shortest of the records in seconds, scaled in the same way.
    pub least: f64,
    /// The longest of the records in seconds, scaled in the same way.
    pub most: f64,
    /// Bytes it will add to the cache.
    pub output: u64,
    /// Memory in bytes.
    pub peak_memory: u64,
    /// Number of records used.
    pub records: usize,
    /// True if the records are of the same scene; those of other scenes may be of another size.
    pub own: bool,
}

impl Timings {
    /// Estimates from the last records of the same scene if there are any, else of all scenes; scaled by
    /// length.
    pub(crate) fn forecast(&self, stage: &str, scene: &str, length: f64) -> Option<Forecast> {
        let all = self.by_stage.get(stage)?;
        let own: Vec<&Timing> = all.iter().filter(|t| t.scene == scene && !scene.is_empty()).collect();
        let used: Vec<&Timing> = if own.is_empty() { all.iter().collect() } else { own };
        let used = &used[used.len().saturating_sub(9)..];
        let mut seconds: Vec<f64> = used
            .iter()
            .map(|t| if t.length > 0.0 { t.seconds * length / t.length } else { t.seconds })
            .collect();
        seconds.sort_by(f64::total_cmp);
        Some(Forecast {
            seconds: seconds[seconds.len() / 2],
            least: seconds[0],
            most: seconds[seconds.len() - 1],
            output: used.iter().map(|t| t.output).max()?,
            peak_memory: used.iter().map(|t| t.peak_memory).max()?,
            records: used.len(),
            own: scene.is_empty() || all.iter().any(|t| t.scene == scene),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_become_distinct_safe_folders() {
        for (name, expected) in
            [("", "_"), ("_", "%5F"), ("IUI3-RedSea", "IUI3-RedSea"), ("../x", "%2E.%2Fx"), ("é", "%C3%A9")]
        {
            assert_eq!(safe(name), expected);
        }
        // File systems refuse folders with longer names.
        let [one, other] = ["ы".repeat(60) + "a", "ы".repeat(60) + "b"].map(|name| safe(&name));
        assert!(one.len() < 255 && other.len() < 255 && one != other, "{one} {other}");
    }

    #[test]
    fn forecasts_prefer_the_scene_and_scale_with_length() {
        let timing = |scene: &str, length: f64, seconds: f64| Timing {
            stage: "reconstruct".to_string(),
            scene: scene.to_string(),
            length,
            bytes: 0,
            seconds,
            peak_memory: 5,
            output: 7,
            at: 0,
        };
        let list = vec![timing("a", 100.0, 10.0), timing("b", 100.0, 30.0), timing("a", 200.0, 24.0)];
        let timings = Timings { by_stage: BTreeMap::from([("reconstruct".to_string(), list)]) };
        let own = timings.forecast("reconstruct", "b", 200.0).expect("records");
        assert_eq!((own.seconds, own.records, own.own), (60.0, 1, true));
        let all = timings.forecast("reconstruct", "new", 100.0).expect("records");
        assert_eq!((all.seconds, all.least, all.most, all.records), (12.0, 10.0, 30.0, 3));
        assert!(!all.own);
        assert!(timings.forecast("import", "a", 1.0).is_none());
    }

    #[test]
    fn each_machine_keeps_durations_in_a_file_of_its_own() {
        let dir = tempfile::tempdir().unwrap();
        let timing = |at: u64| Timing {
            stage: "import".to_string(),
            scene: "a".to_string(),
            length: 1.0,
            bytes: 0,
            seconds: at as f64,
            peak_memory: 0,
            output: 0,
            at,
        };
        let open = |host: &str| {
            let node = crate::cache::node::Node::elsewhere(host, crate::cache::node::Clock::system());
            Cache::open(dir.path(), false).unwrap().as_node(node)
        };
        let (east, west) = (open("east"), open("west"));
        for (cache, at) in [(&east, 10), (&west, 5), (&east, 30), (&west, 20)] {
            cache.add_timing(&timing(at));
        }
        // Earlier versions wrote one file, without times.
        let old = r#"{"stage":"import","scene":"a","length":1.0,"bytes":0,"seconds":1.0,"peak_memory":0,"output":0}"#;
        std::fs::write(east.root().join("timings.jsonl"), old).unwrap();
        let read: Vec<u64> = west.timings().by_stage["import"].iter().map(|t| t.at).collect();
        assert_eq!(read, [0, 5, 10, 20, 30]);
        assert_eq!(std::fs::read_dir(east.root().join(TIMINGS)).unwrap().count(), 2);
    }
}
