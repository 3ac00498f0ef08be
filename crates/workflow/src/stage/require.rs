//! The requirements of stages: files from outside that must be there before anything runs.
//!
//! A stage states its requirements as a function of the parameters of all stages and of the places that the
//! pipeline names ([`Stage::requires`](crate::Stage::requires)). A plan and a run check all of them first: a
//! training of hours that has to fail at its end never starts.

use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::cache::content::{Choice, Contents};
use crate::stage::inputs::Named;
use crate::stage::parameters::AllParameters;
use use3d_code::digest::Digest;

/// Something that is missing, or that conflicts with other settings.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Lacking {
    /// The missing thing, as the subject of a sentence: `the weights of Nu2Net`.
    pub what: String,
    /// The next step: the file to put somewhere, and the place where it is published.
    pub remedy: String,
    /// The setting of the command line that does without it, as it is typed; empty where there is none.
    pub without: String,
}

/// The requirements of a stage.
pub(super) type Requires = Arc<dyn Fn(&AllParameters, &Named, &Checks<'_>) -> Vec<Lacking> + Send + Sync>;

/// Checks of files that are not made twice: a check without a fault is stored in the cache with the state of
/// the files that it read.
pub struct Checks<'a>(pub(crate) &'a Contents);

impl Checks<'_> {
    /// Returns the fault that `check` finds in files of `input`. If it found none before, and none of the
    /// files that it read has changed since, it is not made again. `name` names the check and its rules;
    /// `check` returns the files and folders that it read, relative to `input`.
    pub fn once<E: fmt::Display>(
        &self,
        name: &str,
        input: &Path,
        check: impl FnOnce() -> Result<Vec<PathBuf>, E>,
    ) -> Option<String> {
        let choice = || check().map(|made_from| Choice { files: Vec::new(), made_from });
        let fault = self.0.choice(Digest::of(name.as_bytes()), input, choice).err();
        fault.map(|fault| fault.to_string())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cache::files::Disk;

    #[test]
    fn a_check_without_a_fault_is_made_again_only_when_its_files_change() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("truth.png");
        std::fs::write(&path, "truth").unwrap();
        let old = std::time::SystemTime::now() - std::time::Duration::from_secs(100);
        std::fs::File::options().write(true).open(&path).unwrap().set_modified(old).unwrap();
        // The change time cannot be set back.
        std::thread::sleep(std::time::Duration::from_millis(2100));
        // Each attempt is a process of its own. Returns the fault and the number of checks that were made.
        let attempt = |fault: Option<&str>| {
            let contents = Contents::open(Arc::new(Disk), dir.path().join("stat"), false);
            let mut made = 0;
            let mut once = || {
                Checks(&contents).once("readable", dir.path(), || {
                    made += 1;
                    fault.map_or(Ok(vec!["truth.png".into()]), Err)
                })
            };
            let found = (once(), once());
            contents.save().unwrap();
            assert_eq!(found.0, found.1);
            (found.0, made)
        };
        // A fault is not stored.
        assert_eq!(attempt(Some("broken")), (Some("broken".into()), 2));
        assert_eq!(attempt(None), (None, 1));
        assert_eq!(attempt(None), (None, 0));
        std::fs::write(&path, "other").unwrap();
        assert_eq!(attempt(Some("broken")), (Some("broken".into()), 2));
    }
}
