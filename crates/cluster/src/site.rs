//! The facts of a site, `cluster.toml`: what a plan cannot know. All may be left out.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_build::FileError;
use use3d_build::gc::parse_bytes;

use super::ClusterError;
use super::time;

/// The facts of a site.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Site {
    /// The account that jobs are charged to.
    pub account: Option<String>,
    /// The partition that jobs go to.
    pub partition: Option<String>,
    /// Processors of a task.
    pub cpus: usize,
    /// Memory of a task whose stages never ran before, e.g. `8GB`.
    pub memory: String,
    /// Time of a task whose stages never ran before, e.g. `4h`.
    pub time: String,
    /// The longest time that a job may ask for, e.g. `24h`: what takes longer is asked for again.
    pub longest: String,
    /// Tasks of an array that run at once, at the most.
    pub at_once: usize,
    /// Tasks of an array, at the most: Slurm's `MaxArraySize` less one. What has
    /// more is cut into several arrays.
    pub largest_array: usize,
    /// How often a task that ran out of time is put into the queue again.
    pub requeues: usize,
    /// Lines of shell before the command: modules, variables.
    pub setup: Vec<String>,
    /// Further options of the scheduler, e.g. `--qos=low`.
    pub options: Vec<String>,
    /// The command, where it is not `use3d`.
    pub command: String,
    /// What tasks of a stage need that others do not, by its name; for the
    /// workers of `--layout workers`, `run`.
    pub stage: BTreeMap<String, Needs>,
}

/// What tasks of a stage need.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Needs {
    /// Another partition.
    pub partition: Option<String>,
    /// Another number of processors.
    pub cpus: Option<usize>,
    /// Memory, whatever the forecast.
    pub memory: Option<String>,
    /// Time, whatever the forecast.
    pub time: Option<String>,
    /// More options, e.g. `--gres=gpu:1`.
    pub options: Vec<String>,
    /// HyperQueue's resources besides processors and memory, e.g. `{ "gpus/nvidia" = 1 }`.
    pub resources: BTreeMap<String, u64>,
    /// More settings of `use3d run`, e.g. `["--set", "reconstruct.engine=gpu"]`.
    pub arguments: Vec<String>,
}

impl Default for Site {
    fn default() -> Self {
        Self {
            account: None,
            partition: None,
            cpus: 4,
            memory: "8GB".to_string(),
            time: "4h".to_string(),
            longest: "24h".to_string(),
            at_once: 8,
            largest_array: 1000,
            requeues: 50,
            setup: Vec::new(),
            options: Vec::new(),
            command: "use3d".to_string(),
            stage: BTreeMap::new(),
        }
    }
}

impl Site {
    /// Reads a site file; `stages` are the names that `[stage.NAME]` may have.
    ///
    /// # Errors
    /// What is wrong with it: file, field, expectation.
    pub fn read(path: &Path, stages: &[&str]) -> Result<Self, ClusterError> {
        let text = std::fs::read_to_string(path);
        let text = text.map_err(|source| FileError { path: path.to_path_buf(), doing: "read", source })?;
        Self::parse(&text, stages)
            .map_err(|reason| ClusterError::Site { file: path.display().to_string(), reason })
    }

    /// Of a site file's text.
    ///
    /// # Errors
    /// What is wrong with it, in words.
    pub fn parse(text: &str, stages: &[&str]) -> Result<Self, String> {
        let read = toml::Deserializer::parse(text).map_err(|e| e.to_string())?;
        let site: Self = serde_path_to_error::deserialize(read).map_err(|e| {
            let path = e.path().to_string();
            format!("`{path}`: {}", e.inner().message())
        })?;
        site.check(stages)?;
        Ok(site)
    }

