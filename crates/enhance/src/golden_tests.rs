//! Compares a whole step with the float64 oracle and with its own finite differences.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

use use3d_atc::consensus::ViewTarget;
use use3d_atc::extractor::{ExtractorSettings, Form, Geometry, SourceImage};
use use3d_capture::{Appearance, Formation, Image, MediumMaps};
use use3d_golden::{Case, CaseGaussians, Part};
use use3d_numerics::random::{Purpose, Stream};
use use3d_splat::{Colors, Gaussians, Options, Prepared, Rasterizer, Rendered, view_colors};
use use3d_ubaf::{Field, FieldBox, ObjectPass, Shape, ViewWater};

use crate::engine::{Goals, Step};
use crate::losses::TERMS;
use crate::params::PixelLoss;
use crate::report::ViewErrors;
use crate::views::{Frozen, Listed, Lookups, Reference, ViewConstants};

struct Example {
    field: Field,
    step: Step,
    view: ViewConstants,
    frozen: Frozen,
    goals: Goals,
    stage1: Image,
}

fn array<const N: usize>(case: &Case<'_>, name: &str) -> [f64; N] {
    case.f64(name).try_into().expect("a tensor of that length")
}

fn image(case: &Case<'_>, name: &str) -> Image {
    let (w, h, planes) = case.planes(name);
    Image::from_planes(w, h, planes).expect("planes of that size")
}

impl Example {
    fn new(case: &Case<'_>, appearance: Appearance) -> Self {
        let CaseGaussians { means, log_scales, quaternions, opacity_logits, sh } = case.gaussians();
        let sh_degree = case.count("sh_degree");
        let gaussians = Gaussians { sh_degree, means, log_scales, quaternions, opacity_logits, sh };
        let camera = case.camera();
        let intrinsics = camera.intrinsics;
        let form = if case.config()["form"] == "log" { Form::Log } else { Form::Linear };
        let settings = ExtractorSettings { form, ..ExtractorSettings::default() };
        let geometry = Arc::new(Geometry::new(intrinsics.width, intrinsics.height, &settings).unwrap());
        let lattice = geometry.lattice();
        let maps = MediumMaps {
            color: image(case, "in.c_m"),
            backscatter: image(case, "in.beta_bs"),
            attenuation: image(case, "in.beta_attn"),
            formation: Formation::default(),
            network: None,
        };
        let mut base = Vec::new();
        view_colors(&gaussians, &camera, gaussians.sh_degree, &mut base);
        let mut prepared = Prepared::new();
        prepared.prepare(&gaussians, &camera, &lattice, Colors::Given(&base));
        let mut rendered = Rendered::new();
        let maps = (appearance == Appearance::Water).then_some(maps);
        Rasterizer::new().forward(&prepared, maps.as_ref(), &Options::default(), &mut rendered);
        let source = SourceImage::on_lattice(&geometry, &rendered.image).unwrap();
        let shape = case.shape("in.delta_target");
        let target = ViewTarget {
            grid: (shape[1], shape[0]),
            local: case.f64("in.delta_target").as_chunks::<6>().0.to_vec(),
            weight: case.f64("in.W_support"),
        };
        let factors = case.shape("in.factors");
        let shape = Shape { resolution: factors[1], rank: factors[2], width: case.shape("in.b1")[0] };
        let parameters = ["factors", "W1", "b1", "W2", "b2", "guide", "affine", "transport"]
            .iter()
            .flat_map(|name| case.f32(&format!("in.{name}")))
            .collect();
        let corners = case.rows::<3>("in.box");
        let field = Field::from_parameters(shape, FieldBox { low: corners[0], high: corners[1] }, parameters)
            .unwrap();
        let objects = ObjectPass::new(&field, &gaussians.means, gaussians.sh.iter().map(|sh| sh[0]));
        let lambdas = case.config()["lam"].as_array().expect("three weights");
        let lambda = |i: usize| lambdas[i].as_f64().expect("a number");
        let goals = Goals {
            operator: array(case, "in.t_target"),
            global_scales: array(case, "in.s_g"),
            local_scales: array(case, "in.s_l"),
            pixel_loss: PixelLoss::L1,
            weights: TERMS.map(|row| match row.name {
                "global" => lambda(0),
                "local" => lambda(1),
                "variation" => lambda(2),
                "pixels" => 1.0,
                // The golden's total has no other terms.
                _ => 0.0,
            }),
        };
        let view = ViewConstants {
            camera,
            center: camera.pose.center().as_vec3().to_array(),
            lattice,
            reference: Reference::Transition(Box::new(source), target),
        };
        Self {
            frozen: Frozen {
                prepared,
                listed: Listed::all(objects.sites()),
                base,
                water: maps.map(ViewWater::new),
            },
            step: Step::new(&field, objects),
            stage1: rendered.image,
            field,
            view,
            goals,
        }
    }

