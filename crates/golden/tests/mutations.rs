//! Runs the hand-made errors of `mutations.toml`: each must be noticed by the test that the list names.
//!
//! ```text
//! cargo test --locked -p use3d-golden --test mutations -- --ignored --nocapture
//! ```
//!
//! The workspace is copied to `target/mutations/work`. One error at a time is written into the copy. The
//! test's program is built, the named test is run, and the file is restored. Every error adds a line to
//! `target/mutations/results.tsv`, and a later call goes on with the entries that have no line yet; remove
//! the file to begin again. `USE3D_MUTATIONS=TEXT` takes only the entries whose file contains the text.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Instant;

use serde::Deserialize;

#[derive(Deserialize)]
struct List {
    mutation: Vec<Mutation>,
}

/// One error, and the test that notices it.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Mutation {
    /// The source below the workspace.
    file: String,
    /// Text that occurs exactly once in it.
    before: String,
    /// The wrong text.
    after: String,
    /// `crate::program::test`: `atc::lib::calibrator::…` or `atc::consensus::…`.
    test: String,
}

impl Mutation {
    /// The test's package, the arguments that choose its program, and its name there.
    fn test(&self) -> (String, Vec<String>, String) {
        let mut parts = self.test.splitn(3, "::");
        let mut next = || parts.next().expect("a test is crate::program::name").to_string();
        let (package, program, name) = (format!("use3d-{}", next()), next(), next());
        let chosen = match program.as_str() {
            "lib" => vec!["--lib".to_string()],
            _ => vec!["--test".to_string(), program],
        };
        (package, chosen, name)
    }

    /// A name of the entry that changes with every part of it.
    fn key(&self) -> String {
        [&self.file, &self.before, &self.after, &self.test]
            .map(|part| part.escape_default().to_string())
            .join(" ")
    }
}

fn workspace() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

fn list() -> Vec<Mutation> {
    let text = std::fs::read_to_string(workspace().join("tests/mutations.toml")).expect("the list");
    toml::from_str::<List>(&text).expect("a list of mutations").mutation
}

#[test]
fn every_place_of_the_list_is_in_its_file_exactly_once() {
    let mutations = list();
    assert!(mutations.len() >= 60, "{} entries", mutations.len());
    let mut keys = BTreeSet::new();
    for mutation in &mutations {
        let Mutation { file, before, after, test } = mutation;
        let text = std::fs::read_to_string(workspace().join(file)).unwrap_or_else(|e| panic!("{file}: {e}"));
        assert_eq!(text.matches(before.as_str()).count(), 1, "{file}: {before}");
        assert_ne!(before, after, "{file}");
        assert!(keys.insert(mutation.key()), "{file}: {before} is listed twice");
        // The test exists: a function of its name in its crate.
        let name = test.rsplit("::").next().unwrap_or_default();
        let folder = workspace().join("crates").join(test.split("::").next().unwrap_or_default());
        assert!(declares(&folder, &format!("fn {name}(")), "{file}: {test} is no test");
    }
}

/// True if a source in the folder contains a text.
fn declares(folder: &Path, text: &str) -> bool {
    std::fs::read_dir(folder).expect("a crate").map(|e| e.expect("an entry").path()).any(|path| {
        if path.is_dir() {
            return declares(&path, text);
        }
        let source = path.extension().is_some_and(|e| e == "rs");
        source && std::fs::read_to_string(&path).is_ok_and(|source| source.contains(text))
    })
}

/// Copies a folder without build outputs, which cargo marks. A file with equal content is left alone, so that
/// nothing is built again.
fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).expect("a folder");
    for entry in std::fs::read_dir(from).expect("a folder") {
        let (path, name) = entry.map(|e| (e.path(), e.file_name())).expect("an entry");
        if name == ".git" || name == "node_modules" || path.join("CACHEDIR.TAG").exists() {
            continue;
        }
        let other = to.join(name);
        if path.is_dir() {
            copy(&path, &other);
            continue;
        }
        let content = std::fs::read(&path).expect("a file");
        if std::fs::read(&other).is_ok_and(|found| found == content) {
            continue;
        }
        std::fs::write(other, content).expect("space for the copy");
    }
}

