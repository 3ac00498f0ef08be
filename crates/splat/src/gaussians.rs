//! The Gaussians of a scene as a structure of arrays, and the gradients of a loss with respect to them.

/// `N` anisotropic Gaussians with view-dependent colour, as their raw (unconstrained) parameters.
///
/// Every vector has one element per Gaussian. The geometry is `Σ = R(q) S S R(q)ᵀ` with
/// `S = diag(exp(log_scale))`; the opacity is the logistic function of the logit; the colour is
/// `max(0, Σ_k Y_k(ω) sh_k + ½)`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gaussians {
    /// Highest spherical-harmonics degree stored, 0 to 3. Bands above it are zero.
    pub sh_degree: usize,
    /// Centres, world frame, scene units.
    pub means: Vec<[f32; 3]>,
    /// Natural logarithms of the three standard deviations, scene units.
    pub log_scales: Vec<[f32; 3]>,
    /// Rotations `(w, x, y, z)`, not normalised. The zero quaternion is no rotation, and its Gaussian is
    /// never drawn.
    pub quaternions: Vec<[f32; 4]>,
    /// Logits of the opacities.
    pub opacity_logits: Vec<f32>,
    /// Spherical-harmonics coefficients, `[band][rgb]`.
    pub sh: Vec<[[f32; 3]; 16]>,
}

/// An error in a set of Gaussians; the indices name the first Gaussian with the error.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum GaussiansError {
    /// The arrays have different lengths.
    #[error("{field} has {found} entries where means has {expected}")]
    Length {
        /// The array.
        field: &'static str,
        /// Length of `means`.
        expected: usize,
        /// Length found.
        found: usize,
    },
    /// A spherical-harmonics degree above 3.
    #[error("spherical-harmonics degree is {0}; 0 to 3 are supported")]
    Degree(usize),
    /// A parameter that is NaN or infinite.
    #[error("Gaussian {index} has a {field} that is not finite")]
    NotFinite {
        /// The parameter.
        field: &'static str,
        /// Index of the Gaussian.
        index: usize,
    },
    /// A quaternion of norm zero.
    #[error("Gaussian {index} has a zero quaternion, which is no rotation")]
    ZeroQuaternion {
        /// Index of the Gaussian.
        index: usize,
    },
}

impl Gaussians {
    /// No Gaussians, of the given degree.
    pub fn empty(sh_degree: usize) -> Self {
        Self { sh_degree, ..Self::default() }
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// True if there are no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Checks lengths, finiteness and rotations; the error names the first bad index.
    pub fn validate(&self) -> Result<(), GaussiansError> {
        let expected = self.len();
        for (field, found) in [
            ("log_scales", self.log_scales.len()),
            ("quaternions", self.quaternions.len()),
            ("opacity_logits", self.opacity_logits.len()),
            ("sh", self.sh.len()),
        ] {
            if found != expected {
                return Err(GaussiansError::Length { field, expected, found });
            }
        }
        if self.sh_degree > 3 {
            return Err(GaussiansError::Degree(self.sh_degree));
        }
        for index in 0..expected {
            let finite = |values: &[f32]| values.iter().all(|v| v.is_finite());
            for (field, good) in [
                ("mean", finite(&self.means[index])),
                ("log scale", finite(&self.log_scales[index])),
                ("quaternion", finite(&self.quaternions[index])),
                ("opacity logit", self.opacity_logits[index].is_finite()),
                ("spherical-harmonics coefficient", finite(self.sh[index].as_flattened())),
            ] {
                if !good {
                    return Err(GaussiansError::NotFinite { field, index });
                }
            }
            if self.quaternions[index].iter().all(|&v| v == 0.0) {
                return Err(GaussiansError::ZeroQuaternion { index });
            }
        }
        Ok(())
    }

    /// The Gaussians at `indices`, in that order. Panics on an index out of range.
    pub fn select(&self, indices: &[usize]) -> Self {
        fn pick<T: Copy>(from: &[T], indices: &[usize]) -> Vec<T> {
            indices.iter().map(|&i| from[i]).collect()
        }
        Self {
            sh_degree: self.sh_degree,
            means: pick(&self.means, indices),
            log_scales: pick(&self.log_scales, indices),
            quaternions: pick(&self.quaternions, indices),
            opacity_logits: pick(&self.opacity_logits, indices),
            sh: pick(&self.sh, indices),
        }
    }

    /// Appends `other`; the degree becomes the larger of the two.
    pub fn extend(&mut self, other: &Self) {
        self.sh_degree = self.sh_degree.max(other.sh_degree);
        self.means.extend_from_slice(&other.means);
        self.log_scales.extend_from_slice(&other.log_scales);
        self.quaternions.extend_from_slice(&other.quaternions);
        self.opacity_logits.extend_from_slice(&other.opacity_logits);
        self.sh.extend_from_slice(&other.sh);
    }
}

/// Gradients of a loss with respect to every parameter of [`Gaussians`], and the statistics that density
/// control uses.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GaussianGradients {
    /// Gradient with respect to the centres.
    pub means: Vec<[f32; 3]>,
    /// Gradient with respect to the log standard deviations.
    pub log_scales: Vec<[f32; 3]>,
    /// Gradient with respect to the unnormalised quaternions.
    pub quaternions: Vec<[f32; 4]>,
    /// Gradient with respect to the opacity logits.
    pub opacity_logits: Vec<f32>,
    /// Gradient with respect to the spherical-harmonics coefficients. All zero when the view's colours were
    /// given.
    pub sh: Vec<[[f32; 3]; 16]>,
    /// `Σ_p |∂L_p/∂x|, Σ_p |∂L_p/∂y|` with respect to the projected centre, summed over pixels, 1 / pixel:
    /// the absolute-gradient statistic.
    pub screen: Vec<[f32; 2]>,
    /// The sums without the bars with [`Options::signed_screen`](crate::Options); otherwise empty.
    pub signed_screen: Vec<[f32; 2]>,
    /// True if the Gaussian reached the screen (it has at least one tile).
    pub visible: Vec<bool>,
}

