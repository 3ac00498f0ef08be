//! Properties that hold for any numbers.

use glam::{DMat3, DQuat, DVec3};
use use3d_capture::{Image, Lattice, MediumMaps, Pose};
use use3d_numerics::math;
use use3d_splat::{
    Colors, GaussianGradients, Gradients, Options, Prepared, Rasterizer, RenderGradients, Rendered, ViewOf,
    view_colors,
};

use crate::support::{
    lattice, prepared, random_camera, random_gaussians, random_image, random_map, random_medium,
};

fn render(view: &Prepared, medium: Option<&MediumMaps>) -> Rendered {
    let mut out = Rendered::new();
    Rasterizer::new().forward(view, medium, &Options { layers: true, ..Options::default() }, &mut out);
    out
}

fn worst(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

#[test]
fn the_adjoint_is_the_transpose() {
    for seed in 0..4 {
        let (camera, gaussians) = (random_camera(90, 70), random_gaussians(300, -1.8, seed));
        let view = prepared(&gaussians, &camera);
        for channels in [1, 3, 7, 8, 13] {
            let x: Vec<f32> =
                (0..channels * gaussians.len()).map(|i| math::cos((i * i) as f32 * 0.013)).collect();
            let y: Vec<f32> = (0..channels * 90 * 70).map(|i| math::sin(i as f32 * 0.7) + 0.3).collect();
            let (mut sx, mut sy) = (vec![0.0; y.len()], vec![0.0; x.len()]);
            let mut rasterizer = Rasterizer::new();
            rasterizer.splat(&view, channels, &x, &mut sx);
            rasterizer.splat_adjoint(&view, channels, &y, &mut sy);
            let dot = |a: &[f32], b: &[f32]| -> (f64, f64) {
                a.iter().zip(b).fold((0.0, 0.0), |(s, n), (a, b)| {
                    let p = f64::from(*a) * f64::from(*b);
                    (s + p, n + p.abs())
                })
            };
            let ((left, size), (right, _)) = (dot(&sx, &y), dot(&x, &sy));
            // The difference is bounded relative to the size of the terms, and to the result itself.
            assert!((left - right).abs() <= 1e-6 * size, "{left} {right} {size}");
            assert!((left - right).abs() <= 1e-5 * left.abs().max(1e-2 * size), "{left} {right}");
        }
        // Sᵀ1 summed over Gaussians is the accumulation summed over pixels.
        let mut lifted = vec![0.0; gaussians.len()];
        Rasterizer::new().splat_adjoint(&view, 1, &vec![1.0; 90 * 70], &mut lifted);
        let total: f64 = lifted.iter().map(|v| f64::from(*v)).sum();
        let accumulated: f64 = render(&view, None).accumulation.data().iter().map(|v| f64::from(*v)).sum();
        assert!((total / accumulated - 1.0).abs() < 1e-6);
    }
}

#[test]
fn water_of_the_objects_own_colour_hides_them() {
    let (camera, gaussians) = (random_camera(60, 40), random_gaussians(200, -1.5, 3));
    let mut view = prepared(&gaussians, &camera);
    let color = [0.2, 0.5, 0.7];
    view.set_colors(&vec![color; gaussians.len()]);
    let mut medium = random_medium(60, 40, true, 4);
    medium.attenuation = medium.backscatter.clone();
    for c in 0..3 {
        medium.color.plane_mut(c).fill(color[c]);
    }
    let out = render(&view, Some(&medium));
    for c in 0..3 {
        assert!(out.image.plane(c).iter().all(|v| (v - color[c]).abs() < 2e-6));
    }
}

#[test]
fn clear_water_leaves_objects_on_the_medium_colour() {
    let (camera, gaussians) = (random_camera(60, 40), random_gaussians(100, -1.9, 5));
    let view = prepared(&gaussians, &camera);
    let mut medium = random_medium(60, 40, true, 4);
    medium.attenuation.data_mut().fill(0.0);
    medium.backscatter.data_mut().fill(0.0);
    let out = render(&view, Some(&medium));
    let layers = out.layers.as_ref().unwrap();
    assert!(worst(layers.object.data(), layers.clear.data()) < 1e-6);
    assert!(worst(layers.clear.data(), render(&view, None).image.data()) < 1e-6);
    for c in 0..3 {
        for p in 0..60 * 40 {
            let rest = 1.0 - out.accumulation.data()[p];
            let expected = layers.clear.plane(c)[p] + rest * medium.color.plane(c)[p];
            assert!((out.image.plane(c)[p] - expected).abs() < 2e-6);
        }
    }
    // Nothing is visible: the image is the medium alone, without depth.
    let nothing = render(&prepared(&random_gaussians(0, 0.0, 0), &camera), Some(&medium));
    assert_eq!(nothing.image, medium.color);
    assert!(nothing.depth.data().iter().chain(nothing.accumulation.data()).all(|v| *v == 0.0));
}

#[test]
fn the_layers_add_up_to_the_image() {
    let (camera, gaussians) = (random_camera(60, 40), random_gaussians(200, -1.5, 6));
    let out = render(&prepared(&gaussians, &camera), Some(&random_medium(60, 40, false, 7)));
    let layers = out.layers.unwrap();
    let sum: Vec<f32> = (0..3 * 60 * 40)
        .map(|i| layers.object.data()[i] + layers.medium.data()[i] + layers.far.data()[i])
        .collect();
    assert!(worst(&sum, out.image.data()) < 2e-6);
    assert!(layers.medium.data().iter().chain(layers.far.data()).all(|v| *v > -1e-6));
    assert!(out.accumulation.data().iter().all(|v| (0.0..1.0).contains(v)));
}

#[test]
fn a_rigid_motion_of_world_and_camera_changes_nothing() {
    let (camera, gaussians) = (random_camera(60, 40), random_gaussians(150, -1.5, 8));
    let turn = DQuat::from_axis_angle(DVec3::new(0.3, -0.8, 0.5).normalize(), 1.1);
    let shift = DVec3::new(1.5, -0.7, 2.0);
    let mut moved = gaussians.clone();
    for i in 0..moved.len() {
        let m = turn * DVec3::from_array(gaussians.means[i].map(f64::from)) + shift;
        moved.means[i] = m.as_vec3().to_array();
        let [w, x, y, z] = gaussians.quaternions[i].map(f64::from);
        let norm = (w * w + x * x + y * y + z * z).sqrt();
        let q = turn * DQuat::from_xyzw(x / norm, y / norm, z / norm, w / norm);
        moved.quaternions[i] = [q.w as f32, q.x as f32, q.y as f32, q.z as f32];
    }
    // x_camera = R Tᵀ (x' − s) + t
    let rotation = camera.pose.rotation * DMat3::from_quat(turn).transpose();
    let pose = Pose { rotation, translation: camera.pose.translation - rotation * shift };
    let mut still = Prepared::new();
    still.prepare(&gaussians, &camera, &lattice(&camera), Colors::Sh { degree: 0 });
    let mut turned = Prepared::new();
    let moved_camera = use3d_capture::Camera { pose, ..camera };
    turned.prepare(&moved, &moved_camera, &lattice(&camera), Colors::Sh { degree: 0 });
    let medium = random_medium(60, 40, true, 1);
    let (a, b) = (render(&still, Some(&medium)), render(&turned, Some(&medium)));
    // A pixel on a contour may flip: it changes by at most 1/255, and nothing else changes.
    let differences: Vec<f32> =
        a.image.data().iter().zip(b.image.data()).map(|(a, b)| (a - b).abs()).collect();
    assert!(differences.iter().all(|d| *d < 5e-3));
    assert!(differences.iter().filter(|d| **d > 2e-5).count() < differences.len() / 200);
}

#[test]
fn permuting_gaussians_permutes_gradients_and_keeps_the_image() {
    let (camera, gaussians) = (random_camera(60, 40), random_gaussians(150, -1.5, 10));
    let order: Vec<usize> = (0..150).map(|i| (i * 67 + 13) % 150).collect();
    let shuffled = gaussians.select(&order);
    let medium = random_medium(60, 40, true, 1);
    let image = random_image(60, 40, 2);
    let d_rendered = RenderGradients { image: &image, depth: None, accumulation: None, clear: None };
    let run = |g: &use3d_splat::Gaussians| {
        let view = prepared(g, &camera);
        let mut grads = GaussianGradients::default();
        let options = Options::default();
        Rasterizer::new().backward(
            &view,
            ViewOf { gaussians: g, camera: &camera },
            Some(&medium),
            &options,
            &d_rendered,
            Gradients { gaussians: &mut grads, medium: None },
        );
        (render(&view, Some(&medium)).image, grads)
    };
    let ((image_a, grads_a), (image_b, grads_b)) = (run(&gaussians), run(&shuffled));
    assert_eq!(image_a, image_b);
    for (to, &from) in order.iter().enumerate() {
        assert_eq!(grads_a.means[from], grads_b.means[to]);
        assert_eq!(grads_a.sh[from], grads_b.sh[to]);
        assert_eq!(grads_a.screen[from], grads_b.screen[to]);
    }
}

/// The lattice of some columns and rows shows exactly the pixels of the whole image.
#[test]
fn a_sparse_lattice_renders_the_pixels_of_the_whole_image() {
    let (camera, gaussians) = (random_camera(97, 75), random_gaussians(400, -1.9, 12));
    let medium = random_medium(97, 75, false, 3);
    let whole = render(&prepared(&gaussians, &camera), Some(&medium));
    let columns: Vec<usize> = (0..97).filter(|x| x % 5 != 1 && x % 7 < 4).collect();
    let rows: Vec<usize> = (0..75).filter(|y| y % 3 != 2).collect();
    let pick = |image: &Image| {
        let mut out = Image::new(columns.len(), rows.len());
        for (j, &y) in rows.iter().enumerate() {
            for (i, &x) in columns.iter().enumerate() {
                out.set_pixel(i, j, image.pixel(x, y));
            }
        }
        out
    };
    let some = MediumMaps {
        color: pick(&medium.color),
        backscatter: pick(&medium.backscatter),
        attenuation: pick(&medium.attenuation),
        formation: medium.formation,
        network: None,
    };
    let mut view = Prepared::new();
    let sparse = Lattice::subset(&columns, &rows).unwrap();
    view.prepare(&gaussians, &camera, &sparse, Colors::Sh { degree: 3 });
    let part = render(&view, Some(&some));
    // The exponentials' reduction is per tile, and the tiles differ, so the pixels are equal only to
    // rounding.
    assert!(worst(part.image.data(), pick(&whole.image).data()) < 2e-6);
}

#[test]
fn given_colours_are_used_as_they_are() {
    let (camera, gaussians) = (random_camera(40, 40), random_gaussians(80, -1.5, 13));
    let mut colors = Vec::new();
    view_colors(&gaussians, &camera, 2, &mut colors);
    let (mut sh, mut given) = (Prepared::new(), Prepared::new());
    sh.prepare(&gaussians, &camera, &lattice(&camera), Colors::Sh { degree: 2 });
    given.prepare(&gaussians, &camera, &lattice(&camera), Colors::Given(&colors));
    assert_eq!(render(&sh, None), render(&given, None));
    given.set_colors(&vec![[-1.0, 0.0, 2.0]; gaussians.len()]);
    let out = render(&given, None);
    for (a, v) in out.accumulation.data().iter().zip(out.image.plane(0)) {
        assert!((a + v).abs() < 1e-6);
    }
}

/// The absolute statistic is the sum over pixels of the absolute gradients that each pixel has alone. So it
/// bounds the absolute value of the projected gradient.
#[test]
fn the_screen_statistic_bounds_the_projected_gradient() {
    let (camera, gaussians) = (random_camera(40, 30), random_gaussians(50, -1.5, 14));
    let view = prepared(&gaussians, &camera);
    let run = |image: &Image| {
        let mut grads = GaussianGradients::default();
        let d_rendered = RenderGradients { image, depth: None, accumulation: None, clear: None };
        let options = Options::default();
        Rasterizer::new().backward(
            &view,
            ViewOf { gaussians: &gaussians, camera: &camera },
            None,
            &options,
            &d_rendered,
            Gradients { gaussians: &mut grads, medium: None },
        );
        grads.screen
    };
    let whole = random_image(40, 30, 5);
    let screen = run(&whole);
    let mut sum = vec![[0.0f64; 2]; gaussians.len()];
    for y in 0..30 {
        for x in 0..40 {
            let mut one = Image::new(40, 30);
            one.set_pixel(x, y, whole.pixel(x, y));
            for (sum, pixel) in sum.iter_mut().zip(run(&one)) {
                sum[0] += f64::from(pixel[0]);
                sum[1] += f64::from(pixel[1]);
            }
        }
    }
    let size = screen.iter().flatten().fold(0.0f32, |m, v| m.max(*v));
    assert!(size > 0.0);
    for (a, b) in screen.iter().zip(&sum) {
        for k in 0..2 {
            assert!((f64::from(a[k]) - b[k]).abs() < 1e-5 * f64::from(size), "{a:?} {b:?}");
        }
    }
}

/// Moving the principal point moves the projections and nothing else, so one pixel's derivative by it is the
/// screen statistic of that pixel.
#[test]
fn the_screen_statistic_of_one_pixel_is_its_projected_gradient() {
    let (camera, gaussians) = (random_camera(40, 30), random_gaussians(1, -1.5, 4));
    let mut d_image = Image::new(40, 30);
    let view = prepared(&gaussians, &camera);
    let drawn = render(&view, None).accumulation;
    let order = |p: usize| (drawn.data()[p] - 0.4 * drawn.data().iter().fold(0.0f32, |m, v| m.max(*v))).abs();
    let pixel = (0..40 * 30).min_by(|a, b| order(*a).total_cmp(&order(*b))).unwrap();
    d_image.set_pixel(pixel % 40, pixel / 40, [1.0, 0.5, 0.25]);
    let mut grads = GaussianGradients::default();
    Rasterizer::new().backward(
        &view,
        ViewOf { gaussians: &gaussians, camera: &camera },
        None,
        &Options::default(),
        &RenderGradients { image: &d_image, depth: None, accumulation: None, clear: None },
        Gradients { gaussians: &mut grads, medium: None },
    );
    let loss = |dx: f64, dy: f64| -> f64 {
        let mut moved = camera;
        (moved.intrinsics.cx, moved.intrinsics.cy) = (camera.intrinsics.cx + dx, camera.intrinsics.cy + dy);
        let image = render(&prepared(&gaussians, &moved), None).image;
        let value = image.pixel(pixel % 40, pixel / 40);
        f64::from(value[0]) + 0.5 * f64::from(value[1]) + 0.25 * f64::from(value[2])
    };
    const STEP: f64 = 0.02;
    let by = [
        (loss(STEP, 0.0) - loss(-STEP, 0.0)) / (2.0 * STEP),
        (loss(0.0, STEP) - loss(0.0, -STEP)) / (2.0 * STEP),
    ];
    for k in 0..2 {
        let found = f64::from(grads.screen[0][k]);
        assert!(found > 1e-3 && (found - by[k].abs()).abs() < 1e-2 * found, "{k}: {found} {by:?}");
    }
}

#[test]
fn a_gradient_alone_is_the_gradient_beside_zeros() {
    let (camera, gaussians) = (random_camera(48, 36), random_gaussians(120, -1.5, 17));
    let (view, medium) = (prepared(&gaussians, &camera), random_medium(48, 36, true, 5));
    let (zeros, none) = (Image::new(48, 36), use3d_capture::Map::new(48, 36));
    let (clear, map) = (random_image(48, 36, 8), random_map(48, 36, 9));
    let run = |given: &RenderGradients<'_>, water: Option<&MediumMaps>| {
        let mut grads = GaussianGradients::default();
        Rasterizer::new().backward(
            &view,
            ViewOf { gaussians: &gaussians, camera: &camera },
            water,
            &Options::default(),
            given,
            Gradients { gaussians: &mut grads, medium: None },
        );
        grads.means
    };
    let nothing = RenderGradients { image: &zeros, depth: None, accumulation: None, clear: None };
    let all =
        RenderGradients { depth: Some(&none), accumulation: Some(&none), clear: Some(&zeros), ..nothing };
    for water in [None, Some(&medium)] {
        for (alone, beside) in [
            (RenderGradients { depth: Some(&map), ..nothing }, RenderGradients { depth: Some(&map), ..all }),
            (
                RenderGradients { accumulation: Some(&map), ..nothing },
                RenderGradients { accumulation: Some(&map), ..all },
            ),
            (
                RenderGradients { clear: Some(&clear), ..nothing },
                RenderGradients { clear: Some(&clear), ..all },
            ),
        ] {
            let (alone, beside) = (run(&alone, water), run(&beside, water));
            assert!(alone.iter().flatten().any(|v| v.abs() > 1e-3));
            assert_eq!(alone, beside);
        }
    }
}

