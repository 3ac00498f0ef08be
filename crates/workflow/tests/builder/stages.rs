//! Eight tiny stages in the shape of the real pipeline, and captures to run them on.

use std::collections::BTreeMap;
use std::fs;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_workflow::code::{CodeRules, CodeTable};
use use3d_workflow::files::{Disk, Files};
use use3d_workflow::node::Node;
use use3d_workflow::run::RunOptions;
use use3d_workflow::task::ClusterTask;
use use3d_workflow::{
    Batch, BatchScene, Builder, Cache, Digest, Event, Graph, Listener, Registry, Scope, Stage, StageContext,
    StageError, Summary,
};

/// Options for reading the frames.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct ImportParameters {
    /// Keeps one of every so many words.
    pub(crate) every: usize,
    /// Image size, e.g. `1400x933`.
    pub(crate) size: Option<String>,
}

impl Default for ImportParameters {
    fn default() -> Self {
        Self { every: 1, size: None }
    }
}

/// The medium.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Medium {
    /// None.
    None,
    /// A network.
    Mlp,
    /// Anchors.
    #[default]
    Rbf,
}

/// The long stage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct ReconstructParameters {
    /// Steps.
    pub(crate) iterations: u64,
    /// Learning rate.
    pub(crate) rate: f64,
    /// The medium.
    pub(crate) medium: Medium,
    /// The source of depth: `off` or `network`.
    pub(crate) depth_prior: String,
    /// Steps between lines of the log.
    pub(crate) log_every: u64,
}

impl Default for ReconstructParameters {
    fn default() -> Self {
        Self {
            iterations: 15,
            rate: 0.5,
            medium: Medium::Rbf,
            depth_prior: "off".to_string(),
            log_every: 100,
        }
    }
}

/// A stage with one number.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Strength {
    /// The strength.
    pub(crate) strength: f32,
    /// The 2D enhancer.
    pub(crate) proposer: String,
    /// True if pipeline files turn calibration on; it is left out of keys until it is given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) calibrated: Option<bool>,
}

impl Default for Strength {
    fn default() -> Self {
        Self { strength: 1.0, proposer: "fusion".to_string(), calibrated: None }
    }
}

/// Number of steps that the long stage has really computed.
pub(crate) static STEPS: AtomicU64 = AtomicU64::new(0);

/// One step of the long stage: a hash of the state so far.
fn step(state: [u8; 32], rate: f64) -> [u8; 32] {
    *Digest::of(&[&state[..], &rate.to_bits().to_le_bytes()].concat()).as_bytes()
}

fn hash_inputs(context: &StageContext, salt: &str) -> Result<String, StageError> {
    let mut bytes = [salt.as_bytes(), &context.seed().to_le_bytes()].concat();
    for input in context.inputs() {
        bytes.extend([&input.role, &input.scene, &input.variant].into_iter().flat_map(|text| text.bytes()));
        if input.path.is_file() {
            bytes.extend(fs::read(&input.path)?);
        } else {
            let mut files: Vec<_> = fs::read_dir(&input.path)?.collect::<Result<_, _>>()?;
            files.sort_by_key(|f| f.file_name());
            for file in files.into_iter().filter(|f| f.path().is_file() && f.file_name() != "manifest.json") {
                bytes.extend(fs::read(file.path())?);
            }
        }
    }
    Ok(Digest::of(&bytes).to_string())
}

fn pause(delay: u64, context: &StageContext) -> Result<(), StageError> {
    for _ in 0..delay {
        std::thread::sleep(Duration::from_millis(1));
        context.alive()?;
    }
    Ok(())
}

fn reconstruct(context: &StageContext, p: &ReconstructParameters, delay: u64) -> Result<(), StageError> {
    let words = fs::read(context.input("capture")?.join("words.txt"))?;
    if words.starts_with(b"garbage") {
        return Err(StageError::bad_input_message("words.txt: words are expected, found garbage"));
    }
    let mut state = *Digest::of(
        &[&words[..], &context.seed().to_le_bytes(), format!("{:?}", p.medium).as_bytes()].concat(),
    )
    .as_bytes();
    let checkpoints = context.checkpoints().ok_or_else(|| StageError::message("no checkpoint folder"))?;
    let mut start = 0;
    for entry in fs::read_dir(checkpoints)?.filter_map(Result::ok) {
        let number =
            entry.file_name().to_string_lossy().strip_prefix("step-").and_then(|n| n.parse::<u64>().ok());
        if let Some(number) = number.filter(|n| *n <= p.iterations && *n > start) {
            let bytes = fs::read(entry.path())?;
            if let Ok(bytes) = bytes.try_into() {
                (start, state) = (number, bytes);
            }
        }
    }
    if start > 0 {
        context.resumed(start, p.iterations);
    }
    for i in start..p.iterations {
        state = step(state, p.rate);
        STEPS.fetch_add(1, Ordering::Relaxed);
        if (i + 1) % 5 == 0 {
            let sibling = checkpoints.join(format!("{}-{i}.tmp", std::process::id()));
            fs::write(&sibling, state)?;
            fs::rename(sibling, checkpoints.join(format!("step-{}", i + 1)))?;
        }
        context.progress(i + 1, p.iterations, "steps");
        if i % 5 == 0 {
            pause(delay / 3, context)?;
        }
    }
    Ok(fs::write(context.output().join("scene.bin"), state)?)
}

