//! The text of files, for all formats: UTF-8 with or without a byte order mark, and JSON in it.
//!
//! Python writes numbers that are not finite as `NaN` and `Infinity`, and C as `nan` and `inf`, which no JSON
//! has. Each of them is read as the text `"NaN"`, so that a reader finds no number there and names the place.

use std::collections::BTreeSet;
use std::path::Path;

use serde::de::DeserializeOwned;

use crate::read::ReadError;

/// The text of a file, without its byte order mark.
///
/// # Errors
/// The number of the first line that is not UTF-8, and the fault with the next step.
pub fn text(bytes: &[u8]) -> Result<&str, (usize, String)> {
    if bytes.starts_with(&[0xff, 0xfe]) || bytes.starts_with(&[0xfe, 0xff]) {
        return Err((1, "it is UTF-16 text; save it as UTF-8".into()));
    }
    let text = std::str::from_utf8(bytes).map_err(|e| {
        let before = bytes[..e.valid_up_to()].iter().filter(|b| **b == b'\n').count();
        (1 + before, "it is not UTF-8 text; save it as UTF-8".into())
    })?;
    Ok(text.trim_start_matches('\u{feff}'))
}

/// Reads a file of JSON. A message about a damaged file has `fault`, the parser's words and `remedy`; `path`
/// is for messages.
///
/// # Errors
/// The line of a comment or of bytes that are no text, and a file that is no JSON or of another form.
pub fn json<T: DeserializeOwned>(
    bytes: &[u8],
    path: &Path,
    fault: &str,
    remedy: &str,
) -> Result<T, ReadError> {
    let at_line = |(line, reason): (usize, String)| ReadError::broken(path, format!("line {line}"), reason);
    let whole = text(bytes).map_err(at_line)?;
    // Only a file that is refused is looked at again.
    let read = match serde_json::from_str(whole) {
        Ok(read) => return Ok(read),
        Err(e) => numbers_as_text(whole).map_err(at_line)?.map_or(Err(e), |text| serde_json::from_str(&text)),
    };
    read.map_err(|e| ReadError::broken(path, "JSON", format!("it is {fault} ({e}); {remedy}")))
}

/// A text of JSON with `"NaN"` in place of numbers that are not finite; `None` if there are none.
///
/// # Errors
/// The line of a comment.
fn numbers_as_text(json: &str) -> Result<Option<String>, (usize, String)> {
    let (mut out, mut rest, mut found) = (String::with_capacity(json.len()), json, false);
    while let Some(first) = rest.chars().next() {
        let length = match first {
            '"' => {
                let mut escaped = false;
                let end = rest[1..].find(|c| {
                    let ends = c == '"' && !escaped;
                    escaped = c == '\\' && !escaped;
                    ends
                });
                end.map_or(rest.len(), |end| end + 2)
            }
            '/' | '#' => {
                let line = 1 + json[..json.len() - rest.len()].matches('\n').count();
                return Err((line, "it has a comment, and JSON has none; remove the comment".into()));
            }
            '-' | '+' | 'N' | 'n' | 'I' | 'i' => {
                let end = rest.find([',', ']', '}', ' ', '\t', '\r', '\n']).unwrap_or(rest.len());
                let word = rest[..end].trim_start_matches(['-', '+']).to_ascii_lowercase();
                if ["nan", "inf"].iter().any(|number| word.starts_with(number)) {
                    (rest, found) = (&rest[end..], true);
                    out.push_str("\"NaN\"");
                    continue;
                }
                end
            }
            other => other.len_utf8(),
        };
        out.push_str(&rest[..length]);
        rest = &rest[length..];
    }
    Ok(found.then_some(out))
}

/// A sentence on the fields of a file that are none of these `known` words; `None` if all are. `file` is its
/// name or kind.
pub fn unread<'a>(file: &str, fields: impl IntoIterator<Item = &'a str>, known: &str) -> Option<String> {
    const MOST: usize = 12;
    let known: BTreeSet<&str> = known.split_ascii_whitespace().collect();
    let names: BTreeSet<&str> = fields.into_iter().filter(|name| !known.contains(name)).collect();
    let mut names: Vec<&str> = names.into_iter().collect();
    let more = if names.len() > MOST { format!(" and {} more", names.len() - MOST) } else { String::new() };
    names.truncate(MOST);
    (!names.is_empty()).then(|| format!("fields of {file} that are not used: {}{more}", names.join(", ")))
}

#[cfg(test)]
mod tests {
    use serde_json::Value;

    use super::*;

    fn read(bytes: &[u8]) -> Result<Value, String> {
        json(bytes, Path::new("a.json"), "damaged", "copy it").map_err(|e| e.to_string())
    }

    #[test]
    fn marks_are_skipped_and_numbers_that_are_none_are_texts() {
        assert_eq!(read(b"\xef\xbb\xbf[1]").unwrap(), serde_json::json!([1]));
        let odd = br#"{"a NaN \" // #": [NaN, -Infinity, nan(ind), 1e-3, null, "\\"], "b": -nan}"#;
        let expected =
            serde_json::json!({"a NaN \" // #": ["NaN", "NaN", "NaN", 1e-3, null, "\\"], "b": "NaN"});
        assert_eq!(read(odd).unwrap(), expected);
        for (bytes, said) in [
            (&b"\xff\xfe[\0"[..], "a.json: line 1: it is UTF-16 text"),
            (b"[1,\n\xff]", "a.json: line 2: it is not UTF-8 text"),
            (b"[1,\n// two\n2]", "a.json: line 2: it has a comment"),
            (b"# one\n[]", "a.json: line 1: it has a comment"),
            (b"[1, NaN", "a.json: JSON: it is damaged (EOF"),
            (b"[1, \"", "a.json: JSON: it is damaged (EOF"),
            (b"", "a.json: JSON: it is damaged (EOF"),
        ] {
            let error = read(bytes).unwrap_err();
            assert!(error.starts_with(said), "{error} does not begin with {said}");
        }
    }

    #[test]
    fn mutated_files_never_panic() {
        let seed = br#"{"a": [NaN, -Infinity, 1e-3, null, "\\"], "b": "//", "c": 7}"#;
        let mut state = 7u64;
        for _ in 0..20_000 {
            let mut bytes = seed.to_vec();
            for _ in 0..3 {
                state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                let at = (state >> 33) as usize % bytes.len();
                bytes[at] = (state >> 20) as u8;
            }
            let _ = read(&bytes);
        }
    }

    #[test]
    fn fields_are_named_once() {
        assert_eq!(unread("a.json", ["c"], "c d"), None);
        let said = unread("a.json", ["b", "c", "a", "b"], "c d").unwrap();
        assert_eq!(said, "fields of a.json that are not used: a, b");
    }
}
