//! The modules and crates that a source file uses, found from its tokens.
//!
//! Every path counts that begins with `crate`, `self`, `super`, a module below the file, or a crate: in
//! `use`, in code, in attributes. Names are not resolved any further: a path stands for the file of the
//! longest module path that it begins with. So the names that a module re-exports with `pub use` count as the
//! module's own. Code under `#[cfg(test)]` and in the module [`DEFINITION`](crate::DEFINITION) does not
//! count; other conditions are assumed to be true.

use std::collections::{BTreeMap, BTreeSet};

use proc_macro2::{Delimiter, LexError, Spacing, TokenStream, TokenTree};

use crate::tokens::{attribute, is_cfg_test, is_definition, is_doc, is_punct, is_test_only_file, item_end};

/// The names used in one file.
#[derive(Default)]
pub(crate) struct Uses {
    /// Paths, each with the inline modules that enclose it in the file.
    paths: BTreeSet<(Vec<String>, Vec<String>)>,
    /// Modules in files of their own (`mod name;`).
    modules: BTreeSet<String>,
    /// String literals, of which some name a file that the compiler includes.
    pub(crate) literals: BTreeSet<String>,
}

/// The modules of a crate that are files: module path without `crate` → file.
pub(crate) type Modules = BTreeMap<Vec<String>, String>;

/// The modules of a crate from its files, which are relative to the crate's folder.
pub(crate) fn modules<'a>(files: impl Iterator<Item = &'a String>) -> Modules {
    let module = |file: &String| {
        let path = file.strip_prefix("src/")?.strip_suffix(".rs")?;
        let mut parts: Vec<String> = path.split('/').map(String::from).collect();
        let last = parts.last()?.as_str();
        if last == "mod" || (parts.len() == 1 && (last == "lib" || last == "main")) {
            parts.pop();
        }
        Some((parts, file.clone()))
    };
    files.filter_map(module).collect()
}

/// The names used in a Rust source.
pub(crate) fn uses_of(source: &str) -> Result<Uses, LexError> {
    let stream: TokenStream = source.parse()?;
    let mut uses = Uses::default();
    if !is_test_only_file(&stream) {
        uses.walk(stream, &[]);
    }
    Ok(uses)
}

impl Uses {
    /// The crates among `known` (in their spelling in code) that are used.
    pub(crate) fn crates<'a>(&self, known: impl Iterator<Item = &'a String>) -> Vec<&'a String> {
        // A single word may be any name.
        let paths = self.paths.iter().map(|(_, path)| path).filter(|path| path.len() > 1);
        let first: BTreeSet<&String> = paths.filter_map(|path| path.first()).collect();
        known.filter(|name| first.contains(&name.replace('-', "_"))).collect()
    }

    /// The files that the file `own` uses, without itself.
    pub(crate) fn files(&self, own: &str, modules: &Modules) -> BTreeSet<String> {
        let Some((here, _)) = modules.iter().find(|(_, file)| *file == own) else { return BTreeSet::new() };
        let below = self
            .modules
            .iter()
            .filter_map(|name| modules.get(&[here.as_slice(), std::slice::from_ref(name)].concat()));
        let named = self.paths.iter().filter_map(|(around, path)| resolve(here, around, path, modules));
        below.chain(named).filter(|file| *file != own).cloned().collect()
    }

    fn walk(&mut self, stream: TokenStream, around: &[String]) {
        let tokens: Vec<TokenTree> = stream.into_iter().collect();
        let mut i = 0;
        while i < tokens.len() {
            if let Some((after, group)) = attribute(&tokens, i) {
                if is_cfg_test(&group.stream())
                    && let Some(end) = item_end(&tokens, after, &mut Vec::new())
                {
                    i = end;
                    continue;
                }
                if !is_doc(&group.stream()) {
                    self.walk(group.stream(), around);
                }
                i = after;
                continue;
            }
            if is_definition(&tokens, i) {
                i += 3;
                continue;
            }
            match &tokens[i] {
                TokenTree::Ident(word) if word == "mod" => {
                    match (tokens.get(i + 1), tokens.get(i + 2)) {
                        (Some(TokenTree::Ident(name)), Some(TokenTree::Group(body))) => {
                            self.walk(body.stream(), &[around, &[name.to_string()]].concat());
                        }
                        (Some(TokenTree::Ident(name)), _) => {
                            self.modules.insert(name.to_string());
                        }
                        _ => {}
                    }
                    i += 3;
                    continue;
                }
                // `use name;` and `use name as other;` are paths of one word.
                TokenTree::Ident(word) if word == "use" && !is_separator(&tokens, i + 2) => {
                    if let Some(TokenTree::Ident(name)) = tokens.get(i + 1) {
                        self.paths.insert((around.to_vec(), vec![name.to_string(), "self".to_string()]));
                    }
                }
                TokenTree::Ident(_) if !is_separator(&tokens, i.wrapping_sub(2)) => {
                    i = self.path(&tokens, i, &[], around);
                    continue;
                }
                TokenTree::Literal(literal) => {
                    let text = literal.to_string();
                    if let Some(inner) = text.strip_prefix('"').and_then(|t| t.strip_suffix('"')) {
                        self.literals.insert(inner.to_string());
                    }
                }
                TokenTree::Group(group) => self.walk(group.stream(), around),
                _ => {}
            }
            i += 1;
        }
    }

    /// Reads the path at `i`, which continues `before`, and returns the index after it.
    fn path(&mut self, tokens: &[TokenTree], mut i: usize, before: &[String], around: &[String]) -> usize {
        let mut path = before.to_vec();
        while let Some(TokenTree::Ident(name)) = tokens.get(i) {
            path.push(name.to_string());
            i += 1;
            if !is_separator(tokens, i) {
                break;
            }
            i += 2;
        }
        if let Some(TokenTree::Group(group)) = tokens.get(i)
            && group.delimiter() == Delimiter::Brace
            && is_separator(tokens, i.wrapping_sub(2))
        {
            let list: Vec<TokenTree> = group.stream().into_iter().collect();
            for element in list.split(|t| is_punct(t, ',')) {
                self.path(element, 0, &path, around);
            }
            i += 1;
        }
        self.paths.insert((around.to_vec(), path));
        i
    }
}

