//! Points of a PLY file, as photogrammetry programs export them: `x y z`, and colours where they are there.
//!
//! Binary of either byte order and ascii are read. Other properties, list properties and other elements may
//! be there and are left out. Colours are `red green blue` or `r g b`, 8-bit or 16-bit integers, or floats in
//! `[0, 1]`; without them a point is grey. Every count is checked against the bytes that are left before
//! memory is set aside.

use std::path::Path;

use crate::read::ReadError;
use crate::survey::SurveyPoint;

/// The longest header, bytes.
const HEADER: usize = 1 << 16;
/// The most points of a file. A dense cloud is larger and no start for a reconstruction.
const MOST: u64 = 50_000_000;

/// A line of the header or a vertex, and its fault with the value found and the expectation.
type PlyFault = (String, String);

fn fail<T>(place: impl Into<String>, reason: impl Into<String>) -> Result<T, PlyFault> {
    Err((place.into(), reason.into()))
}

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

    /// The value that stands for a full colour.
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

struct Element {
    name: String,
    count: u64,
    properties: Vec<(String, Kind)>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Form {
    Ascii,
    Binary { big: bool },
}

/// The body of a file, one number after another.
struct Body<'a> {
    rest: &'a [u8],
    form: Form,
}

impl Body<'_> {
    /// The next number; `None` where the file ends or the word is no number.
    fn next(&mut self, scalar: Scalar) -> Option<f64> {
        match self.form {
            Form::Binary { big } => {
                let (head, rest) = self.rest.split_at_checked(scalar.bytes())?;
                self.rest = rest;
                let mut little = [0u8; 8];
                little[..head.len()].copy_from_slice(head);
                if big {
                    little[..head.len()].reverse();
                }
                Some(scalar.decode(little))
            }
            Form::Ascii => {
                let begin = self.rest.iter().position(|b| !b.is_ascii_whitespace())?;
                let word = &self.rest[begin..];
                let end = word.iter().position(u8::is_ascii_whitespace).unwrap_or(word.len());
                self.rest = &word[end..];
                std::str::from_utf8(&word[..end]).ok()?.parse().ok()
            }
        }
    }

    /// Reads one element's properties; `keep(property, value)` gets the scalar ones. `None` where the file
    /// ends or a word is no number.
    fn element(&mut self, properties: &[(String, Kind)], mut keep: impl FnMut(usize, f64)) -> Option<()> {
        for (i, (_, kind)) in properties.iter().enumerate() {
            match *kind {
                Kind::One(scalar) => keep(i, self.next(scalar)?),
                Kind::List { count, item } => {
                    // A negative or NaN count is an empty list; one that is too large ends at the file's end.
                    for _ in 0..self.next(count)? as u64 {
                        self.next(item)?;
                    }
                }
            }
        }
        Some(())
    }
}

/// The fewest bytes that one element takes.
fn least(properties: &[(String, Kind)], form: Form) -> usize {
    let of = |kind: &Kind| match (form, kind) {
        (Form::Ascii, _) => 2,
        (_, Kind::One(scalar)) => scalar.bytes(),
        (_, Kind::List { count, .. }) => count.bytes(),
    };
    properties.iter().map(|(_, kind)| of(kind)).sum()
}

fn header(bytes: &[u8]) -> Result<(Form, Vec<Element>, &[u8]), PlyFault> {
    let (mut form, mut elements, mut rest) = (None, Vec::<Element>::new(), bytes);
    for number in 1.. {
        let place = format!("line {number} of the header");
        let used = bytes.len() - rest.len();
        let Some(end) = rest.iter().take(HEADER.saturating_sub(used)).position(|&b| b == b'\n') else {
            return fail(place, "the header has no `end_header`; export the points again as PLY");
        };
        let line = String::from_utf8_lossy(&rest[..end]).trim().to_string();
        rest = &rest[end + 1..];
        let words: Vec<&str> = line.split_whitespace().collect();
        if number == 1 {
            if line != "ply" {
                return fail(place, "this is not a PLY file: the first line is not `ply`");
            }
            continue;
        }
        let scalar = |name: &str| match Scalar::parse(name) {
            Some(scalar) => Ok(scalar),
            None => fail(place.clone(), format!("unknown type `{}`", name.escape_debug())),
        };
        match words.as_slice() {
            [] | ["comment" | "obj_info", ..] => {}
            ["format", "ascii", _] => form = Some(Form::Ascii),
            ["format", "binary_little_endian", _] => form = Some(Form::Binary { big: false }),
            ["format", "binary_big_endian", _] => form = Some(Form::Binary { big: true }),
            ["element", name, count] => {
                let Ok(count) = count.parse() else {
                    return fail(place, "the count is not a whole number");
                };
                elements.push(Element { name: (*name).into(), count, properties: Vec::new() });
            }
            ["property", kind @ .., name] => {
                let kind = match kind {
                    [one] => Kind::One(scalar(one)?),
                    ["list", count, item] => Kind::List { count: scalar(count)?, item: scalar(item)? },
                    _ => return fail(place, "expected `property TYPE NAME`"),
                };
                let Some(element) = elements.last_mut() else {
                    return fail(place, "a property before any element");
                };
                element.properties.push(((*name).into(), kind));
            }
            ["end_header"] => {
                let Some(form) = form else { return fail(place, "no line `format` before it") };
                return Ok((form, elements, rest));
            }
            _ => return fail(place, format!("unknown line `{}`", line.escape_debug())),
        }
    }
    fail("header", "it does not end")
}

