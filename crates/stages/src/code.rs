//! The code that the stages of this program are made of, as it was when the program was built.

use std::sync::OnceLock;

use use3d_workflow::code::{CodeRules, CodeTable};

/// The files of this crate count one by one. The choice of an engine does not count, because a key already
/// holds the numeric class of its engine. The build system writes no byte of an artifact either.
pub const RULES: CodeRules = CodeRules {
    by_file: "stages",
    not_followed: &["src/engines/"],
    crates_not_followed: &["use3d-workflow"],
};

/// The table of the tree that this program was built from.
pub fn built_in() -> &'static CodeTable {
    static TABLE: OnceLock<CodeTable> = OnceLock::new();
    TABLE.get_or_init(|| {
        let text = include_str!(concat!(env!("OUT_DIR"), "/code.json"));
        CodeTable::stored(text, RULES).expect("the build script wrote this table")
    })
}
