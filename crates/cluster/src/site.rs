//! The facts of a site, `cluster.toml`, which a plan cannot contain. All fields are optional.

use std::collections::BTreeMap;
use std::io;
use std::path::Path;
use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize, de};
use use3d_workflow::gc::{AmountError, parse_bytes};
use use3d_workflow::{ParameterError, read};

use super::ClusterError;
use super::time::{self, TimeError};

/// The facts of a site.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Site {
    /// The account that is charged for jobs.
    pub account: Option<String>,
    /// The partition in which jobs run.
    pub partition: Option<String>,
    /// Number of processors of a task.
    pub cpus: usize,
    /// Memory of a task whose stages never ran before, e.g. `8GB`.
    pub memory: String,
    /// Time of a task whose stages never ran before, e.g. `4h`.
    pub time: String,
    /// The longest time that a job may request, e.g. `24h`; longer work continues in another job.
    pub longest: String,
    /// Most tasks of an array that run at the same time.
    pub at_once: usize,
    /// Most tasks of an array: Slurm's `MaxArraySize` minus one. Larger arrays are cut into several.
    pub largest_array: usize,
    /// Number of times that a task which reached its time limit enters the queue again.
    pub requeues: usize,
    /// Lines of shell before the command: modules, variables.
    pub setup: Vec<String>,
    /// Further options of the scheduler, e.g. `--qos=low`.
    pub options: Vec<String>,
    /// The command, if it is not the program that submits: its name or path, or a list of words such as
    /// `["apptainer", "exec", "use3d.sif", "use3d"]`.
    #[serde(deserialize_with = "one_word_or_several")]
    #[schemars(with = "Option<Vec<String>>")]
    pub command: Option<Vec<String>>,
    /// Settings for tasks of a stage, by its name, that differ from those of other stages; for the workers of
    /// `--layout workers`, `run`.
    pub stage: BTreeMap<String, Needs>,
}

/// Settings for tasks of a stage.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Needs {
    /// Another partition.
    pub partition: Option<String>,
    /// Another number of processors.
    pub cpus: Option<usize>,
    /// Memory, instead of the forecast.
    pub memory: Option<String>,
    /// Time, instead of the forecast.
    pub time: Option<String>,
    /// More options, e.g. `--gres=gpu:1`.
    pub options: Vec<String>,
    /// HyperQueue's resources besides processors, e.g. `{ "gpus/nvidia" = 1 }`. Memory is requested as `mem`,
    /// in megabytes, unless it is named here; a resource of 0 is not requested.
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
            command: None,
            stage: BTreeMap::new(),
        }
    }
}

/// A scheduler, because some fields of a site are not for all schedulers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scheduler {
    /// Slurm.
    Slurm,
    /// HyperQueue.
    HyperQueue,
}