/// Reads the points of a PLY file; ids count from 1, tracks are empty, errors unknown. `path` is for
/// messages.
///
/// # Errors
/// A file without points, cut short, or with coordinates that are not finite.
pub fn points(bytes: &[u8], path: &Path) -> Result<Vec<SurveyPoint>, ReadError> {
    find_points(bytes).map_err(|(place, reason)| ReadError::broken(path, place, reason))
}

fn find_points(bytes: &[u8]) -> Result<Vec<SurveyPoint>, PlyFault> {
    let (form, elements, rest) = header(bytes)?;
    let mut body = Body { rest, form };
    for element in &elements {
        let short = |index: u64| {
            let reason = format!(
                "the file ends here, or holds no number; {} were announced: export the points again",
                element.count
            );
            fail(format!("{} {index}", element.name.escape_debug()), reason)
        };
        let most = body.rest.len() / least(&element.properties, form).max(1);
        // An ascii file may end without white space behind its last number.
        if !element.properties.is_empty() && element.count > most as u64 + 1 {
            return short(most as u64);
        }
        if element.name != "vertex" {
            for index in 0..if element.properties.is_empty() { 0 } else { element.count } {
                if body.element(&element.properties, |_, _| ()).is_none() {
                    return short(index);
                }
            }
            continue;
        }
        return vertices(&mut body, element, short);
    }
    fail("header", "the file has no element `vertex`; export the points again as PLY")
}

fn vertices(
    body: &mut Body<'_>,
    element: &Element,
    short: impl Fn(u64) -> Result<Vec<SurveyPoint>, PlyFault>,
) -> Result<Vec<SurveyPoint>, PlyFault> {
    if element.count > MOST {
        let reason = format!(
            "{} points, more than the {MOST} that are read; export the tie points (sparse cloud), not the dense cloud",
            element.count
        );
        return fail("vertex", reason);
    }
    let place = |names: &[&str]| {
        let found = element.properties.iter().position(|(name, _)| names.contains(&name.as_str()))?;
        matches!(element.properties[found].1, Kind::One(_)).then_some(found)
    };
    let [Some(x), Some(y), Some(z)] = [place(&["x"]), place(&["y"]), place(&["z"])] else {
        return fail("vertex", "the points have no x, y and z; export the points again as PLY");
    };
    let colors =
        [["red", "r", "diffuse_red"], ["green", "g", "diffuse_green"], ["blue", "b", "diffuse_blue"]]
            .map(|names| place(&names));
    let full = |i: Option<usize>| match i.map(|i| element.properties[i].1) {
        Some(Kind::One(scalar)) => scalar.full(),
        _ => 1.0,
    };
    let fulls = colors.map(full);
    let mut out = Vec::with_capacity(element.count as usize);
    let mut values = vec![0.0; element.properties.len()];
    for index in 0..element.count {
        if body.element(&element.properties, |i, v| values[i] = v).is_none() {
            return short(index);
        }
        let position = [values[x], values[y], values[z]];
        if !position.iter().all(|v| v.is_finite()) {
            return fail(format!("vertex {index}"), format!("it lies at {position:?}; expected numbers"));
        }
        let color = |c: usize| match colors[c] {
            Some(i) => (values[i] / fulls[c] * 255.0 + 0.5).clamp(0.0, 255.0) as u8,
            None => 128,
        };
        let color = [color(0), color(1), color(2)];
        out.push(SurveyPoint { id: index + 1, position, color, error: -1.0, track: Vec::new() });
    }
    Ok(out)
}