/// The stages; each takes about `delay` milliseconds.
pub(crate) fn stages(delay: u64) -> Vec<Stage> {
    let simple = move |name: &'static str, scope: Scope| {
        Stage::new(name, scope, move |context, p: &Strength| {
            pause(delay, context)?;
            let text = hash_inputs(context, &format!("{name} {} {}", p.strength, p.proposer))?;
            fs::create_dir_all(context.output().join("deep"))?;
            fs::write(context.output().join("deep/value.txt"), &text)?;
            Ok(fs::write(context.output().join("result.txt"), text)?)
        })
    };
    vec![
        Stage::new("import", Scope::Scene, move |context, p: &ImportParameters| {
            pause(delay, context)?;
            let mut text = String::new();
            fs::File::open(context.input("capture")?.join("images/words.txt"))?.read_to_string(&mut text)?;
            if text.contains("broken") {
                return Err(StageError::message(
                    "images/words.txt: a whole word is expected, found `broken`; fix the file",
                ));
            }
            let words: Vec<&str> = text.split_whitespace().step_by(p.every.max(1)).collect();
            Ok(fs::write(context.output().join("words.txt"), words.join(" "))?)
        })
        .about("Reads a capture.")
        .external("capture", "capture")
        .select(|_: &ImportParameters, _| Ok(vec![PathBuf::from("images")]))
        .promises(&["words.txt"])
        .made_of(&["use3d-io-colmap"], &[]),
        simple("depth", Scope::Scene)
            .input("capture", "import")
            .optional_external("weights", "models")
            .when(|all| all.get("reconstruct").is_some_and(|own| own.json()["depth_prior"] == "network"))
            .made_of(&["use3d-nets"], &[]),
        simple("calibrate", Scope::Shared)
            .optional_external("input", "pairs.input")
            .seeded()
            .made_of(&["use3d-atc"], &[]),
        Stage::new("reconstruct", Scope::Scene, move |context, p| reconstruct(context, p, delay))
            .input("capture", "import")
            .optional_input("depth", "depth")
            .seeded()
            .resumable(&["iterations"])
            .without_effect(&["log_every"])
            .cost(0, 1 << 20)
            .check(|p: &ReconstructParameters| match p.rate {
                rate if rate > 0.0 => Ok(()),
                _ => Err(("rate".to_string(), "a positive number is expected".to_string())),
            })
            .made_of(&["use3d-splat", "use3d-medium"], &[]),
        simple("targets", Scope::Scene)
            .promises(&["result.txt", "deep/"])
            .input("scene", "reconstruct")
            .input("calibrator", "calibrate")
            .or_external("calibrator")
            .made_of(&["use3d-atc"], &[]),
        simple("enhance", Scope::Scene)
            .input("scene", "reconstruct")
            .input("targets", "targets")
            .seeded()
            .made_of(&["use3d-ubaf"], &[]),
        simple("evaluate", Scope::Scene)
            .input("capture", "import")
            .input("scene", "enhance")
            .cost(1, 0)
            .made_of(&["use3d-metrics"], &[]),
        Stage::new("report", Scope::Batch, move |context, _: &Strength| {
            pause(delay, context)?;
            let mut lines: Vec<String> = Vec::new();
            for input in context.inputs() {
                let score = fs::read_to_string(input.path.join("result.txt"))?;
                lines.push(format!("{} {} {} {score}", input.group, input.scene, input.variant));
            }
            lines.extend(context.missing().iter().map(|m| format!("missing {m}")));
            Ok(fs::write(context.output().join("table.txt"), lines.join("\n"))?)
        })
        .input("scores", "evaluate"),
    ]
}

const RULES: CodeRules =
    CodeRules { by_file: "pipeline", not_followed: &[], crates_not_followed: &["use3d-workflow"] };

/// The code of this workspace, whose crates the stages name.
pub(crate) fn code() -> &'static CodeTable {
    static TABLE: OnceLock<CodeTable> = OnceLock::new();
    TABLE.get_or_init(|| {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        CodeTable::of_tree(&root, RULES).expect("a table")
    })
}

/// The stages as a table, with the shorthands of the real one.
pub(crate) fn registry(delay: u64) -> Registry {
    Registry::new(stages(delay), code())
        .expect("the table is right")
        .shorthand("scene", "size", "import", "size")
        .shorthand("calibrator", "proposer", "calibrate", "proposer")
        .shorthand("calibrator", "proposer", "targets", "proposer")
}

/// The disk without syncing: tests do not survive power cuts.
pub(crate) struct Fast;