    fn total(&mut self) -> f64 {
        self.step.render(&self.field, &self.view, &mut self.frozen);
        let mut losses = self.step.losses(&self.view, &self.goals, false).unwrap();
        self.goals.of_field(&self.field, &mut losses);
        losses.total
    }
}

fn steps(part: &Part) -> Vec<Case<'_>> {
    let cases: Vec<_> = part.cases().into_iter().filter(|c| c.has("in.t_target")).collect();
    assert!(!cases.is_empty(), "no whole steps");
    cases
}

/// The cases of [`steps`], each with water and in clear radiance.
fn in_both(part: &Part) -> Vec<(Case<'_>, Appearance)> {
    let each = [Appearance::Water, Appearance::Clear];
    each.into_iter()
        .flat_map(|appearance| steps(part).into_iter().map(move |case| (case, appearance)))
        .collect()
}

#[test]
fn golden_whole_steps() {
    let part = Part::math("ubaf");
    for case in steps(&part) {
        let mut e = Example::new(&case, Appearance::Water);
        case.check_planes("out.rec", e.stage1.data());
        e.step.render(&e.field, &e.view, &mut e.frozen);
        case.check("out.colors_plus", e.step.colors.as_flattened());
        case.check_planes("out.plus", e.step.rendered.image.data());
        let mut losses = e.step.losses(&e.view, &e.goals, true).unwrap();
        e.goals.of_field(&e.field, &mut losses);
        let realised = e.step.transition().clone();
        case.check_f64("out.t", &realised.global);
        case.check_f64("out.delta", realised.local.as_flattened());
        let oracle = [("global", "l_global"), ("local", "l_local"), ("variation", "l_tv")];
        for (name, output) in oracle {
            case.check_f64(&format!("out.{output}"), &[ViewErrors(losses.values).of(name).unwrap().loss]);
        }
        case.check_f64("out.total", &[losses.total]);
        let weights = e.goals.weights;
        for (pull, outputs) in case.pulls() {
            let d_output = |name: &str| {
                if outputs.iter().any(|o| o == name) { case.f64(&format!("cot.{name}"))[0] } else { 0.0 }
            };
            let total = d_output("total");
            for ((row, weight), own) in TERMS.iter().zip(&mut e.goals.weights).zip(weights) {
                let output =
                    oracle.iter().find(|(name, _)| *name == row.name).map_or("", |(_, output)| output);
                *weight = d_output(output) + total * own;
            }
            e.step.render(&e.field, &e.view, &mut e.frozen);
            e.step.losses(&e.view, &e.goals, true).unwrap();
            e.step.backward(&e.field, &e.view, &e.frozen, &e.goals);
            let s = e.field.shape();
            for (name, range) in [
                ("factors", s.factors()),
                ("W1", s.hidden_weight()),
                ("b1", s.hidden_bias()),
                ("W2", s.output_weight()),
                ("b2", s.output_bias()),
                ("guide", s.guide()),
                ("affine", s.affine()),
                ("transport", s.transport()),
            ] {
                case.check_f64(&format!("grad.{pull}.{name}"), &e.step.gradient.values[range]);
            }
        }
    }
}

