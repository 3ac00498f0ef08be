//! The configuration behind a scene's numbers: the preset and the changes to it, the 2D enhancer, the
//! calibrator, the depth prior, the water, the steps, the split, the views, the seed.
//!
//! It is shown for every row of the tables, at the top of the report, and in `scores.json`. It is part of no
//! artifact: it is added when results are delivered.

use serde::{Deserialize, Serialize};

use super::names::distinct;

/// The preset whose results may be shown next to the published ones.
const PAPER: &str = "paper";
/// The methods that 3D-USE is compared with: the names of their presets, and those in tables.
const COMPARED: [(&str, &str); 8] = [
    ("3dgs", "3DGS"),
    ("vanilla", "3DGS"),
    ("seasplat", "SeaSplat"),
    ("water-splatting", "WaterSplatting"),
    ("watersplatting", "WaterSplatting"),
    ("plenodium", "Plenodium"),
    ("3d-uir", "3D-UIR"),
    ("marinestd-gs", "MarineSTD-GS"),
];
/// Up to this many different values of one field are listed one by one.
const SHOWN: usize = 3;

/// The configuration behind the numbers of one scene in one variant, as text.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Configuration {
    /// The preset's name; empty for none.
    pub preset: String,
    /// Parameters that differ from the preset or, without one, from the defaults.
    pub changed: Vec<String>,
    /// The proposer of the transitions.
    pub proposer: String,
    /// The calibrator's origin, its pairs, and the share of its correction that was kept.
    pub calibrator: String,
    /// The depth prior in force.
    pub depth_prior: String,
    /// The start of the water.
    pub water: String,
    /// Steps of stage 1 and of stage 2.
    pub steps: String,
    /// The rule by which views were held out, with the digest of their list.
    pub split: String,
    /// Training views and held-out views.
    pub views: String,
    /// The seed.
    pub seed: String,
    /// True if pairs and split are the paper's, too; no preset can set them.
    pub data_of_the_paper: bool,
}

impl Configuration {
    /// True if everything is the paper's, or another method's with its authors' settings on the paper's
    /// split, so that published numbers may be shown next to these.
    pub fn is_the_papers(&self) -> bool {
        let authors = COMPARED.iter().any(|(preset, _)| *preset == self.preset);
        (self.preset == PAPER || authors) && self.changed.is_empty() && self.data_of_the_paper
    }

    /// The method that was trained, if it is one that 3D-USE is compared with.
    pub fn compared_method(&self) -> Option<&'static str> {
        let of = |name: &str| COMPARED.iter().find(|(preset, _)| *preset == name);
        self.preset.split(" + ").find_map(of).map(|(_, method)| *method)
    }

    /// The preset and the changes to it.
    pub fn base(&self) -> String {
        let base = if self.preset.is_empty() { "defaults".into() } else { format!("preset {}", self.preset) };
        if self.changed.is_empty() { base } else { format!("{base}, changed: {}", self.changed.join(", ")) }
    }

    fn fields(&self) -> [(&'static str, String); 9] {
        [
            ("", self.base()),
            ("proposer", self.proposer.clone()),
            ("calibrator", self.calibrator.clone()),
            ("depth prior", self.depth_prior.clone()),
            ("water", self.water.clone()),
            ("steps", self.steps.clone()),
            ("split", self.split.clone()),
            ("views", self.views.clone()),
            ("seed", self.seed.clone()),
        ]
    }

    /// The configurations of several scenes: names of fields with their values. The first field is the base
    /// and has no name. A value that the scenes share is listed once.
    pub fn parts(all: &[&Self]) -> Vec<(&'static str, String)> {
        let Some(first) = all.first() else { return Vec::new() };
        let each: Vec<_> = all.iter().map(|c| c.fields()).collect();
        let parts = first.fields().into_iter().enumerate().filter_map(|(k, (name, _))| {
            let values = each.iter().map(|fields| fields[k].1.as_str());
            let values = distinct(values.filter(|value| !value.is_empty()));
            let text = match values.len() {
                0 => return None,
                1..=SHOWN => values.join(" or "),
                n => format!("{n} different ones"),
            };
            Some((name, text))
        });
        parts.collect()
    }

    /// The configurations of several scenes in one line.
    pub fn told(all: &[&Self]) -> String {
        let parts = Self::parts(all).into_iter().map(|(name, text)| match name {
            "" => text,
            _ => format!("{name}: {text}"),
        });
        parts.collect::<Vec<_>>().join("; ")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_scenes_share_is_said_once_and_a_change_takes_the_papers_name_away() {
        let paper = Configuration {
            preset: "paper".into(),
            proposer: "nu2net".into(),
            seed: "42".into(),
            data_of_the_paper: true,
            ..Configuration::default()
        };
        assert!(paper.is_the_papers());
        let other = Configuration { preset: "water-splatting".into(), ..paper.clone() };
        assert!(other.is_the_papers());
        let of = |views: &str| Configuration { views: views.into(), ..paper.clone() };
        let scenes = ["17 + 3", "21 + 3"].map(of);
        let told = Configuration::told(&scenes.iter().collect::<Vec<_>>());
        assert_eq!(told, "preset paper; proposer: nu2net; views: 17 + 3 or 21 + 3; seed: 42");
        let changed = Configuration { changed: vec!["targets.proposer = fusion".into()], ..paper.clone() };
        assert_eq!(changed.base(), "preset paper, changed: targets.proposer = fusion");
        for other in [
            changed,
            Configuration { preset: String::new(), ..paper.clone() },
            Configuration { data_of_the_paper: false, ..paper },
        ] {
            assert!(!other.is_the_papers());
        }
    }
}
