//! Scene folders: round trips, the oracle's scene, and the errors of a damaged one.

use std::fs;
use std::path::Path;

use glam::{DMat3, DVec3};
use use3d_capture::{Appearance, Frame, KeptWater};
use use3d_medium::{MediumModel, MediumRbf};
use use3d_scene::{Scene, SceneError};
use use3d_splat::Gaussians;
use use3d_ubaf::{Enhancement, Field, FieldBox, Shape};

fn sample() -> Scene {
    let n = 5;
    let value = |i: usize, k: usize| (i * 7 + k) as f32 * 0.01 - 0.1;
    let gaussians = Gaussians {
        sh_degree: 3,
        means: (0..n).map(|i| [value(i, 0), value(i, 1), value(i, 2)]).collect(),
        log_scales: (0..n).map(|i| [-3.0 + value(i, 3), -3.0, -2.5]).collect(),
        quaternions: (0..n).map(|i| [1.0, value(i, 4), 0.0, 0.2]).collect(),
        opacity_logits: (0..n).map(|i| value(i, 5)).collect(),
        sh: (0..n).map(|i| std::array::from_fn(|b| [value(i, b), value(i, b + 1), value(b, i)])).collect(),
    };
    let field = Field::identity(
        Shape { resolution: 4, rank: 2, width: 3 },
        FieldBox { low: [-1.0; 3], high: [1.0, 2.0, 3.0] },
        7,
    );
    Scene {
        gaussians,
        frame: Frame {
            scale: 0.25,
            rotation: DMat3::from_axis_angle(DVec3::new(0.0, 0.6, 0.8), 0.3),
            translation: DVec3::new(0.1, -0.2, 3.0),
        },
        medium: MediumModel::Rbf(MediumRbf::new(8, 4)),
        medium_degree: 2,
        enhancement: Some(Enhancement {
            field: field.unwrap(),
            centre: [0.5, 0.25, 0.0, -1.0, 2.0, 3.0],
            appearance: Appearance::Water,
            kept_water: KeptWater::ALL,
        }),
    }
}

#[test]
fn a_scene_survives_the_disk_bit_for_bit() {
    let dir = tempfile::tempdir().unwrap();
    let scene = sample();
    scene.save(dir.path()).unwrap();
    assert_eq!(Scene::load(dir.path()).unwrap(), scene);
    let bytes = |name: &str| fs::read(dir.path().join(name)).unwrap();
    let before: Vec<_> =
        ["scene.json", "gaussians.ply", "medium.safetensors", "ubaf.safetensors"].map(bytes).to_vec();
    scene.save(dir.path()).unwrap();
    let after: Vec<_> =
        ["scene.json", "gaussians.ply", "medium.safetensors", "ubaf.safetensors"].map(bytes).to_vec();
    assert_eq!(before, after);
    // After saving again without the enhancement, no file of it is left.
    Scene { enhancement: None, medium: MediumModel::None, ..scene }.save(dir.path()).unwrap();
    let plain = Scene::load(dir.path()).unwrap();
    assert!(plain.enhancement.is_none() && plain.medium.is_none());
    assert!(!dir.path().join("ubaf.safetensors").exists() && !dir.path().join("medium.safetensors").exists());
}

#[test]
fn what_an_enhancement_was_learnt_in_is_kept_and_older_scenes_were_enhanced_with_their_water() {
    let dir = tempfile::tempdir().unwrap();
    let mut scene = sample();
    scene.enhancement.as_mut().unwrap().appearance = Appearance::Clear;
    scene.save(dir.path()).unwrap();
    assert_eq!(Scene::load(dir.path()).unwrap(), scene);
    let path = dir.path().join("scene.json");
    let mut json: serde_json::Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    assert_eq!(json["enhancement"]["appearance"], "clear");
    json["enhancement"].as_object_mut().unwrap().remove("appearance");
    fs::write(&path, json.to_string()).unwrap();
    assert_eq!(Scene::load(dir.path()).unwrap().enhancement.unwrap().appearance, Appearance::Water);
    json["enhancement"]["appearance"] = "fog".into();
    fs::write(&path, json.to_string()).unwrap();
    let message = Scene::load(dir.path()).unwrap_err().to_string();
    assert!(message.contains("scene.json") && message.contains("`fog`"), "{message}");
}