/// A fault in a site file.
#[derive(Debug, thiserror::Error)]
pub enum SiteError {
    /// The file cannot be read.
    #[error(
        "{0}; --cluster expects a file that describes the site (docs/reference/cluster.md shows one); without it \
         the defaults are used"
    )]
    Read(#[source] io::Error),
    /// The file is not TOML.
    #[error(transparent)]
    Toml(#[from] Box<toml::de::Error>),
    /// A field is unknown, or has a value of another type.
    #[error("`{}`: {}", .0.path, .0.message)]
    Form(Box<ParameterError>),
    /// The field of this name is outside its range: the value found, and the expected values.
    #[error("`{0}` is {1}; expected {2}")]
    Value(String, String, String),
    /// The field of this name is not a size.
    #[error("`{0}`: {1}")]
    Size(String, #[source] AmountError),
    /// The field of this name is not a time.
    #[error("`{0}`: {1}")]
    Time(String, #[source] TimeError),
    /// There is no stage of this name; there are the others.
    #[error("`stage.{0}`: there is no such stage; there are: {1}, {WORKERS}")]
    Stage(String, String),
    /// The field of this name has a word that is no option of the scheduler.
    #[error("`{0}`: `{1}` is not an option of sbatch; expected one such as --gres=gpu:1")]
    Option(String, String),
    /// A text that does not fit on a line.
    #[error("{0:?} has a line break or another control character in it; remove it")]
    Line(String),
}

impl SiteError {
    fn value(field: &str, found: &(impl ToString + ?Sized), expected: impl Into<String>) -> Self {
        Self::Value(field.into(), found.to_string(), expected.into())
    }
}

impl Site {
    /// Reads a site file; `stages` are the names that `[stage.NAME]` may have.
    ///
    /// # Errors
    /// The file is wrong: the message has the file, the field and the expected value.
    pub fn read(path: &Path, stages: &[&str]) -> Result<Self, ClusterError> {
        let wrong = |reason| ClusterError::Site { file: path.display().to_string(), reason };
        let text = std::fs::read_to_string(path).map_err(SiteError::Read);
        text.and_then(|text| Self::parse(&text, stages)).map_err(wrong)
    }

    /// Parses the text of a site file.
    ///
    /// # Errors
    /// The text is wrong.
    pub fn parse(text: &str, stages: &[&str]) -> Result<Self, SiteError> {
        let value: serde_json::Value = toml::from_str(text).map_err(Box::new)?;
        let site: Self = read(&value).map_err(|fault| SiteError::Form(Box::new(fault)))?;
        site.check(stages)?;
        Ok(site)
    }

    fn check(&self, stages: &[&str]) -> Result<(), SiteError> {
        let count = |field: &str, n: usize, most: usize| match n {
            0 => Err(SiteError::value(field, &n, "1 or more")),
            n if n > most => Err(SiteError::value(field, &n, format!("{most} or fewer"))),
            _ => Ok(()),
        };
        count("cpus", self.cpus, MOST_CPUS)?;
        count("at_once", self.at_once, usize::MAX)?;
        count("largest_array", self.largest_array, usize::MAX)?;
        let bytes = |field: &str, text: &str| match parse_bytes(text) {
            Ok(0) => Err(SiteError::value(field, &0, "a size such as 8GB")),
            Ok(_) => Ok(()),
            Err(fault) => Err(SiteError::Size(field.into(), fault)),
        };
        let long = |field: &str, text: &str| match time::parse(text) {
            Ok(time) if time < SHORTEST => Err(SiteError::value(field, text, "5min or more")),
            Ok(_) => Ok(()),
            Err(fault) => Err(SiteError::Time(field.into(), fault)),
        };
        bytes("memory", &self.memory)?;
        long("time", &self.time)?;
        long("longest", &self.longest)?;
        for (name, needs) in &self.stage {
            if name != WORKERS && !stages.contains(&name.as_str()) {
                return Err(SiteError::Stage(name.clone(), stages.join(", ")));
            }
            needs.cpus.map_or(Ok(()), |n| count(&format!("stage.{name}.cpus"), n, MOST_CPUS))?;
            needs.memory.as_ref().map_or(Ok(()), |m| bytes(&format!("stage.{name}.memory"), m))?;
            needs.time.as_ref().map_or(Ok(()), |t| long(&format!("stage.{name}.time"), t))?;
        }
        self.check_words()
    }

    /// Checks that every text can be written in its place in a script.
    fn check_words(&self) -> Result<(), SiteError> {
        let of_stages =
            |field: &str| self.stage.keys().map(|name| format!("stage.{name}.{field}")).collect::<Vec<_>>();
        let partitions = of_stages("partition").into_iter().zip(self.stage.values().map(|n| &n.partition));
        let named = [("account", &self.account), ("partition", &self.partition)];
        let named = named.map(|(field, name)| (field.to_string(), name)).into_iter().chain(partitions);
        for (field, name) in named {
            if name.as_ref().is_some_and(|name| name.trim().is_empty()) {
                return Err(SiteError::value(&field, "empty", "a name, or leave it out"));
            }
        }
        let options = of_stages("options").into_iter().zip(self.stage.values().map(|n| &n.options));
        for (field, options) in [("options".to_string(), &self.options)].into_iter().chain(options) {
            if let Some(option) = options.iter().find(|option| !option.starts_with('-')) {
                return Err(SiteError::Option(field, option.clone()));
            }
        }
        let command = self.command.as_deref();
        if command.is_some_and(|words| words.is_empty() || words.iter().any(|word| word.trim().is_empty())) {
            let expected = "a name such as use3d, or leave it out";
            return Err(SiteError::value("command", "empty or has an empty word", expected));
        }
        // Every text is written on a line of its own in a script.
        let lines = [&self.account, &self.partition].into_iter().flatten();
        let lines = lines.chain(&self.options).chain(&self.setup).chain(self.command.iter().flatten());
        let needs =
            self.stage.values().flat_map(|n| n.partition.iter().chain(&n.options).chain(&n.arguments));
        match lines.chain(needs).find(|line| line.chars().any(char::is_control)) {
            Some(line) => Err(SiteError::Line(line.clone())),
            None => Ok(()),
        }
    }

    /// The words of the command of a task: those of the file, else the path of this program, else its name.
    pub fn command(&self) -> Vec<String> {
        let own = || std::env::current_exe().ok()?.to_str().map(|path| vec![path.to_string()]);
        self.command.clone().or_else(own).unwrap_or_else(|| vec!["use3d".to_string()])
    }

    /// The settings of a stage, or of the workers.
    pub fn needs(&self, stage: &str) -> Needs {
        self.stage.get(stage).cloned().unwrap_or_default()
    }

    /// The fields that are set but that this scheduler does not support.
    pub fn unused(&self, scheduler: Scheduler) -> Vec<String> {
        let mut fields = Vec::new();
        let mut add = |field: String, is_set: bool| fields.extend(is_set.then_some(field));
        if scheduler == Scheduler::HyperQueue {
            add("account".into(), self.account.is_some());
            add("partition".into(), self.partition.is_some());
            add("options".into(), !self.options.is_empty());
            add("requeues".into(), self.requeues != Self::default().requeues);
        }
        for (name, needs) in &self.stage {
            match scheduler {
                Scheduler::Slurm => add(format!("stage.{name}.resources"), !needs.resources.is_empty()),
                Scheduler::HyperQueue => {
                    add(format!("stage.{name}.partition"), needs.partition.is_some());
                    add(format!("stage.{name}.options"), !needs.options.is_empty());
                }
            }
        }
        fields
    }
}

/// Reads a command as one word, or as a list of words. A word with spaces is refused: a shell would search
/// for a file of that name.
fn one_word_or_several<'de, D: de::Deserializer<'de>>(from: D) -> Result<Option<Vec<String>>, D::Error> {
    struct Words;
    impl<'de> de::Visitor<'de> for Words {
        type Value = Vec<String>;
        fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
            f.write_str("the command's name or path, or a list of its words")
        }
        fn visit_str<E: de::Error>(self, text: &str) -> Result<Self::Value, E> {
            if text.trim().contains(char::is_whitespace) {
                let words: Vec<&str> = text.split_whitespace().collect();
                return Err(E::custom(format!(
                    "`{text}` has spaces in it; write its words as a list: command = {words:?}"
                )));
            }
            Ok(vec![text.to_string()])
        }
        fn visit_seq<A: de::SeqAccess<'de>>(self, mut list: A) -> Result<Self::Value, A::Error> {
            let mut words = Vec::new();
            while let Some(word) = list.next_element()? {
                words.push(word);
            }
            Ok(words)
        }
    }
    from.deserialize_any(Words).map(Some)
}

/// The most processors, equal to the limit of `use3d --threads`.
const MOST_CPUS: usize = 1024;
/// The name in a site file for the tasks of `--layout workers` and for the last task of a batch.
pub const WORKERS: &str = "run";
/// The shortest time that a job requests: schedulers, modules and checkpoints need time.
pub(crate) const SHORTEST: Duration = Duration::from_secs(300);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_scheduler_has_no_place_for_is_named() {
        let text = r#"
            account = "reef"
            options = ["--qos=low"]
            [stage.import]
            partition = "gpu"
            resources = { "gpus/nvidia" = 1 }
        "#;
        let site = Site::parse(text, &["import"]).expect("right");
        assert_eq!(site.unused(Scheduler::HyperQueue), ["account", "options", "stage.import.partition"]);
        assert_eq!(site.unused(Scheduler::Slurm), ["stage.import.resources"]);
        assert_eq!(Site::default().unused(Scheduler::HyperQueue), Vec::<String>::new());
    }

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
        assert_eq!(Site::parse("", &[]).expect("right"), Site::default());
        let command = |text| Site::parse(text, &[]).expect("right").command.expect("given");
        assert_eq!(command("command = \"/proj/bin/use3d\""), ["/proj/bin/use3d"]);
        assert_eq!(command("command = [\"srun\", \"my tools/use3d\"]"), ["srun", "my tools/use3d"]);
        for (text, words) in [
            ("cpu = 3", "cpu"),
            ("cpus = 0", "`cpus` is 0"),
            ("largest_array = 0", "`largest_array` is 0"),
            ("cpus = \"many\"", "`cpus`: expected a whole number, 0 or more, found \"many\""),
            ("cpus = 99999999999", "expected 1024 or fewer"),
            ("account = \"\"", "`account` is empty"),
            ("[stage.import]\npartition = \" \"", "`stage.import.partition` is empty"),
            ("options = [\"gres=gpu:1\"]", "`options`: `gres=gpu:1` is not an option of sbatch"),
            ("[stage.import]\noptions = [\"gpu\"]", "`stage.import.options`"),
            (
                "command = \"apptainer exec use3d.sif use3d\"",
                r#"command = ["apptainer", "exec", "use3d.sif", "use3d"]"#,
            ),
            ("command = \"\"", "`command` is empty"),
            ("command = []", "`command` is empty"),
            (
                "command = 3",
                "`command`: expected the command's name or path, or a list of its words, found 3",
            ),
            ("memory = \"much\"", "`memory`: `much` is not a size"),
            ("time = \"soon\"", "`time`: `soon` is not a time"),
            ("longest = \"1min\"", "expected 5min or more"),
            ("[stage.fly]", "no such stage; there are: import, reconstruct, run"),
            ("setup = [\"one\\ntwo\"]", "line break"),
            ("[stage.import]\ncpus = 0", "`stage.import.cpus`"),
            ("x", "expected"),
        ] {
            let error = Site::parse(text, &["import", "reconstruct"]).expect_err(text).to_string();
            assert!(error.contains(words), "{text}: {error}");
        }
    }
}
