//! Gaussians as PLY files, in the layout that 3D Gaussian Splatting tools share.
//!
//! The file has one `vertex` element per Gaussian with `x y z`, `f_dc_0..2` (band 0), `f_rest_*` (bands 1
//! and up, channel-major: all of red, then green, then blue; 0, 9, 24 or 45 of them for degree 0 to 3),
//! `opacity` (logit), `scale_0..2` (log), `rot_0..3` (`w x y z`). Normals and other properties, list
//! properties, and elements before `vertex` may be present, in any order and of any type; they are ignored.
//! Binary files of either byte order and ascii files are read; binary little-endian is written.
//!
//! A file is read as a stream, and memory grows only with the data that has arrived. So a header that
//! declares 2⁶⁰ Gaussians costs nothing. Values that are not finite are returned unchanged;
//! [`Gaussians::validate`](crate::Gaussians::validate) finds them.

use std::io::{self, BufRead, BufReader, BufWriter, Read, Write};

use crate::Gaussians;

/// Longest header line, bytes.
const LINE: usize = 4096;
/// Largest number of header lines.
const LINES: usize = 4096;
/// Longest number in an ascii file, bytes.
const TOKEN: usize = 256;
/// Number of rows for which memory is reserved before any row has arrived.
const ROWS: usize = 1 << 14;

/// A reason why a PLY file could not be read.
#[derive(Debug, thiserror::Error)]
pub enum PlyError {
    /// The file could not be read, or ends early.
    #[error("cannot read: {0}")]
    Io(#[from] io::Error),
    /// Not a PLY file.
    #[error("not a PLY file: it does not start with the line `ply`")]
    Magic,
    /// A header line that cannot be understood.
    #[error("line {line} of the header, `{text}`: {problem}")]
    Header {
        /// Line number, from 1.
        line: usize,
        /// The line.
        text: String,
        /// The error in the line.
        problem: &'static str,
    },
    /// The header does not end.
    #[error("the header is too long ({LINES} lines of {LINE} bytes at most) or has no `end_header`")]
    Endless,
    /// No vertices.
    #[error("the file has no `vertex` element")]
    NoVertices,
    /// A property that Gaussians need is missing.
    #[error(
        "the vertices have no property `{0}`; expected the layout of 3D Gaussian Splatting: x y z f_dc_0..2 opacity scale_0..2 rot_0..3"
    )]
    Missing(String),
    /// A number of `f_rest_*` properties that belongs to no degree.
    #[error(
        "the vertices have {0} properties f_rest_*; expected 0, 9, 24 or 45 (spherical-harmonics degree 0 to 3)"
    )]
    Rest(usize),
    /// The file ends inside the vertices or before them.
    #[error("the file is cut off: it ends at {element} {index} of {count}; copy it or make it again")]
    Truncated {
        /// The element.
        element: String,
        /// Its index.
        index: u64,
        /// The count in the header.
        count: u64,
    },
    /// A text in an ascii file that is not a number.
    #[error("{element} {index}: `{text}` is not a number")]
    Number {
        /// The element.
        element: String,
        /// Its index.
        index: u64,
        /// The text.
        text: String,
    },
}

/// A type of numbers.
#[derive(Clone, Copy, Debug)]
struct Scalar {
    /// Number of bytes.
    size: usize,
    /// The value of the first `size` bytes, little-endian or big-endian.
    decode: fn([u8; 8], bool) -> f64,
}

impl Scalar {
    fn parse(name: &str) -> Option<Self> {
        macro_rules! of {
            ($ty:ty) => {{
                const SIZE: usize = size_of::<$ty>();
                let decode = |b: [u8; 8], big: bool| {
                    let mut bytes = [0; SIZE];
                    bytes.copy_from_slice(&b[..SIZE]);
                    if big { <$ty>::from_be_bytes(bytes) as f64 } else { <$ty>::from_le_bytes(bytes) as f64 }
                };
                Self { size: SIZE, decode }
            }};
        }
        Some(match name {
            "char" | "int8" => of!(i8),
            "uchar" | "uint8" => of!(u8),
            "short" | "int16" => of!(i16),
            "ushort" | "uint16" => of!(u16),
            "int" | "int32" => of!(i32),
            "uint" | "uint32" => of!(u32),
            "float" | "float32" => of!(f32),
            "double" | "float64" => of!(f64),
            _ => return None,
        })
    }
}

#[derive(Clone, Copy, Debug)]
enum Kind {
    One(Scalar),
    List { count: Scalar, item: Scalar },
}

