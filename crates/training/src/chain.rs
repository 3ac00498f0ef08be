//! The checkpoints of a run, in a folder that it shares with other runs.
//!
//! Runs that differ only in their length share a folder, because the longer one can resume from the shorter
//! one; other runs may also use it. No run may remove a file from which another one would resume. So a file's
//! name contains the run it belongs to, the length of that run, and the step:
//!
//! ```text
//! reconstruct-<fingerprint>-<length>-<step>.checkpoint
//! ```
//!
//! A run writes and removes only files of its own fingerprint and length, and the last of them stays until a
//! later one is in place. It resumes from the furthest complete file of its fingerprint that is not beyond
//! its length, whichever run wrote it. Two processes may do the same work at once: a step has only one state,
//! so it does not matter whose file remains.

use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::checkpoint::{CheckpointError, CheckpointFile, sweep};

const EXTENSION: &str = "checkpoint";
/// Hexadecimal digits of the fingerprint in a name; the state itself contains all of it.
const DIGITS: usize = 16;
/// Number of attempts to list the folder while other processes remove files.
const LOOKS: usize = 32;

/// A state from which a run can resume.
pub trait Resumable: DeserializeOwned {
    /// The digest of everything that affects the run.
    fn fingerprint(&self) -> &[u8; 32];
    /// Number of steps done.
    fn step(&self) -> u64;
}

/// The folder and names of a run's checkpoints.
#[derive(Clone, Debug)]
pub struct Checkpoints {
    dir: PathBuf,
    /// The prefix of the names of this loop's files.
    name: String,
    fingerprint: [u8; 32],
    length: u64,
}

/// Result of searching for a state to resume from.
#[derive(Debug)]
pub struct ResumePoint<T> {
    /// The furthest state; `None` if the run starts from the beginning.
    pub state: Option<T>,
    /// Messages for the user: files that are damaged or belong to other runs.
    pub notices: Vec<String>,
}

/// The data in the name of a checkpoint file.
struct CheckpointName {
    path: PathBuf,
    ours: bool,
    length: u64,
    step: u64,
}

/// Result of one search in the folder.
enum SearchResult<T> {
    Found(ResumePoint<T>),
    /// No state is usable; the messages for the user.
    Nothing(Vec<String>),
    /// A file was removed between listing and reading.
    Vanished,
}

impl Checkpoints {
    /// The checkpoints of a run of the loop `name` (one word) in `dir`, which is created by the first write.
    /// `fingerprint` is the digest of everything that affects the run, `length` the number of its steps.
    pub fn new(dir: &Path, name: &str, fingerprint: &[u8; 32], length: u64) -> Self {
        Self { dir: dir.to_path_buf(), name: name.to_string(), fingerprint: *fingerprint, length }
    }

    fn run(&self) -> String {
        self.fingerprint[..DIGITS / 2].iter().map(|b| format!("{b:02x}")).collect()
    }

    /// The path of the checkpoint of a step, whether or not it exists.
    pub fn path(&self, step: u64) -> PathBuf {
        self.dir.join(format!("{}-{}-{}-{step}.{EXTENSION}", self.name, self.run(), self.length))
    }

    /// Writes the state after `step` steps, then removes the run's earlier ones.
    pub fn save(&self, step: u64, state: &impl Serialize) -> Result<(), CheckpointError> {
        CheckpointFile::at(self.path(step)).save(state)?;
        sweep(&self.dir);
        for earlier in self.entries().iter().filter(|e| e.ours && e.length == self.length && e.step < step) {
            // The old file only takes up space, and another process may have removed it already.
            let _ = fs::remove_file(&earlier.path);
        }
        Ok(())
    }

