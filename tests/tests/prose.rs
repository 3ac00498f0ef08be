//! Tests of the language of the README, the guide and the reference: short sentences, one thought each, for
//! readers who learnt English at school. CONTRIBUTING.md has the rules; this file checks those that can be
//! counted.
//!
//! A sentence has at most 30 words and two numbers with decimals. There are no brackets inside brackets. A
//! heading, a bold lead or a sentence does not begin with What, Who, Which, Whether or Of, unless it is a
//! question. Lines that can be broken have at most 110 columns. Code, rules of tables and comments are not
//! checked.

use std::path::{Path, PathBuf};

const MOST_WORDS: usize = 30;
const MOST_DECIMALS: usize = 2;
const MOST_COLUMNS: usize = 110;
const HEADS: [&str; 5] = ["What", "Who", "Which", "Whether", "Of"];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the workspace")
}

/// The shelves that are written for people who use the program.
const SHELVES: [&str; 2] = ["docs/guide", "docs/reference"];

/// The README, the start page of the documents, and every page of the guide and the reference.
fn pages() -> Vec<PathBuf> {
    let mut pages: Vec<PathBuf> = ["README.md", "docs/README.md"].iter().map(|p| root().join(p)).collect();
    for shelf in SHELVES {
        for entry in std::fs::read_dir(root().join(shelf)).expect(shelf) {
            let path = entry.expect("an entry").path();
            if path.extension().is_some_and(|e| e == "md") {
                pages.push(path);
            }
        }
    }
    pages.sort();
    pages
}

/// A part of a page that is independent: a heading, a paragraph, a list item or a cell of a table.
#[derive(Debug, PartialEq)]
struct Block {
    line: usize,
    text: String,
}

/// The blocks of a page, without code.
fn blocks(page: &str) -> Vec<Block> {
    let mut found: Vec<Block> = Vec::new();
    let (mut fenced, mut open) = (false, false);
    for (at, line) in page.lines().enumerate() {
        let text = line.trim();
        if text.starts_with("```") {
            fenced = !fenced;
            open = false;
            continue;
        }
        if fenced || text.is_empty() || text.starts_with("<!--") {
            open &= fenced;
            continue;
        }
        if let Some(row) = text.strip_prefix('|') {
            open = false;
            let cells = spoken(row);
            for cell in cells.split('|').map(str::trim) {
                if cell.chars().any(char::is_alphanumeric) {
                    found.push(Block { line: at + 1, text: cell.to_string() });
                }
            }
            continue;
        }
        let heading = text.starts_with('#');
        let item = ["* ", "- "].iter().find_map(|mark| text.strip_prefix(mark)).or_else(|| numbered(text));
        let begins = heading || item.is_some() || !open;
        let text = spoken(item.unwrap_or(text).trim_start_matches('#').trim());
        match found.last_mut().filter(|_| !begins) {
            Some(block) => {
                block.text.push(' ');
                block.text.push_str(&text);
            }
            None => found.push(Block { line: at + 1, text }),
        }
        open = !heading;
    }
    found
}

/// The text after a number such as `1. `.
fn numbered(text: &str) -> Option<&str> {
    let digits = text.chars().take_while(char::is_ascii_digit).count();
    if digits == 0 { None } else { text[digits..].strip_prefix(". ") }
}

/// A line as it is read aloud: code becomes one word, and of a link only its text remains.
fn spoken(line: &str) -> String {
    let mut text = String::new();
    for (at, part) in line.split('`').enumerate() {
        text.push_str(if at % 2 == 0 { part } else { "Code" });
    }
    let mut parts = text.split("](");
    let mut out = parts.next().unwrap_or_default().to_string();
    for part in parts {
        out.push_str(part.split_once(')').map_or("", |(_, rest)| rest));
    }
    out.replace(['[', ']', '*', '!'], "")
}

/// The sentences of a block.
fn sentences(block: &str) -> Vec<String> {
    let mut found = vec![String::new()];
    let words: Vec<&str> = block.split_whitespace().collect();
    for (at, word) in words.iter().enumerate() {
        let sentence = found.last_mut().expect("one sentence");
        if !sentence.is_empty() {
            sentence.push(' ');
        }
        sentence.push_str(word);
        let ends = word.trim_end_matches([')', '"', '”']).ends_with(['.', '?', ':']);
        let next = words.get(at + 1).and_then(|w| w.trim_start_matches(['(', '"', '“']).chars().next());
        if ends && next.is_some_and(|c| c.is_uppercase() || c.is_ascii_digit() && word.ends_with('.')) {
            found.push(String::new());
        }
    }
    found.retain(|s| !s.is_empty());
    found
}

fn is_decimal(word: &str) -> bool {
    let word = word.trim_matches(|c: char| !c.is_ascii_digit());
    word.split_once('.').is_some_and(|(a, b)| {
        [a, b].iter().all(|part| !part.is_empty() && part.chars().all(|c| c.is_ascii_digit()))
    })
}

