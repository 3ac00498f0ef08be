//! COLMAP's binary files. The first byte chooses the kind of file. A file that was read must be the same
//! after it is written and read again.
#![no_main]

use std::path::Path;

use libfuzzer_sys::fuzz_target;
use use3d_io_colmap::{Model, binary};

fuzz_target!(|data: &[u8]| {
    let Some((&which, bytes)) = data.split_first() else { return };
    let path = Path::new("fuzzed.bin");
    let mut again = Vec::new();
    match which % 3 {
        0 => {
            let Ok(cameras) = binary::cameras(bytes, path) else { return };
            binary::write_cameras(&mut again, &cameras).expect("memory takes it");
            let model = Model { cameras, ..Model::default() };
            if model.check(path).is_ok() {
                for camera in &model.cameras {
                    let lens = camera.lens().expect("the reader checked the number of parameters");
                    if let Some((u, v)) = lens.unproject(0.5 * camera.width as f64, 0.5 * camera.height as f64) {
                        lens.project(u, v);
                    }
                }
            }
        }
        1 => {
            let Ok(images) = binary::images(bytes, path) else { return };
            binary::write_images(&mut again, &images).expect("memory takes it");
            // A name may come back in another spelling (`a\b` as `a/b`), but does not change after that.
            let read = binary::images(&again, path).expect("what was written is read");
            assert_eq!(format!("{read:?}"), format!("{images:?}"));
            let _ = Model { images, ..Model::default() }.check(path);
            return;
        }
        _ => {
            let Ok(points) = binary::points(bytes, path) else { return };
            binary::write_points(&mut again, &points).expect("memory takes it");
            let _ = Model { points, ..Model::default() }.check(path);
        }
    }
    assert_eq!(again, bytes, "a binary file that is read is written back byte for byte");
});
