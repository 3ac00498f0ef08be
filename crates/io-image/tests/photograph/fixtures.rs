//! Small photographs with all kinds of metadata, made in memory.

use std::io::Cursor;

use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, ImageFormat};

pub(crate) const SOFTWARE: &str = "3D-USE 0.1.0";
pub(crate) const HISTORY: &str = "water removed, strength 1";

/// A smooth 8-bit picture, RGB.
pub(crate) fn pixels(width: usize, height: usize) -> Vec<u8> {
    (0..width * height)
        .flat_map(|i| {
            let (x, y) = (i % width, i / width);
            [(x * 255 / width) as u8, (y * 255 / height) as u8, ((x + y) * 3 % 200) as u8]
        })
        .collect()
}

/// Numbers in one order of bytes.
#[derive(Clone, Copy)]
pub(crate) struct Order(pub(crate) bool);

impl Order {
    pub(crate) fn short(self, v: u16) -> Vec<u8> {
        if self.0 { v.to_be_bytes() } else { v.to_le_bytes() }.to_vec()
    }

    pub(crate) fn long(self, v: u32) -> Vec<u8> {
        if self.0 { v.to_be_bytes() } else { v.to_le_bytes() }.to_vec()
    }
}

/// A tag: number, kind, count and the bytes of its values.
pub(crate) type Tag = (u16, u16, u32, Vec<u8>);

pub(crate) fn text(tag: u16, text: &str) -> Tag {
    (tag, 2, text.len() as u32 + 1, [text.as_bytes(), b"\0"].concat())
}

/// The bytes of a directory at a place, with its values behind it.
pub(crate) fn directory(order: Order, at: u32, tags: &[Tag], next: u32) -> Vec<u8> {
    let mut body = order.short(tags.len() as u16);
    let (mut place, mut values) = (at + 2 + 12 * tags.len() as u32 + 4, Vec::new());
    for (tag, kind, count, value) in tags {
        body.extend([order.short(*tag), order.short(*kind), order.long(*count)].concat());
        if value.len() <= 4 {
            let mut value = value.clone();
            value.resize(4, 0);
            body.extend(value);
        } else {
            body.extend(order.long(place));
            let mut value = value.clone();
            value.resize(value.len().next_multiple_of(2), 0);
            place += value.len() as u32;
            values.extend(value);
        }
    }
    body.extend(order.long(next));
    body.extend(values);
    body
}

/// The bytes that stand for a camera's maker notes.
pub(crate) const MAKER_NOTE: &[u8] = b"MAKERNOTES: places count from the start";
/// The bytes that stand for a thumbnail.
pub(crate) const THUMBNAIL: &[u8] = b"\xFF\xD8 old colours \xFF\xD9";

