//! The table of stages, checked when it is built.

use std::collections::{BTreeMap, BTreeSet};

use crate::cache::canonical;
use crate::error::BuildError;
use crate::stage::definition::{Input, Scope, Source, Stage};
use use3d_code::{CodeTable, StageCode};

/// The stages in the order in which data flows through them.
#[derive(Clone, Debug)]
pub struct Registry {
    stages: Vec<Stage>,
    code: Vec<StageCode>,
    shorthands: Vec<Shorthand>,
    switches: Vec<Switch>,
}

/// A key of the pipeline file, of a scene and of a variant that leaves out stages if it is `false`. Stages
/// that cannot do without one of them are left out, too. It is part of no artifact's key.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Switch {
    /// The key.
    pub key: &'static str,
    /// Its meaning, for people.
    pub about: &'static str,
    /// The stages.
    pub stages: &'static [&'static str],
}

/// A key of the pipeline file that is short for a parameter of a stage, e.g. a scene's `size` for
/// `import.size`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shorthand {
    /// The table that contains it: `scene`, `calibrator`, `models`, or empty for the top level.
    pub place: &'static str,
    /// The key in that table.
    pub key: &'static str,
    /// The stage.
    pub stage: &'static str,
    /// The parameter, dotted.
    pub parameter: &'static str,
}

impl Registry {
    /// Creates a table of these stages, with their code from `table`. A stage's inputs must come from stages
    /// before it; its roles must be unique; a shared stage must read only shared ones; the code that a stage
    /// names must exist.
    ///
    /// # Errors
    /// Stages that do not fit together, or that name code that does not exist.
    pub fn new(stages: Vec<Stage>, table: &CodeTable) -> Result<Self, BuildError> {
        for (i, stage) in stages.iter().enumerate() {
            check(stage, &stages[..i])?;
            let external =
                |s: &Stage| s.inputs.iter().any(|input| input.source == Source::External(stage.name));
            if stages.iter().any(external) {
                let wrong = format!("`{}` names an input from outside and a stage", stage.name);
                return Err(BuildError::Registry(wrong));
            }
        }
        let code = stages.iter().map(|stage| {
            let own = format!("src/{}.rs", stage.name);
            let has_own = table.files().any(|file| file == own);
            let own: &[&str] = if has_own { &[&own] } else { &[] };
            let code = table.stage(stage.crates, stage.sources.unwrap_or(own));
            code.map_err(|source| BuildError::Code { stage: stage.name.to_string(), source })
        });
        Ok(Self {
            code: code.collect::<Result<_, _>>()?,
            stages,
            shorthands: Vec::new(),
            switches: Vec::new(),
        })
    }

    /// The files that every artifact of a stage has, by stage.
    pub fn promises(&self) -> BTreeMap<&'static str, &'static [&'static str]> {
        self.stages.iter().map(|stage| (stage.name, stage.promises)).collect()
    }

    /// Adds a shorthand. If several have the same place and key, the value sets all their parameters.
    #[must_use]
    pub fn shorthand(
        mut self,
        place: &'static str,
        key: &'static str,
        stage: &'static str,
        parameter: &'static str,
    ) -> Self {
        self.shorthands.push(Shorthand { place, key, stage, parameter });
        self
    }

    /// Adds a switch.
    #[must_use]
    pub fn switch(mut self, key: &'static str, stages: &'static [&'static str], about: &'static str) -> Self {
        self.switches.push(Switch { key, about, stages });
        self
    }

    /// The switches.
    pub fn switches(&self) -> &[Switch] {
        &self.switches
    }

    /// The switch of a key.
    pub fn switch_of(&self, key: &str) -> Option<&Switch> {
        self.switches.iter().find(|switch| switch.key == key)
    }

    /// The stages that are left out together with those of a switch.
    pub(crate) fn switched(&self, switch: &Switch) -> BTreeSet<&'static str> {
        let mut off: BTreeSet<&'static str> = switch.stages.iter().copied().collect();
        for stage in self.stages.iter().filter(|stage| stage.scope != Scope::Batch) {
            let lacks = |input: &Input| {
                let from = if let Source::Stage(from) = input.source { from } else { return false };
                let needed = !input.optional && input.needed.is_none() && input.instead.is_none();
                needed && off.contains(from)
            };
            if stage.inputs.iter().any(lacks) {
                off.insert(stage.name);
            }
        }
        off
    }

