//! Runs whose jobs are not done on threads of their own, but on the deciding thread, or by another process on
//! the same cache.

use std::path::PathBuf;
use std::sync::{Arc, Mutex};

use use3d_build::Batch;
use use3d_build::executor::{Executor, Starter, Task};
use use3d_build::run::RunOptions;

use super::stages::{batch, builder, payload, run, run_with};

/// Runs every task where it is started, and records it.
#[derive(Debug, Default)]
struct Here {
    seen: Mutex<Vec<String>>,
}

impl Executor for Here {
    fn serve<'t>(&self, decide: &mut dyn FnMut(&dyn Starter<'t>)) {
        decide(self);
    }
}

impl<'t> Starter<'t> for Here {
    fn start(&self, task: Task<'t>) {
        self.seen.lock().expect("lock").push(task.label.clone());
        task.run();
    }
}

/// Makes the artifact of every task with another builder on the same cache, like another machine, and only
/// then runs the task.
#[derive(Debug)]
struct Elsewhere {
    cache: PathBuf,
    batch: Batch,
}

impl Executor for Elsewhere {
    fn serve<'t>(&self, decide: &mut dyn FnMut(&dyn Starter<'t>)) {
        decide(self);
    }
}

impl<'t> Starter<'t> for Elsewhere {
    fn start(&self, task: Task<'t>) {
        let other = builder(&self.cache);
        let options = RunOptions { until: Some(vec![task.stage.to_string()]), ..RunOptions::default() };
        let (summary, ..) = run_with(&other, &self.batch, &options);
        let made = other.cache.artifacts().into_iter().any(|(_, key, _)| key == task.key);
        assert!(made, "{task:?}: {summary}");
        task.run();
    }
}

#[test]
fn wherever_jobs_are_done_the_artifacts_are_the_same() {
    let dir = tempfile::tempdir().expect("folder");
    let batch = batch(&dir.path().join("data"), &["reef"]);
    let threads = builder(&dir.path().join("threads"));
    let (_, expected, _) = run(&threads, &batch);
    let whole = payload(&threads.cache);

    let here = Arc::new(Here::default());
    let on_one = builder(&dir.path().join("here"));
    let options = RunOptions { jobs: 3, executor: here.clone(), ..RunOptions::default() };
    let (summary, started, _) = run_with(&on_one, &batch, &options);
    assert_eq!((summary.exit_code(), &started), (0, &expected));
    assert_eq!(payload(&on_one.cache), whole);
    let mut seen = here.seen.lock().expect("lock").clone();
    seen.sort();
    assert_eq!(seen, expected, "every job went through the executor");

    let cache = dir.path().join("elsewhere");
    let asked = builder(&cache);
    let executor = Arc::new(Elsewhere { cache, batch: batch.clone() });
    let options = RunOptions { executor, ..RunOptions::default() };
    let (summary, started, warnings) = run_with(&asked, &batch, &options);
    assert_eq!((summary.exit_code(), started.len(), warnings.len()), (0, 0, 0), "{summary}");
    assert_eq!(summary.done(), 0, "what others made is taken");
    assert_eq!(payload(&asked.cache), whole);
}
