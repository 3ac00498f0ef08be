//! Compares two artifacts of one stage that were computed in two classes of arithmetic.
//!
//! A long training amplifies last bits: on another device the same inputs lead to another scene that is as
//! good. Then the figures that the stage names must agree, each within a tolerance of its own. Images drawn
//! from one scene differ in last bits only: such files are compared one by one, with a distance function that
//! the stage supplies, because this crate reads no pictures.

use std::path::Path;

use serde_json::Value;

use crate::cache::manifest::FileRecord;
use crate::error::StageError;

/// A figure of an artifact, in one of its JSON files.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Figure {
    /// The file, relative to the artifact.
    pub file: &'static str,
    /// The number in the file, as a JSON pointer; `*` stands for every entry of a list, and the mean of all
    /// numbers found is compared.
    pub at: &'static str,
    /// The largest difference between two classes of arithmetic.
    pub within: f64,
}

/// Files of an artifact that are alike between two classes of arithmetic, not equal.
#[derive(Clone, Copy, Debug)]
pub struct AlikeFiles {
    /// End of their names, such as `.png`.
    pub ending: &'static str,
    /// Returns the distance between two such files, or the reason why it cannot be computed.
    pub distance: fn(&Path, &Path) -> Result<f64, StageError>,
    /// Unit of the distance, for messages.
    pub unit: &'static str,
    /// The largest distance between two classes of arithmetic.
    pub within: f64,
}

