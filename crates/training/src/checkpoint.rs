//! Checkpoints of a training loop: one file, whole or absent.
//!
//! Layout: 16 bytes of magic and format version, the 32-byte BLAKE3 digest of everything after it, then the state in bincode's
//! standard configuration. A new checkpoint is written to a sibling, synced and renamed over the old one, so that the machine may die at
//! any moment and a good file remains. A file that is cut short, altered, or of another version is an error that says so; the loop
//! then starts anew (and the caller says so aloud), never from half a state. Internal state only: exchange formats are open ones.

use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

use serde::Serialize;
use serde::de::DeserializeOwned;

const MAGIC: &[u8; 16] = b"3d-use state v01";
const DIGEST: usize = 32;

/// Why a checkpoint could not be written or read.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// The file system refused.
    #[error("checkpoint {}: {source}{}", path.display(), advice(source))]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file is not a checkpoint of this version, is cut short, or was altered.
    #[error("checkpoint {}: {reason}; delete it to start anew", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// The state could not be encoded.
    #[error("the training state could not be encoded: {0}")]
    Encode(String),
}

/// What to do about a full disk.
fn advice(error: &std::io::Error) -> &'static str {
    match error.kind() {
        std::io::ErrorKind::StorageFull | std::io::ErrorKind::QuotaExceeded => {
            " (the disk is full: free some space and run again; the last whole checkpoint is kept)"
        }
        _ => "",
    }
}

fn write(path: &Path, body: &[u8]) -> std::io::Result<()> {
    let mut file = File::create(path)?;
    file.write_all(MAGIC)?;
    file.write_all(blake3::hash(body).as_bytes())?;
    file.write_all(body)?;
    file.sync_all()
}

/// The place of a loop's checkpoint.
#[derive(Clone, Debug)]
pub struct CheckpointFile {
    path: PathBuf,
}

impl CheckpointFile {
    /// `name` in `dir`; the folder is made when the first checkpoint is written.
    pub fn new(dir: &Path, name: &str) -> Self {
        Self { path: dir.join(name) }
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Writes the state in place of the last one.
    pub fn save<T: Serialize>(&self, state: &T) -> Result<(), CheckpointError> {
        let io = |source| CheckpointError::Io { path: self.path.clone(), source };
        let body = bincode::serde::encode_to_vec(state, bincode::config::standard())
            .map_err(|e| CheckpointError::Encode(e.to_string()))?;
        let dir = self.path.parent().unwrap_or(Path::new("."));
        fs::create_dir_all(dir).map_err(io)?;
        // Always the same sibling, so that a run killed while writing leaves at most one behind, and the next save overwrites it.
        let mut name = self.path.file_name().unwrap_or_default().to_os_string();
        name.push(".part");
        let part = self.path.with_file_name(name);
        let written = write(&part, &body).and_then(|()| fs::rename(&part, &self.path));
        if let Err(source) = written {
            // What is left of it only takes up room.
            let _ = fs::remove_file(&part);
            return Err(io(source));
        }
        // The rename itself must survive a power cut; some file systems cannot sync a folder, which is no reason to fail.
        if let Ok(folder) = File::open(dir) {
            let _ = folder.sync_all();
        }
        Ok(())
    }

    /// Reads the state back; `None` if there is no checkpoint.
    pub fn load<T: DeserializeOwned>(&self) -> Result<Option<T>, CheckpointError> {
        let bytes = match fs::read(&self.path) {
            Ok(bytes) => bytes,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(source) => return Err(CheckpointError::Io { path: self.path.clone(), source }),
        };
        let damaged =
            |reason: &str| CheckpointError::Damaged { path: self.path.clone(), reason: reason.into() };
        let rest = bytes
            .strip_prefix(MAGIC.as_slice())
            .ok_or_else(|| damaged("it was written by another version, or is not a checkpoint"))?;
        if rest.len() < DIGEST {
            return Err(damaged("it is cut short"));
        }
        let (digest, body) = rest.split_at(DIGEST);
        if blake3::hash(body).as_bytes() != digest {
            return Err(damaged("its digest does not match its contents"));
        }
        // The digest vouches for the contents, the limit for a state of another shape with an absurd length in it.
        let config = bincode::config::standard();
        match bincode::serde::decode_from_slice::<T, _>(body, config) {
            Ok((state, used)) if used == body.len() => Ok(Some(state)),
            Ok(_) => Err(damaged("it holds more than this version's state")),
            Err(e) => Err(damaged(&format!("its state does not decode ({e})"))),
        }
    }

    /// Removes the checkpoint, if there is one.
    pub fn remove(&self) -> Result<(), CheckpointError> {
        match fs::remove_file(&self.path) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => {
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
    struct State {
        step: u64,
        values: Vec<f32>,
    }

    #[test]
    fn a_state_comes_back_and_a_later_one_replaces_it() {
        let dir = tempfile::tempdir().unwrap();
        let file = CheckpointFile::new(&dir.path().join("deep/down"), "state.bin");
        assert!(file.load::<State>().unwrap().is_none());
        for step in [1, 2] {
            let state = State { step, values: vec![step as f32, f32::MIN_POSITIVE, -0.0] };
            file.save(&state).unwrap();
            assert_eq!(file.load::<State>().unwrap().unwrap(), state);
        }
        // Nothing but the checkpoint lies there.
        assert_eq!(fs::read_dir(dir.path().join("deep/down")).unwrap().count(), 1);
        file.remove().unwrap();
        file.remove().unwrap();
        assert!(file.load::<State>().unwrap().is_none());
    }

    #[test]
    fn every_cut_and_every_flipped_byte_is_noticed() {
        let dir = tempfile::tempdir().unwrap();
        let file = CheckpointFile::new(dir.path(), "state.bin");
        file.save(&State { step: 3, values: vec![0.5; 9] }).unwrap();
        let good = fs::read(file.path()).unwrap();
        for cut in 0..good.len() {
            fs::write(file.path(), &good[..cut]).unwrap();
            assert!(matches!(file.load::<State>(), Err(CheckpointError::Damaged { .. })), "cut at {cut}");
        }
        for at in 0..good.len() {
            let mut bad = good.clone();
            bad[at] ^= 0x10;
            fs::write(file.path(), &bad).unwrap();
            assert!(file.load::<State>().is_err(), "flip at {at}");
        }
    }
}
