//! The destinations of results: checks, before any work is done, that a result can be written there.
//!
//! Folders follow the rules of [`use3d_workflow::place`]. A file is replaced only with `--force`, and only if
//! it is a regular file: never a folder, a device or a symbolic link.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use use3d_capture::name::shown;
use use3d_workflow::place::{self, PlaceError};

use crate::error::{CliError, Done};

/// A place refused before any work is bad input; a failed write is [`CliError::failed`].
impl From<PlaceError> for CliError {
    fn from(error: PlaceError) -> Self {
        Self::Input(error.to_string())
    }
}

/// A path with control characters escaped, for printing.
pub(crate) fn path_text(path: &Path) -> String {
    shown(&path.to_string_lossy()).into_owned()
}

/// Fails if a folder for a result is taken or cannot be written.
pub(crate) fn check_folder(out: &Path, force: bool) -> Done {
    let named = |e: PlaceError| match e {
        PlaceError::Occupied { .. } => CliError::Input(format!("--out {e}")),
        PlaceError::Io { .. } => e.into(),
    };
    if out.file_name().is_none() {
        let what = "this folder is in use; choose another folder for the result";
        return Err(CliError::Input(format!("--out {}: {what}", path_text(out))));
    }
    place::sweep(place::parent(out));
    place::check(out, force).map_err(named)?;
    place::check_writable(place::parent(out)).map_err(named)
}

/// Fails if a file for a result is taken, has none of `extensions`, or cannot be written. `flag` is the flag
/// that names the file.
pub(crate) fn check_file(flag: &str, path: &Path, force: bool, extensions: &[&str]) -> Done {
    let refuse = |what: &str| Err(CliError::Input(format!("{flag} {}: {what}", path_text(path))));
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
pub(crate) fn write_file(
    flag: &str,
    path: &Path,
    fill: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
) -> Done {
    let written = use3d_files::write_atomically(path, |writer| {
        fill(writer)?;
        writer.flush()?;
        writer.get_ref().sync_all()
    });
    written.map_err(|e| CliError::Failed(format!("{flag} {}: cannot be written: {e}", path_text(path))))
}

/// Copies a finished file to the path that the user gave.
pub(crate) fn copy_file(flag: &str, from: &Path, to: &Path) -> Done {
    write_file(flag, to, |writer| io::copy(&mut File::open(from)?, writer).map(|_| ()))
}

/// Copies a finished folder to the path that the user gave, with a record of its own.
pub(crate) fn copy_folder(from: &Path, to: &Path, force: bool) -> Done {
    let made = place::sibling(to);
    let placed = place::copy_folder(from, &made)
        .and_then(|()| place::record(&made, None))
        .and_then(|()| place::put(&made, to, force));
    if placed.is_err() {
        let _ = std::fs::remove_dir_all(&made); // only our files; the first error is the one to report
    }
    placed.map_err(CliError::failed)
}

/// A path as a word of a command line, quoted if necessary.
pub(crate) fn word(path: &Path) -> String {
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

    fn complaint(done: Done) -> String {
        match done {
            Err(CliError::Input(message)) => message,
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
