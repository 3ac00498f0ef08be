//! The work of one node: take the lease, run the stage in a scratch folder, publish.

use std::fs::File;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, mpsc};
use std::time::{Duration, Instant};

use cpu_time::ThreadTime;

use crate::cache::artifacts::{Artifact, Lookup, Published};
use crate::cache::files;
use crate::cache::key::Key;
use crate::cache::manifest::{self, Circumstances, MANIFEST, MadeFor};
use crate::cache::node::Clock;
use crate::cache::{machine, memory};
use crate::error::{FileError, StageError};
use crate::plan::builder::Builder;
use crate::plan::graph::Node;
use crate::plan::history::Timing;
use crate::plan::resolve::Resolved;
use crate::share::killed::Killed;
use crate::share::lease::{HEARTBEAT, Lease, LeaseRequest};
use crate::share::pulse::Progress;
use crate::share::remote::{ClaimRequest, Fetched, RemoteError, RemoteStore, Sent, StoreClaim};
use crate::stage::context::{Log, StageContext};
use crate::stage::events::{Event, Listener};

/// Result of a job.
pub(crate) enum JobResult {
    /// The artifact exists; `computed` is true if this process just computed it.
    Ready { artifact: Arc<Artifact>, computed: bool, seconds: f64 },
    /// The job failed.
    Failed(StageError),
    /// The job was stopped.
    Cancelled,
    /// Another process computes the node; the text names it. The resolved node waits.
    Held(String, Box<Resolved>),
    /// The node failed or was killed in another task of this submission; the text says so.
    LeftAlone(String),
    /// An input's artifact was damaged and has been moved aside; the number is the node that makes it.
    DamagedInput(usize),
}

pub(crate) struct Job<'a> {
    pub(crate) builder: &'a Builder,
    pub(crate) pipeline: &'a str,
    pub(crate) id: usize,
    pub(crate) node: &'a Node,
    pub(crate) label: String,
    pub(crate) resolved: Box<Resolved>,
    pub(crate) threads: usize,
    pub(crate) stop: Arc<AtomicBool>,
    pub(crate) listener: Arc<dyn Listener>,
}

