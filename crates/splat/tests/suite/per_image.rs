//! Water applied to composed images: the papers' formula, its derivative, and the cases in which it equals
//! water in front of every Gaussian.

use glam::DVec3;
use use3d_capture::{Camera, Formation, Image, MediumMaps};
use use3d_numerics::math;
use use3d_splat::{
    GaussianGradients, Gaussians, Gradients, Options, Prepared, Rasterizer, RenderGradients, Rendered, ViewOf,
};

use crate::support::{
    engines, fused_engines, prepared, random_camera, random_gaussians, random_image, random_map,
    random_medium,
};

const SIZE: (usize, usize) = (53, 38);
const LAYERS: Options =
    Options { depth_gradient: true, layers: true, signed_screen: false, water_only: false };

struct View {
    camera: Camera,
    gaussians: Gaussians,
    prepared: Prepared,
    water: MediumMaps,
}

/// Random Gaussians behind water applied to the image; all at one depth if `flat`.
fn view(seed: u64, flat: bool) -> View {
    view_of(-1.2, seed, flat)
}

/// The same view with Gaussians around a given log scale.
fn view_of(log_scale: f64, seed: u64, flat: bool) -> View {
    let camera = random_camera(SIZE.0, SIZE.1);
    let mut gaussians = random_gaussians(60, log_scale, seed);
    if flat {
        for mean in &mut gaussians.means {
            let seen = camera.pose.rotation * DVec3::from(mean.map(f64::from)) + camera.pose.translation;
            let at = DVec3::new(seen.x, seen.y, 4.0) - camera.pose.translation;
            *mean = (camera.pose.rotation.transpose() * at).as_vec3().to_array();
        }
    }
    let mut water = random_medium(SIZE.0, SIZE.1, seed.is_multiple_of(2), seed);
    water.formation = Formation::PerImage;
    View { prepared: prepared(&gaussians, &camera), camera, gaussians, water }
}

fn draw(rasterizer: &mut Rasterizer, view: &View, water: Option<&MediumMaps>) -> Rendered {
    let mut out = Rendered::new();
    rasterizer.forward(&view.prepared, water, &LAYERS, &mut out);
    out
}

fn gradients(
    rasterizer: &mut Rasterizer,
    view: &View,
    water: &MediumMaps,
    d_rendered: &RenderGradients<'_>,
) -> (GaussianGradients, MediumMaps) {
    let (mut gaussians, mut maps) = (GaussianGradients::default(), MediumMaps::zeros(0, 0));
    let of = ViewOf { gaussians: &view.gaussians, camera: &view.camera };
    let into = Gradients { gaussians: &mut gaussians, medium: Some(&mut maps) };
    rasterizer.backward(&view.prepared, of, Some(water), &LAYERS, d_rendered, into);
    (gaussians, maps)
}

fn only(image: &Image) -> RenderGradients<'_> {
    RenderGradients { image, depth: None, accumulation: None, clear: None }
}

/// `I = J e^{−β_a s} + c_m (1 − A e^{−β_b s})` in f64, from the image composed without water. Where a pixel
/// is opaque, this is SeaSplat's `J e^{−β_a s} + c_m (1 − e^{−β_b s})`; where nothing is hit, it is open
/// water.
#[test]
fn a_pixel_is_one_surface_at_its_expected_distance() {
    let view = view_of(-1.6, 3, false);
    for (name, mut rasterizer) in engines() {
        let clear = draw(&mut rasterizer, &view, None);
        let formed = draw(&mut rasterizer, &view, Some(&view.water));
        let (before, after) = (clear.layers.unwrap(), formed.layers.unwrap());
        assert_eq!((&clear.depth, &clear.accumulation), (&formed.depth, &formed.accumulation));
        assert_eq!((&before.clear, &before.distance), (&after.clear, &after.distance));
        let (mut open, mut opaque) = (0, 0);
        for y in 0..SIZE.1 {
            for x in 0..SIZE.0 {
                let at = |image: &Image| image.pixel(x, y).map(f64::from);
                let a = f64::from(clear.accumulation.pixel(x, y)[0]);
                let s = f64::from(before.distance.pixel(x, y)[0]);
                let (light, color) = (at(&clear.image), at(&view.water.color));
                let (beta_a, beta_b) = (at(&view.water.attenuation), at(&view.water.backscatter));
                open += usize::from(a < 0.01);
                opaque += usize::from(a > 0.9);
                for c in 0..3 {
                    let veil = math::exp(-beta_b[c] * s);
                    let object = light[c] * math::exp(-beta_a[c] * s);
                    let far = (1.0 - a) * color[c] * veil;
                    let between = color[c] * (1.0 - a * veil) - far;
                    let close = |image: &Image, expected: f64| {
                        let found = f64::from(image.pixel(x, y)[c]);
                        assert!((found - expected).abs() < 2e-6, "{name} {x} {y}: {found} {expected}");
                    };
                    close(&formed.image, object + between + far);
                    close(&after.object, object);
                    close(&after.medium, between);
                    close(&after.far, far);
                }
            }
        }
        assert!(open > 20 && opaque > 20, "{open} open, {opaque} opaque");
    }
}

