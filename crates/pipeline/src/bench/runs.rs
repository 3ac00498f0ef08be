//! The pipeline that every capture goes through, as the text of a pipeline file.
//!
//! One pipeline per seed, from which captures and trainings both follow. The variant [`DEFAULT`]
//! is this program as it comes; it stands first, so that its stage 1 gives the depth by which
//! all variants are compared. The others are the simple ways and the paper's start of the water;
//! each needs a training of its own.

use std::fmt::Write;

use super::captures::Capture;

/// This program as it comes.
pub const DEFAULT: &str = "default";
/// Nothing is known of the water beforehand: the paper's start.
pub const PRIOR_OFF: &str = "medium-prior-off";
/// Every photograph enhanced on its own, then reconstructed from.
pub const ENHANCE_FIRST: &str = "enhance-then-reconstruct";
/// The scene's appearance fitted to the 2D enhancer's images.
pub const PSEUDO_LABELS: &str = "pseudo-labels";

/// The variants that need trainings of their own, and what they change.
const BASELINES: [(&str, &str); 3] = [
    (PRIOR_OFF, "reconstruct = { medium_prior = \"off\" }"),
    (ENHANCE_FIRST, "reconstruct = { images = \"proposed\", medium = \"none\", medium_prior = \"off\" }"),
    // Its labels are images of photographs, whatever proposes for the scene.
    (PSEUDO_LABELS, "targets = { proposer = \"auto\" }\nenhance = { objective = \"pseudo-labels\" }"),
];

/// Parameters that tell the variants apart: a setting for all variants would make them one.
const APART: [&str; 5] = [
    "reconstruct.medium_prior",
    "reconstruct.images",
    "reconstruct.medium",
    "targets.proposer",
    "enhance.objective",
];

/// The stages whose results the table is made of.
pub const STAGES: [&str; 2] = ["evaluate", "render"];

/// How a table is made.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Recipe {
    /// Photographs per capture.
    pub views: usize,
    /// Their width and height, pixels.
    pub size: (usize, usize),
    /// Steps of stage 1.
    pub iterations: u64,
    /// Whether the baselines that need trainings of their own are run.
    pub baselines: bool,
    /// Further settings, as `--set` takes them.
    pub sets: Vec<String>,
    /// What "enhanced" is learnt from.
    pub learnt_from: LearntFrom,
}

/// What "enhanced" is learnt from. Where the files lie is nobody's business.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LearntFrom {
    /// What the program does without being told.
    #[default]
    Nothing,
    /// Given pairs.
    Pairs,
    /// A given calibrator.
    Calibrator,
}

/// A setting as a word of a command line.
fn word(text: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "._-+=,:/".contains(c);
    if text.chars().all(plain) { text.into() } else { format!("'{}'", text.replace('\'', r"'\''")) }
}

impl Recipe {
    /// Steps of stage 2: a fifth of stage 1's, as in the demo.
    pub fn enhance_iterations(&self) -> u64 {
        (self.iterations / 5).max(1)
    }

