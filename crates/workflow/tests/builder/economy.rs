//! The cost of a run besides its stages is the same for an artifact of a large batch and of a small batch. It
//! is counted in operations of the file system and in searches of a capture.

use std::fs;
use std::io::{self, Read};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use use3d_workflow::content::Choice;
use use3d_workflow::files::Files;
use use3d_workflow::run::RunOptions;
use use3d_workflow::{Batch, Builder, Cache, Graph, Listener, Registry, Scope, Silent, Stage};

use super::stages::{Fast, ImportParameters, batch, code, registry, run};

/// Counts the operations of the file system.
#[derive(Default)]
struct Counting(AtomicUsize);

impl Counting {
    fn one(&self) -> &Fast {
        self.0.fetch_add(1, Ordering::Relaxed);
        &Fast
    }

    /// Returns the number of operations since the last call.
    fn take(&self) -> usize {
        self.0.swap(0, Ordering::Relaxed)
    }
}

impl Files for Counting {
    fn read(&self, path: &Path) -> io::Result<Vec<u8>> {
        self.one().read(path)
    }
    fn open(&self, path: &Path) -> io::Result<Box<dyn Read>> {
        self.one().open(path)
    }
    fn write(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        self.one().write(path, bytes)
    }
    fn append(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        self.one().append(path, bytes)
    }
    fn create_new(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        self.one().create_new(path, bytes)
    }
    fn create_dir_all(&self, path: &Path) -> io::Result<()> {
        self.one().create_dir_all(path)
    }
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        self.one().rename(from, to)
    }
    fn sync(&self, path: &Path) -> io::Result<()> {
        self.one().sync(path)
    }
    fn remove_file(&self, path: &Path) -> io::Result<()> {
        self.one().remove_file(path)
    }
    fn remove_dir_all(&self, path: &Path) -> io::Result<()> {
        self.one().remove_dir_all(path)
    }
    fn exists(&self, path: &Path) -> io::Result<bool> {
        self.one().exists(path)
    }
    fn overwrite(&self, path: &Path, start: u64, bytes: &[u8]) -> io::Result<()> {
        self.one().overwrite(path, start, bytes)
    }
}

fn captures(folder: &Path, count: usize) -> Batch {
    let names: Vec<String> = (0..count).map(|i| format!("s{i:03}")).collect();
    batch(folder, &names.iter().map(String::as_str).collect::<Vec<_>>())
}

#[test]
fn an_artifact_costs_the_same_in_a_large_batch() {
    let dir = tempfile::tempdir().expect("a folder");
    let costs = |count: usize| {
        let counting = Arc::new(Counting::default());
        let cache = Cache::with_files(&dir.path().join(format!("cache-{count}")), false, counting.clone());
        let builder = Builder::new(registry(0), cache.expect("a cache"));
        let batch = captures(dir.path(), count);
        counting.take();
        let summary = run(&builder, &batch).0;
        assert_eq!(summary.exit_code(), 0);
        let computed = counting.take() as f64 / summary.done() as f64;
        // Another process finds everything.
        let cache = Cache::with_files(&dir.path().join(format!("cache-{count}")), false, counting.clone());
        let builder = Builder::new(registry(0), cache.expect("a cache"));
        counting.take();
        let summary = run(&builder, &batch).0;
        assert_eq!((summary.done(), summary.exit_code()), (0, 0));
        (computed, counting.take() as f64 / summary.cached() as f64)
    };
    let ((small, small_found), (large, large_found)) = (costs(4), costs(60));
    println!("{small:.1} and {large:.1} operations an artifact computed");
    println!("{small_found:.1} and {large_found:.1} operations an artifact found");
    assert!(large < 1.2 * small, "{large} of 60 scenes, {small} of 4");
    assert!(large_found < 1.2 * small_found, "{large_found} of 60 scenes, {small_found} of 4");
}

/// The number of searches of a capture.
static LOOKED: AtomicUsize = AtomicUsize::new(0);

#[test]
fn a_capture_is_looked_through_once_and_again_when_it_has_changed() {
    let dir = tempfile::tempdir().expect("a folder");
    let import = Stage::new("import", Scope::Scene, |context, _: &ImportParameters| {
        let text = fs::read_to_string(context.input("capture")?.join("images/words.txt"))?;
        Ok(fs::write(context.output().join("words.txt"), text)?)
    })
    .external("capture", "capture")
    .select_by(|_: &ImportParameters, _| {
        LOOKED.fetch_add(1, Ordering::Relaxed);
        let paths: Vec<_> = ["images"].map(Into::into).into();
        Ok(Choice { files: paths.clone(), made_from: paths })
    })
    .made_of(&[], &[]);
    let registry = Registry::new(vec![import], code()).expect("a table");
    let open =
        || Builder::new(registry.clone(), Cache::open(&dir.path().join("cache"), false).expect("a cache"));
    let looked = || LOOKED.swap(0, Ordering::Relaxed);
    let count = 20;
    let batch = captures(dir.path(), count);
    let listener: Arc<dyn Listener> = Arc::new(Silent);
    let graph = Graph::new(&registry, &batch).expect("a graph");
    // Each capture is searched once in a run, however many nodes wait for room.
    let builder = open();
    assert_eq!(builder.run(&graph, &RunOptions::default(), &listener).done(), count);
    assert_eq!(looked(), count);
    // Folders that were changed a moment ago are searched again; older ones are not.
    std::thread::sleep(Duration::from_millis(2100));
    assert_eq!((open().plan(&graph, None).cached(), looked()), (count, count));
    let builder = open();
    assert_eq!((builder.plan(&graph, None).cached(), looked()), (count, 0));
    assert_eq!(builder.run(&graph, &RunOptions::default(), &listener).cached(), count);
    assert_eq!(looked(), 0);
    // One of them gets one more file.
    fs::write(dir.path().join("s003/images/more.txt"), "more").expect("written");
    assert_eq!((open().plan(&graph, None).to_run(), looked()), (1, 1));
    // With `--rehash`, all are searched.
    let distrusting = Cache::open(&dir.path().join("cache"), true).expect("a cache");
    Builder::new(registry.clone(), distrusting).plan(&graph, None);
    assert_eq!(looked(), count);
}