/// Distances along a direction, in units of the parameters. Over long distances the loss is curved, and
/// short ones are lost in the rounding of f32. A distance in between must agree, so the best one counts.
const DISTANCES: [f64; 8] = [1e-3, 5e-4, 2.5e-4, 1.25e-4, 6.3e-5, 3.1e-5, 1.6e-5, 8e-6];
/// Number of differences of slightly different lengths that are added for each distance, so that their
/// rounding averages out.
const REPEATS: u32 = 8;
/// Largest deviation of a difference as a share of a direction's derivative, in addition to its rounding,
/// which must not exceed the same share.
const DEVIATION: f64 = 0.003;
/// Largest relative error in the length of a gradient that the test may fail to notice.
const NOTICED: f64 = 0.01;

/// Sums of differences of the loss, and the values expected from the gradient. From
/// `Δ(h) = L(θ + h d) − L(θ − h d)` at one length and at twice that,
/// `(8 Δ(h) − Δ(2h)) / 6 = 2 h L′ + O(h⁵)`: the cubic term cancels, so that longer distances, which exceed
/// the rounding more clearly, can be used.
#[derive(Debug)]
struct FiniteDifference {
    found: f64,
    expected: f64,
    /// The difference that the gradient predicts if every parameter moved uphill.
    scale: f64,
    /// The error of `found` due to rounding.
    noise: f64,
}

impl FiniteDifference {
    /// True if the gradient, multiplied by `factor`, agrees with the difference.
    fn agrees(&self, factor: f64) -> bool {
        (self.found - factor * self.expected).abs() < DEVIATION * self.scale + self.noise
    }
}

impl Example {
    /// True if a change of the parameters of `range` leaves the loss unchanged to the bit.
    fn unmoved_by(&mut self, range: Range<usize>) -> bool {
        let (start, here) = (self.field.parameters.clone(), self.total());
        self.field.parameters[range].iter_mut().for_each(|p| *p += 0.5);
        let there = self.total();
        self.field.parameters.copy_from_slice(&start);
        here.to_bits() == there.to_bits()
    }

    /// The differences along `direction` in the parameters of `range`, one for each distance that clearly
    /// exceeds the rounding.
    fn differences(
        &mut self,
        gradient: &[f64],
        range: Range<usize>,
        direction: &[f64],
    ) -> Vec<FiniteDifference> {
        let start = self.field.parameters.clone();
        let slope: f64 = range.clone().zip(direction).map(|(i, d)| (gradient[i] * d).abs()).sum();
        let mut at = |distance: f64| {
            for (i, d) in range.clone().zip(direction) {
                self.field.parameters[i] = (f64::from(start[i]) + distance * d) as f32;
            }
            // The actual change of the f32 parameters, times the gradient.
            let moved: f64 = range
                .clone()
                .map(|i| gradient[i] * (f64::from(self.field.parameters[i]) - f64::from(start[i])))
                .sum();
            (self.total(), moved)
        };
        let here = at(0.0).0;
        // Over such a short distance the loss is linear, so the rest is rounding.
        let noise = (1..=4)
            .map(|k| ((at(2e-6 * f64::from(k)).0 - here) + (at(-2e-6 * f64::from(k)).0 - here)).abs())
            .fold(0.0, f64::max);
        let differences = DISTANCES.map(|distance| {
            // The four values in the combination are rounded separately, which makes its rounding 1.9 times
            // that of a single value. The measured noise has three of them, 2.4 times.
            let noise = noise * f64::from(REPEATS).sqrt();
            let mut sum = FiniteDifference { found: 0.0, expected: 0.0, scale: 0.0, noise };
            for k in 0..REPEATS {
                let distance = distance * (1.0 + 0.03 * f64::from(k));
                let mut over = |distance: f64| {
                    let ((up, moved_up), (down, moved_down)) = (at(distance), at(-distance));
                    [up - down, moved_up - moved_down]
                };
                let (near, far) = (over(distance), over(2.0 * distance));
                let [found, expected] = [0, 1].map(|i| (8.0 * near[i] - far[i]) / 6.0);
                sum.found += found;
                sum.expected += expected;
                sum.scale += 2.0 * distance * slope;
            }
            sum
        });
        self.field.parameters.copy_from_slice(&start);
        differences.into_iter().filter(|d| d.noise < DEVIATION * d.scale).collect()
    }
}

