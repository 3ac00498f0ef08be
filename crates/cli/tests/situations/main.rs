//! Situations of people's captures: each stands for a kind of fault. A fault that spoils the scene is named,
//! what can be used is used, and a sound capture has no finding. `table` tries every fault of the list.

mod metres;
mod model;
mod pixels;
mod readers;
mod table;

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use serde_json::Value;
use tempfile::TempDir;
use use3d_check::{Finding, examine, figures};
use use3d_import::{ImportParams, ImportReport, import, prepare};
use use3d_synth::ChosenFault;

/// The seed of the captures.
const SEED: u64 = 42;

fn command() -> Command {
    Command::new(env!("CARGO_BIN_EXE_use3d"))
}

/// Runs the command; returns its output to both streams.
fn run(command: &mut Command) -> Result<String, String> {
    let done = command.output().expect("the command starts");
    let text = String::from_utf8_lossy(&done.stderr).into_owned() + &String::from_utf8_lossy(&done.stdout);
    if done.status.success() { Ok(text) } else { Err(text) }
}

fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap().map(Result::unwrap) {
        let at = to.join(entry.file_name());
        match entry.path().is_dir() {
            true => copy(&entry.path(), &at),
            false => _ = std::fs::copy(entry.path(), at).unwrap(),
        }
    }
}

/// A copy of a sound capture, which is made once.
fn sound(dir: &Path, name: &str) -> PathBuf {
    static MADE: OnceLock<TempDir> = OnceLock::new();
    let made = MADE.get_or_init(|| {
        let made = tempfile::tempdir().unwrap();
        let mut synth = command();
        synth.args(["-q", "synth", "capture", "--views", "12", "--size", "96x64", "--out"]);
        run(synth.arg(made.path().join("reef"))).unwrap();
        made
    });
    let to = dir.join(name);
    copy(&made.path().join("reef"), &to);
    to
}

/// The capture with a fault.
fn faulty(dir: &Path, fault: &str) -> PathBuf {
    let capture = sound(dir, &fault.replace(':', "-"));
    fault.parse::<ChosenFault>().unwrap().spoil(&capture, SEED).unwrap();
    capture
}

/// The report and the findings of a capture, without those on its water; the error of its import.
fn examined(capture: &Path) -> Result<(ImportReport, Vec<Finding>), String> {
    let original = import(capture, &ImportParams::default()).map_err(|e| e.to_string())?;
    let out = tempfile::tempdir().unwrap();
    let prepared = prepare(&original, out.path(), 1, &|_, _| true).map_err(|e| e.to_string())?;
    let figures = figures(&prepared, &original).map_err(|e| e.to_string())?;
    let report = ImportReport { overlay: prepared.report.overlay, ..original.report };
    let findings = examine(&report, figures, None, None).findings;
    Ok((report, findings))
}

/// The finding on a subject.
fn finding(capture: &Path, subject: &str) -> Finding {
    let findings = examined(capture).unwrap().1;
    let found = findings.iter().find(|finding| finding.subject == subject);
    found.unwrap_or_else(|| panic!("no finding on {subject}: {findings:#?}")).clone()
}

/// The manifest of the capture that an import makes of a folder, what it prints, and the place; the error.
fn imported(capture: &Path) -> Result<(Value, String, PathBuf), String> {
    let out = capture.with_extension("imported");
    let text = run(command().arg("import").arg(capture).arg("--out").arg(&out))?;
    let document = serde_json::from_slice(&std::fs::read(out.join("capture.json")).unwrap()).unwrap();
    Ok((document, text, out))
}