/// An ascii PLY file of points, with 17 significant digits, so that positions read back to the same bits.
pub fn write(points: &[SurveyPoint]) -> String {
    use std::fmt::Write;
    let mut out = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty double x\nproperty double y\nproperty double z\n\
         property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n",
        points.len()
    );
    for point in points {
        let ([x, y, z], [r, g, b]) = (point.position, point.color);
        let _ = writeln!(out, "{x} {y} {z} {r} {g} {b}");
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn points(bytes: &[u8]) -> Result<Vec<SurveyPoint>, ReadError> {
        super::points(bytes, Path::new("points.ply"))
    }

    fn header(form: &str, count: u64, more: &str) -> Vec<u8> {
        format!(
            "ply\nformat {form} 1.0\ncomment by hand\nelement vertex {count}\nproperty float x\nproperty float y\n\
             property double z\nproperty list uchar int seen\nproperty ushort red\nproperty uchar green\n{more}end_header\n"
        )
        .into_bytes()
    }

    #[test]
    fn every_form_gives_the_same_points() {
        let mut ascii = header("ascii", 2, "property float blue\n");
        ascii.extend(b"1.5 -2 3.25 2 7 8 65535 51 0.5\n0 0 1 0 0 255 1");
        let read = points(&ascii).unwrap();
        assert_eq!((read[0].position, read[0].color), ([1.5, -2.0, 3.25], [255, 51, 128]));
        assert_eq!((read[1].id, read[1].color), (2, [0, 255, 255]));
        for big in [false, true] {
            let name = if big { "binary_big_endian" } else { "binary_little_endian" };
            let mut bytes = header(name, 2, "property float blue\n");
            let mut put = |little: &[u8]| {
                let mut value = little.to_vec();
                if big {
                    value.reverse();
                }
                bytes.extend(value);
            };
            for (x, y, z, seen, r, g, b) in [
                (1.5f32, -2.0f32, 3.25f64, &[7i32, 8][..], 65535u16, 51u8, 0.5f32),
                (0.0, 0.0, 1.0, &[], 0, 255, 1.0),
            ] {
                put(&x.to_le_bytes());
                put(&y.to_le_bytes());
                put(&z.to_le_bytes());
                put(&[seen.len() as u8]);
                seen.iter().for_each(|s| put(&s.to_le_bytes()));
                put(&r.to_le_bytes());
                put(&[g]);
                put(&b.to_le_bytes());
            }
            assert_eq!(points(&bytes).unwrap(), read, "{name}");
            assert!(points(&bytes[..bytes.len() - 1]).unwrap_err().to_string().contains("vertex 1"));
        }
        assert_eq!(points(write(&read).as_bytes()).unwrap(), read);
    }

    #[test]
    fn what_is_no_cloud_is_explained() {
        for (bytes, expected) in [
            (&b""[..], "end_header"),
            (b"solid\n", "not a PLY file"),
            (b"ply\nformat ascii 1.0\nend_header\n", "no element `vertex`"),
            (b"ply\nelement vertex 1\nproperty float x\nend_header\n", "no line `format`"),
            (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1", "no x, y and z"),
            (b"ply\nformat ascii 1.0\nproperty float x\n", "before any element"),
            (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty quad x\n", "unknown type"),
            (b"ply\nformat ascii 1.0\nelement vertex many\n", "whole number"),
        ] {
            let said = points(bytes).unwrap_err().to_string();
            assert!(said.contains(expected), "{said} lacks {expected}");
        }
        let huge = header("binary_little_endian", u64::MAX, "");
        assert!(points(&huge).unwrap_err().to_string().contains("announced"));
        let bad = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n1 nan 2\n";
        assert!(points(bad).unwrap_err().to_string().contains("vertex 0"));
    }

    #[test]
    fn mutated_files_never_panic() {
        let mut seed = header("binary_little_endian", 3, "property float blue\n");
        seed.extend([1u8; 99]);
        let mut state = 7u64;
        for _ in 0..20_000 {
            let mut bytes = seed.clone();
            for _ in 0..3 {
                state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                let at = (state >> 33) as usize % bytes.len();
                bytes[at] = (state >> 20) as u8;
            }
            let _ = points(&bytes);
        }
    }
}
