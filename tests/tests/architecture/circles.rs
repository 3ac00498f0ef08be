//! Finds the arrows between the files of one crate, and the circles that they form.
//!
//! An arrow leads from a file to the file that defines what a path in it names; a re-export is followed to
//! its origin. Test modules have no arrows. `a.rs` and the files in `a/` count as one file. A `lib.rs`, a
//! `main.rs` or a `mod.rs` gathers the files below it, so an arrow from it down into its own folder does not
//! count.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// The words of a module's path in its crate; the root's path is empty.
pub(crate) type ModulePath = Vec<String>;

/// The files of a crate by module, and the arrows between them.
#[derive(Debug, Default)]
pub(crate) struct Arrows {
    pub(crate) uses: BTreeMap<ModulePath, BTreeSet<ModulePath>>,
}

/// A path as it stands in a file: the module that surrounds it, and its words.
type Named = (ModulePath, Vec<String>);

/// A source file, as far as its arrows are concerned.
#[derive(Default)]
struct Parsed {
    named: Vec<Named>,
    /// The names that `use` gives to paths, with the module that contains each.
    exported: Vec<(ModulePath, String, Vec<String>)>,
    /// The modules that are compiled for tests only.
    tests: Vec<String>,
}

impl Arrows {
    /// Reads the sources of a crate below `src`. Programs in `src/bin` are left out.
    pub(crate) fn of(src: &Path) -> Self {
        let mut texts = BTreeMap::new();
        for file in super::rust_files(src) {
            let relative = file.strip_prefix(src).expect("a file below it").with_extension("");
            let mut path: ModulePath =
                relative.components().map(|c| c.as_os_str().to_string_lossy().into_owned()).collect();
            if path[0] == "bin" || path == ["main"] && src.join("lib.rs").exists() {
                continue;
            }
            let gathers = path.len() == 1 && ["lib", "main"].contains(&path[0].as_str());
            let folder = path.last().is_some_and(|name| name == "mod");
            if gathers || folder {
                path.pop();
            }
            let text = std::fs::read_to_string(&file).expect("a source file");
            texts.insert(path, (gathers || folder, text));
        }
        Self::of_texts(&texts)
    }

    /// The arrows between texts by module; the first value is true for `lib.rs`, `main.rs` and `mod.rs`.
    fn of_texts(texts: &BTreeMap<ModulePath, (bool, String)>) -> Self {
        let mut parsed: BTreeMap<ModulePath, Parsed> =
            texts.iter().map(|(path, (_, text))| (path.clone(), parse(path, text))).collect();
        let tests: Vec<ModulePath> = parsed
            .iter()
            .flat_map(|(path, file)| {
                file.tests.iter().map(|name| [&path[..], std::slice::from_ref(name)].concat())
            })
            .collect();
        let tested = |path: &ModulePath| {
            texts[path].1.trim_start().starts_with("#![cfg(test)]")
                || tests.iter().any(|t| path.starts_with(t))
        };
        parsed.retain(|path, _| !tested(path));
        let files: BTreeSet<&ModulePath> = parsed.keys().collect();
        let mut exports: BTreeMap<(&ModulePath, &str), &Vec<String>> = BTreeMap::new();
        for (scope, name, path) in parsed.values().flat_map(|file| &file.exported) {
            exports.insert((scope, name), path);
        }
        let mut arrows = Self::default();
        for (path, file) in &parsed {
            let from = whole(path, texts);
            let into = arrows.uses.entry(from.clone()).or_default();
            for (scope, named) in &file.named {
                let Some(found) = definition(scope, named, &files, &exports, 0) else { continue };
                let to = whole(&found, texts);
                let gathered = texts[&from].0 && to.starts_with(&from);
                if to != from && !gathered {
                    into.insert(to);
                }
            }
        }
        arrows
    }

    /// The modules that a module reaches by arrows.
    fn reached(&self, from: &ModulePath) -> BTreeSet<&ModulePath> {
        let (mut open, mut reached) = (vec![from], BTreeSet::new());
        while let Some(path) = open.pop() {
            let new = self.uses.get(path).into_iter().flatten().filter(|next| reached.insert(*next));
            open.extend(new.collect::<Vec<_>>());
        }
        reached
    }

