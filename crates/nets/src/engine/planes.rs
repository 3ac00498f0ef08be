//! The data between layers: planes of `height × width`, one per channel, row-major. Tokens of a transformer
//! are the columns of planes of height 1, so that one matrix product serves both convolutions and
//! transformers.

/// Feature maps `[channels, height, width]`.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Planes {
    pub(crate) channels: usize,
    pub(crate) height: usize,
    pub(crate) width: usize,
    pub(crate) data: Vec<f32>,
}

impl Planes {
    pub(crate) fn new(channels: usize, height: usize, width: usize) -> Self {
        Self { channels, height, width, data: vec![0.0; channels * height * width] }
    }

    pub(crate) fn from_data(channels: usize, height: usize, width: usize, data: Vec<f32>) -> Self {
        assert_eq!(data.len(), channels * height * width);
        Self { channels, height, width, data }
    }

    /// Values per plane.
    pub(crate) fn area(&self) -> usize {
        self.height * self.width
    }

    pub(crate) fn plane(&self, channel: usize) -> &[f32] {
        let n = self.area();
        &self.data[channel * n..(channel + 1) * n]
    }

    /// Channels `range` as their own planes.
    pub(crate) fn slice(&self, range: std::ops::Range<usize>) -> Self {
        let n = self.area();
        let data = self.data[range.start * n..range.end * n].to_vec();
        Self::from_data(range.len(), self.height, self.width, data)
    }

    /// Element-wise sum, in place.
    pub(crate) fn add(&mut self, other: &Self) {
        assert_eq!((self.channels, self.area()), (other.channels, other.area()));
        self.data.iter_mut().zip(&other.data).for_each(|(a, b)| *a += b);
    }
}
