//! Old results that are removed from a results folder. The report with its pages, and the tables, stay.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use use3d_workflow::gc::{Cleaning, Removed};
use use3d_workflow::machine::seconds;
use use3d_workflow::place::{self, Look, PlaceError, Standing, at};

use crate::results::{STAMPED, VIEW};

/// Removes the results of scenes in the results folder `out` that were written longer ago than `age`: the
/// folders with a record, and the scene's page in 3D. Only what this program wrote, and nobody changed since,
/// is removed. A run that wants these results again writes them from the cache.
///
/// # Errors
/// Fails if the folder cannot be read. What cannot be removed is listed in the report.
pub fn clean_results(out: &Path, age: Duration, dry_run: bool) -> Result<Cleaning, PlaceError> {
    let mut cleaning = Cleaning { removed: Vec::new(), failed: Vec::new(), left: 0, dry_run };
    for scene in folders(out)? {
        let mut old = Vec::new();
        let mut entries = walkdir::WalkDir::new(&scene).min_depth(1).sort_by_file_name().into_iter();
        while let Some(Ok(entry)) = entries.next() {
            let path = entry.path();
            let is_page = entry.file_type().is_file() && entry.file_name() == VIEW;
            let is_result = entry.file_type().is_dir() && path.join(place::RECORD).is_file();
            if is_result {
                entries.skip_current_dir();
            }
            if !is_page && !is_result {
                continue;
            }
            let written = if is_page { path.to_path_buf() } else { path.join(place::RECORD) };
            let written = fs::metadata(&written).and_then(|found| found.modified()).ok();
            let since = written.and_then(|time| SystemTime::now().duration_since(time).ok());
            match since.filter(|since| *since > age) {
                Some(since) => old.push((path.to_path_buf(), is_page, since)),
                None => cleaning.left += bytes_below(path),
            }
        }
        for (path, is_page, since) in old {
            let name = path.strip_prefix(out).unwrap_or(&path).to_string_lossy().into_owned();
            let bytes = bytes_below(&path);
            match remove(&path, is_page, dry_run) {
                Ok(()) => {
                    let reason = format!("written {} ago", seconds(since.as_secs_f64()));
                    cleaning.removed.push(Removed { kind: "result", name, bytes, reason, path });
                }
                Err(error) => {
                    cleaning.left += bytes;
                    cleaning.failed.push((name, error));
                }
            }
        }
        if !dry_run {
            // Only an empty folder goes.
            let _ = fs::remove_dir(&scene);
        }
    }
    Ok(cleaning)
}

/// Removes a result. The error is a clause.
fn remove(path: &Path, is_page: bool, dry_run: bool) -> Result<(), String> {
    let is_ours = match (is_page, dry_run) {
        (true, _) => STAMPED.check(path).map(|()| true),
        (false, true) => place::look(path, Look::Close).map(|found| matches!(found, Standing::Ours(_))),
        (false, false) => place::remove(path),
    };
    match is_ours {
        Ok(true) if is_page && !dry_run => fs::remove_file(path).map_err(|error| error.to_string()),
        Ok(true) => Ok(()),
        Ok(false) | Err(PlaceError::Occupied { .. }) => {
            Err("it was not written by this program, or was changed since, so it stays".to_string())
        }
        Err(error) => Err(error.to_string()),
    }
}

/// The folders in a folder, sorted.
fn folders(out: &Path) -> Result<Vec<PathBuf>, PlaceError> {
    let entries: std::io::Result<Vec<fs::DirEntry>> = fs::read_dir(out).and_then(Iterator::collect);
    let mut folders: Vec<PathBuf> = at(out, "read", entries)?
        .into_iter()
        .filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_dir()))
        .map(|entry| entry.path())
        .filter(|folder| !folder.join(place::RECORD).is_file())
        .collect();
    folders.sort();
    Ok(folders)
}

fn bytes_below(path: &Path) -> u64 {
    let entries = walkdir::WalkDir::new(path).into_iter().filter_map(Result::ok);
    entries
        .filter_map(|entry| entry.metadata().ok())
        .filter(|found| found.is_file())
        .map(|found| found.len())
        .sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_old_results_of_this_program_go() {
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path();
        let result = |name: &str, days: u64| {
            let folder = out.join(name);
            fs::create_dir_all(&folder).unwrap();
            fs::write(folder.join("gaussians.ply"), "g").unwrap();
            place::record(&folder, None).unwrap();
            age(&folder.join(place::RECORD), days);
            folder
        };
        let (old, edited, fresh) =
            (result("reef/scene", 40), result("reef/scores", 40), result("wreck/scene", 1));
        fs::write(edited.join("gaussians.ply"), "mine").unwrap();
        fs::write(old.join("notes.txt"), "mine").unwrap();
        let [page, mine, report] =
            ["reef/view.html", "wreck/view.html", "reef/report.html"].map(|name| out.join(name));
        STAMPED.write(&page, "<html>").unwrap();
        STAMPED.write(&report, "<html>").unwrap();
        fs::write(&mine, "<html>").unwrap();
        [&page, &mine, &report].into_iter().for_each(|page| age(page, 40));
        let days = |days: u64| Duration::from_secs(86_400 * days);
        let dry = clean_results(out, days(30), true).unwrap();
        assert_eq!(dry.removed.len(), 2);
        assert!(old.join("gaussians.ply").is_file() && page.is_file());
        let cleaning = clean_results(out, days(30), false).unwrap();
        assert_eq!(cleaning.removed.iter().map(|item| &item.path).collect::<Vec<_>>(), [&old, &page]);
        assert_eq!(cleaning.failed.len(), 2, "{:?}", cleaning.failed);
        assert!(!old.join("gaussians.ply").exists() && !page.exists());
        assert_eq!(fs::read_to_string(old.join("notes.txt")).unwrap(), "mine");
        assert!(
            report.is_file() && mine.is_file() && edited.is_dir() && fresh.join("gaussians.ply").is_file()
        );
    }

    fn age(path: &Path, days: u64) {
        let file = fs::File::options().write(true).open(path).unwrap();
        file.set_modified(SystemTime::now() - Duration::from_secs(86_400 * days)).unwrap();
    }
}
