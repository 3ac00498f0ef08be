//! Result folders outside the cache: which of them are ours, and how one takes another's place without losing
//! anybody's file.
//!
//! A result carries a record, `manifest.json`: an artifact's own, or, where a stage was run by hand, a list
//! of the files with their digests. A folder is ours if it has a record and every file that the record lists
//! still has the bytes it lists. Only then, and only the listed files, may go: the new result is complete in
//! a sibling before the old one is moved out of the way, files that somebody put beside ours move over into
//! the new folder, and nothing is ever removed that the record does not list. Anything else in the place of a
//! result is somebody's own and is refused.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use use3d_capture::name::shown;
use use3d_files::beside;

use super::digest::Digest;
use super::error::FileError;
use super::files;
use super::leftovers;
use super::manifest::{FORMAT as ARTIFACT, FileRecord, MANIFEST};

/// The format line of the record of a stage that was run by hand.
const FORMAT: &str = "use3d result";
/// A record of a million files is smaller; what is larger is something else.
const MOST_BYTES: u64 = 1 << 28;
/// How often another process may come between looking and moving before this one gives up.
const TRIES: usize = 32;

/// Why a result cannot go where it should.
#[derive(Debug, thiserror::Error)]
pub enum PlaceError {
    /// Something is there that must not be replaced. Nothing was touched.
    #[error("{}: {reason}", shown(&path.to_string_lossy()))]
    Occupied {
        /// The folder or file.
        path: PathBuf,
        /// What is there, and what to do.
        reason: String,
    },
    /// The file system refused.
    #[error("cannot {doing} {}: {source}; choose a folder with --out that can be written and has space", shown(&path.to_string_lossy()))]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What was tried.
        doing: &'static str,
        /// What the system said.
        source: io::Error,
    },
}

impl From<FileError> for PlaceError {
    fn from(FileError { path, doing, source }: FileError) -> Self {
        Self::Io { path, doing, source }
    }
}

fn at<T>(path: &Path, doing: &'static str, result: io::Result<T>) -> Result<T, PlaceError> {
    result.map_err(|source| PlaceError::Io { path: path.to_path_buf(), doing, source })
}

/// What of a record is needed here; artifacts' manifests have more.
#[derive(Deserialize, Serialize)]
struct Record {
    format: String,
    schema: u32,
    /// What the result follows from, where whoever wrote the record says so.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    key: Option<Digest>,
    files: Vec<FileRecord>,
}

/// What stands in the place of a result.
#[derive(Debug)]
pub enum Standing {
    /// Nothing, or an empty folder.
    Free,
    /// A result of ours, as it was written.
    Ours(Ours),
    /// Anything else: why it is not ours, in words.
    Foreign(String),
}

/// A result of ours.
#[derive(Debug)]
pub struct Ours {
    /// What it follows from, where its record says so.
    pub key: Option<Digest>,
    /// Whether every listed file is there.
    pub whole: bool,
    /// Our files that are there, the record among them.
    listed: Vec<String>,
    /// Files that somebody put beside ours.
    extra: Vec<String>,
}

/// How closely listed files are looked at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Look {
    /// A file that is older than the record and of the listed size is taken to be as listed.
    Quick,
    /// Every byte is read.
    Close,
}

/// Looks at what stands in the place of a result.
pub fn look(folder: &Path, look: Look) -> Result<Standing, PlaceError> {
    for _ in 1..TRIES {
        let before = identity(folder);
        let standing = look_once(folder, look)?;
        // While one folder was looked at, another process may have put another there.
        if !matches!(standing, Standing::Foreign(_)) || before == identity(folder) {
            return Ok(standing);
        }
    }
    look_once(folder, look)
}

/// What tells a folder from another one under its name.
fn identity(folder: &Path) -> Option<(u64, SystemTime)> {
    let found = fs::symlink_metadata(folder).ok()?;
    #[cfg(unix)]
    let number = std::os::unix::fs::MetadataExt::ino(&found);
    #[cfg(not(unix))]
    let number = 0;
    Some((number, found.modified().ok()?))
}

