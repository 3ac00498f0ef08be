//! Writes the display matrix into a finished MP4 or QuickTime file.
//!
//! ffmpeg has three ways for this, by its version, and none for a matrix that mirrors. The file itself is
//! simple: a box is `size, name, content`; `moov` has a `trak` for each stream, and in it `mdia/hdlr` names
//! the kind and `tkhd` has the matrix, nine big-endian numbers after 40 bytes of content (52 in version 1).

use std::fs::OpenOptions;
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::Path;

use super::turn::DisplayMatrix;

/// The largest `moov` that is read, bytes. It has about 20 bytes for each frame.
const MOST: u64 = 1 << 30;

/// A box in a slice: its name, and the range of its content.
type Found = ([u8; 4], std::ops::Range<usize>);

fn invalid(reason: &str) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, format!("the film has no usable index: {reason}"))
}

/// The head of a box with up to 16 bytes: its name, and the bytes of head and content.
fn head(bytes: &[u8]) -> Option<([u8; 4], u64, u64)> {
    let name = bytes.get(4..8)?.try_into().ok()?;
    let short = u64::from(u32::from_be_bytes(bytes.get(..4)?.try_into().ok()?));
    let (head, whole) = match short {
        1 => (16, u64::from_be_bytes(bytes.get(8..16)?.try_into().ok()?)),
        whole => (8, whole),
    };
    Some((name, head, whole.checked_sub(head)?))
}

/// The boxes in a range of bytes, up to the first one that is not whole.
fn boxes(bytes: &[u8], range: std::ops::Range<usize>) -> Vec<Found> {
    let (mut at, mut found) = (range.start, Vec::new());
    while let Some((name, head, content)) = bytes.get(at..range.end).and_then(head) {
        let begin = at + head as usize;
        let Some(end) = usize::try_from(content).ok().and_then(|c| begin.checked_add(c)) else { break };
        if end > range.end {
            break;
        }
        found.push((name, begin..end));
        at = end;
    }
    found
}

fn inner(bytes: &[u8], range: std::ops::Range<usize>, name: &[u8; 4]) -> Option<std::ops::Range<usize>> {
    boxes(bytes, range).into_iter().find(|(found, _)| found == name).map(|(_, range)| range)
}

/// The place of the first film's matrix in the content of `moov`.
fn matrix_at(moov: &[u8]) -> Option<usize> {
    let tracks = boxes(moov, 0..moov.len()).into_iter().filter(|(name, _)| name == b"trak");
    let mut films = tracks.filter(|(_, track)| {
        let media = inner(moov, track.clone(), b"mdia");
        let handler = media.and_then(|media| inner(moov, media, b"hdlr"));
        handler.and_then(|h| moov.get(h.start + 8..h.start + 12)) == Some(b"vide")
    });
    let head = inner(moov, films.next()?.1, b"tkhd")?;
    let at = head.start + if moov.get(head.start) == Some(&1) { 52 } else { 40 };
    (at + 36 <= head.end).then_some(at)
}

/// Writes a display matrix into the film of a file.
///
/// # Errors
/// The file cannot be read or written, or it has no film.
pub(super) fn write_matrix(path: &Path, matrix: &DisplayMatrix) -> io::Result<()> {
    let mut file = OpenOptions::new().read(true).write(true).open(path)?;
    let length = file.metadata()?.len();
    let mut at = 0u64;
    while at < length {
        file.seek(SeekFrom::Start(at))?;
        let mut first = Vec::new();
        (&mut file).take(16).read_to_end(&mut first)?;
        let (name, head, content) = head(&first).ok_or_else(|| invalid("a box is cut off"))?;
        if &name == b"moov" {
            if content > MOST || at + head + content > length {
                return Err(invalid("its size is wrong"));
            }
            let mut moov = vec![0; content as usize];
            file.seek(SeekFrom::Start(at + head))?;
            file.read_exact(&mut moov)?;
            let place = matrix_at(&moov).ok_or_else(|| invalid("there is no film in it"))?;
            let bytes: Vec<u8> = matrix.0.iter().flat_map(|n| n.to_be_bytes()).collect();
            file.seek(SeekFrom::Start(at + head + place as u64))?;
            return file.write_all(&bytes);
        }
        at = at.saturating_add(head).saturating_add(content);
    }
    Err(invalid("it is missing"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn made(name: &[u8; 4], content: &[u8]) -> Vec<u8> {
        [&(content.len() as u32 + 8).to_be_bytes()[..], name, content].concat()
    }

    fn track(kind: &[u8; 4], version: u8) -> Vec<u8> {
        let mut head = vec![0; if version == 1 { 96 } else { 84 }];
        head[0] = version;
        let handler = [&[0; 8][..], kind, &[0; 13]].concat();
        made(b"trak", &[made(b"tkhd", &head), made(b"mdia", &made(b"hdlr", &handler))].concat())
    }

    #[test]
    fn the_matrix_of_the_film_is_written_and_nothing_else() {
        let matrix = DisplayMatrix([0, 65536, 0, -65536, 0, 0, 0, 0, 1 << 30]);
        let expected: Vec<u8> = matrix.0.iter().flat_map(|n| n.to_be_bytes()).collect();
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.mp4");
        for version in [0, 1] {
            let large = [&1u32.to_be_bytes()[..], b"mdat", &21u64.to_be_bytes(), &[9; 5]].concat();
            let moov =
                made(b"moov", &[made(b"mvhd", &[3; 9]), track(b"soun", 0), track(b"vide", version)].concat());
            let before = [made(b"ftyp", b"isom"), large, moov].concat();
            std::fs::write(&path, &before).unwrap();
            write_matrix(&path, &matrix).unwrap();
            let after = std::fs::read(&path).unwrap();
            let changed: Vec<usize> = (0..before.len()).filter(|&i| before[i] != after[i]).collect();
            let at = before.len() - (8 + 8 + 25) - 44;
            assert_eq!(after[at..at + 36], expected, "{version}");
            assert!(changed.iter().all(|i| (at..at + 36).contains(i)), "{changed:?}");
        }
        for bad in [b"".to_vec(), b"x".to_vec(), made(b"moov", b""), made(b"moov", &track(b"soun", 0))] {
            std::fs::write(&path, bad).unwrap();
            assert!(write_matrix(&path, &matrix).unwrap_err().to_string().contains("no usable index"));
        }
    }
}