#[test]
fn the_water_that_an_enhanced_scene_keeps_is_in_its_description() {
    let dir = tempfile::tempdir().unwrap();
    let mut scene = sample();
    scene.save(dir.path()).unwrap();
    let path = dir.path().join("scene.json");
    let whole = fs::read_to_string(&path).unwrap();
    assert!(!whole.contains("kept_water"), "nothing is said where all of the water is kept: {whole}");
    scene.enhancement.as_mut().unwrap().kept_water = KeptWater([0.5, 0.75, 1.0]);
    scene.save(dir.path()).unwrap();
    assert_eq!(Scene::load(dir.path()).unwrap(), scene);
    for wrong in ["[0.5, 0.75, 1.5]", "[0.5, -0.1, 1.0]"] {
        let text = fs::read_to_string(&path).unwrap();
        let mut json: serde_json::Value = serde_json::from_str(&text).unwrap();
        json["enhancement"]["kept_water"] = serde_json::from_str(wrong).unwrap();
        fs::write(&path, json.to_string()).unwrap();
        let message = Scene::load(dir.path()).unwrap_err().to_string();
        assert!(message.contains("enhancement.kept_water") && message.contains("0 to 1"), "{message}");
    }
}

#[test]
fn golden_scene_mini_loads() {
    let scene = Scene::load(&use3d_golden::root().join("scene-mini/scene")).unwrap();
    assert_eq!((scene.gaussians.len(), scene.gaussians.sh_degree, scene.medium_degree), (400, 3, 3));
    let truth = use3d_golden::Part::load(&use3d_golden::root().join("scene-mini/truth.safetensors"));
    assert_eq!(scene.gaussians.means, truth.whole().rows::<3>("means"));
    match scene.medium {
        MediumModel::Rbf(rbf) => assert_eq!(rbf.centers, truth.whole().rows::<3>("medium.centers")),
        other => panic!("expected rbf, found {:?}", other.kind()),
    }
}

fn corrupt(dir: &Path, from: &str, to: &str) -> String {
    sample().save(dir).unwrap();
    let path = dir.join("scene.json");
    let text = fs::read_to_string(&path).unwrap();
    assert!(text.contains(from), "{text}");
    fs::write(&path, text.replace(from, to)).unwrap();
    Scene::load(dir).unwrap_err().to_string()
}

#[test]
fn a_damaged_description_says_what_is_wrong() {
    let dir = tempfile::tempdir().unwrap();
    let d = dir.path();
    assert!(matches!(Scene::load(d), Err(SceneError::NotAScene(_))));
    assert!(corrupt(d, "\"version\": 1", "\"version\": 9").contains("version is 9"));
    assert!(corrupt(d, "3d-use scene", "something").contains("format is `something`"));
    assert!(corrupt(d, "\"rbf\"", "\"jelly\"").contains("medium.kind is `jelly`"));
    assert!(corrupt(d, "\"gaussians.ply\"", "\"../gaussians.ply\"").contains("plain name inside"));
    assert!(corrupt(d, "\"scale\": 0.25", "\"scale\": -1.0").contains("frame.scale is -1"));
    assert!(corrupt(d, "\"top_k\": 4", "\"top_k\": 40").contains("medium.safetensors"));
}

#[test]
fn truncated_payloads_are_errors_and_name_the_file() {
    let dir = tempfile::tempdir().unwrap();
    for name in ["gaussians.ply", "medium.safetensors", "ubaf.safetensors"] {
        sample().save(dir.path()).unwrap();
        let path = dir.path().join(name);
        let bytes = fs::read(&path).unwrap();
        for keep in [0, 7, bytes.len() / 2, bytes.len() - 1] {
            fs::write(&path, &bytes[..keep]).unwrap();
            let message = Scene::load(dir.path()).unwrap_err().to_string();
            assert!(message.contains(name), "{message}");
        }
    }
}

#[test]
fn a_folder_that_is_not_complete_and_a_description_that_is_cut_off_are_said_with_the_next_step() {
    let again = "copy the scene folder again, or make it again with `use3d run`";
    let dir = tempfile::tempdir().unwrap();
    let said = || Scene::load(dir.path()).unwrap_err().to_string();
    for name in ["gaussians.ply", "medium.safetensors", "ubaf.safetensors"] {
        sample().save(dir.path()).unwrap();
        fs::remove_file(dir.path().join(name)).unwrap();
        let folder = dir.path().display();
        let expected = format!("{folder}: the scene folder is not complete: {name} is missing; {again}");
        assert_eq!(said(), expected);
    }
    sample().save(dir.path()).unwrap();
    let path = dir.path().join("scene.json");
    let text = fs::read_to_string(&path).unwrap();
    let cut: String = text.split_inclusive('\n').take(6).collect();
    fs::write(&path, cut.trim_end()).unwrap();
    let expected =
        format!("{}: it is damaged or cut off (line 6: the file ends here); {again}", path.display());
    assert_eq!(said(), expected);
    fs::write(&path, text.replace("\"version\": 1,", "")).unwrap();
    let lines = text.lines().count();
    let expected = format!("it is damaged or cut off (line {lines}: missing field `version`); {again}");
    assert!(said().ends_with(&expected), "{}", said());
}
