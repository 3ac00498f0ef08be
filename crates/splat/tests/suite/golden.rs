//! Compares the compositor with the independent float64 oracle: forward and every gradient, on every
//! engine.

use use3d_capture::{Camera, Image, Map, MediumMaps};
use use3d_golden::{Case, Part};
use use3d_splat::{
    Colors, GaussianGradients, Gaussians, Gradients, Options, Prepared, Rasterizer, RenderGradients,
    Rendered, ViewOf,
};

use crate::support::{engines, gaussians_of, image_of, lattice, map_of, medium_of};

fn is_linear(case: &Case<'_>) -> bool {
    case.has("in.attr")
}

#[test]
fn golden_compositor_forward_and_every_gradient() {
    let part = Part::math("compositor");
    for (name, mut rasterizer) in engines() {
        for case in part.cases().iter().filter(|c| !is_linear(c)) {
            eprintln!("{name}: {}", case.name());
            check_case(case, &mut rasterizer);
        }
    }
}

fn check_case(case: &Case<'_>, rasterizer: &mut Rasterizer) {
    let (camera, gaussians, medium) = (case.camera(), gaussians_of(case), medium_of(case));
    let depth_gradient = case.config()["s_gradient"].as_bool().unwrap_or(true);
    let options = Options { depth_gradient, layers: true, ..Options::default() };
    let mut prepared = Prepared::new();
    prepared.prepare(&gaussians, &camera, &lattice(&camera), Colors::Sh { degree: case.count("sh_degree") });
    let mut out = Rendered::new();
    rasterizer.forward(&prepared, Some(&medium), &options, &mut out);
    let layers = out.layers.as_ref().expect("layers were asked for");
    case.check_planes("out.rgb", out.image.data());
    case.check_planes("out.depth", out.depth.data());
    case.check_planes("out.acc", out.accumulation.data());
    case.check_planes("out.obj", layers.object.data());
    case.check_planes("out.med", layers.medium.data());
    case.check_planes("out.far", layers.far.data());
    case.check_planes("out.clean", layers.clear.data());
    case.check_planes("out.distance", layers.distance.data());
    let t_final: Vec<f32> = out.accumulation.data().iter().map(|a| 1.0 - a).collect();
    case.check_planes("out.t_final", &t_final);

    let (w, h) = (prepared.width(), prepared.height());
    let (zero, mut grads) = (Image::new(w, h), GaussianGradients::default());
    let mut medium_grads = MediumMaps::zeros(0, 0);
    for (pull, outputs) in case.pulls() {
        let has = |name: &str| outputs.iter().any(|o| o == name);
        let image = if has("rgb") { image_of(case, "cot.rgb") } else { zero.clone() };
        let clear = has("clean").then(|| image_of(case, "cot.clean"));
        let depth = has("depth").then(|| map_of(case, "cot.depth"));
        let accumulation = has("acc").then(|| map_of(case, "cot.acc"));
        let d_rendered = RenderGradients {
            image: &image,
            depth: depth.as_ref(),
            accumulation: accumulation.as_ref(),
            clear: clear.as_ref(),
        };
        rasterizer.backward(
            &prepared,
            ViewOf { gaussians: &gaussians, camera: &camera },
            Some(&medium),
            &options,
            &d_rendered,
            Gradients { gaussians: &mut grads, medium: Some(&mut medium_grads) },
        );
        for input in case.grads() {
            let name = format!("grad.{pull}.{input}");
            match input.as_str() {
                "means" => case.check(&name, grads.means.as_flattened()),
                "log_scales" => case.check(&name, grads.log_scales.as_flattened()),
                "quats" => case.check(&name, grads.quaternions.as_flattened()),
                "opacity_logits" => case.check(&name, &grads.opacity_logits),
                "sh" => case.check(&name, grads.sh.as_flattened().as_flattened()),
                "beta_attn" => case.check_planes(&name, medium_grads.attenuation.data()),
                "beta_bs" => case.check_planes(&name, medium_grads.backscatter.data()),
                "c_m" => case.check_planes(&name, medium_grads.color.data()),
                other => panic!("{}: gradient of unknown input {other}", case.name()),
            }
        }
    }
}

