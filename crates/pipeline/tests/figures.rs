//! Figures in the documents stand for today's program: each table of measured quality carries, in a comment,
//! the command that made it and a digest of the default parameters of the stages behind it.
//!
//! ```text
//! <!-- measured: use3d bench truth --out bench/
//!      defaults of import, reconstruct, targets: 1a2b3c4d5e6f -->
//! ```
//!
//! A digest that is no longer that of the defaults fails here. Measure the table again and write the new
//! digest, remove the table, or write `older` in its place and say "older defaults" where a reader sees it.
#![cfg(feature = "nets")]

use std::path::{Path, PathBuf};

use serde_json::{Value, json};
use use3d_build::{Digest, Registry, canonical};
use use3d_pipeline::stages::registry;

/// Pages without measured quality: times, sizes, choices.
const OTHERS: [&str; 4] = ["performance.md", "networks.md", "packages.md", "decisions.md"];
/// So many decimal numbers make a table of figures.
const FEW: usize = 4;

/// The pages that may hold figures.
fn pages() -> Vec<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let mut pages = vec![root.join("README.md")];
    let science = std::fs::read_dir(root.join("docs/science")).expect("docs/science");
    let mut found: Vec<PathBuf> = science.map(|e| e.expect("an entry").path()).collect();
    found.retain(|p| p.extension().is_some_and(|e| e == "md"));
    found.retain(|p| !OTHERS.iter().any(|name| p.ends_with(name)));
    found.sort();
    pages.extend(found);
    pages
}

/// The parameters that the table of the paper's configuration calls places and bookkeeping.
fn bookkeeping(stage: &str) -> Vec<String> {
    let table: toml::Table = include_str!("paper/parameters.toml").parse().expect("TOML");
    let entries = table.get(stage).and_then(|t| t.as_table()).cloned().unwrap_or_default();
    let left = entries.iter().filter(|(_, e)| e.get("by").and_then(|v| v.as_str()) == Some("pipeline"));
    left.map(|(name, _)| name.clone()).collect()
}

/// The digest of the defaults of some stages, in twelve digits.
fn digest(registry: &Registry, stages: &[&str]) -> Result<String, String> {
    let mut text = String::new();
    for name in stages {
        let stage = registry.stage(name).map_err(|e| e.to_string())?;
        let mut defaults: Value = stage.parameters(&json!({})).expect("defaults");
        bookkeeping(name).iter().for_each(|path| canonical::remove(&mut defaults, path));
        text += &format!("{name} {defaults}\n");
    }
    Ok(Digest::of(text.as_bytes()).to_string().chars().take(12).collect())
}

/// The decimal numbers of a text.
fn decimals(text: &str) -> usize {
    let bytes = text.as_bytes();
    let digit = |i: usize| bytes.get(i).is_some_and(u8::is_ascii_digit);
    (1..bytes.len()).filter(|i| bytes[*i] == b'.' && digit(i - 1) && digit(i + 1)).count()
}

/// A comment about the tables below it: its line, command, stages and digest.
struct Comment {
    line: usize,
    command: String,
    stages: Vec<String>,
    digest: String,
}

fn comment(text: &str, line: usize) -> Result<Comment, String> {
    let form = "expected `<!-- measured: COMMAND`, then `defaults of STAGE, STAGE: DIGEST -->`";
    let inside = text.trim_start_matches("<!--").trim_end_matches("-->").trim();
    let (command, rest) = inside
        .strip_prefix("measured:")
        .and_then(|inside| inside.rsplit_once("defaults of "))
        .ok_or(format!("line {line}: {form}"))?;
    let (stages, digest) = rest.rsplit_once(':').ok_or(format!("line {line}: {form}"))?;
    let stages = stages.split(',').map(|s| s.trim().to_string()).collect();
    Ok(Comment { line, command: command.trim().into(), stages, digest: digest.trim().into() })
}

