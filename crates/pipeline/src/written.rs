//! Files of results that only this program replaces. A [`Sealed`] file ends with the digest of the text
//! before it, which proves that this program wrote it and that it is unchanged. A folder has a record instead
//! ([`use3d_workflow::place`]).

use std::fs;
use std::io::{self, Write};
use std::path::Path;

use use3d_files::write_atomically;
use use3d_workflow::Digest;
use use3d_workflow::place::{PlaceError, at};

/// A kind of file that ends with the digest of the text before it.
pub struct Sealed {
    /// The text before and after the digest.
    pub around: [&'static str; 2],
    /// The file and its writer, as the error for a foreign file names them.
    pub words: [&'static str; 2],
}

impl Sealed {
    /// A text with its digest.
    pub fn seal(&self, text: &str) -> String {
        let [before, after] = self.around;
        format!("{text}{before}{}{after}", Digest::of(text.as_bytes()))
    }

    fn is_sealed(&self, text: &str) -> bool {
        text.rfind(self.around[0]).is_some_and(|end| self.seal(&text[..end]) == text)
    }

    /// Refuses to replace a file that this program did not write, or that was changed since.
    pub fn check(&self, path: &Path) -> Result<(), PlaceError> {
        let found = match fs::symlink_metadata(path) {
            Err(e) if matches!(e.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => {
                return Ok(());
            }
            found => at(path, "look at", found)?,
        };
        if found.is_file() && self.is_sealed(&String::from_utf8_lossy(&at(path, "read", fs::read(path))?)) {
            return Ok(());
        }
        let [file, writer] = self.words;
        let reason = format!(
            "this {file} was not written by this {writer}, or was changed since; move it away, or choose another --out"
        );
        Err(PlaceError::Occupied { path: path.to_path_buf(), reason })
    }

    /// Writes a text with its digest, if the file may be replaced.
    pub fn write(&self, path: &Path, text: &str) -> Result<(), PlaceError> {
        self.check(path)?;
        at(path, "write", write_atomically(path, |file| file.write_all(self.seal(text).as_bytes())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_replaced_only_as_it_was_written() {
        let sealed = Sealed { around: ["<!-- blake3 ", " -->\n"], words: ["page", "program"] };
        let dir = tempfile::tempdir().unwrap();
        let page = dir.path().join("report.html");
        sealed.check(&page).unwrap();
        let html = sealed.seal("<html>");
        for (text, ours) in [
            (html.clone(), true),
            (sealed.seal(&html), true),
            (html.replace("<html>", "<html>my notes"), false),
            (format!("{html}my notes"), false),
            ("<html>my own page".to_string(), false),
        ] {
            fs::write(&page, &text).unwrap();
            assert_eq!(sealed.check(&page).is_ok(), ours, "{text}");
            assert_eq!(sealed.write(&page, "<html>").is_ok(), ours, "{text}");
        }
        fs::remove_file(&page).unwrap();
        fs::create_dir(&page).unwrap();
        assert!(sealed.check(&page).is_err());
    }
}
