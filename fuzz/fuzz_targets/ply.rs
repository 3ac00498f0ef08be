//! Gaussians in PLY files, binary and ASCII.
#![no_main]

use libfuzzer_sys::fuzz_target;
use use3d_splat::ply;

fuzz_target!(|data: &[u8]| {
    let Ok(gaussians) = ply::read(data) else { return };
    let mut again = Vec::new();
    ply::write(&gaussians, &mut again).expect("memory takes it");
    let read = ply::read(again.as_slice()).expect("what was written is read");
    assert_eq!(read.len(), gaussians.len());
});
