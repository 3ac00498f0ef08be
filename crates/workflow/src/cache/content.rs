//! Content digests of files and folders that are not read twice.
//!
//! A file's digest is stored with its size, modification and change time and inode. While these stay the
//! same, the content is taken to be the same, so that an unchanged capture of 10 GB costs one `stat` per
//! file; `rehash` reads everything again. The digest of a file that changed within the last two seconds
//! before it was read is not stored, because a clock tick may hide a second change. A folder's digest covers
//! the relative paths, sizes and digests of its files, sorted by path. It does not cover the folder's own
//! path, so that moving a capture changes nothing.

mod choices;

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::fs::Metadata;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, SystemTime};

use rayon::prelude::*;

use crate::cache::files::{self, Files};
use crate::cache::lock;
use crate::error::FileError;
pub use choices::Choice;
use choices::Choices;
use use3d_code::digest::{Digest, Encoder};

const CONTEXT: &str = "use3d 2026 folder digest v1";
/// The time for which a file must have been unchanged before its digest is stored.
const SETTLE: Duration = Duration::from_secs(2);

/// The data of a file that the system gives without reading it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Stat {
    size: u64,
    modified: u128,
    changed: i128,
    inode: u64,
}

impl Stat {
    fn of(metadata: &Metadata) -> Self {
        let modified = metadata.modified().ok().and_then(|t| t.duration_since(SystemTime::UNIX_EPOCH).ok());
        #[cfg(unix)]
        let (changed, inode) = {
            use std::os::unix::fs::MetadataExt;
            (i128::from(metadata.ctime()) * 1_000_000_000 + i128::from(metadata.ctime_nsec()), metadata.ino())
        };
        #[cfg(not(unix))]
        let (changed, inode) = (0, 0);
        Self { size: metadata.len(), modified: modified.map_or(0, |d| d.as_nanos()), changed, inode }
    }

    /// Returns it as a text without a line break.
    fn words(&self) -> String {
        let Self { size, modified, changed, inode } = self;
        format!("{size} {modified} {changed} {inode}")
    }

    fn parse<'w>(parts: &mut impl Iterator<Item = &'w str>) -> Option<Self> {
        let (size, modified) = (parts.next()?.parse().ok()?, parts.next()?.parse().ok()?);
        let (changed, inode) = (parts.next()?.parse().ok()?, parts.next()?.parse().ok()?);
        Some(Self { size, modified, changed, inode })
    }

    /// Returns true if the last change was so long before `time` that a later one would show.
    fn settled_before(&self, time: SystemTime) -> bool {
        let time = time.duration_since(SystemTime::UNIX_EPOCH).map_or(0, |d| d.as_nanos());
        let last = self.modified.max(self.changed.max(0).cast_unsigned());
        last + SETTLE.as_nanos() < time
    }
}

/// Digest and size of a file or folder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Content {
    /// The digest.
    pub digest: Digest,
    /// Bytes in all files together.
    pub bytes: u64,
}

/// Computes content digests and stores them. An input counts as it was when it was first read.
pub struct Contents {
    files: Arc<dyn Files>,
    table_path: PathBuf,
    rehash: bool,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    table: HashMap<PathBuf, (Stat, Digest)>,
    changed: BTreeSet<PathBuf>,
    whole: BTreeMap<(PathBuf, Vec<PathBuf>), Content>,
    fresh: BTreeSet<PathBuf>,
    choices: Choices,
}

/// The name of the table of choices, beside that of digests.
const CHOICES: &str = "choices";

impl Contents {
    /// Opens the table at `table_path`; an unreadable table counts as empty. `rehash` ignores its entries.
    pub fn open(files: Arc<dyn Files>, table_path: PathBuf, rehash: bool) -> Self {
        let table = files.read(&table_path).map(|bytes| parse(&bytes)).unwrap_or_default();
        let known = if rehash { None } else { files.read(&table_path.with_file_name(CHOICES)).ok() };
        let choices = known.map(|bytes| Choices::read(&bytes)).unwrap_or_default();
        Self { files, table_path, rehash, state: Mutex::new(State { table, choices, ..State::default() }) }
    }

