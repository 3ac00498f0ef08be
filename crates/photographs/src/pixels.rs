//! Work on all pixels of a photograph, compiled in this crate, whose build is optimised, for each type of
//! sample.

use use3d_capture::{Image, Intrinsics};
use use3d_survey::Lens;

use crate::map::ColourMap;
use crate::sample::Sample;
use crate::small::areas;
use crate::straight::read;

/// Pixels of a photograph's file, by their samples.
pub trait PixelSample: Sample {
    /// [`ColourMap::apply`].
    fn change(map: &ColourMap, pixels: &mut [Self], width: usize);
    /// [`shrink`].
    fn shrink(pixels: &[Self], width: usize, size: (usize, usize)) -> Image;
    /// [`straight()`].
    fn straight(
        pixels: (&[Self], usize),
        size: (usize, usize),
        lens: &Lens,
        pinhole: &Intrinsics,
    ) -> Vec<Self>;
}

macro_rules! pixel_sample {
    ($($sample:ty),*) => {$(
        impl PixelSample for $sample {
            fn change(map: &ColourMap, pixels: &mut [Self], width: usize) {
                map.change(pixels, width);
            }
            fn shrink(pixels: &[Self], width: usize, size: (usize, usize)) -> Image {
                areas(pixels, width, size)
            }
            fn straight(
                pixels: (&[Self], usize),
                size: (usize, usize),
                lens: &Lens,
                pinhole: &Intrinsics,
            ) -> Vec<Self> {
                read(pixels, size, lens, pinhole)
            }
        }
    )*};
}

pixel_sample!(u8, u16, f32);

impl ColourMap {
    /// Changes the colours of interleaved RGB pixels of `width` columns in place. Pixels outside the display
    /// range stay outside in a file of floats. Sums of a pixel do not depend on the threads.
    pub fn apply<T: PixelSample>(&self, pixels: &mut [T], width: usize) {
        T::change(self, pixels, width);
    }
}

/// The mean of interleaved RGB pixels of `width` columns over the areas of a smaller picture, display range.
/// The same size gives the pixels themselves.
pub fn shrink<T: PixelSample>(pixels: &[T], width: usize, size: (usize, usize)) -> Image {
    T::shrink(pixels, width, size)
}

/// Interleaved pixels of `channels` values of a photograph of `size` pixels, taken through `lens`, as the
/// pinhole would have taken them. A photograph without pixels gives none.
pub fn straight<T: PixelSample>(
    (pixels, channels): (&[T], usize),
    size: (usize, usize),
    lens: &Lens,
    pinhole: &Intrinsics,
) -> Vec<T> {
    T::straight((pixels, channels), size, lens, pinhole)
}
