//! Checks of bytes during a transfer: they are counted, digested and compared.

use std::io::{self, Read, Write};
use std::path::{Component, Path};
use std::sync::atomic::{AtomicBool, Ordering};

use crate::cache::files;
use crate::cache::manifest::{FileRecord, MANIFEST, Manifest};
use use3d_code::digest::Digest;

/// Receives the bytes of a file and refuses more bytes than expected.
pub(super) struct Receiver<'a, W> {
    to: W,
    hasher: blake3::Hasher,
    count: u64,
    most: u64,
    stop: &'a AtomicBool,
    /// True if there were more bytes than expected.
    pub(super) overfull: bool,
}

impl<'a, W: Write> Receiver<'a, W> {
    pub(super) fn new(to: W, most: u64, stop: &'a AtomicBool) -> Self {
        Self { to, hasher: blake3::Hasher::new(), count: 0, most, stop, overfull: false }
    }

    /// The problem with the received bytes, if there is one.
    pub(super) fn wrong(&self, file: &FileRecord) -> Option<String> {
        if self.overfull || self.count != file.size {
            let came = if self.overfull { "more".to_string() } else { self.count.to_string() };
            return Some(format!("has {came} bytes; expected {}", file.size));
        }
        let digest = Digest::from(self.hasher.finalize());
        (digest != file.digest).then(|| "has other bytes than its digest says".to_string())
    }

    pub(super) fn into_inner(self) -> W {
        self.to
    }
}

impl<W: Write> Write for Receiver<'_, W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.stop.load(Ordering::Relaxed) {
            return Err(io::Error::other("interrupted"));
        }
        if bytes.len() as u64 > self.most - self.count {
            self.overfull = true;
            return Err(io::Error::other("more bytes than expected"));
        }
        let written = self.to.write(bytes)?;
        self.hasher.update(&bytes[..written]);
        self.count += written as u64;
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.to.flush()
    }
}

/// Supplies the bytes of a file, and fails at their end if they do not match its digest, so that a file that
/// has changed meanwhile is never sent under the old name.
pub(super) struct Sender<'a, R> {
    from: R,
    hasher: blake3::Hasher,
    count: u64,
    file: &'a FileRecord,
    stop: &'a AtomicBool,
}

impl<'a, R: Read> Sender<'a, R> {
    pub(super) fn new(from: R, file: &'a FileRecord, stop: &'a AtomicBool) -> Self {
        Self { from, hasher: blake3::Hasher::new(), count: 0, file, stop }
    }
}

impl<R: Read> Read for Sender<'_, R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if self.stop.load(Ordering::Relaxed) {
            return Err(io::Error::other("interrupted"));
        }
        let read = self.from.read(buffer)?;
        self.hasher.update(&buffer[..read]);
        self.count += read as u64;
        let ended = read == 0 && !buffer.is_empty();
        let same =
            || self.count == self.file.size && Digest::from(self.hasher.finalize()) == self.file.digest;
        if self.count > self.file.size || (ended && !same()) {
            return Err(io::Error::other(format!("{} has changed since it was written", self.file.path)));
        }
        Ok(read)
    }
}

/// The problem with the file names in a manifest from elsewhere, if there is one: all files must lie in one
/// folder and nowhere else.
pub(super) fn wrong_names(manifest: &Manifest) -> Option<String> {
    let refused = |name: &str| Some(format!("names a file {name:?}, which no artifact has"));
    for file in &manifest.files {
        let path = Path::new(&file.path);
        let plain = path.components().all(|part| matches!(part, Component::Normal(_)));
        let as_written = files::relative_name(path).as_deref() == Some(file.path.as_str());
        let odd = file.path.is_empty() || file.path.contains(['\0', '\\']) || !as_written;
        if !plain || odd || file.path == MANIFEST {
            return refused(&file.path);
        }
    }
    // Paths are compared by components, so a file that is also a folder comes just before what it holds.
    let mut paths: Vec<&Path> = manifest.files.iter().map(|file| Path::new(&file.path)).collect();
    paths.sort();
    let twice = paths.windows(2).find(|pair| pair[1].starts_with(pair[0]))?;
    refused(&twice[1].to_string_lossy())
}
