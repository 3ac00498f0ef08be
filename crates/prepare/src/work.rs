//! The folder of the work: finished steps with their results, for the next attempt.
//!
//! The folder has a fixed name, so it may have been there before. It is used only if it has this program's
//! mark, belongs to this user, and holds no links: nothing outside it can be written or removed. A finished
//! step is kept only if every file that it made still has the same bytes.

use std::collections::BTreeMap;
use std::fs::{File, Metadata};
use std::io::{ErrorKind, Read, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use use3d_files::{BEING_MADE, Making, beside, create_beside, folder_of, no_link};
use walkdir::WalkDir;

use crate::error::PrepareError;
use crate::process::StepWatch;

/// The file that marks a folder as one of this program. The process that works in the folder locks it.
const MARK: &str = "lock";
/// The text in the mark.
const MARKED: &str = "The folder of an unfinished `use3d prepare`. It may be removed.\n";
const STATE: &str = "state.json";
const LOG: &str = "log.txt";
/// Attempts to lock the folder of the work, and the pause between them.
const LOCK_TRIES: usize = 40;
const LOCK_PAUSE: Duration = Duration::from_millis(50);
/// Endings of the files that belong to a database.
const DATABASE_FILES: [&str; 4] = ["", "-wal", "-shm", "-journal"];

/// The digest of a value's JSON.
pub(crate) fn hash(value: &impl Serialize) -> String {
    let text = serde_json::to_string(value).unwrap_or_default();
    blake3::hash(text.as_bytes()).to_hex().to_string()
}

/// The digest of a file's bytes.
pub(crate) fn digest(path: &Path, watch: &StepWatch<'_>) -> Result<String, PrepareError> {
    let bad = PrepareError::read(path);
    let mut file = File::open(path).map_err(&bad)?;
    let (mut hasher, mut part) = (blake3::Hasher::new(), vec![0; 1 << 20]);
    loop {
        watch.check()?;
        match file.read(&mut part).map_err(&bad)? {
            0 => return Ok(hasher.finalize().to_hex().to_string()),
            n => hasher.update(&part[..n]),
        };
    }
}

/// Writes a file of the work.
pub(crate) fn write(path: &Path, bytes: impl AsRef<[u8]>) -> Result<(), PrepareError> {
    let file = no_link().write(true).create(true).truncate(true).open(path);
    file.and_then(|mut file| file.write_all(bytes.as_ref())).map_err(PrepareError::write(path))
}

/// Removes a folder of the work, if there is one. A process that works in it keeps it.
///
/// # Errors
/// Another process uses it, it is not a folder of this program, or it cannot be removed.
pub fn discard(folder: &Path) -> Result<(), PrepareError> {
    if std::fs::symlink_metadata(folder).is_err_and(|e| e.kind() == ErrorKind::NotFound) {
        return Ok(());
    }
    let _lock = claim(folder)?;
    let entries = std::fs::read_dir(folder).map_err(PrepareError::read(folder))?;
    for entry in entries {
        let entry = entry.map_err(PrepareError::read(folder))?;
        if entry.file_name() != MARK {
            remove(&entry.path())?;
        }
    }
    // The mark is removed last: without it, an interrupted removal would leave the rest for ever.
    remove(&folder.join(MARK))?;
    remove(folder)
}

/// Removes a file or a folder, if it is there. Links are removed and not followed.
fn remove(path: &Path) -> Result<(), PrepareError> {
    let removed = match std::fs::symlink_metadata(path) {
        Ok(found) if found.is_dir() => std::fs::remove_dir_all(path),
        Ok(_) => std::fs::remove_file(path),
        Err(error) => Err(error),
    };
    match removed {
        Err(e) if e.kind() != ErrorKind::NotFound => Err(PrepareError::write(path)(e)),
        _ => Ok(()),
    }
}

/// Removes a database of the work with all files that belong to it.
pub(crate) fn remove_database(folder: &Path, name: &str) -> Result<(), PrepareError> {
    DATABASE_FILES.iter().try_for_each(|end| remove(&folder.join(format!("{name}{end}"))))
}

/// Locks a folder of the work, and creates it if it does not exist. The result is its mark.
fn claim(folder: &Path) -> Result<File, PrepareError> {
    let mark = folder.join(MARK);
    for attempt in 0..LOCK_TRIES {
        if attempt > 0 {
            std::thread::sleep(LOCK_PAUSE);
        }
        create(folder)?;
        let foreign = |reason: &str| PrepareError::Foreign { path: folder.into(), reason: reason.into() };
        let found = std::fs::symlink_metadata(folder).map_err(PrepareError::read(folder))?;
        if !found.is_dir() {
            return Err(foreign("this is a link or a file, and no folder"));
        }
        let mut text = String::new();
        let lock = no_link().read(true).write(true).open(&mark);
        let lock = lock.and_then(|mut file| {
            Read::by_ref(&mut file).take(MARKED.len() as u64 + 1).read_to_string(&mut text)?;
            Ok(file)
        });
        let Some(lock) = lock.ok().filter(|_| text == MARKED) else {
            return Err(foreign("this folder was not made by this version of `use3d prepare`"));
        };
        // A program that another thread has just started may hold a copy of an old lock until it runs, so one
        // refusal says little. A file system without locks is no reason to refuse.
        if matches!(lock.try_lock(), Err(std::fs::TryLockError::WouldBlock)) {
            continue;
        }
        // Another process may have removed the folder since its mark was opened.
        let still = lock.metadata().ok().zip(std::fs::symlink_metadata(&mark).ok());
        if still.is_some_and(|(opened, there)| same_file(&opened, &there)) {
            return check(folder).map(|()| lock);
        }
    }
    Err(PrepareError::Busy { path: folder.to_path_buf() })
}

/// Creates a folder of the work, for this user alone, if nothing or an empty folder has the name. It appears
/// together with its mark.
fn create(folder: &Path) -> Result<(), PrepareError> {
    let empty = || std::fs::read_dir(folder).is_ok_and(|mut entries| entries.next().is_none());
    match std::fs::symlink_metadata(folder) {
        Ok(found) if !found.is_dir() || !empty() => return Ok(()),
        _ => {}
    }
    let parent = folder_of(folder);
    std::fs::create_dir_all(parent).map_err(PrepareError::write(parent))?;
    use3d_files::sweep(parent, BEING_MADE, |_| true);
    let made = beside(folder, BEING_MADE);
    let _making = Making::new(&made);
    let mut builder = std::fs::DirBuilder::new();
    #[cfg(unix)]
    std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
    builder.create(&made).map_err(PrepareError::write(&made))?;
    write(&made.join(MARK), MARKED)?;
    let placed = std::fs::rename(&made, folder);
    if placed.is_err() {
        let _ = std::fs::remove_dir_all(&made); // it belongs to this process alone
    }
    match placed {
        // Another process was faster.
        Err(e) if matches!(e.kind(), ErrorKind::DirectoryNotEmpty | ErrorKind::AlreadyExists) => Ok(()),
        placed => placed.map_err(PrepareError::write(folder)),
    }
}

/// Refuses a folder of another user, and one with links or special files in it: the programs of a step would
/// write through them.
fn check(folder: &Path) -> Result<(), PrepareError> {
    let foreign = |reason: String| PrepareError::Foreign { path: folder.to_path_buf(), reason };
    let mine = || {
        let (path, file) = create_beside(&folder.join(MARK), BEING_MADE, "")?;
        let made = file.metadata();
        std::fs::remove_file(path)?;
        Ok(same_owner(&made?, &std::fs::symlink_metadata(folder)?))
    };
    if !mine().map_err(PrepareError::write(folder))? {
        return Err(foreign("this folder belongs to another user".into()));
    }
    for entry in WalkDir::new(folder).follow_root_links(false) {
        let entry = entry.map_err(|e| PrepareError::walk(folder, &e))?;
        let data = entry.metadata().map_err(|e| PrepareError::walk(folder, &e))?;
        if !(data.is_dir() || data.is_file() && !has_other_names(&data)) {
            let name = entry.path().strip_prefix(folder).unwrap_or(entry.path()).display();
            return Err(foreign(format!("it contains {name}, which is a link or no regular file")));
        }
    }
    Ok(())
}

#[cfg(unix)]
fn same_owner(a: &Metadata, b: &Metadata) -> bool {
    use std::os::unix::fs::MetadataExt;
    a.uid() == b.uid()
}

#[cfg(unix)]
fn same_file(a: &Metadata, b: &Metadata) -> bool {
    use std::os::unix::fs::MetadataExt;
    (a.dev(), a.ino()) == (b.dev(), b.ino())
}

#[cfg(unix)]
fn has_other_names(file: &Metadata) -> bool {
    std::os::unix::fs::MetadataExt::nlink(file) > 1
}

#[cfg(not(unix))]
fn same_owner(_: &Metadata, _: &Metadata) -> bool {
    true
}

#[cfg(not(unix))]
fn same_file(_: &Metadata, _: &Metadata) -> bool {
    true
}

#[cfg(not(unix))]
fn has_other_names(_: &Metadata) -> bool {
    false
}

/// True if a file is empty, or a database of SQLite without its last pages. A program that finds the disk
/// full for a moment may leave such a file and end without an error.
fn is_cut_off(path: &Path) -> std::io::Result<bool> {
    let (mut file, mut head) = (File::open(path)?, Vec::new());
    let length = file.metadata()?.len();
    Read::by_ref(&mut file).take(100).read_to_end(&mut head)?;
    if length == 0 || head.len() < 100 || !head.starts_with(b"SQLite format 3\0") {
        return Ok(length == 0);
    }
    let number = |at: usize| u32::from_be_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]);
    let page = match number(16) >> 16 {
        1 => 1 << 16,
        page => u64::from(page),
    };
    // The number of pages counts only if the last writer wrote it.
    Ok(number(24) == number(92) && length < page * u64::from(number(28)))
}

