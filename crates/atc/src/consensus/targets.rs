//! The targets of a scene, from which stage 2 learns, and their file.
//!
//! The file is one safetensors file: `scene` [3,4] f64, `global_scales` [12] and `local_scales` [6] f64,
//! `mean` [N,6] and `weight` [N] f32, `count` [N] u32, `candidates` [V,3,4] f64. The header records
//! extractor settings (and so the local form), proposer, dispersion, the names of the views, the appearance
//! of the transitions and the share of water in it. A file without these last two describes transitions
//! with all of the water.

use serde::{Deserialize, Serialize};
use use3d_capture::{Appearance, Camera, KeptWater};
use use3d_splat::{Gaussians, Rasterizer};
use use3d_tensors::TensorWriter;

use super::{LocalConsensus, ViewTarget, view_target};
use crate::error::AtcError;
use crate::extractor::{Affine, ExtractorSettings};
use crate::proposers::ProposerId;
use crate::tensors::Reader;

const WHAT: &str = "targets";
const FORMAT: &str = "3d-use targets";
const VERSION: u64 = 1;

/// Fixed targets for one scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Targets {
    /// Extractor settings of the calibrator; stage 2 extracts with the same.
    pub extractor: ExtractorSettings,
    /// The proposer of the proposals.
    pub proposer: ProposerId,
    /// The kind of images that the transitions connect: with water, or of clear radiance.
    pub appearance: Appearance,
    /// The share of the stage-1 water in those images; photographs have all of it.
    pub kept_water: KeptWater,
    /// The scene's global operator minus the identity.
    pub scene: Affine,
    /// Median distance of the views from the consensus.
    pub dispersion: f64,
    /// `s_g`, floored at 10⁻⁴.
    pub global_scales: [f64; 12],
    /// `s_ℓ`, floored at 10⁻⁴.
    pub local_scales: [f64; 6],
    /// Name and global candidate of each view, in the order of fusion.
    pub views: Vec<(String, Affine)>,
    /// The fused local operator of every Gaussian.
    pub state: LocalConsensus,
}

#[derive(Serialize, Deserialize)]
struct TargetsHeader {
    format: String,
    version: u64,
    extractor: ExtractorSettings,
    proposer: ProposerId,
    #[serde(default)]
    appearance: Appearance,
    #[serde(default, skip_serializing_if = "KeptWater::is_all")]
    kept_water: KeptWater,
    dispersion: f64,
    views: Vec<String>,
}

impl Targets {
    /// Number of Gaussians.
    pub fn gaussians(&self) -> usize {
        self.state.mean.len()
    }

    /// True if the global operator and every fused local operator are the identity, to 10⁻⁶.
    pub fn ask_for_no_change(&self) -> bool {
        let least = |v: f64| v.abs() <= 1e-6;
        self.scene.iter().all(|&v| least(v))
            && self.state.mean.as_flattened().iter().all(|&v| least(f64::from(v)))
    }

    /// Returns an error unless the scene has the same number of Gaussians.
    pub fn check_scene(&self, gaussians: &Gaussians) -> Result<(), AtcError> {
        if gaussians.len() == self.gaussians() {
            return Ok(());
        }
        Err(AtcError::TargetsMismatch {
            targets: format!("a scene of {} Gaussians", self.gaussians()),
            found: format!("a scene of {}", gaussians.len()),
        })
    }

    /// The local targets in the view of `camera`, over its operator grid.
    pub fn view_target(
        &self,
        gaussians: &Gaussians,
        camera: &Camera,
        rasterizer: &mut Rasterizer,
    ) -> Result<ViewTarget, AtcError> {
        self.check_scene(gaussians)?;
        let grid = self.extractor.grid(camera.intrinsics.width, camera.intrinsics.height);
        Ok(view_target(gaussians, &self.state, camera, grid, rasterizer))
    }

    /// The bytes of the file; equal targets have equal bytes.
    pub fn to_bytes(&self) -> Result<Vec<u8>, AtcError> {
        let n = self.gaussians();
        let mut writer = TensorWriter::new();
        writer.f64("scene", &[3, 4], &self.scene);
        writer.f64("global_scales", &[12], &self.global_scales);
        writer.f64("local_scales", &[6], &self.local_scales);
        writer.f32("mean", &[n, 6], self.state.mean.as_flattened());
        writer.f32("weight", &[n], &self.state.weight);
        writer.u32("count", &[n], &self.state.count);
        let candidates: Vec<f64> = self.views.iter().flat_map(|(_, t)| *t).collect();
        writer.f64("candidates", &[self.views.len(), 3, 4], &candidates);
        let header = TargetsHeader {
            format: FORMAT.into(),
            version: VERSION,
            extractor: self.extractor.clone(),
            proposer: self.proposer.clone(),
            appearance: self.appearance,
            kept_water: self.kept_water,
            dispersion: self.dispersion,
            views: self.views.iter().map(|(name, _)| name.clone()).collect(),
        };
        writer.finish_with(&header).map_err(|e| AtcError::artifact(WHAT, e.to_string()))
    }

    /// Reads targets from the bytes of a file.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, AtcError> {
        let reader = Reader::new(WHAT, bytes)?;
        let header: TargetsHeader = reader.header(FORMAT, VERSION)?;
        header.extractor.validate().map_err(|e| reader.error(format!("extractor: {e}")))?;
        if !header.kept_water.is_valid() {
            return Err(reader.error("kept_water is not three numbers from 0 to 1"));
        }
        let [n] = reader.sides("count", "one side")?;
        let candidates = reader.f64("candidates", &[header.views.len(), 3, 4])?;
        let array = |name: &str, shape: &[usize]| reader.f64(name, shape);
        let global_scales = array("global_scales", &[12])?;
        let local_scales = array("local_scales", &[6])?;
        if global_scales.iter().chain(&local_scales).any(|&s| s <= 0.0) {
            return Err(reader.error("a scale is not positive"));
        }
        Ok(Self {
            extractor: header.extractor,
            proposer: header.proposer,
            appearance: header.appearance,
            kept_water: header.kept_water,
            scene: fixed(&array("scene", &[3, 4])?),
            dispersion: header.dispersion,
            global_scales: fixed(&global_scales),
            local_scales: fixed(&local_scales),
            views: header
                .views
                .into_iter()
                .zip(candidates.as_chunks::<12>().0)
                .map(|(name, t)| (name, *t))
                .collect(),
            state: LocalConsensus {
                mean: reader.f32("mean", &[n, 6])?.as_chunks::<6>().0.to_vec(),
                weight: reader.f32("weight", &[n])?,
                count: reader.u32("count", &[n])?,
            },
        })
    }
}

/// The first `N` numbers of a slice whose length was checked.
fn fixed<const N: usize>(values: &[f64]) -> [f64; N] {
    std::array::from_fn(|i| values[i])
}
