//! Result folders outside the cache: how to recognise the results of this program, and how a new result
//! replaces an old one without losing anybody's files.
//!
//! A result carries a record, `manifest.json`: an artifact's own, or, for a stage that was run by hand, a
//! list of the files with their digests. A folder is a result of this program ("ours") if it has a record and
//! every file that the record lists still has the listed bytes. Only then may it be replaced, and only the
//! listed files are removed. The new result is complete in a sibling folder before the old one is moved
//! aside. Files of the user beside ours move to the new folder. Nothing is ever removed that the record does
//! not list. Any other folder in the place of a result belongs to the user, and the result is refused.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use use3d_capture::name::shown;
use use3d_files::beside;
pub use use3d_files::folder_of as parent;

pub use crate::cache::manifest::MANIFEST as RECORD;

use crate::cache::files;
use crate::cache::leftovers;
use crate::cache::manifest::{FORMAT as ARTIFACT, FileRecord, MANIFEST};
use crate::error::FileError;
use use3d_code::digest::Digest;

/// The format line of the record of a stage that was run by hand.
const FORMAT: &str = "use3d result";
/// The largest file that is read as a record; a record of a million files is smaller.
const MOST_BYTES: u64 = 1 << 28;
/// Number of attempts while another process keeps changing the folder.
const TRIES: usize = 32;

/// The reason why a result cannot be placed.
#[derive(Debug, thiserror::Error)]
pub enum PlaceError {
    /// There is something that must not be replaced. Nothing was changed.
    #[error("{}: {reason}", shown(&path.to_string_lossy()))]
    Occupied {
        /// The folder or file.
        path: PathBuf,
        /// The present content, and the next step for the user.
        reason: String,
    },
    /// A file operation failed.
    #[error("cannot {doing} {}: {source}; choose a folder with --out that can be written and has space", shown(&path.to_string_lossy()))]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// The operation that was tried, as a verb.
        doing: &'static str,
        /// The system's error.
        source: io::Error,
    },
}

impl From<FileError> for PlaceError {
    fn from(FileError { path, doing, source }: FileError) -> Self {
        Self::Io { path, doing, source }
    }
}

/// The result of a file operation, with the path and the operation in its error.
pub fn at<T>(path: &Path, doing: &'static str, result: io::Result<T>) -> Result<T, PlaceError> {
    result.map_err(|source| PlaceError::Io { path: path.to_path_buf(), doing, source })
}

/// The part of a record that is needed here; artifacts' manifests have more.
#[derive(Deserialize, Serialize)]
struct ResultRecord {
    format: String,
    schema: u32,
    /// The key of the result, if the record contains it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    key: Option<Digest>,
    files: Vec<FileRecord>,
}

/// The present content of a result's place.
#[derive(Debug)]
pub enum Standing {
    /// Nothing, or an empty folder.
    Free,
    /// A result of this program, unchanged.
    Ours(Ours),
    /// Anything else, with the reason why it is not ours.
    Foreign(String),
}

/// A result of this program.
#[derive(Debug)]
pub struct Ours {
    /// The key of the result, if its record contains it.
    pub key: Option<Digest>,
    /// True if every listed file exists.
    pub whole: bool,
    /// The listed files that exist, and the record itself.
    listed: Vec<String>,
    /// Other files, which the user put beside ours.
    extra: Vec<String>,
}

/// The accuracy with which listed files are checked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Look {
    /// A file that is older than the record and has the listed size is assumed to be unchanged.
    Quick,
    /// Every byte is read.
    Close,
}

/// Checks the present content of a result's place.
pub fn look(folder: &Path, look: Look) -> Result<Standing, PlaceError> {
    for _ in 1..TRIES {
        let before = identity(folder);
        let standing = look_once(folder, look)?;
        // During the check, another process may have replaced the folder by another one.
        if !matches!(standing, Standing::Foreign(_)) || before == identity(folder) {
            return Ok(standing);
        }
    }
    look_once(folder, look)
}

