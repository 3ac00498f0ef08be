//! Figures in the documents stand for today's program, or name the program that made them.
//!
//! Tables of measured figures are only in `docs/science/results.md` and `docs/science/performance.md`. Each
//! has a comment above it, in its section, in one of two forms:
//!
//! ```text
//! <!-- measured: use3d bench truth --out bench/
//!      defaults of import, reconstruct, targets: 1a2b3c4d5e6f -->
//!
//! <!-- measured: use3d bench truth --out bench/
//!      program of c72191f -->
//! ```
//!
//! The first form is for tables of today's defaults: the digest is that of the default parameters of the
//! stages behind the figures. When a default has changed, the test fails. Then measure the table again,
//! remove it, or use the second form, which also needs the words "program of `c72191f`" in the text above
//! the table.

#[path = "paper/lines.rs"]
mod lines;

use std::path::{Path, PathBuf};

use serde_json::{Value, json};
use use3d_stages::registry;
use use3d_workflow::{Digest, Registry, canonical};

/// The pages for tables of figures.
const FIGURES: [&str; 2] = ["docs/science/results.md", "docs/science/performance.md"];
/// Pages with numbers that depend on no default of a stage.
const OTHERS: [(&str, &str); 6] = [
    ("docs/science/networks.md", "time and memory of the networks of others, which have no parameters"),
    ("docs/science/inputs.md", "strengths of faults, which a test of `synth` compares with its table"),
    ("docs/reference/networks.md", "sizes of the files of others"),
    ("docs/science/packages.md", "time and memory of two builds of the same program"),
    ("docs/science/viewers.md", "differences of pictures of one artificial scene, which a test asks again"),
    ("docs/science/decisions.md", "values of parameters, which tests of the page and of the preset compare"),
];
/// A table with this many decimal numbers is a table of figures.
const FEW: usize = 4;
/// Write today's digests into the pages if this variable is set.
const UPDATE: &str = "USE3D_UPDATE_FIGURES";

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

/// README and all pages of the documents, by their path in the repository.
fn pages() -> Vec<String> {
    let mut pages = vec!["README.md".to_string()];
    for entry in walkdir::WalkDir::new(root().join("docs")).into_iter().filter_map(Result::ok) {
        if entry.path().extension().is_some_and(|e| e == "md") {
            let below = entry.path().strip_prefix(root()).expect("below");
            pages.push(below.to_string_lossy().into_owned());
        }
    }
    pages.sort();
    pages
}

/// The parameters that the preset `paper` calls places and bookkeeping.
fn bookkeeping(stage: &str) -> Vec<String> {
    let stage = format!("{stage}.");
    let left = lines::lines().into_iter().filter(|(_, (by, _))| by == "pipeline");
    left.filter_map(|(name, _)| name.strip_prefix(&stage).map(String::from)).collect()
}

/// The first twelve digits of the digest of some stages' parameters, with `changed` in place of defaults.
fn digest_with(registry: &Registry, stages: &str, changed: &Value) -> Result<String, String> {
    let mut text = String::new();
    for name in stages.split(',').map(str::trim) {
        let stage = registry.stage(name).map_err(|e| e.to_string())?;
        let given = changed.get(name).cloned().unwrap_or_else(|| json!({}));
        let values = stage.parameters(&given).map_err(|e| e.to_string())?;
        let mut values = Value::clone(values.json());
        bookkeeping(name).iter().for_each(|path| canonical::remove(&mut values, path));
        text += &format!("{name} {values}\n");
    }
    Ok(Digest::of(text.as_bytes()).to_string().chars().take(12).collect())
}

fn digest(registry: &Registry, stages: &str) -> Result<String, String> {
    digest_with(registry, stages, &json!({}))
}

/// The number of decimal numbers in a text.
fn decimals(text: &str) -> usize {
    let bytes = text.as_bytes();
    let digit = |i: usize| bytes.get(i).is_some_and(u8::is_ascii_digit);
    (1..bytes.len())
        .filter(|i| bytes[*i] == b'.' && digit(i + 1) && !bytes[i - 1].is_ascii_alphabetic())
        .count()
}

/// Words without marks and with single spaces.
fn plain(text: &str) -> String {
    text.replace('`', "").split_whitespace().collect::<Vec<_>>().join(" ")
}

/// The origin of the tables below a comment.
#[derive(Clone, Debug, PartialEq)]
enum Made {
    /// By the defaults of some stages, with this digest.
    Defaults { stages: String, digest: String },
    /// By the program of these commits.
    Program(String),
}

