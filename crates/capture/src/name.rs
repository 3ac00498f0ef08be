//! External names that become paths, and external text that is shown to users.
//!
//! A model, a manifest or a list of cameras may come from an untrusted source. Whatever image names it
//! contains, no file may be read or written outside the folder that the user named. A [`FileName`] can only
//! be created by a check, so a function that takes one needs no check of its own. Printed text goes through
//! [`shown`], so that a name cannot move the cursor, change colours or forge a line.

use std::borrow::Cow;
use std::cmp::Ordering;
use std::fmt;
use std::ops::Deref;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

/// Largest number of bytes of a folder's or file's name. File systems allow 255, and a result may get a
/// longer extension.
const MOST_BYTES: usize = 250;
/// Largest number of bytes of a name with its folders. Systems allow 4096 for a path, which also contains the
/// folder above.
const MOST_BYTES_IN_ALL: usize = 1000;

/// A file's name relative to some folder, with `/` between folders: never absolute, never leading out of that
/// folder.
///
/// It has one to 250 bytes in each component and at most 1000 in total; no empty component, no `..`, no drive
/// letter, and no character that [`shown`] would have to escape, so it may be printed unchanged.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String")]
pub struct FileName(String);

/// The reason why a text is not accepted as a file name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the name {name:?} {reason}")]
pub struct NameError {
    /// The text, shortened if it is long.
    pub name: String,
    /// The problem, and the expected form.
    pub reason: String,
}

impl FileName {
    /// Checks an external name. `\` counts as `/`, as in models from Windows; `.` components are dropped.
    ///
    /// # Errors
    /// Fails if the name is empty, too long, absolute, leads out of its folder, or has a character that no
    /// terminal can show.
    pub fn new(name: &str) -> Result<Self, NameError> {
        let refuse = |reason: &str| {
            let mut shortened: String = name.chars().take(80).collect();
            if shortened.len() < name.len() {
                shortened.push('…');
            }
            Err(NameError { name: shortened, reason: reason.to_string() })
        };
        if name.chars().any(commands) {
            return refuse("holds a control character; rename the file");
        }
        let slashed = name.replace('\\', "/");
        let drive = slashed.as_bytes().get(1) == Some(&b':') && slashed.as_bytes()[0].is_ascii_alphabetic();
        if slashed.starts_with('/') || drive {
            return refuse("is an absolute path; expected one relative to its folder");
        }
        let parts: Vec<&str> = slashed.split('/').filter(|part| *part != ".").collect();
        if parts.contains(&"..") {
            return refuse("leaves the folder (`..`)");
        }
        if parts.is_empty() || parts.contains(&"") {
            return refuse("is not a file name (a part of it is empty)");
        }
        let longest = parts.iter().map(|part| part.len()).max().unwrap_or(0);
        if longest > MOST_BYTES {
            return refuse(&format!(
                "has a part of {longest} bytes; at most {MOST_BYTES} are taken: shorten it"
            ));
        }
        let name = parts.join("/");
        if name.len() > MOST_BYTES_IN_ALL {
            let found = name.len();
            return refuse(&format!("has {found} bytes; at most {MOST_BYTES_IN_ALL} are taken: shorten it"));
        }
        Ok(Self(name))
    }

    /// The name of item `index` of a list without names: `0007`.
    pub fn numbered(index: usize) -> Self {
        Self(format!("{index:04}"))
    }

    /// The name of frame `index` of a film: `frame_00007`.
    pub fn frame(index: usize) -> Self {
        Self(format!("frame_{index:05}"))
    }

    /// The name as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// [`stem`] of the name.
    pub fn stem(&self) -> &str {
        stem(&self.0)
    }

    /// [`flat_stem`] of the name.
    pub fn flat_stem(&self) -> String {
        flat_stem(&self.0)
    }

    /// Returns the name if it is valid for an image: results are also named after
    /// [`flat_stem`](Self::flat_stem), which must not be longer than a file name may be.
    ///
    /// # Errors
    /// Fails if folders and name together are too long.
    pub fn of_image(self) -> Result<Self, NameError> {
        Self::new(&self.flat_stem()).map(|_| self)
    }

