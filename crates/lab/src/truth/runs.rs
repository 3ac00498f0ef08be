//! The pipeline that every capture goes through, as the text of a pipeline file.
//!
//! There is one pipeline per seed; the seed determines both captures and trainings. The variant [`DEFAULT`]
//! is this program with its default settings. It comes first, so that its stage 1 supplies the depth by which
//! all variants are compared. The others are the simple methods, the paper's start of the water, and the
//! methods that the paper compares with; each needs a training of its own.

use std::fmt::Write;

use super::captures::Capture;
use use3d_config::METHODS;
use use3d_pipeline::WorkError;

/// This program with its default settings.
pub const DEFAULT: &str = "default";
/// Nothing is known of the water at the start, as in the paper.
pub const PRIOR_OFF: &str = "medium-prior-off";
/// Every photograph is enhanced on its own, and the scene is reconstructed from these images.
pub const ENHANCE_FIRST: &str = "enhance-then-reconstruct";
/// The scene's appearance is fitted to the 2D enhancer's images.
pub const PSEUDO_LABELS: &str = "pseudo-labels";

/// The method of the variant [`DEFAULT`].
const OWN: &str = "3d-use";

/// The methods of other authors: the names of their variants.
pub fn others() -> impl Iterator<Item = &'static str> {
    METHODS.iter().copied().filter(|method| *method != OWN)
}

/// The variants that need trainings of their own, and the parameters that they change.
const BASELINES: [(&str, &str); 3] = [
    (PRIOR_OFF, "reconstruct = { medium_prior = \"off\" }"),
    (ENHANCE_FIRST, "reconstruct = { images = \"proposed\", medium = \"none\", medium_prior = \"off\" }"),
    // Its labels are enhanced photographs, whatever the proposer of the scene.
    (PSEUDO_LABELS, "targets = { proposer = \"auto\" }\nenhance = { objective = \"pseudo-labels\" }"),
];

/// Parameters that distinguish the variants: a setting for all variants would make them equal.
const APART: [&str; 5] = [
    "reconstruct.medium_prior",
    "reconstruct.images",
    "reconstruct.medium",
    "targets.proposer",
    "enhance.objective",
];

/// The stages whose results the table is made of.
pub const STAGES: [&str; 2] = ["evaluate", "render"];

/// The settings of a table.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Recipe {
    /// Photographs per capture.
    pub views: usize,
    /// Their width and height, pixels.
    pub size: (usize, usize),
    /// Steps of stage 1.
    pub iterations: u64,
    /// True if the baselines that need trainings of their own are run.
    pub baselines: bool,
    /// True if the methods of other authors are trained too.
    #[serde(default)]
    pub methods: bool,
    /// Further settings, in the form of `--set`.
    pub sets: Vec<String>,
    /// The source of the meaning of "enhanced".
    pub learnt_from: LearntFrom,
}

/// The source of the meaning of "enhanced". The paths of the files are not recorded.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LearntFrom {
    /// The program's default.
    #[default]
    Nothing,
    /// Given pairs.
    Pairs,
    /// A given calibrator.
    Calibrator,
}

/// A setting as a word of a command line, quoted if needed.
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
        std::iter::once(DEFAULT).chain(baselines).chain(others().filter(|_| self.methods)).collect()
    }

    /// Refuses settings that any other pipeline would accept, but that conflict with the table.
    ///
    /// # Errors
    /// A setting is decided by the table itself.
    pub fn check(&self) -> Result<(), WorkError> {
        for setting in &self.sets {
            let key = setting.split('=').next().unwrap_or_default().trim();
            if key == "seed" {
                return Err(WorkError::Input(format!(
                    "--set {setting}: captures and trainings follow --seeds; name seeds there"
                )));
            }
            if APART.contains(&key) {
                return Err(WorkError::Input(format!(
                    "--set {setting}: this would change the baselines too; say `--set variant.{DEFAULT}.{setting}`"
                )));
            }
        }
        Ok(())
    }

    /// The pipeline file of one seed, as if it were in the folder that holds `captures/`.
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
        for method in others().filter(|_| self.methods) {
            let _ = write!(text, "\n[[variant]]\nname = \"{method}\"\nmethod = \"{method}\"\n");
        }
        text
    }

    /// The command that reproduces the table.
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
        if self.methods {
            text.push_str(" --methods");
        }
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
    use crate::truth::captures::CAPTURES;
    use use3d_config::{LoadOptions, from_text};
    use use3d_stages::registry;
    use use3d_workflow::Graph;

    fn recipe(baselines: bool) -> Recipe {
        Recipe {
            views: 28,
            size: (320, 180),
            iterations: 2000,
            baselines,
            methods: false,
            sets: vec![],
            learnt_from: LearntFrom::Nothing,
        }
    }

    /// The nodes that are computed and not shared with another node, by stage.
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
        let methods = Recipe { methods: true, ..recipe(false) };
        assert_eq!(methods.variants().len(), METHODS.len());
        let trained = own(&methods, "reconstruct");
        assert_eq!(trained.len(), 2 * METHODS.len(), "{trained:?}");
        assert!(own(&methods, "enhance").iter().all(|node| node.ends_with("@default")));
        assert!(methods.command(&["air"], &[1]).ends_with("--baselines simple --methods"));
    }

    #[test]
    fn settings_that_would_make_the_baselines_one_are_refused() {
        let with = |set: &str| Recipe { sets: vec![set.into()], ..recipe(true) }.check();
        assert!(with("reconstruct.densify.enabled=false").is_ok());
        assert!(with("variant.default.reconstruct.medium_prior=tracks").is_ok());
        let refused = with("reconstruct.medium_prior=tracks").unwrap_err().to_string();
        assert!(refused.contains("--set variant.default.reconstruct.medium_prior=tracks"), "{refused}");
        assert!(with("seed=3").unwrap_err().to_string().contains("--seeds"));
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
