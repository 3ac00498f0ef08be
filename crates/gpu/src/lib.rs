//! The engines of training on graphics cards, of any vendor, found at run time.
//!
//! [`adapters`] lists what this machine has and [`Gpu::open`] takes one. A step is a row of kernels,
//! written by hand in WGSL and recorded into one pass; nothing is read back while steps run, so that the
//! card never waits for the processor.
//!
//! # What lies where
//!
//! N Gaussians, E (tile, Gaussian) entries, P pixels of the view, T tiles of 16×16
//! pixels. Every buffer is a flat array.
//!
//! | buffer | items | what |
//! |---|---|---|
//! | geometry | N × 3 `vec4<f32>` | mean and opacity logit; log scales and 0; quaternion `w, x, y, z` |
//! | colours | N × 48 `f32` | 16 bands × rgb one after another; in as many buffers as their bindings take |
//! | first and second moments | as these two | Adam's |
//! | statistics | N `vec2<u32>` | bits of the summed norm, renders |
//! | splats | N × 3 `vec4<f32>` | `x, y, shear, steepness`; `steepness_y, log2_opacity, z, reach_y`; colour, and 1 where visible |
//! | runs | N `vec2<u32>` | first entry and number of entries of a Gaussian |
//! | entries | E `u32` | the Gaussian of an entry; entries of a Gaussian lie together, by tile |
//! | lists | E `u32` | entries by tile, by depth within |
//! | starts | T + 1 `u32` | where a tile's list begins |
//! | records | E × 3 `vec4<f32>` | gradient of an entry: ΣG, ΣGt, ΣGdy, ΣGt²; ΣGt·dy, ΣGdy², ∂z/ln 2, ∂r; ∂g, ∂b, Σ\|Gt\|, Σ\|Gv_y\| |
//! | colour planes | 3 P `f32` | `c·P + y·W + x`: image, its gradient, `Σ w e_b`, `Σ w z c e_a`, `Σ w z e_b`, the water's `c_m`, `k_a`, `k_b` |
//! | planes | P `f32` or `u32` | depth, accumulation, final transmittance, the entry of its list at which a pixel stopped |
//!
//! Of stage 2, for L lookups of the field (listed Gaussians, and with water the 16 rows of
//! its table), rank R, n parameters:
//!
//! | buffer | items | what |
//! |---|---|---|
//! | state | 3 n `f32` | the field's parameters, Adam's first and second moments |
//! | sites | L × 2 `vec4<u32>` | bits of three fractions, and nodes; bits of three signed logs and 0, or of a fixed guide and 1 |
//! | raw, slopes | 6 L `f32` | log-gain and bias, and the loss's derivatives by them |
//! | codes, by codes | R L `f32` | a lookup's code, and the derivatives by it |
//! | grade | 108 `f32` | the mean that is removed, the water's table of 16 × 6, two ratios |
//! | records | E `vec4<f32>` | the derivative of an entry's colour |
//!
//! Photographs, opacities and masks lie as they are stored, four values of 8 bits or two of 16 in a word,
//! depth priors in 16 bits, and a step's first kernel makes the floats of its view; smaller sizes are floats.
//!
//! The water in front of a pixel enters as `e = 2^(−k z)` with `k = β |d| log₂e`.
//!
//! # Determinism
//!
//! Sorts are stable and of whole numbers, every record has one writer, sums go through fixed trees,
//! and no kernel adds floats atomically: the same requests give the same bytes on the same adapter,
//! driver, program and [`Variant`].

pub mod bench;
mod buffer;
mod ceilings;
mod check;
mod chunks;
mod constants;
mod device;
mod drawing;
mod kernel;
mod linear;
mod lists;
mod losses;
mod profile;
mod raster;
mod rebuild;
mod scene;
mod sort;
mod stage1;
mod stage2;
#[cfg(test)]
mod testing;
#[cfg(test)]
mod tests;
pub mod twins;
mod update;
mod variant;
mod water;

pub use check::{CheckError, check, checked_adapters, open_checked};
pub use device::{AdapterReport, DeviceError, Gpu, adapters};
pub use drawing::{Drawing, DrawnView};
pub use linear::LinearSplat;
pub use profile::KernelTime;
pub use stage1::{Stage1, training_bytes};
pub use stage2::Stage2;
pub use variant::Variant;

/// The text of every kernel in every variant, as drivers are given it: what results depend
/// on besides adapter and driver.
pub fn kernel_sources() -> Vec<String> {
    specs().iter().map(kernel::Spec::source).collect()
}

/// Every kernel in every variant.
fn specs() -> Vec<kernel::Spec> {
    let own = [sort::specs(), lists::specs(), raster::specs(), update::specs(), rebuild::specs()].concat();
    let further = own.into_iter().chain(losses::specs()).chain(water::specs());
    further.chain(stage1::specs()).chain(stage2::specs()).chain(linear::specs()).collect()
}
