//! Code digests on a copy of this workspace: comments change nothing, and tokens change only the stages that
//! contain them.

use std::fs;
use std::path::Path;

use use3d_workflow::code::{CodeError, CodeRules, CodeTable};
use use3d_workflow::{BuildError, Digest, Registry};

use super::stages::{code as workspace, stages};

const RULES: CodeRules = CodeRules {
    by_file: "pipeline",
    not_followed: &["src/config/"],
    crates_not_followed: &["use3d-workflow"],
};

/// The digest of the code of a stage that depends on some crates.
fn code_digest_of(root: &Path, crates: &[&str]) -> Result<Digest, CodeError> {
    Ok(CodeTable::of_tree(root, RULES)?.stage(crates, &[])?.digest())
}

#[test]
fn a_token_in_ubaf_makes_the_second_training_stale_and_leaves_the_first_alone() {
    let here = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let dir = tempfile::tempdir().expect("folder");
    for file in ["Cargo.toml", "Cargo.lock"] {
        fs::copy(here.join(file), dir.path().join(file)).expect("copied");
    }
    for name in fs::read_dir(here.join("crates")).expect("crates").map(|e| e.expect("entry").file_name()) {
        let from = here.join("crates").join(&name);
        let to = dir.path().join("crates").join(&name);
        for part in ["src", "Cargo.toml", "build.rs", "templates"] {
            for entry in
                walkdir::WalkDir::new(from.join(part)).follow_links(true).into_iter().filter_map(Result::ok)
            {
                if entry.file_type().is_file() {
                    let target = to.join(entry.path().strip_prefix(&from).expect("below"));
                    fs::create_dir_all(target.parent().expect("a folder")).expect("folder");
                    fs::copy(entry.path(), target).expect("copied");
                }
            }
        }
    }
    let of = |crates: &[&str]| code_digest_of(dir.path(), crates).expect("digest");
    let (first, second) = (of(&["use3d-splat", "use3d-medium"]), of(&["use3d-ubaf"]));
    let lib = dir.path().join("crates/ubaf/src/lib.rs");
    let text = fs::read_to_string(&lib).expect("text");
    fs::write(&lib, format!("{text}\n// A remark.\n/* Another. */\n")).expect("file");
    assert_eq!(of(&["use3d-ubaf"]), second, "a comment changes nothing");
    fs::write(&lib, format!("{text}\nconst _SURFACE: f32 = 0.5;\n")).expect("file");
    assert_ne!(of(&["use3d-ubaf"]), second);
    assert_eq!(of(&["use3d-splat", "use3d-medium"]), first);

    let before = CodeTable::of_tree(dir.path(), RULES).expect("table");
    fs::write(&lib, text).expect("file");
    let after = CodeTable::of_tree(dir.path(), RULES).expect("table");
    let registry = |table: &CodeTable| Registry::new(stages(0), table).expect("table");
    let data = tempfile::tempdir().expect("folder");
    let batch = super::stages::batch(&data.path().join("data"), &["reef"]);
    let mut builder = super::stages::builder(&data.path().join("cache"));
    builder.registry = registry(&before);
    super::stages::run(&builder, &batch);
    builder.registry = registry(&after);
    let graph = use3d_workflow::Graph::new(&builder.registry, &batch).expect("graph");
    let plan = builder.plan(&graph, None);
    let stale: Vec<&str> = plan
        .nodes
        .iter()
        .filter(|n| n.state != use3d_workflow::plan::State::Cached)
        .map(|n| n.stage)
        .collect();
    assert_eq!(stale, ["enhance", "evaluate", "report"]);
    assert!(plan.to_string().contains("reef · enhance: the program is another version"), "{plan}");
    let why = plan.nodes.iter().flat_map(|n| &n.changes).any(|change| change.ingredient == "code use3d-ubaf");
    assert!(why, "{plan}");
    // The bytes come out the same, so no stage below it runs.
    assert_eq!(super::stages::run(&builder, &batch).1, ["reef · enhance"]);
}

#[test]
fn a_stage_that_names_absent_code_is_refused() {
    let mut list = stages(0);
    let last = list.pop().expect("a stage").made_of(&["use3d-ubaff"], &[]);
    list.push(last);
    assert!(matches!(Registry::new(list, workspace()), Err(BuildError::Code { .. })));
    let mut list = stages(0);
    let last = list.pop().expect("a stage").made_of(&[], &["src/stages/absent.rs"]);
    list.push(last);
    assert!(Registry::new(list, workspace()).is_err());
    let mut list = stages(0);
    list.reverse();
    assert!(matches!(Registry::new(list, workspace()), Err(BuildError::Registry(_))), "inputs come first");
}
