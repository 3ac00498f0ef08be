//! Checkpoints of a training loop: one file, complete or absent.
//!
//! Layout: 16 bytes of magic and format version, the 32-byte BLAKE3 digest of everything after it, then the
//! state in bincode's standard configuration. The state is written and read through a small buffer, so a
//! checkpoint needs no memory of its own size. A new one is written to a temporary sibling, synced and
//! renamed over the old one. So the machine may stop at any moment, several processes may write the same file
//! at once, and a good file remains. A file that is cut short, altered, or of another version is an error
//! with that reason; the loop then starts from the beginning (and the caller reports it), never from a
//! damaged state. The format is for internal state only: exchange formats are open ones.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io::{BufRead, BufReader, BufWriter, ErrorKind, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use bincode::error::{DecodeError, EncodeError};
use serde::Serialize;
use serde::de::DeserializeOwned;

/// The version rises with every change to the form of a loop's state: the error for an older file then names
/// its version.
const MAGIC: &[u8; 16] = b"3d-use state v04";
const DIGEST: usize = blake3::OUT_LEN;
/// Number of bytes that are digested, written or read at a time.
const BLOCK: usize = 1 << 20;

/// The reason why a checkpoint could not be written or read.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// A file operation failed.
    #[error("checkpoint {}: {source}{}", path.display(), advice(source))]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The file is not a checkpoint of this version, is cut short, or was altered.
    #[error("checkpoint {}: {reason}; delete it to start from the beginning", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// The problem.
        reason: String,
    },
    /// The state could not be encoded.
    #[error("the training state could not be encoded: {0}")]
    Encode(String),
}

/// The advice for a full disk.
fn advice(error: &std::io::Error) -> &'static str {
    match error.kind() {
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded => {
            " (the disk is full: free some space and run again)"
        }
        _ => "",
    }
}

/// Writes bytes to a file and digests them.
struct Digesting {
    file: File,
    hasher: blake3::Hasher,
}

impl Write for Digesting {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let written = self.file.write(bytes)?;
        self.hasher.update(&bytes[..written]);
        Ok(written)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.file.flush()
    }
}

/// The text in a sibling's name between the file's own name and the suffix that distinguishes siblings.
const PART: &str = ".part-";
/// The time for which a sibling must be unchanged, by this process's own clock, before its writer counts as
/// ended. Locks would show this sooner if all machines that share a folder agreed on them; on network file
/// systems they may not work, or may hang.
const ABANDONED: Duration = Duration::from_secs(600);

/// Creates a sibling of `path` that no other process on any machine and no other thread writes.
fn create_sibling(path: &Path) -> std::io::Result<(PathBuf, File)> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    use3d_files::create_beside(path, &format!("{name}{PART}"), "")
}

/// Removes the unfinished files of killed processes from a folder of checkpoints. A training calls it again
/// and again.
pub(crate) fn sweep(dir: &Path) {
    sweep_at(dir, Instant::now());
}

fn sweep_at(dir: &Path, now: Instant) {
    type FileState = (u64, Option<SystemTime>, Instant);
    static SEEN: Mutex<BTreeMap<PathBuf, FileState>> = Mutex::new(BTreeMap::new());
    let mut seen = SEEN.lock().unwrap_or_else(PoisonError::into_inner);
    let mut there = BTreeSet::new();
    for entry in fs::read_dir(dir).into_iter().flatten().filter_map(Result::ok) {
        if !entry.file_name().to_string_lossy().contains(PART) {
            continue;
        }
        let (path, Ok(data)) = (entry.path(), entry.metadata()) else { continue };
        let (size, modified) = (data.len(), data.modified().ok());
        match seen.get(&path) {
            Some((s, m, since)) if (*s, *m) == (size, modified) => {
                if now.saturating_duration_since(*since) >= ABANDONED {
                    let _ = fs::remove_file(&path);
                }
            }
            _ => {
                seen.insert(path.clone(), (size, modified, now));
            }
        }
        there.insert(path);
    }
    seen.retain(|path, _| path.parent() != Some(dir) || there.contains(path));
}

/// Writes and syncs a whole file. The digest is known only at the end and then written in its place; until
/// then the file has no valid digest.
fn write(mut file: File, state: &impl Serialize) -> Result<(), EncodeError> {
    let io = |inner| EncodeError::Io { inner, index: 0 };
    file.write_all(MAGIC).and_then(|()| file.write_all(&[0; DIGEST])).map_err(io)?;
    let mut body = BufWriter::with_capacity(BLOCK, Digesting { file, hasher: blake3::Hasher::new() });
    bincode::serde::encode_into_std_write(state, &mut body, bincode::config::standard())?;
    let Digesting { mut file, hasher } = body.into_inner().map_err(|e| io(e.into_error()))?;
    file.seek(SeekFrom::Start(MAGIC.len() as u64))
        .and_then(|_| file.write_all(hasher.finalize().as_bytes()))
        .and_then(|()| file.sync_all())
        .map_err(io)
}

