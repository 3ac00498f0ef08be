//! The one table of media. A medium is a file that implements [`Medium`], and a row here; what it is called
//! in files and parameters, the enum of models, and every call that goes to one of them follow from the row.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_capture::{Camera, Formation, Lattice, MediumMaps};

use crate::tensors::{Put, Tensor, Tensors};
use crate::{Coefficients, MediumError, MediumGlobal, MediumImage, MediumMlp, MediumRbf, Role};

/// What a model may need to know of its start; each takes what concerns it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MediumStart {
    /// Anchors of an anchored model, 1 to [`MOST_ANCHORS`](crate::MOST_ANCHORS).
    pub anchors: usize,
    /// Anchors that share a view, 1 to `anchors`.
    pub top_k: usize,
    /// Seed of a model that starts at random.
    pub seed: u64,
}

/// A model that is spherical harmonics of the direction, around a camera.
#[derive(Clone, Copy, Debug)]
pub struct Harmonics<'a> {
    /// `[c_m, β_bs, β_attn][band][RGB]`, one set per anchor; a single one without anchors.
    pub coefficients: &'a [Coefficients],
    /// Where the sets belong; `None`: the one set holds everywhere.
    pub anchors: Option<Anchors<'a>>,
}

/// Places in the scene that coefficients belong to. [`MediumRbf`] says how cameras share them.
#[derive(Clone, Copy, Debug)]
pub struct Anchors<'a> {
    /// Centres, normalised scene units.
    pub centers: &'a [[f32; 3]],
    /// Logarithms of widths.
    pub log_widths: &'a [f32],
    /// Anchors that share a view.
    pub top_k: usize,
}

/// A model of the water: what a row of the table stands for. Degrees of spherical harmonics are 0 to 3.
pub(crate) trait Medium: Sized {
    /// Whether it can start from given spherical harmonics.
    const FROM_HARMONICS: bool = false;

    /// How images are formed in it.
    const FORMATION: Formation = Formation::PerGaussian;

    /// The initial state.
    fn start(start: &MediumStart) -> Result<Self, MediumError>;

    /// Takes the same harmonics everywhere, if it is made of such.
    fn set_harmonics(&mut self, _coefficients: &Coefficients) {}

    /// As [`MediumModel::maps`].
    fn maps(&self, camera: &Camera, lattice: &Lattice, degree: usize, out: &mut MediumMaps);

    /// As [`MediumModel::backward`].
    fn backward(
        &self,
        camera: &Camera,
        lattice: &Lattice,
        degree: usize,
        maps: &MediumMaps,
        d_maps: &MediumMaps,
        gradient: &mut Self,
    );

    /// As [`MediumModel::groups`].
    fn groups(&self) -> Vec<(Role, &[f32])>;

    /// The same, to be changed.
    fn groups_mut(&mut self) -> Vec<(Role, &mut [f32])>;

    /// Gives all its tensors.
    fn write(&self, put: Put<'_>);

    /// The model from its tensors; `top_k` matters to anchored ones.
    fn read(top_k: usize, tensors: &Tensors) -> Result<Self, MediumError>;

    /// Its harmonics, if it is made of such. Water without them is taken by viewers to
    /// vary with the direction alone.
    fn harmonics(&self) -> Option<Harmonics<'_>> {
        None
    }
}

/// Makes models, kinds and calls of the table's rows. No water is in no row: it has no
/// parameters and nothing to compute.
macro_rules! media {
    ($($(#[$doc:meta])* $kind:ident($model:ty) = $name:literal;)+) => {
        /// A model of the water.
        #[allow(clippy::large_enum_variant, reason = "a scene has one, so its size on the stack does not matter")]
        #[derive(Clone, Debug, PartialEq)]
        pub enum MediumModel {
            $($(#[$doc])* $kind($model),)+
            /// No water: plain Gaussian splatting.
            None,
        }

        /// Which model of the water is fitted.
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

            /// How images are formed in water of this kind.
            pub fn formation(self) -> Formation {
                match self {
                    $(Self::$kind => <$model as Medium>::FORMATION,)+
                    Self::None => Formation::default(),
                }
            }

            /// Whether a model of this kind can start from given spherical harmonics.
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

            /// One that is the same harmonics everywhere at the start; `None`
            /// if its kind is not made of such.
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

            /// Which model it is.
            pub fn kind(&self) -> MediumKind {
                match self {
                    $(Self::$kind(_) => MediumKind::$kind,)+
                    Self::None => MediumKind::None,
                }
            }

            /// The maps of one view on a lattice of its pixels. Spherical-harmonic bands above
            /// `active_degree` (0 to 3) are left out; a model without bands knows no such limit.
            /// Without water all maps are zero.
            pub fn maps(&self, camera: &Camera, lattice: &Lattice, active_degree: usize, out: &mut MediumMaps) {
                out.formation = self.kind().formation();
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
            /// are those that [`MediumModel::maps`] made with the same arguments; `gradient` has this model's
            /// kind and size ([`MediumModel::zeros_like`]).
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

            /// Runs of parameters of one role, in order.
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

            /// The model of `kind` from its tensors; `top_k` matters to anchored ones only.
            /// Shapes and finiteness are checked.
            pub fn from_tensors(kind: MediumKind, top_k: usize, tensors: &Tensors) -> Result<Self, MediumError> {
                Ok(match kind {
                    $(MediumKind::$kind => Self::$kind(Medium::read(top_k, tensors)?),)+
                    MediumKind::None => Self::None,
                })
            }

            /// Its spherical harmonics, if it is made of such.
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
    Rbf(MediumRbf) = "rbf";
    /// A network of the viewing direction (WaterSplatting's water).
    Mlp(MediumMlp) = "mlp";
    /// One set of spherical harmonics (Plenodium's water).
    Global(MediumGlobal) = "global";
    /// One set of spherical harmonics, laid over the finished image at its depth
    /// (SeaSplat's and 3D-UIR's formation).
    Image(MediumImage) = "image";
}

impl MediumKind {
    /// The kind of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.iter().copied().find(|kind| kind.name() == name)
    }

    /// The names of all kinds of which `fits` holds, for a message: `rbf, mlp or none`.
    pub fn names(fits: impl Fn(Self) -> bool) -> String {
        let names: Vec<&str> = Self::ALL.iter().filter(|kind| fits(**kind)).map(|kind| kind.name()).collect();
        match names.split_last() {
            Some((last, rest)) if !rest.is_empty() => format!("{} or {last}", rest.join(", ")),
            _ => names.concat(),
        }
    }
}

impl Default for MediumKind {
    /// The method's own.
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