    /// Returns the content of a file or folder. For a folder this covers all files that are not hidden, or
    /// those in `select`: paths relative to the folder, where a folder counts with everything below, and a
    /// path that does not exist is skipped.
    pub fn of(&self, path: &Path, select: Option<&[PathBuf]>) -> Result<Content, FileError> {
        let path = files::at(path, "find", std::fs::canonicalize(path))?;
        let memory = (path.clone(), select.unwrap_or_default().to_vec());
        if let Some(known) = self.lock().whole.get(&memory) {
            return Ok(*known);
        }
        let metadata = files::at(&path, "read", std::fs::metadata(&path))?;
        let content = if metadata.is_file() {
            Content { digest: self.file(&path, &metadata)?, bytes: metadata.len() }
        } else {
            self.folder(&path, select)?
        };
        self.lock().whole.insert(memory, content);
        Ok(content)
    }

    /// Forgets the inputs that this process has read, so that each is checked once more. A run and a plan
    /// begin with this.
    pub(crate) fn look_again(&self) {
        let mut state = self.lock();
        state.whole.clear();
        state.choices.asked.clear();
    }

    /// Returns the files of an input that `who` reads. `choose` makes the choice if none is stored.
    pub(crate) fn choice<E>(
        &self,
        who: Digest,
        input: &Path,
        choose: impl FnOnce() -> Result<Choice, E>,
    ) -> Result<Arc<[PathBuf]>, E> {
        let whose = (who, input.to_path_buf());
        if let Some(known) = self.lock().choices.asked.get(&whose) {
            return Ok(known.clone());
        }
        if let Some(files) = self.lock().choices.still_holds(&whose) {
            return Ok(files);
        }
        let before = SystemTime::now();
        let choice = choose()?;
        Ok(self.lock().choices.remember(&whose, choice, before))
    }

    /// Like [`of`](Self::of), but checks the file or folder again, to find an input that changed while it was
    /// read.
    pub(crate) fn of_now(&self, path: &Path, select: Option<&[PathBuf]>) -> Result<Content, FileError> {
        let path = files::at(path, "find", std::fs::canonicalize(path))?;
        self.lock().whole.remove(&(path.clone(), select.unwrap_or_default().to_vec()));
        self.of(&path, select)
    }

    fn folder(&self, root: &Path, select: Option<&[PathBuf]>) -> Result<Content, FileError> {
        let mut found: BTreeMap<PathBuf, Metadata> = BTreeMap::new();
        let whole = [PathBuf::new()];
        for part in select.unwrap_or(&whole) {
            let start = if part.as_os_str().is_empty() { root.to_path_buf() } else { root.join(part) };
            if !start.exists() {
                continue;
            }
            let visible = |e: &walkdir::DirEntry| e.depth() == 0 || !is_hidden(e.file_name());
            for entry in walkdir::WalkDir::new(&start).follow_links(true).into_iter().filter_entry(visible) {
                let entry = entry.map_err(|e| files::walk_error(root, e))?;
                if entry.file_type().is_file() {
                    let metadata = entry.metadata().map_err(|e| files::walk_error(root, e))?;
                    found.insert(entry.into_path(), metadata);
                }
            }
        }
        let list: Vec<(PathBuf, Metadata)> = found.into_iter().collect();
        let digests: Vec<Result<Digest, FileError>> =
            list.par_iter().map(|(path, metadata)| self.file(path, metadata)).collect();
        let mut encoder = Encoder::new(CONTEXT);
        let mut bytes = 0;
        for ((path, metadata), digest) in list.iter().zip(digests) {
            let relative = path.strip_prefix(root).unwrap_or(path);
            let name =
                relative.components().map(|c| c.as_os_str().to_string_lossy()).collect::<Vec<_>>().join("/");
            encoder.text(&name).number(metadata.len()).bytes(digest?.as_bytes());
            bytes += metadata.len();
        }
        Ok(Content { digest: encoder.finish(), bytes })
    }

    fn file(&self, path: &Path, metadata: &Metadata) -> Result<Digest, FileError> {
        let stat = Stat::of(metadata);
        let state = self.lock();
        if let Some((known, digest)) = state.table.get(path)
            && *known == stat
            && (!self.rehash || state.fresh.contains(path))
        {
            return Ok(*digest);
        }
        drop(state);
        let digest = self.read_digest(path)?;
        if stat.settled_before(SystemTime::now()) {
            self.remember(path, stat, digest);
        }
        Ok(digest)
    }

