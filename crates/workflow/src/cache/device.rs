//! The classes of the devices that have computed into a cache.
//!
//! The key of a stage on a graphics card contains the card's class. A machine without the card learns the
//! class from the cache, so that it can plan, report and read what the card has made.
//!
//! ```text
//! <folder>/v1/devices/<name>.json                 the class of the last device that answered to a name
//! <folder>/v1/devices/<name> of <submission>.json the class of the first one in a submission
//! ```
//!
//! The first device of a submission decides for the whole submission.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::cache::artifacts::Cache;
use crate::cache::files;
use crate::cache::key::DeviceClass;
use crate::cache::lock;
use crate::error::FileError;
use use3d_code::digest::Digest;

/// The record of a device.
#[derive(Deserialize, Serialize)]
struct Answered {
    /// The name that it answered to, for readers of the file.
    name: String,
    class: DeviceClass,
}

/// The answers of this process: the name and class of a device here, and the class that counts.
pub(crate) type Answers = Vec<((String, DeviceClass), DeviceClass)>;

impl Cache {
    fn device_path(&self, name: &str, submission: &str) -> PathBuf {
        let name = Digest::of(name.as_bytes()).short();
        let of = if submission.is_empty() { String::new() } else { format!(" of {submission}") };
        self.root().join("devices").join(format!("{name}{of}.json"))
    }

    fn read_device(&self, path: &Path, programs: &Digest) -> Option<DeviceClass> {
        let answered: Answered = serde_json::from_slice(&self.files().read(path).ok()?).ok()?;
        (answered.class.kernels == *programs).then_some(answered.class)
    }

    /// The class of the device that answers to a name, as far as this cache knows it: the first one of this
    /// process's submission, else the last one. Records of other `programs` are of no use.
    pub(crate) fn known_device(&self, name: &str, programs: &Digest) -> Option<DeviceClass> {
        let submission = self.node.submitted().map(|task| task.submission.as_str());
        let places = submission.into_iter().chain([""]).map(|of| self.device_path(name, of));
        places.into_iter().find_map(|path| self.read_device(&path, programs))
    }

    /// Records the class of the device that answers to a name here. Returns the class that counts: in a
    /// submission that of the first device, else this one. The answer of a process stays, so its nodes ask
    /// the disk once.
    ///
    /// # Errors
    /// Fails if the record cannot be written.
    pub(crate) fn answer(&self, name: &str, own: &DeviceClass) -> Result<DeviceClass, FileError> {
        let asked = (name.to_string(), own.clone());
        if let Some((_, first)) = lock(&self.devices).iter().find(|(known, _)| *known == asked) {
            return Ok(first.clone());
        }
        let last = self.device_path(name, "");
        let mut counts = own.clone();
        if let Some(task) = self.node.submitted() {
            let first = self.device_path(name, &task.submission);
            let known = self.read_device(&first, &own.kernels);
            if known.is_none() {
                self.write_device(&first, name, own)?;
            }
            // Of several that write at once, the last writer decides, and all read what it wrote.
            counts = known.or_else(|| self.read_device(&first, &own.kernels)).unwrap_or(counts);
        }
        if self.read_device(&last, &own.kernels).as_ref() != Some(&counts) {
            self.write_device(&last, name, &counts)?;
        }
        lock(&self.devices).push((asked, counts.clone()));
        Ok(counts)
    }

    fn write_device(&self, path: &Path, name: &str, class: &DeviceClass) -> Result<(), FileError> {
        let answered = Answered { name: name.to_string(), class: class.clone() };
        let bytes = serde_json::to_vec_pretty(&answered).map_err(std::io::Error::other);
        files::write_atomic(self.files(), path, &files::at(path, "write", bytes)?)
    }
}
