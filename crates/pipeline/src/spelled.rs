//! Flags of the command line that stand for settings.

use use3d_reconstruct::EngineChoice;
use use3d_stages::registry;
use use3d_workflow::{Registry, Stage};

/// A flag that stands for a setting.
#[derive(Clone, Debug)]
pub struct Spelled {
    flag: &'static str,
    stage: &'static str,
    key: &'static str,
    value: String,
}

impl Spelled {
    /// The flag `flag` with a value, which stands for `--set STAGE.KEY=VALUE`.
    #[allow(clippy::needless_pass_by_value, reason = "callers give numbers, words and sizes alike")]
    pub fn new(flag: &'static str, stage: &'static str, key: &'static str, value: impl ToString) -> Self {
        Self { flag, stage, key, value: value.to_string() }
    }

    /// The flag `--preset`, which stands for `--set preset=NAME`.
    pub fn preset(name: &str) -> Self {
        Self::new("--preset", "", "preset", name)
    }

    /// The engine as a setting of every stage that has one.
    pub fn engines(engine: Option<&EngineChoice>) -> Vec<Self> {
        let registry = engine.and_then(|_| registry().ok());
        let stages = registry.iter().flat_map(Registry::stages).filter(|stage| stage.device.is_some());
        let of = |stage: &Stage| Some(Self::new("--engine", stage.name(), "engine", engine?));
        stages.filter_map(of).collect()
    }

    /// The setting in the form of `--set`.
    pub fn set(&self) -> String {
        let dot = if self.stage.is_empty() { "" } else { "." };
        format!("{}{dot}{}={}", self.stage, self.key, self.value)
    }
}

/// Rewrites a message about a setting so that it names the flag that was typed.
pub fn as_typed(message: &str, spelled: &[Spelled]) -> String {
    let told = |Spelled { flag, key, value, .. }: &Spelled| {
        let rest = message.strip_prefix("--set ")?;
        let (setting, rest) = rest.split_once(&format!("{key}={value}: "))?;
        let stage = setting.is_empty() || setting.ends_with('.') && !setting.contains(' ');
        // The parameter's name adds nothing to the flag.
        let parameter = [format!("`{setting}{key}`: "), format!("`{key}`: ")];
        let rest = parameter.iter().find_map(|name| rest.strip_prefix(name.as_str())).unwrap_or(rest);
        stage.then(|| format!("{flag} {value}: {rest}"))
    };
    spelled.iter().find_map(told).unwrap_or_else(|| message.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_engine_is_refused_by_the_flag_that_was_typed() {
        let engine = EngineChoice::Gpu(Some("vega".into()));
        let spelled = Spelled::engines(Some(&engine));
        let said = |message: &str| as_typed(message, &spelled);
        assert_eq!(said("--set engine=gpu:vega: `engine`: none"), "--engine gpu:vega: none");
        assert_eq!(said("--set reconstruct.engine=gpu:vega: `engine`: none"), "--engine gpu:vega: none");
        for other in ["--set iterations=x: a number", "scene.toml: engine=gpu:vega: none"] {
            assert_eq!((said(other), as_typed(other, &[])), (other.to_string(), other.to_string()));
        }
        let size = [Spelled::new("--size", "import", "size", "640")];
        let refused = "--set import.size=640: `import.size`: \"640\" is not a size";
        assert_eq!(as_typed(refused, &size), "--size 640: \"640\" is not a size");
        let preset = [Spelled::preset("papre")];
        assert_eq!(preset[0].set(), "preset=papre");
        assert_eq!(as_typed("--set preset=papre: no preset", &preset), "--preset papre: no preset");
    }
}
