//! glTF in one binary file, with the extension `KHR_gaussian_splatting`: floats, without loss.
//!
//! Sizes are linear (drafts had logarithms), opacity is in `[0, 1]`, quaternions are xyzw and of unit length,
//! every harmonic is an attribute of its own. glTF has y up: the Gaussians stay in their given frame, and the
//! node rotates them, including the harmonics.

use std::io::{self, Write};

use serde_json::{Value, json};
use use3d_numerics::math;
use use3d_splat::Gaussians;

use super::{NO_WATER, normalised, opacity, write_words};

/// Writes Gaussians. `turn` is the node's rotation, a quaternion xyzw: half a turn about x for COLMAP's
/// frame, whose y points down.
///
/// # Errors
/// Returns the errors of the writer, and an error for more than 4 GiB, the limit of the format.
pub fn write(gaussians: &Gaussians, comment: &str, turn: [f32; 4], mut writer: impl Write) -> io::Result<()> {
    let n = gaussians.len();
    let mut bytes: Vec<u8> = Vec::new();
    let mut views = Vec::new();
    let mut accessors = Vec::new();
    let mut attributes = serde_json::Map::new();
    let mut put = |name: String, kind: &str, values: &mut dyn Iterator<Item = f32>| {
        let start = bytes.len();
        values.for_each(|v| bytes.extend(v.to_le_bytes()));
        views.push(json!({ "buffer": 0, "byteOffset": start, "byteLength": bytes.len() - start }));
        attributes.insert(name, accessors.len().into());
        accessors
            .push(json!({ "bufferView": views.len() - 1, "componentType": 5126, "count": n, "type": kind }));
    };
    let g = gaussians;
    put("POSITION".into(), "VEC3", &mut g.means.as_flattened().iter().copied());
    let own = |name: &str| format!("KHR_gaussian_splatting:{name}");
    let turns = g.quaternions.iter().map(|&q| normalised(q));
    put(own("ROTATION"), "VEC4", &mut turns.flat_map(|[w, x, y, z]| [x, y, z, w]));
    put(own("SCALE"), "VEC3", &mut g.log_scales.as_flattened().iter().map(|&v| math::exp(v)));
    put(own("OPACITY"), "SCALAR", &mut g.opacity_logits.iter().map(|&v| opacity(v)));
    for degree in 0..=g.sh_degree {
        for k in 0..=2 * degree {
            let band = degree * degree + k;
            let name = own(&format!("SH_DEGREE_{degree}_COEF_{k}"));
            put(name, "VEC3", &mut g.sh.iter().flat_map(|sh| sh[band]));
        }
    }
    // The format requires the extent of the positions.
    let extent = |pick: fn(f32, f32) -> f32| -> [f32; 3] {
        g.means.iter().copied().reduce(|a, b| std::array::from_fn(|k| pick(a[k], b[k]))).unwrap_or_default()
    };
    accessors[0]["min"] = json!(extent(f32::min));
    accessors[0]["max"] = json!(extent(f32::max));
    let document = json!({
        "asset": { "version": "2.0", "generator": comment, "extras": { "note": NO_WATER } },
        "extensionsUsed": ["KHR_gaussian_splatting"],
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0, "rotation": turn }],
        "meshes": [{ "primitives": [{
            "mode": 0,
            "attributes": Value::Object(attributes),
            "extensions": { "KHR_gaussian_splatting": {
                "kernel": "ellipse",
                "colorSpace": "srgb_rec709_display",
                "projection": "perspective",
                "sortingMethod": "cameraDistance",
            } },
        }] }],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{ "byteLength": bytes.len() }],
    });
    let mut text = document.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let sizes = [28 + text.len() + bytes.len(), text.len(), bytes.len()].map(u32::try_from);
    let [Ok(whole), Ok(json), Ok(binary)] = sizes else {
        return Err(io::Error::other("more than 4 GiB: too large for a GLB file"));
    };
    write_words(&mut writer, &[0x4654_6C67, 2, whole, json, 0x4E4F_534A])?;
    writer.write_all(&text)?;
    write_words(&mut writer, &[binary, 0x004E_4942])?;
    writer.write_all(&bytes)?;
    writer.flush()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::foreign::tests::{assert_alike, varied};

    fn read(file: &[u8]) -> (Gaussians, Value) {
        let word = |at: usize| u32::from_le_bytes(file[at..at + 4].try_into().unwrap()) as usize;
        assert_eq!((&file[..4], word(4), word(8)), (&b"glTF"[..], 2, file.len()));
        let json: Value = serde_json::from_slice(&file[20..20 + word(12)]).unwrap();
        let binary = &file[28 + word(12)..];
        let primitive = &json["meshes"][0]["primitives"][0];
        let floats = |name: &str| -> Option<Vec<f32>> {
            let accessor = &json["accessors"][primitive["attributes"].get(name)?.as_u64()? as usize];
            let view = &json["bufferViews"][accessor["bufferView"].as_u64()? as usize];
            let (at, length) = (view["byteOffset"].as_u64()? as usize, view["byteLength"].as_u64()? as usize);
            let width = match accessor["type"].as_str()? {
                "SCALAR" => 1,
                "VEC3" => 3,
                _ => 4,
            };
            assert_eq!(length, 4 * width * accessor["count"].as_u64()? as usize);
            let floats = binary[at..at + length].chunks_exact(4);
            Some(floats.map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect())
        };
        let own = |name: &str| floats(&format!("KHR_gaussian_splatting:{name}"));
        let rows =
            |v: Vec<f32>| -> Vec<[f32; 3]> { v.chunks_exact(3).map(|r| r.try_into().unwrap()).collect() };
        let degree = (0..4).rev().find(|d| own(&format!("SH_DEGREE_{d}_COEF_0")).is_some()).unwrap();
        let mut g = Gaussians::empty(degree);
        g.means = rows(floats("POSITION").unwrap());
        g.log_scales = rows(own("SCALE").unwrap()).iter().map(|s| s.map(math::ln)).collect();
        g.quaternions = own("ROTATION").unwrap().chunks_exact(4).map(|q| [q[3], q[0], q[1], q[2]]).collect();
        g.opacity_logits = own("OPACITY").unwrap().iter().map(|&o| math::ln(o / (1.0 - o))).collect();
        g.sh = vec![[[0.0; 3]; 16]; g.means.len()];
        for l in 0..=degree {
            for k in 0..=2 * l {
                for (sh, row) in g.sh.iter_mut().zip(rows(own(&format!("SH_DEGREE_{l}_COEF_{k}")).unwrap())) {
                    sh[l * l + k] = row;
                }
            }
        }
        (g, json)
    }

    #[test]
    fn what_is_written_is_read_again() {
        for degree in [0, 3] {
            let written = varied(300, degree);
            let mut file = Vec::new();
            write(&written, "3D-USE", [1.0, 0.0, 0.0, 0.0], &mut file).unwrap();
            let (read, json) = read(&file);
            assert_alike(&written, &read, [0.0, 1e-5, 1e-6, 1e-6, 0.0, 0.0]);
            assert_eq!(json["nodes"][0]["rotation"], json!([1.0, 0.0, 0.0, 0.0]));
            assert!(json["asset"]["extras"]["note"].as_str().unwrap().contains("water"));
        }
    }
}
