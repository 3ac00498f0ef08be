//! The list of verbs in `use3d --help`, in groups, and the answer to a path in place of a verb.

use std::fmt::Write as _;
use std::path::Path;

use clap::Command;
use clap::error::{ContextKind, ContextValue, ErrorKind};

/// The groups of verbs with their headings. A first user needs the first group alone.
const GROUPS: [(&str, &[&str]); 6] = [
    ("Start here", &["demo", "prepare", "check", "run", "view", "photographs", "export"]),
    ("Look, film, measure", &["render", "white", "water", "results", "compare"]),
    ("Pipelines and many scenes", &["plan", "status", "why", "graph", "pipelines", "params"]),
    ("One step at a time", &["import", "reconstruct", "calibrate", "targets", "enhance", "evaluate"]),
    ("Several machines", &["submit", "cancel", "push", "pull", "store"]),
    (
        "This installation, tests",
        &["doctor", "models", "devices", "gc", "verify", "synth", "bench", "completions", "man"],
    ),
];

/// The columns of a verb's name and of the whole list.
const NAME: usize = 13;
const WIDTH: usize = 100;

/// The command with its verbs in groups.
pub(super) fn grouped(command: Command) -> Command {
    let mut list = String::new();
    for (heading, verbs) in GROUPS {
        // Writing to a text does not fail.
        let _ = writeln!(list, "{heading}:");
        for verb in verbs {
            let about = command.find_subcommand(verb).and_then(Command::get_about);
            let about = about.map(ToString::to_string).unwrap_or_default();
            let mut line = format!("  {verb:<NAME$}");
            for word in about.split_whitespace() {
                if line.chars().count() + word.chars().count() >= WIDTH {
                    let _ = writeln!(list, "{}", line.trim_end());
                    line = " ".repeat(NAME + 2);
                }
                line.push_str(word);
                line.push(' ');
            }
            let _ = writeln!(list, "{}", line.trim_end());
        }
        list.push('\n');
    }
    command.help_template(format!(
        "{{before-help}}{{about-with-newline}}\n{{usage-heading}} {{usage}}\n\n{list}Options:\n{{options}}{{after-help}}"
    ))
}

/// The text for a command line whose verb is the path of something that is there; `None` if it is none.
pub(super) fn path_as_verb(error: &clap::Error) -> Option<String> {
    if error.kind() != ErrorKind::InvalidSubcommand {
        return None;
    }
    let Some(ContextValue::String(word)) = error.get(ContextKind::InvalidSubcommand) else { return None };
    let path = Path::new(word);
    let verb = match path.extension().and_then(|extension| extension.to_str()) {
        _ if !path.exists() => return None,
        Some("ply" | "spz" | "glb") => "view",
        _ if path.join("report.html").is_file() => "view",
        _ => "run",
    };
    let quoted = use3d_pipeline::destination::word(path);
    Some(format!("error: {word} is no verb, but it is there: did you mean `use3d {verb} {quoted}`?\n"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_verb_stands_in_one_group() {
        use clap::CommandFactory;
        let command = super::super::Cli::command();
        let mut listed: Vec<&str> = GROUPS.iter().flat_map(|(_, verbs)| *verbs).copied().collect();
        let mut verbs: Vec<&str> = command.get_subcommands().map(Command::get_name).collect();
        listed.sort_unstable();
        verbs.sort_unstable();
        assert_eq!(listed, verbs);
    }
}
