//! Checkpoints of the networks with stand-in weights, in every container format.

use std::path::Path;

pub(crate) use use3d_golden::torch::{
    Nesting, Pickle, Tensors, legacy_file, legacy_with_pickle, safetensors_file, zip_file, zip_with_pickle,
};
use use3d_nets::weights::{StandIn, Weights};
use use3d_nets::{Checkpoint, Lpips, NetError};

/// Records every tensor that a network reads, with stand-in values.
#[derive(Default)]
pub(crate) struct Recorder(Tensors);

impl Weights for Recorder {
    fn tensor(&mut self, name: &str, shape: &[usize]) -> Result<Vec<f32>, NetError> {
        let values = StandIn.tensor(name, shape)?;
        self.0.insert(name.to_string(), (shape.to_vec(), values.clone()));
        Ok(values)
    }
}

/// The tensors of a network.
pub(crate) fn recorded(read: impl FnOnce(&mut Recorder) -> Result<(), NetError>) -> Tensors {
    let mut recorder = Recorder::default();
    read(&mut recorder).unwrap();
    recorder.0
}

/// The tensors of the LPIPS heads, a small checkpoint.
pub(crate) fn heads() -> Tensors {
    recorded(|r| Lpips::from_weights(&mut StandIn, r).map(drop))
}

pub(crate) fn open(dir: &Path, bytes: &[u8]) -> Result<Checkpoint, NetError> {
    let path = dir.join("file.pth");
    std::fs::write(&path, bytes).unwrap();
    Checkpoint::open(&path)
}

/// Opens a file and reads all tensors named in `tensors`.
pub(crate) fn read_all(dir: &Path, bytes: &[u8], tensors: &Tensors) -> Result<Tensors, NetError> {
    let mut checkpoint = open(dir, bytes)?;
    let mut out = Tensors::new();
    for (name, (shape, _)) in tensors {
        out.insert(name.clone(), (shape.clone(), checkpoint.tensor(name, shape)?));
    }
    Ok(out)
}