    /// The variants, [`DEFAULT`] first.
    pub fn variants(&self) -> Vec<&'static str> {
        let baselines = BASELINES.iter().map(|(name, _)| *name).filter(|_| self.baselines);
        std::iter::once(DEFAULT).chain(baselines).collect()
    }

    /// Checks the settings that would be legal in any other pipeline.
    ///
    /// # Errors
    /// One that says what the table itself decides, with what to do instead.
    pub fn check(&self) -> Result<(), String> {
        for setting in &self.sets {
            let key = setting.split('=').next().unwrap_or_default().trim();
            if key == "seed" {
                return Err(format!(
                    "--set {setting}: captures and trainings follow --seeds; name seeds there"
                ));
            }
            if APART.contains(&key) {
                return Err(format!(
                    "--set {setting}: this would change the baselines too; say `--set variant.{DEFAULT}.{setting}`"
                ));
            }
        }
        Ok(())
    }

    /// The pipeline of one seed, as if it stood in the folder that holds `captures/`.
    pub fn pipeline(&self, captures: &[Capture], seed: u64) -> String {
        let mut text = format!(
            "name = \"truth-seed-{seed}\"\nseed = {seed}\n\n[defaults.reconstruct]\niterations = {}\n\n[defaults.enhance]\niterations = {}\n",
            self.iterations,
            self.enhance_iterations()
        );
        for capture in captures {
            let (name, folder) = (capture.name, capture.folder(seed));
            let _ = write!(
                text,
                "\n[[scene]]\nname = \"{name}\"\ncapture = \"captures/{folder}\"\ngroup = \"truth\"\n"
            );
        }
        let _ = write!(text, "\n[[variant]]\nname = \"{DEFAULT}\"\n");
        for (name, change) in BASELINES.iter().filter(|_| self.baselines) {
            let _ = write!(text, "\n[[variant]]\nname = \"{name}\"\n{change}\n");
        }
        text
    }

    /// The command that makes the table again.
    pub fn command(&self, captures: &[&str], seeds: &[u64]) -> String {
        let seeds: Vec<String> = seeds.iter().map(u64::to_string).collect();
        let (width, height) = self.size;
        let mut text = format!(
            "use3d bench truth --out DIR --captures {} --seeds {} --size {width}x{height} --views {} --iterations {} --baselines {}",
            captures.join(","),
            seeds.join(","),
            self.views,
            self.iterations,
            if self.baselines { "all" } else { "simple" }
        );
        self.sets.iter().for_each(|set| {
            let _ = write!(text, " --set {}", word(set));
        });
        text.push_str(match self.learnt_from {
            LearntFrom::Nothing => "",
            LearntFrom::Pairs => " --pairs INPUT TARGET",
            LearntFrom::Calibrator => " --calibrator FILE",
        });
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bench::captures::CAPTURES;
    use crate::config::{LoadOptions, from_text};
    use crate::stages::registry;
    use use3d_build::Graph;

    fn recipe(baselines: bool) -> Recipe {
        Recipe {
            views: 28,
            size: (320, 180),
            iterations: 2000,
            baselines,
            sets: vec![],
            learnt_from: LearntFrom::Nothing,
        }
    }

    /// The nodes that compute something of their own, by stage.
    fn own(recipe: &Recipe, stage: &str) -> Vec<String> {
        let registry = registry().unwrap();
        let text = recipe.pipeline(&CAPTURES[..2], 5);
        let options = LoadOptions { cache: Some("cache".into()), ..LoadOptions::default() };
        let pipeline = from_text(&registry, &text, "bench/p.toml".as_ref(), &options).unwrap();
        assert_eq!(pipeline.batch.seed, 5);
        let graph = Graph::new(&registry, &pipeline.batch).unwrap();
        let own = graph.nodes.iter().filter(|n| n.stage_name == stage && n.same_as.is_none());
        own.map(|n| format!("{}@{}", n.scene, n.variant)).collect()
    }

    #[test]
    fn the_pipeline_is_one_that_the_program_reads_and_variants_train_what_they_must() {
        let all = own(&recipe(true), "reconstruct");
        assert!(all.contains(&"display-II@enhance-then-reconstruct".to_string()), "{all:?}");
        assert!(!all.iter().any(|n| n.contains(PSEUDO_LABELS)), "its stage 1 is the default's: {all:?}");
        assert!(own(&recipe(true), "enhance").contains(&"display-I@pseudo-labels".to_string()));
        assert!(!own(&recipe(true), "enhance").iter().any(|n| n.contains(ENHANCE_FIRST)));
        assert_eq!(own(&recipe(false), "reconstruct"), ["display-I@default", "display-II@default"]);
        assert_eq!(recipe(false).variants(), [DEFAULT]);
        assert_eq!(recipe(true).variants().len(), 1 + BASELINES.len());
    }

    #[test]
    fn settings_that_would_make_the_baselines_one_are_refused() {
        let with = |set: &str| Recipe { sets: vec![set.into()], ..recipe(true) }.check();
        assert!(with("reconstruct.densify.enabled=false").is_ok());
        assert!(with("variant.default.reconstruct.medium_prior=tracks").is_ok());
        let refused = with("reconstruct.medium_prior=tracks").unwrap_err();
        assert!(refused.contains("--set variant.default.reconstruct.medium_prior=tracks"), "{refused}");
        assert!(with("seed=3").unwrap_err().contains("--seeds"));
        let sets = vec!["a.b=1".into(), "a.c=[0.0, 1]".into()];
        let learnt = Recipe { sets, learnt_from: LearntFrom::Pairs, ..recipe(false) };
        let command = learnt.command(&["air"], &[1, 2]);
        assert!(command.contains("--captures air --seeds 1,2 --size 320x180 --views 28 --iterations 2000"));
        assert!(
            command.ends_with("--baselines simple --set a.b=1 --set 'a.c=[0.0, 1]' --pairs INPUT TARGET"),
            "{command}"
        );
    }
}
