//! Reads the vertices of PLY files as a stream.
//!
//! Binary files of either byte order and ascii files are read. Other properties, list properties and elements
//! before `vertex` may be there, in any order and of any type. Memory grows only with the data that has
//! arrived, so a header that declares 2⁶⁰ vertices costs nothing. Values that are not finite are returned as
//! they are.

use std::io::{self, BufRead, BufReader, Read};

/// Longest header line, bytes.
const LINE: usize = 4096;
/// Largest number of header lines.
const LINES: usize = 4096;
/// Longest number in an ascii file, bytes.
const TOKEN: usize = 256;
/// Bytes that are read at once.
const BLOCK: usize = 1 << 18;

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
#[derive(Clone, Copy, Debug, PartialEq)]
enum Scalar {
    Integer { bytes: usize, signed: bool },
    Float { bytes: usize },
}

impl Scalar {
    fn parse(name: &str) -> Option<Self> {
        let integer = |bytes, signed| Some(Self::Integer { bytes, signed });
        match name {
            "char" | "int8" => integer(1, true),
            "uchar" | "uint8" => integer(1, false),
            "short" | "int16" => integer(2, true),
            "ushort" | "uint16" => integer(2, false),
            "int" | "int32" => integer(4, true),
            "uint" | "uint32" => integer(4, false),
            "float" | "float32" => Some(Self::Float { bytes: 4 }),
            "double" | "float64" => Some(Self::Float { bytes: 8 }),
            _ => None,
        }
    }

    fn bytes(self) -> usize {
        match self {
            Self::Integer { bytes, .. } | Self::Float { bytes } => bytes,
        }
    }

    /// The value of its bytes, given with the least significant one first.
    fn decode(self, little: [u8; 8]) -> f64 {
        let raw = u64::from_le_bytes(little);
        match self {
            Self::Float { bytes: 4 } => f64::from(f32::from_bits(raw as u32)),
            Self::Float { .. } => f64::from_bits(raw),
            Self::Integer { bytes, signed } => {
                let unused = 64 - 8 * bytes as u32;
                if signed { (((raw << unused) as i64) >> unused) as f64 } else { raw as f64 }
            }
        }
    }

    /// The value of a full colour in this type.
    fn full(self) -> f64 {
        match self {
            Self::Integer { bytes: 2, .. } => 65535.0,
            Self::Integer { .. } => 255.0,
            Self::Float { .. } => 1.0,
        }
    }
}

#[derive(Clone, Copy, Debug)]
enum Kind {
    One(Scalar),
    List { count: Scalar, item: Scalar },
}

#[derive(Debug)]
struct Element {
    name: String,
    count: u64,
    properties: Vec<(String, Kind)>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Encoding {
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

fn header(reader: &mut impl BufRead) -> Result<(Encoding, Vec<Element>), PlyError> {
    if header_line(reader)?.as_deref() != Some("ply") {
        return Err(PlyError::Magic);
    }
    let mut format = None;
    let mut elements: Vec<Element> = Vec::new();
    for line in 2..LINES {
        let Some(text) = header_line(reader)? else { return Err(PlyError::Endless) };
        let error = |problem| PlyError::Header { line, text: text.chars().take(120).collect(), problem };
        let words: Vec<&str> = text.split_whitespace().collect();
        match words.as_slice() {
            [] | ["comment" | "obj_info", ..] => {}
            ["format", kind, _version] => {
                format = Some(match *kind {
                    "ascii" => Encoding::Ascii,
                    "binary_little_endian" => Encoding::Binary { big: false },
                    "binary_big_endian" => Encoding::Binary { big: true },
                    _ => return Err(error("expected ascii, binary_little_endian or binary_big_endian")),
                });
            }
            ["element", name, count] => {
                let count = count.parse().map_err(|_| error("the count is not a whole number"))?;
                elements.push(Element { name: (*name).to_string(), count, properties: Vec::new() });
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
    format: Encoding,
}

impl<R: BufRead> Numbers<R> {
    /// Reads the next number of the given type. `Ok(Err(text))` holds text that is not a number.
    fn next(&mut self, scalar: Scalar) -> io::Result<Result<f64, String>> {
        match self.format {
            Encoding::Binary { big } => {
                let mut little = [0; 8];
                let bytes = &mut little[..scalar.bytes()];
                self.reader.read_exact(bytes)?;
                if big {
                    bytes.reverse();
                }
                Ok(Ok(scalar.decode(little)))
            }
            Encoding::Ascii => {
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
        element: &Element,
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

/// The vertices of a file, in order.
pub struct Vertices<R> {
    numbers: Numbers<BufReader<R>>,
    element: Element,
    index: u64,
}

impl<R: Read> Vertices<R> {
    /// Reads the header, and the elements before the vertices.
    ///
    /// # Errors
    /// This is no PLY file, the header is wrong, the file ends early, or it has no vertices.
    pub fn open(reader: R) -> Result<Self, PlyError> {
        let mut reader = BufReader::with_capacity(BLOCK, reader);
        let (format, elements) = header(&mut reader)?;
        let mut numbers = Numbers { reader, format };
        for element in elements {
            if element.name == "vertex" {
                return Ok(Self { numbers, element, index: 0 });
            }
            // An element without properties takes no bytes, so its count does not matter.
            if !element.properties.is_empty() {
                for index in 0..element.count {
                    numbers.element(&element, index, |_, _| {})?;
                }
            }
        }
        Err(PlyError::NoVertices)
    }

    /// The number of vertices that the header announces.
    pub fn count(&self) -> u64 {
        self.element.count
    }

    /// The names of the properties, in the file's order.
    pub fn properties(&self) -> impl ExactSizeIterator<Item = &str> {
        self.element.properties.iter().map(|(name, _)| name.as_str())
    }

    /// The index of the first property that has one of these names and one number.
    pub fn place(&self, names: &[&str]) -> Option<usize> {
        let found = self.properties().position(|name| names.contains(&name))?;
        matches!(self.element.properties[found].1, Kind::One(_)).then_some(found)
    }

    /// The value of a full colour in the property at an index: 255, 65535 or 1.
    pub fn full(&self, index: usize) -> f64 {
        match self.element.properties.get(index) {
            Some((_, Kind::One(scalar))) => scalar.full(),
            _ => 1.0,
        }
    }

    /// Reads the next vertex; `keep(property index, value)` receives its scalar properties.
    ///
    /// # Errors
    /// The file ends here, or a word is no number.
    pub fn next(&mut self, keep: impl FnMut(usize, f64)) -> Result<(), PlyError> {
        self.numbers.element(&self.element, self.index, keep)?;
        self.index += 1;
        Ok(())
    }
}