impl Job<'_> {
    pub(crate) fn execute(self) -> JobResult {
        if let Some(parent) = self.damaged_input() {
            return JobResult::DamagedInput(parent);
        }
        let lease = match self.turn() {
            Ok(Claim::Ours(lease)) => lease,
            Ok(Claim::Made(artifact)) => return JobResult::Ready { artifact, computed: false, seconds: 0.0 },
            Ok(Claim::Cancelled) => return JobResult::Cancelled,
            Ok(Claim::LeftAlone(reason)) => return JobResult::LeftAlone(reason),
            Ok(Claim::Held(holder)) => return JobResult::Held(holder, self.resolved),
            Err(error) => return JobResult::Failed(error.into()),
        };
        // True if the store's copy is damaged.
        let mut damaged_there = false;
        let mut claim = None;
        // After a claim the store is asked once more: another machine may have sent it meanwhile.
        loop {
            match self.fetch(lease.as_deref()) {
                FetchResult::Artifact(artifact) => {
                    if let Some(lease) = lease {
                        lease.finish();
                    }
                    return JobResult::Ready { artifact, computed: false, seconds: 0.0 };
                }
                FetchResult::Cancelled => return JobResult::Cancelled,
                FetchResult::Failed { damaged } => {
                    damaged_there = damaged;
                    break;
                }
                FetchResult::Nothing if claim.is_some() => break,
                FetchResult::Nothing => match self.claim() {
                    ClaimRequest::Granted(None) => break,
                    ClaimRequest::Granted(ours) => claim = ours,
                    ClaimRequest::Held(holder) => return JobResult::Held(holder, self.resolved),
                },
            }
        }
        let start = Instant::now();
        match self.compute(lease.as_deref(), claim.as_ref()) {
            Ok(artifact) => {
                if let Some(lease) = lease {
                    lease.finish();
                }
                let seconds = start.elapsed().as_secs_f64();
                self.send(&artifact, damaged_there);
                JobResult::Ready { artifact: Arc::new(artifact), computed: true, seconds }
            }
            Err(StageError::Cancelled) => JobResult::Cancelled,
            // An error is no failure of the stage if one of its inputs was removed or damaged meanwhile.
            Err(error) => match self.damaged_input().or_else(|| self.unreadable_input(&error)) {
                Some(parent) => JobResult::DamagedInput(parent),
                None => JobResult::Failed(error),
            },
        }
    }

    /// Finds a damaged or missing input, reports it, moves it aside, and returns the node that makes it.
    fn damaged_input(&self) -> Option<usize> {
        let cache = &self.builder.cache;
        for (parent, artifact) in &self.resolved.artifacts {
            if cache.verify(artifact, false).is_ok() {
                continue;
            }
            // An artifact from another machine may be incomplete for a moment on a network file system.
            artifact.path.ancestors().take(2).for_each(|folder| cache.files().look_again(folder));
            let Err(reason) = cache.verify(artifact, true) else { continue };
            let stage = &artifact.manifest.ingredients.stage;
            let text = if std::fs::symlink_metadata(&artifact.path).is_err() {
                let path = artifact.path.display();
                format!("its input {stage} was removed from the cache ({path}); computing it again")
            } else {
                let aside = cache.set_aside(stage, &artifact.manifest.key);
                let place = aside.map_or_else(|e| e.to_string(), |p| format!("moved to {}", p.display()));
                format!("its input {stage} is damaged: {reason}; {place}, computing it again")
            };
            self.warn(&text);
            return Some(*parent);
        }
        None
    }

    /// Sets aside the fetched inputs of a stage that cannot read its input, and returns a node that makes
    /// one.
    ///
    /// An artifact from a store has the bytes of its manifest, and may still be unusable. It is then computed
    /// here. An input that was computed here is not suspected: the stage has failed.
    fn unreadable_input(&self, error: &StageError) -> Option<usize> {
        if !error.is_bad_input() {
            return None;
        }
        let cache = &self.builder.cache;
        let fetched = |artifact: &Artifact| cache.was_fetched(&artifact.manifest.key);
        let mut suspect = None;
        for (parent, artifact) in self.resolved.artifacts.iter().filter(|(_, artifact)| fetched(artifact)) {
            let (stage, key) = (&artifact.manifest.ingredients.stage, &artifact.manifest.key);
            self.builder.remote.iter().for_each(|store| store.distrust(key));
            let aside = cache.set_aside(stage, key);
            let place = aside.map_or_else(|e| e.to_string(), |p| format!("moved to {}", p.display()));
            self.warn(&format!(
                "its input {stage} from the store cannot be used: {error}; {place}, computing it"
            ));
            suspect = Some(*parent);
        }
        suspect
    }

    fn turn(&self) -> Result<Claim, FileError> {
        let (cache, stage, key) = (&self.builder.cache, self.node.stage_name, &self.resolved.key);
        if self.stop.load(Ordering::Relaxed) {
            return Ok(Claim::Cancelled);
        }
        let artifacts = self.resolved.artifacts.iter().map(|(_, a)| a.manifest.key);
        let reads: Vec<Key> = artifacts.chain(self.resolved.checkpoints).collect();
        let asked = Lease::ask(cache, key, &reads);
        // Another process may have finished between the lookup before and the lease.
        let found = match &asked {
            LeaseRequest::Granted(Some(lease)) if lease.followed => {
                cache.lookup_patiently(stage, key, &|| self.stop.load(Ordering::Relaxed))?
            }
            _ => cache.lookup_again(stage, key)?,
        };
        Ok(match (found, asked) {
            (Lookup::Whole(artifact), asked) => {
                if let LeaseRequest::Granted(Some(lease)) = asked {
                    lease.finish();
                }
                Claim::Made(artifact)
            }
            (_, LeaseRequest::Granted(lease)) => {
                let killed = cache.killed(key);
                if let Some(reason) = self.given_up(killed.as_ref()) {
                    if let Some(lease) = lease {
                        lease.finish();
                    }
                    return Ok(Claim::LeftAlone(reason));
                }
                if let Some(killed) = killed {
                    let resumes = self.resolved.checkpoints.is_some();
                    let next = if resumes { ", from its last checkpoint if it has one" } else { "" };
                    self.note(&format!("{killed}; computing it again{next}"));
                }
                Claim::Ours(lease)
            }
            (_, LeaseRequest::Held(holder)) => Claim::Held(holder),
        })
    }

    /// Returns the reason to leave this node alone: it failed or was killed in a task of this submission, and
    /// would again. A task that the scheduler starts again may try what it was killed at, because its machine
    /// may have been lost.
    fn given_up(&self, killed: Option<&Killed>) -> Option<String> {
        let (cache, key) = (&self.builder.cache, &self.resolved.key);
        let own = cache.node.submitted()?;
        if let Some(task) = killed.and_then(|killed| killed.task.as_ref())
            && own.is_submitted_with(task)
            && !own.follows(task)
        {
            return Some(format!("{task}, where it was killed; the next submission asks for more memory"));
        }
        let failure = cache.record(self.pipeline, self.node).failure.filter(|f| f.key == Some(*key))?;
        let task = failure.task.filter(|task| own.is_submitted_with(task))?;
        Some(format!("{task}, where it failed; the next submission tries it again"))
    }

    /// Fetches the artifact from the store, if there is one. If that fails, the artifact is computed.
    fn fetch(&self, lease: Option<&Lease>) -> FetchResult {
        let Some(store) = self.builder.remote.as_ref().filter(|s| s.is_worth_asking()) else {
            return FetchResult::Nothing;
        };
        let (cache, key) = (&self.builder.cache, &self.resolved.key);
        let fetch = || store.fetch(cache, self.node.stage_name, key, &self.stop);
        match watched(lease, None, &cache.node.clock, &Progress::default(), fetch).0 {
            Ok(Fetched::Missing) => {
                store.worked();
                FetchResult::Nothing
            }
            Ok(Fetched::Now(artifact)) => {
                store.worked();
                self.note(&format!("fetched, {}", machine::bytes(artifact.manifest.bytes())));
                FetchResult::Artifact(artifact)
            }
            Ok(Fetched::Differs(artifact, file)) => {
                self.alarm(&format!("the store has other bytes of {file}"));
                FetchResult::Artifact(artifact)
            }
            Err(RemoteError::Stopped) => FetchResult::Cancelled,
            Err(error) => {
                self.without_store(store, &format!("cannot be fetched: {error}; computing it"));
                FetchResult::Failed { damaged: matches!(error, RemoteError::Wrong { .. }) }
            }
        }
    }

    /// Claims the key in the store, if there is one that can be written to.
    fn claim(&self) -> ClaimRequest {
        match self.builder.remote.as_ref().filter(|s| s.is_worth_asking() && !s.read_only) {
            Some(store) => store.claim(&self.builder.cache, &self.resolved.key, &self.stop),
            None => ClaimRequest::Granted(None),
        }
    }

    /// Sends the computed artifact to the store, if there is one. `check` is true if the store's copy was
    /// damaged.
    fn send(&self, artifact: &Artifact, check: bool) {
        let store = self.builder.remote.as_ref().filter(|s| s.is_worth_asking() && !s.read_only);
        let Some(store) = store else { return };
        match store.send(&self.builder.cache, artifact, None, check, &self.stop) {
            Ok(Sent::Now | Sent::Already) => store.worked(),
            Ok(Sent::Differs(file)) => self.alarm(&format!("the store has other bytes of {file}")),
            // `use3d push` sends it later.
            Err(RemoteError::Stopped) => {}
            Err(error) => {
                self.without_store(store, &format!("cannot be sent: {error}; `use3d push` sends it later"));
            }
        }
    }

    fn warn(&self, text: &str) {
        self.listener.event(&Event::Warning { label: &self.label, text });
    }

    fn note(&self, text: &str) {
        self.listener.event(&Event::Note { label: &self.label, text });
    }

    fn without_store(&self, store: &RemoteStore, text: &str) {
        self.warn(text);
        if store.failed() {
            self.warn(&format!("{} failed repeatedly: continuing without it", store.place()));
        }
    }

    fn compute(&self, lease: Option<&Lease>, claim: Option<&StoreClaim>) -> Result<Artifact, StageError> {
        let cache = &self.builder.cache;
        let stage = &self.builder.registry.stages()[self.node.stage];
        let log_path = cache.log_path(self.pipeline, self.node);
        let log = open_log(&log_path)?;
        log.line(&format!("{}, key {}, {} threads", self.label, self.resolved.key, self.threads));
        let scratch = Scratch { path: cache.scratch()?, cache };
        let output = scratch.path.join("artifact");
        files::at(&output, "create", cache.files().create_dir_all(&output))?;
        let checkpoints = self.resolved.checkpoints.map(|key| cache.checkpoint_path(stage.name, &key));
        if let Some(path) = &checkpoints {
            files::at(path, "create", cache.files().create_dir_all(path))?;
            cache.note_finished(path, false);
        }
        let finished = checkpoints.clone();
        let context = StageContext {
            inputs: self.resolved.inputs.clone(),
            missing: self.resolved.ingredients.missing.clone(),
            output: output.clone(),
            checkpoints,
            seed: self.node.seed.unwrap_or(0),
            threads: self.threads,
            stop: self.stop.clone(),
            node: self.id,
            label: self.label.clone(),
            listener: self.listener.clone(),
            log: log.clone(),
            resumed: AtomicU64::new(0),
            notes: Some(Mutex::default()),
            reached: Arc::default(),
        };
        let (node, label, key, threads) = (self.id, self.label.as_str(), self.resolved.key, self.threads);
        let about = stage.about;
        self.listener.event(&Event::Started { node, label, about, key, threads });
        let start = Instant::now();
        let ((ran, processor_seconds), peak_memory) =
            watched(lease, claim, &cache.node.clock, &context.reached, || {
                in_pool(self.threads, || (stage.run)(&context, &self.node.parameters))
            });
        let seconds = start.elapsed().as_secs_f64();
        if let Err(error) = ran {
            log.line(&format!("failed: {error}"));
            return Err(error);
        }
        if output.join(MANIFEST).exists() {
            let wrong = format!("the stage wrote `{MANIFEST}`, which is a reserved name");
            return Err(StageError::message(wrong));
        }
        let listed = files::list(&output)?;
        if listed.is_empty() {
            return Err(StageError::message("the stage ended without an error but wrote nothing"));
        }
        if let Some(name) = manifest::unkept(stage.promises, &listed.iter().map(|(name, _)| name.as_str())) {
            return Err(StageError::message(format!(
                "the stage ended without an error but did not write {name}, which every result of it has"
            )));
        }
        for (path, select, before) in &self.resolved.externals {
            if cache.contents.of_now(path, select.as_deref())?.digest != *before {
                let wrong = format!("{} changed while it was being read; run again", path.display());
                return Err(StageError::message(wrong));
            }
        }
        let resumed = context.resumed.load(Ordering::Relaxed) as f64 / 1e6;
        let made_for = MadeFor {
            pipeline: self.pipeline.to_string(),
            scene: self.node.scene.clone(),
            variant: self.node.variant.clone(),
        };
        let notes = context.take_notes();
        let how = Circumstances {
            seconds,
            processor_seconds,
            resumed,
            threads: self.threads,
            peak_memory,
            made_for,
            notes,
        };
        let published = cache.publish(&output, self.resolved.ingredients.clone(), how)?;
        let artifact = match published {
            Published::Now(artifact) | Published::Already(artifact) => artifact,
            Published::Differs(artifact, file) => {
                self.alarm(&format!("another process computed other bytes of {file}"));
                artifact
            }
        };
        cache.forget_killed(&self.resolved.key);
        if let Some(path) = finished.filter(|path| path.is_dir()) {
            cache.note_finished(&path, true);
        }
        log.line(&format!("done in {}", machine::seconds(seconds)));
        cache.add_timing(&Timing {
            stage: stage.name.to_string(),
            scene: self.node.scene.clone(),
            length: stage.length(&self.node.parameters),
            bytes: self.resolved.bytes,
            seconds: artifact.manifest.full_seconds(),
            peak_memory,
            output: artifact.manifest.bytes(),
            at: machine::now(),
        });
        Ok(artifact)
    }

    /// Reports that the same key has other bytes.
    fn alarm(&self, what: &str) {
        if self.builder.registry.stages()[self.node.stage].varies {
            return self.note(&format!(
                "{what}; the first result is kept, because this stage varies from run to run"
            ));
        }
        let key = self.resolved.key.short();
        self.warn(&format!(
            "determinism alarm: {what} for the same key {key}; the first artifact is kept. A result must \
             depend only on the ingredients of its key"
        ));
    }
}