/// Random fields on the golden's scene: the derivative along directions of each group agrees with the
/// gradient.
#[test]
fn whole_steps_agree_with_their_differences() {
    let part = Part::math("ubaf");
    for (case, appearance) in in_both(&part) {
        let mut unnoticed = BTreeMap::new();
        for seed in 0..4 {
            let mut e = Example::new(&case, appearance);
            if seed % 2 == 1 {
                // As in the training of large scenes: the mean over some Gaussians, and the others only
                // where the view sees them.
                e.frozen.relist(&Lookups::new(e.step.objects.sites().clone(), 5));
            }
            let draw = Stream::new(seed, Purpose::new("step differences"), 0);
            for (i, p) in e.field.parameters.iter_mut().enumerate() {
                *p += 0.1 * draw.normal(i as u64) as f32;
            }
            // The field is piecewise linear along the guide, and one crossed node can change the derivative
            // by a third. A difference across a node does not estimate the derivative, so the nodes are put
            // on straight lines, each with another slope.
            let s = e.field.shape();
            for rank in 0..s.rank {
                let slope = draw.normal(80_000 + rank as u64);
                let at = |node: usize| s.factors().start + (3 * s.resolution + node) * s.rank + rank;
                let middle = f64::from(e.field.parameters[at(s.resolution / 2)]);
                for node in 0..s.resolution {
                    let along = 2.0 * node as f64 / (s.resolution - 1) as f64 - 1.0;
                    e.field.parameters[at(node)] = (middle + 1.5 * slope * along) as f32;
                }
            }
            e.total();
            e.step.losses(&e.view, &e.goals, true).unwrap();
            e.step.backward(&e.field, &e.view, &e.frozen, &e.goals);
            let gradient = e.step.gradient.values.clone();
            for (group, range) in [
                ("factors", s.factors()),
                ("hidden", s.hidden_weight().start..s.hidden_bias().end),
                ("output", s.output_weight()),
                ("guide", s.guide()),
                ("affine", s.affine()),
                ("transport", s.transport()),
            ] {
                if group == "transport" && appearance == Appearance::Clear {
                    let still = gradient[range.clone()].iter().all(|&g| g == 0.0);
                    assert!(still && e.unmoved_by(range), "clear radiance says nothing about the water");
                    continue;
                }
                let random = |i: usize| draw.normal(50_000 + i as u64);
                let across: Vec<f64> = range.clone().map(|i| random(i).signum()).collect();
                let differences = e.differences(&gradient, range.clone(), &across);
                let right = differences.iter().any(|d| d.agrees(1.0));
                assert!(right, "seed {seed}, {group}, across: {differences:#?}");
                // If every parameter moves uphill, by different lengths, the difference is as large as
                // possible.
                let uphill: Vec<f64> =
                    range.clone().map(|i| gradient[i].signum() * (0.5 + random(i).abs())).collect();
                let differences = e.differences(&gradient, range, &uphill);
                let right = differences.iter().any(|d| d.agrees(1.0));
                assert!(right, "seed {seed}, {group}, uphill: {differences:#?}");
                for (name, factor) in [("shorter", 1.0 - NOTICED), ("longer", 1.0 + NOTICED)] {
                    let passes = differences.iter().any(|d| d.agrees(factor));
                    unnoticed.entry((group, name)).and_modify(|all| *all &= passes).or_insert(passes);
                }
            }
        }
        unnoticed.retain(|_, passes| *passes);
        assert!(unnoticed.is_empty(), "a gradient {NOTICED} off would go unnoticed: {unnoticed:?}");
    }
}
