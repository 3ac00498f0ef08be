//! The few file operations that the cache relies on, behind a trait, so that tests can make each of them
//! fail.
//!
//! A file with its final name is complete: its bytes are synced before the rename that gives the name, and
//! the folder is synced after it.

use std::fs::{self, File};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

pub(crate) use use3d_files::unique;

use crate::error::FileError;

/// The text between a file's name and [`unique`] in the name of its temporary sibling.
pub(crate) const SIBLING: &str = ".tmp-";

/// File operations of the cache. Stages write their own files into their output folders.
pub trait Files: Send + Sync {
    /// Reads the whole file.
    fn read(&self, path: &Path) -> io::Result<Vec<u8>> {
        fs::read(path)
    }
    /// Opens for reading in pieces.
    fn open(&self, path: &Path) -> io::Result<Box<dyn Read>> {
        Ok(Box::new(File::open(path)?))
    }
    /// Creates or replaces a file and syncs it.
    fn write(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        let mut file = File::create(path)?;
        file.write_all(bytes)?;
        file.sync_all()
    }
    /// Appends to a file, creating it where it is missing.
    fn append(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        File::options().append(true).create(true).open(path)?.write_all(bytes)
    }
    /// Creates a file that must not exist yet.
    fn create_new(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        File::options().write(true).create_new(true).open(path)?.write_all(bytes)
    }
    /// Creates a folder and its parents.
    fn create_dir_all(&self, path: &Path) -> io::Result<()> {
        fs::create_dir_all(path)
    }
    /// Renames within a file system, replacing a file.
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        fs::rename(from, to)
    }
    /// Syncs a file or folder.
    fn sync(&self, path: &Path) -> io::Result<()> {
        if cfg!(unix) || path.is_file() { File::open(path)?.sync_all() } else { Ok(()) }
    }
    /// Removes a file.
    fn remove_file(&self, path: &Path) -> io::Result<()> {
        fs::remove_file(path)
    }
    /// Removes a folder with everything below.
    fn remove_dir_all(&self, path: &Path) -> io::Result<()> {
        fs::remove_dir_all(path)
    }
    /// Returns true if a file or folder of that name exists.
    fn exists(&self, path: &Path) -> io::Result<bool> {
        match fs::symlink_metadata(path) {
            Ok(_) => Ok(true),
            Err(e) if is_absence(&e) => Ok(false),
            Err(e) => Err(e),
        }
    }
    /// Overwrites some bytes of an existing file; its length stays.
    fn overwrite(&self, path: &Path, start: u64, bytes: &[u8]) -> io::Result<()> {
        let mut file = File::options().write(true).open(path)?;
        file.seek(SeekFrom::Start(start))?;
        file.write_all(bytes)
    }
    /// Makes the system ask the server again for the names in a folder: a client of a network file system may
    /// cache for a minute that a name did not exist.
    fn look_again(&self, folder: &Path) {
        drop(fs::read_dir(folder).map(|mut entries| entries.next().is_some()));
    }
}

/// The real file system.
#[derive(Clone, Copy, Debug, Default)]
pub struct Disk;

impl Files for Disk {}

/// Returns true if an error says that there is no file or folder of a name.
pub(crate) fn is_absence(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory)
}

/// Adds the path to an error.
pub(crate) fn at<T>(path: &Path, doing: &'static str, result: io::Result<T>) -> Result<T, FileError> {
    result.map_err(|source| FileError { path: path.to_path_buf(), doing, source })
}

/// Writes a small file whole or not at all: a synced sibling, renamed. Folders above it are created.
///
/// # Errors
/// A folder cannot be created or the file cannot be written. The old file is then unchanged.
pub fn write_atomic(files: &dyn Files, path: &Path, bytes: &[u8]) -> Result<(), FileError> {
    let parent = path.parent().unwrap_or(Path::new("."));
    at(parent, "create", files.create_dir_all(parent))?;
    let sibling = sibling(path, &unique());
    let moved = files.write(&sibling, bytes).and_then(|()| rename(files, &sibling, path));
    let written = at(path, "write", moved);
    if written.is_err() {
        // The error that matters is the one above; `Cache::sweep` removes the sibling later.
        let _ = files.remove_file(&sibling);
    }
    written
}

/// The path of a temporary file beside a file.
pub(crate) fn sibling(path: &Path, end: &str) -> PathBuf {
    let mut name = path.file_name().unwrap_or_default().to_os_string();
    name.push(format!("{SIBLING}{end}"));
    path.with_file_name(name)
}

/// Creates a file under a unique name: if it is reported to exist already, this process created it.
pub(crate) fn create_own(files: &dyn Files, path: &Path, bytes: &[u8]) -> io::Result<()> {
    match files.create_new(path, bytes) {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Ok(()),
        other => other,
    }
}