    /// The furthest complete state of this run that is not beyond its length.
    ///
    /// # Errors
    /// An existing file cannot be read. Files that are damaged or disappear meanwhile are skipped.
    pub fn load<T: Resumable>(&self) -> Result<ResumePoint<T>, CheckpointError> {
        sweep(&self.dir);
        let (mut entries, mut notices) = (Vec::new(), Vec::new());
        for _ in 0..LOOKS {
            entries = self.entries();
            entries.sort_by_key(|e| std::cmp::Reverse(e.step));
            match self.furthest(&entries)? {
                SearchResult::Found(found) => return Ok(found),
                SearchResult::Nothing(why) => {
                    notices = why;
                    break;
                }
                SearchResult::Vanished => {}
            }
        }
        if let Some(beyond) = entries.iter().filter(|e| e.ours && e.step > self.length).map(|e| e.step).min()
        {
            notices.push(format!(
                "the checkpoint is of step {beyond}, and this run has only {} steps",
                self.length
            ));
        } else if notices.is_empty() && !entries.is_empty() {
            notices.push(
                "found a checkpoint of an earlier run with other inputs or other parameters; it is kept for \
                 that run"
                    .to_string(),
            );
        }
        if let Some(last) = notices.last_mut() {
            last.push_str("; starting from the beginning");
        }
        Ok(ResumePoint { state: None, notices })
    }

    /// The furthest usable state of these entries, which are sorted by step.
    fn furthest<T: Resumable>(&self, entries: &[CheckpointName]) -> Result<SearchResult<T>, CheckpointError> {
        let mut notices = Vec::new();
        for entry in entries.iter().filter(|e| e.ours && e.step <= self.length) {
            match CheckpointFile::at(entry.path.clone()).load::<T>() {
                Ok(Some(state)) if *state.fingerprint() == self.fingerprint && state.step() == entry.step => {
                    return Ok(SearchResult::Found(ResumePoint { state: Some(state), notices }));
                }
                Ok(Some(_)) => notices.push(format!(
                    "the checkpoint {} does not have the content that its name says; it is not used",
                    entry.path.display()
                )),
                // The run that wrote it has a later file by now, which is not in this list.
                Ok(None) => return Ok(SearchResult::Vanished),
                Err(damaged @ CheckpointError::Damaged { .. }) => notices.push(damaged.to_string()),
                Err(error) => return Err(error),
            }
        }
        Ok(SearchResult::Nothing(notices))
    }

    /// The step and length of this run under another key, if there is one. In a cache the folder's name is a
    /// key, and the folders beside it belong to the same stage. `None` if this run's own folder contains any
    /// of its files.
    pub(crate) fn apart(&self) -> Option<(u64, u64)> {
        let is_key = |name: &std::ffi::OsStr| {
            name.to_str().is_some_and(|name| name.len() == 64 && name.bytes().all(|b| b.is_ascii_hexdigit()))
        };
        if !is_key(self.dir.file_name()?) || self.entries().iter().any(|entry| entry.ours) {
            return None;
        }
        let folders = fs::read_dir(self.dir.parent()?).ok()?.filter_map(Result::ok);
        let others = folders.filter(|folder| is_key(&folder.file_name()) && folder.path() != self.dir);
        let entries = others.flat_map(|folder| Self { dir: folder.path(), ..self.clone() }.entries());
        entries.filter(|e| e.ours && e.step > 0).map(|e| (e.step, e.length)).max()
    }