/// EXIF data of a camera: orientation 6, firmware, date, maker notes, a place, and a thumbnail.
pub(crate) fn exif(big: bool) -> Vec<u8> {
    let order = Order(big);
    let ratio = |all: &[(u32, u32)]| -> Vec<u8> {
        all.iter().flat_map(|(a, b)| [order.long(*a), order.long(*b)].concat()).collect()
    };
    let (exif_at, gps_at, second_at) = (200u32, 400u32, 600u32);
    let mut block = [if big { b"MM\0*" } else { b"II*\0" }.to_vec(), order.long(8)].concat();
    let mut put = |at: u32, bytes: Vec<u8>| {
        assert!(block.len() <= at as usize);
        block.resize(at as usize, 0);
        block.extend(bytes);
    };
    let first = [
        text(0x010F, "Reefcam"),
        text(0x0110, "R1"),
        (0x0112, 3, 1, order.short(6)),
        text(0x0131, "HD9.01.01.70.00"),
        text(0x0132, "2026:05:01 10:11:12"),
        text(0x013B, "A. Diver"),
        text(0x8298, "CC-BY A. Diver"),
        (0x8769, 4, 1, order.long(exif_at)),
        (0x8825, 4, 1, order.long(gps_at)),
    ];
    put(8, directory(order, 8, &first, second_at));
    let inner = [
        (0x829A, 5, 1, ratio(&[(1, 125)])),
        text(0x9003, "2026:05:01 10:11:12"),
        (0x920A, 5, 1, ratio(&[(24, 1)])),
        (0x927C, 7, MAKER_NOTE.len() as u32, MAKER_NOTE.to_vec()),
    ];
    put(exif_at, directory(order, exif_at, &inner, 0));
    let gps = [
        text(1, "S"),
        (2, 5, 3, ratio(&[(12, 1), (6, 1), (305, 10)])),
        text(3, "E"),
        (4, 5, 3, ratio(&[(68, 1), (54, 1), (0, 1)])),
        (5, 1, 1, vec![1]),
        (6, 5, 1, ratio(&[(125, 10)])),
    ];
    put(gps_at, directory(order, gps_at, &gps, 0));
    let thumbnail_at = 700;
    let second = [
        (0x0103, 3, 1, order.short(6)),
        (0x0201, 4, 1, order.long(thumbnail_at)),
        (0x0202, 4, 1, order.long(THUMBNAIL.len() as u32)),
    ];
    put(second_at, directory(order, second_at, &second, 0));
    put(thumbnail_at, THUMBNAIL.to_vec());
    block
}

/// An ICC profile for a colour space of four letters, with the header that readers check.
pub(crate) fn profile(space: &[u8; 4], length: usize) -> Vec<u8> {
    let mut icc = vec![0u8; 132];
    icc.extend((0..length.saturating_sub(132)).map(|i| (i % 251) as u8));
    let size = icc.len() as u32;
    icc[..4].copy_from_slice(&size.to_be_bytes());
    icc[8] = 2;
    icc[12..16].copy_from_slice(b"mntr");
    icc[16..20].copy_from_slice(space);
    icc[20..24].copy_from_slice(b"XYZ ");
    icc[36..40].copy_from_slice(b"acsp");
    icc
}

pub(crate) const XMP: &[u8] = b"<x:xmpmeta xmlns:x='adobe:ns:meta/'>\
<rdf:RDF xmlns:rdf='http://www.w3.org/1999/02/22-rdf-syntax-ns#'>\
<rdf:Description xmlns:dc='http://purl.org/dc/elements/1.1/' dc:source='transect 7'/>\
</rdf:RDF></x:xmpmeta>";

/// Photoshop's resource block with an IPTC record: the keyword `coral`.
pub(crate) fn iptc() -> Vec<u8> {
    let record = [&[0x1C, 2, 25, 0, 5][..], b"coral"].concat();
    let length = (record.len() as u32).to_be_bytes();
    [&b"Photoshop 3.0\08BIM\x04\x04\0\0"[..], &length, &record].concat()
}

pub(crate) fn segment(marker: u8, body: &[u8]) -> Vec<u8> {
    [&[0xFF, marker][..], &(body.len() as u16 + 2).to_be_bytes(), body].concat()
}

/// Puts segments between the start of a JPEG and its tables, in place of the encoder's `JFIF` segment.
pub(crate) fn jpeg_with(encoded: &[u8], segments: &[(u8, Vec<u8>)]) -> Vec<u8> {
    let all: Vec<u8> = segments.iter().flat_map(|(m, b)| segment(*m, b)).collect();
    [b"\xFF\xD8", &all[..], &encoded[20..]].concat()
}

pub(crate) fn jpeg_pixels(width: usize, height: usize, color: ExtendedColorType) -> Vec<u8> {
    let mut bytes = Vec::new();
    let all = pixels(width, height);
    let grey: Vec<u8> = all.chunks_exact(3).map(|p| p[0]).collect();
    let data = if color == ExtendedColorType::L8 { &grey } else { &all };
    JpegEncoder::new_with_quality(&mut bytes, 92).encode(data, width as u32, height as u32, color).unwrap();
    bytes
}

