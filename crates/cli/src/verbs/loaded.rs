//! A pipeline that is read from a file or made for a capture, with its builder and graph.

use std::path::{Path, PathBuf};

use use3d_cluster::slurm;
use use3d_pipeline::config::{LoadOptions, Pipeline, for_capture, load};
use use3d_stages::registry;
use use3d_workflow::{Builder, Cache, Graph, Registry};

use crate::args::{PipelineArgs, as_typed};
use crate::destination::{absolute, path_text};
use crate::error::{CliError, Done};

/// The table of stages.
pub(crate) fn stages() -> Result<Registry, CliError> {
    registry().map_err(CliError::failed)
}

/// A pipeline with the builder and graph to work on it.
pub(crate) struct Loaded {
    pub(crate) pipeline: Pipeline,
    pub(crate) builder: Builder,
    pub(crate) graph: Graph,
}

impl Loaded {
    /// Fails, before anything is computed, if the run would have to fail: weights, pairs or a calibrator are
    /// missing, or settings conflict.
    pub(crate) fn nothing_lacks(&self, until: Option<&[String]>, only: Option<&[(String, String)]>) -> Done {
        let gaps = self.builder.gaps(&self.graph, until, only);
        if gaps.is_empty() { Ok(()) } else { Err(CliError::input(gaps)) }
    }
}

/// Loads a pipeline file, or makes a pipeline for a capture folder, and opens its cache.
pub(crate) fn open(args: &PipelineArgs, scenes: &[String]) -> Result<Loaded, CliError> {
    let registry = stages()?;
    let pipeline = read(&registry, args, scenes)?;
    outside_captures(&pipeline)?;
    let cache = Cache::open(&pipeline.cache, args.cache.rehash).map_err(CliError::input)?;
    let graph = Graph::new(&registry, &pipeline.batch).map_err(CliError::input)?;
    Ok(Loaded { pipeline, builder: Builder::new(registry, cache.asking(slurm::is_over())), graph })
}

/// Loads a pipeline file, or makes a pipeline for a capture folder. The cache is not touched.
pub(crate) fn read(
    registry: &Registry,
    args: &PipelineArgs,
    scenes: &[String],
) -> Result<Pipeline, CliError> {
    let PipelineArgs { target, calibration, cache, .. } = args;
    let options = LoadOptions {
        sets: args.sets(),
        cache: cache.cache.clone(),
        models: cache.models.clone(),
        scenes: scenes.to_vec(),
        pairs: calibration.pairs(),
        calibrator: calibration.calibrator.clone(),
    };
    let pipeline = if target.is_dir() {
        for_capture(registry, target, &options)
    } else if target.is_file() {
        if let Some(what) = no_pipeline(target) {
            return Err(CliError::Input(format!("{}: {what}", target.display())));
        }
        load(registry, target, &options)
    } else {
        let what = "there is no such pipeline file (.toml) or capture folder";
        return Err(CliError::Input(format!("{}: {what}", target.display())));
    };
    pipeline.map_err(|error| CliError::Input(as_typed(&error.to_string(), &args.spelled())))
}

/// Refuses a cache inside the folder of a capture. It would lie beside the photographs, and in a prepared
/// capture, where every file counts, it would change the input of its own results.
fn outside_captures(pipeline: &Pipeline) -> Done {
    let cache = real(&pipeline.cache);
    let captures = pipeline.batch.scenes.iter().filter_map(|s| s.externals.get("capture")?.as_ref().ok());
    match captures.into_iter().find(|capture| cache.starts_with(real(capture))) {
        None => Ok(()),
        Some(capture) => Err(CliError::Input(format!(
            "--cache {}: it would lie in the capture {}; choose a folder outside",
            path_text(&pipeline.cache),
            path_text(capture)
        ))),
    }
}

/// Returns an absolute path without links in the part of it that exists.
pub(crate) fn real(path: &Path) -> PathBuf {
    let path = absolute(path);
    let there = path.ancestors().find_map(|part| Some((part, part.canonicalize().ok()?)));
    match there {
        Some((part, real)) => path.strip_prefix(part).map_or(real.clone(), |rest| real.join(rest)),
        None => path,
    }
}

/// Names the kind of a file that is no pipeline file or capture folder, and the next step for it.
fn no_pipeline(file: &Path) -> Option<&'static str> {
    if use3d_prepare::is_film(file) {
        return Some(
            "a film is not a capture yet: `use3d run FILM` or `use3d prepare FILM --out CAPTURE_DIR` makes one of it",
        );
    }
    let extension = file.extension()?.to_string_lossy().to_lowercase();
    Some(match extension.as_str() {
        "png" | "jpg" | "jpeg" | "tif" | "tiff" | "exr" | "webp" | "heic" | "bmp" | "gif" => {
            "one picture is not a capture: give the folder with the images and their cameras' model"
        }
        "json" if file.file_name().is_some_and(|name| name == "transforms.json") => {
            "give the folder that transforms.json (nerfstudio) lies in, not the file (docs/guide/other-programs.md)"
        }
        "xml" | "psx" | "psz" => {
            "give a folder with Metashape's exported cameras (File > Export > Export Cameras, Agisoft XML) and the photographs \
             (docs/guide/other-programs.md)"
        }
        "rcproj" => {
            "a project file of RealityScan (RealityCapture) is not read: export its cameras as CSV or XMP and its points \
             as PLY beside the photographs, and give that folder (docs/guide/other-programs.md)"
        }
        "json" => {
            "this is not a pipeline file (.toml): give the capture's folder, with images and a model of their cameras \
             (docs/guide/captures.md)"
        }
        _ => return None,
    })
}
