//! Compares the change of a photograph with the golden part `photographs`, all cases: an independent program
//! in float64, from the equations alone.

use use3d_capture::{Image, Map};
use use3d_golden::{Case, Part};
use use3d_render::Response;

use crate::grade::{Seen, grade};

fn image(case: &Case<'_>, name: &str) -> Image {
    let (w, h, planes) = case.planes(name);
    Image::from_planes(w, h, planes).unwrap()
}

#[test]
fn golden_graded_photographs() {
    for case in Part::math("photographs").cases() {
        let photograph = image(&case, "in.photograph");
        let (w, h, answer) = case.planes("in.answer");
        let n = w * h;
        // Plane 3 i + j of the file is N_ij; column j of the response has plane i.
        let column = |j: usize| {
            let planes: Vec<f32> =
                (0..3).flat_map(|i| answer[(3 * i + j) * n..][..n].iter().copied()).collect();
            Image::from_planes(w, h, planes).unwrap()
        };
        let response =
            Response { columns: [column(0), column(1), column(2)], arriving: image(&case, "in.arriving") };
        let coverage = case.has("in.coverage").then(|| {
            let (w, h, plane) = case.planes("in.coverage");
            Map::from_planes(w, h, plane).unwrap()
        });
        let (render, look) = (image(&case, "in.render"), image(&case, "in.look"));
        let seen = Seen {
            photograph: &photograph,
            render: &render,
            look: &look,
            coverage: coverage.as_ref(),
            response: &response,
            soft: true,
        };
        let found = grade(&seen, case.number("keep_light") as f32);
        let mut pixels = photograph.to_interleaved();
        found.map.apply(&mut pixels, w);
        let own = found.own.rows.as_flattened().to_vec();
        for (name, values) in
            [("out.known", found.known.into_data()), ("out.own", own), ("out.graded", pixels)]
        {
            let (expected, tolerance) = (case.f64(name), case.tolerance(name));
            assert_eq!(values.len(), expected.len());
            for (k, (v, e)) in values.iter().zip(&expected).enumerate() {
                let apart = (f64::from(*v) - e).abs();
                assert!(apart <= tolerance, "{} {name} {k}: {v} and {e}, {apart:e}", case.name());
            }
        }
    }
}
