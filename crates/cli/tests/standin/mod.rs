//! Stand-ins of the right shapes for networks trained by others.

use std::path::Path;

use use3d_golden::torch::{Nesting, Tensors, zip_file};
use use3d_nets::weights::{StandIn, Weights};
use use3d_nets::{NetError, Nu2Net};

/// Records the tensors that a network requests.
struct Recorder(Tensors);

impl Weights for Recorder {
    fn tensor(&mut self, name: &str, shape: &[usize]) -> Result<Vec<f32>, NetError> {
        let values = StandIn.tensor(name, shape)?;
        self.0.insert(name.to_string(), (shape.to_vec(), values.clone()));
        Ok(values)
    }
}

/// Writes weights of Nu2Net into a models folder, under the name of the authors' file.
pub(crate) fn nu2net(models: &Path) {
    let mut recorder = Recorder(Tensors::new());
    Nu2Net::from_weights(&mut recorder).expect("a network");
    std::fs::create_dir_all(models).expect("folder");
    std::fs::write(models.join("uie_proposer.pth"), zip_file(&recorder.0, Nesting::Net)).expect("written");
}