/// A finished step.
#[derive(Serialize, Deserialize)]
struct FinishedStep {
    /// The digest of everything that the step depends on: its choices and the steps before it.
    key: String,
    result: Value,
    /// The files that it made, with the digests of their bytes.
    files: BTreeMap<String, String>,
}

/// A step: its name in notes, the file or folder that it makes, and its choices.
pub(crate) struct Step<'a> {
    pub(crate) name: &'static str,
    pub(crate) output: &'a str,
    pub(crate) choices: Value,
}

/// The folder of the work, which one process uses at a time.
pub(crate) struct Work<'a> {
    pub(crate) folder: &'a Path,
    pub(crate) log: PathBuf,
    watch: &'a StepWatch<'a>,
    /// Finished steps in their order.
    finished: Vec<FinishedStep>,
    /// The number of steps that this attempt has made or kept.
    done: usize,
    _lock: File,
}

impl<'a> Work<'a> {
    /// Opens the folder, and creates it if it does not exist.
    ///
    /// # Errors
    /// Another process uses it, it is not a folder of this program, or it cannot be written.
    pub(crate) fn open(folder: &'a Path, watch: &'a StepWatch<'a>) -> Result<Self, PrepareError> {
        let lock = claim(folder)?;
        let state = std::fs::read(folder.join(STATE)).ok();
        let finished = state.and_then(|bytes| serde_json::from_slice(&bytes).ok()).unwrap_or_default();
        Ok(Self { folder, log: folder.join(LOG), watch, finished, done: 0, _lock: lock })
    }

