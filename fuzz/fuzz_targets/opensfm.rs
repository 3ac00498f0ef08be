//! A reconstruction of OpenSfM, and its tracks. Bytes from the first line with a tab on are the tracks.
#![no_main]

use std::path::Path;

use libfuzzer_sys::fuzz_target;
use use3d_io_opensfm::{add_tracks, parse};

fuzz_target!(|data: &[u8]| {
    let at = data.iter().position(|b| *b == b'\t').unwrap_or(data.len());
    let (json, tracks) = data.split_at(at);
    let Ok(mut survey) = parse(json, Path::new("fuzzed.json")) else { return };
    survey.check(Path::new("fuzzed.json"), "").expect("what was read is usable");
    let _ = add_tracks(&mut survey, tracks, Path::new("fuzzed.csv"));
});
