//! Decides if a shared node is still needed: a calibrator that no scene can use any more is not computed.

use super::Runner;
use crate::plan::graph::NodeInput;
use crate::plan::resolve::Outcome;
use crate::run::summary::NodeResult;
use crate::stage::definition::Scope;

/// The need for a shared node.
#[derive(Clone)]
pub(super) enum Need {
    /// No requested scene reads it: it was requested itself.
    Unasked,
    /// A scene that can be computed needs it.
    Live,
    /// It is not yet known if the scenes that need it can be computed.
    Unknown,
    /// No scene can use it any more; the text names the failure.
    Nobody(String),
}

impl Need {
    /// The need from one reader: all of its inputs must exist.
    fn and(self, other: Self) -> Self {
        match (self, other) {
            (Self::Nobody(by), _) | (_, Self::Nobody(by)) => Self::Nobody(by),
            (Self::Unknown, _) | (_, Self::Unknown) => Self::Unknown,
            (one, _) => one,
        }
    }

    /// The need from several readers: one is enough.
    fn or(self, other: Self) -> Self {
        match (self, other) {
            (Self::Unasked, one) | (one, Self::Unasked) => one,
            (Self::Live, _) | (_, Self::Live) => Self::Live,
            (Self::Unknown, _) | (_, Self::Unknown) => Self::Unknown,
            (one, _) => one,
        }
    }
}

impl Runner<'_> {
    /// The need for a shared node by the scenes that read it. It is [`Need::Unknown`] until the first of them
    /// has been imported, which is quick compared with an unused calibrator.
    pub(super) fn need(&self, shared: usize) -> Need {
        let nodes = &self.graph.nodes;
        let scope = |i: usize| self.builder.registry.stages()[nodes[i].stage].scope;
        // Inputs come before the nodes that read them, so one pass finds all nodes that depend on this node,
        // and the states of the others.
        let mut follows = vec![false; nodes.len()];
        let mut stands: Vec<Need> = Vec::with_capacity(nodes.len());
        let mut need = Need::Unasked;
        for i in 0..nodes.len() {
            let parents = || nodes[i].inputs.iter().filter_map(NodeInput::node);
            follows[i] = i == shared || parents().any(|p| follows[p]);
            let others = parents().filter(|p| !follows[*p]);
            let standing = match &self.outcomes[i] {
                Outcome::Unavailable(by) => Need::Nobody(by.clone()),
                Outcome::Ready(_) => Need::Live,
                Outcome::Open if follows[i] || parents().next().is_some() => {
                    others.fold(Need::Live, |all, p| all.and(stands[p].clone()))
                }
                // Two shared nodes must not wait for each other.
                Outcome::Open if scope(i) == Scope::Shared => Need::Live,
                Outcome::Open => Need::Unknown,
            };
            if follows[i] && scope(i) == Scope::Scene && self.nodes[i].result != NodeResult::Unwanted {
                need = need.or(standing.clone());
            }
            stands.push(standing);
        }
        need
    }
}
