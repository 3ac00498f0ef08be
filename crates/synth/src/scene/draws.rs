//! Random numbers drawn one after another from a counter-based stream, for building objects.

use use3d_numerics::random::{Purpose, Stream};

/// The draws of one object: a function of the scene's seed, the kind of object and its number, independent of
/// other objects.
pub(crate) struct Draws {
    stream: Stream,
    next: u64,
}

impl Draws {
    pub(crate) fn new(seed: u64, kind: &'static str, number: u64) -> Self {
        Self { stream: Stream::new(seed, Purpose::new(kind), number), next: 0 }
    }

    /// Uniform in `[low, high)`.
    pub(crate) fn range(&mut self, low: f32, high: f32) -> f32 {
        self.next += 1;
        low + (high - low) * self.stream.uniform(self.next) as f32
    }

    /// Uniform, symmetric about zero, at most `amount` in magnitude.
    pub(crate) fn about(&mut self, amount: f32) -> f32 {
        self.range(-amount, amount)
    }

    /// A uniform choice from `0..n`.
    pub(crate) fn below(&mut self, n: usize) -> usize {
        self.next += 1;
        self.stream.below(self.next, n)
    }

    /// 32 bits, to seed a noise field.
    pub(crate) fn bits(&mut self) -> u32 {
        self.next += 1;
        self.stream.bits(self.next) as u32
    }
}