    /// This loop's checkpoints in the folder, of all runs.
    fn entries(&self) -> Vec<CheckpointName> {
        let run = self.run();
        let parse = |path: PathBuf| {
            let stem = path.file_name()?.to_str()?.strip_suffix(EXTENSION)?.strip_suffix('.')?;
            let mut parts = stem.strip_prefix(self.name.as_str())?.strip_prefix('-')?.split('-');
            let (of, length, step) =
                (parts.next()?, parts.next()?.parse().ok()?, parts.next()?.parse().ok()?);
            let ours = of == run;
            parts.next().is_none().then_some(CheckpointName { path, ours, length, step })
        };
        let list = match fs::read_dir(&self.dir) {
            Ok(list) => list,
            Err(error) => {
                if error.kind() != ErrorKind::NotFound {
                    tracing::warn!(
                        "{}: {error}; the checkpoints in this folder are not used",
                        self.dir.display()
                    );
                }
                return Vec::new();
            }
        };
        list.filter_map(Result::ok).filter_map(|entry| parse(entry.path())).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::SavedStep;

    struct Run(Checkpoints);

    impl Run {
        fn new(dir: &Path, run: u8, length: u64) -> Self {
            Self(Checkpoints::new(dir, "train", &[run; 32], length))
        }
        fn save(&self, step: u64) {
            self.0.save(step, &SavedStep { fingerprint: self.0.fingerprint, step }).unwrap();
        }
        fn load(&self) -> (Option<u64>, String) {
            let found = self.0.load::<SavedStep>().unwrap();
            (found.state.map(|s| s.step), found.notices.join("\n"))
        }
    }

    #[test]
    fn a_run_keeps_its_furthest_and_leaves_those_of_others() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("deep/down");
        let short = Run::new(&folder, 1, 300);
        let long = Run::new(&folder, 1, 310);
        let other = Run::new(&folder, 2, 300);
        assert_eq!(short.load(), (None, String::new()));
        for step in [100, 200, 290] {
            short.save(step);
            other.save(step - 50);
        }
        // The longer run resumes from the shorter one's file, and the shorter one keeps it.
        assert_eq!(long.load(), (Some(290), String::new()));
        long.save(305);
        long.save(310);
        assert_eq!(short.load(), (Some(290), String::new()));
        assert_eq!(other.load(), (Some(240), String::new()));
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 3, "each keeps its last only");
        // Files beyond the requested length, and files of other runs, are reported.
        let (found, notice) = Run::new(&folder, 1, 200).load();
        assert!(found.is_none() && notice.contains("step 290, and this run has only 200"), "{notice}");
        let (found, notice) = Run::new(&folder, 3, 300).load();
        assert!(
            found.is_none()
                && notice.contains("other inputs or other parameters")
                && notice.ends_with("starting from the beginning"),
            "{notice}"
        );
    }

    #[test]
    fn a_damaged_file_is_passed_over_for_the_one_before() {
        let dir = tempfile::tempdir().unwrap();
        let (first, second) = (Run::new(dir.path(), 1, 100), Run::new(dir.path(), 1, 200));
        first.save(80);
        second.save(120);
        fs::write(second.0.path(120), b"3d-use state v01 nonsense").unwrap();
        let (found, notice) = second.load();
        assert_eq!(found, Some(80));
        assert!(notice.contains("cut short") && !notice.contains("starting from the beginning"), "{notice}");
        // A file under another step's name is not used.
        fs::copy(first.0.path(80), first.0.path(90)).unwrap();
        let (found, notice) = first.load();
        assert!(found == Some(80) && notice.contains("that its name says"), "{notice}");
        for step in [80, 90] {
            fs::write(first.0.path(step), b"").unwrap();
        }
        let (found, notice) = first.load();
        assert!(found.is_none() && notice.ends_with("starting from the beginning"), "{notice}");
    }

    #[test]
    fn several_at_once_with_one_name_disturb_nobody() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("shared");
        std::thread::scope(|scope| {
            for length in [60u64, 60, 60, 90] {
                let folder = &folder;
                scope.spawn(move || {
                    let run = Run::new(folder, 1, length);
                    for step in 1..=60 {
                        run.save(step);
                        // At every moment there is a complete file that is at least as far as this run. (A
                        // listing during another process's rename may lack files that existed before and
                        // after.)
                        let far = |_| run.load().0.is_some_and(|found| found >= step);
                        assert!((0..5).any(far), "{step}");
                    }
                });
            }
        });
        let mut left: Vec<_> =
            fs::read_dir(&folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        left.sort();
        assert_eq!(left.len(), 2, "{left:?}");
    }
}
