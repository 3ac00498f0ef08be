//! The models folder: the files that the networks need, the check that they exist, and the check that they
//! are the official ones.
//!
//! Nothing is ever downloaded. A missing file is a [`NetError::NotAvailable`], which names the file and the
//! address where it is published.

use std::io::Read;
use std::path::{Path, PathBuf};

use serde::Serialize;
use sha2::{Digest as _, Sha256};

use crate::checkpoint::{Checkpoint, Shapes};
use crate::depth_anything::{DepthAnythingSize, DepthAnythingV2};
use crate::error::NetError;
use crate::lpips::Lpips;
use crate::musiq::Musiq;
use crate::nu2net::Nu2Net;
use crate::raft::Raft;
use crate::uranker::URanker;
use crate::weights::StandIn;

/// A checkpoint that a network needs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Network {
    /// The proposer as released with 3D-USE.
    Nu2NetReleased,
    /// The proposer as published with UnderwaterRanker.
    Nu2Net,
    /// Depth prior, small.
    DepthAnythingV2Small,
    /// Depth prior, base.
    DepthAnythingV2Base,
    /// Depth prior, large.
    DepthAnythingV2Large,
    /// The linear heads of LPIPS.
    LpipsHeads,
    /// The network below LPIPS.
    AlexNet,
    /// Optical flow.
    RaftLarge,
    /// Underwater quality score.
    URanker,
    /// General quality score.
    Musiq,
    /// The calibrator as released with 3D-USE; not a network for pictures.
    TransitionCalibrator,
}

/// The known properties of a checkpoint.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct CheckpointInfo {
    /// The network.
    pub network: Network,
    /// Its name in tables.
    pub title: &'static str,
    /// Its purpose.
    pub used_for: &'static str,
    /// The file names to look for, in this order; each also with the ending `.safetensors`.
    pub files: &'static [&'static str],
    /// SHA-256 of the official file, if it is published; some names of files end with its first digits.
    #[serde(skip)]
    sha256: Option<&'static str>,
    /// Size of the weights in bytes (files may hold more).
    pub bytes: u64,
    /// Licence of the weights.
    pub licence: &'static str,
    /// The address where the file is published.
    pub origin: &'static str,
}

const UNDERWATER_RANKER: &str = "https://github.com/RQ-Wu/UnderwaterRanker (README: Google Drive or Baidu)";

