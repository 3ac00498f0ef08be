//! Faults of the pixels: photographs that are not those of the model, or show something besides the scene.

use image::{Rgb, RgbImage, imageops};
use use3d_capture::{Image, Map};
use use3d_io_image::read_map;
use use3d_numerics::math;
use use3d_numerics::order::median;

use super::folder::{Chance, Done, Spoiler};
use super::model::{edit_lens, warp};
use super::tracks;
use crate::render::lens_blur;

pub(super) fn upside_down(s: &Spoiler<'_>) -> Done {
    s.repaint(s.strength, |_, picture| imageops::rotate180(&picture))
}

/// Turns two photographs by a quarter.
pub(super) fn quarter_turn(s: &Spoiler<'_>) -> Done {
    let share = 2.0 / s.photographs()?.len().max(1) as f64;
    s.repaint(share, |_, picture| imageops::rotate90(&picture))
}

pub(super) fn mirrored(s: &Spoiler<'_>) -> Done {
    s.repaint(1.0, |_, picture| imageops::flip_horizontal(&picture))
}

/// Turns all photographs by a quarter after model and photographs were cut to squares, so that no size
/// tells.
pub(super) fn square_turn(s: &Spoiler<'_>) -> Done {
    let (w, h) = s.size()?;
    let side = w.min(h);
    let (left, top) = ((w - side) / 2, (h - side) / 2);
    s.repaint(1.0, |_, picture| {
        imageops::rotate90(&imageops::crop_imm(&picture, left, top, side, side).to_image())
    })?;
    s.remove("depth")?;
    let (left, top, side) = (f64::from(left), f64::from(top), f64::from(side));
    edit_lens(s, |_, principal, _| {
        principal[0] -= left;
        principal[1] -= top;
    })?;
    s.edit_model(|model, _| {
        for keypoint in model.images.iter_mut().flat_map(|image| &mut image.keypoints) {
            (keypoint.x, keypoint.y) = (keypoint.x - left, keypoint.y - top);
        }
        let inside = |v: f64| (0.0..side).contains(&v);
        tracks::forget(model, |_, x, y| !inside(x) || !inside(y));
        for camera in &mut model.cameras {
            (camera.width, camera.height) = (side as usize, side as usize);
        }
    })
}

/// Makes the photographs smaller, to a share of their size.
pub(super) fn smaller(s: &Spoiler<'_>) -> Done {
    s.repaint(1.0, |_, picture| {
        let side = |n: u32| ((f64::from(n) * 0.01 * s.strength).round() as u32).max(1);
        imageops::thumbnail(&picture, side(picture.width()), side(picture.height()))
    })
}

/// Cuts a border off, and enlarges the rest to the size of before.
pub(super) fn cropped(s: &Spoiler<'_>) -> Done {
    let rest = 1.0 - 0.01 * s.strength.min(90.0);
    s.repaint(1.0, |_, picture| {
        let (cx, cy) = (0.5 * f64::from(picture.width()), 0.5 * f64::from(picture.height()));
        warp(&picture, |x, y| (cx + rest * (x - cx), cy + rest * (y - cy)))
    })
}

pub(super) fn swapped_colors(s: &Spoiler<'_>) -> Done {
    s.repaint(1.0, |_, mut picture| {
        picture.pixels_mut().for_each(|pixel| pixel.0.reverse());
        picture
    })
}

/// Multiplies the light of a picture, per channel.
fn expose(mut picture: RgbImage, stops: [f64; 3]) -> RgbImage {
    let gains = stops.map(|stops| math::exp2(stops / 2.2));
    for pixel in picture.pixels_mut() {
        for (value, gain) in pixel.0.iter_mut().zip(gains) {
            *value = (f64::from(*value) * gain).round() as u8;
        }
    }
    picture
}

/// The exposure drifts from one end of the swim to the other, by so many stops.
pub(super) fn exposure_drift(s: &Spoiler<'_>) -> Done {
    let last = (s.photographs()?.len().max(2) - 1) as f64;
    s.repaint(1.0, |i, picture| expose(picture, [s.strength * (i as f64 / last - 0.5); 3]))
}

