//! Snapshots of printed texts: their comparison with a file, and the text without the parts that differ from
//! run to run.
#![allow(dead_code, reason = "every test program uses its own part of it")]

use std::path::{Path, PathBuf};

/// Units of time after a number.
const UNITS: [&str; 4] = ["ms", "s", "min", "h"];

/// A printed text in which `DIR` stands for the folder and `#` for durations, dates and commits, without the
/// lines that only show progress.
pub(crate) fn steady(text: &str, folder: &Path) -> String {
    let text = text.replace(&*folder.to_string_lossy(), "DIR");
    let lines = text.lines().filter(|line| !line.ends_with(" left]"));
    lines.map(|line| steady_line(line) + "\n").collect()
}

fn steady_line(line: &str) -> String {
    let words: Vec<&str> = line.split(' ').collect();
    let mut steady: Vec<String> = Vec::new();
    let mut i = 0;
    while i < words.len() {
        let number = words[i].trim_start_matches('(');
        let unit = words.get(i + 1).map_or("", |word| word.trim_end_matches([',', ';', '.', ')', ':']));
        let duration = number.parse::<f64>().is_ok() && UNITS.contains(&unit);
        let commit = i > 0 && words[i - 1].ends_with("(commit");
        // The machine that the program was built for stands after the commit.
        let target = i > 1 && words[i - 2].ends_with("(commit");
        let before = &words[i][..words[i].len() - number.len()];
        if duration {
            // A duration of minutes and seconds becomes one mark.
            let after = &words[i + 1][unit.len()..];
            match steady.last_mut() {
                Some(last) if last.ends_with('#') => *last += after,
                _ => steady.push(format!("{before}#{after}")),
            }
            i += 1;
        } else if target {
            steady.push("#)".into());
        } else if commit || is_date(words[i]) {
            steady.push(if words[i].ends_with(',') { "#,".into() } else { "#".into() });
        } else {
            steady.push(words[i].into());
        }
        i += 1;
    }
    steady.join(" ")
}

/// True for `2026-11-25` and `14:23`.
fn is_date(word: &str) -> bool {
    let digits = |text: &str| text.len() >= 2 && text.bytes().all(|byte| byte.is_ascii_digit());
    let parts = |mark: char| word.split(mark).all(digits).then(|| word.split(mark).count());
    parts('-') == Some(3) || parts(':') == Some(2)
}

/// Compares a text with the file of that name below `snapshots/`.
pub(crate) fn compare(name: &str, text: &str) {
    let file = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/snapshots").join(format!("{name}.txt"));
    // The file should have no spaces at the ends of lines.
    let text: String = text.lines().map(|line| format!("{}\n", line.trim_end())).collect();
    if std::env::var_os("USE3D_UPDATE_SNAPSHOTS").is_some() {
        std::fs::write(&file, &text).expect("the snapshot can be written");
    }
    let written = std::fs::read_to_string(&file).unwrap_or_default();
    let differs = text.lines().zip(written.lines()).position(|(now, then)| now != then);
    let line = differs.unwrap_or_else(|| text.lines().count().min(written.lines().count()));
    assert!(
        text == written,
        "{} differs from line {}:\n- {}\n+ {}\nread it, and write it anew with USE3D_UPDATE_SNAPSHOTS=1",
        file.display(),
        line + 1,
        written.lines().nth(line).unwrap_or_default(),
        text.lines().nth(line).unwrap_or_default()
    );
}