#[test]
fn golden_splat_and_adjoint() {
    let part = Part::math("compositor");
    let mut cases = 0;
    for (name, mut rasterizer) in engines() {
        for case in part.cases().iter().filter(|c| is_linear(c)) {
            eprintln!("{name}: {}", case.name());
            cases += 1;
            let (camera, gaussians) = (case.camera(), gaussians_of(case));
            let mut prepared = Prepared::new();
            prepared.prepare(&gaussians, &camera, &lattice(&camera), Colors::Sh { degree: 0 });
            let channels = case.shape("in.attr")[1];
            let pixels = prepared.width() * prepared.height();
            let mut splat = vec![1.0; channels * pixels];
            rasterizer.splat(&prepared, channels, &case.f32("in.attr"), &mut splat);
            case.check_planes("out.splat", &splat);
            let mut lifted = vec![1.0; channels * gaussians.len()];
            rasterizer.splat_adjoint(&prepared, channels, &case.planes("in.image").2, &mut lifted);
            case.check("out.lifted", &lifted);
            let mut omega = vec![1.0; gaussians.len()];
            rasterizer.splat_adjoint(&prepared, 1, &vec![1.0; pixels], &mut omega);
            case.check("out.omega", &omega);
            let mut gradient = vec![1.0; channels * gaussians.len()];
            rasterizer.splat_adjoint(&prepared, channels, &case.planes("cot.splat").2, &mut gradient);
            case.check("grad.splat.attr", &gradient);
        }
    }
    assert!(cases > 0, "no case with in.attr");
}

/// The backward pass of stage 2 is the full one restricted to colours and medium.
#[test]
fn golden_cases_give_the_same_colour_and_medium_gradients_without_geometry() {
    let part = Part::math("compositor");
    for (name, mut rasterizer) in engines() {
        for case in part.cases().iter().filter(|c| !is_linear(c) && c.pulls().contains_key("rgb")) {
            let (camera, gaussians, medium) = (case.camera(), gaussians_of(case), medium_of(case));
            check_colors(name, &camera, &gaussians, &medium, &image_of(case, "cot.rgb"), &mut rasterizer);
        }
    }
}

fn check_colors(
    name: &str,
    camera: &Camera,
    gaussians: &Gaussians,
    medium: &MediumMaps,
    image: &Image,
    rasterizer: &mut Rasterizer,
) {
    // Degree 0 with a known basis turns the gradient of sh[0] into that of the colour, where the clamp is
    // inactive.
    let mut lifted = gaussians.clone();
    for sh in &mut lifted.sh {
        sh[0] = sh[0].map(|v| v.abs() + 0.1);
    }
    let mut prepared = Prepared::new();
    prepared.prepare(&lifted, camera, &lattice(camera), Colors::Sh { degree: 0 });
    let d_rendered = RenderGradients { image, depth: None, accumulation: None, clear: None::<&Image> };
    let _: Option<&Map> = d_rendered.depth;
    let (mut grads, mut full) = (GaussianGradients::default(), MediumMaps::zeros(0, 0));
    let options = Options::default();
    rasterizer.backward(
        &prepared,
        ViewOf { gaussians: &lifted, camera },
        Some(medium),
        &options,
        &d_rendered,
        Gradients { gaussians: &mut grads, medium: Some(&mut full) },
    );
    let (mut colors, mut maps) = (vec![[9.0; 3]; lifted.len()], MediumMaps::zeros(0, 0));
    rasterizer.backward_colors(&prepared, Some(medium), image, &mut colors, &mut maps);
    let c0 = use3d_numerics::spherical_harmonics::C0;
    let size = colors.as_flattened().iter().fold(1e-6f32, |m, v| m.max(v.abs()));
    for (i, color) in colors.iter().enumerate() {
        for c in 0..3 {
            let expected = grads.sh[i][0][c] / c0;
            assert!(
                (color[c] - expected).abs() <= 1e-5 * size,
                "{name}: Gaussian {i}: {} {expected}",
                color[c]
            );
        }
    }
    for (a, b) in [
        (&maps.color, &full.color),
        (&maps.backscatter, &full.backscatter),
        (&maps.attenuation, &full.attenuation),
    ] {
        let size = b.data().iter().fold(1e-6f32, |m, v| m.max(v.abs()));
        for (a, b) in a.data().iter().zip(b.data()) {
            assert!((a - b).abs() <= 1e-5 * size, "{name}: {a} {b}");
        }
    }
}