/// All files that may be in the models folder.
pub const KNOWN: [CheckpointInfo; 11] = [
    CheckpointInfo {
        network: Network::Nu2NetReleased,
        title: "Nu2Net (3D-USE release)",
        used_for: "corrects colours",
        files: &["uie_proposer.pth"],
        sha256: None,
        bytes: 12_583_692,
        licence: "CC BY-NC 4.0",
        origin: "https://github.com/bilityniu/3D-USE (weights/uie_proposer.pth)",
    },
    CheckpointInfo {
        network: Network::Nu2Net,
        title: "Nu2Net",
        used_for: "corrects colours",
        files: &["NU2Net_ckpt.pth"],
        sha256: None,
        bytes: 12_583_692,
        licence: "CC BY-NC 4.0",
        origin: UNDERWATER_RANKER,
    },
    CheckpointInfo {
        network: Network::DepthAnythingV2Small,
        title: "Depth Anything V2 Small",
        used_for: "makes depth maps",
        files: &["depth_anything_v2_vits.pth"],
        sha256: None,
        bytes: 99_140_356,
        licence: "Apache-2.0",
        origin: "https://huggingface.co/depth-anything/Depth-Anything-V2-Small",
    },
    CheckpointInfo {
        network: Network::DepthAnythingV2Base,
        title: "Depth Anything V2 Base",
        used_for: "makes depth maps",
        files: &["depth_anything_v2_vitb.pth"],
        sha256: None,
        bytes: 389_883_140,
        licence: "CC BY-NC 4.0",
        origin: "https://huggingface.co/depth-anything/Depth-Anything-V2-Base",
    },
    CheckpointInfo {
        network: Network::DepthAnythingV2Large,
        title: "Depth Anything V2 Large",
        used_for: "makes depth maps",
        files: &["depth_anything_v2_vitl.pth"],
        sha256: None,
        bytes: 1_341_262_596,
        licence: "CC BY-NC 4.0",
        origin: "https://huggingface.co/depth-anything/Depth-Anything-V2-Large",
    },
    CheckpointInfo {
        network: Network::LpipsHeads,
        title: "LPIPS 0.1 heads",
        used_for: "scores pictures: LPIPS, wLPIPS",
        files: &["alex.pth", "lpips_alex_v0.1.pth", "lpips/weights/v0.1/alex.pth"],
        sha256: Some(LPIPS_HEADS_SHA256),
        bytes: 4_608,
        licence: "BSD-2-Clause",
        origin: "https://github.com/richzhang/PerceptualSimilarity (lpips/weights/v0.1/alex.pth)",
    },
    CheckpointInfo {
        network: Network::AlexNet,
        title: "AlexNet",
        used_for: "scores pictures: LPIPS, wLPIPS",
        files: &["alexnet-owt-7be5be79.pth", "alexnet-owt-4df8aa71.pth"],
        sha256: None,
        bytes: 244_403_360,
        licence: "BSD-3-Clause",
        origin: "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth",
    },
    CheckpointInfo {
        network: Network::RaftLarge,
        title: "RAFT-Large",
        used_for: "scores pictures: wLPIPS",
        files: &[
            "raft_large_C_T_SKHT_V2-ff5fadd5.pth",
            "raft_large_C_T_V2-1bb1363a.pth",
            "raft_large_C_T_SKHT_V1-0b8c9e55.pth",
            "raft_large_C_T_V1-22a6c225.pth",
            "raft_large_C_T_SKHT_K_V2-b5c70766.pth",
            "raft_large_C_T_SKHT_K_V1-4a6a5039.pth",
            "raft-things.pth",
            "raft-sintel.pth",
            "raft-kitti.pth",
            "raft-chairs.pth",
        ],
        sha256: None,
        bytes: 21_041_724,
        licence: "BSD-3-Clause",
        origin: "https://download.pytorch.org/models/raft_large_C_T_SKHT_V2-ff5fadd5.pth",
    },
    CheckpointInfo {
        network: Network::URanker,
        title: "URanker",
        used_for: "scores pictures",
        files: &["URanker_ckpt.pth", "URanker_ckpt-450eb36d.pth"],
        sha256: None,
        bytes: 86_355_292,
        licence: "CC BY-NC 4.0",
        origin: UNDERWATER_RANKER,
    },
    CheckpointInfo {
        network: Network::Musiq,
        title: "MUSIQ (KonIQ)",
        used_for: "scores pictures",
        files: &["musiq_koniq_ckpt-e95806b9.pth"],
        sha256: Some("e95806b9eae5f3814c410f574ba8e552362bd5bc63d758ed5b97860f5d6185aa"),
        bytes: 108_503_300,
        licence: "Apache-2.0 (original), PolyForm Noncommercial 1.0.0 (torch port)",
        origin: "https://huggingface.co/chaofengc/IQA-PyTorch-Weights",
    },
    CheckpointInfo {
        network: Network::TransitionCalibrator,
        title: "Calibrator (3D-USE release)",
        used_for: "calibrator, where [calibrator] file or --calibrator names it",
        files: &["transition_calibrator.pth"],
        sha256: None,
        bytes: 414_584,
        licence: "Pi-Lab License 1.0 (non-commercial)",
        origin: "https://github.com/bilityniu/3D-USE (weights/transition_calibrator.pth)",
    },
];

const LPIPS_HEADS_SHA256: &str = "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0";

/// The result of comparing a file with the official one.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case", tag = "verdict")]
pub enum DigestCheck {
    /// The digest is the official one, as far as it is published (completely, or its first digits in the
    /// file's name).
    Official,
    /// No digest of this file is known.
    Unknown,
    /// The digest differs from the official one.
    Different {
        /// The official digest or its first digits.
        expected: String,
    },
}

/// A file of the models folder.
#[derive(Clone, Debug, Serialize)]
pub struct ModelFile {
    /// The file.
    pub path: PathBuf,
    /// Its size in bytes.
    pub bytes: u64,
    /// Its SHA-256 digest, hexadecimal.
    pub sha256: String,
    /// The comparison with the official file.
    pub verdict: DigestCheck,
}

/// One row of the list of models.
#[derive(Clone, Debug, Serialize)]
pub struct Status {
    /// The known properties of the checkpoint.
    #[serde(flatten)]
    pub known: CheckpointInfo,
    /// The file, if it exists.
    pub found: Option<ModelFile>,
}

/// The models folder.
#[derive(Clone, Debug)]
pub struct Models {
    dir: PathBuf,
}

impl Network {
    /// The known properties of this checkpoint.
    pub fn known(self) -> &'static CheckpointInfo {
        // The table has one row per variant, in the order of declaration; a test checks this.
        &KNOWN[self as usize]
    }
}

