//! A pipeline that is read from a file or made for a capture, with its builder and graph.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use use3d_cluster::slurm;
use use3d_stages::registry;
use use3d_workflow::graph::{SceneVariant, cell_name};
use use3d_workflow::{BatchScene, BuildError, Builder, Cache, Graph, Registry};

use crate::WorkError;
use crate::destination::{absolute, path_text};
use crate::spelled::{Spelled, as_typed};
use use3d_config::{LoadOptions, Pipeline, for_capture, from_text, load, shipped_as};

/// The table of stages.
///
/// # Errors
/// The sources of a stage are not in the table of code digests.
pub fn stages() -> Result<Registry, WorkError> {
    registry().map_err(WorkError::failed)
}

/// A pipeline as a user asks for it: a file or a capture folder, with the settings of its run.
#[derive(Clone, Debug, Default)]
pub struct PipelineRequest {
    /// The pipeline file or capture folder.
    pub target: PathBuf,
    /// Settings, folders and scenes. Its settings contain those of `flags`.
    pub options: LoadOptions,
    /// The flags among the settings, so that a message names the flag that was typed.
    pub flags: Vec<Spelled>,
    /// True if every input is read again, instead of trusting unchanged sizes and times.
    pub rehash: bool,
    /// True for a command that computes nothing, and so opens no device.
    pub only_looks: bool,
}

impl PipelineRequest {
    /// Reads the pipeline. The cache is not touched.
    ///
    /// # Errors
    /// There is no such file or folder, or it is refused.
    pub fn read(&self, registry: &Registry) -> Result<Pipeline, WorkError> {
        let Self { target, options, .. } = self;
        let refused = |what: &str| Err(WorkError::Input(format!("{}: {what}", target.display())));
        let pipeline = if target.is_dir() {
            for_capture(registry, target, options)
        } else if target.is_file() {
            if let Some(what) = no_pipeline(target) {
                return refused(what);
            }
            load(registry, target, options)
        } else if let Some(text) = shipped_as(target) {
            from_text(registry, &text, target, options)
        } else {
            return refused(
                "there is no such file or folder; give a film, a folder with photographs, or a pipeline file (.toml)",
            );
        };
        pipeline.map_err(|error| WorkError::Input(as_typed(&error.to_string(), &self.flags)))
    }

    /// Reads the pipeline, and opens its cache.
    ///
    /// # Errors
    /// As [`PipelineRequest::read`], or the cache cannot be opened or lies in a capture.
    pub fn open(&self) -> Result<Loaded, WorkError> {
        let registry = stages()?;
        let pipeline = self.read(&registry)?;
        outside_captures(&pipeline)?;
        let cache = Cache::open(&pipeline.cache, self.rehash).map_err(WorkError::input)?;
        let graph = Graph::new(&registry, &pipeline.batch).map_err(WorkError::input)?;
        let builder = Builder::new(registry, cache.asking(slurm::is_over()));
        let builder = if self.only_looks { builder.only_looking() } else { builder };
        Ok(Loaded { pipeline, builder, graph })
    }

    /// Reads the pipeline, and opens its cache, for a command that computes nothing.
    ///
    /// # Errors
    /// As [`PipelineRequest::open`].
    pub fn look(self) -> Result<Loaded, WorkError> {
        Self { only_looks: true, ..self }.open()
    }
}

/// A pipeline with the builder and graph to work on it.
pub struct Loaded {
    /// The scenes, variants and parameters.
    pub pipeline: Pipeline,
    /// Plans and runs it.
    pub builder: Builder,
    /// The nodes of its stages.
    pub graph: Graph,
}

impl Loaded {
    /// Fails, before anything is computed, if the run would have to fail: weights, pairs or a calibrator are
    /// missing, or settings conflict.
    ///
    /// # Errors
    /// The list of everything that is missing.
    pub fn nothing_lacks(
        &self,
        until: Option<&[String]>,
        only: Option<&[SceneVariant]>,
    ) -> Result<(), WorkError> {
        let gaps = self.builder.gaps(&self.graph, until, only);
        if gaps.is_empty() { Ok(()) } else { Err(WorkError::input(gaps)) }
    }

    /// The capture folder of a scene, if the pipeline knows it.
    pub fn capture_of(&self, scene: &str) -> Option<&Path> {
        let scene = self.pipeline.batch.scenes.iter().find(|known| known.name == scene)?;
        scene.externals.get("capture")?.as_deref().ok()
    }

