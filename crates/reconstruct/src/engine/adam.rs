//! Adam over the Gaussians' arrays, in one pass per array.
//!
//! A Gaussian has 59 parameters, each with a gradient and two moments: 944 bytes are read and 708 written
//! if all bands are active. Bands above the active spherical-harmonics degree have no gradient and no
//! moments yet, so they are not touched. The same pass checks on the bits that all values are finite, so
//! that the check vectorises with the rest.

use fearless_simd::{Level, dispatch};
use rayon::prelude::*;
use use3d_numerics::adam::{Adam, AdamScalars};
use use3d_numerics::spherical_harmonics::bands;
use use3d_splat::{GaussianGradients, Gaussians};

use super::{Moments, Moves, StepRates};

/// A task gets this many Gaussians' coefficients, or four times as many floats of another array.
const CHUNK: usize = 1024;
/// Number of floats of one Gaussian's coefficients, and of its constant band.
const COEFFICIENTS: usize = 48;
const CONSTANT: usize = 3;

/// The names of the arrays in messages, in the order of [`numbers`].
const NAMES: [&str; 5] = ["means", "log scales", "quaternions", "opacity logits", "colour coefficients"];

/// The numbers of all Gaussians, array by array.
fn numbers(gaussians: &mut Gaussians) -> [&mut [f32]; 5] {
    [
        gaussians.means.as_flattened_mut(),
        gaussians.log_scales.as_flattened_mut(),
        gaussians.quaternions.as_flattened_mut(),
        &mut gaussians.opacity_logits,
        gaussians.sh.as_flattened_mut().as_flattened_mut(),
    ]
}

impl Moments {
    /// Updates all arrays once, or the colours alone; returns the first array with a value that is not
    /// finite, and the index.
    pub(crate) fn update(
        &mut self,
        (step, moves): (u64, Moves),
        rates: &StepRates,
        degree: usize,
        parameters: &mut Gaussians,
        g: &GaussianGradients,
    ) -> Option<(&'static str, Option<usize>)> {
        let level = Level::new();
        let scalars = |rate: f64| Adam::SPLATTING.scalars(step + 1, rate);
        let plain = [rates.means, rates.scales, rates.quaternions, rates.opacity].map(scalars);
        let coefficients = [rates.sh_constant, rates.sh_directional].map(scalars);
        let active = 3 * bands(degree.min(3));
        let gradients = [
            g.means.as_flattened(),
            g.log_scales.as_flattened(),
            g.quaternions.as_flattened(),
            &g.opacity_logits,
            g.sh.as_flattened().as_flattened(),
        ];
        let moments = numbers(&mut self.first).into_iter().zip(numbers(&mut self.second));
        let arrays = numbers(parameters).into_iter().zip(gradients).zip(moments).zip(NAMES);
        let mut bad = None;
        let first = if moves == Moves::Colors { plain.len() } else { 0 };
        for (k, (((p, g), (m, v)), name)) in arrays.enumerate().skip(first) {
            let chunk = if k < plain.len() { 4 * CHUNK } else { COEFFICIENTS * CHUNK };
            let found = p
                .par_chunks_mut(chunk)
                .zip(g.par_chunks(chunk))
                .zip(m.par_chunks_mut(chunk).zip(v.par_chunks_mut(chunk)))
                .map(|((p, g), (m, v))| match plain.get(k) {
                    Some(scalars) => dispatch!(level, _simd => run(scalars, p, g, m, v)),
                    None => dispatch!(level, _simd => rows(&coefficients, active, p, g, m, v)),
                })
                .reduce(|| 0, |a, b| a | b);
            if found != 0 && bad.is_none() {
                bad = Some((name, use3d_training::guard::first_non_finite(p)));
            }
        }
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
fn rows(
    [constant, directional]: &[AdamScalars; 2],
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
            assert_eq!(
                moments.update((step, Moves::All), &RATES, 1, &mut parameters, &gradients(&slopes)),
                None
            );
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
        let (all, kept) = (parameters.clone(), moments.clone());
        moments.update((3, Moves::Colors), &RATES, 1, &mut parameters, &gradients(&slopes));
        assert_ne!(parameters.sh, all.sh);
        assert_eq!(Gaussians { sh: all.sh.clone(), ..parameters }, all);
        assert_eq!(Gaussians { sh: kept.first.sh.clone(), ..moments.first }, kept.first);
    }

    #[test]
    fn the_first_bad_value_is_named() {
        let mut parameters = random(2000, 3);
        let mut slopes = gradients(&random(2000, 4));
        slopes.quaternions[1500][2] = f32::NAN;
        slopes.sh[3][0][1] = f32::INFINITY;
        let mut moments = Moments::new(&parameters);
        let bad = moments.update((0, Moves::All), &RATES, 0, &mut parameters, &slopes);
        assert_eq!(bad, Some(("quaternions", Some(6002))));
    }
}
