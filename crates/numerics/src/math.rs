//! Elementary functions with the same bits on every C library.
//!
//! `f32::exp`, `f64::sin` and similar functions of the standard library call the C library (or the compiler
//! evaluates them with the C library of its own machine), and C libraries differ in last bits: glibc from
//! musl, one glibc from the next. The functions here are compiled from Rust, with IEEE operations in a fixed
//! order, so they are part of the program. The lint `disallowed_methods` (`clippy.toml`) directs every caller
//! here.
//!
//! These need no replacement, because IEEE 754 fixes every bit: `+ - * /`, `%`, `sqrt`, `mul_add`, `abs`,
//! `floor`, `ceil`, `round`, `trunc`, `min`, `max`, conversions.
//!
//! Errors are below 1 ulp except `tanh` (2 ulp), each for `f32` and `f64`. Argument ranges, infinities and
//! NaN are as in the standard library. For millions of values, use [`lanes`](crate::lanes).

use std::ops::{Div, Mul};

/// `f32` and `f64`.
pub trait Real: Copy + From<f32> + Mul<Output = Self> + Div<Output = Self> + private::Functions {}

impl Real for f32 {}
impl Real for f64 {}

macro_rules! functions {
    ($($(#[$doc:meta])* $name:ident($($arg:ident),+) = $single:expr, $double:expr;)+) => {
        mod private {
            /// One method per function; sealed, so that `f32` and `f64` stay the only two types.
            pub trait Functions: Sized {
                $(fn $name($($arg: Self),+) -> Self;)+
                fn sin_cos(self) -> (Self, Self);
            }

            impl Functions for f32 {
                $(#[inline(always)]
                fn $name($($arg: Self),+) -> Self {
                    ($single)($($arg),+)
                })+

                #[inline(always)]
                fn sin_cos(self) -> (Self, Self) {
                    libm::sincosf(self)
                }
            }

            impl Functions for f64 {
                $(#[inline(always)]
                fn $name($($arg: Self),+) -> Self {
                    ($double)($($arg),+)
                })+

                #[inline(always)]
                fn sin_cos(self) -> (Self, Self) {
                    libm::sincos(self)
                }
            }
        }

        $($(#[$doc])*
        #[inline]
        pub fn $name<T: Real>($($arg: T),+) -> T {
            T::$name($($arg),+)
        })+
    };
}

functions! {
    /// `e^x`.
    exp(x) = libm::expf, libm::exp;
    /// `2^x`.
    exp2(x) = libm::exp2f, libm::exp2;
    /// `e^x − 1`, exact near 0.
    exp_m1(x) = libm::expm1f, libm::expm1;
    /// Natural logarithm.
    ln(x) = libm::logf, libm::log;
    /// `ln(1 + x)`, exact near 0.
    ln_1p(x) = libm::log1pf, libm::log1p;
    /// Logarithm to base 2.
    log2(x) = libm::log2f, libm::log2;
    /// Logarithm to base 10.
    log10(x) = libm::log10f, libm::log10;
    /// Sine of an angle in radians.
    sin(x) = libm::sinf, libm::sin;
    /// Cosine of an angle in radians.
    cos(x) = libm::cosf, libm::cos;
    /// Tangent of an angle in radians.
    tan(x) = libm::tanf, libm::tan;
    /// Inverse sine, in `[-π/2, π/2]`.
    asin(x) = libm::asinf, libm::asin;
    /// Inverse cosine, in `[0, π]`.
    acos(x) = libm::acosf, libm::acos;
    /// Inverse tangent, in `[-π/2, π/2]`.
    atan(x) = libm::atanf, libm::atan;
    /// Angle of the point `(x, y)` in `[-π, π]`.
    atan2(y, x) = libm::atan2f, libm::atan2;
    /// Hyperbolic sine.
    sinh(x) = libm::sinhf, libm::sinh;
    /// Hyperbolic cosine.
    cosh(x) = libm::coshf, libm::cosh;
    /// Hyperbolic tangent.
    tanh(x) = libm::tanhf, libm::tanh;
    /// Cube root.
    cbrt(x) = libm::cbrtf, libm::cbrt;
    /// `√(x² + y²)` without overflow.
    hypot(x, y) = libm::hypotf, libm::hypot;
    /// `x^y`.
    powf(x, y) = super::power_single, libm::pow;
}

/// Sine and cosine of an angle in radians.
#[inline]
pub fn sin_cos<T: Real>(x: T) -> (T, T) {
    T::sin_cos(x)
}

/// `x^n` by repeated squaring, lowest bit first; `1/x^|n|` for negative `n`. `powi(x, 2)` is `x * x`.
///
/// The standard library does not fix the precision of its `powi`, and the compiler evaluates it in another
/// way if both arguments are known.
#[inline]
pub fn powi<T: Real>(x: T, n: i32) -> T {
    let (mut square, mut rest, mut product) = (x, n.unsigned_abs(), T::from(1.0));
    loop {
        if rest & 1 == 1 {
            product = product * square;
        }
        rest >>= 1;
        if rest == 0 {
            break;
        }
        square = square * square;
    }
    if n < 0 { T::from(1.0) / product } else { product }
}

/// `x^y` in f32. For `x > 0` it is computed in f64 and rounded once, which is three times as fast as
/// `libm::powf` and more accurate.
#[inline]
fn power_single(x: f32, y: f32) -> f32 {
    if x > 0.0 && x.is_finite() && y.is_finite() {
        libm::exp(f64::from(y) * libm::log(f64::from(x))) as f32
    } else {
        libm::powf(x, y)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// FNV-1a over the bits of 20,000 arguments in `[low, high]`, in single and double precision.
    fn digest(low: f64, high: f64, single: impl Fn(f32) -> f32, double: impl Fn(f64) -> f64) -> u64 {
        (0..20_000).fold(0xcbf2_9ce4_8422_2325, |hash, i| {
            let x = low + (high - low) * (f64::from(i) + 0.5) / 20_000.0;
            let bits = double(x).to_bits() ^ u64::from(single(x as f32).to_bits()).rotate_left(32);
            (hash ^ bits).wrapping_mul(0x0100_0000_01b3)
        })
    }

    /// The bits do not depend on the machine, the C library or the compiler: these digests are the same
    /// everywhere.
    #[test]
    fn every_function_has_the_bits_it_always_had() {
        let mut other = Vec::new();
        macro_rules! check {
            ($($name:ident($($second:literal)?) in $low:literal, $high:literal: $expected:literal;)+) => {
                $(let found = digest($low, $high, |x| $name(x $(, $second)?), |x| $name(x $(, $second)?));
                if found != $expected {
                    other.push(format!("{} {found:#018x}", stringify!($name)));
                })+
            };
        }
        check! {
            exp() in -80.0, 80.0: 0x5c89_41f0_de81_122c;
            exp2() in -120.0, 120.0: 0x72a6_ab94_07ca_0ce1;
            exp_m1() in -5.0, 5.0: 0xa224_0f8d_9482_0fb5;
            ln() in 0.0, 50.0: 0xac04_b371_3db0_3463;
            ln_1p() in -0.99, 3.0: 0x8498_b07b_8d10_4eb1;
            log2() in 0.0, 50.0: 0xaf22_8bbb_0f4b_8eba;
            log10() in 0.0, 50.0: 0xd2ba_7b07_9ab2_321b;
            sin() in -50.0, 50.0: 0x1d3a_b658_0f42_ca0c;
            cos() in -50.0, 50.0: 0x5bc3_4f52_2261_4655;
            tan() in -1.5, 1.5: 0xe826_0aaa_e732_7c2a;
            asin() in -1.0, 1.0: 0xabb7_94a7_1a63_a29b;
            acos() in -1.0, 1.0: 0x6b14_127f_1687_ebde;
            atan() in -20.0, 20.0: 0x3e59_f3db_a3e0_98f6;
            atan2(-0.7) in -2.0, 2.0: 0x621e_c251_00df_e2e7;
            sinh() in -5.0, 5.0: 0x4c12_64db_47ef_ad47;
            cosh() in -5.0, 5.0: 0x3530_f7be_6193_4be9;
            tanh() in -5.0, 5.0: 0x242b_c607_fed3_1c75;
            cbrt() in -8.0, 8.0: 0x7e4d_e559_a3ef_0f29;
            hypot(0.7) in -2.0, 2.0: 0xa0d0_a93a_5a28_0f85;
            powf(2.4) in 0.0, 2.0: 0x8016_2883_0672_e7d3;
        }
        assert!(other.is_empty(), "other bits: {other:#?}");
    }

    #[test]
    fn values_are_close_to_what_they_name() {
        let close =
            |found: f64, wanted: f64| assert!((found - wanted).abs() < 1e-15 * wanted.abs(), "{found}");
        close(exp(1.0), std::f64::consts::E);
        close(exp2(0.5), std::f64::consts::SQRT_2);
        close(exp_m1(1e-9), 1.000_000_000_5e-9);
        close(ln(2.0), std::f64::consts::LN_2);
        close(ln_1p(1e-9), 9.999_999_995e-10);
        close(log2(10.0), std::f64::consts::LOG2_10);
        close(log10(2.0), std::f64::consts::LOG10_2);
        close(sin(std::f64::consts::FRAC_PI_6), 0.5);
        close(cos(std::f64::consts::FRAC_PI_3), 0.5);
        close(sin_cos(1.0f64).0, sin(1.0));
        close(tan(std::f64::consts::FRAC_PI_4), 1.0);
        close(asin(1.0), std::f64::consts::FRAC_PI_2);
        close(acos(-1.0), std::f64::consts::PI);
        close(atan(1.0), std::f64::consts::FRAC_PI_4);
        close(atan2(1.0, -1.0), 3.0 * std::f64::consts::FRAC_PI_4);
        close(tanh(1.0), sinh(1.0) / cosh(1.0));
        close(cbrt(27.0), 3.0);
        close(hypot(3e300, 4e300), 5e300);
        close(powf(2.0, 0.5), std::f64::consts::SQRT_2);
    }

    #[test]
    fn powers_are_products_in_a_fixed_order() {
        let x = 1.1f64;
        assert_eq!(powi(x, 0), 1.0);
        assert_eq!(powi(x, 2), x * x);
        assert_eq!(powi(x, 7), x * (x * x) * ((x * x) * (x * x)));
        assert_eq!(powi(2f32, -24), 1.0 / 16_777_216.0);
        assert_eq!(powi(1f64, i32::MIN), 1.0);
    }

    #[test]
    fn powers_in_single_precision_keep_the_special_cases() {
        for (x, y) in
            [(0.0, 2.2), (-0.0, 3.0), (-8.0, 2.0), (-8.0, 0.5), (1e30, 3.0), (1e-30, 3.0), (2.0, f32::NAN)]
        {
            let (found, wanted) = (powf(x, y), libm::powf(x, y));
            assert!(found == wanted || found.is_nan() && wanted.is_nan(), "{x}^{y}: {found}, not {wanted}");
        }
        assert_eq!(powf(f32::NAN, 0.0), 1.0);
        assert_eq!(powf(f32::INFINITY, -1.0), 0.0);
        assert_eq!(powf(9f32, 0.5), 3.0);
    }
}