enum Claim {
    Ours(Option<Box<Lease>>),
    Made(Arc<Artifact>),
    Held(String),
    LeftAlone(String),
    Cancelled,
}

/// Result of a fetch from the store.
enum FetchResult {
    Artifact(Arc<Artifact>),
    /// There is none.
    Nothing,
    /// The store failed, or its copy is damaged.
    Failed {
        damaged: bool,
    },
    Cancelled,
}

/// A scratch folder that is removed when the job ends, in every case.
struct Scratch<'a> {
    path: PathBuf,
    cache: &'a crate::cache::artifacts::Cache,
}

impl Drop for Scratch<'_> {
    fn drop(&mut self) {
        // If it cannot be removed now, a later run removes it.
        let _ = self.cache.files().remove_dir_all(&self.path);
    }
}

fn open_log(path: &std::path::Path) -> Result<Log, FileError> {
    let parent = path.parent().unwrap_or(path);
    files::at(parent, "create", std::fs::create_dir_all(parent))?;
    let file = files::at(path, "create", File::create(path))?;
    Ok(Log::new(Box::new(file)))
}

/// Runs `work` in a rayon pool of its own; a panic becomes an error.
pub(crate) fn in_pool(
    threads: usize,
    work: impl FnOnce() -> Result<(), StageError> + Send,
) -> (Result<(), StageError>, f64) {
    let pool = match rayon::ThreadPoolBuilder::new().num_threads(threads).build() {
        Ok(pool) => pool,
        Err(error) => return (Err(error.into()), 0.0),
    };
    let ran = catch_unwind(AssertUnwindSafe(|| pool.install(work))).unwrap_or_else(|panic| {
        let text = panic.downcast_ref::<&str>().map(ToString::to_string);
        let text = text.or_else(|| panic.downcast_ref::<String>().cloned());
        let text = text.unwrap_or_else(|| "no message".to_string());
        Err(StageError::message(format!("internal error, please report it: {text}")))
    });
    // The threads are as old as the pool.
    let each = pool.broadcast(|_| ThreadTime::now().as_duration().as_secs_f64());
    (ran, each.into_iter().sum())
}