/// Runs cargo in the copy; true if it succeeds, and its output. The tested crate is built incrementally and
/// optimised little, because it is built again for every error.
fn cargo(copy: &Path, package: &str, chosen: &[String], rest: &[&str]) -> (bool, String) {
    let output = Command::new(env!("CARGO"))
        .current_dir(copy)
        .args(["test", "--locked", "--quiet", "-p", package])
        .args(chosen)
        .args(rest)
        .env("CARGO_TARGET_DIR", copy.with_file_name("build"))
        .env("CARGO_INCREMENTAL", "1")
        .env("CARGO_PROFILE_DEV_OPT_LEVEL", "1")
        .env("CARGO_PROFILE_DEV_DEBUG", "none")
        .output()
        .expect("cargo");
    let text = [output.stdout, output.stderr].concat();
    (output.status.success(), String::from_utf8_lossy(&text).into_owned())
}

/// The last lines of a text.
fn end_of(text: &str) -> String {
    let lines: Vec<&str> = text.lines().collect();
    lines[lines.len().saturating_sub(15)..].join("\n")
}

#[test]
#[ignore = "half an hour to an hour: it builds a crate for every error; see docs/science/results.md"]
fn every_error_of_the_list_is_noticed() {
    let base = std::env::var_os("CARGO_TARGET_DIR").map_or(workspace().join("target"), PathBuf::from);
    let folder = base.join("mutations");
    let work = folder.join("work");
    copy(&workspace(), &work);
    let results = folder.join("results.tsv");
    let known = std::fs::read_to_string(&results).unwrap_or_default();
    let mut known: BTreeMap<String, (String, f64)> = known
        .lines()
        .filter_map(|line| {
            let mut fields = line.splitn(3, '\t');
            let (verdict, seconds, key) = (fields.next()?, fields.next()?.parse().ok()?, fields.next()?);
            Some((key.to_string(), (verdict.to_string(), seconds)))
        })
        .collect();
    let only = std::env::var("USE3D_MUTATIONS").unwrap_or_default();
    let mutations: Vec<Mutation> = list().into_iter().filter(|m| m.file.contains(&only)).collect();
    let mut passed = BTreeSet::new();
    for (i, mutation) in mutations.iter().enumerate() {
        if known.contains_key(&mutation.key()) {
            continue;
        }
        let (package, chosen, name) = mutation.test();
        let run: &[&str] = &[&name, "--", "--exact"];
        if passed.insert(mutation.test.clone()) {
            let (success, output) = cargo(&work, &package, &chosen, run);
            let found = output.contains("running 1 test") && success;
            assert!(found, "{} does not pass without an error:\n{}", mutation.test, end_of(&output));
        }
        let path = work.join(&mutation.file);
        let right = std::fs::read_to_string(&path).expect("a source");
        std::fs::write(&path, right.replacen(&mutation.before, &mutation.after, 1)).expect("the copy");
        let begun = Instant::now();
        let (built, output) = cargo(&work, &package, &chosen, &["--no-run"]);
        let passes = built && cargo(&work, &package, &chosen, run).0;
        let seconds = begun.elapsed().as_secs_f64();
        std::fs::write(&path, right).expect("the copy");
        assert!(built, "{}: `{}` does not compile:\n{}", mutation.file, mutation.after, end_of(&output));
        let verdict = if passes { "survived" } else { "caught" };
        println!(
            "{:>3}/{} {verdict} in {seconds:.1} s: {}: {} -> {}",
            i + 1,
            mutations.len(),
            mutation.file,
            mutation.before,
            mutation.after
        );
        let mut file =
            std::fs::OpenOptions::new().create(true).append(true).open(&results).expect("the results");
        writeln!(file, "{verdict}\t{seconds:.1}\t{}", mutation.key()).expect("the results");
        known.insert(mutation.key(), (verdict.to_string(), seconds));
    }
    let mut crates: BTreeMap<&str, (usize, usize, f64)> = BTreeMap::new();
    let mut survivors = String::new();
    for mutation in &mutations {
        let (verdict, seconds) = &known[&mutation.key()];
        let row = crates.entry(mutation.file.split('/').nth(1).unwrap_or_default()).or_default();
        *row = (row.0 + 1, row.1 + usize::from(verdict == "caught"), row.2 + seconds);
        if verdict != "caught" {
            let Mutation { file, before, after, test } = mutation;
            writeln!(survivors, "{file}: {before} -> {after} ({test})").expect("a text");
        }
    }
    for (name, (all, caught, seconds)) in crates {
        println!("{name}: {caught} of {all} noticed, {seconds:.0} s");
    }
    assert!(survivors.is_empty(), "not noticed:\n{survivors}");
}
