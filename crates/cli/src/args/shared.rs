//! Arguments that several verbs share.

use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::Args;
use use3d_reconstruct::EngineChoice;
use use3d_stages::registry;
use use3d_workflow::{Registry, Stage};

/// The engine that computes.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct EngineArgs {
    /// The engine that trains and draws: auto, cpu, gpu or gpu:NAME (`use3d devices` lists them;
    /// default: the pipeline's, or cpu).
    #[arg(long, value_name = "ENGINE")]
    engine: Option<EngineChoice>,
    /// The same as `--engine gpu`.
    #[arg(long, conflicts_with = "engine")]
    gpu: bool,
}

impl EngineArgs {
    /// The engine, if one was given.
    pub(crate) fn choice(&self) -> Option<EngineChoice> {
        self.engine.clone().or_else(|| self.gpu.then_some(EngineChoice::Gpu(None)))
    }
}

/// The size of the photographs to work with, which sets the import's size.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct SizeArgs {
    /// Work with photographs of this size: scaled to cover it and cropped centrally
    /// (the same as `--set import.size=WxH`).
    #[arg(long, value_name = "WxH", conflicts_with = "max_side")]
    size: Option<String>,
    /// Work with photographs whose longer side has at most N pixels (the same as `--set import.max_side=N`).
    #[arg(long, value_name = "N", value_parser = count(MAX_SIDE), allow_negative_numbers = true)]
    max_side: Option<usize>,
}

/// The largest side of a photograph.
const MAX_SIDE: u64 = 65_535;

impl SizeArgs {
    /// The settings that the flags stand for.
    pub(crate) fn spelled(&self) -> Vec<Spelled> {
        let size = self.size.iter().map(|size| Spelled::new("--size", "import", "size", size));
        let side = self.max_side.iter().map(|n| Spelled::new("--max-side", "import", "max_side", n));
        size.chain(side).collect()
    }
}

/// A flag that stands for a setting.
#[derive(Clone, Debug)]
pub(crate) struct Spelled {
    flag: &'static str,
    stage: &'static str,
    key: &'static str,
    value: String,
}

impl Spelled {
    #[allow(clippy::needless_pass_by_value, reason = "callers give numbers, words and sizes alike")]
    pub(crate) fn new(
        flag: &'static str,
        stage: &'static str,
        key: &'static str,
        value: impl ToString,
    ) -> Self {
        Self { flag, stage, key, value: value.to_string() }
    }

    /// The engine as a setting of every stage that has one.
    pub(crate) fn engines(engine: Option<&EngineChoice>) -> Vec<Self> {
        let registry = engine.and_then(|_| registry().ok());
        let stages = registry.iter().flat_map(Registry::stages).filter(|stage| stage.device.is_some());
        let of = |stage: &Stage| Some(Self::new("--engine", stage.name(), "engine", engine?));
        stages.filter_map(of).collect()
    }

    /// The setting in the form of `--set`.
    pub(crate) fn set(&self) -> String {
        format!("{}.{}={}", self.stage, self.key, self.value)
    }
}

/// `--set` of a whole pipeline.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct Settings {
    #[command(flatten)]
    pub(crate) engine: EngineArgs,
    /// Set a parameter of a stage, e.g. `reconstruct.iterations=3000`; may be
    /// repeated. `use3d params` lists them.
    #[arg(long = "set", value_name = "STAGE.PARAMETER=VALUE")]
    pub(crate) set: Vec<String>,
}

impl Settings {
    /// All settings in the form of `--set`. The engine is a parameter like any other, and a value set for a
    /// stage wins.
    pub(crate) fn sets(&self) -> Vec<String> {
        self.spelled().iter().map(Spelled::set).chain(self.set.iter().cloned()).collect()
    }

    fn spelled(&self) -> Vec<Spelled> {
        Spelled::engines(self.engine.choice().as_ref())
    }
}

/// The most common settings of a pipeline, as flags.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct CommonArgs {
    /// Steps of stage 1 (the same as `--set reconstruct.iterations=N`).
    #[arg(long, value_name = "N", visible_alias = "steps", value_parser = count(MAX_STEPS), allow_negative_numbers = true)]
    pub(crate) iterations: Option<usize>,
    #[command(flatten)]
    pub(crate) size: SizeArgs,
}

/// The most steps of a training.
pub(super) const MAX_STEPS: u64 = 200_000_000;

impl CommonArgs {
    /// The settings that the flags stand for.
    pub(crate) fn spelled(&self) -> Vec<Spelled> {
        let steps = self.iterations.iter();
        let steps = steps.map(|n| Spelled::new("--iterations", "reconstruct", "iterations", n));
        steps.chain(self.size.spelled()).collect()
    }
}

/// Rewrites a message about a setting so that it names the flag that was typed.
pub(crate) fn as_typed(message: &str, spelled: &[Spelled]) -> String {
    let told = |Spelled { flag, key, value, .. }: &Spelled| {
        let rest = message.strip_prefix("--set ")?;
        let (setting, rest) = rest.split_once(&format!("{key}={value}: "))?;
        let stage = setting.is_empty() || setting.ends_with('.') && !setting.contains(' ');
        // The parameter's name adds nothing to the flag.
        let parameter = [format!("`{setting}{key}`: "), format!("`{key}`: ")];
        let rest = parameter.iter().find_map(|name| rest.strip_prefix(name.as_str())).unwrap_or(rest);
        stage.then(|| format!("{flag} {value}: {rest}"))
    };
    spelled.iter().find_map(told).unwrap_or_else(|| message.to_string())
}

/// `--set` of one stage.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct StageSettings {
    /// Set a parameter of this stage, or `STAGE.PARAMETER` of one that it needs; may be
    /// repeated. `use3d params` lists them.
    #[arg(long = "set", value_name = "PARAMETER=VALUE")]
    pub(crate) set: Vec<String>,
}

