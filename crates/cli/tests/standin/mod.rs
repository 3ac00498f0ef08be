//! Stand-ins of the right shapes for networks trained by others.

use std::path::Path;

use use3d_golden::torch::{Nesting, Tensors, safetensors_file, zip_file};
use use3d_nets::weights::{StandIn, Weights};
use use3d_nets::{DepthAnythingSize, DepthAnythingV2, Lpips, Musiq, NetError, Nu2Net, Raft, URanker};

/// Records the tensors that a network requests.
struct Recorder(Tensors);

impl Weights for Recorder {
    fn tensor(&mut self, name: &str, shape: &[usize]) -> Result<Vec<f32>, NetError> {
        let values = StandIn.tensor(name, shape)?;
        self.0.insert(name.to_string(), (shape.to_vec(), values.clone()));
        Ok(values)
    }
}

fn recorded(read: impl FnOnce(&mut Recorder) -> Result<(), NetError>) -> Tensors {
    let mut recorder = Recorder(Tensors::new());
    read(&mut recorder).expect("a network");
    recorder.0
}

/// Writes weights of Nu2Net into a models folder, under the name of the authors' file.
pub(crate) fn nu2net(models: &Path) {
    let tensors = recorded(|r| Nu2Net::from_weights(r).map(drop));
    std::fs::create_dir_all(models).expect("folder");
    std::fs::write(models.join("uie_proposer.pth"), zip_file(&tensors, Nesting::Net)).expect("written");
}

/// Writes weights of every network of the paper into a models folder. Depth Anything V2 is there in its
/// smallest size. Files whose official digest is published have the ending `.safetensors`, for which none is.
pub(crate) fn networks(models: &Path) {
    nu2net(models);
    let small = DepthAnythingSize::Small;
    for (file, tensors) in [
        ("depth_anything_v2_vits", recorded(|r| DepthAnythingV2::from_weights(small, r).map(drop))),
        ("alexnet-owt-7be5be79", recorded(|r| Lpips::from_weights(r, &mut StandIn).map(drop))),
        ("alex", recorded(|r| Lpips::from_weights(&mut StandIn, r).map(drop))),
        ("raft_large_C_T_SKHT_V2-ff5fadd5", recorded(|r| Raft::from_weights(r).map(drop))),
        ("URanker_ckpt", recorded(|r| URanker::from_weights(r).map(drop))),
        ("musiq_koniq_ckpt-e95806b9", recorded(|r| Musiq::from_weights(r).map(drop))),
    ] {
        let file = models.join(file).with_extension("safetensors");
        std::fs::write(file, safetensors_file(&tensors)).expect("written");
    }
}

/// Writes a file that can be opened and holds no weights, in place of one that is too large for a stand-in.
pub(crate) fn opens(file: &Path) {
    let tensors = Tensors::from([("pretrained.cls_token".to_string(), (vec![1], vec![0.0]))]);
    std::fs::write(file, zip_file(&tensors, Nesting::Root)).expect("written");
}