impl GaussianGradients {
    /// Zeros for `n` Gaussians.
    pub fn new(n: usize) -> Self {
        let mut gradients = Self::default();
        gradients.resize(n);
        gradients
    }

    /// Changes the number of Gaussians and keeps the allocations; the contents are unspecified afterwards.
    pub fn resize(&mut self, n: usize) {
        self.means.resize(n, [0.0; 3]);
        self.log_scales.resize(n, [0.0; 3]);
        self.quaternions.resize(n, [0.0; 4]);
        self.opacity_logits.resize(n, 0.0);
        self.sh.resize(n, [[0.0; 3]; 16]);
        self.screen.resize(n, [0.0; 2]);
        self.visible.resize(n, false);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn two() -> Gaussians {
        Gaussians {
            sh_degree: 1,
            means: vec![[0.0; 3], [1.0; 3]],
            log_scales: vec![[-1.0; 3]; 2],
            quaternions: vec![[1.0, 0.0, 0.0, 0.0]; 2],
            opacity_logits: vec![0.0, 1.0],
            sh: vec![[[0.1; 3]; 16]; 2],
        }
    }

    #[test]
    fn validation_names_the_first_bad_index() {
        assert_eq!(two().validate(), Ok(()));
        let mut g = two();
        g.sh[1][15][2] = f32::NAN;
        g.quaternions[1] = [0.0; 4];
        assert_eq!(
            g.validate(),
            Err(GaussiansError::NotFinite { field: "spherical-harmonics coefficient", index: 1 })
        );
        g.quaternions[0] = [0.0; 4];
        assert_eq!(g.validate(), Err(GaussiansError::ZeroQuaternion { index: 0 }));
        g.opacity_logits.pop();
        assert_eq!(
            g.validate(),
            Err(GaussiansError::Length { field: "opacity_logits", expected: 2, found: 1 })
        );
        assert_eq!(Gaussians::empty(4).validate(), Err(GaussiansError::Degree(4)));
    }

    #[test]
    fn select_and_extend_move_whole_gaussians() {
        let mut g = two();
        let swapped = g.select(&[1, 0]);
        assert_eq!(swapped.means, [[1.0; 3], [0.0; 3]]);
        g.extend(&swapped);
        assert_eq!(g.len(), 4);
        assert_eq!(g.select(&[2, 3]), swapped);
        assert_eq!(g.validate(), Ok(()));
    }
}