    /// Returns the content of one file, and trusts the stored digest as long as its stat stays the same; for
    /// files that this program wrote and closed.
    pub(crate) fn of_file(&self, path: &Path) -> Result<Content, FileError> {
        let metadata = files::at(path, "read", std::fs::metadata(path))?;
        Ok(Content { digest: self.file(path, &metadata)?, bytes: metadata.len() })
    }

    /// Reads a file and returns its digest, even where a digest is stored.
    pub(crate) fn read_digest(&self, path: &Path) -> Result<Digest, FileError> {
        let reader = files::at(path, "open", self.files.open(path))?;
        let mut hasher = blake3::Hasher::new();
        files::at(path, "read", hasher.update_reader(reader))?;
        Ok(hasher.finalize().into())
    }

    /// Stores the digest of a file that this program just wrote, synced and read, and that no other process
    /// writes.
    pub(crate) fn remember_own(&self, path: &Path, digest: Digest) {
        if let Ok(metadata) = std::fs::metadata(path) {
            self.remember(path, Stat::of(&metadata), digest);
        }
    }

    /// The files below `folder` whose stored digest is `digest`, sorted.
    pub(crate) fn places_of(&self, digest: &Digest, folder: &Path) -> Vec<PathBuf> {
        let state = self.lock();
        let equal = state.table.iter().filter(|(path, (_, d))| d == digest && path.starts_with(folder));
        let mut places: Vec<PathBuf> = equal.map(|(path, _)| path.clone()).collect();
        places.sort();
        places
    }

    /// Stores anew the data of a file that got another hard link, for all of its links. One call of the
    /// system serves all of them.
    pub(crate) fn remember_links(&self, path: &Path, digest: Digest) {
        let Ok(now) = std::fs::metadata(path).map(|found| Stat::of(&found)) else { return };
        let mut state = self.lock();
        let State { table, changed, .. } = &mut *state;
        for (link, (stat, known)) in table.iter_mut() {
            if *known == digest && (stat.inode, stat.size) == (now.inode, now.size) {
                *stat = now;
                changed.insert(link.clone());
            }
        }
    }

    fn remember(&self, path: &Path, stat: Stat, digest: Digest) {
        let mut state = self.lock();
        state.table.insert(path.to_path_buf(), (stat, digest));
        state.changed.insert(path.to_path_buf());
        state.fresh.insert(path.to_path_buf());
    }

    /// Writes the new digests, merged with those that other processes have written meanwhile. Losing them
    /// costs only time.
    pub fn save(&self) -> Result<(), FileError> {
        let mut state = self.lock();
        let path = self.table_path.with_file_name(CHOICES);
        let there = || self.files.read(&path).unwrap_or_default();
        if let Some(bytes) = state.choices.to_write(there) {
            files::write_atomic(self.files.as_ref(), &path, &bytes)?;
            state.choices.were_written();
        }
        if state.changed.is_empty() {
            return Ok(());
        }
        let mut merged = self.files.read(&self.table_path).map(|bytes| parse(&bytes)).unwrap_or_default();
        merged.extend(state.changed.iter().filter_map(|path| Some((path.clone(), *state.table.get(path)?))));
        let mut lines: Vec<String> = merged
            .iter()
            .filter_map(|(path, (stat, digest))| {
                let path = serde_json::to_string(path.to_str()?).ok()?;
                Some(format!("{digest} {} {path}", stat.words()))
            })
            .collect();
        lines.sort();
        lines.push(String::new());
        files::write_atomic(self.files.as_ref(), &self.table_path, lines.join("\n").as_bytes())?;
        state.changed.clear();
        Ok(())
    }

