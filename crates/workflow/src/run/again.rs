//! Runs a node again whose inputs are cached, to compare its result with the cached one.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;

use crate::cache::files;
use crate::cache::manifest::FileRecord;
use crate::error::{BuildError, StageError};
use crate::plan::builder::Builder;
use crate::plan::graph::Graph;
use crate::plan::resolve::Outcome;
use crate::run::job::in_pool;
use crate::run::runner::RunOptions;
use crate::stage::context::{Log, StageContext};
use crate::stage::events::Listener;

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
        let (ran, _) = in_pool(context.threads, || (stage.run)(&context, &graph.nodes[node].parameters));
        Ok(ran.and_then(|()| Ok(self.cache.seal(&output)?)))
    }
}
