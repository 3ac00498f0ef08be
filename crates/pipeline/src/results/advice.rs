//! The next steps for the reader of a report, as whole commands to copy.

use std::path::Path;

use use3d_report::story::NextStep;

use crate::destination::word;

/// The most commands.
const MOST: usize = 3;

/// The reason and the command of each step. `typed` is the command that made the results, and `results` their
/// folder, if it has the scene.
pub(super) fn commands(next: &[NextStep], typed: &str, results: Option<&Path>) -> Vec<(String, String)> {
    let said = |why: &str, command: String| (why.to_string(), command);
    // The path of the program itself, and flags before the verb, are of no use to the reader.
    let mut typed = typed.split_once(' ').map_or("", |(_, rest)| rest);
    while let Some(rest) = typed.strip_prefix('-').and_then(|flag| flag.split_once(' ')) {
        typed = rest.1;
    }
    let verb = typed.split(' ').next().unwrap_or_default();
    let is_demo = verb == "demo";
    let mut all = Vec::new();
    if is_demo {
        all.push(said("Try your own photographs", "use3d run my-photographs/".into()));
    }
    for step in next {
        match step {
            NextStep::Check => {
                all.push(said(
                    "Find out what is wrong with the photographs",
                    "use3d check my-photographs/".into(),
                ));
            }
            NextStep::Again(options) if verb == "run" => {
                let again =
                    options.iter().fold(typed.to_string(), |run, (name, value)| with(&run, name, *value));
                all.push(said("Make the scene sharper with a longer run", format!("use3d {again}")));
            }
            NextStep::Again(_) => {}
        }
    }
    let Some(results) = results else { return all };
    let (out, folder) = (word(results), word(&results.with_extension("photographs")));
    all.extend([
        said("Get all of the photographs back, enhanced", format!("use3d photographs {out} --out {folder}")),
        said("Swim through the scene", format!("use3d view {out}")),
        said("Make a film of it", format!("use3d render {out} --path interpolate --video film.mp4")),
    ]);
    all.truncate(MOST);
    all
}

/// The other spellings of `--iterations N`.
const SPELLINGS: [&str; 2] = ["--iterations=", "reconstruct.iterations="];

/// A command with another number behind an option, which it may have already.
fn with(command: &str, option: &str, value: u64) -> String {
    let others = SPELLINGS.iter().copied().filter(|_| option == "--iterations ");
    let spelled = [option, option.trim_start_matches("--set ")].into_iter().chain(others);
    let found = spelled.into_iter().find_map(|own| Some((own, command.split_once(own)?)));
    match found {
        Some((own, (before, after))) => {
            let rest = after.trim_start_matches(|c: char| c.is_ascii_digit());
            format!("{before}{own}{value}{rest}")
        }
        None => format!("{command} {option}{value}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commands_are_whole_and_repeat_what_was_typed() {
        let next = [NextStep::Again(vec![("--iterations ", 3000), ("--set enhance.iterations=", 1000)])];
        let of = |typed: &str| commands(&next, typed, Some(Path::new("use3d-out/my reef")));
        let said = of("/bin/use3d -q run reef/ --iterations 300 --max-side 640");
        let again = "use3d run reef/ --iterations 3000 --max-side 640 --set enhance.iterations=1000";
        assert_eq!(said[0].1, again);
        assert_eq!(said[1].1, "use3d photographs 'use3d-out/my reef' --out 'use3d-out/my reef.photographs'");
        assert_eq!(said.len(), 3);
        let said = of("use3d run demo/ --set reconstruct.iterations=300 --set=enhance.iterations=9");
        let again = "use3d run demo/ --set reconstruct.iterations=3000 --set=enhance.iterations=1000";
        assert_eq!(said[0].1, again);
        assert!(of("use3d run a --iterations=30")[0].1.starts_with("use3d run a --iterations=3000"));
        let said = of("use3d demo");
        assert_eq!(said[0].1, "use3d run my-photographs/");
        assert!(said.iter().all(|(_, command)| !command.contains("--iterations")), "{said:?}");
        let said = commands(&[NextStep::Check], "use3d run reef/", Some(Path::new("out")));
        assert!(said[0].1.starts_with("use3d check") && said[2].1 == "use3d view out");
        assert_eq!(
            commands(&next, "use3d run b.toml", None).len(),
            1,
            "without a scene there is nothing to open"
        );
    }
}
