//! Folders for temporary files outside the cache, and the removal of those that killed processes left.

use std::path::Path;

use use3d_files::Making;
pub use use3d_files::sweep;

/// The prefix of the names of temporary folders.
const SCRATCH: &str = "use3d-";

/// Creates a temporary folder that is removed when it is dropped. It first removes those that killed
/// processes left.
pub fn scratch() -> std::io::Result<Scratch> {
    sweep(&std::env::temp_dir(), SCRATCH, |_| true);
    let folder =
        tempfile::Builder::new().prefix(&format!("{SCRATCH}{}-", use3d_files::unique())).tempdir()?;
    let making = Making::new(folder.path());
    Ok(Scratch { folder, _making: making })
}

/// A folder for temporary files that is removed when it is dropped.
#[derive(Debug)]
pub struct Scratch {
    folder: tempfile::TempDir,
    _making: Making,
}

impl Scratch {
    /// The path of the folder.
    pub fn path(&self) -> &Path {
        self.folder.path()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cache::machine::ProcessId;

    #[test]
    fn a_scratch_folder_says_whose_it_is() {
        let folder = scratch().unwrap();
        let name = folder.path().file_name().unwrap().to_str().unwrap().to_string();
        let alive = name.strip_prefix(SCRATCH).and_then(ProcessId::owner_is_alive);
        assert!(alive != Some(false) && folder.path().is_dir(), "{name}");
    }
}
