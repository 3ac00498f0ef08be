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

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::cache::artifacts::Cache;
use crate::cache::files;
use crate::cache::key::DeviceClass;
use crate::error::FileError;
use use3d_code::digest::Digest;

/// The record of a device.
#[derive(Deserialize, Serialize)]
struct Answered {
    /// The name that it answered to, for readers of the file.
    name: String,
    class: DeviceClass,
}

impl Cache {
    fn device_path(&self, name: &str, submission: &str) -> PathBuf {
        let name = Digest::of(name.as_bytes()).short();
        let of = if submission.is_empty() { String::new() } else { format!(" of {submission}") };
        self.root().join("devices").join(format!("{name}{of}.json"))
    }

    fn read_device(&self, path: &std::path::Path, programs: &Digest) -> Option<DeviceClass> {
        let answered: Answered = serde_json::from_slice(&self.files().read(path).ok()?).ok()?;
        (answered.class.kernels == *programs).then_some(answered.class)
    }

    /// The class of the device that answers to a name, as far as this cache knows it: the first one of this
    /// process's submission, else the last one. Records of other `programs` are of no use.
    pub(crate) fn known_device(&self, name: &str, programs: &Digest) -> Option<DeviceClass> {
        let task = self.node.task.as_ref().filter(|task| !task.submission.is_empty());
        let of_submission =
            task.and_then(|task| self.read_device(&self.device_path(name, &task.submission), programs));
        of_submission.or_else(|| self.read_device(&self.device_path(name, ""), programs))
    }

    /// Records the class of the device that answers to a name here. Returns the class that counts: in a
    /// submission that of the first device, else this one.
    ///
    /// # Errors
    /// Fails if the record cannot be written.
    pub(crate) fn answer(&self, name: &str, class: DeviceClass) -> Result<DeviceClass, FileError> {
        let programs = class.kernels;
        let task = self.node.task.as_ref().filter(|task| !task.submission.is_empty());
        let last = self.device_path(name, "");
        if let Some(task) = task {
            let first = self.device_path(name, &task.submission);
            if let Some(first) = self.read_device(&first, &programs) {
                return Ok(first);
            }
            self.write_device(&first, name, &class)?;
            // Of several that write at once, the last writer decides, and all read what it wrote.
            let class = self.read_device(&first, &programs).unwrap_or(class);
            self.write_device(&last, name, &class)?;
            return Ok(class);
        }
        if self.read_device(&last, &programs).as_ref() != Some(&class) {
            self.write_device(&last, name, &class)?;
        }
        Ok(class)
    }

    fn write_device(&self, path: &std::path::Path, name: &str, class: &DeviceClass) -> Result<(), FileError> {
        let answered = Answered { name: name.to_string(), class: class.clone() };
        let bytes = serde_json::to_vec_pretty(&answered).map_err(std::io::Error::other);
        files::write_atomic(self.files(), path, &files::at(path, "write", bytes)?)
    }
}
