//! Whether two artifacts of one stage agree that were computed in two classes of arithmetic.
//!
//! A long training amplifies last bits: on another device the same inputs lead to another scene that is as
//! good. What must agree then are figures that the stage names, each within a tolerance of its own.

use std::path::Path;

use serde_json::Value;

/// A figure of an artifact, in one of its JSON files.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Figure {
    /// The file, relative to the artifact.
    pub file: &'static str,
    /// Where in it, as a JSON pointer; `*` stands for every entry of a list, of which the mean counts.
    pub at: &'static str,
    /// The largest difference between two classes of arithmetic.
    pub within: f64,
}

/// Why the artifacts in these folders do not agree; `None` if they do. A figure that neither has is none to
/// differ in.
pub(crate) fn disagreement(figures: &[Figure], made: &Path, again: &Path) -> Option<String> {
    let read = |folder: &Path, figure: &Figure| -> Result<Vec<f64>, String> {
        let path = folder.join(figure.file);
        let wrong = |error: String| format!("{}: {error}", path.display());
        let text = std::fs::read_to_string(&path).map_err(|e| wrong(e.to_string()))?;
        let json = serde_json::from_str(&text).map_err(|e| wrong(e.to_string()))?;
        let steps: Vec<&str> = figure.at.split('/').skip(1).collect();
        let mut found = Vec::new();
        collect(&json, &steps, &mut found);
        Ok(found)
    };
    figures.iter().find_map(|figure| {
        let (a, b) = match (read(made, figure), read(again, figure)) {
            (Ok(a), Ok(b)) => (a, b),
            (Err(error), _) | (_, Err(error)) => return Some(error),
        };
        let name = format!("{} {}", figure.file, figure.at);
        if a.len() != b.len() {
            return Some(format!("{name} is there {} times, and again {} times", a.len(), b.len()));
        }
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len().max(1) as f64;
        let (a, b) = (mean(&a), mean(&b));
        let far = (a - b).abs() > figure.within;
        far.then(|| format!("{name} is {a}, and again {b}: more than {} apart", figure.within))
    })
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

    #[test]
    fn figures_agree_within_their_tolerance() {
        let dir = tempfile::tempdir().expect("folder");
        let folder = |name: &str, text: &str| {
            let path = dir.path().join(name);
            std::fs::create_dir(&path).expect("folder");
            std::fs::write(path.join("scores.json"), text).expect("file");
            path
        };
        let figure = |at, within| [Figure { file: "scores.json", at, within }];
        let a = folder("a", r#"{"psnr": {"value": 30.0}, "views": [{"e": 1.0}, {"e": 2.0}], "none": null}"#);
        let b = folder("b", r#"{"psnr": {"value": 30.1}, "views": [{"e": 1.5}, {"e": 1.6}], "none": null}"#);
        let c = folder("c", r#"{"psnr": {"undefined": "why"}, "views": []}"#);
        assert_eq!(disagreement(&figure("/psnr/value", 0.2), &a, &b), None);
        let far = disagreement(&figure("/psnr/value", 0.05), &a, &b).expect("too far");
        assert!(far.contains("scores.json /psnr/value is 30, and again 30.1"), "{far}");
        // Of a list, the mean: 1.5 and 1.55.
        assert_eq!(disagreement(&figure("/views/*/e", 0.06), &a, &b), None);
        assert!(disagreement(&figure("/views/*/e", 0.04), &a, &b).is_some());
        assert_eq!(disagreement(&figure("/none", 0.0), &a, &b), None);
        let gone = disagreement(&figure("/psnr/value", 9.0), &a, &c).expect("gone");
        assert!(gone.contains("1 times, and again 0 times"), "{gone}");
        let absent = [Figure { file: "no.json", at: "/x", within: 1.0 }];
        assert!(disagreement(&absent, &a, &b).expect("absent").contains("no.json"));
    }
}