/// The faults of a sentence.
fn faults(sentence: &str) -> Vec<String> {
    let mut found = Vec::new();
    let words = sentence.split_whitespace().filter(|w| w.chars().any(char::is_alphanumeric));
    let (count, decimals) = words
        .fold((0, 0), |(n, d), word| (n + 1, d + word.split(['/', '–']).filter(|w| is_decimal(w)).count()));
    if count > MOST_WORDS {
        found.push(format!("{count} words"));
    }
    if decimals > MOST_DECIMALS {
        found.push(format!("{decimals} numbers with decimals"));
    }
    let mut depth = 0i32;
    for c in sentence.chars() {
        depth += i32::from(c == '(') - i32::from(c == ')');
        if depth > 1 {
            found.push("brackets within brackets".to_string());
            break;
        }
    }
    let first = sentence.split(|c: char| !c.is_alphabetic()).find(|w| !w.is_empty()).unwrap_or_default();
    if HEADS.iter().any(|head| head.eq_ignore_ascii_case(first)) && !sentence.trim_end().ends_with('?') {
        found.push(format!("begins with {first}"));
    }
    found
}

/// Lines that are too long and could be broken: no tables, no code, no single long word.
fn long_lines(page: &str) -> Vec<usize> {
    let mut fenced = false;
    let mut found = Vec::new();
    for (at, line) in page.lines().enumerate() {
        fenced ^= line.trim_start().starts_with("```");
        let breakable = !fenced && !line.starts_with('|') && !line.starts_with("![");
        if breakable && line.chars().count() > MOST_COLUMNS {
            found.push(at + 1);
        }
    }
    found
}

#[test]
fn the_readme_and_the_guide_are_easy_to_read() {
    let mut all = Vec::new();
    let mut count = 0;
    for page in pages() {
        let text = std::fs::read_to_string(&page).unwrap_or_else(|e| panic!("{}: {e}", page.display()));
        let name = page.strip_prefix(root()).expect("below the workspace").display().to_string();
        all.extend(long_lines(&text).iter().map(|at| format!("{name}:{at}: over {MOST_COLUMNS} columns")));
        for block in blocks(&text) {
            for sentence in sentences(&block.text) {
                count += 1;
                let found = faults(&sentence);
                all.extend(found.iter().map(|fault| format!("{name}:{}: {fault}: {sentence}", block.line)));
            }
        }
    }
    assert!(all.is_empty(), "{} faults; CONTRIBUTING.md has the rules\n{}", all.len(), all.join("\n"));
    assert!(count > 500, "only {count} sentences were found");
}

/// Every page of both shelves is about something that its reader wants to do.
#[test]
fn every_page_begins_with_what_its_reader_can_do() {
    let on_shelf = |page: &&PathBuf| SHELVES.iter().any(|shelf| page.starts_with(root().join(shelf)));
    for page in pages().iter().filter(on_shelf) {
        let text = std::fs::read_to_string(page).unwrap_or_else(|e| panic!("{}: {e}", page.display()));
        let first = blocks(&text).into_iter().nth(1).expect("a paragraph below the heading").text;
        let addressed = first.split(|c: char| !c.is_alphabetic()).any(|w| w == "you");
        assert!(addressed, "{} begins with: {first}", page.display());
    }
}

/// A diver reads the guide from its first page to its last, so it stays short.
#[test]
fn the_guide_is_a_path_of_nine_pages() {
    let guide = pages().into_iter().filter(|p| p.starts_with(root().join("docs/guide"))).count();
    assert!(guide <= 9, "the guide has {guide} pages; a page to look things up belongs into docs/reference");
}

#[test]
fn the_readme_is_two_screens() {
    let readme = std::fs::read_to_string(root().join("README.md")).expect("README.md");
    let lines = readme.lines().count();
    assert!(lines <= 120, "README.md has {lines} lines; 120 are enough");
}

#[test]
fn faults_are_found() {
    let long = format!("It goes {} on.", "on and ".repeat(15));
    assert_eq!(faults(&long), ["33 words"]);
    assert_eq!(faults("It has 1.5, 2.5/3.5 and 4."), ["3 numbers with decimals"]);
    assert_eq!(faults("One (two (three) four) five."), ["brackets within brackets"]);
    assert_eq!(faults("What comes out is small."), ["begins with What"]);
    assert_eq!(faults("which"), ["begins with which"]);
    assert_eq!(faults("Which water was it?"), Vec::<String>::new());
    assert_eq!(faults("Version 0.1.0 takes 1.5 s (twice) and 2 GB."), Vec::<String>::new());
}

#[test]
fn a_page_is_cut_into_sentences() {
    let page = "# Head one\nFirst `a. B c` is [a link](x.md#y). Second\ngoes on.\n\n```\nWhat code. Is.\n```\n* Item: one\n| a | b `|` c |\n|---|---|\n";
    let found: Vec<(usize, String)> =
        blocks(page).iter().flat_map(|b| sentences(&b.text).into_iter().map(|s| (b.line, s))).collect();
    let expected = [
        (1, "Head one"),
        (2, "First Code is a link."),
        (2, "Second goes on."),
        (8, "Item: one"),
        (9, "a"),
        (9, "b Code c"),
    ];
    assert_eq!(found, expected.map(|(at, text)| (at, text.to_string())));
    assert_eq!(long_lines(&format!("short\n{}\n```\n{0}\n```\n| {0} |", "x".repeat(111))), [2]);
}