    /// The sets of files that reach each other, with at least `least` files.
    pub(crate) fn circles(&self, least: usize) -> Vec<Vec<&ModulePath>> {
        let reached: BTreeMap<_, _> = self.uses.keys().map(|path| (path, self.reached(path))).collect();
        let mut seen = BTreeSet::new();
        let mut circles = Vec::new();
        for (path, there) in &reached {
            let back = |other: &&ModulePath| reached.get(*other).is_some_and(|from| from.contains(path));
            let circle: Vec<&ModulePath> = there.iter().copied().filter(back).collect();
            if circle.len() >= least && seen.insert(circle.clone()) {
                circles.push(circle);
            }
        }
        circles
    }
}

/// The module that a file counts as: `a.rs` stands for the files in `a/`.
fn whole(path: &ModulePath, texts: &BTreeMap<ModulePath, (bool, String)>) -> ModulePath {
    let above = (1..path.len()).map(|n| path[..n].to_vec());
    above
        .into_iter()
        .find(|p| texts.get(p).is_some_and(|(gathers, _)| !gathers))
        .unwrap_or_else(|| path.clone())
}

/// The module whose file defines a path's item; `None` for a path into another crate or to a local name.
fn definition(
    scope: &ModulePath,
    path: &[String],
    files: &BTreeSet<&ModulePath>,
    exports: &BTreeMap<(&ModulePath, &str), &Vec<String>>,
    depth: usize,
) -> Option<ModulePath> {
    let mut rest = path;
    let mut at = match rest.first()?.as_str() {
        "crate" => {
            rest = &rest[1..];
            Vec::new()
        }
        "self" | "super" => scope.clone(),
        name => {
            let child = [&scope[..], &[name.to_string()]].concat();
            files.contains(&child).then(|| scope.clone())?
        }
    };
    while let Some(word) = rest.first().filter(|word| ["self", "super"].contains(&word.as_str())) {
        if word == "super" {
            at.pop();
        }
        rest = &rest[1..];
    }
    while let Some((word, below)) = rest.split_first() {
        let child = [&at[..], std::slice::from_ref(word)].concat();
        if files.contains(&child) {
            at = child;
            rest = below;
            continue;
        }
        if let Some(origin) = exports.get(&(&at, word.as_str())).filter(|_| depth < 8) {
            let longer = [&origin[..], below].concat();
            if let Some(found) = definition(&at, &longer, files, exports, depth + 1) {
                return Some(found);
            }
        }
        break;
    }
    (0..=at.len()).rev().map(|n| at[..n].to_vec()).find(|path| files.contains(path))
}

/// The words and signs of a source text; `::` is one sign. Comments and the content of literals are left out.
fn words(text: &str) -> Vec<String> {
    let chars: Vec<char> = text.chars().collect();
    let part = |c: char| c.is_alphanumeric() || c == '_';
    let at = |i: usize| chars.get(i).copied().unwrap_or(' ');
    let (mut words, mut i) = (Vec::new(), 0);
    while i < chars.len() {
        match chars[i] {
            '/' if at(i + 1) == '/' => {
                while i < chars.len() && chars[i] != '\n' {
                    i += 1;
                }
            }
            '/' if at(i + 1) == '*' => {
                while i < chars.len() && !(chars[i] == '*' && at(i + 1) == '/') {
                    i += 1;
                }
                i += 2;
            }
            '"' => {
                i += 1;
                while i < chars.len() && chars[i] != '"' {
                    i += 1 + usize::from(chars[i] == '\\');
                }
                i += 1;
                words.push("\"".into());
            }
            // A raw string ends with its quote and as many signs as before it.
            'r' if at(i + 1) == '"' || at(i + 1) == '#' && ['"', '#'].contains(&at(i + 2)) => {
                let signs = chars[i + 1..].iter().take_while(|c| **c == '#').count();
                i += 2 + signs;
                let closes = |i: usize| {
                    chars[i] == '"'
                        && chars[i + 1..].iter().take(signs).filter(|c| **c == '#').count() == signs
                };
                while i < chars.len() && !closes(i) {
                    i += 1;
                }
                i += 1 + signs;
                words.push("\"".into());
            }
            // A character has a closing quote; a lifetime has none.
            '\'' if at(i + 1) == '\\' || at(i + 2) == '\'' => {
                i += 2 + usize::from(at(i + 1) == '\\');
                while i < chars.len() && chars[i] != '\'' {
                    i += 1;
                }
                i += 1;
            }
            c if part(c) => {
                let start = i;
                while i < chars.len() && part(chars[i]) {
                    i += 1;
                }
                words.push(chars[start..i].iter().collect());
            }
            ':' if at(i + 1) == ':' => {
                words.push("::".into());
                i += 2;
            }
            c => {
                if !c.is_whitespace() {
                    words.push(c.into());
                }
                i += 1;
            }
        }
    }
    words
}