/// Data that distinguish a folder from another one with the same name.
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
        Err(e) if files::is_absence(&e) => return Ok(Standing::Free),
        Err(e) => return at(folder, "look at", Err(e)),
    };
    if kind.is_symlink() {
        return foreign("this is a symbolic link");
    }
    if !kind.is_dir() {
        return foreign("this is not a folder");
    }
    // Symbolic links and special files are never ours and never followed.
    let mut found: BTreeMap<String, fs::Metadata> = BTreeMap::new();
    for entry in walkdir::WalkDir::new(folder).min_depth(1) {
        let entry = match entry {
            Ok(entry) => entry,
            // Another process is removing it right now.
            Err(e) if e.io_error().is_some_and(|e| e.kind() == io::ErrorKind::NotFound) => continue,
            Err(e) => return Err(files::walk_error(folder, e).into()),
        };
        if entry.file_type().is_dir() {
            continue;
        }
        let relative = entry.path().strip_prefix(folder).unwrap_or(entry.path());
        let Some(name) = files::relative_name(relative).filter(|_| entry.file_type().is_file()) else {
            let odd = shown(&relative.to_string_lossy()).into_owned();
            return foreign(&format!("it contains {odd}, which is not a regular file of this program"));
        };
        if let Ok(data) = entry.metadata() {
            found.insert(name, data);
        }
    }
    let Some(record_data) = found.get(MANIFEST) else {
        return match fs::read_dir(folder).map(|mut entries| entries.next().is_none()) {
            Ok(true) => Ok(Standing::Free),
            Ok(false) => foreign("it is not empty and has no manifest.json of this program"),
            Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(Standing::Free),
            Err(e) => at(folder, "look at", Err(e)),
        };
    };
    let Some(record) = read_record(&folder.join(MANIFEST)) else {
        return foreign("its manifest.json was not written by this program");
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

/// Returns true if a file was written before the record. Clocks of file systems tick slowly: at the same
/// tick, it may have been edited.
fn is_older(data: &fs::Metadata, than: Option<SystemTime>) -> bool {
    matches!((data.modified().ok(), than), (Some(file), Some(record)) if file < record)
}

fn read_record(path: &Path) -> Option<ResultRecord> {
    let mut bytes = Vec::new();
    fs::File::open(path).ok()?.take(MOST_BYTES).read_to_end(&mut bytes).ok()?;
    let record: ResultRecord = serde_json::from_slice(&bytes).ok()?;
    (record.schema == 1 && [FORMAT, ARTIFACT].contains(&record.format.as_str())).then_some(record)
}

/// The digest of a file's bytes.
fn digest(path: &Path) -> io::Result<Digest> {
    let mut hasher = blake3::Hasher::new();
    hasher.update_reader(fs::File::open(path)?)?;
    Ok(hasher.finalize().into())
}

/// Writes the record of a finished folder, which makes it a result of this program.
pub fn record(folder: &Path, key: Option<Digest>) -> Result<(), PlaceError> {
    let files: Vec<FileRecord> = files::list(folder)?
        .into_par_iter()
        .filter(|(path, _)| path != MANIFEST)
        .map(|(path, size)| {
            let file = folder.join(&path);
            Ok(FileRecord { digest: at(&file, "read", digest(&file))?, path, size })
        })
        .collect::<Result<_, PlaceError>>()?;
    let path = folder.join(MANIFEST);
    let record = ResultRecord { format: FORMAT.into(), schema: 1, key, files };
    let mut bytes = at(&path, "write", serde_json::to_vec_pretty(&record).map_err(io::Error::other))?;
    bytes.push(b'\n');
    at(&path, "write", fs::write(&path, bytes))
}

/// Fails, before any work is done, if a result must not be written to `folder`: with `replace` if something
/// there is not ours, without it if there is anything.
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
    occupied(folder, &format!("{why}, so it is not replaced; choose another name, or move it away first"))
}

/// Checks, before any work is done, that files can be created in `folder`, or, if it does not exist, in the
/// nearest folder above it.
pub fn check_writable(folder: &Path) -> Result<(), PlaceError> {
    let mut there = folder;
    while fs::symlink_metadata(there).is_err() && there != parent(there) {
        there = parent(there);
    }
    at(folder, "write", tempfile::tempfile_in(there).map(|_| ()))
}

/// The prefix of the names of unfinished results.
const MADE: &str = use3d_files::BEING_MADE;
/// The prefix of the name of an old result during its removal. It may hold the user's files.
const OLD: &str = ".use3d-old-";

/// A path beside `path` for an unfinished result. It does not contain the name of `path`, which may already
/// have the maximum length.
pub fn sibling(path: &Path) -> PathBuf {
    beside(path, MADE)
}

