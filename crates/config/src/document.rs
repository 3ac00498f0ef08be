//! A TOML text as a JSON value, together with the position of each key and value in the text.

use std::collections::BTreeMap;
use std::fmt;
use std::ops::Range;
use std::path::{Path, PathBuf};

use serde_json::{Map, Number, Value};
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use use3d_workflow::error::{ParameterError, nearest};

/// A parsed pipeline file.
#[derive(Debug)]
pub(crate) struct Document {
    file: PathBuf,
    text: String,
    pub(crate) value: Value,
    spans: Spans,
}

/// An error in a pipeline file, or in the command-line options that extend it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ConfigError {
    /// The file; `None` for the command line.
    pub file: Option<PathBuf>,
    /// Line and column, from 1.
    pub place: Option<(usize, usize)>,
    /// The problem, the expected value and the remedy.
    pub message: String,
    /// The line of the file, with a mark below the faulty part.
    excerpt: Option<String>,
}

impl ConfigError {
    /// An error without a place.
    pub(crate) fn plain(message: impl Into<String>) -> Self {
        Self { file: None, place: None, message: message.into(), excerpt: None }
    }
}

impl fmt::Display for ConfigError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(file) = &self.file {
            write!(f, "{}", file.display())?;
            if let Some((line, column)) = self.place {
                write!(f, ":{line}:{column}")?;
            }
            write!(f, ": ")?;
        }
        f.write_str(&self.message)?;
        match &self.excerpt {
            Some(excerpt) => write!(f, "\n{excerpt}"),
            None => Ok(()),
        }
    }
}

impl std::error::Error for ConfigError {}

impl Document {
    pub(crate) fn read(file: &Path) -> Result<Self, ConfigError> {
        let text = std::fs::read_to_string(file).map_err(|e| ConfigError {
            file: Some(file.to_path_buf()),
            ..ConfigError::plain(match e.kind() {
                std::io::ErrorKind::InvalidData => {
                    "this is no text: expected a pipeline file (.toml), a film, or a folder with photographs"
                        .into()
                }
                _ => format!("cannot read the pipeline file: {e}"),
            })
        })?;
        Self::parse(file, text)
    }

    pub(crate) fn parse(file: &Path, text: String) -> Result<Self, ConfigError> {
        let mut this = Self { file: file.to_path_buf(), text, value: Value::Null, spans: Spans::new() };
        let parsed = DeTable::parse(&this.text)
            .map_err(|e| (e.span().unwrap_or(0..0), format!("this is not TOML: {}", e.message())))
            .and_then(|parsed| table("", parsed.get_ref(), &mut this.spans));
        match parsed {
            Ok(value) => Ok(Self { value, ..this }),
            Err((span, message)) => Err(this.error_in(&span, message)),
        }
    }

    /// True if the file has a value at a path.
    pub(crate) fn has(&self, path: &str) -> bool {
        self.spans.contains_key(path)
    }

    /// An error about the value at a path, or about the nearest value above it if there is none at the path.
    pub(crate) fn error(&self, path: &str, message: impl Into<String>) -> ConfigError {
        self.at(path, message.into(), false)
    }

    /// An error about the key at a path.
    pub(crate) fn key_error(&self, path: &str, message: impl Into<String>) -> ConfigError {
        self.at(path, message.into(), true)
    }

    /// An error about a parameter of the table at `base`. `more` lists further names that are valid there.
    pub(crate) fn parameter_error(&self, base: &str, error: &ParameterError, more: &[&str]) -> ConfigError {
        let path = join(base, &error.path);
        match error.unknown_key() {
            Some((unknown, known)) => {
                let known = known.iter().map(String::as_str).chain(more.iter().copied());
                self.key_error(&path, unknown_key(unknown, known))
            }
            None => self.error(&path, error.to_string()),
        }
    }

    fn at(&self, path: &str, message: String, key: bool) -> ConfigError {
        let mut path = path.to_string();
        loop {
            if let Some((key_span, value_span)) = self.spans.get(&path) {
                return self.error_in(if key { key_span } else { value_span }, message);
            }
            match path.rfind(['.', '[']) {
                Some(cut) => path.truncate(cut),
                None => return self.error_in(&(0..0), message),
            }
        }
    }

    fn error_in(&self, span: &Range<usize>, message: String) -> ConfigError {
        let start = span.start.min(self.text.len());
        let line_start = self.text[..start].rfind('\n').map_or(0, |i| i + 1);
        let line_end = self.text[start..].find('\n').map_or(self.text.len(), |i| start + i);
        let line = self.text[..start].matches('\n').count() + 1;
        let column = self.text[line_start..start].chars().count() + 1;
        let marked = self.text[start..span.end.clamp(start, line_end)].chars().count().max(1);
        let number = line.to_string();
        let margin = " ".repeat(number.len());
        let shown = &self.text[line_start..line_end];
        let mark = format!("{}{}", " ".repeat(column - 1), "^".repeat(marked));
        ConfigError {
            file: Some(self.file.clone()),
            place: Some((line, column)),
            message,
            excerpt: Some(format!("{margin} |\n{number} | {shown}\n{margin} | {mark}")),
        }
    }
}

