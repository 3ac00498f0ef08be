//! Compares widths with those of ideal edges: a step that a Gaussian blurs rises from 10 % to 90 % within
//! 2 Φ⁻¹(0.9) σ = 2.5631 σ.

use use3d_numerics::random::{Purpose, Stream};

use super::*;

/// The normal distribution, by Abramowitz and Stegun 7.1.26 (error 1.5e-7).
fn normal(z: f64) -> f64 {
    let x = z.abs() / 2f64.sqrt();
    let t = 1.0 / (1.0 + 0.327_591_1 * x);
    let poly = [1.061_405_429, -1.453_152_027, 1.421_413_741, -0.284_496_736, 0.254_829_592];
    let tail = poly.iter().fold(0.0, |sum, k| (sum + k) * t) * math::exp(-x * x) / 2.0;
    if z < 0.0 { tail } else { 1.0 - tail }
}

/// An image of a value per pixel, grey.
fn grey(width: usize, height: usize, value: impl Fn(f64, f64) -> f64) -> Image {
    let plane: Vec<f32> =
        (0..width * height).map(|i| value((i % width) as f64, (i / width) as f64) as f32).collect();
    Image::from_planes(width, height, plane.repeat(3)).unwrap()
}

/// A step through the middle of 320 × 320 pixels, moved along its normal.
fn step(degrees: f64, sigma: f64, moved: f64, levels: [f64; 2]) -> Image {
    let (sin, cos) = math::sin_cos(degrees.to_radians());
    grey(320, 320, |x, y| {
        let across = (x - 159.3) * cos + (y - 160.4) * sin - moved;
        levels[0] + (levels[1] - levels[0]) * normal(across / sigma)
    })
}

const LEVELS: [f64; 2] = [0.2, 0.6];

fn ratio(photograph: &Image, render: &Image) -> EdgeWidth {
    StepEdges::of(photograph, None).unwrap().in_render(render).unwrap()
}

#[test]
fn widths_are_those_of_ideal_edges_in_every_direction() {
    for sigma in [0.8, 1.0, 1.5, 2.0] {
        for degrees in [0.0, 17.0, 45.0, 63.0, 90.0, 131.0, 200.0, 288.0] {
            let found = StepEdges::of(&step(degrees, sigma, 0.0, LEVELS), None).unwrap();
            for edge in found.edges() {
                let off = edge.width / (2.5631 * sigma) - 1.0;
                let allowed = if sigma < 1.0 { 0.08 } else { 0.05 };
                assert!(off.abs() < allowed, "σ {sigma}, {degrees}°: {} is off by {off}", edge.width);
                let (sin, cos) = math::sin_cos(degrees.to_radians());
                assert!(edge.normal[0] * cos + edge.normal[1] * sin > 0.9998);
                assert!((edge.contrast - 0.4).abs() < 0.01);
            }
        }
    }
}

#[test]
fn the_ratio_is_that_of_the_blurs_and_grows_with_them() {
    let photograph = step(25.0, 1.0, 0.0, LEVELS);
    assert_eq!(ratio(&photograph, &photograph), EdgeWidth { ratio: 1.0, lost: 0.0 });
    let mut before = 1.0;
    for sigma in [1.2, 1.5, 2.0, 2.5, 3.0, 4.0] {
        let found = ratio(&photograph, &step(25.0, sigma, 0.0, LEVELS));
        assert!(found.ratio > before && found.lost == 0.0);
        before = found.ratio;
        if sigma <= 2.5 {
            assert!((found.ratio / sigma - 1.0).abs() < 0.05, "{} for {sigma}", found.ratio);
        }
    }
}

