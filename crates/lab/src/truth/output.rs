//! The folder of a benchmark: `truth.md`, `truth.json`, `pictures/`.
//!
//! `captures/` and `cache/` may be in the same folder, so the folder as a whole has no record. Each of the
//! two files carries the digest of its own text. Anything that this program did not write is refused.

use std::io;
use std::path::{Path, PathBuf};

use use3d_io_image::write_png;
use use3d_pipeline::written::Sealed;
use use3d_workflow::place::{self, PlaceError, at};

use super::figures::TruthFigures;
use super::page::markdown;
use super::picture::Sheet;

const PICTURES: &str = "pictures";

/// The two files.
const PAGE: (&str, Sealed) = ("truth.md", sealed(["\n<!-- written by use3d, blake3 ", " -->\n"]));
const FIGURES: (&str, Sealed) = ("truth.json", sealed([",\n  \"digest\": \"", "\"\n}\n"]));

const fn sealed(around: [&'static str; 2]) -> Sealed {
    Sealed { around, words: ["file", "command"] }
}

fn check_files(out: &Path) -> Result<(), PlaceError> {
    [PAGE, FIGURES].iter().try_for_each(|(name, sealed)| sealed.check(&out.join(name)))
}

/// Checks, before anything is computed, that a benchmark can be written to `out`.
///
/// # Errors
/// Returns the first thing there that this program did not write, or a folder that cannot be written. Nothing
/// is changed.
pub fn check(out: &Path) -> Result<(), PlaceError> {
    place::check_writable(out)?;
    check_files(out)?;
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
    check_files(out)?;
    let [folder, page, path] = [PICTURES, PAGE.0, FIGURES.0].map(|name| out.join(name));
    let fill = |made: &Path| {
        at(made, "create", std::fs::create_dir_all(made))?;
        for sheet in pictures {
            let path = made.join(format!("{}.png", sheet.capture));
            at(&path, "write", write_png(&path, &sheet.image).map_err(io::Error::other))?;
        }
        place::record(made, None)
    };
    place::put_folder(&folder, true, fill, |error| error)?;
    PAGE.1.write(&page, &markdown(figures, pictures))?;
    let text = at(&path, "write", serde_json::to_string_pretty(figures).map_err(io::Error::other))?;
    // The digest becomes the object's last field.
    FIGURES.1.write(&path, text.strip_suffix("\n}").unwrap_or(&text))?;
    Ok(vec![page, path, folder])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::truth::figures::FORMAT;
    use crate::truth::runs::{LearntFrom, Recipe};
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
                methods: false,
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