    /// Forgets files that do not exist any more; part of cleaning up.
    pub(crate) fn forget_missing(&self) {
        let mut state = self.lock();
        if state.choices.forget_missing() {
            let _ = self.files.remove_file(&self.table_path.with_file_name(CHOICES));
        }
        let before = state.table.len();
        state.table.retain(|path, _| path.exists());
        if state.table.len() < before {
            // The table file is removed so that `save` merges into an empty one.
            let _ = self.files.remove_file(&self.table_path);
            state.changed = state.table.keys().cloned().collect();
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }
}

fn is_hidden(name: &std::ffi::OsStr) -> bool {
    name.to_str().is_some_and(|n| n.starts_with('.') || n == "Thumbs.db" || n == "desktop.ini")
}

fn parse(bytes: &[u8]) -> HashMap<PathBuf, (Stat, Digest)> {
    let text = String::from_utf8_lossy(bytes);
    text.lines().filter_map(parse_line).collect()
}

fn parse_line(line: &str) -> Option<(PathBuf, (Stat, Digest))> {
    let mut parts = line.splitn(6, ' ');
    let digest = parts.next()?.parse().ok()?;
    let stat = Stat::parse(&mut parts)?;
    let path: String = serde_json::from_str(parts.next()?).ok()?;
    Some((PathBuf::from(path), (stat, digest)))
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::io::Read;
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;
    use crate::cache::files::Disk;

    /// Counts the opened files.
    struct Counting(AtomicUsize);

    impl Files for Counting {
        fn open(&self, path: &Path) -> std::io::Result<Box<dyn Read>> {
            self.0.fetch_add(1, Ordering::Relaxed);
            Disk.open(path)
        }
        fn read(&self, path: &Path) -> std::io::Result<Vec<u8>> {
            Disk.read(path)
        }
        fn write(&self, path: &Path, bytes: &[u8]) -> std::io::Result<()> {
            Disk.write(path, bytes)
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
        fn sync(&self, path: &Path) -> std::io::Result<()> {
            Disk.sync(path)
        }
        fn remove_file(&self, path: &Path) -> std::io::Result<()> {
            Disk.remove_file(path)
        }
        fn remove_dir_all(&self, path: &Path) -> std::io::Result<()> {
            Disk.remove_dir_all(path)
        }
    }

    #[test]
    fn unchanged_files_are_not_read_again_and_changes_are_seen() {
        let dir = tempfile::tempdir().expect("a folder");
        let data = dir.path().join("data");
        fs::create_dir_all(data.join("images")).expect("folder");
        for name in ["images/a.png", "images/b.png", "notes.txt", ".hidden"] {
            fs::write(data.join(name), name).expect("file");
        }
        let old = SystemTime::now() - Duration::from_secs(100);
        for name in ["images/a.png", "images/b.png", "notes.txt"] {
            fs::File::options()
                .write(true)
                .open(data.join(name))
                .and_then(|f| f.set_modified(old))
                .expect("times");
        }
        let table = dir.path().join("stat");
        let digest = |rehash: bool| {
            let files = Arc::new(Counting(AtomicUsize::new(0)));
            let contents = Contents::open(files.clone(), table.clone(), rehash);
            let content = contents.of(&data, None).expect("content");
            contents.save().expect("saved");
            (content, files.0.load(Ordering::Relaxed))
        };
        let (first, _) = digest(false);
        std::thread::sleep(SETTLE + Duration::from_millis(50)); // the change time cannot be set back
        assert_eq!(digest(false), (first, 3), "fresh files are read until they have settled");
        assert_eq!(digest(false), (first, 0));
        assert_eq!(digest(true), (first, 3));
        // A touched file is read again and has the same digest. A moved folder has the same digest.
        fs::File::options()
            .write(true)
            .open(data.join("notes.txt"))
            .and_then(|f| f.set_modified(old))
            .expect("times");
        assert_eq!(digest(false), (first, 1));
        fs::write(data.join(".hidden"), "other").expect("file");
        assert_eq!(digest(false).0, first);
        // Same size, same modification time, other bytes: the change time shows it.
        fs::write(data.join("images/a.png"), "images/x.png").expect("file");
        fs::File::options()
            .write(true)
            .open(data.join("images/a.png"))
            .and_then(|f| f.set_modified(old))
            .expect("t");
        if cfg!(unix) {
            assert_ne!(digest(false).0, first);
        }
        // A selection ignores the other files, and names that do not exist.
        let contents = Contents::open(Arc::new(Disk), table, false);
        let some = |names: &[&str]| {
            let select: Vec<PathBuf> = names.iter().map(PathBuf::from).collect();
            contents.of(&data, Some(&select)).expect("content")
        };
        assert_ne!(some(&["images"]), some(&["images/b.png"]));
        assert_eq!(some(&["images"]), some(&["images", "absent", "images/b.png"]));
        assert!(contents.of(&dir.path().join("absent"), None).is_err());
        // A damaged table counts as empty.
        assert!(parse(b"garbage\n\xff\xfe 1 2 3").is_empty());
    }
}
