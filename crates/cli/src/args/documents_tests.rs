//! Tests that this program accepts every `use3d` command in the README, the documents and the help's
//! examples: verb, flags and the keys of `--set`. A command in a block of code is parsed whole; one within a
//! sentence may leave out required arguments of its verb.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use clap::error::ErrorKind;
use clap::{CommandFactory, Parser};
use use3d_config::parameters;

use super::Cli;

/// A command as written in a document.
#[derive(Debug, PartialEq)]
struct Command {
    /// The page, for messages.
    page: String,
    /// The arguments after `use3d`.
    arguments: Vec<String>,
    /// True if it is in a block of code, and no part of it is left out.
    whole: bool,
}

fn pages() -> Vec<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let mut pages = vec![root.join("README.md"), root.join("CONTRIBUTING.md")];
    for folder in ["docs", "docs/guide", "docs/reference", "docs/science", "packaging/python"] {
        for entry in std::fs::read_dir(root.join(folder)).expect(folder) {
            let path = entry.expect("an entry").path();
            if path.extension().is_some_and(|e| e == "md") {
                pages.push(path);
            }
        }
    }
    pages.sort();
    pages
}

/// The words of a shell command. Four spaces begin a remark, like in the help's examples.
fn words(line: &str) -> Vec<String> {
    let line = line.trim();
    let line = line.split("    ").next().unwrap_or_default();
    let mut words = vec![String::new()];
    let mut quote = None;
    for c in line.chars() {
        let word = words.last_mut().expect("a word");
        match quote {
            Some(mark) if c == mark => quote = None,
            Some(_) => word.push(c),
            None if c == '\'' || c == '"' => quote = Some(c),
            None if c.is_whitespace() => words.push(String::new()),
            None => word.push(c),
        }
    }
    words.retain(|w| !w.is_empty());
    words
}

/// The arguments of each call of the program in a line: after variables, `/usr/bin/time -v` and the like, up
/// to a pipe, a redirection, a remark or the next command.
fn calls(line: &str) -> Vec<Vec<String>> {
    let words: Vec<String> = words(line).into_iter().take_while(|w| !w.starts_with('#')).collect();
    let ends = |w: &String| ["|", "&&", ";", "&"].contains(&w.as_str()) || w.starts_with('>');
    let mut found = Vec::new();
    for command in words.split(ends) {
        let before = |w: &String| w.contains('=') || ["/usr/bin/time", "-v", "$"].contains(&w.as_str());
        let start = command.iter().position(|w| !before(w)).unwrap_or(command.len());
        let command = &command[start..];
        match command.first().map(String::as_str) {
            Some("use3d") => found.push(command[1..].to_vec()),
            Some("cargo")
                if command.get(1).is_some_and(|w| w == "run") && !command.contains(&"-p".into()) =>
            {
                let behind = command.iter().position(|w| w == "--").map_or(&[][..], |at| &command[at + 1..]);
                found.push(behind.to_vec());
            }
            _ => {}
        }
    }
    found
}

/// The commands of a page.
fn commands(page: &str, text: &str) -> Vec<Command> {
    let mut found = Vec::new();
    let mut add = |line: &str, block: bool| {
        for arguments in calls(line) {
            let whole = block && !line.contains('…');
            found.push(Command { page: page.to_string(), arguments, whole });
        }
    };
    let (mut fenced, mut open, mut prose) = (false, String::new(), String::new());
    for line in text.lines() {
        if line.trim_start().starts_with("```") {
            fenced = !fenced;
        } else if fenced {
            open += line.trim().trim_end_matches('\\').trim_end();
            if line.ends_with('\\') {
                open.push(' ');
            } else {
                add(&open, true);
                open.clear();
            }
        } else {
            prose += line;
            prose.push(' ');
        }
    }
    for code in prose.split('`').skip(1).step_by(2) {
        add(code, false);
    }
    found
}

/// Every parameter, as `stage.name`.
fn known() -> BTreeSet<String> {
    let stages = use3d_pipeline::loaded::stages().expect("the stage table");
    let all = parameters(&stages, None, None).expect("all parameters");
    all.iter().flat_map(|s| s.parameters.iter().map(|p| format!("{}.{}", s.stage, p.name))).collect()
}