#[derive(Debug)]
struct PlyElement {
    name: String,
    count: u64,
    properties: Vec<(String, Kind)>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum PlyEncoding {
    Ascii,
    Binary { big: bool },
}

/// Reads one header line without its end; `None` if it is too long or the file ends.
fn header_line(reader: &mut impl BufRead) -> io::Result<Option<String>> {
    let mut bytes = Vec::new();
    reader.by_ref().take(LINE as u64).read_until(b'\n', &mut bytes)?;
    if bytes.pop() != Some(b'\n') {
        return Ok(None);
    }
    Ok(Some(String::from_utf8_lossy(&bytes).trim_end().to_string()))
}

fn header(reader: &mut impl BufRead) -> Result<(PlyEncoding, Vec<PlyElement>), PlyError> {
    if header_line(reader)?.as_deref() != Some("ply") {
        return Err(PlyError::Magic);
    }
    let mut format = None;
    let mut elements: Vec<PlyElement> = Vec::new();
    for line in 2..LINES {
        let Some(text) = header_line(reader)? else { return Err(PlyError::Endless) };
        let error = |problem| PlyError::Header { line, text: text.chars().take(120).collect(), problem };
        let words: Vec<&str> = text.split_whitespace().collect();
        match words.as_slice() {
            [] | ["comment" | "obj_info", ..] => {}
            ["format", kind, _version] => {
                format = Some(match *kind {
                    "ascii" => PlyEncoding::Ascii,
                    "binary_little_endian" => PlyEncoding::Binary { big: false },
                    "binary_big_endian" => PlyEncoding::Binary { big: true },
                    _ => return Err(error("expected ascii, binary_little_endian or binary_big_endian")),
                });
            }
            ["element", name, count] => {
                let count = count.parse().map_err(|_| error("the count is not a whole number"))?;
                elements.push(PlyElement { name: (*name).to_string(), count, properties: Vec::new() });
            }
            ["property", rest @ ..] => {
                let Some(element) = elements.last_mut() else {
                    return Err(error("a property before any element"));
                };
                let scalar = |name: &str| Scalar::parse(name).ok_or_else(|| error("unknown type"));
                let property = match *rest {
                    ["list", count, item, name] => {
                        (name.to_string(), Kind::List { count: scalar(count)?, item: scalar(item)? })
                    }
                    [kind, name] => (name.to_string(), Kind::One(scalar(kind)?)),
                    _ => {
                        return Err(error("expected `property TYPE NAME` or `property list TYPE TYPE NAME`"));
                    }
                };
                element.properties.push(property);
            }
            ["end_header"] => {
                return Ok((format.ok_or_else(|| error("no format line before it"))?, elements));
            }
            _ => return Err(error("unknown keyword")),
        }
    }
    Err(PlyError::Endless)
}

/// The body, one number after another.
struct Numbers<R> {
    reader: R,
    format: PlyEncoding,
}

impl<R: BufRead> Numbers<R> {
    /// Reads the next number of the given type. `Ok(Err(text))` holds text that is not a number.
    fn next(&mut self, scalar: Scalar) -> io::Result<Result<f64, String>> {
        match self.format {
            PlyEncoding::Binary { big } => {
                let mut bytes = [0; 8];
                self.reader.read_exact(&mut bytes[..scalar.size])?;
                Ok(Ok((scalar.decode)(bytes, big)))
            }
            PlyEncoding::Ascii => {
                let token = self.token()?;
                Ok(token.parse().map_err(|_| token))
            }
        }
    }

    fn token(&mut self) -> io::Result<String> {
        let mut token = Vec::new();
        let mut byte = [0];
        while token.len() < TOKEN {
            match self.reader.read(&mut byte)? {
                0 if token.is_empty() => return Err(io::ErrorKind::UnexpectedEof.into()),
                0 => break,
                _ if !byte[0].is_ascii_whitespace() => token.push(byte[0]),
                _ if token.is_empty() => {}
                _ => break,
            }
        }
        // A longer token is no number; its rest must not be read as the next one.
        if token.len() == TOKEN && self.reader.read(&mut byte)? == 1 && !byte[0].is_ascii_whitespace() {
            token.extend("…".bytes());
        }
        Ok(String::from_utf8_lossy(&token).into_owned())
    }