    /// The result of the next step. It is kept from an earlier attempt if nothing that it depends on has
    /// changed and its files are still the same; else `make` does the step, and later steps are forgotten. A
    /// step that was interrupted starts again, so that its result does not depend on the interruption.
    ///
    /// # Errors
    /// The step fails or makes no output, or its state cannot be written.
    pub(crate) fn step<T: Serialize + DeserializeOwned>(
        &mut self,
        step: Step<'_>,
        make: impl FnOnce(&Self) -> Result<T, PrepareError>,
    ) -> Result<T, PrepareError> {
        let Step { name, output, choices } = step;
        let before = self.done.checked_sub(1).and_then(|last| self.finished.get(last)).map(|s| &s.key);
        let key = hash(&json!([before, name, choices]));
        if let Some(kept) = self.finished.get(self.done).filter(|kept| kept.key == key && self.has(output)) {
            match T::deserialize(&kept.result).ok().zip(self.same(&kept.files)?.then_some(())) {
                Some((result, ())) => {
                    (self.watch.note)(&format!("{name}: kept from the last attempt"));
                    self.done += 1;
                    return Ok(result);
                }
                None => (self.watch.note)(&format!("{name}: changed since the last attempt, so made again")),
            }
        }
        self.finished.truncate(self.done);
        self.store()?;
        remove_database(self.folder, output)?;
        let result = make(self)?;
        let path = self.folder.join(output);
        let failed = |reason: String| PrepareError::Step { step: name, reason, log: self.log.clone() };
        if !self.has(output) {
            return Err(failed(format!("the program ended without an error, but it did not write {output}")));
        }
        if path.is_file() && is_cut_off(&path).map_err(PrepareError::read(&path))? {
            return Err(failed(format!(
                "the program ended without an error, but it wrote only a part of {output}; free some space on the \
                 disk, and run the same command again"
            )));
        }
        let files = self.digests(output)?;
        let value = serde_json::to_value(&result)
            .map_err(|e| PrepareError::write(&self.folder.join(STATE))(std::io::Error::other(e)))?;
        self.finished.push(FinishedStep { key, result: value, files });
        self.done += 1;
        self.store()?;
        Ok(result)
    }

