//! The kernels of stage 2: their bindings and their text.

use use3d_training::EngineError;

use crate::constants::CONSTANTS;
use crate::device::Gpu;
use crate::kernel::{Access, Binding, Constant, Kernel, ROWS, SUM, Spec, U32S, read, write};
use crate::raster;

/// Number of lookups in a workgroup, and in a tile of the kernels that sum the gradients of parameters.
pub(super) const LOOKUPS: usize = 64;
/// Number of pixels in a workgroup of the water's gradients.
pub(super) const WATER_SPAN: usize = 256;
/// Number of sums of the colours' gradients: six outputs, twelve numbers of the affine.
pub(super) const COLOR_SUMS: usize = 18;
/// Number of sums of the water's gradients: the table, the affine, the guide, the ratios.
pub(super) const WATER_SUMS: usize = 114;
/// Number of sums of the guide's gradients.
pub(super) const GUIDE_SUMS: usize = 4;
/// Number of floats of the mean, the table and the ratios together.
pub(super) const GRADE: usize = 108;
/// The value of a status word without an error.
pub(super) const NONE: u32 = u32::MAX;
/// Index of the status word for the first gradient that is not finite.
pub(super) const BAD_GRADIENT: usize = 0;
/// Index of the status word for the first parameter that is not finite.
pub(super) const BAD_PARAMETER: usize = 1;

const FIELD: &str = include_str!("field.wgsl");
const GUIDE: &str = include_str!("guide.wgsl");
const AFFINE: &str = include_str!("affine.wgsl");
const SITES: &str = include_str!("sites.wgsl");
const DECODER: &str = include_str!("decoder.wgsl");
const TABLE: &str = include_str!("table.wgsl");
const FROZEN_WATER: &str = include_str!("frozen_water.wgsl");
const SUM_ROWS: &str = include_str!("sum_rows.wgsl");

const FIELD_BINDING: Binding = (Access::Uniform, "field", "Field");
const SITE_ROWS: Binding = (Access::Read, "sites", "array<vec4<u32>>");
const STATUS: Binding = (Access::Write, "status", "array<atomic<u32>>");
const BASE: Binding = (Access::Read, "base", ROWS);

/// The kind of sums that are added up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Of {
    Parameters,
    Colors,
    Water,
    Guide,
}

impl Of {
    const ALL: [Self; 4] = [Self::Parameters, Self::Colors, Self::Water, Self::Guide];

    /// Position of its totals in the array of totals; parameters have an array of their own.
    fn first(self) -> usize {
        match self {
            Self::Parameters | Self::Colors => 0,
            Self::Water => COLOR_SUMS,
            Self::Guide => COLOR_SUMS + WATER_SUMS,
        }
    }
}

/// A field of one rank; the other sizes are not constants of the text.
struct FieldRank(usize);

