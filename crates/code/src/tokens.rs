//! The tokens of a source file, without those that cannot change a result.
//!
//! These are left out: comments and layout (there are no tokens for them), documentation (`///` is the
//! attribute `doc` to the compiler), items under `#[cfg(test)]`, the inline module [`DEFINITION`], and the
//! trailing commas that a formatter adds when it breaks a line. The spacing between punctuation counts only
//! where it makes a different operator (`&&` is not `& &`, `=-` is `= -`). In doubt a token counts: a
//! needless rerun costs minutes, a missed one costs trust.

use std::path::{Path, PathBuf};

use proc_macro2::{Delimiter, Group, LexError, Spacing, TokenStream, TokenTree};

use crate::DEFINITION;

/// The canonical bytes of a source text, and the files of its `#[cfg(test)] mod name;` items.
pub(crate) struct SourceTokens {
    pub(crate) bytes: Vec<u8>,
    pub(crate) test_modules: Vec<String>,
}

/// Tokenises Rust source.
pub(crate) fn tokens_of(source: &str) -> Result<SourceTokens, LexError> {
    let stream: TokenStream = source.parse()?;
    let mut out = SourceTokens { bytes: Vec::new(), test_modules: Vec::new() };
    if is_test_only_file(&stream) {
        return Ok(out);
    }
    write_stream(stream, false, &mut out);
    Ok(out)
}

/// The paths at which the source of `#[cfg(test)] mod name;` in `file` may be.
pub(crate) fn module_files(file: &Path, module: &str) -> [PathBuf; 2] {
    let stem = file.file_stem().and_then(|s| s.to_str()).unwrap_or_default();
    let parent = file.parent().unwrap_or(Path::new(""));
    let base = if matches!(stem, "mod" | "lib" | "main") { parent.to_path_buf() } else { parent.join(stem) };
    [base.join(format!("{module}.rs")), base.join(module).join("mod.rs")]
}

pub(crate) fn is_test_only_file(stream: &TokenStream) -> bool {
    let tokens: Vec<TokenTree> = stream.clone().into_iter().collect();
    let mut i = 0;
    // `#![…]` has three tokens, `#[…]` two.
    while let Some((after, group)) = attribute(&tokens, i).filter(|(after, _)| *after == i + 3) {
        if is_cfg_test(&group.stream()) {
            return true;
        }
        i = after;
    }
    false
}

pub(crate) fn is_cfg_test(attribute: &TokenStream) -> bool {
    attribute.to_string().replace(' ', "") == "cfg(test)"
}

pub(crate) fn is_doc(attribute: &TokenStream) -> bool {
    matches!(attribute.clone().into_iter().next(), Some(TokenTree::Ident(name)) if name == "doc")
}

/// `a,)` is `a)` in a call, but `(a,)` is not `(a)` alone: only a group that follows a name may lose its last
/// comma.
fn write_stream(stream: TokenStream, may_drop_only_comma: bool, out: &mut SourceTokens) {
    let tokens: Vec<TokenTree> = stream.into_iter().collect();
    let commas = tokens.iter().filter(|t| is_punct(t, ',')).count();
    let mut i = 0;
    while i < tokens.len() {
        if let Some((after, group)) = attribute(&tokens, i) {
            let outer = after - i == 2;
            if is_doc(&group.stream()) {
                i = after;
                continue;
            }
            if outer
                && is_cfg_test(&group.stream())
                && let Some(end) = item_end(&tokens, after, &mut out.test_modules)
            {
                i = end;
                continue;
            }
        }
        if is_definition(&tokens, i) {
            i += 3;
            continue;
        }
        let next = tokens.get(i + 1);
        match &tokens[i] {
            TokenTree::Punct(punct) if punct.as_char() == ',' => {
                let closes = next.is_none() && (commas > 1 || may_drop_only_comma);
                let closes_generics = next.is_some_and(|t| is_punct(t, '>'));
                if !closes && !closes_generics {
                    write_token(out, b'p', ", ");
                }
            }
            TokenTree::Punct(punct) => {
                let mut mark = ' ';
                if let (Spacing::Joint, Some(TokenTree::Punct(second))) = (punct.spacing(), next)
                    && joins(punct.as_char(), second.as_char())
                {
                    mark = '+';
                }
                write_token(out, b'p', &format!("{}{mark}", punct.as_char()));
            }
            TokenTree::Ident(ident) => write_token(out, b'i', &ident.to_string()),
            TokenTree::Literal(literal) => write_token(out, b'l', &literal.to_string()),
            TokenTree::Group(group) => {
                let (open, close) = match group.delimiter() {
                    Delimiter::Parenthesis => ('(', ')'),
                    Delimiter::Brace => ('{', '}'),
                    Delimiter::Bracket => ('[', ']'),
                    Delimiter::None => (' ', ' '),
                };
                let after_name = i > 0 && is_callee(&tokens[i - 1]);
                out.bytes.push(open as u8);
                write_stream(group.stream(), open != '(' || after_name, out);
                out.bytes.push(close as u8);
            }
        }
        i += 1;
    }
}

