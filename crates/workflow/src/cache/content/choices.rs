//! Choices of files that are not made twice.
//!
//! To choose the files of a capture that a stage reads, its model is read and its folders are listed, which
//! may take long. So a choice is stored with its sources: the files that were read and the folders that were
//! listed. It is valid as long as none of them has another size, time or inode. Errors are not stored.

use std::collections::{BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::SystemTime;

use super::Stat;
use use3d_code::digest::Digest;

/// The files of an external input that a stage reads.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Choice {
    /// The files, and folders with everything below, relative to the input.
    pub files: Vec<PathBuf>,
    /// The sources of the choice, relative to the input. If one of them changes, the choice is made again. If
    /// there are none, it is made every time.
    pub made_from: Vec<PathBuf>,
}

impl From<Vec<PathBuf>> for Choice {
    fn from(files: Vec<PathBuf>) -> Self {
        Self { files, made_from: Vec::new() }
    }
}

/// The key of a choice: a digest of the code and the parameters that choose, and the input.
pub(super) type Whose = (Digest, PathBuf);

/// A stored choice.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct StoredChoice {
    pub(super) files: Arc<[PathBuf]>,
    /// Its sources with their state at that time; `None` for a source that did not exist.
    from: Vec<(PathBuf, Option<Stat>)>,
}

/// The stored choices.
#[derive(Default)]
pub(super) struct Choices {
    table: HashMap<Whose, StoredChoice>,
    changed: BTreeSet<Whose>,
    /// The choices that were requested since the run or the plan began.
    pub(super) asked: HashMap<Whose, Arc<[PathBuf]>>,
}

fn stat(input: &Path, path: &Path) -> Option<Stat> {
    std::fs::metadata(input.join(path)).ok().map(|metadata| Stat::of(&metadata))
}

impl Choices {
    pub(super) fn read(bytes: &[u8]) -> Self {
        let text = String::from_utf8_lossy(bytes);
        Self { table: text.lines().filter_map(parse).collect(), ..Self::default() }
    }

    /// Returns the stored choice if none of its sources has changed.
    pub(super) fn still_holds(&mut self, whose: &Whose) -> Option<Arc<[PathBuf]>> {
        let made = self.table.get(whose)?;
        if made.from.iter().any(|(path, known)| stat(&whose.1, path) != *known) {
            return None;
        }
        let files = made.files.clone();
        self.asked.insert(whose.clone(), files.clone());
        Some(files)
    }

    /// Stores a choice whose making began at `began`, unless one of its sources was changed since then or a
    /// moment before: the choice may have missed the change, and one clock tick may hide a second one.
    pub(super) fn remember(&mut self, whose: &Whose, choice: Choice, began: SystemTime) -> Arc<[PathBuf]> {
        let files: Arc<[PathBuf]> = choice.files.into();
        let from: Vec<_> = choice.made_from.into_iter().map(|path| (stat(&whose.1, &path), path)).collect();
        if !from.is_empty() && from.iter().all(|(stat, _)| stat.is_none_or(|s| s.settled_before(began))) {
            let from = from.into_iter().map(|(stat, path)| (path, stat)).collect();
            self.table.insert(whose.clone(), StoredChoice { files: files.clone(), from });
            self.changed.insert(whose.clone());
        }
        self.asked.insert(whose.clone(), files.clone());
        files
    }

    /// Returns the new bytes of the table, with the choices that other processes have written meanwhile;
    /// `None` if there is no new choice.
    pub(super) fn to_write(&self, there: impl FnOnce() -> Vec<u8>) -> Option<Vec<u8>> {
        if self.changed.is_empty() {
            return None;
        }
        let mut merged = Self::read(&there()).table;
        merged.extend(
            self.changed.iter().filter_map(|whose| Some((whose.clone(), self.table.get(whose)?.clone()))),
        );
        let mut lines: Vec<String> = merged.iter().filter_map(|(whose, made)| line(whose, made)).collect();
        lines.sort();
        lines.push(String::new());
        Some(lines.join("\n").into_bytes())
    }

    pub(super) fn were_written(&mut self) {
        self.changed.clear();
    }

    /// Removes the choices of inputs that no longer exist.
    pub(super) fn forget_missing(&mut self) -> bool {
        let before = self.table.len();
        self.table.retain(|(_, input), _| input.exists());
        let some = self.table.len() < before;
        if some {
            self.changed = self.table.keys().cloned().collect();
        }
        some
    }
}

/// Writes a choice as one line: the digest, then JSON.
fn line((who, input): &Whose, made: &StoredChoice) -> Option<String> {
    let texts = |paths: &mut dyn Iterator<Item = &Path>| {
        paths.map(|path| path.to_str().map(String::from)).collect::<Option<Vec<String>>>()
    };
    let files = texts(&mut made.files.iter().map(PathBuf::as_path))?;
    let from = texts(&mut made.from.iter().map(|(path, _)| path.as_path()))?;
    let stats: Vec<String> =
        made.from.iter().map(|(_, stat)| stat.as_ref().map(Stat::words).unwrap_or_default()).collect();
    let json = serde_json::to_string(&(input.to_str()?, files, from, stats)).ok()?;
    Some(format!("{who} {json}"))
}

fn parse(line: &str) -> Option<(Whose, StoredChoice)> {
    let (who, json) = line.split_once(' ')?;
    let (input, files, from, stats): (PathBuf, Vec<PathBuf>, Vec<PathBuf>, Vec<String>) =
        serde_json::from_str(json).ok()?;
    if from.len() != stats.len() || from.is_empty() {
        return None;
    }
    let stat = |words: &String| {
        if words.is_empty() { Some(None) } else { Stat::parse(&mut words.split(' ')).map(Some) }
    };
    let stats: Vec<Option<Stat>> = stats.iter().map(stat).collect::<Option<_>>()?;
    let made = StoredChoice { files: files.into(), from: from.into_iter().zip(stats).collect() };
    Some(((who.parse().ok()?, input), made))
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_choice_is_stored_only_if_its_sources_were_at_rest_before_it_began() {
        let dir = tempfile::tempdir().expect("a folder");
        let whose = (Digest::of(b"stage"), dir.path().to_path_buf());
        let choice = || Choice { files: vec!["a.jpg".into()], made_from: vec![".".into()] };
        let stored = |began: SystemTime| {
            let mut choices = Choices::default();
            choices.remember(&whose, choice(), began);
            choices.still_holds(&whose).is_some()
        };
        // The folder was changed just now.
        let now = SystemTime::now();
        assert!(!stored(now) && !stored(now - Duration::from_secs(60)));
        assert!(stored(now + Duration::from_secs(60)));
    }
}