impl Models {
    /// The folder with the checkpoints. It need not exist; then no network is available.
    pub fn open(dir: impl Into<PathBuf>) -> Self {
        Self { dir: dir.into() }
    }

    /// The folder.
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// Every checkpoint with the file found for it. Reads each file completely, to compute its digest.
    pub fn status(&self) -> Result<Vec<Status>, NetError> {
        Ok(self.status_while(&|| true)?.unwrap_or_default())
    }

    /// Like [`status`](Self::status), while `go_on` returns true; `None` if it returned false before the end.
    pub fn status_while(&self, go_on: &dyn Fn() -> bool) -> Result<Option<Vec<Status>>, NetError> {
        let mut rows = Vec::with_capacity(KNOWN.len());
        for known in KNOWN {
            let found = match self.find(known.network) {
                None => None,
                Some(path) => match inspect(&known, path, go_on)? {
                    None => return Ok(None),
                    found => found,
                },
            };
            rows.push(Status { known, found });
        }
        Ok(Some(rows))
    }

    /// True if the file of a network exists (its content is not read).
    pub fn has(&self, network: Network) -> bool {
        self.find(network).is_some()
    }

    /// The file of a network, if it exists.
    pub fn find(&self, network: Network) -> Option<PathBuf> {
        // The official file comes first, then the safetensors file of the same name.
        let mut paths = network.known().files.iter().flat_map(|file| {
            let path = self.dir.join(file);
            [path.clone(), path.with_extension("safetensors")]
        });
        paths.find(|path| path.is_file())
    }

    /// Opens the checkpoint of a network. A file whose digest differs from the published one is refused.
    pub fn checkpoint(&self, network: Network) -> Result<Checkpoint, NetError> {
        let known = network.known();
        let path = self.find(network).ok_or_else(|| self.not_available(network))?;
        if expected_digest(known, &path).is_some()
            && let Some(found) = inspect(known, path.clone(), &|| true)?
            && let DigestCheck::Different { expected } = found.verdict
        {
            return Err(NetError::Digest { path, expected, found: found.sha256 });
        }
        let mut checkpoint = Checkpoint::open(&path)?;
        if network == Network::RaftLarge && checkpoint.tensors().any(|(name, _)| name.starts_with("fnet.")) {
            checkpoint.rename(torchvision_name);
        }
        Ok(checkpoint)
    }

    /// Checks the file of a network without reading its values: it is there, has the published digest (if one
    /// is), can be read, and has every tensor in its shape. The shapes of Depth Anything V2 and of the
    /// calibrator are not checked: the first is too large, and the second says its own layout.
    pub fn check(&self, network: Network) -> Result<(), NetError> {
        let checkpoint = self.checkpoint(network)?;
        let mut shapes = Shapes(&checkpoint);
        let mut rest = StandIn;
        match network {
            Network::Nu2NetReleased | Network::Nu2Net => Nu2Net::from_weights(&mut shapes).map(drop),
            Network::LpipsHeads => Lpips::from_weights(&mut rest, &mut shapes).map(drop),
            Network::AlexNet => Lpips::from_weights(&mut shapes, &mut rest).map(drop),
            Network::RaftLarge => Raft::from_weights(&mut shapes).map(drop),
            Network::URanker => URanker::from_weights(&mut shapes).map(drop),
            Network::Musiq => Musiq::from_weights(&mut shapes).map(drop),
            Network::DepthAnythingV2Small
            | Network::DepthAnythingV2Base
            | Network::DepthAnythingV2Large
            | Network::TransitionCalibrator => Ok(()),
        }
    }

    fn not_available(&self, network: Network) -> NetError {
        let known = network.known();
        NetError::NotAvailable {
            network: known.title,
            file: known.files[0],
            dir: self.dir.clone(),
            origin: known.origin,
        }
    }

    fn load<T>(
        &self,
        network: Network,
        read: impl FnOnce(&mut Checkpoint) -> Result<T, NetError>,
    ) -> Result<T, NetError> {
        let mut checkpoint = self.checkpoint(network)?;
        let net = read(&mut checkpoint)?;
        let unused = checkpoint.unused();
        if !unused.is_empty() {
            tracing::debug!(file = %checkpoint.path().display(), tensors = ?unused, "tensors not used");
        }
        Ok(net)
    }

    /// The proposer: the file released with 3D-USE if it exists, else the one of UnderwaterRanker.
    pub fn nu2net(&self) -> Result<Nu2Net, NetError> {
        let network = [Network::Nu2NetReleased, Network::Nu2Net].into_iter().find(|n| self.has(*n));
        match network {
            Some(network) => self.load(network, |w| Nu2Net::from_weights(w)),
            // The message names the one of the two that is published on its own.
            None => Err(self.not_available(Network::Nu2Net)),
        }
    }

