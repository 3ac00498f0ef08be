//! Notes about delivered results, so that a run with nothing to do does not read the results again. The cache
//! holds one small note for every part of a results folder, such as the folder of a scene.
//!
//! ```text
//! <cache>/v1/delivered/<results folder>/<part>.json
//! ```
//!
//! A note lists the sources of the part, and has a digest of the names, sizes, times and inodes of its files
//! at the time of delivery. If this digest is the same now, no file was changed, added or removed, and the
//! part is ours as it was delivered. Without a note, or with another digest, every place is examined as
//! closely as before ([`place`](crate::cache::place)). So the loss of a note costs only time.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use serde::{Deserialize, Serialize};

use crate::cache::artifacts::Cache;
use crate::cache::files;
use crate::error::FileError;
use use3d_code::digest::{Digest, Encoder};

/// The sources of a part of a results folder: by place, a key or another text that identifies the source.
pub type Sources = BTreeMap<String, String>;

#[derive(Deserialize, Serialize)]
struct Note {
    format: String,
    sources: Sources,
    state: Digest,
}

const FORMAT: &str = "use3d delivered 2";
/// The pause and the number of pauses until the clock of the file system has advanced.
const TICK: (Duration, u32) = (Duration::from_millis(5), 20);

/// The notes of one results folder.
#[derive(Clone)]
pub struct Notes {
    cache: Cache,
    out: PathBuf,
    folder: PathBuf,
}

impl Notes {
    /// The notes of the results folder `out`.
    pub fn of(cache: &Cache, out: &Path) -> Self {
        let out = std::path::absolute(out).unwrap_or_else(|_| out.to_path_buf());
        let real = out.canonicalize().unwrap_or_else(|_| out.clone());
        let name = Digest::of(real.as_os_str().as_encoded_bytes()).short();
        Self { cache: cache.clone(), folder: cache.root().join("delivered").join(name), out }
    }

    fn note(&self, part: &str) -> PathBuf {
        self.folder.join(format!("{}.json", Digest::of(part.as_bytes()).short()))
    }

    /// Returns the sources of a part if its files are unchanged since its delivery, and nothing otherwise.
    /// `paths` are the part's files and folders, relative to the results folder.
    pub fn standing(&self, part: &str, paths: &[PathBuf]) -> Sources {
        let read = || -> Option<Sources> {
            let bytes = self.cache.files().read(&self.note(part)).ok()?;
            let note: Note = serde_json::from_slice(&bytes).ok()?;
            let same = note.format == FORMAT && self.state(paths)?.0 == note.state;
            same.then_some(note.sources)
        };
        read().unwrap_or_default()
    }

    /// Writes the note of a delivered part.
    ///
    /// # Errors
    /// An error if the note cannot be written; the part is delivered nevertheless.
    pub fn keep(&self, part: &str, paths: &[PathBuf], sources: Sources) -> Result<(), FileError> {
        let path = self.note(part);
        files::at(&self.folder, "create", self.cache.files().create_dir_all(&self.folder))?;
        if let Some((digest, Some(newest))) = self.state(paths) {
            // A change within the same clock tick could not be distinguished from the delivery.
            let over = (0..TICK.1).any(|_| {
                let over = newest < self.file_system_now(&path);
                if !over {
                    std::thread::sleep(TICK.0);
                }
                over
            });
            if over && self.state(paths).is_some_and(|(now, _)| now == digest) {
                let note = Note { format: FORMAT.to_string(), sources, state: digest };
                let bytes = serde_json::to_vec(&note).unwrap_or_default();
                return files::write_atomic(self.cache.files(), &path, &bytes);
            }
        }
        // Without a sure digest there is no note.
        let _ = self.cache.files().remove_file(&path);
        Ok(())
    }

    /// Returns the time that the file system gives to a file which is written now.
    fn file_system_now(&self, beside: &Path) -> SystemTime {
        let probe = use3d_files::create_beside(beside, "now-", "");
        let Ok((path, file)) = probe else { return SystemTime::UNIX_EPOCH };
        let now = file.metadata().and_then(|m| m.modified()).unwrap_or(SystemTime::UNIX_EPOCH);
        let _ = std::fs::remove_file(path);
        now
    }

    /// Returns a digest of the present state of files and folders, and the time of the last change; `None` if
    /// one of them cannot be read.
    fn state(&self, paths: &[PathBuf]) -> Option<(Digest, Option<SystemTime>)> {
        let mut encoder = Encoder::new("use3d 2026 looks of results v1");
        let mut newest = None;
        for path in paths {
            let from = self.out.join(path);
            if std::fs::symlink_metadata(&from).is_err_and(|e| e.kind() == std::io::ErrorKind::NotFound) {
                encoder.text("nothing").bytes(path.as_os_str().as_encoded_bytes());
                continue;
            }
            for entry in walkdir::WalkDir::new(&from).sort_by_file_name() {
                let entry = entry.ok()?;
                if entry.file_type().is_dir() {
                    continue;
                }
                let (data, relative) = (entry.metadata().ok()?, entry.path().strip_prefix(&self.out).ok()?);
                encoder.bytes(relative.as_os_str().as_encoded_bytes()).number(data.len());
                let modified = data.modified().ok()?;
                let since = modified.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
                encoder.bytes(&since.as_nanos().to_le_bytes());
                #[cfg(unix)]
                {
                    use std::os::unix::fs::MetadataExt;
                    encoder.number(data.ino()).number(data.mode().into());
                    encoder.number(data.ctime().cast_unsigned()).number(data.ctime_nsec().cast_unsigned());
                }
                newest = newest.max(Some(modified));
            }
        }
        Some((encoder.finish(), newest))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_delivered_stands_until_anything_of_it_changes() {
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path().join("out");
        let cache = Cache::open(&dir.path().join("cache"), false).unwrap();
        let notes = Notes::of(&cache, &out);
        let parts = [PathBuf::from("reef"), PathBuf::from("view.html")];
        let sources = Sources::from([("scene".to_string(), "key".to_string())]);
        let deliver = || {
            std::fs::create_dir_all(out.join("reef/deep")).unwrap();
            std::fs::write(out.join("reef/deep/a"), "one").unwrap();
            notes.keep("reef", &parts, sources.clone()).unwrap();
        };
        assert!(notes.standing("reef", &parts).is_empty());
        type Change = fn(&Path);
        let changes: [Change; 5] = [
            |out| std::fs::write(out.join("reef/deep/a"), "two").unwrap(),
            |out| std::fs::write(out.join("reef/mine"), "mine").unwrap(),
            |out| std::fs::remove_file(out.join("reef/deep/a")).unwrap(),
            |out| std::fs::write(out.join("view.html"), "mine").unwrap(),
            |out| std::fs::rename(out.join("reef/deep"), out.join("reef/depth")).unwrap(),
        ];
        for change in changes {
            deliver();
            assert_eq!(notes.standing("reef", &parts), sources);
            assert!(notes.standing("wreck", &parts).is_empty());
            change(&out);
            assert!(notes.standing("reef", &parts).is_empty());
        }
        deliver();
        assert!(Notes::of(&cache, &dir.path().join("elsewhere")).standing("reef", &parts).is_empty());
    }
}
