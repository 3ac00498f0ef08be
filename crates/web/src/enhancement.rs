//! The page's data about an enhancement: six numbers per Gaussian, and the field for the water's colour.
//!
//! With a Gaussian's local log-gain `a` and bias `b`, its enhanced colour at strength `s` is `e^{s a} ⊙ (c +
//! s (δA c + b_g)) + s b`. So the strength is one number that the page may change at any time without
//! evaluating a field. Water is graded at the camera's position, so the page evaluates the field for it:
//! sixteen times a frame, which costs almost nothing.

use serde_json::{Value, json};
use use3d_capture::Appearance;
use use3d_scene::Scene;
use use3d_ubaf::{OUTPUTS, ObjectPass};

/// Log-gain RGB and bias RGB of every Gaussian; `None` for a scene that is not enhanced.
pub(crate) fn grades(scene: &Scene) -> Option<Vec<[f32; OUTPUTS]>> {
    let enhancement = scene.enhancement.as_ref()?;
    let g = &scene.gaussians;
    let mut pass = ObjectPass::new(&enhancement.field, &g.means, g.sh.iter().map(|sh| sh[0]));
    pass.forward(&enhancement.field);
    Some(pass.locals(enhancement.centre))
}

/// The enhancement's entry in the header.
pub(crate) fn entry(scene: &Scene) -> Value {
    let Some(enhancement) = &scene.enhancement else { return Value::Null };
    let field = &enhancement.field;
    let (shape, p) = (field.shape(), &field.parameters);
    json!({
        "water": enhancement.appearance == Appearance::Water,
        "keptWater": enhancement.kept_water.0,
        "affine": field.affine().as_flattened(),
        "guide": field.guide(),
        "transport": field.transport(),
        "low": field.bounds.low,
        "high": field.bounds.high,
        "resolution": shape.resolution,
        "rank": shape.rank,
        "width": shape.width,
        "factors": p[shape.factors()],
        "hiddenWeight": p[shape.hidden_weight()],
        "hiddenBias": p[shape.hidden_bias()],
        "outputWeight": p[shape.output_weight()],
        "outputBias": p[shape.output_bias()],
    })
}
