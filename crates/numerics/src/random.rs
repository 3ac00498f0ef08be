//! Counter-based random numbers: every draw is a function of (seed, purpose, step, index) (R29).
//!
//! There is no generator state, so a resumed run, another thread count or another order of evaluation draws
//! the same numbers. The mixing function is the finaliser of SplitMix64 (Steele, Lea, Flood, "Fast splittable
//! pseudorandom number generators", OOPSLA 2014), applied after each key word. Not for cryptography.

use crate::math;

/// The purpose of a draw. Two purposes never share a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Purpose(u64);

impl Purpose {
    /// A purpose from its name, e.g. `Purpose::new("split Gaussians")`.
    pub const fn new(name: &str) -> Self {
        // The hash only has to distinguish a few dozen names.
        Self(fnv1a(name))
    }
}

/// The FNV-1a hash of a text.
pub const fn fnv1a(text: &str) -> u64 {
    let (bytes, mut hash, mut i) = (text.as_bytes(), 0xcbf2_9ce4_8422_2325u64, 0);
    while i < bytes.len() {
        hash = (hash ^ bytes[i] as u64).wrapping_mul(0x0000_0100_0000_01b3);
        i += 1;
    }
    hash
}

/// The stream of one (seed, purpose, step).
#[derive(Clone, Copy, Debug)]
pub struct Stream {
    key: u64,
}

/// The finaliser of SplitMix64.
pub const fn mix(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// The increment of SplitMix64.
pub const GOLDEN: u64 = 0x9e37_79b9_7f4a_7c15;

impl Stream {
    /// The stream for `purpose` at `step` under `seed`.
    pub const fn new(seed: u64, purpose: Purpose, step: u64) -> Self {
        let key = mix(seed.wrapping_add(GOLDEN));
        let key = mix(key ^ purpose.0.wrapping_add(GOLDEN));
        Self { key: mix(key ^ step.wrapping_mul(GOLDEN).wrapping_add(1)) }
    }

    /// 64 random bits for `index`.
    pub const fn bits(&self, index: u64) -> u64 {
        mix(self.key.wrapping_add(index.wrapping_add(1).wrapping_mul(GOLDEN)))
    }

    /// Uniform in `[0, 1)`, 53 bits.
    pub fn uniform(&self, index: u64) -> f64 {
        (self.bits(index) >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
    }

    /// Uniform in `0..n` (`n > 0`; the bias of at most `n / 2^64` is irrelevant here).
    pub fn below(&self, index: u64, n: usize) -> usize {
        ((u128::from(self.bits(index)) * n as u128) >> 64) as usize
    }

    /// Standard normal (Box–Muller on draws `2 index` and `2 index + 1`).
    pub fn normal(&self, index: u64) -> f64 {
        let u = 1.0 - self.uniform(2 * index);
        let v = self.uniform(2 * index + 1);
        (-2.0 * math::ln(u)).sqrt() * math::cos(std::f64::consts::TAU * v)
    }

    /// A uniformly random permutation of `0..n` (Fisher–Yates).
    pub fn permutation(&self, n: usize) -> Vec<usize> {
        let mut order: Vec<usize> = (0..n).collect();
        for i in (1..n).rev() {
            order.swap(i, self.below(i as u64, i + 1));
        }
        order
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn draws_depend_on_every_part_of_the_key() {
        let a = Stream::new(1, Purpose::new("a"), 0);
        for other in [
            Stream::new(2, Purpose::new("a"), 0),
            Stream::new(1, Purpose::new("b"), 0),
            Stream::new(1, Purpose::new("a"), 1),
        ] {
            assert_ne!(a.bits(0), other.bits(0));
        }
        assert_ne!(a.bits(0), a.bits(1));
    }

    #[test]
    fn moments_are_those_of_the_distributions() {
        let s = Stream::new(42, Purpose::new("moments"), 7);
        let n = 200_000;
        let (mut u1, mut u2, mut n1, mut n2) = (0.0, 0.0, 0.0, 0.0);
        for i in 0..n {
            let (u, z) = (s.uniform(i), s.normal(i));
            (u1, u2, n1, n2) = (u1 + u, u2 + u * u, n1 + z, n2 + z * z);
        }
        let n = n as f64;
        assert!((u1 / n - 0.5).abs() < 4e-3 && (u2 / n - 1.0 / 3.0).abs() < 4e-3);
        assert!((n1 / n).abs() < 1e-2 && (n2 / n - 1.0).abs() < 2e-2);
    }

    #[test]
    fn a_permutation_has_every_index_once() {
        let mut p = Stream::new(3, Purpose::new("views"), 5).permutation(101);
        assert_ne!(p[..5], [0, 1, 2, 3, 4]);
        p.sort_unstable();
        assert!(p.iter().enumerate().all(|(i, &v)| i == v));
    }
}
