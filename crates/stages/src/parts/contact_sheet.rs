//! A contact sheet of stage 1: photographs next to renderings of the scene from the same cameras.
//!
//! It is drawn with the scene's own compositor, so that stage 1's artifact depends neither on stage 2 nor on
//! the code that shows pictures.

use use3d_capture::{Camera, Capture, Image, Lattice, MediumMaps, View};
use use3d_import::{ImportError, load_pixels};
use use3d_scene::{Compositor, Scene};
use use3d_splat::{Options, Rendered};

/// Most views on a sheet.
const MOST: usize = 8;
/// Longest side of a thumbnail, pixels.
const SIDE: usize = 400;
/// White between pictures, pixels.
const GAP: usize = 8;
/// Number of columns of pairs when there are more than [`ONE_COLUMN`] pairs.
const COLUMNS: usize = 2;
/// Up to this many pairs are stacked in one column.
const ONE_COLUMN: usize = 3;

/// The views on the sheet, evenly chosen: the held-out views, or the training views if none is held out.
pub(crate) fn chosen(capture: &Capture) -> Vec<&View> {
    let mut views: Vec<&View> = capture.test_views().collect();
    if views.is_empty() {
        views = capture.training_views().collect();
    }
    let count = views.len().min(MOST);
    (0..count).map(|k| views[k * views.len() / count]).collect()
}

/// Renders the scene from a camera, with its water.
fn draw(compositor: &mut Compositor, scene: &Scene, camera: &Camera) -> Image {
    let lattice = Lattice::full(&camera.intrinsics);
    let mut maps = MediumMaps::zeros(0, 0);
    let water = scene.look_through(camera, &lattice, &mut maps);
    compositor.prepare(scene, camera, &lattice, |_| ());
    let mut rendered = Rendered::new();
    compositor.draw(water.then_some(&maps), &Options::default(), &mut rendered);
    rendered.image
}

/// Scales an image down by the mean of whole blocks of pixels, so that the longer side is at most [`SIDE`].
/// Values are clamped to the display range.
fn thumbnail(image: &Image) -> Image {
    let block = image.width().max(image.height()).div_ceil(SIDE).max(1);
    let (width, height) = ((image.width() / block).max(1), (image.height() / block).max(1));
    let mut small = Image::new(width, height);
    for y in 0..height {
        for x in 0..width {
            let mut sum = [0.0f32; 3];
            for v in y * block..(y + 1) * block {
                for u in x * block..(x + 1) * block {
                    let pixel = image.pixel(u.min(image.width() - 1), v.min(image.height() - 1));
                    (0..3).for_each(|c| sum[c] += pixel[c].clamp(0.0, 1.0));
                }
            }
            small.set_pixel(x, y, sum.map(|s| s / (block * block) as f32));
        }
    }
    small
}

/// Arranges pairs of thumbnails in rows, photographs on the left. The highest picture gives the height of a
/// row.
fn lay_out(pairs: &[[Image; 2]]) -> Image {
    let columns = if pairs.len() > ONE_COLUMN { COLUMNS } else { 1 };
    let cell = pairs.iter().flatten().map(Image::width).max().unwrap_or(0) + GAP;
    let heights: Vec<usize> = pairs
        .chunks(columns)
        .map(|row| row.iter().flatten().map(Image::height).max().unwrap_or(0) + GAP)
        .collect();
    let height: usize = heights.iter().sum();
    let mut sheet = Image::filled((2 * columns * cell).saturating_sub(GAP), height.saturating_sub(GAP), 1.0);
    let mut top = 0;
    for (row, height) in pairs.chunks(columns).zip(heights) {
        for (i, picture) in row.iter().flatten().enumerate() {
            for y in 0..picture.height() {
                for x in 0..picture.width() {
                    sheet.set_pixel(i * cell + x, top + y, picture.pixel(x, y));
                }
            }
        }
        top += height;
    }
    sheet
}

/// The contact sheet of a capture and the scene made from it; `None` without views.
pub(crate) fn sheet(capture: &Capture, scene: &Scene) -> Result<Option<Image>, ImportError> {
    let mut compositor = Compositor::default();
    let pair = |view: &View| -> Result<[Image; 2], ImportError> {
        let captured = load_pixels(view)?.to_image();
        Ok([thumbnail(&captured), thumbnail(&draw(&mut compositor, scene, &view.camera))])
    };
    let pairs = chosen(capture).into_iter().map(pair).collect::<Result<Vec<_>, _>>()?;
    Ok((!pairs.is_empty()).then(|| lay_out(&pairs)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thumbnails_are_block_means_and_pairs_stand_in_rows() {
        let mut large = Image::filled(900, 300, 0.25);
        large.set_pixel(0, 0, [7.0, 0.25, 0.25]); // counts as 1
        let small = thumbnail(&large);
        assert_eq!((small.width(), small.height()), (300, 100));
        assert!((small.pixel(0, 0)[0] - (8.0 * 0.25 + 1.0) / 9.0).abs() < 1e-6);
        assert_eq!(small.pixel(1, 0), [0.25; 3]);

        let pair = |value| [Image::filled(10, 6, value), Image::filled(10, 6, value + 0.1)];
        let one = lay_out(&[pair(0.1), pair(0.3)]);
        assert_eq!((one.width(), one.height()), (20 + GAP, 12 + GAP));
        assert_eq!(one.pixel(10 + GAP, 6 + GAP), [0.4; 3]);
        assert_eq!(one.pixel(10, 0), [1.0; 3], "white between");
        let many: Vec<[Image; 2]> = (0..5).map(|i| pair(0.1 * i as f32)).collect();
        let two = lay_out(&many);
        assert_eq!((two.width(), two.height()), (40 + 3 * GAP, 18 + 2 * GAP));
        assert_eq!(two.pixel(20 + 2 * GAP, 0), [0.1; 3], "the second pair");
    }
}