pub(crate) fn profile_segments(icc: &[u8]) -> Vec<(u8, Vec<u8>)> {
    let parts: Vec<&[u8]> = icc.chunks(60_000).collect();
    let count = parts.len() as u8;
    let part =
        |(i, part): (usize, &&[u8])| (0xE2, [b"ICC_PROFILE\0", &[i as u8 + 1, count][..], part].concat());
    parts.iter().enumerate().map(part).collect()
}

/// The segments of a photograph with everything that is to be kept.
pub(crate) fn kept_segments(big: bool) -> Vec<(u8, Vec<u8>)> {
    let mut all = vec![
        (0xE0, b"JFIF\0\x01\x02\x01\0\x48\0\x48\0\0".to_vec()),
        (0xE1, [b"Exif\0\0", &exif(big)[..]].concat()),
        (0xE1, [b"http://ns.adobe.com/xap/1.0/\0", XMP].concat()),
    ];
    all.extend(profile_segments(&profile(b"RGB ", 100_000)));
    all.push((0xED, iptc()));
    all.push((0xE6, b"GoPro\0maker's own".to_vec()));
    all.push((0xFE, b"a diver's comment".to_vec()));
    all
}

/// A JPEG of 48x32 pixels with all kinds of metadata.
pub(crate) fn jpeg(big: bool) -> Vec<u8> {
    jpeg_with(&jpeg_pixels(48, 32, ExtendedColorType::Rgb8), &kept_segments(big))
}

/// The segments of a JPEG before its scan.
pub(crate) fn segments(bytes: &[u8]) -> Vec<(u8, Vec<u8>)> {
    let (mut all, mut at) = (Vec::new(), 2);
    while bytes[at + 1] != 0xDA {
        let end = at + 2 + usize::from(u16::from_be_bytes([bytes[at + 2], bytes[at + 3]]));
        all.push((bytes[at + 1], bytes[at + 4..end].to_vec()));
        at = end;
    }
    all
}

fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0u32, |crc, &b| {
        (0..8).fold(crc ^ u32::from(b), |c, _| (c >> 1) ^ (0xEDB8_8320 & (c & 1).wrapping_neg()))
    })
}

pub(crate) fn chunk(name: &[u8; 4], body: &[u8]) -> Vec<u8> {
    let named = [&name[..], body].concat();
    [&(body.len() as u32).to_be_bytes()[..], &named, &crc32(&named).to_be_bytes()].concat()
}

/// The zlib form of some bytes, stored without compression.
pub(crate) fn stored(bytes: &[u8]) -> Vec<u8> {
    let length = bytes.len() as u16;
    let (a, b) = bytes.iter().fold((1u32, 0u32), |(a, b), v| {
        let a = (a + u32::from(*v)) % 65521;
        (a, (b + a) % 65521)
    });
    let head = [&[0x78, 1, 1][..], &length.to_le_bytes(), &(!length).to_le_bytes()].concat();
    [&head, bytes, &(b << 16 | a).to_be_bytes()].concat()
}

/// A PNG with chunks behind its header and before its end.
pub(crate) fn png_with(picture: &image::DynamicImage, before: &[Vec<u8>], after: &[Vec<u8>]) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    picture.write_to(&mut bytes, ImageFormat::Png).unwrap();
    let bytes = bytes.into_inner();
    let end = bytes.len() - 12;
    [&bytes[..33], &before.concat(), &bytes[33..end], &after.concat(), &bytes[end..]].concat()
}

/// Chunks that are kept before the pixels.
pub(crate) fn kept_chunks() -> Vec<Vec<u8>> {
    vec![
        chunk(b"gAMA", &45455u32.to_be_bytes()),
        chunk(b"cHRM", &[0, 0, 0x7A, 0x26, 0, 0, 0x80, 0x84].repeat(4)),
        chunk(b"iCCP", &[b"reef\0\0", &stored(&profile(b"RGB ", 500))[..]].concat()),
        chunk(b"pHYs", &[0, 0, 0x0B, 0x13, 0, 0, 0x0B, 0x13, 1]),
        chunk(b"eXIf", &exif(true)),
        chunk(b"tEXt", b"Comment\0a diver's comment"),
        chunk(b"tEXt", b"Software\0Darkroom 2"),
        chunk(b"iTXt", &[b"XML:com.adobe.xmp\0\0\0\0\0", XMP].concat()),
    ]
}