impl FieldRank {
    fn spec(&self, name: &'static str, threads: u32, bindings: &[Binding], parts: &[&'static str]) -> Spec {
        let count = |value: usize| Constant::Count(value as u32);
        Spec {
            name,
            threads,
            bindings: bindings.to_vec(),
            constants: vec![
                ("RANK", count(self.0)),
                ("NONE", Constant::Count(NONE)),
                ("BAD_GRADIENT", count(BAD_GRADIENT)),
                ("BAD_PARAMETER", count(BAD_PARAMETER)),
            ],
            parts: parts.to_vec(),
        }
    }

    fn lookup(&self) -> Spec {
        let partial = (Access::Write, "partial", ROWS);
        let bindings = [FIELD_BINDING, read("state"), SITE_ROWS, write("raw"), partial];
        let parts = [FIELD, GUIDE, SITES, DECODER, SUM_ROWS, include_str!("lookup.wgsl")];
        self.spec("lookup", LOOKUPS as u32, &bindings, &parts)
    }

    fn grade(&self) -> Spec {
        let partial = (Access::Read, "partial", ROWS);
        let bindings = [FIELD_BINDING, read("state"), read("raw"), partial, write("grade")];
        self.spec("grade", 64, &bindings, &[FIELD, SUM_ROWS, include_str!("grade.wgsl")])
    }

    fn recolor(&self) -> Spec {
        let splats = (Access::Write, "splats", ROWS);
        let bindings = [FIELD_BINDING, read("state"), read("raw"), read("grade"), BASE, splats];
        self.spec("recolor", 64, &bindings, &[FIELD, AFFINE, include_str!("recolor.wgsl")])
    }

    fn water(&self) -> Spec {
        let bindings = [FIELD_BINDING, read("state"), read("grade"), raster::WATER, write("enhanced")];
        let parts = [FIELD, GUIDE, AFFINE, TABLE, FROZEN_WATER, include_str!("water.wgsl")];
        self.spec("enhanced water", 64, &bindings, &parts)
    }

    fn recolor_back(&self) -> Spec {
        let bindings = [
            FIELD_BINDING,
            read("state"),
            read("raw"),
            read("grade"),
            BASE,
            (Access::Read, "runs", "array<vec2<u32>>"),
            (Access::Read, "records", ROWS),
            write("slopes"),
            write("partial"),
        ];
        let parts = [FIELD, AFFINE, SUM_ROWS, include_str!("recolor_back.wgsl")];
        self.spec("recolor backward", LOOKUPS as u32, &bindings, &parts)
    }

    fn water_back(&self) -> Spec {
        let bindings = [
            FIELD_BINDING,
            read("state"),
            read("grade"),
            raster::WATER,
            read("image_pull"),
            (Access::Read, "kept", U32S),
            write("partial"),
        ];
        let parts = [FIELD, GUIDE, AFFINE, TABLE, FROZEN_WATER, include_str!("water_back.wgsl")];
        self.spec("enhanced water backward", 128, &bindings, &parts)
    }

    fn total(&self, of: Of) -> Spec {
        let bindings = [FIELD_BINDING, read("partial"), write("totals")];
        let mut spec = self.spec("total of sums", 64, &bindings, &[FIELD, SUM, include_str!("total.wgsl")]);
        spec.constants.push(("OF", Constant::Count(of as u32)));
        spec.constants.push(("FIRST", Constant::Count(of.first() as u32)));
        spec
    }

    fn table_back(&self) -> Spec {
        let bindings = [FIELD_BINDING, read("totals"), read("grade"), write("slopes")];
        self.spec("water table backward", 64, &bindings, &[FIELD, include_str!("table_back.wgsl")])
    }

    fn lookup_back(&self) -> Spec {
        let bindings = [
            FIELD_BINDING,
            read("state"),
            SITE_ROWS,
            read("totals"),
            write("slopes"),
            write("codes"),
            write("by_codes"),
            write("partial"),
        ];
        let parts = [FIELD, GUIDE, SITES, DECODER, SUM_ROWS, include_str!("lookup_back.wgsl")];
        self.spec("lookup backward", LOOKUPS as u32, &bindings, &parts)
    }

    fn units(&self) -> Spec {
        let bindings = [FIELD_BINDING, read("state"), read("slopes"), read("codes"), write("partial")];
        self.spec("hidden units", LOOKUPS as u32, &bindings, &[FIELD, DECODER, include_str!("units.wgsl")])
    }

    fn nodes(&self) -> Spec {
        let bindings = [FIELD_BINDING, read("state"), SITE_ROWS, read("by_codes"), write("partial")];
        let parts = [FIELD, GUIDE, SITES, include_str!("nodes.wgsl")];
        self.spec("factor nodes", LOOKUPS as u32, &bindings, &parts)
    }

    fn gradient(&self, water: bool) -> Spec {
        let bindings = [
            FIELD_BINDING,
            read("state"),
            read("totals"),
            read("grade"),
            read("of_field"),
            write("gradient"),
            STATUS,
        ];
        let mut spec = self.spec("gradient", 64, &bindings, &[FIELD, include_str!("gradient.wgsl")]);
        spec.constants.push(("WATER", Constant::Switch(water)));
        spec
    }

    fn learn(&self) -> Spec {
        let bindings = [FIELD_BINDING, read("gradient"), write("state"), STATUS];
        self.spec("field update", 64, &bindings, &[FIELD, include_str!("learn.wgsl")])
    }
}

/// The kernel that finds the entries that some pixel sees.
pub(super) fn seen() -> Spec {
    let more = [(Access::Read, "kept", U32S), (Access::Write, "seen", U32S)];
    Spec {
        name: "seen entries",
        threads: 64,
        bindings: [&raster::TILE[..], &more[..]].concat(),
        constants: vec![],
        parts: vec![CONSTANTS, raster::SHARED, include_str!("seen.wgsl")],
    }
}

/// The kernel for the gradient of the colours of a tile's Gaussians: one record per entry.
pub(crate) fn colors(water: bool) -> Spec {
    let more =
        [raster::WATER, (Access::Read, "kept", U32S), read("image_pull"), (Access::Write, "records", ROWS)];
    Spec {
        name: "colours backward",
        threads: 64,
        bindings: [&raster::TILE[..], &more[..]].concat(),
        constants: vec![("WATER", Constant::Switch(water))],
        parts: vec![CONSTANTS, raster::SHARED, include_str!("colors.wgsl")],
    }
}

/// A kernel that reads a view's lists, and counts or writes the weights of its pixels.
fn weights(name: &'static str, more: &[Binding], writes: bool) -> Spec {
    Spec {
        name,
        threads: 256,
        bindings: [&raster::TILE[..], more].concat(),
        constants: vec![("WRITE", Constant::Switch(writes))],
        parts: vec![
            CONSTANTS,
            raster::SHARED,
            if writes { "" } else { NO_PAIRS },
            include_str!("weights.wgsl"),
        ],
    }
}

/// A stand-in for the pairs that the first run does not write.
const NO_PAIRS: &str = "var<private> pairs: array<vec2<u32>, 1>;";
const PAIRS: &str = "array<vec2<u32>>";

