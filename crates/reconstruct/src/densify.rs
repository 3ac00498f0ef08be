//! The parameters of density control.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_numerics::range::{OutOfRange, at_least, not_negative, positive, within};

use crate::density::Children;
use crate::engine::GradientScale;

/// The rules of density control.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Strategy {
    /// Absolute screen gradients, ceilings of opacity with a pause after each, and culling to the end.
    #[default]
    Absolute,
    /// Those of 3D Gaussian Splatting. Opposite screen gradients cancel. Sizes and the rate of centres are
    /// in extents of the cameras: 1.1 times the largest distance of a camera from their mean. Large Gaussians
    /// are removed after the first ceiling, and after growth. There is no pause, and no culling at the end.
    #[serde(rename = "3dgs")]
    Signed,
}

/// The choice of the Gaussians that are split or duplicated.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Candidates {
    /// The mean screen gradient.
    #[default]
    Gradient,
    /// The share of the errors of several rendered views, as many as `gradient` would choose, or as `budget`
    /// leaves room for.
    Error,
}

/// The rules by which Gaussians are added and removed (R9).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Densify {
    /// True if the number of Gaussians changes at all.
    pub enabled: bool,
    /// The rules of density control: this program's own, or those of 3D Gaussian Splatting.
    pub strategy: Strategy,
    /// Gradient statistics are gathered from this step on.
    pub statistics_from: u64,
    /// No refinement up to this step (at most a quarter of the run).
    pub warm_up: u64,
    /// Steps between refinements.
    pub every: u64,
    /// Steps between opacity ceilings.
    pub period: u64,
    /// Longest pause after a ceiling: densification waits until `step mod period` reaches the smaller of this
    /// and the number of training views + `every`.
    pub pause: u64,
    /// Share of the run after which no Gaussians are added.
    pub until: f64,
    /// Mean absolute screen gradient above which a Gaussian is split or duplicated.
    pub gradient_threshold: f64,
    /// With the strategy `3dgs`, the mean absolute screen gradient above which large Gaussians are split.
    /// Small ones are still duplicated by `gradient_threshold`. 0: that one decides on both.
    pub split_threshold: f64,
    /// Pixels of the training images for which `gradient_threshold` is meant (the method's 1400×933). For
    /// other images screen gradients are multiplied by (pixels / this) to the power of `size_exponent`. 0:
    /// never.
    pub reference_pixels: u64,
    /// The exponent of that scale, 0 to 1. With 1/2 a scene grows to about as many Gaussians per pixel at any
    /// size. With less, larger images get fewer per pixel, because four times the pixels rarely show four
    /// times the detail.
    pub size_exponent: f64,
    /// Largest standard deviation up to which it is duplicated rather than split, scene units.
    pub split_scale: f64,
    /// The places of the two children of a split.
    pub split: Children,
    /// Factor by which drawn children of a split are smaller.
    pub shrink: f64,
    /// The choice of the Gaussians that are split or duplicated.
    pub candidates: Candidates,
    /// Number of training views that are rendered before a refinement, for `candidates` and
    /// `split_floor`.
    pub views: usize,
    /// Weight λ of edges in the errors of `candidates = "error"`: an error at a strong edge of the
    /// photograph counts 1 + λ times.
    pub edge_weight: f64,
    /// Number of Gaussians at the end of growth, which follows the square root of the time until then. The
    /// first candidates in their order are split or duplicated, whatever the thresholds. 0: the thresholds
    /// decide on the number.
    pub budget: usize,
    /// Gaussians are not split or duplicated if the children's size on the screen, the geometric mean of
    /// their standard deviations in pixels, would be below this in all rendered views. 0: any are.
    pub split_floor: f64,
    /// Gaussians below this opacity are removed while densifying.
    pub cull_opacity: f64,
    /// The opacity below which Gaussians are removed afterwards, at every refinement to the end.
    pub cull_opacity_late: f64,
    /// A run with a course of fewer steps than this has no ceilings and removes no Gaussians above half of
    /// `initial_opacity`: opacities have no time to rise. 0: runs of any length are alike.
    pub gentle_below: u64,
    /// Gaussians with a standard deviation above this are removed, scene units.
    pub cull_scale: f64,
    /// With the strategy `3dgs`, Gaussians are removed whose radius on the screen was larger than this number
    /// of pixels. 0: never.
    pub cull_screen: f64,
    /// Opacities are lowered to this at every ceiling.
    pub opacity_ceiling: f64,
    /// With the strategy `3dgs`, steps between ceilings of `lower_to`. 0: never.
    pub lower_every: u64,
    /// Opacities are lowered to this at those.
    pub lower_to: f64,
    /// Strength of the noise that moves nearly transparent Gaussians at every ceiling, in steps of centres.
    pub noise: f64,
    /// Culling never leaves fewer Gaussians than this …
    pub floor: usize,
    /// … nor a smaller share of the initial ones.
    pub floor_share: f64,
    /// True if Adam's moments of the water's coefficients are zeroed at every refinement.
    pub reset_medium: bool,
}

