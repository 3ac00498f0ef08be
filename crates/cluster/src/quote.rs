//! Words of scripts: quoted so that a shell reads them unchanged, and refused if a script cannot hold them.

use std::path::Path;

use super::ClusterError;

/// A word for `bash`, quoted if necessary.
pub fn word(text: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_./=:,@%+".contains(c);
    if !text.is_empty() && text.chars().all(plain) {
        return text.to_string();
    }
    format!("'{}'", text.replace('\'', r"'\''"))
}

/// Words with spaces between.
pub fn words(words: &[impl AsRef<str>]) -> String {
    words.iter().map(|w| word(w.as_ref())).collect::<Vec<_>>().join(" ")
}

/// A path as a word of a script.
///
/// # Errors
/// It is not UTF-8.
pub fn path_word(path: &Path) -> Result<String, ClusterError> {
    let text = path.to_str().ok_or_else(|| ClusterError::NotUtf8(path.display().to_string()));
    text.map(String::from)
}

/// Refuses a text with a control character: it goes into comments and lines of a script, so it must be one
/// line. `name` names it in the error.
///
/// # Errors
/// There is one.
pub fn one_line(text: &str, name: impl FnOnce() -> String) -> Result<(), ClusterError> {
    if text.chars().any(char::is_control) { Err(ClusterError::Control(name())) } else { Ok(()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_shell_would_read_otherwise_is_quoted() {
        for (text, quoted) in [
            ("reef@full", "reef@full"),
            ("a b", "'a b'"),
            ("", "''"),
            ("it's", r"'it'\''s'"),
            ("$HOME;`x`", "'$HOME;`x`'"),
            ("~/x", "'~/x'"),
            ("Korallé", "'Korallé'"),
        ] {
            assert_eq!(word(text), quoted);
        }
    }
}