/// The keys of `--set` that belong to no stage.
fn unknown_keys(arguments: &[String], known: &BTreeSet<String>) -> Vec<String> {
    let sets = arguments.windows(2).filter(|pair| pair[0] == "--set").map(|pair| pair[1].as_str());
    let mut unknown = Vec::new();
    for key in sets.filter_map(|set| set.split_once('=')).map(|(key, _)| key) {
        let mut bare = key;
        for place in ["scene.", "variant."] {
            if let Some((_, rest)) = bare.strip_prefix(place).and_then(|rest| rest.split_once('.')) {
                bare = rest;
            }
        }
        // These belong to the pipeline, not to a stage.
        let pipeline =
            ["method", "preset", "seed", "stage2"].contains(&bare) || bare.starts_with("calibrator.");
        // For a stage run by hand, the stage's name in front of its own parameters can be left out.
        let of_a_stage =
            known.contains(bare) || known.iter().any(|k| k.split_once('.').is_some_and(|k| k.1 == bare));
        if !pipeline && !of_a_stage && !bare.contains('…') {
            unknown.push(key.to_string());
        }
    }
    unknown
}

/// Returns the reason why this program does not accept a command.
fn fault(command: &Command, known: &BTreeSet<String>) -> Option<String> {
    // `use3d VERB --help` stands for any verb, and `slurm|hq` for either.
    let stands_for_any = |w: &String| w == "VERB" || w.contains('|');
    if command.arguments.iter().any(stands_for_any) {
        return None;
    }
    let unknown = unknown_keys(&command.arguments, known);
    if !unknown.is_empty() {
        return Some(format!("no parameter {}", unknown.join(", ")));
    }
    let words = std::iter::once("use3d").chain(command.arguments.iter().map(String::as_str));
    let error = Cli::try_parse_from(words).err()?;
    let incomplete = matches!(
        error.kind(),
        ErrorKind::MissingRequiredArgument
            | ErrorKind::MissingSubcommand
            | ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand
            | ErrorKind::WrongNumberOfValues
            | ErrorKind::TooFewValues
            | ErrorKind::InvalidValue
            | ErrorKind::ValueValidation
    );
    let shown = matches!(error.kind(), ErrorKind::DisplayHelp | ErrorKind::DisplayVersion);
    // In a sentence a value may be left out or be a letter: `--set`, `--water A`.
    let excused = shown || !command.whole && incomplete;
    (!excused).then(|| error.to_string().lines().next().unwrap_or_default().to_string())
}

#[test]
fn every_command_in_the_documents_is_one_of_this_program() {
    let known = known();
    let mut faults = Vec::new();
    let mut whole = 0;
    for page in pages() {
        let text = std::fs::read_to_string(&page).expect("a page");
        for command in commands(&page.display().to_string(), &text) {
            whole += usize::from(command.whole);
            if let Some(fault) = fault(&command, &known) {
                faults.push(format!("{}: use3d {}: {fault}", command.page, command.arguments.join(" ")));
            }
        }
    }
    assert!(faults.is_empty(), "\n{}", faults.join("\n"));
    assert!(whole > 80, "only {whole} whole commands were found");
}

#[test]
fn every_example_of_the_help_is_one_of_this_program() {
    fn examples(command: &clap::Command, found: &mut Vec<String>) {
        let text = command.get_after_help().map(ToString::to_string).unwrap_or_default();
        found.extend(text.lines().filter(|l| l.starts_with("  ")).map(str::to_string));
        command.get_subcommands().for_each(|verb| examples(verb, found));
    }
    let known = known();
    let mut lines = Vec::new();
    examples(&Cli::command(), &mut lines);
    assert!(lines.len() > 40, "only {} examples were found", lines.len());
    for line in lines {
        for arguments in calls(&line) {
            let command = Command { page: "help".into(), arguments, whole: true };
            assert_eq!(fault(&command, &known), None, "{line}");
        }
    }
}

#[test]
fn commands_are_found_and_faults_are_seen() {
    let text = "Try `use3d plan` or `use3d\nrun x --fast`.\n\n```\nmkdir a && X=1 use3d run 'b c' \\\n      --set d=1 > e   # use3d f\ncargo run --release -- demo\n$ use3d status g\n```\n";
    let found: Vec<(Vec<String>, bool)> =
        commands("p", text).into_iter().map(|c| (c.arguments, c.whole)).collect();
    let expected: [(&[&str], bool); 5] = [
        (&["run", "b c", "--set", "d=1"], true),
        (&["demo"], true),
        (&["status", "g"], true),
        (&["plan"], false),
        (&["run", "x", "--fast"], false),
    ];
    assert_eq!(
        found,
        expected.map(|(words, whole)| (words.iter().map(ToString::to_string).collect(), whole))
    );

    let known = known();
    let of = |line: &str, whole| {
        let arguments = calls(line).remove(0);
        fault(&Command { page: String::new(), arguments, whole }, &known)
    };
    assert_eq!(of("use3d plan", false), None);
    for (line, whole) in [
        ("use3d plan", true),
        ("use3d run x --fast", false),
        ("use3d rnu", false),
        ("use3d run x --set reconstruct.iteration=3", true),
        ("use3d bench truth --out x --baselines none", true),
    ] {
        assert!(of(line, whole).is_some(), "{line}");
    }
}