/// Name and contents of all chunks of a PNG.
pub(crate) fn chunks(bytes: &[u8]) -> Vec<(String, Vec<u8>)> {
    let (mut all, mut at) = (Vec::new(), 8);
    while at < bytes.len() {
        let length = u32::from_be_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
        let name = String::from_utf8(bytes[at + 4..at + 8].to_vec()).unwrap();
        all.push((name, bytes[at + 8..at + 8 + length].to_vec()));
        at += 12 + length;
    }
    all
}

/// A TIFF of uncompressed rows: its order of bytes, size, bits, sample format, samples per pixel and
/// photometric number, further tags, and the values of the maker notes and the place in its EXIF and GPS
/// directories.
pub(crate) fn tiff(
    big: bool,
    (width, height): (u32, u32),
    (bits, format, samples, photometric): (u16, u16, usize, u16),
    data: &[u8],
    further: &[Tag],
) -> Vec<u8> {
    let order = Order(big);
    let mut file = [if big { b"MM\0*" } else { b"II*\0" }.to_vec(), order.long(0)].concat();
    let mut put = |bytes: &[u8]| {
        file.resize(file.len().next_multiple_of(2), 0);
        file.extend(bytes);
        (file.len() - bytes.len()) as u32
    };
    let pixels = put(data);
    let at = pixels + (data.len() as u32).next_multiple_of(2);
    let inner = [
        (0x829A, 5, 1, [order.long(1), order.long(125)].concat()),
        text(0x9003, "2026:05:01 10:11:12"),
        (0x927C, 7, MAKER_NOTE.len() as u32, MAKER_NOTE.to_vec()),
    ];
    let exif = put(&directory(order, at, &inner, 0));
    let bytes = directory(order, exif, &inner, 0).len() as u32;
    let at = (exif + bytes).next_multiple_of(2);
    let places = [
        text(1, "S"),
        (2, 5, 3, [(12, 1), (6, 1), (30, 1)].map(|(a, b)| [order.long(a), order.long(b)].concat()).concat()),
    ];
    let gps = put(&directory(order, at, &places, 0));
    let many = |v: u16| (0..samples).flat_map(|_| order.short(v)).collect::<Vec<u8>>();
    let short = |tag: u16, v: u16| (tag, 3, 1, order.short(v));
    let mut tags = vec![
        (256, 4, 1, order.long(width)),
        (257, 4, 1, order.long(height)),
        (258, 3, samples as u32, many(bits)),
        short(259, 1),
        short(262, photometric),
        text(271, "Reefcam"),
        (273, 4, 1, order.long(pixels)),
        short(274, 8),
        short(277, samples as u16),
        (278, 4, 1, order.long(height)),
        (279, 4, 1, order.long(data.len() as u32)),
        text(305, "Darkroom 2"),
        (339, 3, samples as u32, many(format)),
        (700, 1, XMP.len() as u32, XMP.to_vec()),
        (
            33550,
            12,
            3,
            [0.5f64, 0.25, 0.0].map(|v| if big { v.to_be_bytes() } else { v.to_le_bytes() }).concat(),
        ),
        (34665, 4, 1, order.long(exif)),
        (34853, 4, 1, order.long(gps)),
    ];
    if samples == 4 && photometric == 2 {
        tags.push(short(338, 1));
    }
    tags.retain(|t| !further.iter().any(|f| f.0 == t.0));
    tags.extend(further.iter().cloned());
    tags.sort_by_key(|t| t.0);
    let at = file.len().next_multiple_of(2);
    file.resize(at, 0);
    file.extend(directory(order, at as u32, &tags, 0));
    file[4..8].copy_from_slice(&order.long(at as u32));
    file
}
