//! The record of finished photographs, in the folder of the results.
//!
//! One line of JSON for each photograph, written when its file is complete: the file's size and time, those
//! of the original, and what the table shows. A line that was cut off by a kill is ignored, and that
//! photograph is made again. A short line before it says that its file is being written, so that a file
//! whose line is missing is known as the program's own. Masks and the table have such short lines, too: one
//! before they are written, one after, with their size and time. The first line names the settings, because
//! photographs with other settings are other results. Nothing is written before all files were checked.

use std::collections::BTreeMap;
use std::fs::OpenOptions;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

use serde::{Deserialize, Serialize};
use use3d_capture::FileName;
use use3d_io_image::{Photograph, Samples};
use use3d_photographs::ViewMap;

use crate::WorkError;

/// The record's name in the folder of the results.
const FILE: &str = ".photographs.jsonl";
const FORMAT: &str = "3d-use photographs 1";

/// The first line.
#[derive(Debug, Serialize, Deserialize)]
struct Head {
    format: String,
    settings: String,
}

/// A file of the program that is no finished photograph: it is being written, other settings wrote it, or it
/// is a mask or the table.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Begun {
    begun: String,
    /// The finished file; `None` while it is being written.
    result: Option<Stamp>,
}

/// The permission to replace files in the folder of the results.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Overwrite {
    /// Nothing.
    #[default]
    Nothing,
    /// Photographs that this program made with other settings.
    Own,
    /// All files.
    All,
}

/// Size in bytes and time of change of a file.
type Stamp = (u64, u128);

/// A finished photograph.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FinishedPhotograph {
    /// Its relative name.
    pub name: String,
    /// Width, pixels.
    pub width: usize,
    /// Height, pixels.
    pub height: usize,
    /// Bits of a sample.
    pub bits: u8,
    /// The share of pixels that the scene does not know; `None` without a camera.
    pub unknown: Option<f64>,
    /// Median and 90 % quantile of the distance, units of the model; `None` if there is no surface.
    pub distances: Option<[f64; 2]>,
    /// The change of the whole view.
    pub(super) view: Option<[[f32; 4]; 3]>,
    /// Sentences for the user.
    pub notes: Vec<String>,
    #[serde(default)]
    original: Option<Stamp>,
    #[serde(default)]
    result: Option<Stamp>,
}

impl FinishedPhotograph {
    /// The row of a photograph that was changed by the mean of the views.
    pub(super) fn without_camera(name: &FileName, photograph: &Photograph) -> Self {
        let bits = match photograph.pixels {
            Samples::Eight(_) => 8,
            Samples::Sixteen(_) => 16,
            Samples::Float(_) => 32,
        };
        Self {
            name: name.to_string(),
            width: photograph.width,
            height: photograph.height,
            bits,
            unknown: None,
            distances: None,
            view: None,
            notes: photograph.notes.clone(),
            original: None,
            result: None,
        }
    }

    /// The change of the whole view; `None` without a camera.
    pub fn view_map(&self) -> Option<ViewMap> {
        self.view.map(|rows| ViewMap { rows })
    }

    /// The mean gain of the whole view for grey, per channel.
    pub fn gains(&self) -> Option<[f32; 3]> {
        self.view.map(|rows| rows.map(|row| row[0] + row[1] + row[2] + row[3] / 0.5))
    }
}

/// The finished photographs of a folder.
#[derive(Debug)]
pub struct Record {
    path: PathBuf,
    entries: BTreeMap<String, FinishedPhotograph>,
    /// Files that are the program's own, but no finished results: see [`Begun`].
    begun: BTreeMap<String, Option<Stamp>>,
    overwrite: Overwrite,
    /// The first line, until the file has it.
    head: Option<Head>,
    /// True if the last line was cut off.
    cut: bool,
}

fn stamp(path: &Path) -> Option<Stamp> {
    let data = std::fs::metadata(path).ok().filter(std::fs::Metadata::is_file)?;
    let time = data.modified().ok()?.duration_since(UNIX_EPOCH).ok()?;
    Some((data.len(), time.as_nanos()))
}

