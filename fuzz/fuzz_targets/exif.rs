//! The EXIF data of a JPEG.
#![no_main]

use libfuzzer_sys::fuzz_target;
use use3d_io_image::{exif_of_bytes, straighten};

fuzz_target!(|data: &[u8]| {
    let mut copy = data.to_vec();
    straighten(&mut copy);
    if (2..=8).contains(&exif_of_bytes(data).orientation) {
        assert_eq!(exif_of_bytes(&copy).orientation, 1);
    }
});