/// The entries of a folder that can be read.
pub(crate) fn entries(folder: &Path) -> impl Iterator<Item = fs::DirEntry> + use<> {
    fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok)
}

/// Renames a file or folder whose old and new name only this process uses. If a server's reply was lost, the
/// system repeats the request and the server may answer that the old name does not exist. So after an error
/// the existing names decide.
pub(crate) fn rename(files: &dyn Files, from: &Path, to: &Path) -> io::Result<()> {
    let renamed = files.rename(from, to);
    if renamed.is_err() {
        [from, to].into_iter().filter_map(Path::parent).for_each(|folder| files.look_again(folder));
        if matches!((files.exists(from), files.exists(to)), (Ok(false), Ok(true))) {
            return Ok(());
        }
    }
    renamed
}

/// Lists every regular file below a folder with its path (`/` between folders) and size, sorted; symbolic
/// links and special files are errors.
pub(crate) fn list(root: &Path) -> Result<Vec<(String, u64)>, FileError> {
    let mut out = Vec::new();
    for entry in walkdir::WalkDir::new(root).sort_by_file_name() {
        let entry = entry.map_err(|e| walk_error(root, e))?;
        if entry.file_type().is_dir() {
            continue;
        }
        let size = entry.metadata().map_err(|e| walk_error(root, e))?.len();
        let relative = entry.path().strip_prefix(root).unwrap_or(entry.path());
        let name = relative_name(relative);
        let (true, Some(name)) = (entry.file_type().is_file(), name) else {
            let source = io::Error::other("not a regular file with a UTF-8 name");
            return Err(FileError { path: entry.path().to_path_buf(), doing: "store", source });
        };
        out.push((name, size));
    }
    out.sort();
    Ok(out)
}

/// A relative path with `/` between folders, or `None` if it is not UTF-8.
pub(crate) fn relative_name(path: &Path) -> Option<String> {
    let parts: Option<Vec<&str>> = path.components().map(|c| c.as_os_str().to_str()).collect();
    Some(parts?.join("/"))
}

/// The numbers of a file's device and of the file on it, which all hard links to the file share; `None` where
/// the system gives none.
pub(crate) fn identity(found: &fs::Metadata) -> Option<(u64, u64)> {
    #[cfg(unix)]
    {
        use std::os::unix::fs::MetadataExt;
        Some((found.dev(), found.ino()))
    }
    #[cfg(not(unix))]
    {
        let _ = found;
        None
    }
}

/// The [`identity`] of a file that has more than one hard link.
pub(crate) fn linked(found: &fs::Metadata) -> Option<(u64, u64)> {
    #[cfg(unix)]
    let several = std::os::unix::fs::MetadataExt::nlink(found) > 1;
    #[cfg(not(unix))]
    let several = false;
    identity(found).filter(|_| several)
}

/// Converts the error of a folder walk.
pub(crate) fn walk_error(root: &Path, error: walkdir::Error) -> FileError {
    let path = error.path().map_or_else(|| root.to_path_buf(), PathBuf::from);
    let source = match error.loop_ancestor() {
        Some(ancestor) => io::Error::other(format!("a symbolic link leads back to {}", ancestor.display())),
        None => error.into_io_error().unwrap_or_else(|| io::Error::other("unreadable")),
    };
    FileError { path, doing: "read", source }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Performs each operation and then returns an error, like a server whose replies are lost.
    struct LostAnswers;

    impl Files for LostAnswers {
        fn read(&self, path: &Path) -> io::Result<Vec<u8>> {
            Disk.read(path)
        }
        fn open(&self, path: &Path) -> io::Result<Box<dyn Read>> {
            Disk.open(path)
        }
        fn write(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
            Disk.write(path, bytes)
        }
        fn append(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
            Disk.append(path, bytes)
        }
        fn create_new(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
            Disk.create_new(path, bytes)
        }
        fn create_dir_all(&self, path: &Path) -> io::Result<()> {
            Disk.create_dir_all(path)
        }
        fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
            Disk.rename(from, to)?;
            Disk.rename(from, to)
        }
        fn sync(&self, _: &Path) -> io::Result<()> {
            Ok(())
        }
        fn remove_file(&self, path: &Path) -> io::Result<()> {
            Disk.remove_file(path)
        }
        fn remove_dir_all(&self, path: &Path) -> io::Result<()> {
            Disk.remove_dir_all(path)
        }
    }

    #[test]
    fn a_rename_whose_answer_was_lost_has_happened() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("file");
        for text in ["one", "two"] {
            write_atomic(&LostAnswers, &file, text.as_bytes()).unwrap();
            assert_eq!(fs::read_to_string(&file).unwrap(), text);
        }
        let error = rename(&LostAnswers, &dir.path().join("nothing"), &dir.path().join("new")).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::NotFound);
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    }
}
