//! Snapshots of the user's texts, word for word: the help of every verb and common error messages.
//! `USE3D_UPDATE_SNAPSHOTS=1` writes the files below `snapshots/` again; the difference is then reviewed like
//! code.

mod steady;

use std::path::Path;
use std::process::Command;

use steady::compare;

/// Exit code, stdout and stderr of a run in `folder`.
fn said(folder: &Path, arguments: &[&str]) -> String {
    let output = Command::new(env!("CARGO_BIN_EXE_use3d"))
        .args(arguments)
        .current_dir(folder)
        .env_clear()
        .output()
        .expect("the command starts");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).replace(&*folder.to_string_lossy(), "DIR");
    let code = output.status.code().map_or_else(|| "killed".into(), |code| code.to_string());
    format!("$ use3d {}\n{}{}[{code}]\n", arguments.join(" "), text(&output.stdout), text(&output.stderr))
}

#[test]
fn the_help_of_every_verb() {
    let folder = tempfile::tempdir().expect("a folder");
    let top = said(folder.path(), &["--help"]);
    // Verbs are indented by two spaces in the groups of verbs; continuation lines are indented further.
    let list = top.split("Start here:\n").nth(1).and_then(|rest| rest.split("\nOptions:").next());
    let list = list.unwrap_or_default();
    let verbs = list.lines().filter(|line| line.starts_with("  ") && !line.starts_with("   "));
    let verbs: Vec<&str> = verbs.filter_map(|line| line.split_whitespace().next()).collect();
    assert!(verbs.contains(&"run") && verbs.contains(&"man") && verbs.len() > 15, "{verbs:?}");
    let each =
        verbs.iter().filter(|verb| **verb != "help").map(|verb| said(folder.path(), &[verb, "--help"]));
    compare("help", &(top.clone() + "\n" + &each.collect::<Vec<_>>().join("\n")));
}

#[test]
fn the_messages_that_a_beginner_meets() {
    let folder = tempfile::tempdir().expect("a folder");
    let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).expect("a file");
    let scene = "[[scene]]\nname = \"reef\"\ncapture = \"reef\"\n";
    write("key.toml", &format!("name = \"x\"\n[defaults.reconstruct]\niteratons = 3\n{scene}"));
    write("value.toml", &format!("name = \"x\"\n[defaults.reconstruct]\nsh_degree = 4\n{scene}"));
    write("preset.toml", &format!("name = \"x\"\npreset = \"vanila\"\n{scene}"));
    write("pairs.toml", &format!("name = \"x\"\n[defaults.pairs]\nextractor.cells = 1\n{scene}"));
    write("place.toml", &format!("name = \"x\"\n{scene}preset = \"paper\"\n"));
    write("empty.toml", "name = \"x\"\n");
    std::fs::create_dir(folder.path().join("photographs")).expect("a folder");
    let runs: [&[&str]; 12] = [
        &["rnu"],
        &["run"],
        &["run", "nowhere.toml"],
        &["run", "key.toml"],
        &["run", "value.toml"],
        &["run", "preset.toml"],
        &["run", "pairs.toml"],
        &["run", "place.toml"],
        &["verify", "--set", "reconstruct.iterations=3"],
        &["run", "empty.toml"],
        &["import", "photographs", "--out", "out"],
        &["render", "photographs", "--cameras", "photographs", "--out", "out"],
    ];
    let text: Vec<String> = runs.iter().map(|arguments| said(folder.path(), arguments)).collect();
    compare("messages", &text.join("\n"));
}