/// The rule by which a stage's artifacts of two classes of arithmetic are compared.
#[derive(Clone, Copy, Debug)]
pub enum Agreement {
    /// Figures agree within their tolerances; bytes are not compared.
    Figures(&'static [Figure]),
    /// Both artifacts have the same files: files of these kinds are alike, all others equal.
    Files(&'static [AlikeFiles]),
}

/// Result of a comparison.
#[derive(Debug, PartialEq)]
pub(crate) enum Verdict {
    /// All named figures or files agree within their tolerances.
    Agree,
    /// The first difference, as text.
    Apart(String),
    /// Neither artifact has any of the named figures.
    NothingToCompare(String),
}

/// An artifact's folder, and what lies in it.
#[derive(Clone, Copy)]
pub(crate) struct ArtifactFolder<'a> {
    pub(crate) path: &'a Path,
    pub(crate) files: &'a [FileRecord],
}

/// Compares two artifacts by the rule of their stage.
pub(crate) fn compare(agreement: &Agreement, made: ArtifactFolder<'_>, again: ArtifactFolder<'_>) -> Verdict {
    let said = match agreement {
        Agreement::Figures(figures) => compare_figures(figures, made.path, again.path),
        Agreement::Files(kinds) => compare_files(kinds, made, again).map(|()| true),
    };
    match (said, agreement) {
        (Err(apart), _) => apart,
        (Ok(false), Agreement::Figures(figures)) => {
            let names: Vec<String> = figures.iter().map(|f| format!("{} {}", f.file, f.at)).collect();
            Verdict::NothingToCompare(format!("neither has any of {}", names.join(", ")))
        }
        (Ok(_), _) => Verdict::Agree,
    }
}

/// Returns true if there was any figure to compare; a difference is an error.
fn compare_figures(figures: &[Figure], made: &Path, again: &Path) -> Result<bool, Verdict> {
    let read = |folder: &Path, figure: &Figure| -> Result<Vec<f64>, Verdict> {
        let path = folder.join(figure.file);
        let wrong = |error: String| Verdict::Apart(format!("{}: {error}", path.display()));
        let text = std::fs::read_to_string(&path).map_err(|e| wrong(e.to_string()))?;
        let json = serde_json::from_str(&text).map_err(|e| wrong(e.to_string()))?;
        let steps: Vec<&str> = figure.at.split('/').skip(1).collect();
        let mut found = Vec::new();
        collect(&json, &steps, &mut found);
        Ok(found)
    };
    let mut any = false;
    for figure in figures {
        let (a, b) = (read(made, figure)?, read(again, figure)?);
        let name = format!("{} {}", figure.file, figure.at);
        if a.len() != b.len() {
            let (a, b) = (a.len(), b.len());
            return differs(format!("{name} is there {a} times, and again {b} times"));
        }
        any |= !a.is_empty();
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len().max(1) as f64;
        let (a, b) = (mean(&a), mean(&b));
        // NaN never counts as agreement.
        let near = (a - b).abs() <= figure.within;
        if !near {
            return differs(format!("{name} is {a}, and again {b}: more than {} apart", figure.within));
        }
    }
    Ok(any)
}

fn compare_files(
    kinds: &[AlikeFiles],
    made: ArtifactFolder<'_>,
    again: ArtifactFolder<'_>,
) -> Result<(), Verdict> {
    let of = |files: &'_ [FileRecord], path: &str| files.iter().find(|f| f.path == path).map(|f| f.digest);
    if let Some(more) = again.files.iter().find(|f| of(made.files, &f.path).is_none()) {
        return differs(format!("{} is new", more.path));
    }
    for file in made.files {
        let name = &file.path;
        let Some(digest) = of(again.files, name) else { return differs(format!("{name} is missing")) };
        if digest == file.digest {
            continue;
        }
        let Some(kind) = kinds.iter().find(|kind| name.ends_with(kind.ending)) else {
            return differs(format!("{name} comes out different"));
        };
        let distance = (kind.distance)(&made.path.join(name), &again.path.join(name));
        let distance = distance.map_err(|error| Verdict::Apart(error.to_string()))?;
        let near = distance <= kind.within;
        if !near {
            return differs(format!(
                "{name} comes out different: {distance:.6} {}, more than {}",
                kind.unit, kind.within
            ));
        }
    }
    Ok(())
}

fn differs<T>(difference: String) -> Result<T, Verdict> {
    Err(Verdict::Apart(difference))
}

fn collect(json: &Value, steps: &[&str], found: &mut Vec<f64>) {
    match (steps, json) {
        ([], value) => found.extend(value.as_f64()),
        (["*", rest @ ..], Value::Array(list)) => list.iter().for_each(|entry| collect(entry, rest, found)),
        ([name, rest @ ..], Value::Object(map)) => {
            map.get(*name).into_iter().for_each(|entry| collect(entry, rest, found));
        }
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_code::digest::Digest;

    fn compare_figures(figures: &'static [Figure], made: &Path, again: &Path) -> Verdict {
        let folder = |path| ArtifactFolder { path, files: &[] };
        compare(&Agreement::Figures(figures), folder(made), folder(again))
    }

    fn apart(verdict: Verdict) -> String {
        match verdict {
            Verdict::Apart(what) => what,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn figures_agree_within_their_tolerance() {
        let dir = tempfile::tempdir().expect("folder");
        let folder = |name: &str, text: &str| {
            let path = dir.path().join(name);
            std::fs::create_dir(&path).expect("folder");
            std::fs::write(path.join("scores.json"), text).expect("file");
            path
        };
        const fn figure(at: &'static str, within: f64) -> Figure {
            Figure { file: "scores.json", at, within }
        }
        let a = folder("a", r#"{"psnr": {"value": 30.0}, "views": [{"e": 1.0}, {"e": 2.0}], "none": null}"#);
        let b = folder("b", r#"{"psnr": {"value": 30.1}, "views": [{"e": 1.5}, {"e": 1.6}], "none": null}"#);
        let c = folder("c", r#"{"psnr": {"undefined": "why"}, "views": []}"#);
        assert_eq!(compare_figures(const { &[figure("/psnr/value", 0.2)] }, &a, &b), Verdict::Agree);
        let far = apart(compare_figures(const { &[figure("/psnr/value", 0.05)] }, &a, &b));
        assert!(far.contains("scores.json /psnr/value is 30, and again 30.1"), "{far}");
        // The mean of a list is compared: 1.5 and 1.55.
        assert_eq!(compare_figures(const { &[figure("/views/*/e", 0.06)] }, &a, &b), Verdict::Agree);
        apart(compare_figures(const { &[figure("/views/*/e", 0.04)] }, &a, &b));
        let gone = apart(compare_figures(const { &[figure("/psnr/value", 9.0)] }, &a, &c));
        assert!(gone.contains("1 times, and again 0 times"), "{gone}");
        const ABSENT: [Figure; 1] = [Figure { file: "no.json", at: "/x", within: 1.0 }];
        assert!(apart(compare_figures(&ABSENT, &a, &b)).contains("no.json"));
        // One of two figures is enough; none at all is no agreement.
        const ONE: [Figure; 2] = [figure("/none", 0.0), figure("/psnr/value", 0.2)];
        assert_eq!(compare_figures(&ONE, &a, &b), Verdict::Agree);
        match compare_figures(const { &[figure("/none", 0.0), figure("/misspelt", 0.0)] }, &a, &b) {
            Verdict::NothingToCompare(what) => {
                assert!(what.contains("scores.json /none, scores.json /misspelt"), "{what}");
            }
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn files_of_a_kind_agree_within_their_distance_and_all_others_to_the_byte() {
        const KINDS: [AlikeFiles; 1] = [AlikeFiles {
            ending: ".txt",
            distance: |a, b| {
                let length = |path: &Path| std::fs::metadata(path).map(|m| m.len());
                Ok(length(a)?.abs_diff(length(b)?) as f64)
            },
            unit: "bytes in length",
            within: 1.0,
        }];
        let dir = tempfile::tempdir().expect("folder");
        let artifact = |name: &str, files: &[(&str, &str)]| {
            let path = dir.path().join(name);
            std::fs::create_dir(&path).expect("folder");
            let record = |(file, text): &(&str, &str)| {
                std::fs::write(path.join(file), text).expect("file");
                let digest = Digest::of(text.as_bytes());
                FileRecord { path: file.to_string(), size: text.len() as u64, digest }
            };
            let records: Vec<FileRecord> = files.iter().map(record).collect();
            (path, records)
        };
        let made = artifact("made", &[("a.txt", "four"), ("b.raw", "b")]);
        let against = |(path, files): &(std::path::PathBuf, Vec<FileRecord>)| {
            let made = ArtifactFolder { path: &made.0, files: &made.1 };
            compare(&Agreement::Files(&KINDS), made, ArtifactFolder { path, files })
        };
        assert_eq!(against(&artifact("near", &[("a.txt", "fours"), ("b.raw", "b")])), Verdict::Agree);
        let far = apart(against(&artifact("far", &[("a.txt", "foursome"), ("b.raw", "b")])));
        assert!(far.contains("a.txt comes out different: 4.000000 bytes in length, more than 1"), "{far}");
        let other = apart(against(&artifact("other", &[("a.txt", "four"), ("b.raw", "c")])));
        assert!(other.contains("b.raw comes out different"), "{other}");
        assert!(apart(against(&artifact("less", &[("a.txt", "four")]))).contains("b.raw is missing"));
        let more = artifact("more", &[("a.txt", "four"), ("b.raw", "b"), ("c", "")]);
        assert!(apart(against(&more)).contains("c is new"));
    }
}
