//! Cameras of RealityScan: an XMP file if the bytes begin with `<`, else a table.
#![no_main]

use std::collections::BTreeMap;
use std::path::Path;

use libfuzzer_sys::fuzz_target;
use use3d_capture::FileName;
use use3d_io_realityscan::{Sidecar, parse_sidecars, parse_table};

fuzz_target!(|data: &[u8]| {
    let path = Path::new("fuzzed");
    let found = if data.starts_with(b"<") {
        let name = FileName::new("fuzzed").expect("a name");
        parse_sidecars(&[Sidecar { name, path: path.into(), bytes: data.to_vec() }], path)
    } else {
        parse_table(data, path)
    };
    let Ok(found) = found else { return };
    let sizes: BTreeMap<_, _> = found.shots.iter().map(|shot| (shot.name.clone(), (64, 48))).collect();
    if let Ok(survey) = found.into_survey(&sizes, path) {
        survey.check(path, "").expect("what was read is usable");
    }
});
