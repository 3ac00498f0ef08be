//! A checkpoint that is no network of this crate: all its tensors by name, and the texts and whole numbers
//! stored with them.
//!
//! The calibrator that the paper's authors released is such a file. The meaning of its tensors is defined in
//! another crate.

use std::collections::BTreeMap;
use std::path::Path;

use crate::checkpoint::Checkpoint;
use crate::error::NetError;
use crate::weights::Weights;

/// The content of a file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Archive {
    /// Name to shape and values (row-major).
    pub tensors: BTreeMap<String, (Vec<usize>, Vec<f32>)>,
    /// Texts and whole numbers at the top of the archive (or in the header of a safetensors file), as text.
    pub labels: BTreeMap<String, String>,
}

impl Archive {
    /// Reads the tensors at the level of `marker`, wherever the state dict is nested. Tensors that are
    /// `unneeded` and everything at other levels are skipped. A file with more than `most` values is refused
    /// before they are read.
    pub fn read(
        path: &Path,
        marker: &str,
        unneeded: &dyn Fn(&str) -> bool,
        most: usize,
    ) -> Result<Self, NetError> {
        let damaged = |message: String| NetError::Damaged { path: path.to_path_buf(), message };
        let mut checkpoint = Checkpoint::open(path)?;
        let labels = checkpoint.labels()?;
        let prefix = checkpoint
            .tensors()
            .find_map(|(name, _)| name.strip_suffix(marker).map(str::to_string))
            .filter(|prefix| prefix.is_empty() || prefix.ends_with('.'))
            .ok_or_else(|| damaged(format!("it has no tensor `{marker}`")))?;
        checkpoint.rename(|name| name.strip_prefix(&prefix).map(str::to_string));
        let wanted: Vec<(String, Vec<usize>)> = checkpoint
            .tensors()
            .filter(|(name, _)| !unneeded(name))
            .map(|(name, shape)| (name.to_string(), shape.to_vec()))
            .collect();
        let count = |shape: &[usize]| shape.iter().try_fold(1usize, |n, side| n.checked_mul(*side));
        let values = wanted.iter().try_fold(0usize, |n, (_, shape)| n.checked_add(count(shape)?));
        if values.is_none_or(|n| n > most) {
            return Err(damaged(format!("its tensors hold more than {most} values")));
        }
        let mut tensors = BTreeMap::new();
        for (name, shape) in wanted {
            let values = checkpoint.tensor(&name, &shape)?;
            tensors.insert(name, (shape, values));
        }
        Ok(Self { tensors, labels })
    }
}
