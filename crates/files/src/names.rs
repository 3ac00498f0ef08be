//! Names that no other process, on any machine or in any container, and no other call uses.

use std::fs::{File, OpenOptions};
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::owner::{ProcessId, random};

/// The prefix of the names of unfinished files and folders.
pub const BEING_MADE: &str = ".use3d-tmp-";

/// Returns a name that no other call in any process returns. It begins with the [name](ProcessId::name) of
/// this process.
pub fn unique() -> String {
    unique_of(OWNER.get_or_init(|| ProcessId::this().name()))
}

static OWNER: OnceLock<String> = OnceLock::new();

fn unique_of(owner: &str) -> String {
    static COUNTER: AtomicU64 = AtomicU64::new(0);
    static CHANCE: OnceLock<u64> = OnceLock::new();
    let chance = CHANCE.get_or_init(random);
    format!("{owner}-{chance:016x}-{}", COUNTER.fetch_add(1, Ordering::Relaxed))
}

/// Returns the folder that contains `path`.
pub fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Returns a path in the folder of `path`: `begin` and a [unique] name. It does not contain the name of
/// `path`, which may already have the maximum length.
pub fn beside(path: &Path, begin: &str) -> PathBuf {
    folder_of(path).join(format!("{begin}{}", unique()))
}

/// Creates a file in the folder of `path`. Its name is `begin`, a [unique] name and `end`.
///
/// # Errors
/// An error if no file can be created in the folder.
pub fn create_beside(path: &Path, begin: &str, end: &str) -> io::Result<(PathBuf, File)> {
    create(|| folder_of(path).join(format!("{begin}{}{end}", unique())))
}

/// Options for opening a file of a fixed name. Where a symbolic link has the name, opening fails.
pub fn no_link() -> OpenOptions {
    let mut options = OpenOptions::new();
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::custom_flags(&mut options, libc::O_NOFOLLOW);
    options
}

/// Creates a file under the first free name. A name that a link has is not free.
fn create(mut name: impl FnMut() -> PathBuf) -> io::Result<(PathBuf, File)> {
    loop {
        let path = name();
        match File::options().write(true).create_new(true).open(&path) {
            Ok(file) => return Ok((path, file)),
            Err(error) if error.kind() == ErrorKind::AlreadyExists => {}
            Err(error) => return Err(error),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;
    use std::process::Command;

    use super::*;
    use crate::write_atomically;

    /// The variable that gives a child process of a test its task.
    const DO: &str = "USE3D_TEST_NAMES";

    fn this_test_again(name: &str, order: &str) -> Command {
        let mut command = Command::new(std::env::current_exe().unwrap());
        command.args(["--exact", &format!("names::tests::{name}"), "--nocapture"]).env(DO, order);
        command
    }

    #[test]
    fn processes_that_think_they_are_one_get_different_names() {
        let names: Vec<String> = (0..3).map(|_| unique_of("a-1-2")).collect();
        if std::env::var_os(DO).is_some() {
            println!("names: {}", names.join(" "));
            return;
        }
        let said = || -> Vec<String> {
            let own = "processes_that_think_they_are_one_get_different_names";
            let text = String::from_utf8(this_test_again(own, "say").output().unwrap().stdout).unwrap();
            let line = text.lines().find_map(|line| line.split_once("names: ")).unwrap().1;
            line.split(' ').map(String::from).collect()
        };
        let (one, other) = (said(), said());
        let parts = |name: &str| -> (String, String, String) {
            let (rest, count) = name.rsplit_once('-').unwrap();
            let (owner, chance) = rest.rsplit_once('-').unwrap();
            (owner.to_string(), chance.to_string(), count.to_string())
        };
        for (counted, (a, b)) in one.iter().zip(&other).enumerate() {
            let (a, b) = (parts(a), parts(b));
            assert_eq!((&a.0, &a.2), (&b.0, &b.2));
            assert_eq!((a.0.as_str(), a.1.len(), a.2), ("a-1-2", 16, counted.to_string()));
            assert_ne!(a.1, b.1);
        }
        assert_eq!((one.len(), other.len()), (3, 3));
    }

    /// Stands for two containers that render into one folder: both are process 1, and they have the same
    /// start time and the same counter.
    #[test]
    fn two_processes_of_one_id_write_into_one_folder() {
        const FILES: usize = 300;
        if let Some(order) = std::env::var_os(DO) {
            let folder = PathBuf::from(order);
            OWNER.set("container-1-1".to_string()).unwrap();
            let which = folder.file_name().unwrap().to_str().unwrap().to_string();
            for i in 0..FILES {
                let text = format!("{which} {i} ").repeat(500);
                let path = folder.with_file_name(format!("{which}-{i}"));
                // Two writes give the other process time to write between them.
                write_atomically(&path, |w| {
                    w.write_all(text.as_bytes())?;
                    w.flush()?;
                    w.write_all(text.as_bytes())
                })
                .unwrap();
            }
            return;
        }
        let dir = tempfile::tempdir().unwrap();
        let own = "two_processes_of_one_id_write_into_one_folder";
        let start =
            |which: &str| this_test_again(own, dir.path().join(which).to_str().unwrap()).spawn().unwrap();
        for mut child in [start("one"), start("other")] {
            assert!(child.wait().unwrap().success());
        }
        for which in ["one", "other"] {
            for i in 0..FILES {
                let text = std::fs::read_to_string(dir.path().join(format!("{which}-{i}"))).unwrap();
                assert!(text == format!("{which} {i} ").repeat(1000), "{which}-{i} has other bytes");
            }
        }
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 2 * FILES);
    }

    #[cfg(unix)]
    #[test]
    fn a_planted_link_is_not_followed() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        std::fs::write(at("victim"), "precious").unwrap();
        std::os::unix::fs::symlink(at("victim"), at("guessed")).unwrap();
        std::os::unix::fs::symlink(at("nowhere"), at("guessed too")).unwrap();
        let mut names = ["guessed", "guessed too", "free"].into_iter();
        let (path, mut file) = create(|| at(names.next().unwrap())).unwrap();
        file.write_all(b"a result").unwrap();
        assert_eq!(path, at("free"));
        assert_eq!(std::fs::read_to_string(at("victim")).unwrap(), "precious");
        assert!(!at("nowhere").exists() && at("guessed").is_symlink());
        for name in ["guessed", "guessed too"] {
            assert!(no_link().write(true).create(true).truncate(true).open(at(name)).is_err());
        }
        assert_eq!(std::fs::read_to_string(at("victim")).unwrap(), "precious");
        no_link().append(true).create(true).open(at("free")).unwrap().write_all(b"!").unwrap();
        assert_eq!(std::fs::read_to_string(at("free")).unwrap(), "a result!");
    }

    #[test]
    fn names_of_this_process_say_that_it_runs() {
        let (path, _) = create_beside(&std::env::temp_dir().join("x"), BEING_MADE, ".y4m").unwrap();
        let name = path.file_name().unwrap().to_str().unwrap().to_string();
        std::fs::remove_file(&path).unwrap();
        assert_ne!(ProcessId::owner_is_alive(name.strip_prefix(BEING_MADE).unwrap()), Some(false));
        assert!(name.ends_with(".y4m") && path.parent() == Some(&std::env::temp_dir()));
    }
}
