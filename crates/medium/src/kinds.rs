//! The one table of media. A medium is a file that implements [`Medium`], and a row of this table. The row
//! defines its name in files and parameters, the way in which images are formed in it, its variant of the
//! enum of models, and the dispatch of every call.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_capture::{Camera, Formation, Lattice, MediumMaps};

use crate::medium::{Anchors, Harmonics, Medium, MediumStart};
use crate::tensors::{Tensor, Tensors};
use crate::{
    Coefficients, MediumError, MediumGlobal, MediumMlp, MediumPerView, MediumRbf, MediumSeasplat, MediumUir,
    Role,
};

/// Makes models, kinds and calls from the table's rows. There is no row for no water: it has no parameters
/// and nothing to compute.
macro_rules! media {
    ($($(#[$doc:meta])* $kind:ident($model:ty, $formation:ident) = $name:literal;)+) => {
        /// A model of the water.
        #[allow(clippy::large_enum_variant, reason = "a scene has one, so its size on the stack does not matter")]
        #[derive(Clone, Debug, PartialEq)]
        pub enum MediumModel {
            $($(#[$doc])* $kind($model),)+
            /// No water: plain Gaussian splatting.
            None,
        }

        /// The model of the water that is fitted.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
        #[schemars(rename = "Medium")]
        pub enum MediumKind {
            $($(#[$doc])* #[serde(rename = $name)] $kind,)+
            /// No water: plain Gaussian splatting.
            #[serde(rename = "none")]
            None,
        }

        impl MediumKind {
            /// Every kind, in the table's order.
            pub const ALL: &[Self] = &[$(Self::$kind,)+ Self::None];

            /// The name in files and parameters.
            pub fn name(self) -> &'static str {
                match self {
                    $(Self::$kind => $name,)+
                    Self::None => "none",
                }
            }

            /// The way in which images are formed in water of this kind.
            pub fn formation(self) -> Formation {
                match self {
                    $(Self::$kind => Formation::$formation,)+
                    Self::None => Formation::default(),
                }
            }

            /// True if a model of this kind can start from given spherical harmonics.
            pub fn starts_from_harmonics(self) -> bool {
                match self {
                    $(Self::$kind => <$model as Medium>::FROM_HARMONICS,)+
                    Self::None => false,
                }
            }
        }

        impl MediumModel {
            /// A model in its initial state.
            pub fn start(kind: MediumKind, start: &MediumStart) -> Result<Self, MediumError> {
                Ok(match kind {
                    $(MediumKind::$kind => Self::$kind(Medium::start(start)?),)+
                    MediumKind::None => Self::None,
                })
            }

            /// A model that starts with the same harmonics everywhere; `None` if its kind does not consist
            /// of harmonics.
            pub fn start_from(
                kind: MediumKind,
                start: &MediumStart,
                coefficients: &Coefficients,
            ) -> Result<Option<Self>, MediumError> {
                if !kind.starts_from_harmonics() {
                    return Ok(None);
                }
                let mut model = Self::start(kind, start)?;
                match &mut model {
                    $(Self::$kind(m) => m.set_harmonics(coefficients),)+
                    Self::None => {}
                }
                Ok(Some(model))
            }

            /// The kind of this model.
            pub fn kind(&self) -> MediumKind {
                match self {
                    $(Self::$kind(_) => MediumKind::$kind,)+
                    Self::None => MediumKind::None,
                }
            }

            /// Computes the maps of one view on a lattice of its pixels. Spherical-harmonic bands above
            /// `active_degree` (0 to 3) are left out; a model without bands ignores this limit. Without
            /// water all maps are zero.
            pub fn maps(&self, camera: &Camera, lattice: &Lattice, active_degree: usize, out: &mut MediumMaps) {
                out.formation = self.kind().formation();
                out.network = None;
                match self {
                    $(Self::$kind(m) => m.maps(camera, lattice, active_degree.min(3), out),)+
                    Self::None => {
                        out.resize(lattice.width(), lattice.height());
                        for image in [&mut out.color, &mut out.backscatter, &mut out.attenuation] {
                            image.data_mut().fill(0.0);
                        }
                    }
                }
            }

            /// Adds to `gradient` the gradient of `<d_maps, maps>` with respect to every parameter. `maps`
            /// must be the result of [`MediumModel::maps`] for the same arguments; `gradient` has this
            /// model's kind and size ([`MediumModel::zeros_like`]).
            pub fn backward(
                &self,
                camera: &Camera,
                lattice: &Lattice,
                active_degree: usize,
                maps: &MediumMaps,
                d_maps: &MediumMaps,
                gradient: &mut Self,
            ) {
                let degree = active_degree.min(3);
                match (self, gradient) {
                    $((Self::$kind(m), Self::$kind(gradient)) => {
                        m.backward(camera, lattice, degree, maps, d_maps, gradient);
                    })+
                    (this, gradient) => {
                        debug_assert_eq!(this.kind(), gradient.kind(), "a gradient has its model's kind");
                    }
                }
            }

            /// The parameters in order, as runs of one role each.
            pub fn groups(&self) -> Vec<(Role, &[f32])> {
                match self {
                    $(Self::$kind(m) => m.groups(),)+
                    Self::None => Vec::new(),
                }
            }

            pub(crate) fn groups_mut(&mut self) -> Vec<(Role, &mut [f32])> {
                match self {
                    $(Self::$kind(m) => m.groups_mut(),)+
                    Self::None => Vec::new(),
                }
            }

            /// The model's tensors.
            pub fn to_tensors(&self) -> Tensors {
                let mut tensors = Tensors::new();
                let mut put = |name: &str, shape: &[usize], values: &[f32]| {
                    tensors.insert(name.into(), Tensor { shape: shape.to_vec(), values: values.to_vec() });
                };
                match self {
                    $(Self::$kind(m) => m.write(&mut put),)+
                    Self::None => {}
                }
                tensors
            }

            /// Makes the model of `kind` from its tensors; only anchored models use `top_k`. Shapes and
            /// finiteness are checked.
            pub fn from_tensors(kind: MediumKind, top_k: usize, tensors: &Tensors) -> Result<Self, MediumError> {
                Ok(match kind {
                    $(MediumKind::$kind => Self::$kind(Medium::read(top_k, tensors)?),)+
                    MediumKind::None => Self::None,
                })
            }

            /// Returns its spherical harmonics, if it consists of harmonics.
            pub fn harmonics(&self) -> Option<Harmonics<'_>> {
                match self {
                    $(Self::$kind(m) => m.harmonics(),)+
                    Self::None => None,
                }
            }
        }
    };
}

media! {
    /// Anchored spherical harmonics: the method's own.
    Rbf(MediumRbf, PerGaussian) = "rbf";
    /// A network of the viewing direction (WaterSplatting's water).
    Mlp(MediumMlp, PerGaussian) = "mlp";
    /// One set of spherical harmonics (Plenodium's water).
    Global(MediumGlobal, PerGaussian) = "global";
    /// One set of spherical harmonics, applied to the finished image at its depth (SeaSplat's formation).
    Image(MediumGlobal, PerImage) = "image";
    /// Free numbers of every training view (MarineSTD-GS's water). Other views have those of the nearest one.
    PerView(MediumPerView, PerGaussian) = "per-view";
    /// A network of the inverse depth and the camera's pose, applied to the finished image (3D-UIR's water).
    Uir(MediumUir, DepthNetwork) = "uir";
    /// Nine numbers for the whole scene, applied to the finished image at distances that are normalised in
    /// each view (SeaSplat's water).
    Seasplat(MediumSeasplat, Normalised) = "seasplat";
}

impl MediumKind {
    /// The kind with this name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.iter().copied().find(|kind| kind.name() == name)
    }

    /// True if its effect follows from coefficients per scene unit of distance, like that of real water.
    pub fn is_per_length(self) -> bool {
        matches!(self.formation(), Formation::PerGaussian | Formation::PerImage)
    }

    /// The names of all kinds for which `fits` is true, for a message: `rbf, mlp or none`.
    pub fn names(fits: impl Fn(Self) -> bool) -> String {
        let names: Vec<&str> = Self::ALL.iter().filter(|kind| fits(**kind)).map(|kind| kind.name()).collect();
        match names.split_last() {
            Some((last, rest)) if !rest.is_empty() => format!("{} or {last}", rest.join(", ")),
            _ => names.concat(),
        }
    }
}

impl Default for MediumKind {
    /// The medium of the method itself.
    fn default() -> Self {
        Self::Rbf
    }
}

impl MediumModel {
    /// The anchors of an anchored model.
    pub fn anchors(&self) -> Option<Anchors<'_>> {
        self.harmonics()?.anchors
    }
}
