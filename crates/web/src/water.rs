//! The page's data about the water: coefficients of its harmonics or, for any other water, a cube map of
//! directions that is computed here.
//!
//! The network is smooth, so faces of [`SIDE`] pixels, read with linear interpolation, reproduce it to about
//! the precision of the stored half floats.

use glam::{DMat3, DVec3};
use half::f16;
use serde_json::{Value, json};
use use3d_capture::{Camera, Image, Intrinsics, Lattice, MediumMaps, Pose};
use use3d_medium::Coefficients;
use use3d_scene::Scene;

/// Pixels along a face of the cube.
const SIDE: usize = 64;

fn flat(coefficients: &Coefficients) -> &[f32] {
    coefficients.as_flattened().as_flattened()
}

/// True if the page draws the scene's water. It has no place for distances that are normalised in each view,
/// nor for a network of the depth.
fn drawn(scene: &Scene) -> bool {
    scene.medium.kind().is_per_length()
}

/// The water's entry in the header.
pub(crate) fn entry(scene: &Scene) -> Value {
    let kind = scene.medium.kind().name();
    let degree = scene.medium_degree.min(3);
    if scene.medium.is_none() {
        return json!({ "kind": kind });
    }
    if !drawn(scene) {
        return json!({ "kind": "none", "of": kind });
    }
    let Some(harmonics) = scene.medium.harmonics() else {
        return json!({ "kind": kind, "degree": 3, "side": SIDE });
    };
    let sets = harmonics.coefficients;
    match harmonics.anchors {
        None => json!({ "kind": kind, "degree": degree, "coefficients": sets.first().map(flat) }),
        Some(anchors) => json!({
            "kind": kind,
            "degree": degree,
            "topK": anchors.top_k,
            "centers": anchors.centers,
            "logWidths": anchors.log_widths,
            "coefficients": sets.iter().map(flat).collect::<Vec<_>>(),
        }),
    }
}

/// The faces of a cube map in OpenGL's convention: a pixel `(s, t)` in `[−1, 1]²`, with rows from the first
/// on, is in the direction `x s + y t + z`.
const FACES: [[[f64; 3]; 3]; 6] = [
    [[0.0, 0.0, -1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]],
    [[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]],
    [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]],
    [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]],
    [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]],
    [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]],
];

/// The baked cube map of water that is not made of harmonics: colour, backscatter, attenuation, each six
/// faces of RGBA half floats. `None` for other waters.
pub(crate) fn cube(scene: &Scene) -> Option<Vec<u8>> {
    if scene.medium.is_none() || scene.medium.harmonics().is_some() || !drawn(scene) {
        return None;
    }
    let half_side = SIDE as f64 / 2.0;
    let intrinsics =
        Intrinsics { width: SIDE, height: SIDE, fx: half_side, fy: half_side, cx: half_side, cy: half_side };
    let faces: Vec<MediumMaps> = FACES
        .iter()
        .map(|axes| {
            // Camera axes as columns. A cube map is left-handed, which does not matter for a map of
            // directions.
            let [x, y, z] = axes.map(DVec3::from_array);
            let pose = Pose { rotation: DMat3::from_cols(x, y, z).transpose(), translation: DVec3::ZERO };
            let mut maps = MediumMaps::zeros(0, 0);
            scene.medium.maps(&Camera { intrinsics, pose }, &Lattice::full(&intrinsics), 3, &mut maps);
            maps
        })
        .collect();
    let quantities: [fn(&MediumMaps) -> &Image; 3] = [|m| &m.color, |m| &m.backscatter, |m| &m.attenuation];
    let mut bytes = Vec::with_capacity(3 * 6 * SIDE * SIDE * 8);
    for quantity in quantities {
        for face in &faces {
            let image = quantity(face);
            for i in 0..SIDE * SIDE {
                let pixel = image.pixel(i % SIDE, i / SIDE);
                for v in pixel.into_iter().chain([1.0]) {
                    bytes.extend(f16::from_f32(v).to_le_bytes());
                }
            }
        }
    }
    Some(bytes)
}