    /// The same name with another extension in place of its own.
    ///
    /// # Errors
    /// Fails if the extension makes the name invalid: too long, or with a character that is not allowed.
    pub fn with_extension(&self, extension: &str) -> Result<Self, NameError> {
        Self::new(&format!("{}.{extension}", self.stem()))
    }

    /// The path of a file of this name below `folder`.
    pub fn below(&self, folder: &Path) -> PathBuf {
        folder.join(&self.0)
    }
}

impl Deref for FileName {
    type Target = str;

    fn deref(&self) -> &str {
        &self.0
    }
}

/// A name joined to a folder stays below it.
impl AsRef<Path> for FileName {
    fn as_ref(&self) -> &Path {
        Path::new(&self.0)
    }
}

impl fmt::Display for FileName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(&self.0)
    }
}

impl TryFrom<String> for FileName {
    type Error = NameError;

    fn try_from(name: String) -> Result<Self, NameError> {
        Self::new(&name)
    }
}

impl From<FileName> for String {
    fn from(name: FileName) -> Self {
        name.0
    }
}

impl<T: AsRef<str> + ?Sized> PartialEq<T> for FileName {
    fn eq(&self, other: &T) -> bool {
        self.0 == other.as_ref()
    }
}

/// An image's name without its extension, with its folders: `left/a.b.png` is `left/a.b`.
pub fn stem(name: &str) -> &str {
    match name.rfind('.') {
        Some(dot) if dot > name.rfind('/').map_or(0, |s| s + 1) => &name[..dot],
        _ => name,
    }
}

/// The stem as one file name, for results in one folder: `left/a.b.png` is `left_a.b`. In a prepared capture
/// it is unique among the views.
pub fn flat_stem(name: &str) -> String {
    stem(name).replace('/', "_")
}

/// The photograph, with or without its extension, that a file masks by its name: `a_mask.png` and
/// `a.mask.png` mask `a`, and `a.jpg.mask.png` masks `a.jpg`.
pub fn masked(name: &str) -> Option<&str> {
    let stem = stem(name);
    let (photograph, mark) = stem.split_at_checked(stem.len().checked_sub(5)?)?;
    let marked = ["_mask", ".mask"].iter().any(|known| mark.eq_ignore_ascii_case(known));
    (marked && !photograph.is_empty() && !photograph.ends_with('/')).then_some(photograph)
}

/// Compares two names as people order them: digits count as numbers, so `2.png` comes before `10.png`. Names
/// whose numbers have equally many digits are in the order of their bytes.
pub fn natural_order(a: &str, b: &str) -> Ordering {
    let digits = |rest: &[u8]| rest.iter().take_while(|byte| byte.is_ascii_digit()).count();
    let (mut left, mut right) = (a.as_bytes(), b.as_bytes());
    loop {
        let (m, n) = (digits(left), digits(right));
        let (next, order) = if m > 0 && n > 0 {
            // Without its zeros, a number with more digits is larger.
            let zeros = |number: &[u8]| number.iter().take_while(|byte| **byte == b'0').count();
            let (x, y) = (&left[zeros(&left[..m])..m], &right[zeros(&right[..n])..n]);
            ((m, n), x.len().cmp(&y.len()).then_with(|| x.cmp(y)))
        } else {
            ((1, 1), left.first().cmp(&right.first()))
        };
        if order.is_ne() || left.is_empty() {
            return order.then_with(|| a.cmp(b));
        }
        (left, right) = (&left[next.0..], &right[next.1..]);
    }
}

/// External text made safe for printing within a line: characters that control a terminal or reorder text are
/// escaped (`\u{1b}`), everything else is unchanged.
pub fn shown(text: &str) -> Cow<'_, str> {
    escaped(text, commands)
}

/// Like [`shown`], for text of several lines: line ends and tabs are kept.
pub fn shown_lines(text: &str) -> Cow<'_, str> {
    escaped(text, |c| c != '\n' && c != '\t' && commands(c))
}

