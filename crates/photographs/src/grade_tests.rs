//! Properties of the two forms.

use use3d_capture::{Image, Map};
use use3d_numerics::random::{Purpose, Stream};
use use3d_render::Response;

use super::*;

const SIZE: (usize, usize) = (96, 64);

/// A picture with structure at several scales, different for each seed.
fn picture(seed: u64) -> Image {
    let draw = Stream::new(seed, Purpose::new("picture"), 0);
    let (w, h) = SIZE;
    let mut image = Image::new(w, h);
    for y in 0..h {
        for x in 0..w {
            let block = draw.uniform((y / 6 * 64 + x / 6) as u64) as f32;
            let fine = draw.uniform((100_000 + y * w + x) as u64) as f32;
            let v = 0.25 + 0.3 * block + 0.1 * fine;
            image.set_pixel(x, y, [0.6 * v, v, 0.9 * v + 0.05 * x as f32 / w as f32]);
        }
    }
    image
}

/// The answer to light of a look with the matrix `m` in water that lets `t` through.
fn response(m: [[f32; 3]; 3], t: [f32; 3]) -> Response {
    let constant = |values: [f32; 3]| {
        let mut image = Image::new(SIZE.0, SIZE.1);
        (0..3).for_each(|c| image.plane_mut(c).fill(values[c]));
        image
    };
    let column = |j: usize| constant([0, 1, 2].map(|i| m[i][j] * t[j]));
    Response { columns: [column(0), column(1), column(2)], arriving: constant(t) }
}

const IDENTITY: [[f32; 3]; 3] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
const MIXED: [[f32; 3]; 3] = [[1.6, 0.2, -0.1], [0.05, 0.9, 0.1], [-0.1, 0.15, 0.8]];

fn mapped(image: &Image, m: [[f32; 3]; 3], b: [f32; 3]) -> Image {
    let mut out = image.clone();
    for y in 0..image.height() {
        for x in 0..image.width() {
            let p = image.pixel(x, y);
            out.set_pixel(x, y, [0, 1, 2].map(|i| b[i] + (0..3).map(|j| m[i][j] * p[j]).sum::<f32>()));
        }
    }
    out
}

fn seen<'a>(photograph: &'a Image, render: &'a Image, look: &'a Image, response: &'a Response) -> Seen<'a> {
    Seen { photograph, render, look, coverage: None, response, soft: true }
}

fn graded(seen: &Seen<'_>, keep: f32) -> Image {
    let mut pixels = seen.photograph.to_interleaved();
    grade(seen, keep).map.apply(&mut pixels, SIZE.0);
    Image::from_interleaved(SIZE.0, SIZE.1, &pixels).unwrap()
}