    /// Depth Anything V2 in one size.
    pub fn depth_anything_v2(&self, size: DepthAnythingSize) -> Result<DepthAnythingV2, NetError> {
        let network = match size {
            DepthAnythingSize::Small => Network::DepthAnythingV2Small,
            DepthAnythingSize::Base => Network::DepthAnythingV2Base,
            DepthAnythingSize::Large => Network::DepthAnythingV2Large,
        };
        self.load(network, |w| DepthAnythingV2::from_weights(size, w))
    }

    /// LPIPS with AlexNet; needs both files.
    pub fn lpips(&self) -> Result<Lpips, NetError> {
        let mut heads = self.checkpoint(Network::LpipsHeads)?;
        let mut trunk = self.checkpoint(Network::AlexNet)?;
        Lpips::from_weights(&mut trunk, &mut heads)
    }

    /// RAFT-Large, from torchvision's or Princeton's file.
    pub fn raft(&self) -> Result<Raft, NetError> {
        self.load(Network::RaftLarge, |w| Raft::from_weights(w))
    }

    /// URanker.
    pub fn uranker(&self) -> Result<URanker, NetError> {
        self.load(Network::URanker, |w| URanker::from_weights(w))
    }

    /// MUSIQ with the KonIQ weights.
    pub fn musiq(&self) -> Result<Musiq, NetError> {
        self.load(Network::Musiq, |w| Musiq::from_weights(w))
    }
}

/// The published digest of a file, or the published part of it: names like `…-7be5be79.pth` end with its
/// first eight digits.
fn expected_digest(known: &CheckpointInfo, path: &Path) -> Option<String> {
    let name = path.file_name()?.to_str()?;
    if !known.files.iter().any(|file| Path::new(file).file_name() == path.file_name()) {
        return None;
    }
    if let Some(digest) = known.sha256 {
        return Some(digest.to_string());
    }
    let (_, digits) = name.strip_suffix(".pth")?.rsplit_once('-')?;
    let hexadecimal = digits.len() == 8 && digits.bytes().all(|b| b.is_ascii_hexdigit());
    hexadecimal.then(|| digits.to_string())
}

/// Reads a file completely for its digest; `None` if `go_on` returned false before the end.
fn inspect(
    known: &CheckpointInfo,
    path: PathBuf,
    go_on: &dyn Fn() -> bool,
) -> Result<Option<ModelFile>, NetError> {
    let read_error = |source| NetError::Read { path: path.clone(), source };
    let mut file = std::fs::File::open(&path).map_err(read_error)?;
    let mut hasher = Sha256::new();
    let mut buffer = vec![0u8; 1 << 20];
    let mut bytes = 0;
    loop {
        if !go_on() {
            return Ok(None);
        }
        let n = file.read(&mut buffer).map_err(read_error)?;
        if n == 0 {
            break;
        }
        hasher.update(&buffer[..n]);
        bytes += n as u64;
    }
    let sha256: String = hasher.finalize().iter().map(|b| format!("{b:02x}")).collect();
    let verdict = match expected_digest(known, &path) {
        None => DigestCheck::Unknown,
        Some(expected) if sha256.starts_with(&expected) => DigestCheck::Official,
        Some(expected) => DigestCheck::Different { expected },
    };
    Ok(Some(ModelFile { path, bytes, sha256, verdict }))
}