impl Record {
    /// Reads the record of a folder for these settings. Nothing is written before [`Record::start`].
    ///
    /// # Errors
    /// The folder is a file, or holds photographs with other settings that may not be replaced.
    pub(super) fn open(folder: &Path, settings: &str, overwrite: Overwrite) -> Result<Self, WorkError> {
        if folder.exists() && !folder.is_dir() {
            return Err(WorkError::Input(format!(
                "{}: this is a file; name a folder for the photographs with --out",
                folder.display()
            )));
        }
        let path = folder.join(FILE);
        let text = std::fs::read_to_string(&path).unwrap_or_default();
        let mut lines = text.lines();
        let head: Option<Head> = lines.next().and_then(|line| serde_json::from_str(line).ok());
        let head = head.filter(|head| head.format == FORMAT);
        let (mut entries, mut begun) = (BTreeMap::new(), BTreeMap::new());
        for line in lines.filter(|_| head.is_some()) {
            if let Ok(entry) = serde_json::from_str::<FinishedPhotograph>(line) {
                begun.remove(&entry.name);
                entries.insert(entry.name.clone(), entry);
            } else if let Ok(line) = serde_json::from_str::<Begun>(line) {
                begun.insert(line.begun, line.result);
            }
        }
        if head.as_ref().is_some_and(|head| head.settings == settings) {
            let cut = !text.ends_with('\n');
            return Ok(Self { path, entries, begun, overwrite, head: None, cut });
        }
        if head.is_some() && overwrite == Overwrite::Nothing {
            return Err(WorkError::Input(format!(
                "{}: this folder holds photographs that were made with other settings, from other files or by \
                 another scene; pass --force to replace them, or choose another folder",
                folder.display()
            )));
        }
        begun.extend(entries.into_iter().map(|(name, entry)| (name, entry.result)));
        let head = Some(Head { format: FORMAT.into(), settings: settings.into() });
        Ok(Self { path, entries: BTreeMap::new(), begun, overwrite, head, cut: false })
    }

    /// Makes the folder and the record ready for new lines.
    ///
    /// # Errors
    /// They cannot be written.
    pub(super) fn start(&mut self) -> Result<(), WorkError> {
        if let Some(folder) = self.path.parent() {
            std::fs::create_dir_all(folder)
                .map_err(|e| WorkError::Failed(format!("{}: cannot be made: {e}", folder.display())))?;
        }
        if let Some(head) = self.head.take() {
            let begun = &self.begun;
            use3d_files::write_atomically(&self.path, |w| {
                serde_json::to_writer(&mut *w, &head)?;
                for (name, result) in begun {
                    w.write_all(b"\n")?;
                    serde_json::to_writer(&mut *w, &Begun { begun: name.clone(), result: *result })?;
                }
                w.write_all(b"\n")
            })
            .map_err(|e| self.unwritable(&e))?;
        }
        if std::mem::take(&mut self.cut) {
            // A line that was cut off must not swallow the next one.
            self.write("\n")?;
        }
        Ok(())
    }

    fn unwritable(&self, error: &std::io::Error) -> WorkError {
        WorkError::Failed(format!("{}: cannot be written: {error}", self.path.display()))
    }

    fn write(&self, text: &str) -> Result<(), WorkError> {
        let file = OpenOptions::new().append(true).open(&self.path);
        file.and_then(|mut file| file.write_all(text.as_bytes())).map_err(|e| self.unwritable(&e))
    }

    /// True if a photograph is finished: neither its original nor its result changed since.
    pub(super) fn has(&self, name: &FileName, source: &Path, target: &Path) -> bool {
        self.entries.get(name.as_str()).is_some_and(|entry| {
            entry.result.is_some() && entry.result == stamp(target) && entry.original == stamp(source)
        })
    }

    /// True if a mask or the table is complete and did not change since. `key` is its name in this record.
    pub(super) fn holds(&self, key: &str, file: &Path) -> bool {
        self.begun.get(key).is_some_and(|result| result.is_some() && *result == stamp(file))
    }

