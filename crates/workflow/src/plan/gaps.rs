//! The requirements of a batch that are not met: each missing thing once, with the stages and scenes that
//! need it.

use std::fmt::{self, Display, Formatter};

use crate::plan::builder::Builder;
use crate::plan::graph::{Graph, SceneVariant};
use crate::stage::require::{Checks, Lacking};

/// A missing thing, and the stages and scenes that need it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Gap {
    /// The missing thing.
    pub lacking: Lacking,
    /// The stages that need it.
    pub stages: Vec<&'static str>,
    /// The scenes that need it; empty if a stage over all scenes needs it.
    pub scenes: Vec<String>,
}

/// Everything that is missing, each thing once.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Gaps(pub Vec<Gap>);

impl Gaps {
    /// True if nothing is missing.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    fn add(&mut self, lacking: Lacking, stage: &'static str, scene: &str) {
        let known = self.0.iter().position(|gap| gap.lacking == lacking);
        let at = known.unwrap_or_else(|| {
            self.0.push(Gap { lacking, stages: Vec::new(), scenes: Vec::new() });
            self.0.len() - 1
        });
        let gap = &mut self.0[at];
        if !gap.stages.contains(&stage) {
            gap.stages.push(stage);
        }
        if !scene.is_empty() && !gap.scenes.iter().any(|s| s == scene) {
            gap.scenes.push(scene.to_string());
        }
    }
}

/// Most scenes that a line names one by one.
const SHOWN: usize = 3;

impl Display for Gap {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Lacking { what, remedy, without } = &self.lacking;
        write!(f, "{what} (for {}", self.stages.join(", "))?;
        match self.scenes.len() {
            0 => {}
            1..=SHOWN => write!(f, " of {}", self.scenes.join(", "))?,
            n => write!(f, " of {n} scenes")?,
        }
        write!(f, "): {remedy}")?;
        if without.is_empty() { Ok(()) } else { write!(f, "; to run without it: {without}") }
    }
}

impl Display for Gaps {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let count = match self.0.len() {
            1 => "one thing is".to_string(),
            n => format!("{n} things are"),
        };
        write!(f, "{count} missing, and nothing was computed:")?;
        self.0.iter().try_for_each(|gap| write!(f, "\n- {gap}"))?;
        let mut without: Vec<&str> = Vec::new();
        for setting in self.0.iter().map(|gap| gap.lacking.without.as_str()) {
            if !setting.is_empty() && !without.contains(&setting) {
                without.push(setting);
            }
        }
        if without.len() > 1 && self.0.iter().all(|gap| !gap.lacking.without.is_empty()) {
            write!(f, "\nTo run without all of these: {}", without.join(" "))?;
        }
        Ok(())
    }
}

impl Builder {
    /// Lists everything that the wanted nodes of a graph need and do not have. Computes nothing.
    pub fn gaps(&self, graph: &Graph, until: Option<&[String]>, only: Option<&[SceneVariant]>) -> Gaps {
        let mut gaps = self.missing_devices(graph, until, only);
        let checks = Checks(&self.cache.contents);
        let wanted = graph.wanted_of(until, only);
        for (node, _) in graph.nodes.iter().zip(wanted).filter(|(_, wanted)| *wanted) {
            let Some(requires) = &self.registry.stages()[node.stage].requires else { continue };
            for lacking in requires(&node.place.all, &node.place.named, &checks) {
                gaps.add(lacking, node.stage_name, &node.scene);
            }
        }
        gaps
    }

    /// Lists the devices that the wanted nodes of a graph ask for, that this machine does not have, and that
    /// have computed nothing into this cache.
    pub fn missing_devices(
        &self,
        graph: &Graph,
        until: Option<&[String]>,
        only: Option<&[SceneVariant]>,
    ) -> Gaps {
        let mut gaps = Gaps::default();
        let wanted = graph.wanted_of(until, only);
        for (node, _) in graph.nodes.iter().zip(wanted).filter(|(_, wanted)| *wanted && !self.only_looks) {
            let stage = &self.registry.stages()[node.stage];
            let (Some(device), Err(remedy)) = (&stage.device, self.arithmetic(stage, &node.parameters))
            else {
                continue;
            };
            let asked = node.parameters.json().get(device.parameter).and_then(|value| value.as_str());
            let what = format!("the device `{}`", asked.unwrap_or_default());
            gaps.add(Lacking { what, remedy, without: String::new() }, node.stage_name, &node.scene);
        }
        gaps
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_several_need_is_said_once_with_all_of_them() {
        let lacking = |what: &str, without: &str| Lacking {
            what: what.into(),
            remedy: "put a.pth into models".into(),
            without: without.into(),
        };
        let mut gaps = Gaps::default();
        for scene in ["a", "b", "c", "d"] {
            gaps.add(lacking("the weights", "--set x=1"), "targets", scene);
            gaps.add(lacking("the weights", "--set x=1"), "evaluate", scene);
        }
        gaps.add(lacking("the pairs", "--set y=2"), "pairs", "");
        assert_eq!(
            gaps.to_string(),
            "2 things are missing, and nothing was computed:\n- the weights (for targets, evaluate of 4 \
             scenes): put a.pth into models; to run without it: --set x=1\n- the pairs (for pairs): put \
             a.pth into models; to run without it: --set y=2\nTo run without all of these: --set x=1 --set \
             y=2"
        );
        gaps.add(lacking("the truth", ""), "evaluate", "a");
        assert!(!gaps.to_string().contains("run without all"), "not all of it can be done without");
    }
}