    /// The stages.
    pub fn stages(&self) -> &[Stage] {
        &self.stages
    }

    /// The stages that have parameters of their own.
    pub fn sections(&self) -> impl Iterator<Item = &Stage> + Clone {
        self.stages.iter().filter(|stage| stage.section() == stage.name)
    }

    /// The shorthands.
    pub fn shorthands(&self) -> &[Shorthand] {
        &self.shorthands
    }

    /// A stage by name.
    pub fn stage(&self, name: &str) -> Result<&Stage, BuildError> {
        Ok(&self.stages[self.index(name)?])
    }

    /// The index of a stage in the table.
    pub(crate) fn index(&self, name: &str) -> Result<usize, BuildError> {
        let found = self.stages.iter().position(|s| s.name == name);
        found.ok_or_else(|| BuildError::unknown("stage", name, self.stages.iter().map(|s| s.name)))
    }

    /// A stage and all stages that its result follows from, in the order of the table.
    pub fn upstream(&self, name: &str) -> impl Iterator<Item = &Stage> {
        let mut reached = vec![false; self.stages.len()];
        for (i, stage) in self.stages.iter().enumerate().rev() {
            reached[i] |= stage.name == name;
            let inputs = if reached[i] { &stage.inputs[..] } else { &[] };
            for input in inputs {
                if let Source::Stage(from) | Source::Reference(from) = input.source {
                    self.stages.iter().zip(&mut reached).for_each(|(s, r)| *r |= s.name == from);
                }
            }
        }
        self.stages.iter().zip(reached).filter_map(|(stage, reached)| reached.then_some(stage))
    }

    /// The code of the stage of that name.
    pub fn code_of(&self, name: &str) -> Result<&StageCode, BuildError> {
        Ok(&self.code[self.index(name)?])
    }

    /// The code of a stage.
    pub(crate) fn code(&self, index: usize) -> &StageCode {
        &self.code[index]
    }
}

fn check(stage: &Stage, before: &[Stage]) -> Result<(), BuildError> {
    let name = stage.name;
    let wrong = |what: String| Err(BuildError::Registry(what));
    if name.is_empty() || !name.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-') {
        return wrong(format!("`{name}`: a stage's name is lower-case letters, digits and hyphens"));
    }
    if ["scene", "variant", "defaults", "name", "group", "seed"].contains(&name) {
        return wrong(format!("`{name}` is a word of the pipeline file, not a name for a stage"));
    }
    if before.iter().any(|s| s.name == name) {
        return wrong(format!("two stages are called `{name}`"));
    }
    if let Ok(defaults) = stage.parameters(&serde_json::json!({})) {
        let mut named = stage.without_effect.iter().chain(stage.length_like);
        if let Some(path) = named.find(|path| canonical::at(defaults.json(), path).is_none()) {
            return wrong(format!("stage `{name}` has no parameter `{path}`"));
        }
    }
    for (i, input) in stage.inputs.iter().enumerate() {
        if stage.inputs[..i].iter().any(|other| other.role == input.role) {
            return wrong(format!("stage `{name}` has two inputs called `{}`", input.role));
        }
        let (Source::Stage(from) | Source::Reference(from)) = input.source else { continue };
        let Some(from) = before.iter().find(|s| s.name == from) else {
            return wrong(format!("stage `{name}` reads `{from}`, which is not a stage before it"));
        };
        let fits = match stage.scope {
            Scope::Shared => from.scope == Scope::Shared,
            Scope::Scene => from.scope != Scope::Batch,
            Scope::Batch => true,
        };
        if !fits {
            return wrong(format!(
                "stage `{name}` is made once {} and cannot read `{}`, which is made once {}",
                per(stage.scope),
                from.name,
                per(from.scope)
            ));
        }
    }
    Ok(())
}

fn per(scope: Scope) -> &'static str {
    match scope {
        Scope::Scene => "per scene",
        Scope::Shared => "for all scenes",
        Scope::Batch => "per batch",
    }
}