/// The index after the item that starts at `i`: after its body, its `;`, or the `,` of a field.
fn item_end(words: &[String], mut i: usize) -> usize {
    let mut depth = 0_usize;
    while i < words.len() {
        match words[i].as_str() {
            "{" | "(" | "[" => depth += 1,
            "}" | ")" | "]" if depth == 0 => return i,
            closed @ ("}" | ")" | "]") => {
                depth -= 1;
                if depth == 0 && closed == "}" {
                    return i + 1;
                }
            }
            ";" | "," if depth == 0 => return i + 1,
            _ => {}
        }
        i += 1;
    }
    i
}

/// Reads the paths that start at `i`: `a::{b, c::d}` gives `a::b` and `a::c::d`. The index of the end is
/// returned, and each path with the name that it gets.
fn paths(words: &[String], i: &mut usize) -> Vec<(Vec<String>, String)> {
    let sign = |i: usize| words.get(i).map_or("", String::as_str);
    if sign(*i) == "{" {
        *i += 1;
        let mut all = Vec::new();
        while *i < words.len() && sign(*i) != "}" {
            let before = *i;
            all.extend(paths(words, i));
            *i += usize::from(sign(*i) == "," || *i == before);
        }
        *i += 1;
        return all;
    }
    let first = sign(*i).to_string();
    if !(first == "*" || first.chars().all(|c| c.is_alphanumeric() || c == '_') && !first.is_empty()) {
        return Vec::new();
    }
    *i += 1;
    let continues = sign(*i) == "::"
        && (["{", "*"].contains(&sign(*i + 1))
            || sign(*i + 1).starts_with(|c: char| c.is_alphabetic() || c == '_'));
    if continues {
        *i += 1;
        let below = paths(words, i).into_iter();
        return below.map(|(path, name)| ([vec![first.clone()], path].concat(), name)).collect();
    }
    let mut name = first.clone();
    if sign(*i) == "as" {
        name = sign(*i + 1).to_string();
        *i += 2;
    }
    vec![(vec![first], name)]
}