/// Returns true if the inline module of a stage's definition begins at `i`.
pub(crate) fn is_definition(tokens: &[TokenTree], i: usize) -> bool {
    let word = |at: usize, text: &str| matches!(tokens.get(at), Some(TokenTree::Ident(w)) if w == text);
    word(i, "mod") && word(i + 1, DEFINITION) && matches!(tokens.get(i + 2), Some(TokenTree::Group(_)))
}

fn write_token(out: &mut SourceTokens, kind: u8, text: &str) {
    out.bytes.push(kind);
    out.bytes.extend_from_slice(&(text.len() as u32).to_le_bytes());
    out.bytes.extend_from_slice(text.as_bytes());
}

pub(crate) fn is_punct(token: &TokenTree, c: char) -> bool {
    matches!(token, TokenTree::Punct(p) if p.as_char() == c)
}

fn is_callee(before: &TokenTree) -> bool {
    const KEYWORDS: [&str; 14] = [
        "return", "in", "if", "match", "while", "as", "break", "else", "let", "mut", "ref", "move", "for",
        "yield",
    ];
    match before {
        TokenTree::Ident(name) => !KEYWORDS.iter().any(|k| name == k),
        TokenTree::Punct(p) => p.as_char() == '!',
        TokenTree::Group(_) => true,
        TokenTree::Literal(_) => false,
    }
}

/// Returns true if two adjacent characters begin an operator of the language.
fn joins(first: char, second: char) -> bool {
    let pairs = ["&&", "||", "<<", ">>", "..", "::", "->", "=>", "<-"];
    pairs.iter().any(|pair| pair.chars().eq([first, second]))
        || (second == '=' && "=!<>+-*/%^&|.".contains(first))
        || first == '\''
}

/// The index after `#[…]` or `#![…]` at `i`, and the brackets.
pub(crate) fn attribute(tokens: &[TokenTree], i: usize) -> Option<(usize, &Group)> {
    if !is_punct(tokens.get(i)?, '#') {
        return None;
    }
    let bang = usize::from(tokens.get(i + 1).is_some_and(|t| is_punct(t, '!')));
    match tokens.get(i + 1 + bang) {
        Some(TokenTree::Group(group)) if group.delimiter() == Delimiter::Bracket => {
            Some((i + 2 + bang, group))
        }
        _ => None,
    }
}