/// The source of the meaning of "enhanced", on the command line.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct CalibrationArgs {
    /// Learn from these pairs: two folders of images with equal names, apart from the extension (they replace
    /// those of the pipeline file).
    #[arg(long, num_args = 2, value_names = ["INPUT", "TARGET"], conflicts_with = "calibrator")]
    pairs: Vec<PathBuf>,
    /// Use this finished calibrator: from `use3d calibrate`, or the authors' transition_calibrator.pth.
    /// Nothing is learnt then.
    #[arg(long, value_name = "FILE")]
    pub(crate) calibrator: Option<PathBuf>,
}

impl CalibrationArgs {
    /// The arguments for these pairs or this calibrator.
    pub(crate) fn of(pairs: Option<(PathBuf, PathBuf)>, calibrator: Option<PathBuf>) -> Self {
        Self { pairs: pairs.map_or_else(Vec::new, |(input, target)| vec![input, target]), calibrator }
    }

    /// True if nothing was given.
    pub(crate) fn is_empty(&self) -> bool {
        self.pairs.is_empty() && self.calibrator.is_none()
    }

    /// The two folders of pairs, if they were given.
    pub(crate) fn pairs(&self) -> Option<(PathBuf, PathBuf)> {
        match self.pairs.as_slice() {
            [input, target] => Some((input.clone(), target.clone())),
            _ => None,
        }
    }
}

/// The cache.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct CacheArgs {
    /// The cache folder (default: the pipeline's, or ~/.cache/use3d).
    #[arg(long, env = "USE3D_CACHE", value_name = "DIR")]
    pub(crate) cache: Option<PathBuf>,
    /// The models folder (default: the pipeline's, or ./models).
    #[arg(long, env = "USE3D_MODELS", value_name = "DIR")]
    pub(crate) models: Option<PathBuf>,
    /// Read every input again instead of trusting unchanged sizes and times.
    #[arg(long)]
    pub(crate) rehash: bool,
}

/// A pipeline, with its settings and folders.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct PipelineArgs {
    /// A pipeline file (.toml) or a capture folder; for `run` also a film or a folder of photographs.
    #[arg(value_name = "PIPELINE.toml|CAPTURE_DIR")]
    pub(crate) target: PathBuf,
    #[command(flatten)]
    pub(crate) common: CommonArgs,
    #[command(flatten)]
    pub(crate) settings: Settings,
    #[command(flatten)]
    pub(crate) calibration: CalibrationArgs,
    #[command(flatten)]
    pub(crate) cache: CacheArgs,
}

impl PipelineArgs {
    /// All settings in the form of `--set`; those given by `--set` itself come last, and so win.
    pub(crate) fn sets(&self) -> Vec<String> {
        self.spelled().iter().map(Spelled::set).chain(self.settings.set.iter().cloned()).collect()
    }

    /// The settings that flags stand for.
    pub(crate) fn spelled(&self) -> Vec<Spelled> {
        self.common.spelled().into_iter().chain(self.settings.spelled()).collect()
    }

    /// A pipeline as in its file, with the given cache.
    pub(crate) fn of(target: &Path, cache: &CacheArgs) -> Self {
        Self { target: target.to_path_buf(), cache: cache.clone(), ..Self::default() }
    }
}

/// Permission to replace an earlier result.
#[derive(Clone, Copy, Debug, Default, Args)]
pub(crate) struct Replace {
    /// Replace an earlier result in the same place: folders only if this program wrote them and nobody
    /// changed them, and any regular file.
    #[arg(long)]
    pub(crate) force: bool,
}

/// A whole number from 1 to `most`.
pub(crate) fn count(most: u64) -> impl Fn(&str) -> Result<usize, String> + Clone + Send + Sync + 'static {
    move |text| {
        let number = text.parse::<usize>().ok().filter(|n| *n >= 1 && *n as u64 <= most);
        number.ok_or_else(|| format!("expected a whole number from 1 to {most}"))
    }
}

/// A number; its range is checked where it is used.
pub(crate) fn fraction(text: &str) -> Result<f32, String> {
    text.parse().map_err(|_| "expected a number, such as 0.5".to_string())
}

/// A port of this machine.
pub(crate) fn port(text: &str) -> Result<u16, String> {
    let port = text.parse::<u16>().ok().filter(|port| *port > 0);
    port.ok_or_else(|| "expected a whole number from 1 to 65535".to_string())
}

/// Parses a time above zero, such as `90min`, `3h` or `3:50:00`.
pub(crate) fn time(text: &str) -> Result<Duration, String> {
    let time = use3d_cluster::time::parse(text).map_err(|e| e.to_string())?;
    if time.is_zero() { Err("the time must be more than 0".to_string()) } else { Ok(time) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_engine_is_refused_by_the_flag_that_was_typed() {
        let engine = EngineChoice::Gpu(Some("vega".into()));
        let spelled = Spelled::engines(Some(&engine));
        let said = |message: &str| as_typed(message, &spelled);
        assert_eq!(said("--set engine=gpu:vega: `engine`: none"), "--engine gpu:vega: none");
        assert_eq!(said("--set reconstruct.engine=gpu:vega: `engine`: none"), "--engine gpu:vega: none");
        for other in ["--set iterations=x: a number", "scene.toml: engine=gpu:vega: none"] {
            assert_eq!((said(other), as_typed(other, &[])), (other.to_string(), other.to_string()));
        }
        let size = [Spelled::new("--size", "import", "size", "640")];
        let refused = "--set import.size=640: `import.size`: \"640\" is not a size";
        assert_eq!(as_typed(refused, &size), "--size 640: \"640\" is not a size");
    }
}
