//! Errors, whose messages include the next step for the user.

use std::error::Error;
use std::fmt;
use std::path::{Path, PathBuf};

use use3d_code::CodeError;

/// An invalid parameter of a stage.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ParameterError {
    /// Dotted path of the parameter; empty for the whole.
    pub path: String,
    /// The problem in words, and the expected value.
    pub message: String,
    /// The problem as data.
    pub problem: Problem,
}

/// A problem with a parameter.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Problem {
    /// The table has no such key.
    UnknownKey {
        /// The key.
        name: String,
        /// The keys that there are.
        known: Vec<String>,
    },
    /// There is no such choice.
    UnknownChoice {
        /// The choice.
        name: String,
        /// The choices that there are.
        known: Vec<String>,
    },
    /// A field without a default is missing.
    Missing(&'static str),
    /// Text is expected, and something else was found.
    NoText,
    /// The value is out of range or of another type.
    Value,
}

impl ParameterError {
    /// A problem with the value of the parameter at a path.
    pub(crate) fn new(path: impl Into<String>, message: String) -> Self {
        Self { path: path.into(), message, problem: Problem::Value }
    }

    /// The unknown key and the keys that there are, if that is the problem.
    pub fn unknown_key(&self) -> Option<(&str, &[String])> {
        match &self.problem {
            Problem::UnknownKey { name, known } => Some((name, known)),
            _ => None,
        }
    }

    /// The known name nearest to the unknown one, if any is near.
    pub fn suggestion(&self) -> Option<&str> {
        let (Problem::UnknownKey { name, known } | Problem::UnknownChoice { name, known }) = &self.problem
        else {
            return None;
        };
        nearest(name, known.iter().map(String::as_str))
    }
}

impl fmt::Display for ParameterError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if !self.path.is_empty() {
            // A message about a value continues the sentence that begins with its name.
            let joint = if self.message.starts_with("is ") { " " } else { ": " };
            write!(f, "`{}`{joint}", self.path)?;
        }
        f.write_str(&self.message)?;
        self.suggestion().map_or(Ok(()), |near| write!(f, "; did you mean `{near}`?"))
    }
}

impl Error for ParameterError {}

/// The name nearest to `wrong`, or `None` if all names differ too much.
pub fn nearest<'n>(wrong: &str, names: impl IntoIterator<Item = &'n str>) -> Option<&'n str> {
    let lower = wrong.to_lowercase();
    names
        .into_iter()
        .map(|name| (strsim::jaro_winkler(&lower, &name.to_lowercase()), name))
        .filter(|(score, _)| *score > 0.75)
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, name)| name)
}

/// The reason why a stage did not fill its folder.
///
/// Any error converts with `?`. (This type is itself not a `std::error::Error`, which makes that conversion
/// possible.)
#[derive(Debug)]
pub enum StageError {
    /// The stage was stopped; its checkpoints are on disk.
    Cancelled,
    /// The stage failed.
    Failed(Box<dyn Error + Send + Sync>),
}

impl StageError {
    /// A failure from an error.
    pub fn failed(error: impl Error + Send + Sync + 'static) -> Self {
        Self::Failed(Box::new(error))
    }

    /// A failure with a message.
    pub fn message(text: impl Into<String>) -> Self {
        Self::Failed(text.into().into())
    }

    /// A failure caused by the stage's inputs, not by the stage's own work.
    pub fn bad_input(error: impl Error + Send + Sync + 'static) -> Self {
        Self::failed(BadInput(Box::new(error)))
    }

    /// The same with a message.
    pub fn bad_input_message(text: impl Into<String>) -> Self {
        Self::Failed(Box::new(BadInput(text.into().into())))
    }

    /// Returns true if the inputs caused the failure.
    pub fn is_bad_input(&self) -> bool {
        matches!(self, Self::Failed(error) if error.is::<BadInput>())
    }

    /// A failure to read or write a file.
    pub fn io(path: &Path, source: std::io::Error) -> Self {
        Self::failed(FileError { path: path.to_path_buf(), doing: "use", source })
    }
}

/// Marks an error as caused by the input; the text is the inner error's.
#[derive(Debug, thiserror::Error)]
#[error(transparent)]
struct BadInput(Box<dyn Error + Send + Sync>);

impl<E: Error + Send + Sync + 'static> From<E> for StageError {
    fn from(error: E) -> Self {
        Self::failed(error)
    }
}

impl fmt::Display for StageError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Cancelled => f.write_str("interrupted"),
            Self::Failed(error) => f.write_str(&chain(error.as_ref())),
        }
    }
}

/// An error and its causes in one line.
pub fn chain(error: &dyn Error) -> String {
    let mut text = error.to_string();
    for cause in std::iter::successors(error.source(), |&cause| cause.source()) {
        let cause = cause.to_string();
        if !text.contains(&cause) {
            text = format!("{text}: {cause}");
        }
    }
    text
}

/// A file operation that failed.
#[derive(Debug, thiserror::Error)]
#[error("cannot {doing} {}: {source}{}", path.display(), advice(source))]
pub struct FileError {
    /// The file or folder.
    pub path: PathBuf,
    /// The operation that was tried, as a verb.
    pub doing: &'static str,
    /// The system's error.
    pub source: std::io::Error,
}

fn advice(error: &std::io::Error) -> &'static str {
    use std::io::ErrorKind as Kind;
    match error.kind() {
        Kind::StorageFull | Kind::QuotaExceeded => {
            " (the disk is full: free some space, choose another folder with --cache, or run `use3d gc`, which removes steps that can be computed again; nothing finished is lost)"
        }
        Kind::NotADirectory | Kind::AlreadyExists => {
            " (this is a file or lies below one: give a folder with --cache or --out)"
        }
        Kind::ReadOnlyFilesystem | Kind::PermissionDenied => {
            " (choose a folder that can be written: --out for results, --cache or USE3D_CACHE for the cache)"
        }
        _ => "",
    }
}

/// The errors that stop the builder as a whole.
#[derive(Debug, thiserror::Error)]
pub enum BuildError {
    /// A file operation failed.
    #[error(transparent)]
    File(#[from] FileError),
    /// A stage names code that does not exist.
    #[error("stage `{stage}`: {source}")]
    Code {
        /// The stage.
        stage: String,
        /// The problem.
        source: CodeError,
    },
    /// The stages do not fit together. This is a mistake in the program, found when the registry is built.
    #[error("stage table: {0}")]
    Registry(String),
    /// A name that does not exist.
    #[error("no {kind} `{name}`{}; there are: {known}", suggestion.as_ref().map(|s| format!(" (did you mean `{s}`?)")).unwrap_or_default())]
    Unknown {
        /// The kind of the name, such as a scene or stage.
        kind: &'static str,
        /// The name that was given.
        name: String,
        /// The nearest known one.
        suggestion: Option<String>,
        /// The known names.
        known: String,
    },
    /// Invalid parameters of a stage.
    #[error("{place}: {error}")]
    Parameters {
        /// The place where they are written.
        place: String,
        /// The problem.
        error: Box<ParameterError>,
    },
}

impl BuildError {
    /// An unknown name, with the nearest known one.
    pub fn unknown<'n>(kind: &'static str, name: &str, known: impl IntoIterator<Item = &'n str>) -> Self {
        let known: Vec<&str> = known.into_iter().collect();
        Self::Unknown {
            kind,
            name: name.to_string(),
            suggestion: nearest(name, known.iter().copied()).map(String::from),
            known: known.join(", "),
        }
    }
}