    fn check(&self, stages: &[&str]) -> Result<(), String> {
        let positive = |field: &str, n: usize| {
            if n == 0 { Err(format!("`{field}` is 0; expected 1 or more")) } else { Ok(()) }
        };
        positive("cpus", self.cpus)?;
        positive("at_once", self.at_once)?;
        positive("largest_array", self.largest_array)?;
        let bytes = |field: &str, text: &str| match parse_bytes(text) {
            Ok(0) => Err(format!("`{field}` is nothing; expected a size such as 8GB")),
            Ok(_) => Ok(()),
            Err(reason) => Err(format!("`{field}`: {reason}")),
        };
        let long = |field: &str, text: &str| match time::parse(text) {
            Ok(time) if time < SHORTEST => Err(format!("`{field}` is {text}; expected 5min or more")),
            Ok(_) => Ok(()),
            Err(reason) => Err(format!("`{field}`: {reason}")),
        };
        bytes("memory", &self.memory)?;
        long("time", &self.time)?;
        long("longest", &self.longest)?;
        for (name, needs) in &self.stage {
            if name != WORKERS && !stages.contains(&name.as_str()) {
                let known = stages.join(", ");
                return Err(format!("`stage.{name}`: there is no such stage; there are: {known}, {WORKERS}"));
            }
            needs.cpus.map_or(Ok(()), |n| positive(&format!("stage.{name}.cpus"), n))?;
            needs.memory.as_ref().map_or(Ok(()), |m| bytes(&format!("stage.{name}.memory"), m))?;
            needs.time.as_ref().map_or(Ok(()), |t| long(&format!("stage.{name}.time"), t))?;
        }
        // Whatever stands in a script stands in a line of its own.
        let lines = [&self.account, &self.partition].into_iter().flatten();
        let lines = lines.chain(&self.options).chain(&self.setup).chain([&self.command]);
        let needs =
            self.stage.values().flat_map(|n| n.partition.iter().chain(&n.options).chain(&n.arguments));
        match lines.chain(needs).find(|line| line.chars().any(char::is_control)) {
            Some(line) => {
                Err(format!("{line:?} has a line break or another control character in it; remove it"))
            }
            None => Ok(()),
        }
    }

    /// What tasks of a stage, or the workers, need.
    pub fn needs(&self, stage: &str) -> Needs {
        self.stage.get(stage).cloned().unwrap_or_default()
    }
}

/// The name under which the tasks of `--layout workers`, and the one that ends a batch, stand in a site file.
pub const WORKERS: &str = "run";
/// No job asks for less: schedulers, modules and checkpoints take their time.
pub(crate) const SHORTEST: Duration = Duration::from_secs(300);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_site_is_read_and_what_is_wrong_is_named() {
        let text = r#"
            account = "reef"
            cpus = 16
            setup = ["module load cuda/12.4"]
            [stage.reconstruct]
            partition = "gpu"
            options = ["--gres=gpu:1"]
        "#;
        let site = Site::parse(text, &["import", "reconstruct"]).expect("right");
        assert_eq!((site.cpus, site.needs("reconstruct").partition.as_deref()), (16, Some("gpu")));
        assert_eq!(site.needs("import"), Needs::default());
        assert_eq!(Site::parse("", &[]), Ok(Site::default()));
        for (text, words) in [
            ("cpu = 3", "cpu"),
            ("cpus = 0", "`cpus` is 0"),
            ("largest_array = 0", "`largest_array` is 0"),
            ("cpus = \"many\"", "`cpus`"),
            ("memory = \"much\"", "`memory`: `much` is not a size"),
            ("time = \"soon\"", "`time`: `soon` is not a time"),
            ("longest = \"1min\"", "expected 5min or more"),
            ("[stage.fly]", "no such stage; there are: import, reconstruct, run"),
            ("setup = [\"one\\ntwo\"]", "line break"),
            ("[stage.import]\ncpus = 0", "`stage.import.cpus`"),
            ("x", "expected"),
        ] {
            let error = Site::parse(text, &["import", "reconstruct"]).expect_err(text);
            assert!(error.contains(words), "{text}: {error}");
        }
    }
}
