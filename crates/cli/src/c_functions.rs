//! Elementary functions that third-party crates call from the C library, computed by `numerics::math`
//! instead.
//!
//! Their last bits would differ from one C library to the next. `exr` builds the tables of its lossy
//! compression with three of them, and these tables affect the pixels of an imported picture; the progress
//! bar and the big integers of `.npy` headers need the others. If the program itself defines a function under
//! its C name, the linker uses it for everything in the program. `tests/c_library.rs` fails when a dependency
//! calls another such function.

#![expect(unsafe_code, reason = "exporting a function under its C name, with the signature of <math.h>")]

use use3d_numerics::math;

#[unsafe(no_mangle)]
extern "C" fn cosf(x: f32) -> f32 {
    math::cos(x)
}

#[unsafe(no_mangle)]
extern "C" fn logf(x: f32) -> f32 {
    math::ln(x)
}

#[unsafe(no_mangle)]
extern "C" fn powf(x: f32, y: f32) -> f32 {
    math::powf(x, y)
}

#[unsafe(no_mangle)]
extern "C" fn log2(x: f64) -> f64 {
    math::log2(x)
}

#[unsafe(no_mangle)]
extern "C" fn pow(x: f64, y: f64) -> f64 {
    math::powf(x, y)
}