/// Converts Princeton's name of a RAFT tensor to torchvision's; `None` for aliases of tensors that exist
/// under another name.
fn torchvision_name(name: &str) -> Option<String> {
    let parts: Vec<&str> = name.split('.').collect();
    let renamed = match parts[..] {
        [encoder @ ("fnet" | "cnet"), ref rest @ ..] => {
            let encoder = if encoder == "fnet" { "feature_encoder" } else { "context_encoder" };
            let rest = match rest {
                ["conv1", tail] => format!("convnormrelu.0.{tail}"),
                ["norm1", tail] => format!("convnormrelu.1.{tail}"),
                ["conv2", tail] => format!("conv.{tail}"),
                [_, _, "norm3", _] => return None,
                [stage, block, part, tail] => {
                    let part = match *part {
                        "conv1" => "convnormrelu1.0",
                        "norm1" => "convnormrelu1.1",
                        "conv2" => "convnormrelu2.0",
                        "norm2" => "convnormrelu2.1",
                        other => other,
                    };
                    format!("{stage}.{block}.{part}.{tail}")
                }
                other => other.join("."),
            };
            format!("{encoder}.{rest}")
        }
        ["update_block", "encoder", "conv", tail] => format!("update_block.motion_encoder.conv.0.{tail}"),
        ["update_block", "encoder", part, tail] => {
            let part = part.replace("convc", "convcorr").replace("convf", "convflow");
            format!("update_block.motion_encoder.{part}.0.{tail}")
        }
        ["update_block", "gru", part, tail] => {
            let (gate, unit) = part.split_at(part.len().checked_sub(1)?);
            format!("update_block.recurrent_block.convgru{unit}.{gate}.{tail}")
        }
        ["update_block", "mask", "0", tail] => format!("mask_predictor.convrelu.0.{tail}"),
        ["update_block", "mask", "2", tail] => format!("mask_predictor.conv.{tail}"),
        _ => name.to_string(),
    };
    Some(renamed)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_has_one_row_per_network_in_order() {
        for (i, known) in KNOWN.iter().enumerate() {
            assert_eq!(known.network as usize, i, "{}", known.title);
            assert!(!known.files.is_empty());
        }
    }

    #[test]
    fn a_missing_file_is_named_with_its_folder() {
        let models = Models::open("/nonexistent/models");
        let message = models.raft().unwrap_err().to_string();
        assert!(
            message.contains("put raft_large_C_T_SKHT_V2-ff5fadd5.pth into /nonexistent/models"),
            "{message}"
        );
        assert!(matches!(models.nu2net(), Err(NetError::NotAvailable { file: "NU2Net_ckpt.pth", .. })));
        assert!(models.status().unwrap().iter().all(|s| s.found.is_none()));
    }

    #[test]
    fn digests_come_from_the_table_or_the_name() {
        let digest = |network: Network, name: &str| expected_digest(network.known(), Path::new(name));
        assert_eq!(digest(Network::AlexNet, "/m/alexnet-owt-7be5be79.pth").as_deref(), Some("7be5be79"));
        assert_eq!(digest(Network::LpipsHeads, "/m/alex.pth").as_deref(), Some(LPIPS_HEADS_SHA256));
        assert!(digest(Network::Musiq, "musiq_koniq_ckpt-e95806b9.pth").unwrap().starts_with("e95806b9eae5"));
        assert_eq!(digest(Network::RaftLarge, "raft-things.pth"), None);
        assert_eq!(digest(Network::Nu2Net, "NU2Net_ckpt.pth"), None);
        assert_eq!(digest(Network::AlexNet, "alexnet-owt-7be5be79.safetensors"), None);
    }

    #[test]
    fn a_file_with_another_digest_than_its_name_says_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("alexnet-owt-7be5be79.pth"), b"not it").unwrap();
        let models = Models::open(dir.path());
        assert!(matches!(models.checkpoint(Network::AlexNet), Err(NetError::Digest { .. })));
        let status = models.status().unwrap();
        let found = status.iter().find_map(|s| s.found.as_ref()).unwrap();
        assert_eq!(found.verdict, DigestCheck::Different { expected: "7be5be79".into() });
        assert_eq!(found.bytes, 6);
    }

    #[test]
    fn princeton_names_become_torchvision_names() {
        for (from, to) in [
            ("fnet.conv1.weight", "feature_encoder.convnormrelu.0.weight"),
            ("cnet.norm1.running_var", "context_encoder.convnormrelu.1.running_var"),
            ("fnet.conv2.bias", "feature_encoder.conv.bias"),
            ("cnet.layer2.0.norm2.bias", "context_encoder.layer2.0.convnormrelu2.1.bias"),
            ("cnet.layer2.0.downsample.1.weight", "context_encoder.layer2.0.downsample.1.weight"),
            ("update_block.encoder.convc1.weight", "update_block.motion_encoder.convcorr1.0.weight"),
            ("update_block.encoder.convf2.bias", "update_block.motion_encoder.convflow2.0.bias"),
            ("update_block.encoder.conv.bias", "update_block.motion_encoder.conv.0.bias"),
            ("update_block.gru.convq2.weight", "update_block.recurrent_block.convgru2.convq.weight"),
            ("update_block.flow_head.conv1.bias", "update_block.flow_head.conv1.bias"),
            ("update_block.mask.0.weight", "mask_predictor.convrelu.0.weight"),
            ("update_block.mask.2.bias", "mask_predictor.conv.bias"),
        ] {
            assert_eq!(torchvision_name(from).as_deref(), Some(to), "{from}");
        }
        assert_eq!(torchvision_name("cnet.layer3.0.norm3.weight"), None);
    }
}
