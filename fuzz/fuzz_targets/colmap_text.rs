//! COLMAP's text files. The first byte chooses the kind of file. A file that was read must be the same after
//! it is written and read again.
#![no_main]

use std::path::Path;

use libfuzzer_sys::fuzz_target;
use use3d_io_colmap::text;

fuzz_target!(|data: &[u8]| {
    let Some((&which, bytes)) = data.split_first() else { return };
    let path = Path::new("fuzzed.txt");
    let mut again = Vec::new();
    // Compares debug texts, because a NaN is not equal to itself.
    match which % 3 {
        0 => {
            let Ok(cameras) = text::cameras(bytes, path) else { return };
            text::write_cameras(&mut again, &cameras).expect("memory takes it");
            let read = text::cameras(&again, path).expect("what was written is read");
            assert_eq!(format!("{read:?}"), format!("{cameras:?}"));
        }
        1 => {
            let Ok(images) = text::images(bytes, path) else { return };
            // A name that begins or ends with a space cannot be written in a line.
            let Ok(()) = text::write_images(&mut again, &images) else { return };
            let read = text::images(&again, path).expect("what was written is read");
            assert_eq!(format!("{read:?}"), format!("{images:?}"));
        }
        _ => {
            let Ok(points) = text::points(bytes, path) else { return };
            text::write_points(&mut again, &points).expect("memory takes it");
            let read = text::points(&again, path).expect("what was written is read");
            assert_eq!(format!("{read:?}"), format!("{points:?}"));
        }
    }
});