/// With every Gaussian at one depth there is one distance per pixel, so both formations give the same image
/// and the same derivatives.
#[test]
fn at_one_depth_both_formations_agree() {
    let view = view(4, true);
    let in_front = MediumMaps { formation: Formation::PerGaussian, ..view.water.clone() };
    let close = |what: &str, found: &[f32], expected: &[f32]| {
        let size = expected.iter().fold(0.0f32, |most, v| most.max(v.abs()));
        let off = found.iter().zip(expected).fold(0.0f32, |most, (a, b)| most.max((a - b).abs()));
        assert!(size > 0.0 && off < 1e-4 * size.max(1.0), "{what}: off by {off} of {size}");
    };
    let d_image = random_image(SIZE.0, SIZE.1, 8);
    let mut rasterizer = Rasterizer::new();
    let (over, front) =
        (draw(&mut rasterizer, &view, Some(&view.water)), draw(&mut rasterizer, &view, Some(&in_front)));
    close("image", over.image.data(), front.image.data());
    let (a, b) = (over.layers.unwrap(), front.layers.unwrap());
    close("object", a.object.data(), b.object.data());
    close("medium", a.medium.data(), b.medium.data());
    close("far", a.far.data(), b.far.data());
    let ((over, maps), (front, expected)) = (
        gradients(&mut rasterizer, &view, &view.water, &only(&d_image)),
        gradients(&mut rasterizer, &view, &in_front, &only(&d_image)),
    );
    close("opacities", &over.opacity_logits, &front.opacity_logits);
    close("colours", over.sh.as_flattened().as_flattened(), front.sh.as_flattened().as_flattened());
    close("scales", over.log_scales.as_flattened(), front.log_scales.as_flattened());
    close("c_m", maps.color.data(), expected.color.data());
    close("β_bs", maps.backscatter.data(), expected.backscatter.data());
    close("β_attn", maps.attenuation.data(), expected.attenuation.data());
}

#[test]
fn fused_engines_give_the_same_bits() {
    for formation in [Formation::PerImage, Formation::Normalised] {
        let mut view = view(5, false);
        view.water.formation = formation;
        fused_engines_agree(&view);
    }
}

fn fused_engines_agree(view: &View) {
    let (image, clear) = (random_image(SIZE.0, SIZE.1, 1), random_image(SIZE.0, SIZE.1, 2));
    let (depth, accumulation) = (random_map(SIZE.0, SIZE.1, 3), random_map(SIZE.0, SIZE.1, 4));
    let d_rendered = RenderGradients {
        image: &image,
        depth: Some(&depth),
        accumulation: Some(&accumulation),
        clear: Some(&clear),
    };
    let mut found = fused_engines().into_iter().map(|(name, mut rasterizer)| {
        let drawn = draw(&mut rasterizer, view, Some(&view.water));
        (name, drawn, gradients(&mut rasterizer, view, &view.water, &d_rendered))
    });
    let (_, first, differentiated) = found.next().unwrap();
    for (name, drawn, derived) in found {
        assert!(drawn == first && derived == differentiated, "{name}");
    }
}

/// The image is linear in the colours, and the derivative needs no forward pass before it.
#[test]
fn derivatives_of_colours_are_those_of_the_colours_there_are() {
    let mut view = view(6, false);
    let d_image = random_image(SIZE.0, SIZE.1, 9);
    let n = view.gaussians.len();
    let colors: Vec<[f32; 3]> =
        (0..n).map(|i| std::array::from_fn(|c| 0.2 + 0.1 * ((i + c) % 5) as f32)).collect();
    let dot = |a: &Image, b: &Image| -> f64 {
        a.data().iter().zip(b.data()).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
    };
    let mut rasterizer = Rasterizer::new();
    draw(&mut rasterizer, &view, Some(&view.water));
    view.prepared.set_colors(&colors);
    let (mut grads, mut maps) = (vec![[0.0f32; 3]; n], MediumMaps::zeros(0, 0));
    rasterizer.backward_colors(&view.prepared, Some(&view.water), &d_image, &mut grads, &mut maps);
    // The gradient of the water equals that of the full derivative, also where nothing else is asked for.
    let (mut kept, mut alone) = (GaussianGradients::default(), MediumMaps::zeros(0, 0));
    let of = ViewOf { gaussians: &view.gaussians, camera: &view.camera };
    let into = Gradients { gaussians: &mut kept, medium: Some(&mut alone) };
    let water_only = Options { water_only: true, ..LAYERS };
    rasterizer.backward(&view.prepared, of, Some(&view.water), &water_only, &only(&d_image), into);
    assert_eq!((&alone, kept), (&maps, GaussianGradients::default()));
    assert_eq!(maps, gradients(&mut Rasterizer::new(), &view, &view.water, &only(&d_image)).1);
    let lit = dot(&draw(&mut rasterizer, &view, Some(&view.water)).image, &d_image);
    view.prepared.set_colors(&vec![[0.0; 3]; n]);
    let dark = dot(&draw(&mut rasterizer, &view, Some(&view.water)).image, &d_image);
    let along: f64 = grads
        .as_flattened()
        .iter()
        .zip(colors.as_flattened())
        .map(|(g, c)| f64::from(*g) * f64::from(*c))
        .sum();
    assert!((lit - dark - along).abs() < 1e-4 * (lit - dark).abs().max(1.0), "{lit} − {dark}, {along}");
}