/// Returns true if `::` is at `i`.
fn is_separator(tokens: &[TokenTree], i: usize) -> bool {
    let joint = |t: &TokenTree| matches!(t, TokenTree::Punct(p) if p.as_char() == ':' && p.spacing() == Spacing::Joint);
    tokens.get(i).is_some_and(joint) && tokens.get(i.wrapping_add(1)).is_some_and(|t| is_punct(t, ':'))
}

/// The file of the longest module path that `path` begins with; `None` for a path into another crate or to a
/// local name.
fn resolve<'a>(
    here: &[String],
    around: &[String],
    path: &[String],
    modules: &'a Modules,
) -> Option<&'a String> {
    // A single word is a name, `self`, or the `crate` of `pub(crate)`.
    if path.len() < 2 {
        return None;
    }
    let inside = [here, around].concat();
    let mut rest = path;
    let mut base = match path.first()?.as_str() {
        "crate" => {
            rest = &rest[1..];
            Vec::new()
        }
        "self" | "super" => inside,
        name => {
            let has =
                |scope: &Vec<String>| modules.contains_key(&[scope.as_slice(), &[name.to_string()]].concat());
            [inside, here.to_vec()].into_iter().find(has)?
        }
    };
    while let Some(word) = rest.first().filter(|w| ["self", "super"].contains(&w.as_str())) {
        if word == "super" {
            base.pop();
        }
        rest = &rest[1..];
    }
    base.extend(rest.iter().filter(|w| *w != "self").cloned());
    (0..=base.len()).rev().find_map(|n| modules.get(&base[..n]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_lead_to_files() {
        let files = [
            "src/lib.rs",
            "src/report/mod.rs",
            "src/report/plot.rs",
            "src/stages/mod.rs",
            "src/stages/a.rs",
            "src/stages/b.rs",
        ]
        .map(String::from);
        let modules = modules(files.iter());
        let of = |own: &str, source: &str| -> Vec<String> {
            uses_of(source).expect("Rust").files(own, &modules).into_iter().collect()
        };
        let a = "src/stages/a.rs";
        assert_eq!(of(a, "use super::b::{X, Y}; fn f() {}"), ["src/stages/b.rs"]);
        assert_eq!(of(a, "use super::b;"), ["src/stages/b.rs"]);
        assert_eq!(
            of(a, "use crate::{report::{self, plot::{Plot, Series}}, stages::b::*};"),
            ["src/report/mod.rs", "src/report/plot.rs", "src/stages/b.rs"]
        );
        assert_eq!(
            of(a, "fn f() -> u8 { let x: u8 = crate::report::plot::g::<u8>(1); x }"),
            ["src/report/plot.rs"]
        );
        assert_eq!(of(a, "mod inner { use super::*; use super::super::b::X; }"), ["src/stages/b.rs"]);
        assert_eq!(of(a, "pub(crate) fn f(&self) {} pub(super) fn g() { self.f() }"), Vec::<String>::new());
        assert_eq!(of(a, "fn f() { super::helper() }"), ["src/stages/mod.rs"]);
        assert_eq!(
            of("src/report/mod.rs", "mod plot; use crate::stages::a::A;"),
            ["src/report/plot.rs", "src/stages/a.rs"]
        );
        assert_eq!(of("src/report/mod.rs", "pub use plot::Plot;"), ["src/report/plot.rs"]);
        let none: [&str; 0] = [];
        assert_eq!(
            of(
                a,
                "//! [`super::b`]\n#[cfg(test)] mod tests { use super::super::b::X; }\n#[cfg(test)] use super::b::X;"
            ),
            none
        );
        assert_eq!(of(a, "pub(crate) mod definition { use super::super::b::X; use use3d_a::Y; }"), none);
        assert_eq!(of(a, "use std::fmt; fn f(b: u8) -> u8 { b.a::<u8>() + report }"), none);
    }

    #[test]
    fn crates_are_those_at_the_start_of_a_path() {
        let uses = uses_of(
            "use use3d_atc::calibrator; use walkdir; #[derive(thiserror::Error)] struct E; fn f(image: u8) { serde_json::to_string(&image) }",
        )
        .expect("Rust");
        let known =
            ["image", "serde-json", "thiserror", "use3d-atc", "use3d-nets", "walkdir"].map(String::from);
        assert_eq!(uses.crates(known.iter()), ["serde-json", "thiserror", "use3d-atc", "walkdir"]);
    }
}
