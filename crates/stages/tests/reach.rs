//! A second reader of the files and crates that a stage reaches. It is independent of the first one: it finds
//! paths in the text of the sources, while the build system reads tokens. Everything it finds has to be in
//! every stage's code, or an edit would leave stale artifacts in use.
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use use3d_stages::registry;

/// Folders that write no byte of an artifact (`RULES`, and the code that chooses a stage's inputs).
const NOT_FOLLOWED: [&str; 1] = ["src/engines/"];
/// Crates that write no byte of an artifact either: the build system, and the code for cards, which the
/// numeric class covers.
const CRATES_NOT_FOLLOWED: [&str; 2] = ["use3d-workflow", "use3d-gpu"];

fn stages() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).to_path_buf()
}

/// The text of a source without comments, without its tests and without the definition of a stage.
fn source(file: &Path) -> String {
    let text = std::fs::read_to_string(file).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
    let end = text.find("#[cfg(test)]").or_else(|| text.find("#[cfg(all(test")).unwrap_or(text.len());
    let (mut text, mut rest) = (String::new(), &text[..end]);
    if let Some((before, after)) = rest.split_once("mod definition {\n") {
        text += before;
        rest = after.split_once("\n}\n").map_or("", |(_, after)| after);
    }
    text += rest;
    let lines = text.lines().filter(|line| !line.trim_start().starts_with("//"));
    lines.collect::<Vec<_>>().join("\n")
}

/// The paths that begin here: `a::{b, c::d}` gives `a::b` and `a::c::d`.
fn paths(text: &[u8], at: &mut usize) -> Vec<Vec<String>> {
    let skip = |at: &mut usize| {
        while text.get(*at).is_some_and(u8::is_ascii_whitespace) {
            *at += 1;
        }
    };
    skip(at);
    if text.get(*at) == Some(&b'{') {
        *at += 1;
        let mut all = Vec::new();
        loop {
            all.extend(paths(text, at));
            // `as name` after a path does not change its target.
            while text.get(*at).is_some_and(|c| !b",}".contains(c)) {
                *at += 1;
            }
            let end = text.get(*at) != Some(&b',');
            *at += 1;
            skip(at);
            if end || text.get(*at) == Some(&b'}') {
                *at += usize::from(!end);
                return all;
            }
        }
    }
    let start = *at;
    while text.get(*at).is_some_and(|c| c.is_ascii_alphanumeric() || *c == b'_') {
        *at += 1;
    }
    let name = String::from_utf8_lossy(&text[start..*at]).into_owned();
    if name.is_empty() {
        return Vec::new();
    }
    if text[*at..].starts_with(b"::") {
        *at += 2;
        let below = paths(text, at);
        let joined = |path: Vec<String>| [name.clone()].into_iter().chain(path).collect();
        let all: Vec<Vec<String>> = below.into_iter().map(joined).collect();
        return if all.is_empty() { vec![vec![name]] } else { all };
    }
    vec![vec![name]]
}

/// All paths of a text that begin with a word.
fn beginning_with(text: &str, word: &str) -> Vec<Vec<String>> {
    let bytes = text.as_bytes();
    let path = format!("{word}::");
    let starts = text.match_indices(&path).map(|(at, _)| at);
    let whole =
        |at: &usize| *at == 0 || !(bytes[at - 1].is_ascii_alphanumeric() || b"_:".contains(&bytes[at - 1]));
    starts.filter(whole).flat_map(|mut at| paths(bytes, &mut at)).collect()
}

/// The file of the longest module path at the start of a path.
fn module(path: &[String]) -> Option<String> {
    (1..=path.len()).rev().find_map(|n| {
        let stem = format!("src/{}", path[..n].join("/"));
        let files = [format!("{stem}.rs"), format!("{stem}/mod.rs")];
        files.into_iter().find(|file| stages().join(file).is_file())
    })
}

