//! The engines of training on graphics cards, of any vendor, found at run time.
//!
//! [`adapters`] lists the adapters of this machine and [`Gpu::open`] opens one. A step is a series of
//! kernels, written by hand in WGSL and recorded into one pass. Nothing is read back while steps run, so
//! that the card never waits for the processor.
//!
//! # Buffers
//!
//! There are N Gaussians, E (tile, Gaussian) entries, P pixels of the view, and T tiles of 16×16 pixels.
//! Every buffer is a flat array.
//!
//! | buffer | items | contents |
//! |---|---|---|
//! | geometry | N × 3 `vec4<f32>` | mean and opacity logit; log scales and 0; quaternion `w, x, y, z` |
//! | colours | N × 48 `f32` | 16 bands × rgb in sequence; in as many buffers as their bindings need |
//! | first and second moments | as these two | Adam's moments |
//! | statistics | N `vec2<u32>` | bits of the summed norm, number of renders |
//! | splats | N × 3 `vec4<f32>` | three rows per Gaussian, see below |
//! | runs | N `vec2<u32>` | first entry and number of entries of a Gaussian |
//! | entries | E `u32` | the Gaussian of an entry; entries of a Gaussian lie together, by tile |
//! | lists | E `u32` | entries by tile, and by depth within a tile |
//! | starts | T + 1 `u32` | start of each tile's list |
//! | records | E × 3 `vec4<f32>` | gradient of an entry, three rows, see below |
//! | colour planes | 3 P `f32` | the image, and its gradient |
//! | water | 9 P `f32` | `c_m`, `k_a` and `k_b` |
//! | depth | P `f32` | expected depth |
//! | colour gradients | 6 N `f32` | the gradient of a Gaussian's colour, and the view direction |
//! | kept | 13 P `u32` | accumulation, three images, transmittance, stop, depth: see below |
//!
//! The rows of a splat are `x, y, shear, steepness`; `steepness_y, log2_opacity, z, reach_y`; colour, and 1
//! if it is visible. Those of a record are ΣG, ΣGt, ΣGdy, ΣGt²; ΣGt·dy, ΣGdy², ∂z/ln 2, ∂r; ∂g, ∂b, Σ\|Gt\|,
//! Σ\|Gv_y\|. A stop is the entry at which a pixel stopped. Colour planes have their values at `c·P + y·W +
//! x`. The three images that the forward pass keeps are `Σ w e_b`, `Σ w z c e_a` and `Σ w z e_b`. Floats
//! among words are stored as their bits. Several quantities share a buffer where a kernel would otherwise
//! bind more than ten: some devices have no more.
//!
//! The buffers of stage 2, for L lookups of the field (listed Gaussians, and with water the 16 rows of its
//! table), rank R and n parameters:
//!
//! | buffer | items | contents |
//! |---|---|---|
//! | state | 3 n `f32` | the field's parameters, Adam's first and second moments |
//! | sites | L × 2 `vec4<u32>` | three fractions and nodes; three signed logs and 0, or a fixed guide and 1 |
//! | raw, slopes | 6 L `f32` | log-gain and bias, and the loss's gradients with respect to them |
//! | codes, by codes | R L `f32` | a lookup's code, and the gradient with respect to it |
//! | grade | 108 `f32` | the removed mean, the water's table of 16 × 6, two ratios |
//! | records | E `vec4<f32>` | the gradient of an entry's colour |
//!
//! Photographs, opacities and masks are in their stored form, four values of 8 bits or two of 16 bits in a
//! word; depth priors have 16 bits. A step's first kernel makes the floats of its view at the step's size.
//!
//! The water in front of a pixel is given as `e = 2^(−k z)` with `k = β |d| log₂e`.
//!
//! # Determinism
//!
//! Sorts are stable and use unsigned integers, every record has one writer, sums run through fixed trees,
//! and no kernel adds floats atomically. So the same requests give the same bytes on the same adapter,
//! driver, program and [`Variant`].

mod adapter;
mod buffer;
mod check;
mod chunks;
mod compiled;
mod constants;
mod device;
mod drawing;
mod drawn;
#[cfg(test)]
mod driver_tests;
mod kernel;
mod linear;
mod lists;
mod losses;
pub mod measure;
mod per_view;
mod profile;
mod raster;
mod rebuild;
mod rows;
mod scene;
mod selection;
mod sort;
mod stage1;
mod stage2;
mod subgroups;
#[cfg(test)]
mod test_support;
#[cfg(test)]
mod tests;
mod times;
pub mod twins;
mod update;
mod variant;
mod vulkan;
mod water;

pub use check::{CheckError, check, checked_adapters, open_checked};
pub use device::{AdapterReport, DeviceError, Gpu, adapters, environment_note};
pub use drawing::{Drawing, DrawnView};
pub use linear::LinearSplat;
pub use losses::VALUES as LOSSES_WITH_KERNELS;
pub use stage1::{Stage1, training_bytes};
pub use stage2::Stage2;
pub use variant::Variant;

/// The text of every kernel in every variant, as drivers receive it. Results depend on it, as on adapter
/// and driver.
pub fn kernel_sources() -> Vec<String> {
    specs().iter().map(kernel::Spec::source).collect()
}

/// The name and the text of every kernel in every variant, each text once.
pub fn kernel_texts() -> Vec<(&'static str, String)> {
    let mut seen = std::collections::HashSet::new();
    let all = specs().into_iter().map(|spec| (spec.name, spec.source()));
    all.filter(|(_, text)| seen.insert(text.clone())).collect()
}

/// Every kernel in every variant.
fn specs() -> Vec<kernel::Spec> {
    [
        &sort::specs()[..],
        &lists::specs(),
        &raster::specs(),
        &update::specs(),
        &[rebuild::gather(), subgroups::widths()],
        &losses::specs(),
        &water::specs(),
        &[stage1::unpack()],
        &stage2::specs(),
        &linear::specs(),
    ]
    .concat()
}