fn escaped(text: &str, bad: impl Fn(char) -> bool) -> Cow<'_, str> {
    if !text.chars().any(&bad) {
        return Cow::Borrowed(text);
    }
    let mut out = String::with_capacity(text.len() + 16);
    text.chars().for_each(|c| if bad(c) { out.extend(c.escape_unicode()) } else { out.push(c) });
    Cow::Owned(out)
}

/// True for control characters, line and paragraph separators, and characters that change the direction of
/// the following text.
fn commands(c: char) -> bool {
    c.is_control() || matches!(c, '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_never_leads_out_of_its_folder() {
        let (long, deep) = ("x".repeat(251), vec!["deep"; 201].join("/"));
        for bad in [
            "",
            ".",
            "./",
            "/",
            "/etc/passwd",
            "..",
            "../a",
            "a/../../b",
            "a/..",
            "\\a",
            "..\\a",
            "C:\\a",
            "c:a",
            "a//b",
            "a/",
            "a\0b",
            "a\nb",
            "\u{1b}[31ma",
            "a\u{9b}b",
            "a\u{202e}b",
            &long,
            &deep,
        ] {
            let error = FileName::new(bad).expect_err(bad);
            assert!(!error.to_string().chars().any(char::is_control), "{error}");
            assert!(serde_from(bad).is_err(), "{bad:?}");
        }
        for (good, kept) in [
            ("a.png", "a.png"),
            ("./left\\a b.png", "left/a b.png"),
            ("...", "..."),
            ("a..b", "a..b"),
            ("größe/é.jpg", "größe/é.jpg"),
            (&long[1..], &long[1..]),
        ] {
            assert_eq!(FileName::new(good).expect(good), kept);
            assert_eq!(
                FileName::new(good).expect(good).below(Path::new("/out")),
                Path::new("/out").join(kept)
            );
        }
    }

    /// Parses a name as in a manifest.
    fn serde_from(name: &str) -> Result<FileName, serde::de::value::Error> {
        use serde::de::IntoDeserializer;
        FileName::deserialize(name.to_string().into_deserializer())
    }

    #[test]
    fn an_images_results_fit_into_one_folder() {
        let nested =
            |n: usize| FileName::new(&format!("{}/{}.png", "f".repeat(n), "x".repeat(49))).expect("a name");
        assert!(nested(200).of_image().is_ok());
        assert!(nested(201).of_image().is_err());
    }

    #[test]
    fn another_extension_is_checked_too() {
        let name = FileName::new("left/a.b.jpg").expect("a name");
        assert_eq!(name.with_extension("png").expect("a name"), "left/a.b.png");
        assert!(name.with_extension("/../../x").is_err());
        assert!(name.with_extension("\u{7}").is_err());
        assert_eq!((name.stem(), name.flat_stem().as_str()), ("left/a.b", "left_a.b"));
        assert_eq!(stem(".hidden"), ".hidden");
        assert_eq!(stem("x.d/plain"), "x.d/plain");
    }

    #[test]
    fn digits_are_numbers_and_padded_names_keep_their_order() {
        let mut names = ["10.png", "b2", "1.png", "b10/1", "2.png", "02.png", "b2/20", "b2/3", "b"];
        names.sort_by(|a, b| natural_order(a, b));
        assert_eq!(names, ["1.png", "02.png", "2.png", "10.png", "b", "b2", "b2/3", "b2/20", "b10/1"]);
        let padded = ["IMG_0001.JPG", "IMG_0002.JPG", "IMG_0010.JPG", "IMG_0010_a.JPG", "a-01", "a01"];
        assert!(padded.is_sorted_by(|a, b| natural_order(a, b).is_lt() && a < b));
    }

    #[test]
    fn what_is_shown_cannot_command_a_terminal() {
        assert_eq!(shown("größe 1.png"), "größe 1.png");
        assert_eq!(shown("a\u{1b}[2K\rerror: b\n\u{202e}"), "a\\u{1b}[2K\\u{d}error: b\\u{a}\\u{202e}");
        assert_eq!(shown_lines("a\nb\u{7}"), "a\nb\\u{7}");
    }
}
