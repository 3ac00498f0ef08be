//! The lines of the preset `paper`, with the source that each has in its comment.

use std::collections::BTreeMap;

/// All lines, by `stage.parameter`. A line is `NAME = VALUE # BY: PLACE`, or `# NAME # pipeline: REASON` if
/// the preset leaves the value open. A source is `paper`, `authors`, `ours` or `pipeline`, and the place
/// there or the reason.
pub(crate) fn lines() -> BTreeMap<String, (String, String)> {
    let (mut all, mut section) = (BTreeMap::new(), String::new());
    for text in include_str!("../../src/presets/paper.toml").lines() {
        if let Some(name) = text.strip_prefix('[') {
            section = name.trim_end_matches(']').to_string();
        } else if let Some((value, source)) = text.rsplit_once(" # ").filter(|_| !section.is_empty()) {
            let name = value.trim_start_matches("# ").split(" = ").next().unwrap_or_default();
            let (by, place) = source.split_once(": ").unwrap_or((source, ""));
            all.insert(format!("{section}.{name}"), (by.to_string(), place.to_string()));
        }
    }
    all
}
