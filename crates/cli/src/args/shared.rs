//! What several verbs take.

use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::Args;
use clap::builder::{RangedU64ValueParser, TypedValueParser};
use use3d_reconstruct::EngineChoice;

/// `--set` of a whole pipeline.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct Settings {
    /// What trains both stages and draws: auto, cpu, gpu or gpu:NAME (`use3d devices` lists them;
    /// default: the pipeline's, or cpu).
    #[arg(long, value_name = "ENGINE")]
    pub(crate) engine: Option<EngineChoice>,
    /// Set a parameter of a stage, e.g. `reconstruct.iterations=3000`; may be
    /// repeated. `use3d params` lists them.
    #[arg(long = "set", value_name = "STAGE.PARAMETER=VALUE")]
    pub(crate) set: Vec<String>,
}

impl Settings {
    /// All settings as `--set` has them; the engine is a parameter like any other, and
    /// one that is set for a stage wins.
    pub(crate) fn sets(&self) -> Vec<String> {
        let stages = ["reconstruct", "targets", "enhance", "render", "evaluate"];
        let engine =
            self.engine.iter().flat_map(|e| stages.iter().map(move |stage| format!("{stage}.engine={e}")));
        engine.chain(self.set.iter().cloned()).collect()
    }
}

/// A message about a setting that `--engine` stands for, by the flag that was typed.
pub(crate) fn as_typed(message: &str, engine: Option<&EngineChoice>) -> String {
    let Some(engine) = engine else { return message.to_string() };
    let typed = format!("--engine {engine}: ");
    let told = message.strip_prefix("--set ").and_then(|rest| {
        let (setting, rest) = rest.split_once(&format!("engine={engine}: "))?;
        let stage = setting.is_empty() || setting.ends_with('.') && !setting.contains(' ');
        // The parameter's name says nothing more.
        let parameter = [format!("`{setting}engine`: "), "`engine`: ".to_string()];
        let rest = parameter.iter().find_map(|name| rest.strip_prefix(name.as_str())).unwrap_or(rest);
        stage.then(|| typed + rest)
    });
    told.unwrap_or_else(|| message.to_string())
}

/// `--set` of one stage.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct StageSettings {
    /// Set a parameter of this stage, or `STAGE.PARAMETER` of one that it needs; may be
    /// repeated. `use3d params` lists them.
    #[arg(long = "set", value_name = "PARAMETER=VALUE")]
    pub(crate) set: Vec<String>,
}

/// What "enhanced" is learnt from, on the command line.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct CalibrationArgs {
    /// Learn from these pairs: two folders of images with equal file stems (they
    /// win over the pipeline file's).
    #[arg(long, num_args = 2, value_names = ["INPUT", "TARGET"], conflicts_with = "calibrator")]
    pairs: Vec<PathBuf>,
    /// Use this finished calibrator: `use3d calibrate`'s, or the authors'
    /// transition_calibrator.pth. Nothing is learnt then.
    #[arg(long, value_name = "FILE")]
    pub(crate) calibrator: Option<PathBuf>,
}

impl CalibrationArgs {
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

/// A pipeline, and what it is read with.
#[derive(Clone, Debug, Args)]
pub(crate) struct PipelineArgs {
    /// A pipeline file (.toml) or a capture folder.
    #[arg(value_name = "PIPELINE.toml|CAPTURE_DIR")]
    pub(crate) target: PathBuf,
    #[command(flatten)]
    pub(crate) settings: Settings,
    #[command(flatten)]
    pub(crate) calibration: CalibrationArgs,
    #[command(flatten)]
    pub(crate) cache: CacheArgs,
}

impl PipelineArgs {
    /// A pipeline as its file has it, in a cache.
    pub(crate) fn of(target: &Path, cache: &CacheArgs) -> Self {
        Self {
            target: target.to_path_buf(),
            settings: Settings::default(),
            calibration: CalibrationArgs::default(),
            cache: cache.clone(),
        }
    }
}

/// What may be replaced.
#[derive(Clone, Copy, Debug, Default, Args)]
pub(crate) struct Replace {
    /// Replace an earlier result in the same place: of folders only those that this program wrote and nobody
    /// changed, of files any regular one.
    #[arg(long)]
    pub(crate) force: bool,
}

/// A whole number from 1 to `most`.
pub(crate) fn count(most: u64) -> impl TypedValueParser<Value = usize> {
    // `most` fits wherever a `usize` has 32 bits.
    RangedU64ValueParser::<u64>::new().range(1..=most).map(|n| n as usize)
}

/// A time such as `90min`, `3h` or `3:50:00`, more than nothing.
pub(crate) fn time(text: &str) -> Result<Duration, String> {
    let time = use3d_cluster::time::parse(text)?;
    if time.is_zero() { Err("no time at all: give more than 0".to_string()) } else { Ok(time) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_engine_is_refused_by_the_flag_that_was_typed() {
        let engine = EngineChoice::Gpu(Some("vega".into()));
        let said = |message: &str| as_typed(message, Some(&engine));
        assert_eq!(said("--set engine=gpu:vega: `engine`: none"), "--engine gpu:vega: none");
        assert_eq!(said("--set reconstruct.engine=gpu:vega: `engine`: none"), "--engine gpu:vega: none");
        for other in ["--set iterations=x: a number", "scene.toml: engine=gpu:vega: none"] {
            assert_eq!((said(other), as_typed(other, None)), (other.to_string(), other.to_string()));
        }
    }
}