    /// The scenes and variants of names in the form `SCENE` or `SCENE@VARIANT`; `None` for no names.
    ///
    /// # Errors
    /// A name that the pipeline does not have, with the most similar one.
    pub fn cells(&self, named: &[String]) -> Result<Option<Vec<SceneVariant>>, WorkError> {
        let of_scenes = self.graph.nodes.iter().filter(|n| !n.scene.is_empty());
        let cells: BTreeSet<SceneVariant> = of_scenes.map(|n| (n.scene.clone(), n.variant.clone())).collect();
        let find = |name: &String| {
            let (scene, variant) = name.split_once('@').unwrap_or((name, ""));
            let cell = (scene.to_string(), variant.to_string());
            if cells.contains(&cell) {
                return Ok(cell);
            }
            let known: Vec<String> = cells.iter().map(|(s, v)| cell_name(s, v)).collect();
            let known = known.iter().map(String::as_str);
            Err(WorkError::input(BuildError::unknown("scene and variant", name, known)))
        };
        let found: Vec<SceneVariant> = named.iter().map(find).collect::<Result<_, _>>()?;
        Ok((!found.is_empty()).then_some(found))
    }

    /// True if a scene's cameras are found in this film or folder first.
    fn is_footage(&self, path: &Path) -> bool {
        let footage = |scene: &BatchScene| Some(scene.externals.get("footage")?.as_deref() == Ok(path));
        self.pipeline.batch.scenes.iter().any(|scene| footage(scene) == Some(true))
    }

    /// Refuses a folder of results inside the cache, or among the files of a capture, where the next run
    /// would take them for photographs.
    ///
    /// # Errors
    /// The place is refused, with the folder that it lies in.
    pub fn check_out(&self, out: &Path) -> Result<(), WorkError> {
        let (cache, place) = (&self.pipeline.cache, real(out));
        if place.starts_with(real(cache)) {
            return Err(WorkError::Input(format!(
                "--out {}: it would lie in the cache {}; choose a folder outside",
                path_text(out),
                path_text(cache)
            )));
        }
        for capture in captures(&self.pipeline) {
            let Ok(below) = place.strip_prefix(real(capture)) else { continue };
            let first = below.components().next();
            // Every file beside photographs without cameras counts.
            let all = self.is_footage(capture);
            if all || first.is_some_and(|first| READ.iter().any(|read| first.as_os_str() == *read)) {
                return Err(WorkError::Input(format!(
                    "--out {}: this is inside the files of the capture {}; choose a folder outside it",
                    path_text(&place),
                    path_text(capture)
                )));
            }
        }
        Ok(())
    }
}

/// Folders of a capture that the import reads.
const READ: [&str; 4] = ["images", "masks", "depth", "sparse"];

/// The captures of a pipeline, and the footage of scenes without cameras.
fn captures(pipeline: &Pipeline) -> impl Iterator<Item = &PathBuf> {
    pipeline.batch.scenes.iter().flat_map(|scene| {
        let named = ["capture", "footage"].into_iter();
        named.filter_map(|name| scene.externals.get(name)?.as_ref().ok())
    })
}

/// Refuses a cache inside the folder of a capture. It would lie beside the photographs, and in a prepared
/// capture, where every file counts, it would change the input of its own results.
fn outside_captures(pipeline: &Pipeline) -> Result<(), WorkError> {
    let cache = real(&pipeline.cache);
    match captures(pipeline).find(|capture| cache.starts_with(real(capture))) {
        None => Ok(()),
        Some(capture) => Err(WorkError::Input(format!(
            "--cache {}: it would lie in the capture {}; choose a folder outside",
            path_text(&pipeline.cache),
            path_text(capture)
        ))),
    }
}

/// Returns an absolute path without links in the part of it that exists.
pub fn real(path: &Path) -> PathBuf {
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
            "a film is not a capture yet, and this needs one: `use3d prepare FILM --out CAPTURE_DIR` makes it (`use3d run \
             FILM` makes it first, and then the scene)",
        );
    }
    let extension = file.extension()?.to_string_lossy().to_lowercase();
    Some(match extension.as_str() {
        "png" | "jpg" | "jpeg" | "tif" | "tiff" | "exr" | "webp" | "heic" | "bmp" | "gif" => {
            "one picture is not a capture: give the folder with the images and their cameras' model"
        }
        "json" if file.file_name().is_some_and(|name| name == "transforms.json") => {
            "give the folder that transforms.json (nerfstudio) lies in, not the file (docs/reference/other-programs.md)"
        }
        "xml" | "psx" | "psz" => {
            "give a folder with Metashape's exported cameras (File > Export > Export Cameras, Agisoft XML) and the photographs \
             (docs/reference/other-programs.md)"
        }
        "rcproj" => {
            "a project file of RealityScan (RealityCapture) is not read: export its cameras as CSV or XMP and its points \
             as PLY beside the photographs, and give that folder (docs/reference/other-programs.md)"
        }
        "json" => {
            "this is not a pipeline file (.toml): give the capture's folder, with images and a model of their cameras \
             (docs/reference/captures.md)"
        }
        "toml" => return None,
        _ => "expected a film, a folder with photographs, or a pipeline file (.toml)",
    })
}
