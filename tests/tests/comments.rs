//! Counts the item comments of the code that begin with a question word.
//!
//! A comment says what a thing is or does (CONTRIBUTING.md, "Plain words"). One that begins with "What",
//! "Whether" or "How" names a riddle instead, so at most [`MOST`] of them may.

use std::path::{Path, PathBuf};

/// The largest share of item comments that may begin with one of [`HEADS`].
const MOST: f64 = 0.01;
const HEADS: [&str; 9] = ["What", "Whether", "Who", "Whoever", "How", "Which", "Where", "Of", "When"];
/// The longest line of a comment, in characters.
const COLUMNS: usize = 110;

/// Every Rust file of the workspace's crates and tests.
fn files() -> Vec<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the workspace").to_path_buf();
    let mut folders = vec![root.join("crates"), root.join("tests")];
    let mut files = Vec::new();
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).expect("a folder") {
            let path = entry.expect("an entry").path();
            let name = path.file_name().expect("a name").to_string_lossy().into_owned();
            if path.is_dir() && !["node_modules", "target"].contains(&name.as_str()) {
                folders.push(path);
            } else if name.ends_with(".rs") {
                files.push(path);
            }
        }
    }
    files
}

/// The text of a line that is an item comment.
fn item_comment(line: &str) -> Option<&str> {
    let line = line.trim_start();
    let text = line.strip_prefix("///").or_else(|| line.strip_prefix("//!"))?;
    Some(text.strip_prefix(' ').unwrap_or(text))
}

/// The first line of every item comment, with its number.
fn first_lines(text: &str) -> Vec<(usize, &str)> {
    let mut inside = false;
    let mut first = Vec::new();
    for (number, line) in text.lines().enumerate() {
        let comment = item_comment(line);
        if let (Some(comment), false) = (comment, inside) {
            first.push((number + 1, comment));
        }
        inside = comment.is_some();
    }
    first
}

fn begins_with_a_question(comment: &str) -> bool {
    let word = comment.split(|c: char| !c.is_alphanumeric()).next().unwrap_or_default();
    HEADS.contains(&word)
}

#[test]
fn few_item_comments_begin_with_a_question_word() {
    let (mut count, mut riddles) = (0, Vec::new());
    for file in files() {
        let text = std::fs::read_to_string(&file).expect("UTF-8");
        for (line, comment) in first_lines(&text) {
            count += 1;
            if begins_with_a_question(comment) {
                riddles.push(format!("{}:{line}: {comment}", file.display()));
            }
        }
    }
    assert!(count > 5000, "the comments were not found: {count}");
    assert!(
        riddles.len() as f64 <= MOST * count as f64,
        "{} of {count}:\n{}",
        riddles.len(),
        riddles.join("\n")
    );
}

#[test]
fn comments_fit_into_the_columns() {
    let mut long = Vec::new();
    for file in files() {
        let text = std::fs::read_to_string(&file).expect("UTF-8");
        let too_long = |line: &str| line.trim_start().starts_with("//") && line.chars().count() > COLUMNS;
        for (number, line) in text.lines().enumerate().filter(|(_, line)| too_long(line)) {
            long.push(format!("{}:{}: {line}", file.display(), number + 1));
        }
    }
    assert!(long.is_empty(), "{}", long.join("\n"));
}

#[test]
fn the_count_sees_what_it_is_for() {
    let text = "//! What a module is.\n//! How it works.\n\n/// A thing.\nfn a() {}\n/// Whether it is.\nfn b() {}\n";
    let first = first_lines(text);
    assert_eq!(first.iter().map(|f| f.0).collect::<Vec<_>>(), [1, 4, 6]);
    assert_eq!(first.iter().filter(|f| begins_with_a_question(f.1)).count(), 2);
    assert!(!begins_with_a_question("Whatever remains"));
    assert!(!begins_with_a_question("Offset of the table"));
}
