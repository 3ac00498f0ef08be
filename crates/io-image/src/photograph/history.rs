//! The two texts that a written photograph gains: the program (`Software`) and one line of history.
//!
//! The history is the EXIF tag `ImageHistory`. ExifTool shows it, cameras do not write it, and comments,
//! captions and titles stay untouched. A line that is there stays, and the new one follows it. The old
//! `Software` is mostly the firmware of the camera, so the line of history repeats it.

/// The EXIF tag with the program that wrote the file.
pub(crate) const SOFTWARE: u16 = 0x0131;
/// The EXIF tag with the history of the picture.
pub(crate) const IMAGE_HISTORY: u16 = 0x9213;

/// A text in one line: control characters become spaces.
pub(crate) fn one_line(text: &str) -> String {
    text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect::<String>().trim().to_string()
}

/// The text of an EXIF value: up to the first zero byte.
fn text_of(value: &[u8]) -> String {
    let end = value.iter().position(|b| *b == 0).unwrap_or(value.len());
    one_line(&String::from_utf8_lossy(&value[..end]))
}

/// The bytes of the two tags, each with its zero byte: [`SOFTWARE`] and [`IMAGE_HISTORY`]. The arguments are
/// the new texts and the values that the file has for the two tags.
pub(crate) fn values(
    software: &str,
    history: &str,
    old_software: Option<&[u8]>,
    old_history: Option<&[u8]>,
) -> [(u16, Vec<u8>); 2] {
    let (software, mut line) = (one_line(software), one_line(history));
    let before = old_software.map(text_of).unwrap_or_default();
    if !before.is_empty() && before != software {
        line = format!("{line} (Software before: {before})");
    }
    let earlier = old_history.map(text_of).unwrap_or_default();
    if !earlier.is_empty() {
        line = format!("{earlier}; {line}");
    }
    let ended = |text: String| [text.as_bytes(), b"\0"].concat();
    [(SOFTWARE, ended(software)), (IMAGE_HISTORY, ended(line))]
}
