//! A PNG of a few thousand pixels with a colour profile that unpacks to 400 MB. It is the only test of its
//! process, because it reads the peak memory of the process.

use std::path::Path;

use use3d_io_image::{decode, image_info, info_of_bytes, read_image};

/// Zeros with the best DEFLATE compression: a literal, then `repeats` × "258 bytes again".
fn zeros(repeats: usize) -> Vec<u8> {
    let mut out = vec![0x78, 0x9c];
    let (mut held, mut count) = (0u64, 0u32);
    let mut put = |bits: u64, length: u32| {
        held |= bits << count;
        count += length;
        while count >= 8 {
            out.push(held as u8);
            held >>= 8;
            count -= 8;
        }
    };
    put(0b011, 3); // last block, fixed codes
    put(0b0000_1100, 8); // literal 0: code 00110000, first bit first
    for _ in 0..repeats {
        put(0b1010_0011, 8); // length 258: code 11000101
        put(0, 5); // distance 1
    }
    put(0, 7); // end of block
    put(0, 7); // the last byte
    let length = (258 * repeats + 1) as u64;
    out.extend((((length % 65521) << 16 | 1) as u32).to_be_bytes());
    out
}

fn checksum(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(u32::MAX, |crc, &b| {
        (0..8).fold(crc ^ u32::from(b), |c, _| if c & 1 == 1 { c >> 1 ^ 0xEDB8_8320 } else { c >> 1 })
    })
}

fn chunk(name: &[u8; 4], body: &[u8]) -> Vec<u8> {
    let named = [&name[..], body].concat();
    [&(body.len() as u32).to_be_bytes()[..], &named, &checksum(&named).to_be_bytes()].concat()
}

/// The peak memory of this process, bytes; `None` if the system does not report it.
fn peak() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|l| l.starts_with("VmHWM:"))?;
    line.split_whitespace().nth(1)?.parse::<u64>().ok().map(|kib| 1024 * kib)
}

#[test]
fn a_colour_profile_is_never_unpacked() {
    let mut plain = std::io::Cursor::new(Vec::new());
    let picture = image::RgbaImage::from_fn(48, 32, |x, y| image::Rgba([x as u8, y as u8, 7, 200]));
    picture.write_to(&mut plain, image::ImageFormat::Png).unwrap();
    let plain = plain.into_inner();
    let (start, rest) = plain.split_at(8 + 25); // signature and header chunk
    let profile = chunk(b"iCCP", &[b"bomb\0\0", &zeros(1_600_000)[..]].concat());
    assert!(profile.len() < 3_000_000);
    let bomb = [start, &profile, rest].concat();
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("bomb.png");
    std::fs::write(&path, &bomb).unwrap();
    // The bits above are valid: any reader of profiles would unpack all of them.
    let before = peak();
    let info = image_info(&path).unwrap();
    assert_eq!((info.width, info.height, info.alpha), (48, 32, true));
    let expected = decode(&plain, Path::new("plain.png")).unwrap();
    assert_eq!(decode(&bomb, &path).unwrap(), expected);
    assert_eq!(read_image(&path).unwrap().width(), 48);
    assert_eq!(info_of_bytes(&bomb, &path).unwrap(), info);
    if let (Some(before), Some(after)) = (before, peak()) {
        assert!(after - before < 100 << 20, "{} MiB were taken", (after - before) >> 20);
    }
}
