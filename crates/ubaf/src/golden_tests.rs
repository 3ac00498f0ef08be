//! Compares the field with the float64 oracle: outputs and gradients, at the stated tolerances.

use use3d_capture::{Formation, Image, MediumMaps};
use use3d_golden::{Case, Part};

use crate::{Field, FieldBox, Gradient, ObjectPass, Shape, ViewWater, WaterPass, variation};

fn field(case: &Case<'_>) -> Field {
    let factors = case.shape("in.factors").to_vec();
    let shape = Shape { resolution: factors[1], rank: factors[2], width: case.shape("in.b1")[0] };
    let parameters: Vec<f32> = ["factors", "W1", "b1", "W2", "b2", "guide", "affine", "transport"]
        .iter()
        .flat_map(|name| case.f32(&format!("in.{name}")))
        .collect();
    let corners = case.rows::<3>("in.box");
    let bounds = FieldBox { low: corners[0], high: corners[1] };
    Field::from_parameters(shape, bounds, parameters).unwrap()
}

fn image(case: &Case<'_>, name: &str) -> Image {
    let (w, h, planes) = case.planes(name);
    Image::from_planes(w, h, planes).unwrap()
}

fn check_gradient(case: &Case<'_>, pull: &str, gradient: &Gradient) {
    let s = gradient.shape();
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
        case.check_f64(&format!("grad.{pull}.{name}"), &gradient.values[range]);
    }
}

/// Cases of the field. Cases of whole optimisation steps are tested in the crate that has a compositor and
/// an extractor.
fn field_cases(part: &Part) -> Vec<Case<'_>> {
    let cases: Vec<_> = part.cases().into_iter().filter(|c| c.has("in.c_bar")).collect();
    assert!(!cases.is_empty(), "no field cases");
    cases
}

#[test]
fn golden_field_outputs_and_gradients() {
    let part = Part::math("ubaf");
    for case in field_cases(&part) {
        let field = field(&case);
        let (means, guides) = (case.rows::<3>("in.means"), case.rows::<3>("in.c_bar"));
        let base = case.rows::<3>("in.colors");
        let mut objects = ObjectPass::with_guides(&field, &means, guides.iter().copied());
        objects.forward(&field);
        case.check("out.mode", &objects.mean);
        case.check("out.local", objects.locals(objects.mean).as_flattened());
        let mut colors = Vec::new();
        objects.colors(&field, &base, &mut colors);
        case.check("out.colors_plus", colors.as_flattened());

        let camera: [f32; 3] = case.f32("in.cam_center").try_into().unwrap();
        let water = ViewWater::new(MediumMaps {
            color: image(&case, "in.c_m"),
            backscatter: image(&case, "in.beta_bs"),
            attenuation: image(&case, "in.beta_attn"),
            formation: Formation::default(),
            network: None,
        });
        let mut pass = WaterPass::default();
        let mut maps = MediumMaps::zeros(0, 0);
        pass.forward(&field, camera, &water, 1.0, &mut maps);
        case.check("out.table", pass.table(&field, camera, 1.0).as_flattened());
        case.check_planes("out.c_m_plus", maps.color.data());
        case.check_planes("out.beta_bs_plus", maps.backscatter.data());
        case.check_planes("out.beta_attn_plus", maps.attenuation.data());
        case.check_f64("out.tv", &[variation::forward(&field)]);

        for (pull, outputs) in case.pulls() {
            let mut gradient = Gradient::new(field.shape());
            let has = |name: &str| outputs.iter().any(|o| o == name);
            if has("local") {
                objects.backward_locals(&field, &case.rows::<6>("cot.local"), &mut gradient);
            }
            if has("colors_plus") {
                objects.backward(&field, &base, &case.rows::<3>("cot.colors_plus"), &mut gradient);
            }
            if has("c_m_plus") {
                let d_maps = MediumMaps {
                    color: image(&case, "cot.c_m_plus"),
                    backscatter: image(&case, "cot.beta_bs_plus"),
                    attenuation: image(&case, "cot.beta_attn_plus"),
                    formation: Formation::default(),
                    network: None,
                };
                pass.backward(&field, camera, &water, &d_maps, &mut gradient);
            }
            if has("tv") {
                variation::backward(&field, case.f64("cot.tv")[0], &mut gradient);
            }
            check_gradient(&case, &pull, &gradient);
        }
    }
}
