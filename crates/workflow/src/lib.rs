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
//! use use3d_workflow::code::CodeTable;
//! use use3d_workflow::{
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
//! # Rooms
//!
//! A room uses only the rooms that stand before it in this list.
//!
//! * [`cache`] keeps artifacts on disk, with keys, manifests and digests, and results outside the cache.
//! * [`share`] shares a cache or a store between processes and machines: leases, killed tasks, remote stores.
//! * [`stage`] defines a stage: its inputs, its parameters, its requirements, and what its function gets.
//! * [`plan`] makes the graph of scenes × stages × variants, derives keys, and forecasts a run.
//! * [`run`] runs a batch or one stage, transfers, verifies and cleans, and writes the texts about it.
//!
//! The crate [`code`] computes the digests of the sources that a stage uses.

pub mod cache;
pub mod error;
pub mod plan;
pub mod run;
pub mod share;
pub mod stage;

pub use cache::artifacts::{Artifact, Cache, DamagedFile};
pub use cache::key::DeviceClass;
pub use cache::manifest::Notes;
pub use cache::{canonical, content, delivered, files, key, leftovers, machine, manifest, node, place, task};
pub use error::{BuildError, FileError, ParameterError, StageError};
pub use plan::builder::Builder;
pub use plan::gaps::{Gap, Gaps};
pub use plan::graph::{Batch, BatchScene, Graph, Variant};
pub use plan::planning::Plan;
pub use plan::{graph, history, picture, status};
pub use run::runner::RunOptions;
pub use run::summary::Summary;
pub use run::sync::Transferred;
pub use run::{gc, verify};
pub use share::killed::Killed;
pub use share::lease::{PATIENCE, Working};
pub use share::remote;
pub use stage::agree::{Agreement, AlikeFiles, Figure};
pub use stage::context::StageContext;
pub use stage::definition::{Input, Scope, Select, Source, Stage};
pub use stage::device::{AskedDevice, Device};
pub use stage::events::{Event, Listener, Silent};
pub use stage::expected::Expected;
pub use stage::inputs::{Named, StageInput};
pub use stage::parameters::{AllParameters, Parameters};
pub use stage::reading::read;
pub use stage::registry::{Registry, Shorthand, Switch};
pub use stage::require::{Checks, Lacking};
pub use use3d_code as code;
pub use use3d_code::digest::{self, Digest};