/// A comment above tables: its line, the level of its section, the command and the program.
#[derive(Clone, Debug)]
struct Comment {
    line: usize,
    level: usize,
    command: String,
    made: Made,
}

fn comment(text: &str, line: usize, level: usize) -> Result<Comment, String> {
    let form = "expected `<!-- measured: COMMAND`, then `defaults of STAGE, STAGE: DIGEST -->` or \
                `program of COMMIT -->`";
    let inside = text.trim().strip_prefix("<!--").and_then(|t| t.strip_suffix("-->")).ok_or(form)?;
    let inside = inside.trim().strip_prefix("measured:").ok_or(form)?;
    let of = |word: &str| inside.rsplit_once(word).map(|(command, rest)| (command.trim(), plain(rest)));
    let (command, made) = if let Some((command, rest)) = of("program of ") {
        let commit = |word: &str| word.len() >= 7 && word.bytes().all(|b| b.is_ascii_hexdigit());
        if !rest.split([' ', ',']).any(commit) {
            return Err(format!("`{rest}` names no commit by seven hexadecimal digits or more"));
        }
        (command, Made::Program(rest))
    } else {
        let (command, rest) = of("defaults of ").ok_or(form)?;
        let (stages, digest) = rest.rsplit_once(':').ok_or(form)?;
        (command, Made::Defaults { stages: stages.into(), digest: digest.trim().into() })
    };
    if command.is_empty() {
        return Err("the command is missing".into());
    }
    Ok(Comment { line, level, command: command.into(), made })
}

/// The problems of a page, and the page with today's digests.
fn look(registry: &Registry, name: &str, text: &str) -> (Vec<String>, String) {
    let (mut wrong, mut written) = (Vec::new(), text.to_string());
    // The text of a section counts for all sections in it.
    let (mut current, mut sections): (Option<Comment>, Vec<(usize, String)>) = (None, Vec::new());
    let mut lines = text.lines().enumerate().map(|(i, line)| (i + 1, line)).peekable();
    let mut in_code = false;
    while let Some((number, line)) = lines.next() {
        in_code ^= line.trim_start().starts_with("```");
        let level = line.bytes().take_while(|b| *b == b'#').count();
        if level > 0 && !in_code {
            sections.retain(|(of, _)| *of < level);
            sections.push((level, String::new()));
            current = current.filter(|comment: &Comment| comment.level < level);
        }
        if line.starts_with("<!-- measured") {
            let mut whole = line.to_string();
            while !whole.contains("-->") {
                let Some((_, more)) = lines.next() else { break };
                whole = format!("{whole} {}", more.trim());
            }
            match comment(&whole, number, sections.last().map_or(0, |(level, _)| *level)) {
                Err(error) => wrong.push(format!("{name}:{number}: {error}")),
                Ok(found) => {
                    if let Made::Defaults { stages, digest: stated } = &found.made {
                        match digest(registry, stages) {
                            Err(error) => wrong.push(format!("{name}:{number}: {error}")),
                            Ok(now) if *stated != now => {
                                wrong.push(format!(
                                    "{name}:{number}: the defaults of {stages} have changed since ({stated} is now \
                                     {now}): {}",
                                    found.command
                                ));
                                let place = format!("{stages}: {stated}");
                                written = written.replace(&place, &format!("{stages}: {now}"));
                            }
                            Ok(_) => {}
                        }
                    }
                    current = Some(found);
                }
            }
        } else if line.starts_with('|') {
            let mut table = line.to_string();
            while let Some((_, row)) = lines.next_if(|(_, row)| row.starts_with('|')) {
                table += row;
            }
            if decimals(&table) < FEW {
                continue;
            }
            if !FIGURES.contains(&name) {
                wrong.push(format!(
                    "{name}:{number}: tables of figures are in {} alone",
                    FIGURES.join(" and ")
                ));
                continue;
            }
            match &current {
                None => wrong.push(format!(
                    "{name}:{number}: figures without a command, and without the program that made them"
                )),
                Some(Comment { made: Made::Program(commits), line, .. }) => {
                    let words = format!("program of {commits}");
                    if !sections.iter().any(|(_, text)| plain(text).contains(&words)) {
                        wrong.push(format!("{name}:{number}: the text above does not say \"{words}\", as the comment in line {line} does"));
                    }
                }
                Some(_) => {}
            }
        } else if let Some((_, text)) = sections.last_mut() {
            text.push_str(line);
            text.push('\n');
        }
    }
    (wrong, written)
}

const HELP: &str = "Measure a table again with its command, and write today's digests with \
    `USE3D_UPDATE_FIGURES=1 cargo test -p use3d-config --test figures` (that alone is right if the new default changes no byte); or remove it; or write `program of COMMIT` \
    in its comment and in the text above it, with the last commit that had these defaults";

