//! Paths that the user names, and the destinations of results: checks, before any work is done, that a result
//! can be written there.
//!
//! Folders follow the rules of [`use3d_workflow::place`]. A file is replaced only with `--force`, and only if
//! it is a regular file: never a folder, a device or a symbolic link.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use use3d_capture::name::shown;
use use3d_workflow::place::{self, PlaceError};
use use3d_workflow::{Cache, Digest};

use crate::WorkError;

/// The folder of results where none is named.
pub const OUT: &str = "use3d-out";

/// An absolute form of a path; links stay in it.
pub fn absolute(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf())
}

/// The paths of a folder's files and folders; none if it cannot be read.
pub fn entries(folder: &Path) -> impl Iterator<Item = PathBuf> + use<> {
    std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path())
}

/// The hidden folder beside a result for the work of a stage by hand.
pub fn work_of(out: &Path) -> PathBuf {
    let name = out.file_name().unwrap_or_default().to_string_lossy();
    out.with_file_name(format!(".{name}.work"))
}

/// The checkpoints of trainings in a folder for the work of a stage by hand.
pub fn checkpoints_in(work: &Path) -> impl Iterator<Item = PathBuf> + use<> {
    let is_one = |file: &PathBuf| file.extension().is_some_and(|ending| ending == "checkpoint");
    Cache::checkpoints_of(work).filter(is_one)
}

/// A path with control characters escaped, for printing.
pub fn path_text(path: &Path) -> String {
    shown(&path.to_string_lossy()).into_owned()
}

/// Fails if a folder for a result is taken or cannot be written.
pub fn check_folder(out: &Path, force: bool) -> Result<(), WorkError> {
    if out.file_name().is_none() {
        let what = "this folder is in use; choose another folder for the result";
        return Err(WorkError::Input(format!("--out {}: {what}", path_text(out))));
    }
    let folder = place::parent(out);
    place::sweep(folder);
    place::check(out, force).and_then(|()| place::check_writable(folder)).map_err(|e| match e {
        PlaceError::Occupied { .. } => WorkError::Input(format!("--out {e}")),
        PlaceError::Io { .. } => e.into(),
    })
}

/// Fails if a file for a result is taken, has none of `extensions`, or cannot be written. `flag` is the flag
/// that names the file.
pub fn check_file(flag: &str, path: &Path, force: bool, extensions: &[&str]) -> Result<(), WorkError> {
    let refuse = |what: &str| Err(WorkError::Input(format!("{flag} {}: {what}", path_text(path))));
    if path.file_name().is_none() {
        return refuse("expected the name of a file");
    }
    if path == Path::new("-") {
        return refuse("results are not written to the standard output; expected the name of a file");
    }
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
    if !extensions.is_empty() && !extensions.contains(&extension.as_str()) {
        return refuse(&format!("expected a name that ends in .{}", extensions.join(" or .")));
    }
    match std::fs::symlink_metadata(path) {
        Ok(found) if found.is_dir() => return refuse("this is a folder; expected the name of a file"),
        Ok(found) if !found.is_file() => {
            return refuse(
                "this is a link or a device and not a regular file, so it is not replaced; choose another \
                 name",
            );
        }
        Ok(_) if !force => {
            return refuse("the file exists; pass --force to replace it, or choose another name");
        }
        Err(e) if e.kind() != io::ErrorKind::NotFound => return refuse(&e.to_string()),
        _ => {}
    }
    let folder = place::parent(path);
    place::sweep(folder);
    place::check_writable(folder).or_else(|e| match e {
        PlaceError::Io { source, .. } => refuse(&format!("cannot write in {}: {source}", path_text(folder))),
        other => Err(other.into()),
    })
}

/// Writes a file that [`check_file`] allowed, whole or not at all; parent folders are created.
pub fn write_file(
    flag: &str,
    path: &Path,
    fill: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
) -> Result<(), WorkError> {
    let written = use3d_files::write_atomically(path, |writer| {
        fill(writer)?;
        writer.flush()?;
        writer.get_ref().sync_all()
    });
    written.map_err(|e| WorkError::Failed(format!("{flag} {}: cannot be written: {e}", path_text(path))))
}

/// Writes a text like [`write_file`].
pub fn write_text(flag: &str, path: &Path, text: &str) -> Result<(), WorkError> {
    write_file(flag, path, |writer| writer.write_all(text.as_bytes()))
}

/// Copies a finished file to the path that the user gave.
pub fn copy_file(flag: &str, from: &Path, to: &Path) -> Result<(), WorkError> {
    write_file(flag, to, |writer| io::copy(&mut File::open(from)?, writer).map(|_| ()))
}

/// Copies a finished folder to the path that the user gave, with a record of its own.
pub fn copy_folder(from: &Path, to: &Path, force: bool) -> Result<(), WorkError> {
    put_folder(to, None, force, |made| place::copy_folder(from, made).map_err(WorkError::failed))
}

/// Fills a new folder, and moves it to its place with a record of its own. An error leaves nothing behind.
pub fn put_folder(
    to: &Path,
    key: Option<Digest>,
    force: bool,
    fill: impl FnOnce(&Path) -> Result<(), WorkError>,
) -> Result<(), WorkError> {
    let fill = |made: &Path| fill(made).and_then(|()| place::record(made, key).map_err(WorkError::failed));
    place::put_folder(to, force, fill, WorkError::failed)
}

/// A path as a word of a command line, quoted if necessary.
pub fn word(path: &Path) -> String {
    let text = path_text(path);
    let plain = |c: char| c.is_alphanumeric() || "/._-+~@:=,".contains(c);
    if !text.is_empty() && text.chars().all(plain) {
        return text;
    }
    format!("'{}'", text.replace('\'', r"'\''"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn complaint(done: Result<(), WorkError>) -> String {
        match done {
            Err(WorkError::Input(message)) => message,
            other => format!("{other:?}"),
        }
    }

    #[test]
    fn files_are_replaced_only_when_meant_and_only_regular_ones() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        let check = |path: &Path, force: bool| check_file("--ply", path, force, &["ply"]);
        check(&at("no/such/folder/a.ply"), false).unwrap();
        std::fs::write(at("a.ply"), "mine").unwrap();
        assert!(complaint(check(&at("a.ply"), false)).contains("--force"));
        check(&at("a.ply"), true).unwrap();
        assert!(complaint(check(Path::new("-"), true)).contains("standard output"));
        assert!(complaint(check(&at("a.splat"), true)).contains(".ply"));
        std::fs::create_dir(at("folder.ply")).unwrap();
        assert!(complaint(check(&at("folder.ply"), true)).contains("folder"));
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink(at("a.ply"), at("link.ply")).unwrap();
            std::os::unix::fs::symlink(at("nowhere"), at("dangling.ply")).unwrap();
            assert!(complaint(check(&at("link.ply"), true)).contains("regular"));
            assert!(complaint(check(&at("dangling.ply"), true)).contains("regular"));
            assert!(complaint(check_file("--video", Path::new("/dev/null"), true, &[])).contains("regular"));
        }
    }

    #[test]
    fn the_present_folder_is_no_place_for_a_result() {
        for out in [".", "..", "/", "a/.."] {
            assert!(complaint(check_folder(Path::new(out), true)).contains("--out"), "{out}");
        }
    }

    #[test]
    fn words_survive_a_shell() {
        assert_eq!(word(Path::new("a/b-1.png")), "a/b-1.png");
        assert_eq!(word(Path::new("it's here")), r"'it'\''s here'");
    }
}
