//! A folder as a store: a portable disk, or a mounted share that is too slow or not consistent enough for a
//! cache.

use std::fs::{self, File};
use std::io::{self, ErrorKind, Read, Write};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use super::{Listed, Remote, RemoteError};
use crate::cache::files;

/// A folder; unfinished files have names below `v1/tmp`.
#[derive(Clone, Debug)]
pub struct FolderStore {
    root: PathBuf,
}

impl FolderStore {
    /// The store in a folder, which is created by the first write.
    pub fn new(root: &Path) -> Self {
        Self { root: root.to_path_buf() }
    }

    fn refused(&self, doing: &'static str, name: &str, error: &io::Error) -> RemoteError {
        let passing = matches!(
            error.kind(),
            ErrorKind::Interrupted | ErrorKind::TimedOut | ErrorKind::StaleNetworkFileHandle
        );
        let (place, name) = (self.place(), name.to_string());
        RemoteError::Refused { place, doing, name, reason: error.to_string(), passing }
    }

    /// Writes a file with a unique name, passes it to `finish`, and removes it afterwards.
    fn written<T>(
        &self,
        name: &str,
        from: &mut dyn Read,
        finish: impl FnOnce(&Path, &Path) -> io::Result<T>,
    ) -> Result<T, RemoteError> {
        let (target, folder) = (self.root.join(name), self.root.join("v1/tmp"));
        let made =
            [Some(folder.as_path()), target.parent()].into_iter().flatten().try_for_each(fs::create_dir_all);
        let created = made.and_then(|()| use3d_files::create_beside(&folder.join("part"), "", ""));
        let (sibling, mut file) = created.map_err(|e| self.refused("write", name, &e))?;
        let done =
            copy(from, &mut file, RemoteError::Local, |e| self.refused("write", name, &e)).and_then(|()| {
                let done = file.sync_all().and_then(|()| finish(&sibling, &target));
                done.map_err(|e| self.refused("write", name, &e))
            });
        // If it became the target, there is nothing left to remove.
        let _ = fs::remove_file(&sibling);
        done
    }
}

/// Copies, and keeps errors of the reader and of the writer apart.
fn copy(
    from: &mut dyn Read,
    to: &mut dyn Write,
    of_reader: impl Fn(io::Error) -> RemoteError,
    of_writer: impl Fn(io::Error) -> RemoteError,
) -> Result<(), RemoteError> {
    let mut buffer = vec![0; 1 << 18];
    loop {
        match from.read(&mut buffer) {
            Ok(0) => return Ok(()),
            Ok(n) => to.write_all(&buffer[..n]).map_err(&of_writer)?,
            Err(e) if e.kind() == ErrorKind::Interrupted => {}
            Err(e) => return Err(of_reader(e)),
        }
    }
}

impl Remote for FolderStore {
    fn place(&self) -> String {
        self.root.display().to_string()
    }

    fn get(&self, name: &str, to: &mut (dyn Write + Send)) -> Result<bool, RemoteError> {
        // The type is checked first, because opening a pipe waits for a writer.
        if self.size(name)?.is_none() {
            return Ok(false);
        }
        let mut file = match File::open(self.root.join(name)) {
            Ok(file) => file,
            Err(e) if e.kind() == ErrorKind::NotFound => return Ok(false),
            Err(e) => return Err(self.refused("read", name, &e)),
        };
        copy(&mut file, to, |e| self.refused("read", name, &e), RemoteError::Local)?;
        Ok(true)
    }

    fn size(&self, name: &str) -> Result<Option<u64>, RemoteError> {
        match fs::metadata(self.root.join(name)) {
            Ok(found) if found.is_file() => Ok(Some(found.len())),
            Ok(_) => Err(self.refused("read", name, &io::Error::other("it is not a plain file"))),
            Err(e) if e.kind() == ErrorKind::NotFound => Ok(None),
            Err(e) => Err(self.refused("look at", name, &e)),
        }
    }

    fn put(&self, name: &str, from: &mut (dyn Read + Send), _: u64) -> Result<(), RemoteError> {
        self.written(name, from, |sibling, target| fs::rename(sibling, target))
    }

    fn create(&self, name: &str, mut bytes: &[u8]) -> Result<bool, RemoteError> {
        // Creates a hard link to the whole file: unlike a rename, this fails if the name exists. Portable
        // disks often do not support hard links; there the file is written in place, and a partly written
        // file is detected by its digest or manifest.
        let whole = bytes;
        self.written(name, &mut bytes, |sibling, target| {
            let made = fs::hard_link(sibling, target).or_else(|e| match e.kind() {
                ErrorKind::AlreadyExists => Err(e),
                _ => {
                    let mut file = File::options().write(true).create_new(true).open(target)?;
                    file.write_all(whole).and_then(|()| file.sync_all())
                }
            });
            match made {
                Ok(()) => Ok(true),
                Err(e) if e.kind() == ErrorKind::AlreadyExists => Ok(false),
                Err(e) => Err(e),
            }
        })
    }

    fn list(&self, prefix: &str) -> Result<Vec<Listed>, RemoteError> {
        let mut found = Vec::new();
        for entry in walkdir::WalkDir::new(self.root.join(prefix)) {
            let entry = match entry {
                Ok(entry) => entry,
                // The file does not exist or was removed meanwhile.
                Err(e) if e.io_error().is_some_and(|e| e.kind() == ErrorKind::NotFound) => continue,
                Err(e) => return Err(self.refused("list", prefix, &io::Error::other(e))),
            };
            let name = entry.path().strip_prefix(&self.root).ok().and_then(files::relative_name);
            let (true, Some(name)) = (entry.file_type().is_file(), name) else { continue };
            let Ok(data) = entry.metadata() else { continue };
            let written = data.modified().unwrap_or(SystemTime::UNIX_EPOCH);
            found.push(Listed { name, size: data.len(), written });
        }
        Ok(found)
    }

    fn remove(&self, name: &str) -> Result<(), RemoteError> {
        match fs::remove_file(self.root.join(name)) {
            Err(e) if e.kind() != ErrorKind::NotFound => Err(self.refused("remove", name, &e)),
            _ => Ok(()),
        }
    }
}
