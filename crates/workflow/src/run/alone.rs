//! Runs one stage without the cache, as in `use3d reconstruct CAPTURE --out SCENE`, with the same code and
//! defaults as in a pipeline.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64};

use serde_json::Value;

use crate::cache::files;
use crate::cache::manifest::FileRecord;
use crate::cache::place::{self, PlaceError};
use crate::error::{BuildError, StageError};
use crate::plan::builder::Builder;
use crate::plan::graph::Graph;
use crate::plan::resolve::Outcome;
use crate::run::job::in_pool;
use crate::run::runner::RunOptions;
use crate::stage::context::{Log, StageContext};
use crate::stage::definition::Stage;
use crate::stage::events::Listener;
use crate::stage::inputs::StageInput;

/// A stage that is run by hand.
#[derive(Clone, Debug)]
pub struct Alone<'a> {
    /// Its parameters, see [`Stage::parameters`].
    pub parameters: &'a Value,
    /// Its inputs: role and path.
    pub inputs: Vec<(String, PathBuf)>,
    /// The folder for the result; it appears only when the stage is done.
    pub output: &'a Path,
    /// True if the result is kept; it then gets a record of its files.
    pub record: bool,
    /// True if an earlier result of this program in that place may be replaced.
    pub replace: bool,
    /// The folder for the checkpoints of a resumable stage; `None` keeps none.
    pub checkpoints: Option<PathBuf>,
    /// The seed.
    pub seed: u64,
    /// Threads to use.
    pub threads: usize,
    /// The flag that stops the stage when it is set.
    pub stop: Arc<AtomicBool>,
}

impl Stage {
    /// Runs the stage by itself.
    pub fn run_alone(&self, alone: Alone<'_>, listener: &Arc<dyn Listener>) -> Result<(), StageError> {
        let sibling = place::sibling(alone.output);
        let created = std::fs::create_dir_all(&sibling);
        created.map_err(|source| PlaceError::Io { path: alone.output.into(), doing: "write", source })?;
        let input = |(role, path)| StageInput { role, path, ..StageInput::default() };
        let context = StageContext {
            inputs: alone.inputs.into_iter().map(input).collect(),
            missing: Vec::new(),
            output: sibling.clone(),
            checkpoints: alone.checkpoints,
            seed: if self.seeded { alone.seed } else { 0 },
            threads: alone.threads.max(1),
            stop: alone.stop,
            node: 0,
            label: self.name.to_string(),
            listener: listener.clone(),
            log: Log::new(Box::new(std::io::sink())),
            resumed: AtomicU64::new(0),
            notes: None,
            reached: Arc::default(),
        };
        let ran = in_pool(context.threads, || (self.run)(&context, alone.parameters));
        let placed = ran.and_then(|()| {
            if alone.record {
                place::record(&sibling, None)?;
            }
            place::put(&sibling, alone.output, alone.replace).map_err(StageError::bad_input)
        });
        if placed.is_err() {
            let _ = std::fs::remove_dir_all(&sibling);
        }
        placed
    }
}

impl Builder {
    /// Runs a node again whose inputs are cached, into `scratch`, from the start (without checkpoints), and
    /// returns the records of its files.
    pub(crate) fn run_again(
        &self,
        graph: &Graph,
        node: usize,
        outcomes: &[Outcome],
        scratch: &Path,
        options: &RunOptions,
        listener: &Arc<dyn Listener>,
    ) -> Result<Result<Vec<FileRecord>, StageError>, BuildError> {
        let Ok(resolved) = self.resolve(graph, node, outcomes) else {
            return Ok(Err(StageError::message("its inputs are missing")));
        };
        let stage = &self.registry.stages()[graph.nodes[node].stage];
        let output = scratch.join("artifact");
        let checkpoints = resolved.checkpoints.map(|_| scratch.join("checkpoints"));
        if let Some(path) = &checkpoints {
            files::at(path, "create", std::fs::create_dir_all(path))?;
        }
        files::at(&output, "create", std::fs::create_dir_all(&output))?;
        let context = StageContext {
            inputs: resolved.inputs,
            missing: resolved.ingredients.missing,
            output: output.clone(),
            checkpoints,
            seed: graph.nodes[node].seed.unwrap_or(0),
            threads: options.cores.max(1),
            stop: options.stop.clone(),
            node,
            label: graph.nodes[node].label(),
            listener: listener.clone(),
            log: Log::new(Box::new(std::io::sink())),
            resumed: AtomicU64::new(0),
            notes: None,
            reached: Arc::default(),
        };
        let ran = in_pool(context.threads, || (stage.run)(&context, &graph.nodes[node].parameters));
        Ok(ran.and_then(|()| Ok(self.cache.seal(&output)?)))
    }
}
