//! A store in memory whose answers are late, wrong, incomplete or missing, as a test asks.

use std::io::{Read, Write};

use use3d_workflow::remote::{Listed, Memory, Remote, RemoteError};

/// The faults of a store.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Fault {
    /// Answers 503.
    Unavailable,
    /// Performs the operation, and answers 503.
    AnswerLost,
    /// Performs the operation and loses the reply, and its client repeats the request by itself.
    AskedTwice,
    /// Answers 403.
    Forbidden,
    /// Sends only the first half, as if it were complete.
    Truncated,
    /// Sends the first half and breaks the connection.
    BrokenOff,
    /// Sends other bytes.
    Wrong,
    /// Sends more bytes than the object has.
    More,
    /// Sends one byte at a time.
    Slow,
    /// Answers that the object does not exist.
    Missing,
    /// Creates an object that exists already.
    Careless,
}

/// Chooses the fault of an operation on a name.
type Faults = Box<dyn Fn(&str, &str) -> Option<Fault> + Send + Sync>;

/// A store in memory with faults.
pub(super) struct Faulty {
    pub(super) inner: Memory,
    fault: Faults,
}

impl Faulty {
    pub(super) fn new(fault: impl Fn(&str, &str) -> Option<Fault> + Send + Sync + 'static) -> Self {
        Self { inner: Memory::default(), fault: Box::new(fault) }
    }

    fn refused(&self, doing: &'static str, name: &str, passing: bool) -> RemoteError {
        let reason = if passing { "503 Slow Down" } else { "403 Forbidden" }.to_string();
        RemoteError::Refused { place: self.place(), doing, name: name.to_string(), reason, passing }
    }

    fn asked(&self, doing: &'static str, name: &str) -> Result<Option<Fault>, RemoteError> {
        match (self.fault)(doing, name) {
            Some(Fault::Unavailable) => Err(self.refused(doing, name, true)),
            Some(Fault::Forbidden) => Err(self.refused(doing, name, false)),
            fault => Ok(fault),
        }
    }

    fn answer<T>(&self, fault: Option<Fault>, name: &str, done: T) -> Result<T, RemoteError> {
        if fault == Some(Fault::AnswerLost) { Err(self.refused("hear of", name, true)) } else { Ok(done) }
    }
}

impl Remote for Faulty {
    fn place(&self) -> String {
        "faulty".to_string()
    }

    fn get(&self, name: &str, to: &mut (dyn Write + Send)) -> Result<bool, RemoteError> {
        let fault = self.asked("get", name)?;
        let Some(mut bytes) = self.inner.objects().get(name).cloned() else { return Ok(false) };
        let half = bytes.len() / 2;
        match fault {
            Some(Fault::Missing) => return Ok(false),
            Some(Fault::Truncated | Fault::BrokenOff) => bytes.truncate(half),
            Some(Fault::Wrong) => bytes[half] ^= 1,
            Some(Fault::More) => bytes.push(0),
            _ => {}
        }
        let size = if fault == Some(Fault::Slow) { 1 } else { bytes.len().max(1) };
        for piece in bytes.chunks(size) {
            to.write_all(piece).map_err(RemoteError::Local)?;
        }
        if fault == Some(Fault::BrokenOff) {
            Err(self.refused("get", name, true))
        } else {
            self.answer(fault, name, true)
        }
    }

    fn size(&self, name: &str) -> Result<Option<u64>, RemoteError> {
        let fault = self.asked("size", name)?;
        let size = self.inner.size(name)?;
        self.answer(fault, name, size)
    }

    fn put(&self, name: &str, from: &mut (dyn Read + Send), size: u64) -> Result<(), RemoteError> {
        let fault = self.asked("put", name)?;
        self.inner.put(name, from, size)?;
        self.answer(fault, name, ())
    }

    fn create(&self, name: &str, bytes: &[u8]) -> Result<bool, RemoteError> {
        let fault = self.asked("create", name)?;
        if fault == Some(Fault::Careless) {
            self.inner.objects().insert(name.to_string(), bytes.to_vec());
            return Ok(true);
        }
        if fault == Some(Fault::AskedTwice) {
            self.inner.create(name, bytes)?;
        }
        let created = self.inner.create(name, bytes)?;
        self.answer(fault, name, created)
    }

    fn remove(&self, name: &str) -> Result<(), RemoteError> {
        if (self.fault)("remove", name) == Some(Fault::Forbidden) {
            return Err(self.refused("remove", name, false));
        }
        self.inner.remove(name)
    }

    fn list(&self, prefix: &str) -> Result<Vec<Listed>, RemoteError> {
        let fault = self.asked("list", prefix)?;
        let found = self.inner.list(prefix)?;
        self.answer(fault, prefix, found)
    }
}