/// The files of this crate that a file names.
fn named(file: &str) -> BTreeSet<String> {
    let text = source(&stages().join(file));
    let own: Vec<String> = file.trim_start_matches("src/").split('/').map(String::from).collect();
    let mut parent = own.clone();
    parent.pop();
    if own.last().is_some_and(|name| name == "mod.rs") {
        parent.pop();
    }
    let mut found = BTreeSet::new();
    for path in beginning_with(&text, "crate") {
        found.extend(module(&path[1..]));
    }
    for path in beginning_with(&text, "super") {
        let ups = path.iter().take_while(|name| *name == "super").count();
        let base = parent.len().saturating_sub(ups - 1);
        let whole: Vec<String> = parent[..base].iter().chain(&path[ups..]).cloned().collect();
        // A path into a module does not count as the module itself: `super::*` in a module inside a file.
        let longer = |m: &String| *m != format!("src/{}/mod.rs", parent[..base].join("/"));
        found.extend(module(&whole).filter(longer));
    }
    found
}

/// The crates of the workspace that a text names.
fn crates_of(text: &str) -> BTreeSet<String> {
    let names = text.match_indices("use3d_").map(|(at, _)| &text[at..]);
    let word = |rest: &str| {
        let end = rest.find(|c: char| !(c.is_ascii_alphanumeric() || c == '_')).unwrap_or(rest.len());
        (rest[end..].starts_with("::")).then(|| rest[..end].replace('_', "-"))
    };
    names.filter_map(word).filter(|name| folder_of(name).is_dir()).collect()
}

fn folder_of(name: &str) -> PathBuf {
    stages().join("..").join(name.trim_start_matches("use3d-"))
}

/// The crates that a crate's table of dependencies names.
fn dependencies(name: &str) -> BTreeSet<String> {
    let text = std::fs::read_to_string(folder_of(name).join("Cargo.toml")).expect("a manifest");
    let manifest: toml::Table = text.parse().expect("TOML");
    let table = manifest.get("dependencies").and_then(|d| d.as_table()).cloned().unwrap_or_default();
    let optional = |spec: &toml::Value| spec.get("optional").and_then(toml::Value::as_bool) == Some(true);
    table
        .iter()
        .filter(|(n, spec)| n.starts_with("use3d-") && !optional(spec))
        .map(|(n, _)| n.clone())
        .collect()
}

#[test]
fn a_second_reader_finds_no_file_and_no_crate_that_a_stage_s_key_leaves_out() {
    let table = registry().expect("the stage table");
    let (mut files, mut crates) = (0, 0);
    for stage in table.stages() {
        let code = table.code_of(stage.name()).expect("a stage");
        let mut open = vec![format!("src/{}.rs", stage.name())];
        let mut reached: BTreeSet<String> = open.iter().cloned().collect();
        let mut names = BTreeSet::new();
        while let Some(file) = open.pop() {
            names.extend(crates_of(&source(&stages().join(&file))));
            for next in named(&file) {
                if !NOT_FOLLOWED.iter().any(|known| next.starts_with(known)) && reached.insert(next.clone()) {
                    open.push(next);
                }
            }
        }
        let mut all = BTreeSet::new();
        let mut open: Vec<String> = names.into_iter().collect();
        while let Some(name) = open.pop() {
            if !CRATES_NOT_FOLLOWED.contains(&name.as_str()) && all.insert(name.clone()) {
                open.extend(dependencies(&name));
            }
        }
        for file in &reached {
            assert!(code.ours.contains_key(file), "{} uses {file}, and its key leaves it out", stage.name());
        }
        for name in &all {
            assert!(code.ours.contains_key(name), "{} uses {name}, and its key leaves it out", stage.name());
        }
        (files, crates) = (files + reached.len(), crates + all.len());
    }
    assert!(
        files > 60 && crates > 80,
        "a reader that finds little proves little: {files} files, {crates} crates"
    );
}

#[test]
fn the_second_reader_reads_paths_as_the_language_has_them() {
    let text = "use crate::parts::{files::{self, SCORES}, water}; let x = crate::engines::Drawn; notcrate::a";
    let found: Vec<String> = beginning_with(text, "crate").iter().map(|path| path.join("::")).collect();
    assert_eq!(
        found,
        [
            "crate::parts::files::self",
            "crate::parts::files::SCORES",
            "crate::parts::water",
            "crate::engines::Drawn"
        ]
    );
    let names = |path: &[&str]| path.iter().map(ToString::to_string).collect::<Vec<_>>();
    assert_eq!(module(&names(&["parts", "files", "SCORES"])).as_deref(), Some("src/parts/files.rs"));
    assert_eq!(module(&names(&["engines", "check"])).as_deref(), Some("src/engines/mod.rs"));
    assert!(named("src/evaluate.rs").contains("src/parts/files.rs"));
}