#[test]
fn figures_in_the_documents_name_the_program_that_made_them() {
    let registry = registry().expect("the stage table");
    let mut wrong = Vec::new();
    for page in pages().iter().filter(|page| OTHERS.iter().all(|(other, _)| page != other)) {
        let file = root().join(page);
        let text = std::fs::read_to_string(&file).expect("a page");
        let (problems, written) = look(&registry, page, &text);
        if std::env::var_os(UPDATE).is_some() && written != text {
            std::fs::write(&file, &written).expect("written");
            wrong.extend(look(&registry, page, &written).0);
        } else {
            wrong.extend(problems);
        }
    }
    assert!(wrong.is_empty(), "{}\n\n{HELP}.", wrong.join("\n"));
    for (page, why) in OTHERS {
        assert!(root().join(page).is_file(), "{page} ({why})");
    }
}

#[test]
fn a_default_that_changes_and_a_table_without_an_origin_are_told() {
    let registry = registry().expect("the stage table");
    let stages = "enhance, targets";
    let now = digest(&registry, stages).expect("known stages");
    // Any parameter with an effect on a result changes the digest; bookkeeping does not.
    let with = |changed: Value| digest_with(&registry, stages, &changed).expect("known parameters");
    assert_ne!(with(json!({"enhance": {"iterations": 77}})), now);
    assert_ne!(with(json!({"targets": {"consensus": {"measure_order": true}}})), now);
    assert_eq!(with(json!({"enhance": {"log_every": 7}, "targets": {"engine": "auto"}})), now);
    assert_ne!(digest(&registry, "enhance").expect("a known stage"), now);

    const TABLE: &str = "\n| a | b |\n|---|---|\n| 1.5 | .25 |\n| 3.5 | 4.5 |\n";
    let page = |made: &str, words: &str| {
        format!("# A\n\n{words}\n\n<!-- measured: use3d demo\n     {made} -->\n{TABLE}")
    };
    let told = |text: &str| look(&registry, FIGURES[0], text).0.join("\n");
    let current = page(&format!("defaults of {stages}: {now}"), "");
    assert_eq!(told(&current), "");
    let stale = page(&format!("defaults of {stages}: 0123456789ab"), "");
    for word in ["results.md:5: ", "have changed", &now, "use3d demo"] {
        assert!(told(&stale).contains(word), "{word}: {}", told(&stale));
    }
    assert_eq!(look(&registry, FIGURES[0], &stale).1, current, "the update writes today's digest");

    let older = |words: &str| page("program of c72191f", words);
    assert!(told(&older("")).contains("does not say \"program of c72191f\""), "{}", told(&older("")));
    assert_eq!(told(&older("Made by the program\nof `c72191f`.")), "");
    assert!(told(&page("program of today", "program of today")).contains("names no commit"));
    // Words below the table, or of another section, do not count.
    assert!(told(&format!("{}\nprogram of c72191f\n", older(""))).contains("does not say"));
    assert!(told(&format!("# B\n\nprogram of c72191f\n\n{}", older(""))).contains("does not say"));
    // A comment counts for the sections below its own, and not for the next one.
    assert_eq!(told(&format!("{current}\n## Part\n{TABLE}")), "");
    assert!(
        told(&format!("{current}\n# B\n{TABLE}")).contains(":15: figures without"),
        "{}",
        told(&format!("{current}\n# B\n{TABLE}"))
    );
    assert!(told(&current.replace("<!-- measured", "<!-- seen")).contains(":8: figures without"));
    assert!(told(&current.replace("use3d demo", "")).contains("the command is missing"));
    assert!(told(&current.replace("targets", "tarkets")).contains("tarkets"));
    assert_eq!(told("| version | size |\n|---|---|\n| 0.1 | 12 |\n"), "", "few numbers are no figures");
    let elsewhere = look(&registry, "docs/science/method.md", &current).0.join("\n");
    assert!(elsewhere.contains("tables of figures are in docs/science/results.md and"), "{elsewhere}");
}

#[test]
fn the_water_types_that_reports_compare_with_are_those_of_synthetic_captures() {
    for (kind, (name, attenuation)) in use3d_synth::WaterType::ALL.into_iter().zip(use3d_water::JERLOV) {
        assert_eq!(kind.name(), name);
        for (a, b) in kind.attenuation().into_iter().zip(attenuation) {
            assert!((f64::from(a) - b).abs() < 1e-6, "{name}: {a} {b}");
        }
    }
}
