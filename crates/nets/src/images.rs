//! Conversion between images and the networks' planes, with checks, padding and cropping.

use use3d_capture::{Image, Map};

use crate::engine::planes::Planes;
use crate::engine::resample::{Rule, resize};
use crate::error::NetError;

/// A picture whose long side is at most `side` pixels: larger ones are shrunk with an antialiasing bilinear
/// filter, both sides rounded down. Scores without reference are usually computed at 1024.
pub fn limit_long_side(image: &Image, side: usize) -> Image {
    let (width, height) = (image.width(), image.height());
    let long = width.max(height);
    if long <= side {
        return image.clone();
    }
    let fit = |n: usize| (n * side / long).max(1);
    let small = resize(&planes(image), fit(height), fit(width), Rule::BilinearAntialiased);
    let mut out = Image::new(small.width, small.height);
    out.data_mut().copy_from_slice(&small.data);
    out
}

/// Refuses a picture that has a side shorter than `side`, or a value that is not finite.
pub(crate) fn check(network: &'static str, image: &Image, side: usize) -> Result<(), NetError> {
    let (width, height) = (image.width(), image.height());
    if width < side || height < side {
        let problem = format!("the picture is {width}x{height} pixels; at least {side}x{side} are needed");
        return Err(NetError::Input { network, problem });
    }
    if let Some(i) = image.data().iter().position(|v| !v.is_finite()) {
        let (x, y) = (i % width, i / width % height);
        let problem =
            format!("the value of channel {} at pixel ({x}, {y}) is not finite", i / image.pixels());
        return Err(NetError::Input { network, problem });
    }
    Ok(())
}

/// Refuses a pair of pictures of different sizes.
pub(crate) fn check_pair(network: &'static str, a: &Image, b: &Image, side: usize) -> Result<(), NetError> {
    check(network, a, side)?;
    check(network, b, side)?;
    same_size(network, [a, b].map(|image| (image.width(), image.height())))
}

/// Refuses two pictures of these sizes if they differ.
pub(crate) fn same_size(network: &'static str, [a, b]: [(usize, usize); 2]) -> Result<(), NetError> {
    if a == b {
        return Ok(());
    }
    let problem = format!("the two pictures differ in size: {}x{} and {}x{}", a.0, a.1, b.0, b.1);
    Err(NetError::Input { network, problem })
}

/// The planes of an image.
pub(crate) fn planes(image: &Image) -> Planes {
    Planes::from_data(3, image.height(), image.width(), image.data().to_vec())
}

/// Applies `map(channel, value)` to every value.
pub(crate) fn scaled_planes(image: &Image, map: impl Fn(usize, f32) -> f32) -> Planes {
    let n = image.pixels();
    let data = image.data().iter().enumerate().map(|(i, &v)| map(i / n, v)).collect();
    Planes::from_data(3, image.height(), image.width(), data)
}

/// Three planes as an image.
pub(crate) fn image(planes: Planes) -> Result<Image, NetError> {
    Image::from_planes(planes.width, planes.height, planes.data)
        .ok_or(NetError::Input { network: "network", problem: "the result has not three channels".into() })
}

/// One plane as a map.
pub(crate) fn map(planes: Planes) -> Result<Map, NetError> {
    Map::from_planes(planes.width, planes.height, planes.data)
        .ok_or(NetError::Input { network: "network", problem: "the result has not one channel".into() })
}

/// A larger picture with the border pixels repeated outwards.
pub(crate) fn pad_edges(input: &Planes, top: usize, left: usize, height: usize, width: usize) -> Planes {
    arranged(input, height, width, |plane, y, x| {
        let y = y.saturating_sub(top).min(input.height - 1);
        let x = x.saturating_sub(left).min(input.width - 1);
        plane[y * input.width + x]
    })
}

/// A larger picture with zeros outside.
pub(crate) fn pad_zeros(input: &Planes, top: usize, left: usize, height: usize, width: usize) -> Planes {
    arranged(input, height, width, |plane, y, x| {
        let (y, x) = (y.wrapping_sub(top), x.wrapping_sub(left));
        if y < input.height && x < input.width { plane[y * input.width + x] } else { 0.0 }
    })
}

/// A picture of this size with the values `value(plane, y, x)`.
fn arranged(
    input: &Planes,
    height: usize,
    width: usize,
    value: impl Fn(&[f32], usize, usize) -> f32,
) -> Planes {
    let mut out = Planes::new(input.channels, height, width);
    for (c, plane) in out.data.chunks_exact_mut(height * width).enumerate() {
        let source = input.plane(c);
        for (y, row) in plane.chunks_exact_mut(width).enumerate() {
            for (x, o) in row.iter_mut().enumerate() {
                *o = value(source, y, x);
            }
        }
    }
    out
}

/// The part of size `height × width` at (`top`, `left`).
pub(crate) fn crop(input: &Planes, top: usize, left: usize, height: usize, width: usize) -> Planes {
    arranged(input, height, width, |plane, y, x| plane[(top + y) * input.width + left + x])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::picture;

    #[test]
    fn the_long_side_is_limited_and_the_mean_kept() {
        let image = picture(1, 300, 200);
        let small = limit_long_side(&image, 128);
        assert_eq!((small.width(), small.height()), (128, 85));
        let mean = |image: &Image| image.data().iter().sum::<f32>() / image.data().len() as f32;
        assert!((mean(&image) - mean(&small)).abs() < 2e-3);
        assert_eq!(limit_long_side(&image, 300), image);
    }

    #[test]
    fn padding_and_cropping_are_inverse() {
        let input = planes(&picture(2, 13, 9));
        for pad in [pad_edges, pad_zeros] {
            let padded = pad(&input, 3, 1, 16, 16);
            assert_eq!(crop(&padded, 3, 1, 9, 13), input);
        }
        assert_eq!(pad_edges(&input, 3, 1, 16, 16).data[0], input.data[0]);
        assert_eq!(pad_zeros(&input, 3, 1, 16, 16).data[0], 0.0);
    }
}