    /// Checks that the result of a photograph may be written.
    ///
    /// # Errors
    /// Its place is the original itself, or holds a file that this program did not write.
    pub(super) fn check(&self, name: &FileName, source: &Path, target: &Path) -> Result<(), WorkError> {
        let same = source.canonicalize().ok();
        if same.is_some() && same == target.canonicalize().ok() {
            return Err(WorkError::Input(format!(
                "{}: the result would replace the original photograph; choose another folder with --out",
                target.display()
            )));
        }
        self.check_file(name.as_str(), target)
    }

    /// Checks that a file may be written. `key` is its name in this record.
    ///
    /// # Errors
    /// Its place holds a file that this program did not write.
    pub(super) fn check_file(&self, key: &str, target: &Path) -> Result<(), WorkError> {
        let finished = self.entries.get(key).and_then(|entry| entry.result);
        let begun = self.begun.get(key);
        let own = begun.is_some_and(|result| result.is_none() || *result == stamp(target))
            || finished == stamp(target);
        if target.exists() && self.overwrite != Overwrite::All && !own {
            return Err(WorkError::Input(format!(
                "{}: the file exists and is not a finished result; move it, or let `use3d photographs` with --force \
                 replace it",
                target.display()
            )));
        }
        Ok(())
    }

    fn append(&self, line: serde_json::Result<String>) -> Result<(), WorkError> {
        self.write(&(line.map_err(WorkError::failed)? + "\n"))
    }

    fn note(&mut self, key: &str, result: Option<Stamp>) -> Result<(), WorkError> {
        self.begun.insert(key.to_string(), result);
        self.append(serde_json::to_string(&Begun { begun: key.to_string(), result }))
    }

    /// Notes that a file is about to be written.
    ///
    /// # Errors
    /// The record cannot be written.
    pub(super) fn begin(&mut self, key: &str) -> Result<(), WorkError> {
        self.note(key, None)
    }

    /// Notes that a mask or the table is complete.
    ///
    /// # Errors
    /// The record cannot be written.
    pub(super) fn end(&mut self, key: &str, file: &Path) -> Result<(), WorkError> {
        self.note(key, stamp(file))
    }

    /// Adds a finished photograph.
    ///
    /// # Errors
    /// The record cannot be written.
    pub(super) fn add(
        &mut self,
        mut entry: FinishedPhotograph,
        source: &Path,
        target: &Path,
    ) -> Result<(), WorkError> {
        (entry.original, entry.result) = (stamp(source), stamp(target));
        self.append(serde_json::to_string(&entry))?;
        self.begun.remove(&entry.name);
        self.entries.insert(entry.name.clone(), entry);
        Ok(())
    }