/// The path of a loop's checkpoint.
#[derive(Clone, Debug)]
pub struct CheckpointFile {
    path: PathBuf,
}

impl CheckpointFile {
    /// The file `name` in `dir`; the folder is created when the first checkpoint is written.
    pub fn new(dir: &Path, name: &str) -> Self {
        Self::at(dir.join(name))
    }

    /// The file at `path`.
    pub fn at(path: PathBuf) -> Self {
        Self { path }
    }

    /// The path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Replaces the last state by this one.
    ///
    /// If the folder is removed meanwhile, it is created again. If it is removed again and again, there is no
    /// checkpoint but a warning, and the training continues, because checkpoints only protect its work.
    pub fn save<T: Serialize>(&self, state: &T) -> Result<(), CheckpointError> {
        for _ in 0..3 {
            match self.save_once(state) {
                Err(CheckpointError::Io { source, .. }) if source.kind() == ErrorKind::NotFound => {}
                other => return other,
            }
        }
        tracing::warn!(
            "the checkpoint {} was removed right after it was written; continuing without it",
            self.path.display()
        );
        Ok(())
    }

    fn save_once<T: Serialize>(&self, state: &T) -> Result<(), CheckpointError> {
        let io = |source| CheckpointError::Io { path: self.path.clone(), source };
        let dir = self.path.parent().unwrap_or(Path::new("."));
        fs::create_dir_all(dir).map_err(io)?;
        let (part, file) = create_sibling(&self.path).map_err(io)?;
        let written = match write(file, state) {
            Ok(()) => fs::rename(&part, &self.path).map_err(io),
            Err(EncodeError::Io { inner, .. }) => Err(io(inner)),
            Err(error) => Err(CheckpointError::Encode(error.to_string())),
        };
        if written.is_err() {
            // The unfinished file only takes up space.
            let _ = fs::remove_file(&part);
            return written;
        }
        // The sync makes the rename itself survive a power cut; some file systems cannot sync a folder, which
        // is no reason to fail.
        if let Ok(folder) = File::open(dir) {
            let _ = folder.sync_all();
        }
        Ok(())
    }

    /// Reads the state back; `None` if there is no checkpoint.
    pub fn load<T: DeserializeOwned>(&self) -> Result<Option<T>, CheckpointError> {
        let io = |source| CheckpointError::Io { path: self.path.clone(), source };
        let damaged =
            |reason: &str| CheckpointError::Damaged { path: self.path.clone(), reason: reason.into() };
        let mut file = match File::open(&self.path) {
            Ok(file) => file,
            Err(e) if e.kind() == ErrorKind::NotFound => return Ok(None),
            Err(e) => return Err(io(e)),
        };
        let mut head = [0; MAGIC.len() + DIGEST];
        file.read_exact(&mut head).map_err(|e| match e.kind() {
            ErrorKind::UnexpectedEof => damaged("it is cut short"),
            _ => io(e),
        })?;
        let (magic, digest) = head.split_at(MAGIC.len());
        if magic != MAGIC {
            return Err(damaged("it was written by another version, or is not a checkpoint"));
        }
        let mut hasher = blake3::Hasher::new();
        hasher.update_reader(&file).map_err(io)?;
        if hasher.finalize().as_bytes() != digest {
            return Err(damaged("its digest does not match its contents"));
        }
        file.seek(SeekFrom::Start(head.len() as u64)).map_err(io)?;
        let mut body = BufReader::with_capacity(BLOCK, file);
        // The digest protects the contents. A state of another form still cannot cause huge allocations,
        // because arrays grow while they are read.
        match bincode::serde::decode_from_std_read::<T, _, _>(&mut body, bincode::config::standard()) {
            Ok(state) if body.fill_buf().map_err(io)?.is_empty() => Ok(Some(state)),
            Ok(_) => Err(damaged("it contains more than the state of this version")),
            Err(DecodeError::Io { inner, .. }) if inner.kind() != ErrorKind::UnexpectedEof => Err(io(inner)),
            Err(e) => Err(damaged(&format!("its state does not decode ({e})"))),
        }
    }

