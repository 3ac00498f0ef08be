//! Every fault that `synth capture --fault list` names is found as the list says and as the guide quotes it,
//! and sound captures have no serious finding and one minor one at most.
//!
//! The middle strengths and three sound captures are tried; all of them, and real captures, with
//!
//! ```text
//! USE3D_STRENGTHS=all cargo test -p use3d --test situations table -- --nocapture
//! ```

use std::path::Path;

use rayon::prelude::*;
use use3d_check::{Finding, Severity};
use use3d_synth::{CaptureFault, ChosenFault, Due, FAULTS};

use super::{SEED, command, examined, run, sound};

/// True if all strengths and all sound captures are tried, which takes minutes.
fn whole() -> bool {
    std::env::var("USE3D_STRENGTHS").is_ok_and(|strengths| strengths == "all")
}

/// The weight of the gravest of some findings: 3 for a refusal, 2 serious, 1 minor, 0 none.
fn weight(findings: &[&Finding]) -> u8 {
    let of = |finding: &&Finding| match finding.severity {
        Severity::Serious => 2,
        Severity::Minor => 1,
        Severity::Note | Severity::Good => 0,
    };
    findings.iter().map(of).max().unwrap_or(0)
}

/// A text without its figures, which differ a little from capture to capture.
fn bare(text: &str) -> String {
    text.chars().filter(|c| !c.is_ascii_digit() && *c != '.').collect()
}

/// A finding without its figures.
fn kind(finding: &Finding) -> String {
    format!("{:?} {}", finding.severity, bare(&finding.text))
}

/// The faults in the gallery of the guide, each with the finding that is quoted there.
fn gallery() -> Vec<(String, String)> {
    let page = include_str!("../../../../docs/guide/check.md");
    let entries = page.split("\n**`").skip(1);
    let quoted: Vec<_> = entries
        .filter_map(|entry| {
            let (fault, rest) = entry.split_once("`.** \"")?;
            let (quote, _) = rest.split_once('"')?;
            Some((fault.to_string(), quote.replace('\n', " ")))
        })
        .collect();
    assert!(quoted.len() > 5, "{quoted:?}");
    quoted
}

/// True if a finding of a line is the one that is quoted, with its severity; `…` stands for left out words.
fn quotes(line: &str, quote: &str) -> bool {
    let (severity, text) = quote.split_once(": ").expect("a severity");
    let findings = line.split(": ").skip(1).flat_map(|part| part.split(" | "));
    let severe = findings.map(str::to_lowercase).any(|finding| finding.starts_with(severity));
    severe && text.split('…').all(|part| bare(line).contains(&bare(part.trim())))
}

/// The finding that a sound capture does not have, in words, and the complaint if it is not the one that is
/// owed.
fn tried(fault: ChosenFault, level: usize, usual: &[String]) -> (String, Option<String>) {
    let dir = tempfile::tempdir().unwrap();
    let capture = sound(dir.path(), "reef");
    fault.spoil(&capture, SEED).unwrap();
    let (found, words, noted) = match examined(&capture) {
        Err(error) => (3, error, false),
        Ok((_, findings)) => {
            let own: Vec<&Finding> = findings.iter().filter(|f| !usual.contains(&kind(f))).collect();
            let told = own.iter().filter(|f| f.severity != Severity::Good);
            let words = told.map(|f| format!("{:?} {}: {}", f.severity, f.subject, f.text));
            let noted = own.iter().any(|f| f.severity != Severity::Good);
            (weight(&own), words.collect::<Vec<_>>().join(" | "), noted)
        }
    };
    let right = match fault.fault.due {
        Due::Refused => found == 3,
        Due::Serious => found == 2 || (level == 0 && found == 1),
        Due::Minor => found == 1 || found == 2,
        Due::Note => found < 3 && noted,
        Due::Right => found == 0,
    };
    (words.clone(), (!right).then_some(words))
}

