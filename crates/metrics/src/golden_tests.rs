//! Compares the measures with the golden part `metrics`, all cases.

use use3d_capture::{Image, Image8};
use use3d_golden::{Case, Part};

use crate::lab::{LabTable, quantise};
use crate::ms_ssim::{MsSsim, RECONSTRUCTION_WEIGHTS, STANDARD_WEIGHTS};
use crate::{
    Flow, UCIQE_VARIANT, backward_warp, forward_backward, lab_of_srgb, psnr, ssim, uciqe_of_8bit,
    uiqm_of_8bit,
};

fn image8(case: &Case<'_>, name: &str) -> Image8 {
    let (w, h, planes) = case.planes(name);
    Image8::from_planes(w, h, planes.iter().map(|&v| v as u8).collect()).unwrap()
}

fn image(case: &Case<'_>, name: &str) -> Image {
    let (w, h, planes) = case.planes(name);
    Image::from_planes(w, h, planes).unwrap()
}

/// The cases that have a tensor; at least one.
fn with<'a>(part: &'a Part, tensor: &str) -> Vec<Case<'a>> {
    let cases: Vec<_> = part.cases().into_iter().filter(|c| c.has(tensor)).collect();
    assert!(!cases.is_empty(), "no case has {tensor}");
    cases
}

#[test]
fn golden_full_reference() {
    let part = Part::math("metrics");
    for case in with(&part, "in.y") {
        let (x, y) = (image8(&case, "in.x").to_float(), image8(&case, "in.y").to_float());
        case.check_f64("out.psnr", &[psnr(&x, &y, None).unwrap()]);
        case.check_f64("out.ssim", &[ssim(&x, &y, None).unwrap()]);
        // Display range centred on zero leaves a quarter of the cancellation.
        let (centred_x, centred_y) = (x.map(|v| v - 0.5), y.map(|v| v - 0.5));
        let mut measure = MsSsim::default();
        for (name, weights) in
            [("out.ms_ssim3", &RECONSTRUCTION_WEIGHTS[..]), ("out.ms_ssim5", &STANDARD_WEIGHTS)]
        {
            if case.has(name) {
                let mut gradient = Image::new(0, 0);
                let value = measure.value_and_gradient(&centred_x, &centred_y, 0.5, weights, &mut gradient);
                case.check_f64(name, &[value]);
            }
        }
    }
}

#[test]
fn golden_lab() {
    let part = Part::math("metrics");
    for case in with(&part, "out.lab") {
        let image = image8(&case, "in.x");
        let lab: Vec<f64> = (0..image.pixels())
            .flat_map(|p| {
                let rgb = image.pixel(p % image.width(), p / image.width());
                lab_of_srgb(rgb.map(|v| f32::from(v) / 255.0))
            })
            .collect();
        case.check_f64("out.lab", &lab);
        let table = LabTable::new();
        let lab8: Vec<f64> = (0..image.pixels())
            .flat_map(|p| quantise(table.lab(image.pixel(p % image.width(), p / image.width()))))
            .map(f64::from)
            .collect();
        case.check_within("out.lab8", &lab8, 1.0);
        let expected = case.f64("out.lab8");
        let off = lab8.iter().zip(&expected).filter(|(a, b)| a != b).count();
        assert!(off * 1000 <= lab8.len(), "{}: {off} of {} 8-bit values differ", case.name(), lab8.len());
    }
}

#[test]
fn golden_uciqe_and_uiqm() {
    let part = Part::math("metrics");
    for case in with(&part, "out.uciqe") {
        let image = image8(&case, "in.x");
        let names: Vec<String> = serde_json::from_value(case.config()["variants"].clone()).unwrap();
        let default: String = serde_json::from_value(case.config()["default"].clone()).unwrap();
        assert_eq!(default, UCIQE_VARIANT);
        // The cases also have the other variants in public use.
        let own = names.iter().position(|name| name == UCIQE_VARIANT).unwrap();
        let found = uciqe_of_8bit(&image).unwrap();
        for (name, first, values) in [
            ("out.uciqe_parts", 3 * own, &[found.chroma_spread, found.contrast, found.saturation][..]),
            ("out.uciqe", own, &[found.score]),
        ] {
            let mut all = case.f64(name);
            all[first..first + values.len()].copy_from_slice(values);
            case.check_f64(name, &all);
        }
        let q = uiqm_of_8bit(&image).unwrap();
        case.check_f64("out.uiqm", &[q.score, q.colorfulness, q.sharpness, q.contrast]);
    }
}

#[test]
fn golden_warping() {
    let part = Part::math("metrics");
    for case in with(&part, "in.f12") {
        let flow = |name: &str| {
            let (w, h, planes) = case.planes(name);
            Flow::from_planes(w, h, planes).unwrap()
        };
        let (f12, f21) = (flow("in.f12"), flow("in.f21"));
        let warped = backward_warp(&image(&case, "in.img2"), &f12).unwrap();
        case.check_planes("out.warped", warped.image.data());
        let bits = |mask: &crate::Mask| mask.data().iter().map(|&v| f64::from(v)).collect::<Vec<_>>();
        case.check_within("out.inside", &bits(&warped.inside), 0.0);
        let check = forward_backward(&f12, &f21).unwrap();
        case.check_planes("out.fb_error_sq", check.error_squared.data());
        let (a, b) = (case.number("a") as f32, case.number("b") as f32);
        case.check_within("out.mask", &bits(&check.relative_mask(a, b)), 0.0);
        case.check_within("out.mask_1px", &bits(&check.relative_mask(0.0, 1.0)), 0.0);
    }
}
