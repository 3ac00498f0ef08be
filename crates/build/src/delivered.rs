//! What was delivered into a results folder, so that a run that finds everything there reads nothing of it
//! again: one small file for every part of the folder, such as a scene's, kept in the cache.
//!
//! ```text
//! <cache>/v1/delivered/<results folder>/<part>.json
//! ```
//!
//! A note says what the part was made of, and how its files looked when that was done: names, sizes, times and
//! inodes, in one digest. As long as they look the same, nobody has changed, added or removed one, and the part
//! is ours as it was delivered. Without a note, or where anything differs, every place is looked at as closely as
//! ever ([`place`](super::place)). So losing a note costs only time.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use serde::{Deserialize, Serialize};

use super::cache::Cache;
use super::digest::{Digest, Encoder};
use super::error::FileError;
use super::files;

/// What a part of a results folder was made of: by place, a key or another text that says it.
pub type MadeOf = BTreeMap<String, String>;

#[derive(Deserialize, Serialize)]
struct Note {
    format: String,
    made_of: MadeOf,
    looks: Digest,
}

const FORMAT: &str = "use3d delivered 1";
/// How long to wait, and how often, until the clock of the file system has gone on.
const TICK: (Duration, u32) = (Duration::from_millis(5), 20);

/// The notes of one results folder.
#[derive(Clone)]
pub struct Notes {
    cache: Cache,
    out: PathBuf,
    folder: PathBuf,
}

impl Notes {
    /// Of the results folder `out`.
    pub fn of(cache: &Cache, out: &Path) -> Self {
        let out = std::path::absolute(out).unwrap_or_else(|_| out.to_path_buf());
        let real = out.canonicalize().unwrap_or_else(|_| out.clone());
        let name = Digest::of(real.as_os_str().as_encoded_bytes()).short();
        Self { cache: cache.clone(), folder: cache.root().join("delivered").join(name), out }
    }

    fn note(&self, part: &str) -> PathBuf {
        self.folder.join(format!("{}.json", Digest::of(part.as_bytes()).short()))
    }

    /// What a part is made of, where it looks as it did when it was delivered; nothing otherwise. `paths` are
    /// the part's files and folders, relative to the results folder.
    pub fn standing(&self, part: &str, paths: &[PathBuf]) -> MadeOf {
        let read = || -> Option<MadeOf> {
            let bytes = self.cache.files().read(&self.note(part)).ok()?;
            let note: Note = serde_json::from_slice(&bytes).ok()?;
            let same = note.format == FORMAT && self.looks(paths)?.digest == note.looks;
            same.then_some(note.made_of)
        };
        read().unwrap_or_default()
    }

    /// Notes that a part was delivered.
    ///
    /// # Errors
    /// A note that cannot be written; the part is delivered all the same.
    pub fn keep(&self, part: &str, paths: &[PathBuf], made_of: MadeOf) -> Result<(), FileError> {
        let path = self.note(part);
        files::at(&self.folder, "create", self.cache.files().create_dir_all(&self.folder))?;
        for _ in 0..TICK.1 {
            let Some(looks) = self.looks(paths) else { break };
            // What is changed within the same tick of the clock could not be told from what was delivered.
            if looks.newest.is_some_and(|newest| newest < self.present(&path)) {
                let note = Note { format: FORMAT.to_string(), made_of, looks: looks.digest };
                let bytes = serde_json::to_vec(&note).unwrap_or_default();
                return files::write_atomic(self.cache.files(), &path, &bytes);
            }
            std::thread::sleep(TICK.0);
        }
        // What cannot be told is not noted.
        let _ = self.cache.files().remove_file(&path);
        Ok(())
    }

    /// The time that the system gives to a file which is written now.
    fn present(&self, beside: &Path) -> SystemTime {
        let probe = use3d_files::create_beside(beside, "now-", "");
        let Ok((path, file)) = probe else { return SystemTime::UNIX_EPOCH };
        let now = file.metadata().and_then(|m| m.modified()).unwrap_or(SystemTime::UNIX_EPOCH);
        let _ = std::fs::remove_file(path);
        now
    }

    /// How files and folders look now; `None` where something cannot be looked at.
    fn looks(&self, paths: &[PathBuf]) -> Option<Looks> {
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
        Some(Looks { digest: encoder.finish(), newest })
    }
}

struct Looks {
    digest: Digest,
    newest: Option<SystemTime>,
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
        let made_of = MadeOf::from([("scene".to_string(), "key".to_string())]);
        let deliver = || {
            std::fs::create_dir_all(out.join("reef/deep")).unwrap();
            std::fs::write(out.join("reef/deep/a"), "one").unwrap();
            notes.keep("reef", &parts, made_of.clone()).unwrap();
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
            assert_eq!(notes.standing("reef", &parts), made_of);
            assert!(notes.standing("wreck", &parts).is_empty());
            change(&out);
            assert!(notes.standing("reef", &parts).is_empty());
        }
        deliver();
        assert!(Notes::of(&cache, &dir.path().join("elsewhere")).standing("reef", &parts).is_empty());
    }
}