    /// The files of an output, with the digests of their bytes. A wish to stop waits for them, because the
    /// step is done.
    fn digests(&self, output: &str) -> Result<BTreeMap<String, String>, PrepareError> {
        let mut files = BTreeMap::new();
        for entry in WalkDir::new(self.folder.join(output)) {
            let entry = entry.map_err(|e| PrepareError::walk(self.folder, &e))?;
            if let (true, Some(name)) = (entry.file_type().is_file(), self.name(entry.path())) {
                let mut hasher = blake3::Hasher::new();
                let read = File::open(entry.path()).and_then(|file| hasher.update_reader(file).map(drop));
                read.map_err(PrepareError::read(entry.path()))?;
                files.insert(name, hasher.finalize().to_hex().to_string());
            }
        }
        Ok(files)
    }

    /// The name of a file in the folder, as notes have it.
    fn name(&self, path: &Path) -> Option<String> {
        path.strip_prefix(self.folder).ok()?.to_str().map(String::from)
    }

    /// True if files of an earlier attempt still have the same bytes. Only an interruption is an error.
    fn same(&self, files: &BTreeMap<String, String>) -> Result<bool, PrepareError> {
        for (name, noted) in files {
            match digest(&self.folder.join(name), self.watch) {
                Ok(found) if found == *noted => {}
                Err(PrepareError::Interrupted) => return Err(PrepareError::Interrupted),
                _ => return Ok(false),
            }
        }
        Ok(true)
    }

    /// Forgets the last step, so that the next attempt does it again.
    ///
    /// # Errors
    /// The state cannot be written.
    pub(crate) fn forget_last(&mut self) -> Result<(), PrepareError> {
        self.done = self.done.saturating_sub(1);
        self.finished.truncate(self.done);
        self.store()
    }

    /// Removes a file or a folder of the work, if it is there.
    ///
    /// # Errors
    /// It cannot be removed.
    pub(crate) fn remove(&self, name: &str) -> Result<(), PrepareError> {
        remove(&self.folder.join(name))
    }

    /// Removes the files of a folder that no finished step made.
    ///
    /// # Errors
    /// One of them cannot be removed.
    pub(crate) fn remove_others(&self, name: &str) -> Result<(), PrepareError> {
        for entry in WalkDir::new(self.folder.join(name)) {
            let entry = entry.map_err(|e| PrepareError::walk(self.folder, &e))?;
            let made = |name: String| self.finished.iter().any(|step| step.files.contains_key(&name));
            if !entry.file_type().is_dir() && !self.name(entry.path()).is_some_and(made) {
                remove(entry.path())?;
            }
        }
        Ok(())
    }

    fn has(&self, name: &str) -> bool {
        self.folder.join(name).exists()
    }

    fn store(&self) -> Result<(), PrepareError> {
        let path = self.folder.join(STATE);
        use3d_files::write_atomically(&path, |w| serde_json::to_writer(w, &self.finished).map_err(Into::into))
            .map_err(PrepareError::write(&path))
    }
}
