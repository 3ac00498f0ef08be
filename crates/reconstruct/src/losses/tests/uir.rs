//! Compares the terms of 3D-UIR with goldens and finite differences.

use use3d_capture::{Lattice, Pose};
use use3d_splat::Colors;

use super::*;

/// Gaussians in front of a camera, and the view that all of them reach.
fn in_view(log_scales: Vec<[f32; 3]>) -> (Camera, Gaussians, Prepared) {
    let intrinsics = Intrinsics { width: 23, height: 19, fx: 20.0, fy: 20.0, cx: 11.0, cy: 9.0 };
    let camera = Camera { intrinsics, pose: Pose::IDENTITY };
    let mut gaussians = crate::engine::zeros(log_scales.len(), 0);
    gaussians.means.fill([0.0, 0.0, 4.0]);
    gaussians.quaternions.fill([1.0, 0.0, 0.0, 0.0]);
    gaussians.log_scales = log_scales;
    let mut prepared = Prepared::new();
    let lattice = Lattice::full(&camera.intrinsics);
    prepared.prepare(&gaussians, &camera, &lattice, Colors::Sh { degree: 0 });
    (camera, gaussians, prepared)
}

/// Value and gradients (depth, accumulation, sizes) of a term of 3D-UIR with these weights.
fn evaluated(
    row: &LossTerm,
    (depth, accumulation, prior): (&Map, &Map, Option<&Map>),
    log_scales: Vec<[f32; 3]>,
    weights: &[f64],
) -> (Vec<Option<f64>>, ViewGradients) {
    let (camera, gaussians, prepared) = in_view(log_scales);
    let target = Target { prior: prior.cloned(), ..Target::default() };
    let image = Image::new(depth.width(), depth.height());
    let (mut values, mut gradients) = (vec![None; weights.len()], ViewGradients::default());
    let seen = Observation {
        step: 0,
        camera: &camera,
        image: &image,
        clear: None,
        depth,
        accumulation,
        water: None,
        target: &target,
        gaussians: &gaussians,
        prepared: &prepared,
    };
    (row.term)().evaluate(&seen, weights, &mut values, &mut gradients);
    (values, gradients)
}

#[test]
fn golden_terms_of_3d_uir() {
    let part = Part::math("uir");
    let of = |name: &str| part.cases().into_iter().find(|case| case.name() == name).unwrap();
    for (name, value, at) in [("agreement", "inverse_depth", 0), ("variation", "depth_variation", 1)] {
        let case = of(name);
        let prior = case.has("in.prior").then(|| map(&case, "in.prior"));
        let pixels = (&map(&case, "in.depth"), &map(&case, "in.opacity"), prior.as_ref());
        let mut weights = [0.0; 2];
        weights[at] = case.f64(&format!("cot.{value}"))[0];
        let (values, gradients) = evaluated(&inverse_depth::TERM, pixels, vec![[-2.0; 3]], &weights);
        case.check_f64(&format!("out.{value}"), &[values[at].unwrap()]);
        case.check_planes("grad.all.depth", gradients.depth.get().unwrap().data());
        case.check_planes("grad.all.opacity", gradients.accumulation.get().unwrap().data());
    }
    let case = of("flatness");
    let (none, scales) = (Map::new(23, 19), case.rows::<3>("in.scales"));
    let weight = case.f64("cot.flatness")[0];
    let (values, mut gradients) = evaluated(&flatness::TERM, (&none, &none, None), scales.clone(), &[weight]);
    case.check_f64("out.flatness", &[values[0].unwrap()]);
    case.check("grad.all.scales", gradients.log_scales(scales.len()).as_flattened());
}

#[test]
fn inverse_depth_needs_pixels_and_a_prior_that_varies_and_its_gradient_agrees_with_differences() {
    let n = 23 * 19;
    let stream = Stream::new(3, Purpose::new("inverse depth"), 0);
    let draw = |from: u64| (0..n).map(|i| 0.3 + 0.6 * stream.uniform(from + i as u64) as f32).collect();
    let of = |data: Vec<f32>| Map::from_planes(23, 19, data).unwrap();
    let (depth, accumulation, prior) = (of(draw(0)), of(draw(1000)), of(draw(2000)));
    let value = |depth: &Map, accumulation: &Map, prior: &Map| {
        let pixels = (depth, accumulation, Some(prior));
        evaluated(&inverse_depth::TERM, pixels, vec![[-2.0; 3]], &[0.0, 1.0]).0[1].unwrap()
    };
    let pixels = (&depth, &accumulation, Some(&prior));
    let (_, gradients) = evaluated(&inverse_depth::TERM, pixels, vec![[-2.0; 3]], &[0.0, 1.0]);
    for at in (0..n).step_by(17) {
        let moved = |map: &Map, by: f32| {
            let mut map = map.clone();
            map.data_mut()[at] += by;
            map
        };
        let h = 1e-4;
        let by_depth = (value(&moved(&depth, h), &accumulation, &prior)
            - value(&moved(&depth, -h), &accumulation, &prior))
            / f64::from(2.0 * h);
        let by_opacity = (value(&depth, &moved(&accumulation, h), &prior)
            - value(&depth, &moved(&accumulation, -h), &prior))
            / f64::from(2.0 * h);
        for (numeric, slot) in [(by_depth, &gradients.depth), (by_opacity, &gradients.accumulation)] {
            let own = f64::from(slot.get().unwrap().data()[at]);
            assert!((own - numeric).abs() < 2e-4, "pixel {at}: {own} against {numeric}");
        }
    }
    for prior in [Map::filled(23, 19, 0.5), Map::filled(23, 19, f32::NAN), Map::new(23, 19)] {
        let (values, gradients) = evaluated(
            &inverse_depth::TERM,
            (&depth, &accumulation, Some(&prior)),
            vec![[-2.0; 3]],
            &[1.0, 0.0],
        );
        assert_eq!(values, [Some(0.0), None]);
        assert!(gradients.depth.get().unwrap().data().iter().all(|g| *g == 0.0));
    }
}
