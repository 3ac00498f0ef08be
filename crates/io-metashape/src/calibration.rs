//! Metashape's lens model.
//!
//! With the ray's point `(x, y)` on the plane `z = 1`, bent by the projection of the sensor's type, and
//! `r² = x² + y²`:
//!
//! ```text
//! radial = 1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸
//! growth = 1 + p3 r² + p4 r⁴                                  p3, p4: before version 2
//! x' = x radial + (p1 (r² + 2 x²) + 2 p2 x y) growth
//! y' = y radial + (p2 (r² + 2 y²) + 2 p1 x y) growth
//! u = w/2 + cx + x' f + x' b1 + y' b2                         pixels
//! v = h/2 + cy + y' f
//! ```
//!
//! `p1` goes with `x²`: the order is the other way round than OpenCV's. `k4` is the fourth term of a
//! polynomial, no denominator. `cx` and `cy` count from the middle of the image.
//!
//! PhotoScan before 1.2 wrote `fx`, `fy` and `skew` instead, with `cx` and `cy` from the corner and OpenCV's
//! order of `p1` and `p2`: `u = cx + x' fx + y' skew`, `v = cy + y' fy`.
//!
//! Projections by type: `frame` is perspective, `fisheye` and `equidistant_fisheye` equidistant,
//! `equisolid_fisheye` equisolid. Panoramas and satellite sensors have no pinhole and are refused.

use use3d_survey::{Distortion, Lens, Projection, ReadError, SurveyCamera};

use crate::xml::{Element, is_true};

/// The parameters of a calibration that are read; any other that is not 0 is refused.
const KNOWN: [&str; 17] =
    ["f", "fx", "fy", "cx", "cy", "b1", "b2", "skew", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "date"];

fn projection(element: Element<'_>, kind: &str) -> Result<Projection, ReadError> {
    match kind {
        "frame" => Ok(Projection::Perspective),
        "fisheye" | "equidistant_fisheye" => Ok(Projection::Equidistant),
        "equisolid_fisheye" => Ok(Projection::Equisolid),
        _ => element.fail(format!(
            "the camera type {kind:?} is not read; expected frame, fisheye, equidistant_fisheye or \
             equisolid_fisheye: cut panoramas into perspective images in Metashape first"
        )),
    }
}

/// The calibration that counts: the adjusted one, or that of an old file, which has one and does not say
/// which; the initial one only where the sensor's calibration is fixed.
fn chosen(sensor: Element<'_>) -> Result<Element<'_>, ReadError> {
    let of_class =
        |class: Option<&str>| sensor.children("calibration").find(|c| c.attribute("class") == class);
    if let Some(found) = of_class(Some("adjusted")).or_else(|| of_class(None)) {
        return Ok(found);
    }
    let fixed = sensor
        .children("property")
        .any(|p| p.attribute("name") == Some("fixed") && p.attribute("value").is_some_and(is_true));
    match of_class(Some("initial")) {
        Some(initial) if fixed => Ok(initial),
        Some(_) => sensor.fail(
            "it has the initial calibration only, not the adjusted one; align the photos (Workflow > Align \
             Photos), then export the cameras again",
        ),
        None => sensor.fail("it has no <calibration>; align the photos and export the cameras again"),
    }
}

fn resolution(element: Element<'_>) -> Result<Option<(usize, usize)>, ReadError> {
    let Some(found) = element.child("resolution") else { return Ok(None) };
    Ok(Some((found.number("width")?, found.number("height")?)))
}

/// The camera of a sensor.
///
/// # Errors
/// A sensor without an adjusted calibration or a size, of an unknown type, or with parameters that are not
/// known or no numbers.
pub(crate) fn camera(sensor: Element<'_>) -> Result<SurveyCamera, ReadError> {
    let calibration = chosen(sensor)?;
    let kind = calibration.attribute("type").or(sensor.attribute("type")).unwrap_or("frame");
    let projection = projection(calibration, kind)?;
    let stated = resolution(calibration)?;
    let Some((width, height)) = stated.map_or_else(|| resolution(sensor), |size| Ok(Some(size)))? else {
        return sensor.fail("it has no <resolution>; export the cameras again");
    };
    for child in calibration.node.children().filter(roxmltree::Node::is_element) {
        let name = child.tag_name().name();
        let numeric = child.text().and_then(|t| t.trim().parse::<f64>().ok());
        if !KNOWN.contains(&name) && numeric.is_some_and(|v| v != 0.0) {
            return calibration.fail(format!(
                "the lens parameter <{name}> is not known; fix it at 0 in Tools > Camera Calibration, align \
                 again and export"
            ));
        }
    }
    let number = |element: Element<'_>| element.numbers::<1>().map(|[v]| v);
    let optional = |name: &'static str| calibration.child(name).map(number).transpose();
    let or_zero = |name: &'static str| optional(name).map(|v| v.unwrap_or(0.0));
    let (cx, cy) = (or_zero("cx")?, or_zero("cy")?);
    let (p1, p2) = (or_zero("p1")?, or_zero("p2")?);
    let mut distortion = Distortion::default();
    for (slot, name) in distortion.numerator.iter_mut().zip(["k1", "k2", "k3", "k4"]) {
        *slot = or_zero(name)?;
    }
    let lens = if let Some(f) = optional("f")? {
        distortion.tangential = [p2, p1];
        distortion.tangential_growth = [or_zero("p3")?, or_zero("p4")?];
        Lens {
            focal: [f + or_zero("b1")?, f],
            skew: or_zero("b2")?,
            principal: [0.5 * width as f64 + cx, 0.5 * height as f64 + cy],
            projection,
            distortion,
        }
    } else if let (Some(fx), Some(fy)) = (optional("fx")?, optional("fy")?) {
        distortion.tangential = [p1, p2];
        let skew = or_zero("skew")?;
        Lens { focal: [fx, fy], skew, principal: [cx, cy], projection, distortion }
    } else {
        return calibration.fail("it has no focal length <f>; align the photos and export the cameras again");
    };
    if !lens.focal.iter().all(|f| *f > 0.0) {
        let reason = format!("its focal length is {:?} pixels; expected above 0", lens.focal);
        return calibration.fail(reason);
    }
    let label = sensor.attribute("label").map(String::from);
    Ok(SurveyCamera { id: sensor.number("id")?, model: kind.to_string(), label, width, height, lens })
}