impl Default for Densify {
    fn default() -> Self {
        Self {
            enabled: true,
            strategy: Strategy::Absolute,
            statistics_from: 100,
            warm_up: 300,
            every: 50,
            period: 250,
            pause: 125,
            until: 2.0 / 3.0,
            gradient_threshold: 2.05e-3,
            split_threshold: 0.0,
            reference_pixels: 1400 * 933,
            size_exponent: 0.2,
            split_scale: 1e-3,
            split: Children::Drawn,
            shrink: 1.3,
            candidates: Candidates::Gradient,
            views: 8,
            edge_weight: 1.0,
            budget: 0,
            split_floor: 0.0,
            cull_opacity: 0.5,
            cull_opacity_late: 0.1,
            gentle_below: 2000,
            cull_scale: 10.0,
            cull_screen: 0.0,
            opacity_ceiling: 0.45,
            lower_every: 0,
            lower_to: 0.8,
            noise: 0.0,
            floor: 100,
            floor_share: 0.1,
            reset_medium: true,
        }
    }
}

impl Densify {
    /// The scale of screen gradients for the size of the images.
    pub fn gradient_scale(&self) -> GradientScale {
        GradientScale {
            reference_pixels: self.reference_pixels,
            exponent: self.size_exponent,
            signed: self.strategy == Strategy::Signed,
            both: self.compares_both(),
        }
    }

    /// True if signed screen gradients decide on duplicates, and absolute ones on splits.
    pub fn compares_both(&self) -> bool {
        self.strategy == Strategy::Signed && self.split_threshold > 0.0
    }

    /// Checks every range.
    pub(crate) fn validate(&self) -> Result<(), OutOfRange> {
        let d = self;
        let share = |path: &str, value: f64| within(path, value, 0.0, 1.0);
        at_least("densify.every", self.every, 1)?;
        at_least("densify.period", self.period, 1)?;
        share("densify.until", d.until)?;
        share("densify.cull_opacity", d.cull_opacity)?;
        share("densify.cull_opacity_late", d.cull_opacity_late)?;
        share("densify.floor_share", d.floor_share)?;
        at_least("densify.views", d.views as u64, 1)?;
        not_negative("densify.edge_weight", d.edge_weight)?;
        not_negative("densify.split_floor", d.split_floor)?;
        positive("densify.gradient_threshold", d.gradient_threshold)?;
        not_negative("densify.split_threshold", d.split_threshold)?;
        share("densify.size_exponent", d.size_exponent)?;
        positive("densify.split_scale", d.split_scale)?;
        positive("densify.shrink", d.shrink)?;
        positive("densify.cull_scale", d.cull_scale)?;
        not_negative("densify.cull_screen", d.cull_screen)?;
        not_negative("densify.noise", d.noise)?;
        for (path, most) in [("densify.opacity_ceiling", d.opacity_ceiling), ("densify.lower_to", d.lower_to)]
        {
            if !(most > 0.0 && most < 1.0) {
                return Err(OutOfRange::new(path, most, "between 0 and 1"));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use use3d_numerics::math;

    use super::*;

    #[test]
    fn screen_gradients_are_scaled_to_the_size_of_the_images() {
        let d = Densify::default();
        let of = |d: &Densify, width: u32, height: u32| d.gradient_scale().at(f64::from(width * height));
        assert_eq!(of(&d, 1400, 933), 1.0);
        // Half the side: the scale falls by a quarter, and by half in the rule per pixel.
        assert!((of(&d, 700, 933 / 2) - math::powf(0.25f32, 0.2)).abs() < 1e-3);
        let per_pixel = Densify { size_exponent: 0.5, ..d };
        assert!((of(&per_pixel, 700, 933 / 2) - 0.5).abs() < 1e-3);
        assert_eq!(of(&Densify { reference_pixels: 0, ..d }, 320, 180), 1.0);
    }
}
