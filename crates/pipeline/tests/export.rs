//! Files for other programs: scenes far from zero, coarse formats, and readers that count lines.

use std::path::Path;

use glam::{DMat3, DQuat, DVec3};
use use3d_capture::Frame;
use use3d_medium::{MediumKind, MediumModel, MediumStart};
use use3d_pipeline::export::{ExportLook, ExportedScene, GaussianFormat, GaussianFrame, WrittenFile};
use use3d_scene::Scene;
use use3d_scene::white::Gains;
use use3d_splat::{Gaussians, ply};
use use3d_web::foreign::spz::Version;

const COUNT: usize = 3000;
/// The place of a model in the coordinates of the earth's middle, metres.
const EARTH: [f64; 3] = [4_358_067.15, 506_612.6, 4_614_943.73];

/// A number in `[−1, 1]` for each index.
fn spread(i: usize) -> f32 {
    (((i * 7919 + 13) % 10_007) as f32 / 5003.5) - 1.0
}

/// A scene without water whose model lies `away` from zero, 20 units wide.
fn scene(away: DVec3) -> Scene {
    let mut gaussians = Gaussians::empty(0);
    for i in 0..COUNT {
        gaussians.means.push([spread(3 * i), spread(3 * i + 1), spread(3 * i + 2)]);
        gaussians.log_scales.push([-4.0; 3]);
        gaussians.quaternions.push([1.0, 0.0, 0.0, 0.0]);
        gaussians.opacity_logits.push(2.0);
        gaussians.sh.push([[0.1; 3]; 16]);
    }
    let (scale, rotation) = (0.1, DMat3::from_quat(DQuat::from_rotation_x(0.4)));
    let frame = Frame { scale, rotation, translation: -scale * (rotation * away) };
    let medium = MediumModel::start(
        MediumKind::None,
        &MediumStart { anchors: 1, top_k: 1, seed: 0, views: Vec::new() },
    )
    .unwrap();
    Scene { gaussians, frame, medium, medium_degree: 0, enhancement: None }
}

fn written(scene: &Scene, path: &Path, format: GaussianFormat) -> WrittenFile {
    let look = ExportLook { mode: None, water: 0.0, backdrop: false, gains: Gains::ONE, cameras: None };
    let exported = ExportedScene::bake((scene, path.parent().unwrap()), &look, None).unwrap();
    exported.write(("--file", path), format, GaussianFrame::Colmap, "use3d test".into()).unwrap()
}

#[test]
fn export_far() {
    let dir = tempfile::tempdir().unwrap();
    for away in [DVec3::ZERO, DVec3::from_array(EARTH), DVec3::new(0.0, -3e7, 12.5)] {
        let scene = scene(away);
        let path = dir.path().join(format!("{}.ply", away.y));
        let file = written(&scene, &path, GaussianFormat::Ply);
        assert_eq!(file.offset.is_some(), away != DVec3::ZERO, "{file:?}");
        let offset = DVec3::from_array(file.offset.unwrap_or_default());
        let read = ply::read(std::fs::File::open(&path).unwrap()).unwrap();
        for (own, normalised) in read.means.iter().zip(&scene.gaussians.means) {
            let expected = scene.frame.invert(DVec3::from_array(normalised.map(f64::from)));
            let found = DVec3::from_array(own.map(f64::from)) + offset;
            assert!(found.distance(expected) < 1e-4 * file.extent, "{found} {expected} {file:?}");
        }
        let header = std::fs::read(&path).unwrap();
        let header = String::from_utf8_lossy(&header[..600]).into_owned();
        assert_eq!(header.contains("comment offset: add "), file.offset.is_some(), "{header}");
        for format in
            [GaussianFormat::Spz(Version::Three), GaussianFormat::CompressedPly, GaussianFormat::Glb]
        {
            let file = written(&scene, &dir.path().join(format!("{}-{format:?}", away.y)), format);
            assert!(file.rounding < 3e-4 * file.extent, "{format:?} {file:?}");
        }
    }
}

#[test]
fn a_far_gaussian_makes_a_coarse_file_and_that_is_said() {
    let dir = tempfile::tempdir().unwrap();
    let mut scene = scene(DVec3::ZERO);
    scene.gaussians.means[7] = [3.0e5, 0.0, 0.0];
    let fine = written(&scene, &dir.path().join("fine.ply"), GaussianFormat::Ply);
    let coarse = written(&scene, &dir.path().join("coarse.spz"), GaussianFormat::Spz(Version::Three));
    assert!(fine.offset.is_none() && fine.rounding < 1e-5 * fine.extent, "{fine:?}");
    assert!(coarse.rounding > 3e-4 * coarse.extent, "{coarse:?}");
}

#[test]
fn ply_header_third_line() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("scene.ply");
    written(&scene(DVec3::ZERO), &path, GaussianFormat::Ply);
    let bytes = std::fs::read(path).unwrap();
    let third = bytes.split(|b| *b == b'\n').nth(2).unwrap();
    assert_eq!(String::from_utf8_lossy(third), format!("element vertex {COUNT}"));
}