/// The kernel that counts the weights of every pixel.
pub(super) fn count_weights() -> Spec {
    weights("numbers of weights", &[(Access::Write, "firsts", U32S)], false)
}

/// The kernel that writes them.
pub(super) fn write_weights() -> Spec {
    weights("weights", &[(Access::Write, "firsts", U32S), (Access::Write, "pairs", PAIRS)], true)
}

const SIZES: Binding = (Access::Uniform, "sizes", "vec4<u32>");
const FIRSTS: Binding = (Access::Read, "firsts", U32S);
const READ_PAIRS: Binding = (Access::Read, "pairs", PAIRS);
const SPLATS: Binding = (Access::Read, "splats", ROWS);

/// The kernel that composes a view from its weights.
fn frozen_forward(water: bool) -> Spec {
    let kept = (Access::Write, "kept", U32S);
    Spec {
        name: "frozen forward",
        threads: 64,
        bindings: vec![SIZES, FIRSTS, READ_PAIRS, SPLATS, raster::WATER, write("image"), kept],
        constants: vec![("WATER", Constant::Switch(water))],
        parts: vec![raster::SHARED, include_str!("frozen_forward.wgsl")],
    }
}

/// The kernel for the gradient of the colours of a view with weights.
fn frozen_colors(water: bool) -> Spec {
    let (owners, records) = ((Access::Read, "owners", U32S), (Access::Write, "records", ROWS));
    Spec {
        name: "frozen colours backward",
        threads: 64,
        bindings: vec![SIZES, FIRSTS, READ_PAIRS, owners, SPLATS, raster::WATER, read("image_pull"), records],
        constants: vec![("WATER", Constant::Switch(water))],
        parts: vec![raster::SHARED, include_str!("frozen_colors.wgsl")],
    }
}

/// All kernels of this module, for fields of the smallest, the method's and the largest rank.
pub(crate) fn specs() -> Vec<Spec> {
    let of_rank = |rank| {
        let v = FieldRank(rank);
        let mut all = vec![
            v.lookup(),
            v.grade(),
            v.recolor(),
            v.water(),
            v.recolor_back(),
            v.water_back(),
            v.table_back(),
            v.lookup_back(),
            v.units(),
            v.nodes(),
            v.gradient(false),
            v.gradient(true),
            v.learn(),
        ];
        all.extend(Of::ALL.map(|of| v.total(of)));
        all
    };
    let mut specs: Vec<Spec> = [1, 8, 16].into_iter().flat_map(of_rank).collect();
    specs.extend([seen(), colors(false), colors(true), count_weights(), write_weights()]);
    specs.extend([false, true].into_iter().flat_map(|water| [frozen_forward(water), frozen_colors(water)]));
    specs
}

/// The kernels for a field of one rank.
#[derive(Debug)]
pub(super) struct FieldKernels {
    pub(super) lookup: Kernel,
    pub(super) grade: Kernel,
    pub(super) recolor: Kernel,
    pub(super) water: Kernel,
    pub(super) recolor_back: Kernel,
    pub(super) water_back: Kernel,
    totals: [Kernel; 4],
    pub(super) table_back: Kernel,
    pub(super) lookup_back: Kernel,
    pub(super) units: Kernel,
    pub(super) nodes: Kernel,
    /// The variant without water, and the one with it.
    pub(super) gradient: [Kernel; 2],
    pub(super) learn: Kernel,
    pub(super) colors: [Kernel; 2],
    /// Those for views with weights, in the same order.
    pub(super) frozen_forward: [Kernel; 2],
    pub(super) frozen_colors: [Kernel; 2],
}

impl FieldKernels {
    pub(super) fn new(gpu: &Gpu, rank: usize) -> Result<Self, EngineError> {
        let v = FieldRank(rank);
        let kernel = |spec: Spec| Kernel::new(gpu, &spec);
        let total = |of| kernel(v.total(of));
        Ok(Self {
            lookup: kernel(v.lookup())?,
            grade: kernel(v.grade())?,
            recolor: kernel(v.recolor())?,
            water: kernel(v.water())?,
            recolor_back: kernel(v.recolor_back())?,
            water_back: kernel(v.water_back())?,
            totals: [total(Of::Parameters)?, total(Of::Colors)?, total(Of::Water)?, total(Of::Guide)?],
            table_back: kernel(v.table_back())?,
            lookup_back: kernel(v.lookup_back())?,
            units: kernel(v.units())?,
            nodes: kernel(v.nodes())?,
            gradient: [kernel(v.gradient(false))?, kernel(v.gradient(true))?],
            learn: kernel(v.learn())?,
            colors: [kernel(colors(false))?, kernel(colors(true))?],
            frozen_forward: [kernel(frozen_forward(false))?, kernel(frozen_forward(true))?],
            frozen_colors: [kernel(frozen_colors(false))?, kernel(frozen_colors(true))?],
        })
    }

    pub(super) fn total(&self, of: Of) -> &Kernel {
        &self.totals[of as usize]
    }
}
