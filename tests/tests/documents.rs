//! Tests of the documents: every relative link leads to a file and every anchor to a heading, the start page
//! and the site's contents name every page, and links of the archive and of the site stay inside it.

use std::path::{Component, Path, PathBuf};

/// Folders with documents, below the workspace.
const FOLDERS: &[&str] = &[
    "",
    "docs",
    "docs/guide",
    "docs/reference",
    "docs/science",
    "packaging/python",
    "fuzz",
    "tests/golden",
    "tests/museum",
];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the workspace")
}

/// Every document, as a path below the workspace.
fn documents() -> Vec<PathBuf> {
    let mut found = Vec::new();
    for folder in FOLDERS {
        for entry in std::fs::read_dir(root().join(folder)).expect(folder) {
            let path = Path::new(folder).join(entry.expect("an entry").file_name());
            if path.extension().is_some_and(|e| e == "md") {
                found.push(path);
            }
        }
    }
    found.sort();
    assert!(found.len() > 20, "{found:?}");
    found
}

fn text(document: &Path) -> String {
    std::fs::read_to_string(root().join(document)).unwrap_or_else(|e| panic!("{}: {e}", document.display()))
}

/// The lines that are not code, with their numbers.
fn prose(text: &str) -> impl Iterator<Item = (usize, &str)> {
    let mut fenced = false;
    text.lines().enumerate().filter_map(move |(at, line)| {
        let fence = line.trim_start().starts_with("```");
        fenced ^= fence;
        (!fence && !fenced).then_some((at + 1, line))
    })
}

/// Relative links of a document: line, file (the document's own name if there is only an anchor), anchor.
fn links(text: &str) -> Vec<(usize, String, String)> {
    let mut found = Vec::new();
    for (at, line) in prose(text) {
        // Text between backticks is code.
        let spoken: String = line.split('`').step_by(2).collect::<Vec<_>>().join("`");
        for part in spoken.split("](").skip(1) {
            let target = part.split([')', ' ']).next().unwrap_or_default();
            if !target.contains("://") && !target.starts_with("mailto:") {
                let (file, anchor) = target.split_once('#').unwrap_or((target, ""));
                found.push((at, file.to_string(), anchor.to_string()));
            }
        }
    }
    found
}

/// The anchors of a document's headings, as GitHub makes them.
fn anchors(text: &str) -> Vec<String> {
    let mut plain: Vec<String> = Vec::new();
    let mut found = Vec::new();
    for (_, line) in prose(text) {
        let title = line.trim_start_matches('#');
        if title.len() == line.len() || !title.starts_with(' ') {
            continue;
        }
        let kept = title.trim().chars().filter(|c| c.is_alphanumeric() || " -_".contains(*c));
        let anchor: String = kept.map(|c| if c == ' ' { '-' } else { c }).collect();
        let anchor = anchor.to_lowercase();
        // A repeated heading gets a number.
        let earlier = plain.iter().filter(|a| **a == anchor).count();
        found.push(if earlier > 0 { format!("{anchor}-{earlier}") } else { anchor.clone() });
        plain.push(anchor);
    }
    found
}

/// The path that a link of `document` leads to, below the workspace; `None` if it leads out of it.
fn target(document: &Path, file: &str) -> Option<PathBuf> {
    if file.is_empty() {
        return Some(document.to_path_buf());
    }
    let mut path = document.parent()?.to_path_buf();
    for part in Path::new(file).components() {
        match part {
            Component::Normal(name) => path.push(name),
            Component::CurDir => {}
            Component::ParentDir => path.pop().then_some(())?,
            Component::RootDir | Component::Prefix(_) => return None,
        }
    }
    Some(path)
}

#[test]
fn every_link_leads_to_a_file_and_every_anchor_to_a_heading() {
    let mut dead = Vec::new();
    let mut count = 0;
    for document in documents() {
        for (line, file, anchor) in links(&text(&document)) {
            count += 1;
            let place = format!("{}:{line}: {file}#{anchor}", document.display());
            match target(&document, &file) {
                Some(path) if root().join(&path).exists() => {
                    if !anchor.is_empty() && !anchors(&text(&path)).contains(&anchor) {
                        dead.push(format!("{place}: no such heading"));
                    }
                }
                _ => dead.push(format!("{place}: no such file")),
            }
        }
    }
    assert!(dead.is_empty(), "\n{}", dead.join("\n"));
    assert!(count > 50, "only {count} links were found");
}

/// The pages of the three shelves.
fn pages() -> Vec<PathBuf> {
    let shelves = ["docs/guide", "docs/reference", "docs/science"];
    documents().into_iter().filter(|d| shelves.iter().any(|shelf| d.starts_with(shelf))).collect()
}

#[test]
fn the_start_page_and_the_contents_name_every_page() {
    for list in ["docs/README.md", "docs/SUMMARY.md"].map(Path::new) {
        let named: Vec<_> = links(&text(list)).iter().filter_map(|(_, file, _)| target(list, file)).collect();
        let missing: Vec<_> = pages().into_iter().filter(|page| !named.contains(page)).collect();
        assert!(missing.is_empty(), "{} does not name {missing:?}", list.display());
    }
    let readme = links(&text(Path::new("README.md")));
    assert!(
        readme.iter().any(|(_, file, _)| file == "docs/README.md"),
        "the README does not lead to the pages"
    );
}

/// The site is made of `docs` alone, so a link to a file outside would not work there.
#[test]
fn links_of_the_site_stay_in_it() {
    for document in documents().into_iter().filter(|d| d.starts_with("docs")) {
        for (line, file, _) in links(&text(&document)) {
            let path = target(&document, &file).expect("a link within the workspace");
            assert!(
                path.starts_with("docs"),
                "{}:{line}: {file} is not on the site that `mdbook build docs` makes; name it in code instead",
                document.display()
            );
        }
    }
}

/// The archive contains the documents of the top folder, docs/ and the licences.
#[test]
fn links_of_documents_in_the_archive_stay_in_it() {
    let release = text(Path::new("packaging/release"));
    assert!(
        release.contains("cp -r LICENSE-MIT LICENSE-APACHE ./*.md docs "),
        "what packaging/release copies is not known here"
    );
    for document in documents() {
        if document.components().count() > 1 && !document.starts_with("docs") {
            continue;
        }
        for (line, file, _) in links(&text(&document)) {
            let path = target(&document, &file).expect("a link within the workspace");
            let top = path.components().count() == 1 && path.extension().is_some_and(|e| e == "md");
            let kept = top || path.starts_with("docs") || path.to_string_lossy().starts_with("LICENSE-");
            assert!(
                kept,
                "{}:{line}: {file} is not in the archive that packaging/release makes",
                document.display()
            );
        }
    }
}

#[test]
fn anchors_are_those_of_github() {
    let text = "# One, two\n```\n# code\n```\n## `a.b` – c\n## Again\n## Again\n#no heading\n";
    assert_eq!(anchors(text), ["one-two", "ab--c", "again", "again-1"]);
    let text = "see [a](x.md#y) and `[b](z.md)`, ![c](d.jpg)\n```\n[e](f)\n```\n[g](https://h)";
    assert_eq!(links(text), [(1, "x.md".into(), "y".into()), (1, "d.jpg".into(), String::new())]);
}