fn look_once(folder: &Path, look: Look) -> Result<Standing, PlaceError> {
    let foreign = |why: &str| Ok(Standing::Foreign(why.to_string()));
    let kind = match fs::symlink_metadata(folder) {
        Ok(found) => found.file_type(),
        Err(e) if matches!(e.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => {
            return Ok(Standing::Free);
        }
        Err(e) => return at(folder, "look at", Err(e)),
    };
    if kind.is_symlink() {
        return foreign("this is a symbolic link");
    }
    if !kind.is_dir() {
        return foreign("this is no folder");
    }
    // Symbolic links and special files are never ours and never followed.
    let mut found: BTreeMap<String, fs::Metadata> = BTreeMap::new();
    for entry in walkdir::WalkDir::new(folder).min_depth(1) {
        let entry = match entry {
            Ok(entry) => entry,
            // Another process removes it right now.
            Err(e) if e.io_error().is_some_and(|e| e.kind() == io::ErrorKind::NotFound) => continue,
            Err(e) => return Err(files::walk_error(folder, e).into()),
        };
        if entry.file_type().is_dir() {
            continue;
        }
        let relative = entry.path().strip_prefix(folder).unwrap_or(entry.path());
        let Some(name) = files::relative_name(relative).filter(|_| entry.file_type().is_file()) else {
            let odd = shown(&relative.to_string_lossy()).into_owned();
            return foreign(&format!("it holds {odd}, which is not a plain file of ours"));
        };
        if let Ok(data) = entry.metadata() {
            found.insert(name, data);
        }
    }
    let Some(record_data) = found.get(MANIFEST) else {
        return match fs::read_dir(folder) {
            Ok(mut entries) => match entries.next() {
                None => Ok(Standing::Free),
                Some(_) => foreign("it is not empty and holds no record of this program (manifest.json)"),
            },
            Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(Standing::Free),
            Err(e) => at(folder, "look at", Err(e)),
        };
    };
    let Some(record) = read_record(&folder.join(MANIFEST)) else {
        return foreign("its manifest.json is not a record of this program");
    };
    let written = record_data.modified().ok();
    let changed = record.files.par_iter().find_map_first(|listed| {
        let data = found.get(&listed.path)?;
        let same = data.len() == listed.size
            && (look == Look::Quick && is_older(data, written)
                || digest(&folder.join(&listed.path)).is_ok_and(|d| d == listed.digest));
        (!same).then(|| listed.path.clone())
    });
    if let Some(name) = changed {
        return foreign(&format!("{} was changed after this program wrote it", shown(&name)));
    }
    let whole = record.files.iter().all(|f| found.contains_key(&f.path));
    let own: BTreeSet<&str> = record.files.iter().map(|f| f.path.as_str()).chain([MANIFEST]).collect();
    let (listed, extra) = found.into_keys().partition(|name| own.contains(name.as_str()));
    Ok(Standing::Ours(Ours { key: record.key, whole, listed, extra }))
}

/// Whether a file was written before the record. Clocks of file systems tick slowly: at the same tick, it may
/// have been edited.
fn is_older(data: &fs::Metadata, than: Option<SystemTime>) -> bool {
    matches!((data.modified().ok(), than), (Some(file), Some(record)) if file < record)
}

fn read_record(path: &Path) -> Option<Record> {
    let mut bytes = Vec::new();
    fs::File::open(path).ok()?.take(MOST_BYTES).read_to_end(&mut bytes).ok()?;
    let record: Record = serde_json::from_slice(&bytes).ok()?;
    (record.schema == 1 && [FORMAT, ARTIFACT].contains(&record.format.as_str())).then_some(record)
}

/// The digest of a file's bytes.
fn digest(path: &Path) -> io::Result<Digest> {
    let mut hasher = blake3::Hasher::new();
    hasher.update_reader(fs::File::open(path)?)?;
    Ok(hasher.finalize().into())
}

/// Writes the record of a finished folder: from now on it is a result of ours.
pub fn record(folder: &Path, key: Option<Digest>) -> Result<(), PlaceError> {
    let listed: Vec<(String, u64)> =
        files::list(folder)?.into_iter().filter(|(p, _)| p != MANIFEST).collect();
    let files: Vec<FileRecord> = listed
        .into_par_iter()
        .map(|(path, size)| {
            let file = folder.join(&path);
            Ok(FileRecord { digest: at(&file, "read", digest(&file))?, path, size })
        })
        .collect::<Result<_, PlaceError>>()?;
    let path = folder.join(MANIFEST);
    let record = Record { format: FORMAT.into(), schema: 1, key, files };
    let mut bytes = at(&path, "write", serde_json::to_vec_pretty(&record).map_err(io::Error::other))?;
    bytes.push(b'\n');
    at(&path, "write", fs::write(&path, bytes))
}

/// Refuses what must not be replaced, before any work is done: with `replace`, whatever is not ours, without
/// it, anything.
pub fn check(folder: &Path, replace: bool) -> Result<(), PlaceError> {
    match look(folder, Look::Quick)? {
        Standing::Free => Ok(()),
        Standing::Ours(_) if replace => Ok(()),
        Standing::Ours(_) => Err(there(folder)),
        Standing::Foreign(why) => Err(not_ours(folder, &why)),
    }
}

fn occupied(path: &Path, reason: &str) -> PlaceError {
    PlaceError::Occupied { path: path.to_path_buf(), reason: reason.to_string() }
}

fn there(folder: &Path) -> PlaceError {
    occupied(folder, "an earlier result is here; pass --force to replace it, or choose another name")
}

fn not_ours(folder: &Path, why: &str) -> PlaceError {
    occupied(folder, &format!("{why}; it is left as it is: choose another name, or move it away first"))
}

/// Finds out, before any work is done, whether files can be made in `folder`, or, where it is not there, in
/// the nearest folder above.
pub fn check_writable(folder: &Path) -> Result<(), PlaceError> {
    let mut there = folder;
    while fs::symlink_metadata(there).is_err() && there != parent(there) {
        there = parent(there);
    }
    at(folder, "write", tempfile::tempfile_in(there).map(|_| ()))
}

/// The folder that `path` lies in.
pub fn parent(path: &Path) -> &Path {
    use3d_files::folder_of(path)
}

/// What begins the name of a thing that is being made.
const MADE: &str = use3d_files::BEING_MADE;
/// What begins the name of an old result on its way out. It may hold files of others.
const OLD: &str = ".use3d-old-";

/// A place beside `path` for what is being made; not called after it, since a name may be as long as names
/// can be.
pub fn sibling(path: &Path) -> PathBuf {
    beside(path, MADE)
}

/// Removes from a folder what processes that were killed left half made.
///
/// An old result that was moved out of the way goes if it holds nothing but our files, as we wrote them. Where
/// it may hold somebody's, a warning says where it lies.
pub fn sweep(folder: &Path) {
    leftovers::sweep(folder, MADE, |_| true);
    leftovers::sweep(folder, OLD, |aside| {
        let ours = matches!(look_once(aside, Look::Close), Ok(Standing::Ours(ours)) if ours.extra.is_empty());
        if !ours {
            tracing::warn!(
                "{}: the files of an earlier result, and perhaps some of yours, which a run that was cut off had moved \
                 there; look through it, then remove it",
                shown(&aside.to_string_lossy())
            );
        }
        ours
    });
}

/// Copies a folder of plain files and folders.
pub fn copy_folder(from: &Path, to: &Path) -> Result<(), PlaceError> {
    at(to, "create", fs::create_dir_all(to))?;
    let entries: io::Result<Vec<fs::DirEntry>> = fs::read_dir(from).and_then(Iterator::collect);
    let mut entries = at(from, "read", entries)?;
    // The record last: a file that is newer has to be read to know whether it was edited.
    entries.sort_by_key(|entry| entry.file_name() == MANIFEST);
    for entry in entries {
        let (source, target) = (entry.path(), to.join(entry.file_name()));
        if at(&source, "read", entry.file_type())?.is_dir() {
            copy_folder(&source, &target)?;
        } else {
            at(&target, "write", fs::copy(&source, &target))?;
        }
    }
    Ok(())
}

/// Puts the finished folder `made`, a [`sibling`] with its record, in the place of `folder`. What stood there
/// is replaced only if it is ours (and `replace` allows it); files that were put beside ours stay.
pub fn put(made: &Path, folder: &Path, replace: bool) -> Result<(), PlaceError> {
    // Another process may deliver into the same place: then look again.
    for _ in 0..TRIES {
        let old = match look(folder, Look::Close)? {
            Standing::Foreign(why) => return Err(not_ours(folder, &why)),
            Standing::Ours(_) if !replace => return Err(there(folder)),
            Standing::Free => {
                match fs::remove_dir(folder) {
                    Err(e)
                        if !matches!(
                            e.kind(),
                            io::ErrorKind::NotFound | io::ErrorKind::DirectoryNotEmpty
                        ) =>
                    {
                        return at(folder, "replace", Err(e));
                    }
                    _ => {}
                }
                None
            }
            Standing::Ours(ours) => {
                if let Some(name) = ours.extra.iter().find(|name| in_the_way(made, name)) {
                    let why =
                        format!("{} is not ours, and the new result has a file of that name", shown(name));
                    return Err(not_ours(folder, &why));
                }
                let aside = beside(folder, OLD);
                match fs::rename(folder, &aside) {
                    Err(e) if e.kind() == io::ErrorKind::NotFound => continue,
                    other => at(folder, "replace", other)?,
                }
                // Nobody else knows it by this name: what it is now, it stays.
                match look_once(&aside, Look::Quick)? {
                    Standing::Ours(ours) => Some((aside, ours)),
                    _ => {
                        at(folder, "put back", fs::rename(&aside, folder))?;
                        continue;
                    }
                }
            }
        };
        match (fs::rename(made, folder), old) {
            (Ok(()), None) => return Ok(()),
            (Ok(()), Some((aside, ours))) => return retire(&aside, &ours, folder),
            (Err(e), old) => {
                // Back to where it was; if somebody was faster, what was beside it goes to that result.
                if let Some((aside, ours)) = old
                    && fs::rename(&aside, folder).is_err()
                {
                    retire(&aside, &ours, folder)?;
                }
                if !matches!(e.kind(), io::ErrorKind::DirectoryNotEmpty | io::ErrorKind::AlreadyExists) {
                    return at(folder, "write", Err(e));
                }
            }
        }
    }
    Err(occupied(folder, "another process keeps changing it; run again when that one is done"))
}

/// Whether a file called `name` has no room beside the files of `made`.
fn in_the_way(made: &Path, name: &str) -> bool {
    let taken = |path: &Path, also_folders: bool| {
        made.join(path).symlink_metadata().is_ok_and(|found| also_folders || !found.is_dir())
    };
    Path::new(name).ancestors().any(|part| taken(part, part == Path::new(name)))
}

/// Moves what others put beside an old result into the new one, and removes our files. A folder that is not
/// empty then holds something that has no room there or came since, and stays.
fn retire(aside: &Path, ours: &Ours, folder: &Path) -> Result<(), PlaceError> {
    for name in &ours.extra {
        let to = folder.join(name);
        if in_the_way(folder, name) {
            continue;
        }
        at(&to, "create the folder of", fs::create_dir_all(parent(&to)))?;
        at(&to, "keep", fs::rename(aside.join(name), &to))?;
    }
    // The record last: until then they are known to be ours.
    let (record, others): (Vec<_>, Vec<_>) = ours.listed.iter().partition(|name| *name == MANIFEST);
    for name in others.into_iter().chain(record) {
        at(aside, "remove the old files of", fs::remove_file(aside.join(name)))?;
    }
    for entry in walkdir::WalkDir::new(aside).contents_first(true).into_iter().flatten() {
        // Only empty folders can be removed in this way.
        if entry.file_type().is_dir() {
            let _ = fs::remove_dir(entry.path());
        }
    }
    Ok(())
}

#[cfg(test)]
#[path = "place/tests.rs"]
mod tests;