/// What is wrong with a page.
fn problems(registry: &Registry, name: &str, text: &str) -> Vec<String> {
    let mut wrong = Vec::new();
    let (mut current, mut section): (Option<Comment>, String) = (None, String::new());
    let mut lines = text.lines().enumerate().map(|(i, line)| (i + 1, line)).peekable();
    while let Some((number, line)) = lines.next() {
        if line.starts_with('#') {
            (current, section) = (None, String::new());
        }
        section += line;
        section.push('\n');
        if line.starts_with("<!-- measured") {
            let mut whole = line.to_string();
            while !whole.contains("-->") {
                let Some((_, more)) = lines.next() else { break };
                whole = format!("{whole} {}", more.trim());
            }
            match comment(&whole, number) {
                Ok(found) => {
                    let stages: Vec<&str> = found.stages.iter().map(String::as_str).collect();
                    match digest(registry, &stages) {
                        Err(error) => wrong.push(format!("{name}:{number}: {error}")),
                        Ok(now) if found.digest != now && found.digest != "older" => wrong.push(format!(
                            "{name}:{number}: stale, its defaults ({}) are now {now}: {}",
                            found.stages.join(", "),
                            found.command
                        )),
                        Ok(_) if found.command.is_empty() => {
                            wrong.push(format!("{name}:{number}: no command"));
                        }
                        Ok(_) => {}
                    }
                    current = Some(found);
                }
                Err(error) => wrong.push(format!("{name}: {error}")),
            }
        }
        if line.starts_with('|') {
            let mut table = String::new();
            while let Some((_, row)) = lines.next_if(|(_, row)| row.starts_with('|')) {
                table += row;
            }
            if decimals(&table) < FEW {
                continue;
            }
            match &current {
                None => wrong.push(format!("{name}:{number}: figures without a command and a digest")),
                Some(comment) if comment.digest == "older" && !section.contains("older defaults") => {
                    wrong.push(format!(
                        "{name}:{}: says `older`, and the section does not say \"older defaults\"",
                        comment.line
                    ));
                }
                Some(_) => {}
            }
        }
    }
    wrong
}

#[test]
fn figures_in_the_documents_are_of_todays_defaults() {
    let registry = registry().expect("the stage table");
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let wrong: Vec<String> = pages()
        .iter()
        .flat_map(|page| {
            let name = page.strip_prefix(&root).unwrap_or(page).display().to_string();
            problems(&registry, &name, &std::fs::read_to_string(page).expect("a page"))
        })
        .collect();
    assert!(
        wrong.is_empty(),
        "{}\n\nMeasure again and write the digest, remove the table, or write `older` and say \"older defaults\" beside it.",
        wrong.join("\n")
    );
}

#[test]
fn a_default_that_moves_and_a_table_without_a_command_are_told() {
    let registry = registry().expect("the stage table");
    let now = digest(&registry, &["enhance", "targets"]).expect("known stages");
    assert_ne!(now, digest(&registry, &["enhance"]).expect("a known stage"));
    let page = |digest: &str, words: &str| {
        format!(
            "# A\n\n{words}\n\n<!-- measured: use3d demo\n     defaults of enhance, targets: {digest} -->\n\n| a | b |\n|---|---|\n| 1.5 | 2.5 |\n| 3.5 | 4.5 |\n"
        )
    };
    let told = |text: &str| problems(&registry, "p.md", text).join("\n");
    assert_eq!(told(&page(&now, "")), "");
    let stale = told(&page("0123456789ab", ""));
    assert!(stale.contains("p.md:5: stale") && stale.contains(&now) && stale.contains("use3d demo"), "{stale}");
    assert!(told(&page("older", "")).contains("older defaults"));
    assert_eq!(told(&page("older", "Measured with older defaults.")), "");
    let bare = page(&now, "").replace("<!-- measured", "<!-- seen");
    assert!(told(&bare).contains("p.md:8: figures without"), "{}", told(&bare));
    let next = format!("{}\n# B\n\n| a | b |\n|---|---|\n| 1.5 | 2.5 |\n| 3.5 | 4.5 |\n", page(&now, ""));
    assert!(told(&next).contains("p.md:15: figures without"), "{}", told(&next));
    assert!(told(&page(&now, "").replace("targets", "tarkets")).contains("did you mean"));
}