/// The message "unknown key `x`; did you mean `y`?", or the list of valid keys if none is similar.
pub(crate) fn unknown_key<'k>(unknown: &str, known: impl Iterator<Item = &'k str> + Clone) -> String {
    match nearest(unknown, known.clone()) {
        Some(near) => format!("unknown key `{unknown}`; did you mean `{near}`?"),
        None => format!("unknown key `{unknown}`; known here: {}", Vec::from_iter(known).join(", ")),
    }
}

pub(crate) fn join(base: &str, path: &str) -> String {
    match (base.is_empty(), path.is_empty()) {
        (true, _) => path.to_string(),
        (_, true) => base.to_string(),
        _ => format!("{base}.{path}"),
    }
}

/// Maps a path (`scene[0].reconstruct.iterations`) to the byte ranges of its key and of its value.
type Spans = BTreeMap<String, (Range<usize>, Range<usize>)>;
type Wrong = (Range<usize>, String);

fn table(base: &str, table: &DeTable<'_>, spans: &mut Spans) -> Result<Value, Wrong> {
    let mut out = Map::new();
    for (key, item) in table {
        let path = join(base, key.get_ref());
        spans.insert(path.clone(), (key.span(), item.span()));
        out.insert(key.get_ref().to_string(), value(&path, item, spans)?);
    }
    Ok(Value::Object(out))
}

fn value(path: &str, item: &Spanned<DeValue<'_>>, spans: &mut Spans) -> Result<Value, Wrong> {
    let wrong = |message: &str| (item.span(), message.to_string());
    Ok(match item.get_ref() {
        DeValue::String(text) => Value::String(text.to_string()),
        DeValue::Integer(digits) => {
            let plain = digits.as_str().replace('_', "");
            let plain = plain.trim_start_matches('+');
            let signed = i64::from_str_radix(plain, digits.radix()).map(Value::from);
            let any = signed.or_else(|_| u64::from_str_radix(plain, digits.radix()).map(Value::from));
            any.map_err(|_| wrong("this whole number is too large"))?
        }
        DeValue::Float(digits) => {
            let number: Option<f64> = digits.as_str().replace('_', "").parse().ok();
            let number = number.and_then(Number::from_f64);
            Value::Number(number.ok_or_else(|| wrong("a finite number is expected"))?)
        }
        DeValue::Boolean(yes) => Value::Bool(*yes),
        DeValue::Datetime(time) => Value::String(time.to_string()),
        DeValue::Array(items) => {
            let each = items.iter().enumerate().map(|(i, item)| {
                let path = format!("{path}[{i}]");
                spans.insert(path.clone(), (item.span(), item.span()));
                value(&path, item, spans)
            });
            Value::Array(each.collect::<Result<_, _>>()?)
        }
        DeValue::Table(inner) => table(path, inner, spans)?,
    })
}

/// A value from the command line: parsed as TOML if possible, else the text itself (`rbf`, `1400x933`).
pub(crate) fn loose_value(text: &str) -> Value {
    let parsed = DeValue::parse(text).ok().and_then(|v| value("", &v, &mut Spans::new()).ok());
    parsed.unwrap_or_else(|| Value::String(text.to_string()))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn values_of_the_command_line() {
        for (text, expected) in [
            ("3000", json!(3000)),
            ("1_000", json!(1000)),
            ("-3", json!(-3)),
            ("0.5", json!(0.5)),
            ("1e-3", json!(1e-3)),
            ("true", json!(true)),
            ("rbf", json!("rbf")),
            ("\"3000\"", json!("3000")),
            ("1400x933", json!("1400x933")),
            ("[1, 2]", json!([1, 2])),
            ("", json!("")),
            ("nan", json!("nan")),
        ] {
            assert_eq!(loose_value(text), expected, "{text}");
        }
    }

    #[test]
    fn errors_point_into_the_text() {
        let text = "name = \"x\"\n[[scene]]\nname = \"a\"\nimport = { sise = 3 }\n".to_string();
        let document = Document::parse(Path::new("p.toml"), text).expect("TOML");
        assert_eq!(document.value, json!({"name": "x", "scene": [{"name": "a", "import": {"sise": 3}}]}));
        let error = document.key_error("scene[0].import.sise", "unknown");
        assert_eq!(error.place, Some((4, 12)));
        assert_eq!(
            error.to_string(),
            "p.toml:4:12: unknown\n  |\n4 | import = { sise = 3 }\n  |            ^^^^"
        );
        assert_eq!(document.error("scene[0].import.absent.deep", "m").place, Some((4, 10)));
        let error =
            Document::parse(Path::new("p.toml"), "name = \"x\nb = 1".to_string()).expect_err("not TOML");
        assert_eq!(error.place.map(|p| p.0), Some(1));
        assert!(Document::parse(Path::new("p.toml"), "a = inf".to_string()).is_err());
    }
}
