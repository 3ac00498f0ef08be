//! The result of a decoder: interleaved samples as the file stores them, and their conversions.

use use3d_capture::{Image, Map, Pixels, Raster};

/// Samples of one file, `[height, width, channels]`, in the file's own precision.
#[derive(Clone, Debug, PartialEq)]
pub enum Samples {
    /// 8-bit, full scale 255.
    Eight(Vec<u8>),
    /// 16-bit, full scale 65535.
    Sixteen(Vec<u16>),
    /// Floating point (or integers of no stated full scale), values as stored.
    Float(Vec<f32>),
}

/// A decoded file: 1 channel is grey, 2 grey and alpha, 3 RGB, 4 RGB and alpha.
#[derive(Clone, Debug, PartialEq)]
pub struct Decoded {
    /// Width, pixels.
    pub width: usize,
    /// Height, pixels.
    pub height: usize,
    /// 1 to 4.
    pub channels: usize,
    /// `width * height * channels` samples.
    pub samples: Samples,
}

/// The three colours of every pixel as planes; grey is used for all three, alpha is dropped.
fn colors<T: Copy + Default, U: Copy + Default>(
    decoded: &Decoded,
    samples: &[T],
    convert: impl Fn(T) -> U,
) -> Raster<U, 3> {
    let n = decoded.width * decoded.height;
    let channels = decoded.channels;
    let mut out = Raster::<U, 3>::new(decoded.width, decoded.height);
    let (red, rest) = out.data_mut().split_at_mut(n);
    let (green, blue) = rest.split_at_mut(n);
    let (g, b) = if channels >= 3 { (1, 2) } else { (0, 0) };
    let planes = red.iter_mut().zip(green).zip(blue);
    for (((r, gr), bl), pixel) in planes.zip(samples.chunks_exact(channels)) {
        *r = convert(pixel[0]);
        *gr = convert(pixel[g]);
        *bl = convert(pixel[b]);
    }
    out
}

impl Decoded {
    /// True if the last channel is alpha.
    pub fn has_alpha(&self) -> bool {
        matches!(self.channels, 2 | 4)
    }

    /// The colours in the form that is kept in memory: 8-bit files stay 8-bit, all others become 16-bit
    /// (clamped to `[0, 1]`).
    pub fn to_pixels(&self) -> Pixels {
        match &self.samples {
            Samples::Eight(s) => Pixels::Eight(colors(self, s, |v| v)),
            Samples::Sixteen(s) => Pixels::Sixteen(colors(self, s, |v| v)),
            // A NaN becomes 0 in the conversion to u16.
            Samples::Float(s) => {
                Pixels::Sixteen(colors(self, s, |v| (v.clamp(0.0, 1.0) * 65535.0 + 0.5).floor() as u16))
            }
        }
    }

    /// The colours in display range; float files keep their values, also outside `[0, 1]`.
    pub fn to_image(&self) -> Image {
        match &self.samples {
            Samples::Eight(s) => colors(self, s, |v| f32::from(v) / 255.0),
            Samples::Sixteen(s) => colors(self, s, |v| f32::from(v) / 65535.0),
            Samples::Float(s) => colors(self, s, |v| v),
        }
    }

    fn channel_map(&self, first: usize, count: usize) -> Map {
        let share = 1.0 / count as f32;
        let mut out = Map::new(self.width, self.height);
        let pixels = out.data_mut().iter_mut();
        macro_rules! gather {
            ($samples:expr, $convert:expr) => {
                for (o, pixel) in pixels.zip($samples.chunks_exact(self.channels)) {
                    *o = pixel[first..first + count].iter().map($convert).sum::<f32>() * share;
                }
            };
        }
        match &self.samples {
            Samples::Eight(s) => gather!(s, |&v| f32::from(v) / 255.0),
            Samples::Sixteen(s) => gather!(s, |&v| f32::from(v) / 65535.0),
            Samples::Float(s) => gather!(s, |&v| v),
        }
        out
    }

    /// One channel: the grey value, or the mean of the three colours; alpha is dropped. Integer values are
    /// divided by their full scale, float values are kept as stored.
    pub fn to_map(&self) -> Map {
        if self.channels >= 3 { self.channel_map(0, 3) } else { self.channel_map(0, 1) }
    }

    /// The alpha channel as a weight in `[0, 1]`, if there is one.
    pub fn alpha(&self) -> Option<Map> {
        self.has_alpha().then(|| {
            let mut map = self.channel_map(self.channels - 1, 1);
            map.data_mut().iter_mut().for_each(|v| *v = if v.is_nan() { 0.0 } else { v.clamp(0.0, 1.0) });
            map
        })
    }
}
