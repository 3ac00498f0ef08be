//! The code that the stages of this program are made of, as it was when the program was built.

use std::sync::OnceLock;

use use3d_build::code::{CodeRules, CodeTable};

/// Files of this crate count one by one; the pipeline file's reader writes no byte of an artifact, and which
/// engine computes one is told by its numeric class.
pub const RULES: CodeRules = CodeRules {
    by_file: "pipeline",
    not_followed: &["src/config/", "src/engines/"],
    absent: if cfg!(feature = "nets") { &[] } else { &["use3d-nets"] },
};

/// The table of the tree that this program was built from.
pub fn built_in() -> &'static CodeTable {
    static TABLE: OnceLock<CodeTable> = OnceLock::new();
    TABLE.get_or_init(|| {
        let text = include_str!(concat!(env!("OUT_DIR"), "/code.json"));
        CodeTable::stored(text, RULES).expect("the build script wrote this table")
    })
}