impl Files for Fast {
    fn read(&self, path: &Path) -> std::io::Result<Vec<u8>> {
        Disk.read(path)
    }
    fn open(&self, path: &Path) -> std::io::Result<Box<dyn Read>> {
        Disk.open(path)
    }
    fn write(&self, path: &Path, bytes: &[u8]) -> std::io::Result<()> {
        fs::write(path, bytes)
    }
    fn append(&self, path: &Path, bytes: &[u8]) -> std::io::Result<()> {
        Disk.append(path, bytes)
    }
    fn create_new(&self, path: &Path, bytes: &[u8]) -> std::io::Result<()> {
        Disk.create_new(path, bytes)
    }
    fn create_dir_all(&self, path: &Path) -> std::io::Result<()> {
        Disk.create_dir_all(path)
    }
    fn rename(&self, from: &Path, to: &Path) -> std::io::Result<()> {
        Disk.rename(from, to)
    }
    fn sync(&self, _: &Path) -> std::io::Result<()> {
        Ok(())
    }
    fn remove_file(&self, path: &Path) -> std::io::Result<()> {
        Disk.remove_file(path)
    }
    fn remove_dir_all(&self, path: &Path) -> std::io::Result<()> {
        Disk.remove_dir_all(path)
    }
}

/// A builder on `folder` that does not sync the disk.
pub(crate) fn builder(folder: &Path) -> Builder {
    Builder::new(registry(0), Cache::with_files(folder, false, Arc::new(Fast)).expect("a cache"))
}

/// This process as a task of a submission.
pub(crate) fn in_task(id: &str, submission: &str) -> Node {
    Node::this().in_task(ClusterTask {
        scheduler: "slurm".into(),
        cluster: String::new(),
        id: id.into(),
        attempt: 0,
        memory: 0,
        submission: submission.into(),
    })
}

/// Creates captures in `folder`, as a batch.
pub(crate) fn batch(folder: &Path, names: &[&str]) -> Batch {
    let mut batch = Batch { name: "synthetic".to_string(), seed: 42, ..Batch::default() };
    for name in names {
        batch.scenes.push(scene(folder, name));
    }
    batch
}

/// Creates a capture in `folder`, as a scene.
pub(crate) fn scene(folder: &Path, name: &str) -> BatchScene {
    let capture = folder.join(name);
    fs::create_dir_all(capture.join("images")).expect("folder");
    let words = capture.join("images/words.txt");
    if !words.exists() {
        // Several processes of a test share a capture, so none rewrites it while another reads it.
        fs::write(words, format!("some words of {name}\n")).expect("file");
        fs::write(capture.join("notes.txt"), "not read").expect("file");
    }
    BatchScene {
        name: name.to_string(),
        group: "Group".to_string(),
        externals: BTreeMap::from([("capture".to_string(), Ok(capture))]),
        ..BatchScene::default()
    }
}

/// Records the events.
#[derive(Default)]
pub(crate) struct Witness {
    pub(crate) started: Mutex<Vec<String>>,
    pub(crate) warnings: Mutex<Vec<String>>,
}

impl Listener for Witness {
    fn event(&self, event: &Event<'_>) {
        match event {
            Event::Started { label, .. } => self.started.lock().expect("lock").push((*label).to_string()),
            Event::Warning { label, text } => {
                self.warnings.lock().expect("lock").push(format!("{label}: {text}"));
            }
            _ => {}
        }
    }
}

/// Runs a batch; returns the summary, the computed stages (sorted labels), and the warnings.
pub(crate) fn run_with(
    builder: &Builder,
    batch: &Batch,
    options: &RunOptions,
) -> (Summary, Vec<String>, Vec<String>) {
    let graph = Graph::new(&builder.registry, batch).expect("a graph");
    let witness = Arc::new(Witness::default());
    let listener: Arc<dyn Listener> = witness.clone();
    let summary = builder.run(&graph, options, &listener);
    let mut started = witness.started.lock().expect("lock").clone();
    started.sort();
    let warnings = witness.warnings.lock().expect("lock").clone();
    (summary, started, warnings)
}

/// Like [`run_with`], one stage after the other.
pub(crate) fn run(builder: &Builder, batch: &Batch) -> (Summary, Vec<String>, Vec<String>) {
    run_with(builder, batch, &RunOptions::default())
}

/// Every payload byte of a cache: `stage/key/file` to content. Manifests are left out, because they hold
/// times.
pub(crate) fn payload(cache: &Cache) -> BTreeMap<String, Vec<u8>> {
    let mut all = BTreeMap::new();
    for (stage, key, path) in cache.artifacts() {
        for entry in walkdir::WalkDir::new(&path).into_iter().map(|e| e.expect("entry")) {
            if entry.file_type().is_file() && entry.file_name() != "manifest.json" {
                let name = entry.path().strip_prefix(&path).expect("below").display().to_string();
                all.insert(format!("{stage}/{key}/{name}"), fs::read(entry.path()).expect("file"));
            }
        }
    }
    all
}