/// The index after the item that starts at `i`; `None` if it is not an item (a field, an arm, an expression),
/// which is kept.
pub(crate) fn item_end(tokens: &[TokenTree], mut i: usize, test_modules: &mut Vec<String>) -> Option<usize> {
    while let Some((after, _)) = attribute(tokens, i) {
        i = after;
    }
    if matches!(tokens.get(i), Some(TokenTree::Ident(name)) if name == "pub") {
        i += 1;
        if matches!(tokens.get(i), Some(TokenTree::Group(g)) if g.delimiter() == Delimiter::Parenthesis) {
            i += 1;
        }
    }
    let word = |k: usize| match tokens.get(k) {
        Some(TokenTree::Ident(name)) => name.to_string(),
        _ => String::new(),
    };
    let ends_at_semicolon = match word(i).as_str() {
        "use" | "static" | "type" => true,
        "const" => !matches!(word(i + 1).as_str(), "fn" | "unsafe" | "async" | "extern"),
        "mod" | "fn" | "impl" | "struct" | "enum" | "union" | "trait" | "unsafe" | "async" | "extern"
        | "macro_rules" => false,
        _ => return None,
    };
    if word(i) == "mod" && tokens.get(i + 2).is_some_and(|t| is_punct(t, ';')) {
        test_modules.push(word(i + 1));
    }
    for (k, token) in tokens.iter().enumerate().skip(i) {
        let brace = matches!(token, TokenTree::Group(g) if g.delimiter() == Delimiter::Brace);
        if is_punct(token, ';') || (brace && !ends_at_semicolon) {
            return Some(k + 1);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bytes(source: &str) -> Vec<u8> {
        tokens_of(source).expect("Rust").bytes
    }

    #[test]
    fn cosmetics_do_not_count() {
        let plain = "fn f(a: &[u8], b: Vec<Vec<u8>>) -> (u8,) { g(a, b); let x = -1; if a && b { (1,) } else { h() } }";
        let dressed = "//! Module.\n/// Docs.\n#[doc = \"more\"]\nfn f(\n    a: &[u8], // why\n    b: Vec<Vec<u8>>,\n) -> (u8,) {\n    \
            /* block /* nested */ */ g(\n        a,\n        b,\n    );\n    let x=-1;\n    if a&&b { (1,) } else { h() }\n}\n\
            #[cfg(test)]\nmod tests { #[test] fn t() { f() } }\n#[cfg(test)]\nuse std::{a, b};\n";
        assert_eq!(bytes(plain), bytes(dressed));
    }

    #[test]
    fn every_token_counts() {
        let base = "fn f(x: f32) -> f32 { x * 2.0 + 1.0 }";
        for other in [
            "fn f(x: f32) -> f32 { x * 2.0 - 1.0 }",
            "fn f(x: f32) -> f32 { x * 2.5 + 1.0 }",
            "fn f(x: f64) -> f32 { x * 2.0 + 1.0 }",
            "fn f(y: f32) -> f32 { x * 2.0 + 1.0 }",
            "fn f(x: f32) -> f32 { (x * 2.0) + 1.0 }",
            "#[inline] fn f(x: f32) -> f32 { x * 2.0 + 1.0 }",
        ] {
            assert_ne!(bytes(base), bytes(other), "{other}");
        }
        assert_ne!(bytes("fn f() { a && b }"), bytes("fn f() { a & &b }"));
        assert_ne!(bytes("fn f() { (a,) }"), bytes("fn f() { (a) }"));
        assert_ne!(bytes("const A: &str = \"a b\";"), bytes("const A: &str = \"a  b\";"));
        assert_ne!(bytes("#[cfg(not(test))] fn f() {}"), bytes(""));
    }

    #[test]
    fn test_modules_in_files_are_named() {
        let tokens = tokens_of("#[cfg(test)]\nmod tests;\nmod real;").expect("Rust");
        assert_eq!(tokens.test_modules, ["tests"]);
        assert_eq!(tokens.bytes, bytes("mod real;"));
        assert_eq!(module_files(Path::new("src/lib.rs"), "tests")[0], Path::new("src/tests.rs"));
        assert_eq!(module_files(Path::new("src/field.rs"), "tests")[1], Path::new("src/field/tests/mod.rs"));
        assert!(bytes("#![cfg(test)]\nfn helper() {}").is_empty());
        assert!(tokens_of("fn f( {").is_err());
    }
}
