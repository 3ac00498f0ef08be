//! Whether somebody still needs what a shared node makes: a calibrator that no scene can use any more is not
//! computed.

use super::super::resolve::Outcome;
use super::super::stage::Scope;
use super::super::summary::Became;
use super::Runner;

/// Who waits for what a shared node makes.
#[derive(Clone)]
pub(super) enum Need {
    /// No scene was asked for that reads it: it was asked for itself.
    Unasked,
    /// A scene that can be computed.
    Live,
    /// Scenes of which that is not known yet.
    Unknown,
    /// No scene any more; what failed.
    Nobody(String),
}

impl Need {
    /// Of one reader: all that it reads must be there.
    fn and(self, other: Self) -> Self {
        match (self, other) {
            (Self::Nobody(by), _) | (_, Self::Nobody(by)) => Self::Nobody(by),
            (Self::Unknown, _) | (_, Self::Unknown) => Self::Unknown,
            (one, _) => one,
        }
    }

    /// Of several readers: one is enough.
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
    /// Whether some scene that reads a shared node can still be computed: [`Need::Unknown`] until the first
    /// of them has been read in, which is quick beside a calibrator that nobody would use.
    pub(super) fn need(&self, shared: usize) -> Need {
        let nodes = &self.graph.nodes;
        let scope = |i: usize| self.builder.registry.stages()[nodes[i].stage].scope;
        // Inputs come before what reads them: one pass finds all that follows from this node, and how the
        // rest stands.
        let mut follows = vec![false; nodes.len()];
        let mut stands: Vec<Need> = Vec::with_capacity(nodes.len());
        let mut need = Need::Unasked;
        for i in 0..nodes.len() {
            let parents = || nodes[i].inputs.iter().filter_map(|input| input.node());
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
            if follows[i] && scope(i) == Scope::Scene && self.nodes[i].result != Became::Unwanted {
                need = need.or(standing.clone());
            }
            stands.push(standing);
        }
        need
    }
}
