//! Things that the scene does not have: a fish that passes, and an object that no other view shows. They are
//! graded like their surroundings, without a halo round them and without a ghost of the scene in them.

use use3d_capture::{Image, Map};
use use3d_metrics::ciede2000;
use use3d_numerics::math;
use use3d_numerics::random::{Purpose, Stream};
use use3d_photographs::{Grade, Seen, grade};
use use3d_render::Response;

const SIZE: (usize, usize) = (640, 400);

/// A picture of the values of a function of the place.
fn picture(f: impl Fn(usize, usize) -> [f32; 3]) -> Image {
    let mut image = Image::new(SIZE.0, SIZE.1);
    for y in 0..SIZE.1 {
        for x in 0..SIZE.0 {
            image.set_pixel(x, y, f(x, y));
        }
    }
    image
}

/// A sea floor of stones of several sizes, different for each seed.
fn floor(seed: u64) -> Image {
    let draw = Stream::new(seed, Purpose::new("floor"), 0);
    let stone = |size: usize, x: usize, y: usize| {
        draw.uniform((size * 1_000_000 + y / size * 1000 + x / size) as u64) as f32
    };
    picture(|x, y| {
        let v = 0.15 + 0.15 * stone(50, x, y) + 0.15 * stone(11, x, y) + 0.08 * stone(2, x, y);
        [0.55 * v, v, 0.9 * v]
    })
}

/// The factors of the look, which change over the picture.
fn gain(x: usize) -> [f32; 3] {
    let far = x as f32 / SIZE.0 as f32;
    [1.8 + 0.8 * far, 1.1 + 0.1 * far, 1.0]
}

/// The photograph of the floor in a light of its own, with some grain.
fn photograph_of(floor: &Image) -> Image {
    let draw = Stream::new(9, Purpose::new("grain"), 0);
    picture(|x, y| {
        let lamp = 0.03 + 0.03 * (x as f32 / SIZE.0 as f32);
        let grain = 0.006 * draw.normal((y * SIZE.0 + x) as u64) as f32;
        let [r, g, b] = floor.pixel(x, y);
        [r + lamp + grain, g + 0.7 * lamp + grain, b + 0.2 * lamp + grain]
    })
}

/// The photograph in the look, in water that lets most light through.
fn graded(photograph: &Image, render: &Image) -> (Image, Grade) {
    let look = picture(|x, y| {
        let (p, m) = (render.pixel(x, y), gain(x));
        [m[0] * p[0], m[1] * p[1] + 0.02, m[2] * p[2]]
    });
    let light = [0.5f32, 0.8, 0.85];
    let column =
        |j: usize| picture(|x, _| std::array::from_fn(|i| if i == j { gain(x)[j] * light[j] } else { 0.0 }));
    let response = Response { columns: [column(0), column(1), column(2)], arriving: picture(|_, _| light) };
    let seen = Seen { photograph, render, look: &look, coverage: None, response: &response, soft: true };
    let grade = grade(&seen, 0.0);
    let mut pixels = photograph.to_interleaved();
    grade.map.apply(&mut pixels, SIZE.0);
    (Image::from_interleaved(SIZE.0, SIZE.1, &pixels).expect("its own size"), grade)
}

/// An ellipse: centre and radii, pixels.
#[derive(Clone, Copy)]
struct Ellipse {
    centre: (f32, f32),
    radii: (f32, f32),
}

impl Ellipse {
    /// The distance from its edge in pixels, roughly; 0 inside.
    fn outside(&self, x: usize, y: usize) -> f32 {
        let (u, v) = ((x as f32 - self.centre.0) / self.radii.0, (y as f32 - self.centre.1) / self.radii.1);
        (math::hypot(f64::from(u), f64::from(v)) as f32 - 1.0).max(0.0) * self.radii.0.min(self.radii.1)
    }
}

fn mean_where(map: &Map, inside: impl Fn(usize, usize) -> bool) -> f32 {
    let (mut sum, mut count) = (0.0, 0.0f32);
    for y in 0..SIZE.1 {
        for x in 0..SIZE.0 {
            if inside(x, y) {
                (sum, count) = (sum + map.pixel(x, y)[0], count + 1.0);
            }
        }
    }
    sum / count
}

#[test]
fn no_halo_stands_round_a_fish() {
    let render = floor(1);
    let without = photograph_of(&render);
    let plain = graded(&without, &render).0;
    let fish = |centre, radii| Ellipse { centre, radii };
    for (fish, colour) in [
        (fish((330.0, 200.0), (40.0, 16.0)), [0.10, 0.12, 0.14]),
        (fish((200.0, 120.0), (25.0, 12.0)), [0.75, 0.72, 0.60]),
        (fish((480.0, 280.0), (60.0, 30.0)), [0.70, 0.45, 0.10]),
    ] {
        let with = picture(|x, y| {
            let stripe = if (x / 7 + y / 5).is_multiple_of(3) { 0.75 } else { 1.0 };
            if fish.outside(x, y) == 0.0 { colour.map(|v| v * stripe) } else { without.pixel(x, y) }
        });
        let apart = ciede2000(&graded(&with, &render).0, &plain).expect("one size");
        let ring = mean_where(&apart, |x, y| (1e-6..=12.0).contains(&fish.outside(x, y)));
        println!("ring of 12 pixels: {ring}");
        assert!(ring <= 3.0, "{colour:?}: {ring}");
    }
}

#[test]
fn an_object_of_one_view_is_graded_by_the_view_and_has_no_ghost_of_the_scene() {
    let (render, own) = (floor(2), floor(77));
    let without = photograph_of(&render);
    // 15 % of the picture.
    let object = Ellipse { centre: (300.0, 200.0), radii: (150.0, 81.0) };
    let inside = |x: usize, y: usize| object.outside(x, y) == 0.0;
    let photograph = picture(|x, y| {
        let v = own.pixel(x, y)[1];
        if inside(x, y) { [1.1 * v + 0.1, 0.8 * v + 0.1, 0.5 * v] } else { without.pixel(x, y) }
    });
    let (out, grade) = graded(&photograph, &render);
    let mut expected = photograph.to_interleaved();
    grade.own.grade(&photograph).apply(&mut expected, SIZE.0);
    let expected = Image::from_interleaved(SIZE.0, SIZE.1, &expected).expect("its own size");
    let apart = mean_where(&ciede2000(&out, &expected).expect("one size"), inside);
    println!("inside: {apart}");
    assert!(apart <= 4.0, "{apart}");
    let (mut both, mut one, mut two) = (0.0f64, 0.0f64, 0.0f64);
    for (x, y) in (1..SIZE.1 - 1).flat_map(|y| (1..SIZE.0 - 1).map(move |x| (x, y))) {
        let slopes = |image: &Image| {
            let at = |x: usize, y: usize| f64::from(image.pixel(x, y)[1]);
            [at(x + 1, y) - at(x, y), at(x, y + 1) - at(x, y)]
        };
        if inside(x, y) && inside(x + 1, y) && inside(x, y + 1) {
            for (a, b) in slopes(&out).into_iter().zip(slopes(&render)) {
                (both, one, two) = (both + a * b, one + a * a, two + b * b);
            }
        }
    }
    let ghost = both / (one * two).sqrt();
    println!("correlation of gradients: {ghost}");
    assert!(ghost.abs() <= 0.1, "{ghost}");
}