#[test]
fn every_fault_is_found_as_the_list_says() {
    let all = whole();
    let dir = tempfile::tempdir().unwrap();
    let findings = examined(&sound(dir.path(), "reef")).unwrap().1;
    let usual: Vec<String> = findings.iter().map(kind).collect();
    let levels = |fault: &'static CaptureFault| match fault.strengths {
        Some(_) if all => 0..3,
        _ => 1..2,
    };
    let chosen: Vec<_> =
        FAULTS.iter().flat_map(|fault| levels(fault).map(move |level| (fault, level))).collect();
    let lines: Vec<(usize, String, Option<String>)> = chosen
        .par_iter()
        .map(|(fault, level)| {
            let (words, complaint) = tried(fault.at(*level), *level, &usual);
            let name = format!("{} {level}, owed {}", fault.name, fault.due.word());
            (*level, format!("{name}: {words}"), complaint.map(|words| format!("{name}: {words}")))
        })
        .collect();
    for (_, line, complaint) in &lines {
        println!("{} {line}", if complaint.is_some() { "MISSED" } else { "found " });
    }
    let missed = |level: usize| -> (usize, Vec<&String>) {
        let of = || lines.iter().filter(|line| line.0 == level);
        (of().count(), of().filter_map(|line| line.2.as_ref()).collect())
    };
    let [(weak, not_weak), (_, not_middle), (_, not_strong)] = [missed(0), missed(1), missed(2)];
    println!("not found: {} of {weak} weak, {not_middle:?}, {not_strong:?}", not_weak.len());
    assert!(not_middle.is_empty() && not_strong.is_empty(), "{not_middle:#?} {not_strong:#?}");
    let misquoted: Vec<_> = gallery()
        .into_iter()
        .filter(|(fault, quote)| {
            let of_fault = format!("{fault} 1, ");
            !lines.iter().any(|(_, line, _)| line.starts_with(&of_fault) && quotes(line, quote))
        })
        .collect();
    assert!(misquoted.is_empty(), "the gallery of docs/guide/check.md has other words: {misquoted:#?}");
    // Four of five weak faults are enough.
    assert!(5 * not_weak.len() <= weak, "{not_weak:#?}");
}

/// Fails if a sound capture has a serious finding, or more than one minor one.
fn check_sound(capture: &Path) {
    let findings = examined(capture).unwrap().1;
    let of = |severity| {
        let all = findings.iter().filter(move |f| f.severity == severity);
        all.map(|f| format!("{}: {}", f.subject, f.text)).collect::<Vec<_>>()
    };
    let (serious, minor) = (of(Severity::Serious), of(Severity::Minor));
    println!("{}: {serious:?} {minor:?}", capture.display());
    assert!(serious.is_empty() && minor.len() <= 1, "{}: {serious:#?} {minor:#?}", capture.display());
}

#[test]
fn sound_captures_have_no_serious_finding_and_one_minor_one_at_most() {
    let dir = tempfile::tempdir().unwrap();
    let kinds: [&[&str]; 9] = [
        &["--seed", "1"],
        &["--seed", "2", "--views", "40"],
        &["--seed", "3", "--no-depth-priors"],
        &["--seed", "4", "--size", "64x96"],
        &["--seed", "5", "--lens", "radial"],
        &["--seed", "6", "--physics", "spectral", "--water", "3C"],
        &["--seed", "7", "--physics", "spectral", "--water", "air"],
        &["--seed", "8", "--physics", "spectral", "--water", "IA", "--fish", "2"],
        &["--seed", "9", "--place", "pool"],
    ];
    let step = if whole() { 1 } else { 3 };
    for (number, kind) in kinds.into_iter().enumerate().step_by(step) {
        let capture = dir.path().join(number.to_string());
        let mut synth = command();
        synth.args(["-q", "synth", "capture", "--out"]).arg(&capture);
        let usual = [("--views", "20"), ("--size", "96x64")];
        for (flag, value) in usual.into_iter().filter(|(flag, _)| !kind.contains(flag)) {
            synth.args([flag, value]);
        }
        run(synth.args(kind)).unwrap();
        check_sound(&capture);
    }
}

#[test]
fn real_captures_have_no_serious_finding_and_one_minor_one_at_most() {
    let Some(data) = std::env::var_os("USE3D_DATA").filter(|_| whole()) else {
        println!(
            "SKIPPED, no real capture was examined: USE3D_DATA is not set, or USE3D_STRENGTHS is not `all`"
        );
        return;
    };
    for name in ["reef_deepreefmap", "vent_sucre", "fern"] {
        let capture = Path::new(&data).join(name);
        if !capture.is_dir() {
            println!("SKIPPED: {} is not there", capture.display());
            continue;
        }
        // The command measures the water, too.
        let text = run(command().args(["-q", "check", "--json"]).arg(&capture)).unwrap();
        let report: serde_json::Value = serde_json::from_str(&text).unwrap();
        let findings = report["findings"].as_array().unwrap();
        let count = |severity: &str| findings.iter().filter(|f| f["severity"] == severity).count();
        assert!(count("serious") == 0 && count("minor") <= 1, "{name}: {findings:#?}");
    }
}