#[test]
fn exposure_and_a_small_shift_are_forgiven_and_lost_edges_are_the_widest() {
    let photograph = step(70.0, 1.2, 0.0, LEVELS);
    let dark = ratio(&photograph, &step(70.0, 1.2, 0.0, [0.15, 0.35]));
    assert!((dark.ratio - 1.0).abs() < 0.01 && dark.lost == 0.0);
    for moved in [-1.0, 0.5, 1.0] {
        let shifted = ratio(&photograph, &step(70.0, 1.2, moved, LEVELS));
        assert!((shifted.ratio - 1.0).abs() < 0.03 && shifted.lost == 0.0, "{shifted:?} for {moved}");
    }
    for lost in
        [step(70.0, 1.2, 0.0, [0.2, 0.3]), step(70.0, 1.2, 0.0, [0.6, 0.2]), step(70.0, 1.2, 3.0, LEVELS)]
    {
        let found = ratio(&photograph, &lost);
        let widest = 16.0 / (2.5631 * 1.2);
        assert!(found.lost == 1.0 && (found.ratio / widest - 1.0).abs() < 0.05, "{found:?}");
    }
}

#[test]
fn noise_changes_little() {
    let stream = Stream::new(1, Purpose::new("edge noise"), 0);
    let noisy = |image: Image, from: u64| {
        let noise = (0..image.data().len()).map(|i| 0.01 * stream.normal(from + i as u64) as f32);
        let data = image.data().iter().zip(noise).map(|(v, noise)| v + noise).collect();
        Image::from_planes(image.width(), image.height(), data).unwrap()
    };
    let photograph = noisy(step(33.0, 1.0, 0.0, LEVELS), 0);
    let found = StepEdges::of(&photograph, None).unwrap();
    let widths = Ascending::of(found.edges().iter().map(|edge| edge.width));
    let median = widths.interpolated(0.5).unwrap();
    assert!((median / 2.5631 - 1.0).abs() < 0.05, "{median}");
    let blurred = found.in_render(&noisy(step(33.0, 2.0, 0.0, LEVELS), 1_000_000)).unwrap();
    assert!((blurred.ratio - 2.0).abs() < 0.12, "{blurred:?}");
}

#[test]
fn only_straight_steps_between_plateaus_are_edges() {
    let count = |image: &Image| match StepEdges::of(image, None) {
        Err(MetricError::FewEdges { found, least: 20 }) => found,
        other => panic!("{other:?}"),
    };
    assert_eq!(count(&Image::filled(90, 70, 0.4)), 0);
    assert_eq!(count(&Image::new(20, 20)), 0);
    // A thin line, waves, and a small disk.
    assert_eq!(count(&grey(160, 160, |x, _| 0.2 + 0.4 * math::exp(-math::powi(x - 80.0, 2) / 3.0))), 0);
    assert_eq!(count(&grey(160, 160, |x, y| 0.4 + 0.2 * math::sin(0.5 * x + 0.2 * y))), 0);
    let disk = |x: f64, y: f64| {
        let radius = (math::powi(x - 80.0, 2) + math::powi(y - 80.0, 2)).sqrt();
        0.2 + 0.4 * normal(6.0 - radius)
    };
    assert_eq!(count(&grey(160, 160, disk)), 0);
    // A weak step, and one that the mask hides.
    assert_eq!(count(&step(10.0, 1.0, 0.0, [0.3, 0.33])), 0);
    let mut mask = Mask::filled(320, 320, 1);
    (0..320).for_each(|y| (160..170).for_each(|x| mask.set_pixel(x, y, [0])));
    let image = step(0.0, 1.0, 0.0, LEVELS);
    assert!(StepEdges::of(&image, None).is_ok());
    assert!(StepEdges::of(&image, Some(&mask)).is_err());
    assert!(StepEdges::of(&image, Some(&Mask::new(3, 3))).is_err());
    assert!(StepEdges::of(&image, None).unwrap().in_render(&Image::new(9, 9)).is_err());
}

#[test]
fn edges_are_apart_and_at_most_two_hundred() {
    // Steps every 40 columns, up and down.
    let stairs = grey(900, 400, |x, _| {
        let phase = (x / 80.0).fract() * 80.0;
        0.2 + 0.4 * (normal(phase - 20.0) - normal(phase - 60.0))
    });
    let found = StepEdges::of(&stairs, None).unwrap();
    assert_eq!(found.edges().len(), 200);
    for (i, a) in found.edges().iter().enumerate() {
        for b in &found.edges()[..i] {
            assert!(a.strength <= b.strength);
            assert!(math::powi(a.at[0] - b.at[0], 2) + math::powi(a.at[1] - b.at[1], 2) >= 64.0);
        }
    }
}
