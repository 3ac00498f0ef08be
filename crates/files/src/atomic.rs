//! Writes one file completely or not at all: under a temporary name in the same folder, then renamed.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use crate::making::Making;
use crate::names::{BEING_MADE, create_beside, folder_of};

/// Creates or replaces `path` with the output of `fill`. On an error the temporary file is removed and `path`
/// is untouched.
///
/// Parent folders are created. The data is not forced to the storage medium (`fsync`): callers that publish a
/// whole folder do this once, for the folder.
///
/// # Errors
/// Every error of `fill` and of the file system.
pub fn write_atomically<T>(
    path: &Path,
    fill: impl FnOnce(&mut BufWriter<File>) -> io::Result<T>,
) -> io::Result<T> {
    if path.file_name().is_none() {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "the path has no file name"));
    }
    std::fs::create_dir_all(folder_of(path))?;
    let (temporary, file) = create_beside(path, BEING_MADE, "")?;
    let _making = Making::new(&temporary);
    let result = (|| {
        let mut writer = BufWriter::with_capacity(1 << 18, file);
        let value = fill(&mut writer)?;
        writer.flush()?;
        drop(writer);
        std::fs::rename(&temporary, path)?;
        Ok(value)
    })();
    if result.is_err() {
        let _ = std::fs::remove_file(&temporary); // the first error is the one to report
    }
    result
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_as_long_as_names_can_be_is_written() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("x".repeat(255));
        write_atomically(&path, |w| w.write_all(b"whole")).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"whole");
    }

    #[test]
    fn a_failed_write_leaves_what_was_there_and_no_litter() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("sub/a.txt");
        write_atomically(&path, |w| w.write_all(b"old")).unwrap();
        let failed = write_atomically(&path, |w| {
            w.write_all(b"half of the ne")?;
            Err::<(), _>(io::Error::other("the pen broke"))
        });
        assert!(failed.is_err());
        assert_eq!(std::fs::read(&path).unwrap(), b"old");
        assert_eq!(std::fs::read_dir(path.parent().unwrap()).unwrap().count(), 1);
    }
}
