//! A `transforms.json`; what is read must survive being written and read again.
#![no_main]

use std::path::Path;

use libfuzzer_sys::fuzz_target;
use use3d_io_nerfstudio::{export, parse};

fuzz_target!(|data: &[u8]| {
    let path = Path::new("fuzzed.json");
    let Ok(read) = parse(data, path) else { return };
    read.survey.check(path, "").expect("what was read is usable");
    let Ok(written) = export(&read.survey, "") else { return };
    let again = parse(written.transforms.as_bytes(), path).expect("what was written is read");
    assert_eq!(again.survey.cameras.len(), read.survey.cameras.len());
    assert_eq!(again.survey.files, read.survey.files);
});
