//! Folders for temporary files outside the cache, and what killed processes left of them.

use std::path::Path;

use use3d_files::Making;
pub use use3d_files::sweep;

/// What the names of folders for temporary files begin with.
const SCRATCH: &str = "use3d-";

/// A folder for temporary files that goes away when it is dropped; those of processes that were killed go
/// now.
pub fn scratch() -> std::io::Result<Scratch> {
    sweep(&std::env::temp_dir(), SCRATCH, |_| true);
    let folder =
        tempfile::Builder::new().prefix(&format!("{SCRATCH}{}-", use3d_files::unique())).tempdir()?;
    let making = Making::new(folder.path());
    Ok(Scratch { folder, _making: making })
}

/// A folder for temporary files.
#[derive(Debug)]
pub struct Scratch {
    folder: tempfile::TempDir,
    _making: Making,
}

impl Scratch {
    /// Where it is.
    pub fn path(&self) -> &Path {
        self.folder.path()
    }
}

#[cfg(test)]
mod tests {
    use super::super::machine::ProcessId;
    use super::*;

    #[test]
    fn a_scratch_folder_says_whose_it_is() {
        let folder = scratch().unwrap();
        let name = folder.path().file_name().unwrap().to_str().unwrap().to_string();
        let alive = name.strip_prefix(SCRATCH).and_then(ProcessId::owner_is_alive);
        assert!(alive != Some(false) && folder.path().is_dir(), "{name}");
    }
}
