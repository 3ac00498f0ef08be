//! The folder of a benchmark: `truth.md`, `truth.json`, `pictures/`.
//!
//! `captures/` and `cache/` may be in the same folder, so the folder as a whole has no record. Each of the
//! two files carries the digest of its own text, which proves that this program wrote it and that it is
//! unchanged. The pictures have a record like any result folder ([`use3d_workflow::place`]). Anything that
//! this program did not write is refused.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use use3d_files::write_atomically;
use use3d_io_image::write_png;
use use3d_workflow::Digest;
use use3d_workflow::place::{self, PlaceError};

use super::figures::TruthFigures;
use super::page::markdown;
use super::picture::Sheet;

const PICTURES: &str = "pictures";

/// A file that ends with the digest of the text before it.
struct Sealed {
    name: &'static str,
    /// The text before and after the digest.
    around: [&'static str; 2],
}

const PAGE: Sealed = Sealed { name: "truth.md", around: ["\n<!-- written by use3d, blake3 ", " -->\n"] };
const FIGURES: Sealed = Sealed { name: "truth.json", around: [",\n  \"digest\": \"", "\"\n}\n"] };

impl Sealed {
    fn seal(&self, text: &str) -> String {
        let [before, after] = self.around;
        format!("{text}{before}{}{after}", Digest::of(text.as_bytes()))
    }

    fn is_sealed(&self, text: &str) -> bool {
        text.rfind(self.around[0]).is_some_and(|end| self.seal(&text[..end]) == text)
    }

    /// Refuses to replace a file that this program did not write, or that was changed since.
    fn check(&self, out: &Path) -> Result<PathBuf, PlaceError> {
        let path = out.join(self.name);
        let found = match std::fs::symlink_metadata(&path) {
            Err(e) if matches!(e.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => {
                return Ok(path);
            }
            found => at(&path, "look at", found)?,
        };
        let ours = found.is_file()
            && self.is_sealed(&String::from_utf8_lossy(&at(&path, "read", std::fs::read(&path))?));
        if ours {
            return Ok(path);
        }
        let reason = "this file was not written by this command, or was changed since; move it away, or choose another --out";
        Err(PlaceError::Occupied { path, reason: reason.into() })
    }

    fn write(&self, out: &Path, text: &str) -> Result<PathBuf, PlaceError> {
        let path = self.check(out)?;
        let written = write_atomically(&path, |file| file.write_all(self.seal(text).as_bytes()));
        at(&path, "write", written)?;
        Ok(path)
    }
}

fn at<T>(path: &Path, doing: &'static str, result: io::Result<T>) -> Result<T, PlaceError> {
    result.map_err(|source| PlaceError::Io { path: path.to_path_buf(), doing, source })
}

/// Checks, before anything is computed, that a benchmark can be written to `out`.
///
/// # Errors
/// Returns the first thing there that this program did not write, or a folder that cannot be written. Nothing
/// is changed.
pub fn check(out: &Path) -> Result<(), PlaceError> {
    place::check_writable(out)?;
    PAGE.check(out)?;
    FIGURES.check(out)?;
    place::sweep(out);
    place::check(&out.join(PICTURES), true)
}

/// Fills `out` and returns the paths written; pictures are named after their captures.
///
/// # Errors
/// Fails if a place was meanwhile occupied by something that this program did not write, or cannot be
/// written.
pub fn deliver(figures: &TruthFigures, pictures: &[Sheet], out: &Path) -> Result<Vec<PathBuf>, PlaceError> {
    at(out, "create", std::fs::create_dir_all(out))?;
    // Nothing is changed if one of the files cannot be replaced.
    PAGE.check(out)?;
    FIGURES.check(out)?;
    let folder = out.join(PICTURES);
    let made = place::sibling(&folder);
    let fill = || {
        at(&made, "create", std::fs::create_dir_all(&made))?;
        for sheet in pictures {
            let path = made.join(format!("{}.png", sheet.capture));
            at(&path, "write", write_png(&path, &sheet.image).map_err(io::Error::other))?;
        }
        place::record(&made, None)
    };
    let placed = fill().and_then(|()| place::put(&made, &folder, true));
    if placed.is_err() {
        let _ = std::fs::remove_dir_all(&made); // it belongs to this process alone; the first error is the one to report
    }
    placed?;
    let page = PAGE.write(out, &markdown(figures, pictures))?;
    let path = out.join(FIGURES.name);
    let text = at(&path, "write", serde_json::to_string_pretty(figures).map_err(io::Error::other))?;
    // The digest becomes the object's last field.
    let open = text.strip_suffix("\n}").unwrap_or(&text);
    Ok(vec![page, FIGURES.write(out, open)?, folder])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bench::figures::FORMAT;
    use crate::bench::runs::{LearntFrom, Recipe};
    use use3d_capture::Image;

    fn figures() -> TruthFigures {
        TruthFigures {
            format: FORMAT.into(),
            version: 1,
            program: "0".into(),
            command: "use3d bench truth".into(),
            recipe: Recipe {
                views: 5,
                size: (48, 32),
                iterations: 10,
                baselines: false,
                sets: vec![],
                learnt_from: LearntFrom::Nothing,
            },
            seeds: vec![1],
            pipelines: [].into(),
            failed: vec![],
            captures: vec![],
        }
    }

    #[test]
    fn own_results_are_replaced_changed_and_foreign_ones_are_not() {
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path().join("bench");
        check(&out).unwrap();
        let image = Image::filled(4, 3, 0.5);
        let pictures = [Sheet { capture: "air".into(), image, shows: vec!["photograph"] }];
        for _ in 0..2 {
            let delivered = deliver(&figures(), &pictures, &out).unwrap();
            assert!(delivered.iter().all(|path| path.exists()), "{delivered:?}");
            check(&out).unwrap();
        }
        let json = std::fs::read_to_string(out.join("truth.json")).unwrap();
        let value: serde_json::Value = serde_json::from_str(&json).unwrap();
        assert_eq!((&value["seeds"][0], value["digest"].as_str().map(str::len)), (&1.into(), Some(64)));
        assert_eq!(serde_json::from_str::<TruthFigures>(&json).unwrap(), figures());
        for name in ["truth.md", "truth.json"] {
            let path = out.join(name);
            let ours = std::fs::read_to_string(&path).unwrap();
            for theirs in [ours.replacen("bench", "my own bench", 1), format!("{ours}notes"), "notes".into()]
            {
                std::fs::write(&path, &theirs).unwrap();
                assert!(check(&out).unwrap_err().to_string().contains("--out"));
                assert!(deliver(&figures(), &pictures, &out).is_err());
                assert_eq!(std::fs::read_to_string(&path).unwrap(), theirs, "left as it was");
            }
            std::fs::write(&path, ours).unwrap();
            check(&out).unwrap();
        }
        std::fs::write(out.join("pictures/air.png"), "mine").unwrap();
        assert!(check(&out).is_err());
        std::fs::remove_dir_all(out.join("pictures")).unwrap();
        std::fs::create_dir(out.join("pictures")).unwrap();
        std::fs::write(out.join("pictures/holiday.png"), "mine").unwrap();
        assert!(check(&out).unwrap_err().to_string().contains("pictures"));
    }
}