/// Removes unfinished results of killed processes from a folder.
///
/// An old result that a delivery moved aside is removed if it holds nothing but our files as they were
/// written. If it may hold files of the user, a warning gives its place.
pub fn sweep(folder: &Path) {
    leftovers::sweep(folder, MADE, |_| true);
    leftovers::sweep(folder, OLD, |aside| {
        let ours = matches!(look_once(aside, Look::Close), Ok(Standing::Ours(ours)) if ours.extra.is_empty());
        if !ours {
            tracing::warn!(
                "{}: this folder holds files of an earlier result, and perhaps some of yours; an interrupted run \
                 moved them there; check it, then remove it",
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
    // The record is copied last: a file newer than the record would have to be read to check it.
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

/// Puts a folder that `fill` makes at `folder`: completely, or not at all. `fill` writes the record, too. See
/// [`put`] for `replace`; `failed` converts its error.
pub fn put_folder<E>(
    folder: &Path,
    replace: bool,
    fill: impl FnOnce(&Path) -> Result<(), E>,
    failed: impl FnOnce(PlaceError) -> E,
) -> Result<(), E> {
    let made = sibling(folder);
    let placed = fill(&made).and_then(|()| put(&made, folder, replace).map_err(failed));
    if placed.is_err() {
        // The unfinished folder belongs to this process alone; the first error is the one to report.
        let _ = fs::remove_dir_all(&made);
    }
    placed
}

/// Moves the finished folder `made`, a [`sibling`] with its record, to `folder`. An old result is replaced
/// only if it is ours (and `replace` allows it); the user's files beside ours stay.
pub fn put(made: &Path, folder: &Path, replace: bool) -> Result<(), PlaceError> {
    // Another process may deliver into the same place: then check again.
    for _ in 0..TRIES {
        let old = match look(folder, Look::Close)? {
            Standing::Foreign(why) => return Err(not_ours(folder, &why)),
            Standing::Ours(_) if !replace => return Err(there(folder)),
            Standing::Free => {
                let harmless = [io::ErrorKind::NotFound, io::ErrorKind::DirectoryNotEmpty];
                match fs::remove_dir(folder) {
                    Err(e) if !harmless.contains(&e.kind()) => return at(folder, "replace", Err(e)),
                    _ => None,
                }
            }
            Standing::Ours(ours) => {
                if let Some(name) = ours.extra.iter().find(|name| in_the_way(made, name)) {
                    let why = format!(
                        "{} was not written by this program, and the new result has a file of that name",
                        shown(name)
                    );
                    return Err(not_ours(folder, &why));
                }
                let aside = beside(folder, OLD);
                match fs::rename(folder, &aside) {
                    Err(e) if e.kind() == io::ErrorKind::NotFound => continue,
                    other => at(folder, "replace", other)?,
                }
                // No other process knows this name, so the folder does not change any more.
                let Standing::Ours(ours) = look_once(&aside, Look::Quick)? else {
                    at(folder, "put back", fs::rename(&aside, folder))?;
                    continue;
                };
                Some((aside, ours))
            }
        };
        match (fs::rename(made, folder), old) {
            (Ok(()), None) => return Ok(()),
            (Ok(()), Some((aside, ours))) => return retire(&aside, &ours, folder),
            (Err(e), old) => {
                // The old folder moves back; if another process was faster, the user's files move to that
                // process's result.
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
    Err(occupied(folder, "another process is changing it; run again when that process has ended"))
}

/// Removes a result of this program; the user's files beside it stay. Returns false, and changes nothing, if
/// the folder is no such result, or was changed after it was written.
///
/// # Errors
/// Fails if a file cannot be moved or removed.
pub fn remove(folder: &Path) -> Result<bool, PlaceError> {
    if !matches!(look(folder, Look::Quick)?, Standing::Ours(_)) {
        return Ok(false);
    }
    let aside = beside(folder, OLD);
    at(folder, "remove", fs::rename(folder, &aside))?;
    // No other process knows this name, so the folder does not change any more.
    match look_once(&aside, Look::Close) {
        Ok(Standing::Ours(ours)) => retire(&aside, &ours, folder).map(|()| true),
        looked => {
            at(folder, "put back", fs::rename(&aside, folder))?;
            looked.map(|_| false)
        }
    }
}

/// Returns true if a file called `name` conflicts with the files of `made`.
fn in_the_way(made: &Path, name: &str) -> bool {
    let taken = |path: &Path, also_folders: bool| {
        made.join(path).symlink_metadata().is_ok_and(|found| also_folders || !found.is_dir())
    };
    Path::new(name).ancestors().any(|part| taken(part, part == Path::new(name)))
}

/// Moves the user's files from an old result into the new one, and removes the old result's own files. A
/// folder that is then not empty holds files that conflict there or were added since; it stays.
fn retire(aside: &Path, ours: &Ours, folder: &Path) -> Result<(), PlaceError> {
    for name in ours.extra.iter().filter(|name| !in_the_way(folder, name)) {
        let to = folder.join(name);
        at(&to, "create the folder of", fs::create_dir_all(parent(&to)))?;
        at(&to, "keep", fs::rename(aside.join(name), &to))?;
    }
    // The record is removed last, because it says which files are ours.
    let (record, others): (Vec<_>, Vec<_>) = ours.listed.iter().partition(|name| *name == MANIFEST);
    for name in others.into_iter().chain(record) {
        at(aside, "remove the old files of", fs::remove_file(aside.join(name)))?;
    }
    for entry in walkdir::WalkDir::new(aside).contents_first(true).into_iter().flatten() {
        // This removes only empty folders.
        if entry.file_type().is_dir() {
            let _ = fs::remove_dir(entry.path());
        }
    }
    Ok(())
}

#[cfg(test)]
#[path = "place/tests.rs"]
mod tests;
