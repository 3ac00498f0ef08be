//! One image type for the workspace: planar, row-major, of any element and channel count.

/// A planar raster: `C` planes of `width × height` elements, row-major, plane after plane.
///
/// The value of channel `c` at column `x`, row `y` is `data()[(c * height + y) * width + x]`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Raster<T, const C: usize> {
    width: usize,
    height: usize,
    data: Vec<T>,
}

/// RGB in display range `[0, 1]` (renders may be outside the range; writers clamp).
pub type Image = Raster<f32, 3>;
/// RGB as stored in an 8-bit file.
pub type Image8 = Raster<u8, 3>;
/// One channel: depth, accumulation, mask weights.
pub type Map = Raster<f32, 1>;

impl<T: Copy + Default, const C: usize> Raster<T, C> {
    /// A raster of zeros.
    pub fn new(width: usize, height: usize) -> Self {
        Self { width, height, data: vec![T::default(); C * width * height] }
    }

    /// A raster with every element equal to `value`.
    pub fn filled(width: usize, height: usize, value: T) -> Self {
        Self { width, height, data: vec![value; C * width * height] }
    }

    /// Changes the size, keeping the allocation if it is large enough. The contents are unspecified
    /// afterwards.
    pub fn resize(&mut self, width: usize, height: usize) {
        self.width = width;
        self.height = height;
        self.data.resize(C * width * height, T::default());
    }

    /// Converts interleaved pixels (`[H, W, C]`, row-major) to planes; `None` if the length is not `width *
    /// height * C`.
    pub fn from_interleaved(width: usize, height: usize, pixels: &[T]) -> Option<Self> {
        if pixels.len() != C * width * height {
            return None;
        }
        let mut out = Self::new(width, height);
        let n = width * height;
        for (p, pixel) in pixels.chunks_exact(C.max(1)).enumerate() {
            for c in 0..C {
                out.data[c * n + p] = pixel[c];
            }
        }
        Some(out)
    }

    /// Interleaved copy, `[H, W, C]` row-major.
    pub fn to_interleaved(&self) -> Vec<T> {
        let n = self.width * self.height;
        let mut out = Vec::with_capacity(C * n);
        for p in 0..n {
            for c in 0..C {
                out.push(self.data[c * n + p]);
            }
        }
        out
    }

    /// The pixel at column `x`, row `y`.
    #[inline]
    pub fn pixel(&self, x: usize, y: usize) -> [T; C] {
        let (n, p) = (self.width * self.height, y * self.width + x);
        std::array::from_fn(|c| self.data[c * n + p])
    }

    /// Sets the pixel at column `x`, row `y`.
    #[inline]
    pub fn set_pixel(&mut self, x: usize, y: usize, value: [T; C]) {
        let (n, p) = (self.width * self.height, y * self.width + x);
        for c in 0..C {
            self.data[c * n + p] = value[c];
        }
    }

    /// A copy with `f` applied to every element.
    pub fn map<U>(&self, f: impl Fn(T) -> U) -> Raster<U, C> {
        Raster { width: self.width, height: self.height, data: self.data.iter().map(|&v| f(v)).collect() }
    }
}

impl<T, const C: usize> Raster<T, C> {
    /// Makes a raster from planar data; `None` if its length is not `C * width * height`.
    pub fn from_planes(width: usize, height: usize, data: Vec<T>) -> Option<Self> {
        (data.len() == C * width * height).then_some(Self { width, height, data })
    }

    /// Width in pixels.
    #[inline]
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height in pixels.
    #[inline]
    pub fn height(&self) -> usize {
        self.height
    }

    /// Pixels per plane.
    #[inline]
    pub fn pixels(&self) -> usize {
        self.width * self.height
    }

    /// All planes, one after another.
    #[inline]
    pub fn data(&self) -> &[T] {
        &self.data
    }

    /// All planes, one after another, mutable.
    #[inline]
    pub fn data_mut(&mut self) -> &mut [T] {
        &mut self.data
    }

    /// Returns the planar data itself.
    pub fn into_data(self) -> Vec<T> {
        self.data
    }

    /// Plane `c`, row-major.
    #[inline]
    pub fn plane(&self, c: usize) -> &[T] {
        let n = self.pixels();
        &self.data[c * n..(c + 1) * n]
    }

    /// Plane `c`, row-major, mutable.
    #[inline]
    pub fn plane_mut(&mut self, c: usize) -> &mut [T] {
        let n = self.pixels();
        &mut self.data[c * n..(c + 1) * n]
    }

    /// All planes as separate slices.
    pub fn planes(&self) -> [&[T]; C] {
        let n = self.pixels();
        std::array::from_fn(|c| &self.data[c * n..(c + 1) * n])
    }

    /// Row `y` of plane `c`.
    #[inline]
    pub fn row(&self, c: usize, y: usize) -> &[T] {
        let start = (c * self.height + y) * self.width;
        &self.data[start..start + self.width]
    }
}

impl Image {
    /// 8-bit copy: clamped to `[0, 1]`, `floor(255 x + 0.5)`.
    pub fn to_8bit(&self) -> Image8 {
        self.map(|v| (v.clamp(0.0, 1.0) * 255.0 + 0.5).floor() as u8)
    }
}

impl Image8 {
    /// The values divided by 255.
    pub fn to_float(&self) -> Image {
        self.map(|v| f32::from(v) / 255.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn interleaved_and_planar_are_inverse() {
        let pixels: Vec<f32> = (0..2 * 3 * 3).map(|v| v as f32).collect();
        let image = Image::from_interleaved(3, 2, &pixels).unwrap();
        assert_eq!(image.pixel(1, 0), [3.0, 4.0, 5.0]);
        assert_eq!(image.row(2, 1), &[11.0, 14.0, 17.0]);
        assert_eq!(image.to_interleaved(), pixels);
        assert!(Image::from_interleaved(3, 3, &pixels).is_none());
    }

    #[test]
    fn quantisation_rounds_half_up_and_clamps() {
        let image =
            Image::from_interleaved(2, 1, &[-1.0, 0.5, 2.0, 1.0 / 510.0, 0.499 / 255.0, 1.0]).unwrap();
        assert_eq!(image.to_8bit().to_interleaved(), [0, 128, 255, 1, 0, 255]);
    }
}
