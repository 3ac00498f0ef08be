//! Adam over the Gaussians' arrays, in one pass per array.
//!
//! A Gaussian has 59 parameters, each with a gradient and two moments: 944 bytes are read and 708 written
//! if all bands are active. Bands above the active spherical-harmonics degree have no gradient and no
//! moments yet, so they are not touched. The same pass checks on the bits that all values are finite, so
//! that the check vectorises with the rest.

use fearless_simd::{Level, Simd, dispatch};
use rayon::prelude::*;
use use3d_numerics::adam::{Adam, AdamScalars};
use use3d_numerics::spherical_harmonics::bands;
use use3d_splat::{GaussianGradients, Gaussians};

use super::{Moments, StepRates};

/// Gaussians per task.
const CHUNK: usize = 1024;
/// Number of floats of one Gaussian's coefficients, and of its constant band.
const COEFFICIENTS: usize = 48;
const CONSTANT: usize = 3;

impl Moments {
    /// Updates all arrays once; returns the first array with a value that is not finite, and the index.
    pub(crate) fn update(
        &mut self,
        step: u64,
        rates: &StepRates,
        degree: usize,
        parameters: &mut Gaussians,
        gradients: &GaussianGradients,
    ) -> Option<(&'static str, Option<usize>)> {
        let scalars = |rate: f64| Adam::SPLATTING.scalars(step + 1, rate);
        let (m, v) = (&mut self.first, &mut self.second);
        let mut bad = None;
        let mut note = |name: &'static str, values: &[f32], found: bool| {
            if found && bad.is_none() {
                bad = Some((name, use3d_training::guard::first_non_finite(values)));
            }
        };
        macro_rules! plain {
            ($field:ident, $rate:expr, $name:literal) => {
                let found = flat(
                    &scalars($rate),
                    parameters.$field.as_flattened_mut(),
                    gradients.$field.as_flattened(),
                    m.$field.as_flattened_mut(),
                    v.$field.as_flattened_mut(),
                );
                note($name, parameters.$field.as_flattened(), found);
            };
        }
        plain!(means, rates.means, "means");
        plain!(log_scales, rates.scales, "log scales");
        plain!(quaternions, rates.quaternions, "quaternions");
        let found = flat(
            &scalars(rates.opacity),
            &mut parameters.opacity_logits,
            &gradients.opacity_logits,
            &mut m.opacity_logits,
            &mut v.opacity_logits,
        );
        note("opacity logits", &parameters.opacity_logits, found);
        let found = coefficients(
            &scalars(rates.sh_constant),
            &scalars(rates.sh_directional),
            3 * bands(degree.min(3)),
            &mut parameters.sh,
            &gradients.sh,
            &mut m.sh,
            &mut v.sh,
        );
        note("colour coefficients", parameters.sh.as_flattened().as_flattened(), found);
        bad
    }
}

/// The exponent bits, all set in infinities and NaN.
const EXPONENT: u32 = 0x7f80_0000;

#[inline(always)]
fn run(scalars: &AdamScalars, p: &mut [f32], g: &[f32], m: &mut [f32], v: &mut [f32]) -> u32 {
    let n = p.len();
    let (g, m, v) = (&g[..n], &mut m[..n], &mut v[..n]);
    let mut bad = 0;
    for i in 0..n {
        let value = scalars.apply(p[i], g[i], &mut m[i], &mut v[i]);
        p[i] = value;
        bad |= u32::from(value.to_bits() & EXPONENT == EXPONENT);
    }
    bad
}

#[inline(always)]
fn run_dispatched<S: Simd>(
    _simd: S,
    scalars: &AdamScalars,
    p: &mut [f32],
    g: &[f32],
    m: &mut [f32],
    v: &mut [f32],
) -> u32 {
    run(scalars, p, g, m, v)
}

fn flat(scalars: &AdamScalars, p: &mut [f32], g: &[f32], m: &mut [f32], v: &mut [f32]) -> bool {
    let level = Level::new();
    let chunk = CHUNK * 4;
    p.par_chunks_mut(chunk)
        .zip(g.par_chunks(chunk))
        .zip(m.par_chunks_mut(chunk).zip(v.par_chunks_mut(chunk)))
        .map(|((p, g), (m, v))| dispatch!(level, simd => run_dispatched(simd, scalars, p, g, m, v)))
        .reduce(|| 0, |a, b| a | b)
        != 0
}

type Coefficients = [[f32; 3]; 16];

fn coefficients(
    constant: &AdamScalars,
    directional: &AdamScalars,
    active: usize,
    p: &mut [Coefficients],
    g: &[Coefficients],
    m: &mut [Coefficients],
    v: &mut [Coefficients],
) -> bool {
    let level = Level::new();
    p.par_chunks_mut(CHUNK)
        .zip(g.par_chunks(CHUNK))
        .zip(m.par_chunks_mut(CHUNK).zip(v.par_chunks_mut(CHUNK)))
        .map(|((p, g), (m, v))| {
            dispatch!(level, simd => rows(
                simd,
                constant,
                directional,
                active,
                p.as_flattened_mut().as_flattened_mut(),
                g.as_flattened().as_flattened(),
                m.as_flattened_mut().as_flattened_mut(),
                v.as_flattened_mut().as_flattened_mut(),
            ))
        })
        .reduce(|| 0, |a, b| a | b)
        != 0
}

