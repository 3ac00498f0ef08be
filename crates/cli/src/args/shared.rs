//! Arguments that several verbs share.

use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::Args;
use use3d_config::{LoadOptions, shipped_file};
use use3d_pipeline::loaded::PipelineRequest;
use use3d_pipeline::spelled::Spelled;
use use3d_reconstruct::EngineChoice;

use crate::error::{Done, WorkError};

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

/// The method and the preset.
#[derive(Clone, Debug, Default, Args)]
struct PresetArgs {
    /// Train this method with its authors' schedule: 3dgs, seasplat, water-splatting, plenodium, 3d-uir,
    /// marinestd-gs, 3d-use.
    #[arg(long, value_name = "NAME")]
    method: Option<String>,
    /// Take the values of this preset in place of the defaults (`use3d params --preset NAME` lists them).
    #[arg(long, value_name = "NAME")]
    preset: Option<String>,
}

impl PresetArgs {
    /// The settings that the flags stand for.
    fn spelled(&self) -> impl Iterator<Item = Spelled> {
        let method = self.method.as_deref().map(|name| Spelled::new("--method", "", "method", name));
        method.into_iter().chain(self.preset.as_deref().map(Spelled::preset))
    }
}

/// `--set` of a whole pipeline.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct Settings {
    #[command(flatten)]
    pub(crate) engine: EngineArgs,
    #[command(flatten)]
    preset: PresetArgs,
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
        let engines = Spelled::engines(self.engine.choice().as_ref());
        engines.into_iter().chain(self.preset.spelled()).collect()
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

/// `--set` of one stage.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct StageSettings {
    #[command(flatten)]
    preset: PresetArgs,
    /// Set a parameter of this stage, or `STAGE.PARAMETER` of one that it needs; may be
    /// repeated. `use3d params` lists them.
    #[arg(long = "set", value_name = "PARAMETER=VALUE")]
    set: Vec<String>,
}

impl StageSettings {
    /// The settings that `flags` and the preset stand for.
    pub(crate) fn spelled(&self, flags: Vec<Spelled>) -> Vec<Spelled> {
        self.preset.spelled().chain(flags).collect()
    }

    /// These settings, with a models folder.
    pub(crate) fn options(&self, models: Option<&PathBuf>) -> LoadOptions {
        LoadOptions { sets: self.set.clone(), models: models.cloned(), ..LoadOptions::default() }
    }
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

impl CacheArgs {
    /// A pipeline as in its file, with this cache.
    pub(crate) fn request(&self, target: &Path) -> PipelineRequest {
        let (cache, models) = (self.cache.clone(), self.models.clone());
        let options = LoadOptions { cache, models, ..LoadOptions::default() };
        PipelineRequest {
            target: shipped_file(target),
            options,
            rehash: self.rehash,
            ..PipelineRequest::default()
        }
    }
}

/// The settings and folders of a pipeline's run.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct PipelineSettings {
    #[command(flatten)]
    common: CommonArgs,
    #[command(flatten)]
    settings: Settings,
    #[command(flatten)]
    calibration: CalibrationArgs,
    #[command(flatten)]
    pub(crate) cache: CacheArgs,
}

impl PipelineSettings {
    /// The pipeline of `target` with these settings. Those given by `--set` itself come last, and so win.
    pub(crate) fn request(&self, target: &Path) -> PipelineRequest {
        let mut request = self.cache.request(target);
        request.flags = self.common.spelled().into_iter().chain(self.settings.spelled()).collect();
        let flags = request.flags.iter().map(Spelled::set);
        request.options.sets = flags.chain(self.settings.set.iter().cloned()).collect();
        request.options.pairs = self.calibration.pairs();
        request.options.calibrator.clone_from(&self.calibration.calibrator);
        request
    }
}

/// A pipeline, with its settings and folders.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct PipelineArgs {
    /// A pipeline file (.toml) or a capture folder; for `run` also a film or a folder of photographs.
    #[arg(value_name = "PIPELINE.toml|CAPTURE_DIR")]
    pub(crate) target: PathBuf,
    #[command(flatten)]
    pub(crate) settings: PipelineSettings,
}

impl PipelineArgs {
    /// The pipeline of these arguments.
    pub(crate) fn request(&self) -> PipelineRequest {
        self.settings.request(&self.target)
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
pub(crate) fn count(most: u64) -> impl Fn(&str) -> Result<usize, WorkError> + Clone + Send + Sync + 'static {
    move |text| {
        let number = text.parse::<usize>().ok().filter(|n| *n >= 1 && *n as u64 <= most);
        number.ok_or_else(|| WorkError::Input(format!("expected a whole number from 1 to {most}")))
    }
}

/// A number; its range is checked where it is used.
pub(crate) fn fraction(text: &str) -> Result<f32, WorkError> {
    text.parse().map_err(|_| WorkError::input("expected a number, such as 0.5"))
}

/// Refuses shares that are not between 0 and 1, by their flags.
pub(crate) fn check_shares(shares: &[(&str, f32)]) -> Done {
    match shares.iter().find(|(_, value)| !(0.0..=1.0).contains(value)) {
        Some((flag, value)) => Err(WorkError::Input(format!("{flag} {value}: expected 0 to 1"))),
        None => Ok(()),
    }
}

/// A port of this machine.
pub(crate) fn port(text: &str) -> Result<u16, WorkError> {
    let port = text.parse::<u16>().ok().filter(|port| *port > 0);
    port.ok_or_else(|| WorkError::input("expected a whole number from 1 to 65535"))
}

/// Parses a time above zero, such as `90min`, `3h` or `3:50:00`.
pub(crate) fn time(text: &str) -> Result<Duration, WorkError> {
    let time = use3d_cluster::time::parse(text).map_err(WorkError::input)?;
    if time.is_zero() { Err(WorkError::input("the time must be more than 0")) } else { Ok(time) }
}