fn worst(a: &Image, b: &Image) -> f32 {
    a.data().iter().zip(b.data()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

fn mean_difference(a: &Image, b: &Image) -> f32 {
    a.data().iter().zip(b.data()).map(|(a, b)| (a - b).abs()).sum::<f32>() / a.data().len() as f32
}

#[test]
fn a_look_that_changes_nothing_gives_the_photograph_back() {
    let render = picture(1);
    let photograph = mapped(&render, IDENTITY, [0.03, 0.01, -0.02]);
    let clear_water = response(IDENTITY, [1.0; 3]);
    let out = graded(&seen(&photograph, &render, &render, &clear_water), 1.0);
    assert!(worst(&out, &photograph) < 2e-3, "{}", worst(&out, &photograph));
}

#[test]
fn a_photograph_equal_to_the_render_gives_the_look_also_off_the_diagonal() {
    let render = picture(2);
    let look = mapped(&render, MIXED, [0.02, -0.01, 0.03]);
    let out = graded(&seen(&render, &render, &look, &response(MIXED, [0.5, 0.8, 0.9])), 0.0);
    assert!(worst(&out, &look) < 5e-3, "{}", worst(&out, &look));
    // Without the terms off the diagonal it would not be the look.
    let diagonal = [[1.6, 0.0, 0.0], [0.0, 0.9, 0.0], [0.0, 0.0, 0.8]];
    assert!(worst(&mapped(&render, diagonal, [0.02, -0.01, 0.03]), &look) > 0.05);
}

#[test]
fn the_detail_of_the_photograph_is_answered_by_the_matrix() {
    let render = picture(3);
    let look = mapped(&render, MIXED, [0.0; 3]);
    // The photograph has a line that the render lacks.
    let mut photograph = render.clone();
    (20..70).for_each(|x| photograph.set_pixel(x, 30, render.pixel(x, 30).map(|v| v + 0.05)));
    let out = graded(&seen(&photograph, &render, &look, &response(MIXED, [0.6; 3])), 0.0);
    for x in 30..60 {
        for i in 0..3 {
            let answer: f32 = MIXED[i].iter().sum::<f32>() * 0.05;
            let found = out.pixel(x, 30)[i] - look.pixel(x, 30)[i];
            assert!((found - answer).abs() < 0.012, "{x} {i}: {found} {answer}");
        }
    }
}

#[test]
fn the_light_of_a_shot_goes_or_stays_as_asked() {
    let render = picture(4);
    let photograph = mapped(&render, IDENTITY, [0.06, 0.02, -0.02]);
    let look = mapped(&render, MIXED, [0.0; 3]);
    let answer = response(MIXED, [1.0; 3]);
    let of = |keep| graded(&seen(&photograph, &render, &look, &answer), keep);
    let (none, half, all) = (of(0.0), of(0.5), of(1.0));
    assert!(mean_difference(&none, &look) < 6e-3, "{}", mean_difference(&none, &look));
    let kept = mapped(&photograph, MIXED, [0.0; 3]);
    assert!(mean_difference(&all, &kept) < 6e-3, "{}", mean_difference(&all, &kept));
    let middle: Vec<f32> = none.data().iter().zip(all.data()).map(|(a, b)| 0.5 * (a + b)).collect();
    let middle = Image::from_planes(SIZE.0, SIZE.1, middle).unwrap();
    assert!(mean_difference(&half, &middle) < 1e-3);
}

#[test]
fn where_the_scene_knows_nothing_it_has_no_say() {
    let (w, h) = SIZE;
    let photograph = picture(7);
    // On the right the render shows something else, bright green.
    let (mut render, other) = (photograph.clone(), picture(8));
    for y in 0..h {
        for x in w / 2..w {
            let v = other.pixel(x, y)[1];
            render.set_pixel(x, y, [0.1 * v, 0.4 + v, 0.1 * v]);
        }
    }
    let look = mapped(&render, MIXED, [0.0; 3]);
    let expected = mapped(&photograph, MIXED, [0.0; 3]);
    let answer = response(MIXED, [0.8; 3]);
    let out = graded(&seen(&photograph, &render, &look, &answer), 0.0);
    let mut difference = 0.0f32;
    for y in 10..h - 10 {
        for x in w - 20..w - 4 {
            let (a, b) = (out.pixel(x, y), expected.pixel(x, y));
            difference = difference.max((0..3).map(|c| (a[c] - b[c]).abs()).fold(0.0, f32::max));
        }
    }
    assert!(difference < 0.08, "{difference}");
    // The same for surfaces that no training view saw.
    let none = Map::new(w, h);
    let answer = response(IDENTITY, [1.0; 3]);
    let seen = Seen { coverage: Some(&none), ..seen(&photograph, &photograph, &expected, &answer) };
    let out = graded(&seen, 0.0);
    assert!(worst(&out, &expected) < 0.01, "{}", worst(&out, &expected));
}

#[test]
fn noise_is_not_answered_where_no_light_arrives() {
    let render = picture(9);
    let look = mapped(&render, [[3.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 3.0]], [0.0; 3]);
    let strong = [[40.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 3.0]];
    // A thousandth of the red light arrives, so the answer to red is bounded by the view's own map.
    let answer = response(strong, [1e-3, 0.9, 0.9]);
    let grade = grade(&seen(&render, &render, &look, &answer), 0.0);
    let red = &grade.map.first[..SIZE.0 * SIZE.1];
    assert!(red.iter().all(|m| (*m - 3.0).abs() < 0.2), "{:?}", &red[..4]);
}

#[test]
fn the_mean_of_views_changes_a_photograph_without_a_camera() {
    let photograph = picture(10);
    let view =
        |gain: f32| ViewMap { rows: [[gain, 0.0, 0.0, 0.1], [0.0, gain, 0.0, 0.0], [0.0, 0.0, gain, 0.0]] };
    let mean = ViewMap::mean(&[view(0.5), view(0.7)]);
    assert!((mean.rows[1][1] - 0.6).abs() < 1e-6);
    let mut pixels = photograph.to_interleaved();
    mean.grade(&photograph).apply(&mut pixels, SIZE.0);
    assert!((pixels[0] - (0.6 * photograph.pixel(0, 0)[0] + 0.1)).abs() < 1e-5);
}