    /// Reads one element; `keep(property index, value)` receives its scalar properties.
    fn element(
        &mut self,
        element: &PlyElement,
        index: u64,
        mut keep: impl FnMut(usize, f64),
    ) -> Result<(), PlyError> {
        let error = |e: io::Error| match e.kind() {
            io::ErrorKind::UnexpectedEof => {
                PlyError::Truncated { element: element.name.clone(), index, count: element.count }
            }
            _ => PlyError::Io(e),
        };
        let number = |text| PlyError::Number { element: element.name.clone(), index, text };
        for (i, (_, kind)) in element.properties.iter().enumerate() {
            match *kind {
                Kind::One(scalar) => keep(i, self.next(scalar).map_err(error)?.map_err(number)?),
                Kind::List { count, item } => {
                    let items = self.next(count).map_err(error)?.map_err(number)?;
                    // A negative or NaN count is an empty list; a count that is too large fails at the end
                    // of the file.
                    for _ in 0..items as u64 {
                        self.next(item).map_err(error)?.map_err(number)?;
                    }
                }
            }
        }
        Ok(())
    }
}

/// Reads Gaussians from a PLY file.
pub fn read(reader: impl Read) -> Result<Gaussians, PlyError> {
    let mut reader = BufReader::with_capacity(1 << 18, reader);
    let (format, elements) = header(&mut reader)?;
    let mut numbers = Numbers { reader, format };
    for element in &elements {
        if element.name == "vertex" {
            return vertices(&mut numbers, element);
        }
        // An element without properties takes no bytes, so its count does not matter.
        if !element.properties.is_empty() {
            for index in 0..element.count {
                numbers.element(element, index, |_, _| {})?;
            }
        }
    }
    Err(PlyError::NoVertices)
}

fn vertices(numbers: &mut Numbers<impl BufRead>, element: &PlyElement) -> Result<Gaussians, PlyError> {
    let rest = element.properties.iter().filter(|(name, _)| name.starts_with("f_rest_")).count();
    let sh_degree = match rest {
        0 => 0,
        9 => 1,
        24 => 2,
        45 => 3,
        _ => return Err(PlyError::Rest(rest)),
    };
    // The slots of a row: 0..3 position, 3 opacity, 4..7 scale, 7..11 rotation, 11..59 colour [band][rgb].
    let mut slots = vec![None; element.properties.len()];
    let mut place = |name: String, slot: usize| {
        let found = element.properties.iter().position(|(n, k)| *n == name && matches!(k, Kind::One(_)));
        slots[found.ok_or(PlyError::Missing(name))?] = Some(slot);
        Ok::<_, PlyError>(())
    };
    for (slot, name) in ["x", "y", "z", "opacity"].into_iter().enumerate() {
        place(name.to_string(), slot)?;
    }
    for i in 0..3 {
        place(format!("scale_{i}"), 4 + i)?;
        place(format!("f_dc_{i}"), 11 + i)?;
    }
    for i in 0..4 {
        place(format!("rot_{i}"), 7 + i)?;
    }
    for i in 0..rest {
        let (channel, band) = (i / (rest / 3), 1 + i % (rest / 3));
        place(format!("f_rest_{i}"), 11 + 3 * band + channel)?;
    }
    let mut out = Gaussians::empty(sh_degree);
    let room = element.count.min(ROWS as u64) as usize;
    out.means.reserve(room);
    out.log_scales.reserve(room);
    out.quaternions.reserve(room);
    out.opacity_logits.reserve(room);
    out.sh.reserve(room);
    for index in 0..element.count {
        let mut row = [0.0f32; 59];
        numbers.element(element, index, |i, value| {
            if let Some(slot) = slots[i] {
                row[slot] = value as f32;
            }
        })?;
        out.means.push([row[0], row[1], row[2]]);
        out.opacity_logits.push(row[3]);
        out.log_scales.push([row[4], row[5], row[6]]);
        out.quaternions.push([row[7], row[8], row[9], row[10]]);
        out.sh.push(std::array::from_fn(|k| std::array::from_fn(|c| row[11 + 3 * k + c])));
    }
    Ok(out)
}

/// Writes Gaussians as binary little-endian PLY with 45 `f_rest_*` and zero
/// normals, as the common viewers expect.
pub fn write(gaussians: &Gaussians, writer: impl Write) -> io::Result<()> {
    write_with_comments(gaussians, &[], writer)
}

/// Like [`write()`], with comment lines in the header; a line break in a comment becomes a space.
pub fn write_with_comments(gaussians: &Gaussians, comments: &[String], writer: impl Write) -> io::Result<()> {
    let mut out = BufWriter::with_capacity(1 << 18, writer);
    let mut names: Vec<String> = ["x", "y", "z", "nx", "ny", "nz"].map(str::to_string).to_vec();
    names.extend((0..3).map(|i| format!("f_dc_{i}")));
    names.extend((0..45).map(|i| format!("f_rest_{i}")));
    names.push("opacity".to_string());
    names.extend((0..3).map(|i| format!("scale_{i}")));
    names.extend((0..4).map(|i| format!("rot_{i}")));
    write!(out, "ply\nformat binary_little_endian 1.0\n")?;
    for comment in comments {
        writeln!(out, "comment {}", comment.replace(['\n', '\r'], " "))?;
    }
    writeln!(out, "element vertex {}", gaussians.len())?;
    for name in &names {
        writeln!(out, "property float {name}")?;
    }
    out.write_all(b"end_header\n")?;
    let mut row = Vec::with_capacity(names.len() * 4);
    for i in 0..gaussians.len() {
        row.clear();
        let sh = &gaussians.sh[i];
        let rest = (0..3).flat_map(|c| (1..16).map(move |k| sh[k][c]));
        let values = gaussians.means[i]
            .into_iter()
            .chain([0.0; 3])
            .chain(sh[0])
            .chain(rest)
            .chain([gaussians.opacity_logits[i]])
            .chain(gaussians.log_scales[i])
            .chain(gaussians.quaternions[i]);
        for value in values {
            row.extend_from_slice(&value.to_le_bytes());
        }
        out.write_all(&row)?;
    }
    out.flush()
}
