//! A build system for computations that take hours. It defines stages, cache keys and artifacts, and it plans
//! runs, runs stages and keeps the cache.
//!
//! The inputs are a [`Registry`] of stages and a [`Batch`] of scenes. The outputs are artifacts in a
//! [`Cache`] and a [`Summary`] of the run. The crate contains none of the computations, and it reads no
//! pipeline files.
//!
//! A [`Stage`] is data and one pure function. The data are its name, the crates whose code it depends on, its
//! parameters and its inputs; the function fills one folder. From these the builder derives a [`key`]: a
//! digest of the stage's code, parameters and the *content* of its inputs. The folder of a key is computed
//! once and never changes. A stage whose inputs came out the same as before is not run again, whatever
//! happened upstream.
//!
//! ```
//! use std::sync::Arc;
//! use use3d_build::code::CodeTable;
//! use use3d_build::{
//!     Batch, Cache, Builder, Graph, Listener, Registry, RunOptions, BatchScene, Scope, Silent, Stage
//! };
//!
//! #[derive(Default, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
//! #[serde(deny_unknown_fields, default)]
//! struct Import { upper_case: bool }
//!
//! let import = Stage::new("import", Scope::Scene, |context, parameters: &Import| {
//!     let text = std::fs::read_to_string(context.input("capture")?.join("words.txt"))?;
//!     let text = if parameters.upper_case { text.to_uppercase() } else { text };
//!     Ok(std::fs::write(context.output().join("words.txt"), text)?)
//! })
//! .external("capture", "capture")                 // a folder that the pipeline file names
//! .made_of(&[], &[]);                             // its code, for the key
//! let count = Stage::new("count", Scope::Scene, |context, _: &Import| {
//!     let text = std::fs::read_to_string(context.input("words")?.join("words.txt"))?;
//!     Ok(std::fs::write(context.output().join("count"), text.split(' ').count().to_string())?)
//! })
//! .input("words", "import");                      // another stage's artifact
//!
//! let folder = tempfile::tempdir()?;
//! let capture = folder.path().join("capture");
//! std::fs::create_dir(&capture)?;
//! std::fs::write(capture.join("words.txt"), "clear water")?;
//!
//! let builder = Builder::new(
//!     Registry::new(vec![import, count], &CodeTable::default())?,
//!     Cache::open(&folder.path().join("cache"), false)?
//! );
//! let mut batch = Batch { name: "words".into(), seed: 42, ..Batch::default() };
//! batch.scenes.push(BatchScene {
//!     name: "reef".into(), externals: [("capture".into(), Ok(capture))].into(), ..BatchScene::default()
//! });
//!
//! let listener: Arc<dyn Listener> = Arc::new(Silent);
//! let graph = Graph::new(&builder.registry, &batch)?;
//! let first = builder.run(&graph, &RunOptions::default(), &listener);
//! assert_eq!((first.done(), first.cached(), first.exit_code()), (2, 0, 0));
//! let artifact = first.artifact("reef", "", "count").expect("it ran");
//! assert_eq!(std::fs::read_to_string(artifact.path.join("count"))?, "2");
//!
//! batch.defaults.insert("import".into(), serde_json::json!({"upper_case": true}));
//! let graph = Graph::new(&builder.registry, &batch)?;
//! assert_eq!(builder.plan(&graph, None).to_run(), 2);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # The rules for a stage
//!
//! * Its files depend on its inputs, parameters and [seed](StageContext::seed) alone, whatever the number of
//!   threads: no times, host names or paths in them. `use3d verify --sample` recomputes and compares. If
//!   this holds within one class of arithmetic only, the stage names the
//!   [figures](Stage::agrees_across_classes) by which artifacts of two classes are compared.
//! * It reads nothing but its inputs, and writes nothing but its output folder and its checkpoints.
//! * Long stages are [resumable](Stage::resumable): the checkpoint folder is keyed without the parameters
//!   that only set the length of the work. So 20 000 steps after 15 000 cost 5 000, as long as nothing else
//!   in the stage depends on the total.
//! * Long stages check [`StageContext::cancelled`] often and return [`StageError::Cancelled`] after saving a
//!   checkpoint.
//!
//! # Overview of the modules
//!
//! [`cache`]: the folder layout, publishing, verification. [`code`]: token-level code digests. [`content`]:
//! digests of inputs that are not read twice. [`graph`]: scenes × stages × variants. [`plan`] and [`run`]:
//! the forecast of a run, and the run. [`executor`]: places where jobs run. [`history`]: records of past
//! runs, and forecasts. [`place`]: results outside the cache, and the rules for replacing them;
//! [`delivered`]: the sources of those that exist. [`remote`]: a store beside the cache.

mod agree;
mod alone;
pub mod cache;
pub mod canonical;
pub mod code;
pub mod content;
mod context;
pub mod delivered;
pub mod digest;
pub mod error;
mod events;
pub mod executor;
pub mod files;
pub mod gc;
pub mod graph;
pub mod history;
mod job;
pub mod key;
mod lease;
pub mod leftovers;
pub mod machine;
pub mod manifest;
mod memory;
pub mod node;
pub mod picture;
pub mod place;
pub mod plan;
mod pulse;
mod registry;
pub mod remote;
mod require;
mod resolve;
pub mod run;
mod stage;
pub mod status;
mod summary;
pub mod task;
mod text;
pub mod verify;

pub use agree::{Agreement, AlikeFiles, Figure};
pub use alone::Alone;
pub use cache::{Artifact, Cache};
pub use context::{Notes, StageContext, StageInput};
pub use digest::Digest;
pub use error::{BuildError, FileError, ParameterError, StageError};
pub use events::{Event, Listener, Silent};
pub use executor::{Executor, Threads};
pub use graph::{Batch, BatchScene, Graph, Variant};
pub use key::DeviceClass;
pub use lease::{PATIENCE, Working};
pub use plan::Plan;
pub use registry::{Registry, Shorthand};
pub use require::{Checks, Gap, Gaps, Lacking};
pub use run::{RunOptions, Summary};
pub use stage::{AllParameters, Input, Named, Scope, Select, Source, Stage};

/// Stages and the cache they work on.
#[derive(Clone)]
pub struct Builder {
    /// The stages.
    pub registry: Registry,
    /// The cache.
    pub cache: Cache,
    numeric_class: String,
    remote: Option<std::sync::Arc<remote::RemoteStore>>,
}

impl Builder {
    /// A builder on this machine.
    pub fn new(registry: Registry, cache: Cache) -> Self {
        let cache = cache.with_promises(&registry);
        Self { registry, cache, numeric_class: key::numeric_class(), remote: None }
    }

    /// The same builder, which looks in a store for artifacts that the cache lacks before it computes them,
    /// and uploads the artifacts that it has computed.
    #[must_use]
    pub fn with_remote(self, remote: std::sync::Arc<remote::RemoteStore>) -> Self {
        Self { remote: Some(remote), ..self }
    }

    /// The same builder as if on a machine with another class of arithmetic.
    #[must_use]
    pub fn with_numeric_class(mut self, class: &str) -> Self {
        self.numeric_class = class.to_string();
        self
    }
}
