//! A store in memory, the reference for the other stores in tests.

use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::sync::{Mutex, MutexGuard};
use std::time::SystemTime;

use super::{Listed, Remote, RemoteError};
use crate::cache::lock;

/// Objects in memory.
#[derive(Debug, Default)]
pub struct Memory {
    objects: Mutex<BTreeMap<String, Vec<u8>>>,
}

impl Memory {
    /// The objects by name.
    pub fn objects(&self) -> MutexGuard<'_, BTreeMap<String, Vec<u8>>> {
        lock(&self.objects)
    }
}

impl Remote for Memory {
    fn place(&self) -> String {
        "memory".to_string()
    }

    fn get(&self, name: &str, to: &mut (dyn Write + Send)) -> Result<bool, RemoteError> {
        let bytes = self.objects().get(name).cloned();
        bytes.map_or(Ok(false), |bytes| to.write_all(&bytes).map(|()| true).map_err(RemoteError::Local))
    }

    fn size(&self, name: &str) -> Result<Option<u64>, RemoteError> {
        Ok(self.objects().get(name).map(|bytes| bytes.len() as u64))
    }

    fn put(&self, name: &str, from: &mut (dyn Read + Send), _: u64) -> Result<(), RemoteError> {
        let mut bytes = Vec::new();
        from.read_to_end(&mut bytes).map_err(RemoteError::Local)?;
        self.objects().insert(name.to_string(), bytes);
        Ok(())
    }

    fn create(&self, name: &str, bytes: &[u8]) -> Result<bool, RemoteError> {
        let mut objects = self.objects();
        let is_new = !objects.contains_key(name);
        if is_new {
            objects.insert(name.to_string(), bytes.to_vec());
        }
        Ok(is_new)
    }

    fn list(&self, prefix: &str) -> Result<Vec<Listed>, RemoteError> {
        let objects = self.objects();
        let of = |(name, bytes): (&String, &Vec<u8>)| {
            let written = SystemTime::UNIX_EPOCH;
            Listed { name: name.clone(), size: bytes.len() as u64, written }
        };
        Ok(objects.iter().filter(|(name, _)| name.starts_with(prefix)).map(of).collect())
    }

    fn remove(&self, name: &str) -> Result<(), RemoteError> {
        self.objects().remove(name);
        Ok(())
    }
}