pub(super) fn exposure_jumps(s: &Spoiler<'_>) -> Done {
    s.repaint(1.0, |i, picture| expose(picture, [s.strength * s.chance(i).normal(); 3]))
}

/// Red and blue of every view change against each other, by so many per cent.
pub(super) fn balance_jumps(s: &Spoiler<'_>) -> Done {
    s.repaint(1.0, |i, picture| {
        let stops = math::log2(1.0 + 0.01 * s.strength) * s.chance(i).normal();
        expose(picture, [stops, 0.0, -stops])
    })
}

/// Two cameras on one frame in folders of their own, one of them brighter.
pub(super) fn rig(s: &Spoiler<'_>) -> Done {
    s.repaint(1.0, |i, picture| if i % 2 == 1 { expose(picture, [s.strength; 3]) } else { picture })?;
    s.rename_photographs(|i, name| format!("{}/{name}", if i % 2 == 1 { "right" } else { "left" }))
}

/// Blurs every third photograph. One lens blur has a variance of half a square pixel. Repeated, it has the
/// strength's standard deviation, and needs no exponential function.
pub(super) fn blurred(s: &Spoiler<'_>) -> Done {
    let times = (2.0 * s.strength * s.strength).round().max(1.0) as usize;
    s.repaint(0.34, |_, picture| {
        let (w, h) = picture.dimensions();
        let pixels: Vec<f32> = picture.iter().map(|v| f32::from(*v)).collect();
        let Some(mut image) = Image::from_interleaved(w as usize, h as usize, &pixels) else {
            return picture;
        };
        (0..times).for_each(|_| lens_blur(&mut image));
        RgbImage::from_fn(w, h, |x, y| Rgb(image.pixel(x as usize, y as usize).map(|v| v.round() as u8)))
    })
}

pub(super) fn noisy(s: &Spoiler<'_>) -> Done {
    s.repaint(1.0, |i, mut picture| {
        let mut grain = s.chance(i);
        picture.pixels_mut().flat_map(|p| &mut p.0).for_each(|v| {
            *v = (f64::from(*v) + 2.55 * s.strength * grain.normal()).round() as u8;
        });
        picture
    })
}

pub(super) fn black(s: &Spoiler<'_>) -> Done {
    s.repaint(0.0, |_, picture| RgbImage::new(picture.width(), picture.height()))
}

/// Lays water over the photographs, so that only a share of the light at the middle distance arrives.
pub(super) fn haze(s: &Spoiler<'_>) -> Done {
    let arriving = (0.01 * s.strength).clamp(1e-3, 1.0);
    let maps: Vec<Map> = s.files("truth/depth")?.iter().map(|p| read_map(p)).collect::<Result<_, _>>()?;
    let known = maps.iter().flat_map(|map| map.data()).copied().filter(|z| *z > 0.0);
    let middle = median(known).map_or(1.0, f64::from);
    s.repaint(1.0, |i, mut picture| {
        for (x, y, pixel) in picture.enumerate_pixels_mut() {
            let z = maps.get(i).map_or(0.0, |map| f64::from(map.pixel(x as usize, y as usize)[0]));
            let left = if z > 0.0 { math::powf(arriving, z / middle) } else { 0.0 };
            for (value, veil) in pixel.0.iter_mut().zip([60.0, 120.0, 130.0]) {
                *value = (left * f64::from(*value) + (1.0 - left) * veil).round() as u8;
            }
        }
        picture
    })
}

/// Black bars above and below, each of so many per cent of the height.
pub(super) fn bars(s: &Spoiler<'_>) -> Done {
    let height = f64::from(s.size()?.1);
    let bar = (0.01 * s.strength.min(45.0) * height).round().max(1.0) as u32;
    s.cover(|_, _, y| (y < bar || y + bar >= height as u32).then_some([0; 3]))
}

