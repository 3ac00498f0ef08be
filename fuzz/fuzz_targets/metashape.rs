//! A cameras file of Metashape, and the points beside it. Bytes before the first line `ply` are the XML.
#![no_main]

use std::path::Path;

use libfuzzer_sys::fuzz_target;
use use3d_io_metashape::{add_points, parse};

fuzz_target!(|data: &[u8]| {
    let at = data.windows(4).position(|w| w == b"ply\n").unwrap_or(data.len());
    let (xml, ply) = data.split_at(at);
    let _ = use3d_survey::ply::points(ply, Path::new("fuzzed.ply"));
    let Ok(mut survey) = parse(xml, Path::new("fuzzed.xml")) else { return };
    survey.check(Path::new("fuzzed.xml"), "").expect("what was read is usable");
    let _ = add_points(&mut survey, ply, Path::new("fuzzed.ply"));
});
