//! The pipeline files that come with the program. An installed program has no folder `pipelines/` beside it,
//! so they are parts of the program. The file of the paper has parts with names of their own.

use std::path::{Path, PathBuf};

/// The file of the paper.
const PAPER: &str = include_str!("../../../pipelines/paper.toml");
/// The files with captures beside them. They are read where they stand, and not by a bare name.
const PLACED: [(&str, &str); 2] = [
    ("demo", include_str!("../../../pipelines/demo.toml")),
    ("rivals", include_str!("../../../pipelines/rivals.toml")),
];

/// A part of the paper's file: the scenes of some groups in some variants.
struct PaperPart {
    name: &'static str,
    about: &'static str,
    groups: &'static [&'static str],
    /// The variants; an empty list leaves the preset alone, without a variant's name.
    variants: &'static [&'static str],
    /// False for a part that ends with stage 1 and so needs no pairs.
    stage_2: bool,
}

const PARTS: [PaperPart; 6] = [
    PaperPart {
        name: "ablation-stage1",
        about: "The first ablation: the water and the depth prior, on the four SeaThru-NeRF scenes.",
        groups: &["SeaThru-4"],
        variants: &["full", "vanilla", "mlp", "rbf-without-depth", "rbf-without-prior"],
        stage_2: false,
    },
    PaperPart {
        name: "ablation-stage2",
        about: "The second ablation: global and local transitions, and two other ways to use 2D priors.",
        groups: &["SeaThru-4"],
        variants: &["full", "local-only", "global-only", "pseudo-labels", "enhance-then-reconstruct"],
        stage_2: true,
    },
    PaperPart {
        name: "d3-d5",
        about: "The sequences D3 and D5 of Sea-Thru at the paper's size, each in a group of its own.",
        groups: &["D3", "D5"],
        variants: &[],
        stage_2: true,
    },
    PaperPart {
        name: "druva20",
        about: "The twenty scenes of DRUVA at the paper's size.",
        groups: &["DRUVA-20"],
        variants: &[],
        stage_2: true,
    },
    PaperPart {
        name: "seathru4",
        about: "The four SeaThru-NeRF scenes at the paper's size.",
        groups: &["SeaThru-4"],
        variants: &[],
        stage_2: true,
    },
    PaperPart {
        name: "use26",
        about: "All 26 scenes of the paper: SeaThru-4, DRUVA-20, D3 and D5, without the ablations.",
        groups: &["SeaThru-4", "DRUVA-20", "D3", "D5"],
        variants: &[],
        stage_2: true,
    },
];

impl PaperPart {
    fn text(&self) -> String {
        let quoted = |list: &[&str], block: &str, key: &str| {
            list.iter().any(|value| block.lines().any(|line| line == format!("{key} = \"{value}\"")))
        };
        let keeps = |block: &&str| {
            if block.contains("[[scene]]") {
                return quoted(self.groups, block, "group");
            }
            if block.contains("[[variant]]") {
                return quoted(self.variants, block, "name");
            }
            self.stage_2 || !block.contains("[calibrator]")
        };
        let mut blocks = PAPER.split("\n\n").filter(keeps);
        let head = blocks.next().unwrap_or_default();
        let settings = head.find("name = ").map_or("", |at| &head[at..]);
        let settings = settings.replacen("\"paper\"", &format!("\"{}\"", self.name), 1);
        let stage_2 = if self.stage_2 { "" } else { "\nstage2 = false" };
        let Self { name, about, .. } = self;
        let head = format!(
            "#:schema ./schema.json\n# {about} A part of the pipeline of the paper.\n#   DATA=/downloads use3d run {name}\n\
             {settings}{stage_2}"
        );
        let rest = blocks.map(str::trim_end);
        std::iter::once(head.as_str()).chain(rest).collect::<Vec<_>>().join("\n\n") + "\n"
    }
}

/// The names of all shipped files and parts, sorted.
pub fn shipped_names() -> Vec<&'static str> {
    let placed = PLACED.iter().map(|(name, _)| *name);
    let mut names: Vec<&str> = PARTS.iter().map(|part| part.name).chain(placed).chain(["paper"]).collect();
    names.sort_unstable();
    names
}

/// The text of a shipped pipeline; `None` for another name.
pub fn shipped(name: &str) -> Option<String> {
    let placed = PLACED.iter().find(|(known, _)| *known == name).map(|(_, text)| *text);
    match placed.or((name == "paper").then_some(PAPER)) {
        Some(text) => Some(text.to_string()),
        None => PARTS.iter().find(|part| part.name == name).map(PaperPart::text),
    }
}

/// The text of the paper's pipeline, or of a part of it, for a file of its name that is not there, such as
/// `pipelines/use26.toml`.
pub fn shipped_as(file: &Path) -> Option<String> {
    let is_file = file.extension().is_some_and(|end| end == "toml");
    let name = file.file_stem()?.to_str()?;
    if PLACED.iter().any(|(placed, _)| *placed == name) { None } else { shipped(name).filter(|_| is_file) }
}

/// The file that a command means by the bare name of a shipped pipeline.
pub fn shipped_file(target: &Path) -> PathBuf {
    let file = target.with_extension("toml");
    let is_name = target.components().count() == 1 && !target.exists() && target.extension().is_none();
    if is_name && shipped_as(&file).is_some() { file } else { target.to_path_buf() }
}
