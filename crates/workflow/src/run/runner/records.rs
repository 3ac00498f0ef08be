//! The records of nodes from run to run: the ingredients of the last result, and the last failure.

use super::Runner;
use crate::cache::artifacts::Artifact;
use crate::cache::key::Key;
use crate::cache::machine;
use crate::cache::manifest::Manifest;
use crate::error::StageError;
use crate::plan::history::{Failure, Made, Record};
use crate::plan::resolve::Outcome;
use crate::run::summary::NodeResult;
use crate::stage::events::Event;
use serde::Deserialize;
use serde::de::IgnoredAny;
use use3d_code::digest::Digest;

/// The parts of a node's record that matter during a run. The whole record is read only to change it.
#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(from = "RecordHead")]
pub(super) struct LastResult {
    /// The key and content of its last artifact.
    pub(super) last: Option<(Key, Digest)>,
    pub(super) failed: bool,
}

/// The fields of a [`Record`] that a [`LastResult`] needs.
#[derive(Deserialize)]
struct RecordHead {
    last: Option<LastArtifact>,
    failure: Option<IgnoredAny>,
}

#[derive(Deserialize)]
struct LastArtifact {
    key: Key,
    content: Digest,
}

impl From<RecordHead> for LastResult {
    fn from(record: RecordHead) -> Self {
        let last = record.last.map(|made| (made.key, made.content));
        Self { last, failed: record.failure.is_some() }
    }
}

impl Runner<'_> {
    /// Ends a node without a result; the failure and its log are kept for `status`, and the batch stops
    /// unless it is to continue.
    pub(super) fn fail(&mut self, i: usize, key: Option<Key>, error: &StageError) {
        self.held.remove(&i);
        let reason = error.to_string();
        let node = &self.graph.nodes[i];
        let log = self.builder.cache.log_path(&self.graph.name, node);
        let label = self.nodes[i].label.clone();
        self.listener.event(&Event::Failed { node: i, label: &label, reason: &reason, log: &log });
        let mut record = self.builder.cache.record(&self.graph.name, node);
        let at = machine::utc(machine::now());
        let task = self.builder.cache.node.task.clone();
        record.failure = Some(Failure { key, reason: reason.clone(), log: log.clone(), at, task });
        self.write_record(i, &record);
        self.nodes[i].result = NodeResult::Failed { reason, log, bad_input: error.is_bad_input() };
        self.known[i].failed = true;
        self.outcomes[i] = Outcome::Unavailable(label);
        self.over(i);
        self.halted |= !self.options.keep_going;
    }

    /// Records the ingredients of a node's result; the earlier record is kept, to show the changes.
    pub(super) fn record_made(&mut self, i: usize, artifact: &Artifact) {
        let Manifest { key, content, ref ingredients, .. } = artifact.manifest;
        let same = self.known[i].last == Some((key, content));
        if same && !self.known[i].failed {
            return;
        }
        let mut record = self.builder.cache.record(&self.graph.name, &self.graph.nodes[i]);
        record.failure = None;
        if !record.last.as_ref().is_some_and(|last| last.key == key && last.content == content) {
            let at = machine::utc(machine::now());
            let old = record.last.replace(Made { key, ingredients: ingredients.clone(), content, at });
            record.before = old.filter(|o| o.key != key).or(record.before);
        }
        self.known[i] = LastResult { last: Some((key, content)), failed: false };
        self.write_record(i, &record);
    }

    fn write_record(&self, i: usize, record: &Record) {
        // The artifact counts; its record is not essential.
        if let Err(error) = self.builder.cache.write_record(&self.graph.name, &self.graph.nodes[i], record) {
            self.warn(i, &error.to_string());
        }
    }

    /// Warns if an artifact was lost and came out different when the same key was computed again.
    pub(super) fn warn_if_changed(&self, i: usize, artifact: &Artifact) {
        let manifest = &artifact.manifest;
        let other = |(key, content)| key == manifest.key && content != manifest.content;
        let varies = self.builder.registry.stages()[self.graph.nodes[i].stage].varies;
        if !varies && self.known[i].last.is_some_and(other) {
            self.warn(i, "determinism alarm: computed again for the same key, it has other bytes");
        }
    }
}