fn parse(own: &ModulePath, text: &str) -> Parsed {
    let words = words(text);
    let sign = |i: usize| words.get(i).map_or("", String::as_str);
    let (mut file, mut i) = (Parsed::default(), 0);
    // The modules inside the file that are open, each with the depth of its braces.
    let (mut inner, mut depth) = (Vec::<(String, usize)>::new(), 0_usize);
    while i < words.len() {
        let scope =
            || -> ModulePath { own.iter().chain(inner.iter().map(|(name, _)| name)).cloned().collect() };
        if sign(i) == "#" && sign(i + 1) == "[" {
            let end = item_end(&words, i + 2);
            let condition = words[i + 2..end].concat();
            if condition == "cfg(test)" || condition.starts_with("cfg(all(test,") {
                let mut start = end + 1;
                while sign(start) == "#" {
                    start = item_end(&words, start + 2) + 1;
                }
                let stop = item_end(&words, start);
                let module = words[start..stop].iter().position(|word| word == "mod");
                if let Some(at) = module.filter(|at| sign(start + at + 2) == ";") {
                    file.tests.push(sign(start + at + 1).to_string());
                }
                i = stop;
            } else {
                i = end + 1;
            }
            continue;
        }
        match sign(i) {
            "{" => depth += 1,
            "}" => {
                depth = depth.saturating_sub(1);
                if inner.last().is_some_and(|(_, at)| *at == depth) {
                    inner.pop();
                }
            }
            "mod" if sign(i + 2) == "{" => {
                inner.push((sign(i + 1).to_string(), depth));
                i += 1;
            }
            "mod" if sign(i + 2) == ";" => i += 2,
            "use" => {
                // A `use` is an arrow of its file, and it gives the name to the file's children and, if it is
                // public, to other files.
                let scope = scope();
                i += 1;
                for (path, name) in paths(&words, &mut i) {
                    let last = path.len().saturating_sub(2);
                    let name = if name == "self" { path[last].clone() } else { name };
                    file.exported.push((scope.clone(), name, path.clone()));
                    file.named.push((scope.clone(), path));
                }
                continue;
            }
            word if sign(i + 1) == "::"
                && (i == 0 || ![".", "::", "$"].contains(&sign(i - 1)))
                && word.chars().all(|c| c.is_alphanumeric() || c == '_') =>
            {
                let scope = scope();
                let found = paths(&words, &mut i);
                file.named.extend(found.into_iter().map(|(path, _)| (scope.clone(), path)));
                continue;
            }
            _ => {}
        }
        i += 1;
    }
    file
}

fn texts(files: &[(&str, bool, &str)]) -> BTreeMap<ModulePath, (bool, String)> {
    let path = |path: &str| path.split('/').filter(|p| !p.is_empty()).map(String::from).collect();
    files.iter().map(|(module, gathers, text)| (path(module), (*gathers, (*text).to_string()))).collect()
}

#[test]
fn a_circle_of_three_files_is_found_also_through_a_re_export() {
    let files = [
        ("", true, "mod a; mod b; pub mod c; pub use c::Third;"),
        ("a", false, "use crate::b::{self, Second as Other}; struct First; // crate::d::Nothing"),
        ("b", false, "fn f() -> crate::Third { let text = \"crate::a::First\"; crate::Third }"),
        ("c", false, "struct Third; mod inner { use super::*; fn f(x: super::super::a::First) {} }"),
        ("d", false, "use super::a::First;"),
        ("e", false, "pub(crate) use crate::a::First; fn f(x: First) {}"),
    ];
    let arrows = Arrows::of_texts(&texts(&files));
    let circles = arrows.circles(3);
    assert_eq!(
        circles,
        [[&["a"], &["b"], &["c"]].map(|p| p.map(String::from).to_vec()).iter().collect::<Vec<_>>()]
    );
    for user in ["d", "e"] {
        assert_eq!(arrows.uses[&vec![user.to_string()]].len(), 1, "{user}: {arrows:?}");
    }
}

#[test]
fn tests_children_and_gatherers_form_no_circle() {
    let files = [
        ("", true, "mod a; mod room; use a::First; fn f() -> First { room::x::f() }"),
        ("a", false, "mod part; pub struct First; #[cfg(test)] mod tests { use crate::room::y::Y; }"),
        ("a/part", false, "use super::First; #[cfg(test)] use crate::room::x::X; fn f() { crate::f() }"),
        ("room", true, "mod x; mod y; pub use x::X; pub struct Shared; fn f() { y::g() }"),
        ("room/x", false, "use super::Shared; use crate::a::First; pub struct X;"),
        ("room/y", false, "use super::{Shared, X}; #[cfg(test)] #[path = \"z.rs\"] mod z;"),
        ("room/y/z", false, "use crate::a::First; use crate::room::x::X;"),
    ];
    let arrows = Arrows::of_texts(&texts(&files));
    assert!(arrows.circles(2).is_empty(), "{arrows:?}");
    let of = |path: &[&str]| &arrows.uses[&path.iter().map(|p| (*p).to_string()).collect::<Vec<_>>()];
    assert_eq!(of(&["a"]).len(), 1, "the root alone: {arrows:?}");
    assert_eq!(of(&["room", "y"]).len(), 2, "the room and x: {arrows:?}");
}