#[test]
fn pairs_are_counted_to_the_gaussian_that_fills_a_pixel() {
    let (w, h) = (50, 40);
    let mut gaussians = random_gaussians(4, -1.5, 2);
    gaussians.means = (0..4).map(|k| [0.0, 0.0, 0.2 * k as f32]).collect();
    gaussians.log_scales = vec![[6.0; 3]; 4];
    gaussians.opacity_logits = vec![12.0; 4];
    let pairs = prepared(&gaussians, &random_camera(w, h)).pairs();
    // The first one leaves 0.001 of the light. The second one would leave less than 1e-4, so the pixel ends
    // there without it, and nothing asks for the others.
    let pixels = (w * h) as u64;
    assert_eq!((pairs.contributing, pairs.tested), (pixels, 2 * pixels));
    assert_eq!(pairs.entries, 4 * (w.div_ceil(16) * h.div_ceil(16)) as u64);
}

#[test]
fn signed_screen_gradients_are_those_of_a_moved_principal_point_and_radii_those_of_the_ellipse() {
    let (mut camera, gaussians) = (random_camera(60, 40), random_gaussians(1, -1.2, 9));
    let d_image = random_image(60, 40, 3);
    let loss = |camera: &use3d_capture::Camera| {
        let out = render(&prepared(&gaussians, camera), None).image;
        out.data().iter().zip(d_image.data()).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>()
    };
    let screens = |signed_screen: bool| {
        let (mut out, options) =
            (GaussianGradients::default(), Options { signed_screen, ..Options::default() });
        let d_rendered = RenderGradients { image: &d_image, depth: None, accumulation: None, clear: None };
        let of = ViewOf { gaussians: &gaussians, camera: &camera };
        let grads = Gradients { gaussians: &mut out, medium: None };
        Rasterizer::new().backward(&prepared(&gaussians, &camera), of, None, &options, &d_rendered, grads);
        (out.signed_screen, out.screen[0])
    };
    let (signed, absolute) = screens(true);
    assert_eq!(screens(false), (vec![], absolute));
    let signed = signed[0];
    let h = 0.05;
    for axis in 0..2 {
        let at = |by: f64| {
            let mut moved = camera;
            *[&mut moved.intrinsics.cx, &mut moved.intrinsics.cy][axis] += by;
            loss(&moved)
        };
        let numeric = (at(h) - at(-h)) / (2.0 * h);
        let (own, most) = (f64::from(signed[axis]), f64::from(absolute[axis]));
        assert!((own - numeric).abs() < 0.05 * most, "{own} against {numeric}, at most {most}");
        assert!(own.abs() <= most * (1.0 + 1e-5));
    }
    // A ball straight ahead is a disc with the radius 3 √((f σ / z)² + 0.3).
    camera.intrinsics.fy = camera.intrinsics.fx;
    let (mut ball, place) = (gaussians.clone(), camera.pose.center());
    let ahead = place + camera.pose.rotation.transpose() * (glam::DVec3::Z * 2.0);
    ball.means[0] = ahead.as_vec3().to_array();
    ball.log_scales[0] = [use3d_numerics::math::ln(0.1f32); 3];
    let mut radii = vec![0.0];
    prepared(&ball, &camera).raise_radii(&mut radii);
    let spread = camera.intrinsics.fx * 0.1 / 2.0;
    let expected = 3.0 * (spread * spread + 0.3).sqrt();
    assert!((f64::from(radii[0]) - expected).abs() < 0.02 * expected, "{radii:?} {expected}");
}
