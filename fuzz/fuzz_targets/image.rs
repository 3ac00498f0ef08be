//! Image files of every format: header, then samples. For large images only the header is read, so that the
//! fuzzer stays fast.
#![no_main]

use std::path::Path;

use libfuzzer_sys::fuzz_target;
use use3d_io_image::{decode, info_of_bytes};

fuzz_target!(|data: &[u8]| {
    let path = Path::new("fuzzed");
    let Ok(info) = info_of_bytes(data, path) else { return };
    if info.width * info.height > 1 << 18 {
        return;
    }
    if let Ok(decoded) = decode(data, path) {
        assert_eq!((decoded.width, decoded.height), (info.width, info.height));
        decoded.to_pixels();
        decoded.to_map();
        decoded.alpha();
    }
});