/// A display of blocks like letters, in the corners; its last letters change like a clock.
pub(super) fn display(s: &Spoiler<'_>) -> Done {
    let (w, h) = s.size()?;
    let share = (0.01 * s.strength).min(0.5);
    // Two boxes, each three times as wide as high.
    let high = ((0.5 * share * f64::from(w) * f64::from(h) / 3.0).sqrt().round() as u32).max(3);
    let wide = (3 * high).min(w);
    s.cover(|i, x, y| {
        let (upper, lower) = (x < wide && y < high, x + wide >= w && y + high >= h);
        let (x, y, clock) = match (upper, lower) {
            (true, _) => (x, y, 0),
            (_, true) => (x + wide - w, y + high - h, if 4 * (x + wide - w) > 3 * wide { i } else { 0 }),
            _ => return None,
        };
        let edge = x == 0 || y == 0 || x + 1 == wide || y + 1 == high;
        let lit = !edge && (x / 2 * 7 + y / 2 * 13 + x * y / 5 + clock as u32 * 3).is_multiple_of(3);
        Some([if lit { 255 } else { 0 }; 3])
    })
}

/// A black rim around a circle that leaves out so many per cent of the half diagonal.
pub(super) fn rim(s: &Spoiler<'_>) -> Done {
    let (w, h) = s.size()?;
    let (cx, cy) = (0.5 * f64::from(w), 0.5 * f64::from(h));
    let radius = math::hypot(cx, cy) * (1.0 - 0.01 * s.strength.min(90.0));
    s.cover(|_, x, y| {
        let away = math::hypot(f64::from(x) + 0.5 - cx, f64::from(y) + 0.5 - cy);
        (away > radius).then_some([0; 3])
    })
}

/// A gripper that reaches from below into every view, so many per cent of the height.
pub(super) fn gripper(s: &Spoiler<'_>) -> Done {
    let (w, h) = s.size()?;
    let reach = (0.01 * s.strength).min(0.9) * f64::from(h);
    s.cover(|_, x, y| {
        let up = f64::from(h - y);
        let side = (f64::from(x) - 0.5 * f64::from(w)).abs() / f64::from(w);
        // An arm that ends in two jaws.
        let arm = up < 0.6 * reach && side < 0.12;
        let jaws = up < reach && (0.06..0.12).contains(&side);
        let shade = 70 + ((x * 5 + y * 3) % 40) as u8;
        (arm || jaws).then_some([shade, shade, shade / 2])
    })
}

/// Fish in every view at other places, without masks.
pub(super) fn fish(s: &Spoiler<'_>) -> Done {
    let (w, h) = s.size()?;
    let (w, h) = (f64::from(w), f64::from(h));
    let shoal = |i: usize| -> Vec<([f64; 4], [u8; 3])> {
        let mut chance = s.chance(i);
        let one = |chance: &mut Chance| {
            let length = w * (0.05 + 0.06 * chance.uniform());
            let body = [w * chance.uniform(), h * chance.uniform(), length, 0.4 * length];
            let tone = 40.0 + 170.0 * chance.uniform();
            (body, [tone as u8, (0.9 * tone) as u8, (0.5 * tone) as u8])
        };
        (0..s.strength.min(100.0) as usize).map(|_| one(&mut chance)).collect()
    };
    let shoals: Vec<_> = (0..s.photographs()?.len()).map(shoal).collect();
    s.cover(|i, x, y| {
        let inside = |([cx, cy, a, b], _): &&([f64; 4], [u8; 3])| {
            let (x, y) = ((f64::from(x) + 0.5 - cx) / a, (f64::from(y) + 0.5 - cy) / b);
            x * x + y * y < 1.0
        };
        shoals.get(i)?.iter().find(inside).map(|(_, color)| *color)
    })
}

/// Half of the photographs are grey.
pub(super) fn grey(s: &Spoiler<'_>) -> Done {
    s.repaint(0.5, |_, mut picture| {
        for pixel in picture.pixels_mut() {
            let [r, g, b] = pixel.0.map(u32::from);
            *pixel = Rgb([((3 * r + 6 * g + b) / 10) as u8; 3]);
        }
        picture
    })
}