#[inline(always)]
fn rows<S: Simd>(
    _simd: S,
    constant: &AdamScalars,
    directional: &AdamScalars,
    active: usize,
    p: &mut [f32],
    g: &[f32],
    m: &mut [f32],
    v: &mut [f32],
) -> u32 {
    let rows = p.chunks_exact_mut(COEFFICIENTS).zip(g.chunks_exact(COEFFICIENTS));
    let moments = m.chunks_exact_mut(COEFFICIENTS).zip(v.chunks_exact_mut(COEFFICIENTS));
    let mut bad = 0;
    for ((p, g), (m, v)) in rows.zip(moments) {
        bad |= run(constant, &mut p[..CONSTANT], &g[..CONSTANT], &mut m[..CONSTANT], &mut v[..CONSTANT]);
        if active == COEFFICIENTS {
            // The usual case, with a length that the compiler knows.
            let all = CONSTANT..COEFFICIENTS;
            bad |= run(directional, &mut p[all.clone()], &g[all.clone()], &mut m[all.clone()], &mut v[all]);
        } else {
            let some = CONSTANT..active;
            bad |=
                run(directional, &mut p[some.clone()], &g[some.clone()], &mut m[some.clone()], &mut v[some]);
        }
    }
    bad
}

#[cfg(test)]
mod tests {
    use use3d_numerics::random::{Purpose, Stream};

    use super::super::zeros;
    use super::*;

    fn random(n: usize, salt: u64) -> Gaussians {
        let stream = Stream::new(salt, Purpose::new("adam test"), 0);
        let mut g = zeros(n, 3);
        let all = [
            g.means.as_flattened_mut(),
            g.log_scales.as_flattened_mut(),
            g.quaternions.as_flattened_mut(),
            &mut g.opacity_logits,
            g.sh.as_flattened_mut().as_flattened_mut(),
        ];
        let mut k = 0;
        for values in all {
            for v in values {
                *v = stream.normal(k) as f32;
                k += 1;
            }
        }
        g
    }

    fn gradients(from: &Gaussians) -> GaussianGradients {
        let mut g = GaussianGradients::new(from.len());
        g.means.clone_from(&from.means);
        g.log_scales.clone_from(&from.log_scales);
        g.quaternions.clone_from(&from.quaternions);
        g.opacity_logits.clone_from(&from.opacity_logits);
        g.sh.clone_from(&from.sh);
        g
    }

    const RATES: StepRates = StepRates {
        means: 1e-3,
        sh_constant: 2e-3,
        sh_directional: 3e-3,
        opacity: 4e-3,
        scales: 5e-3,
        quaternions: 6e-3,
        medium_constant: 0.0,
        medium_directional: 0.0,
        medium_network: 0.0,
    };

    #[test]
    fn every_group_moves_at_its_own_rate_like_the_plain_update() {
        let n = 3000;
        let mut parameters = random(n, 1);
        let (before, slopes) = (parameters.clone(), random(n, 2));
        let mut moments = Moments::new(&parameters);
        for step in 0..3 {
            assert_eq!(moments.update(step, &RATES, 1, &mut parameters, &gradients(&slopes)), None);
        }
        let plain = |from: &[f32], g: &[f32], rate: f64| {
            let (mut p, mut m, mut v) = (from.to_vec(), vec![0.0; g.len()], vec![0.0; g.len()]);
            for step in 1..=3 {
                Adam::SPLATTING.update(step, rate, &mut p, g, &mut m, &mut v);
            }
            p
        };
        assert_eq!(
            parameters.means.as_flattened(),
            plain(before.means.as_flattened(), slopes.means.as_flattened(), 1e-3)
        );
        assert_eq!(parameters.opacity_logits, plain(&before.opacity_logits, &slopes.opacity_logits, 4e-3));
        let at = 1234;
        let row = |g: &Gaussians, range: std::ops::Range<usize>| g.sh[at].as_flattened()[range].to_vec();
        assert_eq!(row(&parameters, 0..3), plain(&row(&before, 0..3), &row(&slopes, 0..3), 2e-3));
        assert_eq!(row(&parameters, 3..12), plain(&row(&before, 3..12), &row(&slopes, 3..12), 3e-3));
        // Above the active degree nothing changes.
        assert_eq!(row(&parameters, 12..48), row(&before, 12..48));
    }

    #[test]
    fn the_first_bad_value_is_named() {
        let mut parameters = random(2000, 3);
        let mut slopes = gradients(&random(2000, 4));
        slopes.quaternions[1500][2] = f32::NAN;
        slopes.sh[3][0][1] = f32::INFINITY;
        let mut moments = Moments::new(&parameters);
        let bad = moments.update(0, &RATES, 0, &mut parameters, &slopes);
        assert_eq!(bad, Some(("quaternions", Some(6002))));
    }
}