    /// Removes the checkpoint, if there is one.
    pub fn remove(&self) -> Result<(), CheckpointError> {
        match fs::remove_file(&self.path) {
            Err(e) if e.kind() != ErrorKind::NotFound => {
                Err(CheckpointError::Io { path: self.path.clone(), source: e })
            }
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use serde::Deserialize;

    use super::*;

    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    struct SavedValues {
        step: u64,
        values: Vec<f32>,
    }

    #[test]
    fn a_state_comes_back_and_a_later_one_replaces_it() {
        let dir = tempfile::tempdir().unwrap();
        let file = CheckpointFile::new(&dir.path().join("deep/down"), "state.bin");
        assert!(file.load::<SavedValues>().unwrap().is_none());
        for step in [1, 2] {
            let state = SavedValues { step, values: vec![step as f32, f32::MIN_POSITIVE, -0.0] };
            file.save(&state).unwrap();
            assert_eq!(file.load::<SavedValues>().unwrap().unwrap(), state);
        }
        // A state of another version is refused, even if it is complete.
        assert!(matches!(file.load::<(SavedValues, SavedValues)>(), Err(CheckpointError::Damaged { .. })));
        assert!(matches!(file.load::<u64>(), Err(CheckpointError::Damaged { .. })));
        // The folder contains only the checkpoint.
        assert_eq!(fs::read_dir(dir.path().join("deep/down")).unwrap().count(), 1);
        file.remove().unwrap();
        file.remove().unwrap();
        assert!(file.load::<SavedValues>().unwrap().is_none());
    }

    #[test]
    fn what_a_killed_writer_left_is_removed_and_what_is_being_written_is_not() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("state.bin");
        let (written, mut file) = create_sibling(&path).unwrap();
        let (left, _) = create_sibling(&path).unwrap();
        assert_ne!(written, left);
        // The writer may be on another machine, where neither locks nor process ids are visible: the growing
        // file shows that it is alive.
        let now = Instant::now();
        for minutes in [0, 5, 9] {
            sweep_at(dir.path(), now + Duration::from_secs(60 * minutes));
            file.write_all(b"more").unwrap();
        }
        assert!(written.exists() && left.exists());
        sweep_at(dir.path(), now + ABANDONED);
        assert!(written.exists() && !left.exists());
    }

    #[test]
    fn writers_of_one_file_do_not_meet() {
        let dir = tempfile::tempdir().unwrap();
        let file = CheckpointFile::new(&dir.path().join("shared"), "state.bin");
        std::thread::scope(|scope| {
            for writer in 0..4u64 {
                let file = file.clone();
                scope.spawn(move || {
                    for step in 0..40 {
                        file.save(&SavedValues { step, values: vec![writer as f32; 3000] }).unwrap();
                        let read = file.load::<SavedValues>().unwrap().expect("whole at every moment");
                        assert!(read.values.iter().all(|v| *v == read.values[0]));
                    }
                });
            }
        });
        assert_eq!(fs::read_dir(dir.path().join("shared")).unwrap().count(), 1);
    }

    #[test]
    fn a_state_that_fails_halfway_leaves_the_last_one() {
        struct Faulty;
        impl Serialize for Faulty {
            fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                use serde::ser::{Error, SerializeTuple};

                // More than a block, so that a part of it is in the file by then.
                let mut tuple = serializer.serialize_tuple(BLOCK)?;
                for _ in 0..BLOCK {
                    tuple.serialize_element(&1.0f32)?;
                }
                Err(S::Error::custom("out of words"))
            }
        }

        let dir = tempfile::tempdir().unwrap();
        let file = CheckpointFile::new(dir.path(), "state.bin");
        let good = SavedValues { step: 1, values: vec![0.25] };
        file.save(&good).unwrap();
        let error = file.save(&Faulty).unwrap_err();
        assert!(error.to_string().contains("out of words"), "{error}");
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
        assert_eq!(file.load::<SavedValues>().unwrap().unwrap(), good);
    }

    #[test]
    fn every_cut_and_every_flipped_byte_is_noticed() {
        let dir = tempfile::tempdir().unwrap();
        let file = CheckpointFile::new(dir.path(), "state.bin");
        file.save(&SavedValues { step: 3, values: vec![0.5; 9] }).unwrap();
        let good = fs::read(file.path()).unwrap();
        for cut in 0..good.len() {
            fs::write(file.path(), &good[..cut]).unwrap();
            assert!(
                matches!(file.load::<SavedValues>(), Err(CheckpointError::Damaged { .. })),
                "cut at {cut}"
            );
        }
        for at in 0..good.len() {
            let mut bad = good.clone();
            bad[at] ^= 0x10;
            fs::write(file.path(), &bad).unwrap();
            assert!(file.load::<SavedValues>().is_err(), "flip at {at}");
        }
    }
}