/// Runs `work` while a second thread renews lease and claim and measures the memory.
fn watched<T>(
    lease: Option<&Lease>,
    claim: Option<&StoreClaim>,
    clock: &Clock,
    reached: &Progress,
    work: impl FnOnce() -> T,
) -> (T, u64) {
    const SAMPLE: Duration = Duration::from_millis(200);
    let peak = AtomicU64::new(memory::resident().unwrap_or(0));
    let (finished, wait) = mpsc::channel::<()>();
    let result = std::thread::scope(|scope| {
        let peak = &peak;
        scope.spawn(move || {
            lease.iter().for_each(|l| l.renew(reached));
            let mut renewed = clock.now();
            while let Err(mpsc::RecvTimeoutError::Timeout) = wait.recv_timeout(SAMPLE) {
                let held = memory::resident().unwrap_or(0);
                peak.fetch_max(held, Ordering::Relaxed);
                reached.note_memory(held);
                if clock.now() - renewed > HEARTBEAT {
                    lease.iter().for_each(|l| l.renew(reached));
                    claim.iter().for_each(|c| c.renew(clock, reached));
                    renewed = clock.now();
                }
            }
        });
        let result = work();
        drop(finished);
        result
    });
    peak.fetch_max(memory::resident().unwrap_or(0), Ordering::Relaxed);
    (result, peak.into_inner())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pool_counts_the_seconds_of_its_processors_and_not_those_of_waiting() {
        const WORK: Duration = Duration::from_millis(20);
        let busy = |_: rayon::BroadcastContext<'_>| while ThreadTime::now().as_duration() < WORK {};
        let (ran, seconds) = in_pool(2, || {
            rayon::broadcast(busy);
            Ok(())
        });
        assert!(ran.is_ok() && (0.04..0.4).contains(&seconds), "{seconds}");
        let (_, waited) = in_pool(1, || {
            std::thread::sleep(Duration::from_millis(100));
            Ok(())
        });
        assert!(waited < 0.09, "{waited}");
    }
}
