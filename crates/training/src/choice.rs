//! The choice of the engine for a training, in the form of command lines and pipeline files.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// The engine that computes a training.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum EngineChoice {
    /// The best graphics card that passes its check at the start and supports the requested training, else
    /// the processor.
    Auto,
    /// The processor.
    #[default]
    Cpu,
    /// A graphics card: the best one, or the first one whose name contains this text, in any case.
    Gpu(Option<String>),
}

/// The error for a text that names no engine.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{0}` is not an engine; expected auto, cpu, gpu or gpu:NAME with any part of an adapter's name (`use3d \
     devices` lists them)"
)]
pub struct UnknownEngine(String);

impl FromStr for EngineChoice {
    type Err = UnknownEngine;

    fn from_str(text: &str) -> Result<Self, UnknownEngine> {
        match (text, text.split_once(':')) {
            ("auto", _) => Ok(Self::Auto),
            ("cpu", _) => Ok(Self::Cpu),
            ("gpu", _) => Ok(Self::Gpu(None)),
            (_, Some(("gpu", name))) if !name.trim().is_empty() => {
                Ok(Self::Gpu(Some(name.trim().to_string())))
            }
            _ => Err(UnknownEngine(text.to_string())),
        }
    }
}

impl TryFrom<String> for EngineChoice {
    type Error = UnknownEngine;

    fn try_from(text: String) -> Result<Self, UnknownEngine> {
        text.parse()
    }
}

impl From<EngineChoice> for String {
    fn from(choice: EngineChoice) -> Self {
        choice.to_string()
    }
}

impl fmt::Display for EngineChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => f.write_str("auto"),
            Self::Cpu => f.write_str("cpu"),
            Self::Gpu(None) => f.write_str("gpu"),
            Self::Gpu(Some(name)) => write!(f, "gpu:{name}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read_and_what_is_no_engine_is_refused() {
        for text in ["auto", "cpu", "gpu", "gpu:RTX 3090"] {
            assert_eq!(text.parse::<EngineChoice>().unwrap().to_string(), text);
        }
        assert_eq!("gpu: llvmpipe ".parse(), Ok(EngineChoice::Gpu(Some("llvmpipe".into()))));
        for text in ["", "cuda", "gpu:", "gpu: ", "GPU"] {
            let error = text.parse::<EngineChoice>().unwrap_err().to_string();
            assert!(error.contains(&format!("`{text}`")) && error.contains("use3d devices"), "{error}");
        }
    }
}