    /// The finished photographs, by name.
    pub fn entries(&self) -> impl Iterator<Item = &FinishedPhotograph> {
        self.entries.values()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(name: &str) -> FinishedPhotograph {
        FinishedPhotograph {
            name: name.into(),
            width: 4,
            height: 3,
            bits: 8,
            unknown: Some(0.25),
            distances: Some([1.0, 2.0]),
            view: None,
            notes: Vec::new(),
            original: None,
            result: None,
        }
    }

    #[test]
    fn finished_photographs_are_known_until_a_file_changes() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        let (source, target) = (at("original.jpg"), at("result.jpg"));
        std::fs::write(&source, "original").unwrap();
        let name = FileName::new("result.jpg").unwrap();
        let mut record = Record::open(dir.path(), "a", Overwrite::Nothing).unwrap();
        assert!(!at(FILE).exists(), "nothing is written before the start");
        record.start().unwrap();
        assert!(!record.has(&name, &source, &target));
        record.check(&name, &source, &target).unwrap();
        std::fs::write(&target, "result").unwrap();
        record.add(entry("result.jpg"), &source, &target).unwrap();
        // A line that a kill cut off is ignored, and the next one is not lost.
        let path = at(FILE);
        let mut text = std::fs::read_to_string(&path).unwrap();
        text.push_str("{\"name\": \"ha");
        std::fs::write(&path, &text).unwrap();
        let mut record = Record::open(dir.path(), "a", Overwrite::Nothing).unwrap();
        assert!(record.has(&name, &source, &target));
        record.start().unwrap();
        record.add(entry("other.jpg"), &source, &target).unwrap();
        let record = Record::open(dir.path(), "a", Overwrite::Nothing).unwrap();
        assert_eq!(record.entries().count(), 2);
        std::fs::write(&target, "another result").unwrap();
        assert!(!record.has(&name, &source, &target));
        let refused = record.check(&name, &source, &target).unwrap_err().to_string();
        assert!(refused.contains("--force"), "{refused}");
        // A file whose line a kill prevented is the program's own.
        let mut record = Record::open(dir.path(), "a", Overwrite::Nothing).unwrap();
        record.begin(name.as_str()).unwrap();
        let record = Record::open(dir.path(), "a", Overwrite::Nothing).unwrap();
        record.check(&name, &source, &target).unwrap();
        // Once it is finished, a user's changes to it are safe, with these settings and with others.
        let mut record = Record::open(dir.path(), "a", Overwrite::Nothing).unwrap();
        record.add(entry("result.jpg"), &source, &target).unwrap();
        let changed = |overwrite, settings: &str| {
            std::fs::write(&target, "changed by its user").unwrap();
            let record = Record::open(dir.path(), settings, overwrite).unwrap();
            let refused = record.check(&name, &source, &target).is_err();
            std::fs::write(&target, "another result").unwrap();
            refused
        };
        assert!(changed(Overwrite::Nothing, "a"));
        let mut record = Record::open(dir.path(), "a", Overwrite::Nothing).unwrap();
        record.begin(name.as_str()).unwrap();
        record.add(entry("result.jpg"), &source, &target).unwrap();
        // With other settings, own files may be replaced, and others not.
        let record = Record::open(dir.path(), "b", Overwrite::Own).unwrap();
        record.check(&name, &source, &target).unwrap();
        assert!(changed(Overwrite::Own, "b"));
        // A mask or the table is own while it is as it was written.
        let table = at("table.csv");
        let mut record = Record::open(dir.path(), "a", Overwrite::Nothing).unwrap();
        std::fs::write(&table, "of its user").unwrap();
        assert!(record.check_file("table.csv", &table).is_err());
        record.begin("table.csv").unwrap();
        record.check_file("table.csv", &table).unwrap();
        record.end("table.csv", &table).unwrap();
        let record = Record::open(dir.path(), "b", Overwrite::Own).unwrap();
        assert!(record.holds("table.csv", &table) && record.check_file("table.csv", &table).is_ok());
        std::fs::write(&table, "changed by its user").unwrap();
        assert!(!record.holds("table.csv", &table) && record.check_file("table.csv", &table).is_err());
        let foreign = at("foreign.jpg");
        std::fs::write(&foreign, "of somebody").unwrap();
        assert!(record.check(&FileName::new("foreign.jpg").unwrap(), &source, &foreign).is_err());
    }

    #[test]
    fn other_settings_and_the_original_itself_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let original = dir.path().join("a.jpg");
        std::fs::write(&original, "original").unwrap();
        let name = FileName::new("a.jpg").unwrap();
        let mut record = Record::open(dir.path(), "a", Overwrite::All).unwrap();
        record.start().unwrap();
        let refused = record.check(&name, &original, &original).unwrap_err().to_string();
        assert!(refused.contains("original photograph"), "{refused}");
        let refused = Record::open(dir.path(), "b", Overwrite::Nothing).unwrap_err().to_string();
        assert!(refused.contains("other settings"), "{refused}");
        assert_eq!(Record::open(dir.path(), "b", Overwrite::Own).unwrap().entries().count(), 0);
        let refused = Record::open(&original, "a", Overwrite::Nothing).unwrap_err().to_string();
        assert!(refused.contains("this is a file"), "{refused}");
    }
}
