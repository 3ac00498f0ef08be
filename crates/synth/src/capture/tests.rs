use std::collections::BTreeMap;
use std::path::PathBuf;

use glam::{DVec2, Vec3};
use use3d_capture::Intrinsics;
use use3d_io_image::{read_image, read_map};
use use3d_numerics::math;

use super::*;
use crate::scene::Location;
use crate::water::WaterType;

fn small() -> CaptureParams {
    CaptureParams { views: 5, width: 80, height: 60, points: 300, detail: 0.12, ..CaptureParams::default() }
}

fn in_pool<T: Send>(threads: usize, f: impl FnOnce() -> T + Send) -> T {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(f)
}

fn files(root: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let (mut out, mut open) = (BTreeMap::new(), vec![root.to_path_buf()]);
    while let Some(dir) = open.pop() {
        for entry in std::fs::read_dir(&dir).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
            } else {
                let bytes = std::fs::read(&path).unwrap();
                out.insert(path.strip_prefix(root).unwrap().to_path_buf(), bytes);
            }
        }
    }
    out
}

/// The written cameras in COLMAP's frame, in view order.
fn cameras(model: &use3d_io_colmap::Model) -> Vec<Camera> {
    let k = &model.cameras[0];
    let intrinsics = Intrinsics {
        width: k.width,
        height: k.height,
        fx: k.parameters[0],
        fy: k.parameters[1],
        cx: k.parameters[2],
        cy: k.parameters[3],
    };
    model.images.iter().map(|image| Camera { intrinsics, pose: image.pose() }).collect()
}

#[test]
fn a_capture_is_the_same_for_any_number_of_threads_and_agrees_with_its_truth() {
    let dir = tempfile::tempdir().unwrap();
    let params = small();
    let (a, b) = (dir.path().join("a"), dir.path().join("b"));
    let truth = in_pool(1, || write_capture(&params, &a, &mut |_, _| {})).unwrap();
    in_pool(3, || write_capture(&params, &b, &mut |_, _| {})).unwrap();
    let (first, second) = (files(&a), files(&b));
    assert_eq!(first.keys().collect::<Vec<_>>(), second.keys().collect::<Vec<_>>());
    for (name, bytes) in &first {
        assert!(bytes == &second[name], "{} differs", name.display());
    }
    let read: CaptureTruth =
        serde_json::from_slice(&std::fs::read(a.join("truth/water.json")).unwrap()).unwrap();
    assert_eq!(read, truth);

    let model = use3d_io_colmap::read_model(&a.join("sparse/0")).unwrap();
    let cameras = cameras(&model);
    assert_eq!(cameras.len(), params.views);
    let depths: Vec<Map> = (0..params.views)
        .map(|i| read_map(&a.join(format!("truth/depth/{}.exr", stem(i)))).unwrap())
        .collect();
    the_formation_equation_holds(&a, &truth, &cameras, &depths, params.noise);
    depths_agree_between_views(&cameras, &depths);
    points_reproject(&model, &cameras);
    priors_follow_disparity(&a, &depths);
}

/// FNV-1a over what the files of a capture say: decoded values, because an encoder may change.
fn content(root: &Path) -> u64 {
    let mut hash = 0xcbf2_9ce4_8422_2325u64;
    let mut feed = |bytes: &[u8]| {
        for byte in bytes {
            hash = (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3);
        }
    };
    for (name, bytes) in files(root) {
        feed(name.to_str().unwrap().as_bytes());
        let values = match name.extension().and_then(|e| e.to_str()) {
            Some("png") if name.starts_with("depth") || name.starts_with("masks") => {
                read_map(&root.join(&name)).unwrap().data().to_vec()
            }
            Some("png") => read_image(&root.join(&name)).unwrap().data().to_vec(),
            Some("exr") => read_map(&root.join(&name)).unwrap().data().to_vec(),
            _ => {
                feed(&bytes);
                continue;
            }
        };
        values.iter().for_each(|v| feed(&v.to_bits().to_le_bytes()));
    }
    hash
}

#[test]
fn a_capture_without_a_lens_is_the_one_it_was_before_there_were_lenses() {
    let dir = tempfile::tempdir().unwrap();
    let spectral = CaptureParams { physics: Physics::Spectral, fish: 1, snow: 0.3, ..small() };
    let found = [small(), spectral].map(|params| {
        let out = dir.path().join(format!("{:?}", params.physics));
        write_capture(&CaptureParams { views: 3, width: 48, height: 32, ..params }, &out, &mut |_, _| {})
            .unwrap();
        format!("{:016x}", content(&out))
    });
    assert_eq!(found, ["95a0fd9b4608b537", "fbcf3f7097dc8dfa"]);
}

#[test]
fn a_pool_is_even_and_has_points_where_its_joints_are() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("pool");
    let params = CaptureParams {
        place: Location::Pool,
        views: 6,
        width: 160,
        height: 90,
        points: 600,
        depth_priors: false,
        ..CaptureParams::default()
    };
    write_capture(&params, &out, &mut |_, _| ()).unwrap();
    let model = use3d_io_colmap::read_model(&out.join("sparse/0")).unwrap();
    assert!(model.points.len() > 100, "{}", model.points.len());
    let clean = read_image(&out.join("truth/clean/frame_0003.png")).unwrap();
    let depth = read_map(&out.join("truth/depth/frame_0003.exr")).unwrap();
    assert!(depth.data().iter().filter(|z| **z > 0.0).count() > 160 * 80, "floor and walls all around");
    // For more than half of the pixels, neighbouring pixels of the floor hardly differ.
    let even = |x: usize, y: usize| (clean.pixel(x, y)[1] - clean.pixel(x + 1, y)[1]).abs() < 0.02;
    let pixels = (0..90).flat_map(|y| (0..159).map(move |x| (x, y)));
    let share = pixels.filter(|(x, y)| even(*x, *y)).count() as f64 / (90.0 * 159.0);
    assert!(share > 0.5, "{share}");
}

/// Checks I = J e^{-β_attn s} + c_m (1 - e^{-β_bs s}) from the written files alone, away from edges, within
/// noise and quantisation.
fn the_formation_equation_holds(
    dir: &Path,
    truth: &CaptureTruth,
    cameras: &[Camera],
    depths: &[Map],
    noise: f32,
) {
    let water = truth.water.expect("the method's own water");
    let (mut checked, mut squares, mut water_only) = (0, 0.0f64, 0);
    for (i, (camera, depth)) in cameras.iter().zip(depths).enumerate() {
        let picture = read_image(&dir.join(format!("images/{}.png", stem(i)))).unwrap();
        let clean = read_image(&dir.join(format!("truth/clean/{}.png", stem(i)))).unwrap();
        for y in 1..depth.height() - 1 {
            for x in 1..depth.width() - 1 {
                let z = depth.pixel(x, y)[0];
                let around =
                    [(x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)].map(|(x, y)| depth.pixel(x, y)[0]);
                if around.iter().any(|&d| (d - z).abs() > 0.015 * z.min(d)) {
                    continue;
                }
                let ray = camera.ray(x as f64 + 0.5, y as f64 + 0.5);
                let direction = (camera.pose.rotation.transpose() * ray.normalize()).as_vec3();
                let s = if z > 0.0 { z * ray.length() as f32 } else { f32::INFINITY };
                water_only += usize::from(z == 0.0);
                let predicted = water.seen_through(clean.pixel(x, y), s, direction);
                let found = picture.pixel(x, y);
                for c in 0..3 {
                    squares += math::powi(f64::from(predicted[c] - found[c]), 2);
                    checked += 1;
                }
            }
        }
    }
    assert!(checked > 10_000 && water_only > 50, "{checked} values, {water_only} open-water pixels");
    // A few interior pixels are averages over another object's edge.
    let rms = (squares / f64::from(checked)).sqrt();
    assert!(rms < 2.0 * f64::from(noise), "formation equation is off by {rms}");
}

/// Checks that a surface point of one view has the depth that another view sees there, unless it is hidden.
fn depths_agree_between_views(cameras: &[Camera], depths: &[Map]) {
    let (mut agree, mut nearer_than_seen, mut tested) = (0, 0, 0);
    for i in 0..cameras.len() - 1 {
        let (from, to) = (&cameras[i], &cameras[i + 1]);
        for y in (0..depths[i].height()).step_by(2) {
            for x in (0..depths[i].width()).step_by(2) {
                let z = f64::from(depths[i].pixel(x, y)[0]);
                if z <= 0.0 {
                    continue;
                }
                let ray = from.ray(x as f64 + 0.5, y as f64 + 0.5);
                let point = from.pose.center() + from.pose.rotation.transpose() * (z * ray);
                let Some((DVec2 { x: u, y: v }, depth)) = to.project(point) else { continue };
                if u < 0.0 || v < 0.0 || u >= depths[i].width() as f64 || v >= depths[i].height() as f64 {
                    continue;
                }
                let seen = f64::from(depths[i + 1].pixel(u as usize, v as usize)[0]);
                tested += 1;
                agree += usize::from((seen / depth - 1.0).abs() < 0.05);
                nearer_than_seen += usize::from(seen == 0.0 || seen > 1.3 * depth);
            }
        }
    }
    assert!(tested > 1000 && agree * 10 > tested * 6, "{agree} of {tested} agree");
    // A point can be hidden, but a view never sees a surface behind it.
    assert!(nearer_than_seen * 25 < tested, "{nearer_than_seen} of {tested} are in front of what is seen");
}

fn points_reproject(model: &use3d_io_colmap::Model, cameras: &[Camera]) {
    assert!(model.points.len() > 100, "{} points", model.points.len());
    let mut errors: Vec<f64> = Vec::new();
    for point in &model.points {
        assert!(point.track.len() >= 2);
        for &(image, keypoint) in &point.track {
            let index = model.images.iter().position(|m| m.id == image).unwrap();
            let keypoint = &model.images[index].keypoints[keypoint as usize];
            assert_eq!(keypoint.point, point.id);
            let (pixel, _) = cameras[index].project(point.position.into()).unwrap();
            errors.push(math::hypot(pixel.x - keypoint.x, pixel.y - keypoint.y));
        }
    }
    errors.sort_by(f64::total_cmp);
    let median = errors[errors.len() / 2];
    assert!((0.1..1.0).contains(&median), "median reprojection error {median}");
    assert!(errors[errors.len() * 98 / 100] < 4.0);
    let registered = use3d_capture::Pose::IDENTITY;
    assert!(cameras.iter().all(|c| c.pose.validate().is_ok() && c.pose != registered));
}

/// Checks that priors are larger for nearer pixels, nearly everywhere, and unknown where there is no surface.
fn priors_follow_disparity(dir: &Path, depths: &[Map]) {
    let prior = read_map(&dir.join(format!("depth/{}.png", stem(0)))).unwrap();
    let pixels: Vec<(f32, f32)> = depths[0].data().iter().zip(prior.data()).map(|(&z, &p)| (z, p)).collect();
    assert!(pixels.iter().all(|&(z, p)| (z > 0.0) == (p > 0.0)));
    let known: Vec<_> = pixels.iter().filter(|(z, _)| *z > 0.0).collect();
    let (mut right, mut all) = (0, 0);
    for i in 0..known.len() {
        let (a, b) = (known[i], known[(i * 7919 + 13) % known.len()]);
        if a.0 < 0.8 * b.0 {
            all += 1;
            right += usize::from(a.1 > b.1);
        }
    }
    assert!(all > 500 && right * 100 > all * 97, "{right} of {all}");
}

#[test]
fn outputs_are_never_overwritten_and_parameters_are_checked() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("note.txt"), "mine").unwrap();
    let error = write_capture(&small(), dir.path(), &mut |_, _| {}).unwrap_err();
    assert!(matches!(error, SynthError::OutputExists { .. }) && error.to_string().contains("already there"));
    let bad: [(CaptureParams, &str); 7] = [
        (CaptureParams { views: 1, ..small() }, "views"),
        (CaptureParams { width: 3, ..small() }, "width"),
        (CaptureParams { noise: f32::NAN, ..small() }, "noise"),
        (CaptureParams { detail: 0.0, ..small() }, "detail"),
        (CaptureParams { snow: 0.5, ..small() }, "snow"),
        (CaptureParams { air: true, ..small() }, "air"),
        (CaptureParams { fish: 51, physics: Physics::Spectral, ..small() }, "fish"),
    ];
    for (params, field) in bad {
        let out = dir.path().join("new");
        let error = write_capture(&params, &out, &mut |_, _| {}).unwrap_err();
        assert!(error.to_string().contains(field) && !out.exists());
    }
    let unknown = serde_json::from_str::<CaptureParams>(r#"{"veiws": 3}"#).unwrap_err();
    assert!(unknown.to_string().contains("veiws"));
}

#[test]
fn the_colmap_frame_is_a_similarity_with_y_roughly_down() {
    for seed in 0..20 {
        let frame = colmap_frame(seed);
        assert!((frame.rotation.determinant() - 1.0).abs() < 1e-12);
        let down = frame.rotation * Vec3::NEG_Z.as_dvec3();
        assert!(down.y > 0.8, "seed {seed}: {down}");
    }
}

fn spectral() -> CaptureParams {
    CaptureParams { physics: Physics::Spectral, auto_exposure: 1.0, white_balance: 0.5, ..small() }
}

/// The mean of each channel of a view's file, display values.
fn means(path: &Path) -> [f32; 3] {
    let image = read_image(path).unwrap();
    image.planes().map(|plane| plane.iter().sum::<f32>() / plane.len() as f32)
}

#[test]
fn a_spectral_capture_is_deterministic_sets_each_view_and_hides_its_fish() {
    let dir = tempfile::tempdir().unwrap();
    let params = CaptureParams { fish: 3, snow: 0.3, ..spectral() };
    let (a, b) = (dir.path().join("a"), dir.path().join("b"));
    let truth = in_pool(1, || write_capture(&params, &a, &mut |_, _| {})).unwrap();
    in_pool(3, || write_capture(&params, &b, &mut |_, _| {})).unwrap();
    assert_eq!(files(&a), files(&b));
    assert_eq!(truth.gains.len(), params.views);
    assert!(truth.water.is_none() && truth.attenuation_per_metre.is_none());
    let effective = truth.effective_attenuation_per_metre.expect("spectral water");
    assert!(effective[0] > effective[1], "{effective:?}");
    let red: Vec<f32> = truth.gains.iter().map(|g| g.gains[0]).collect();
    assert!(red.iter().any(|g| (g / red[0] - 1.0).abs() > 0.01), "{red:?}");

    // The masks exist, and no feature of the scene is tracked on a fish.
    let model = use3d_io_colmap::read_model(&a.join("sparse/0")).unwrap();
    let mut hidden = 0;
    for (i, image) in model.images.iter().enumerate() {
        let mask = read_map(&a.join(format!("masks/{}.png", stem(i)))).unwrap();
        hidden += mask.data().iter().filter(|v| **v == 0.0).count();
        assert_eq!(image.name, file(i));
    }
    assert!(hidden > 100, "{hidden} pixels hidden");
}

#[test]
fn one_setting_for_all_views_is_one_gain_and_noise_is_the_sensors() {
    let dir = tempfile::tempdir().unwrap();
    let write = |name: &str, params: &CaptureParams| {
        let out = dir.path().join(name);
        (write_capture(params, &out, &mut |_, _| {}).unwrap(), out)
    };
    let (fixed, _) = write("fixed", &CaptureParams { auto_exposure: 0.0, ..spectral() });
    let first = fixed.gains[0].gains;
    for view in &fixed.gains {
        for (g, wanted) in view.gains.iter().zip(first) {
            assert!((g / wanted - 1.0).abs() < 1e-4, "{view:?} is not {first:?}");
        }
    }
    // Air under a full grey-world balance is nearly neutral and keeps the clean picture's contrast.
    let air = CaptureParams { air: true, white_balance: 0.0, noise: 0.0, ..spectral() };
    let (truth, out) = write("air", &air);
    let view = |folder: &str| means(&out.join(folder).join(file(0)));
    let (photograph, clean) = (view("images"), view("truth/clean"));
    assert!(photograph.iter().chain(&clean).all(|v| (0.05..0.95).contains(v)), "{photograph:?} {clean:?}");
    assert_eq!(truth.effective_attenuation_per_metre.map(|k| k.map(|v| v.abs() < 1e-5)), Some([true; 3]));
    // Under water, red is missing.
    let (_, out) = write("water", &CaptureParams { white_balance: 0.0, ..spectral() });
    let [red, green, _] = means(&out.join("images").join(file(0)));
    assert!(red < green, "{red} {green}");
}

#[test]
fn a_display_capture_keeps_its_description_when_fields_are_added() {
    let text = serde_json::to_string(&CaptureParams::default()).unwrap();
    for field in ["physics", "air", "lamps", "auto_exposure", "snow", "fish"] {
        assert!(!text.contains(field), "{text}");
    }
    assert_eq!(serde_json::from_str::<CaptureParams>(&text).unwrap(), CaptureParams::default());
}

#[test]
fn an_action_camera_s_capture_marks_grey_patches_that_are_grey_without_water() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("action");
    let params = CaptureParams {
        views: 4,
        width: 160,
        height: 90,
        physics: Physics::Spectral,
        camera: Development::Action,
        greys: true,
        white_balance: 0.5,
        auto_exposure: 1.0,
        ..small()
    };
    write_capture(&params, &out, &mut |_, _| ()).unwrap();
    let (mut patches, mut clipped) = (0, 0);
    for view in 0..params.views {
        let read = |folder: &str| read_image(&out.join(folder).join(file(view))).unwrap();
        let (clean, photograph) = (read("truth/clean"), read("images"));
        let greys = read_map(&out.join("truth/greys").join(file(view))).unwrap();
        clipped += photograph.plane(0).iter().filter(|v| **v == 0.0).count();
        for y in 0..params.height {
            for x in 0..params.width {
                if greys.pixel(x, y)[0] == 1.0 {
                    patches += 1;
                    let [r, g, b] = clean.pixel(x, y);
                    assert!((r - g).abs() < 0.02 && (b - g).abs() < 0.02, "{view} {x} {y}: {r} {g} {b}");
                }
            }
        }
    }
    assert!(patches > 100, "{patches}");
    assert!(clipped > 50, "red is clipped far away: {clipped}");
}

#[test]
fn tiles_of_the_veil_s_colour_look_alike_from_near_and_far() {
    let dir = tempfile::tempdir().unwrap();
    let spread = |place: Location| {
        let out = dir.path().join(place.name());
        let params = CaptureParams { place, water: WaterType::Ib, noise: 0.0, ..small() };
        write_capture(&params, &out, &mut |_, _| ()).unwrap();
        let image = read_image(&out.join("images").join(file(0))).unwrap();
        let mean = |rows: std::ops::Range<usize>| {
            let n = (rows.len() * params.width) as f32;
            [0, 1, 2].map(|c| rows.clone().map(|y| image.row(c, y).iter().sum::<f32>()).sum::<f32>() / n)
        };
        let (far, near) = (mean(0..10), mean(params.height - 10..params.height));
        (0..3).map(|c| math::ln(far[c] / far[1] / (near[c] / near[1])).abs()).fold(0.0, f32::max)
    };
    let (blue, veil) = (spread(Location::Pool), spread(Location::VeilPool));
    assert!(veil < 0.6 * blue, "{veil} {blue}");
}

#[test]
fn what_only_spectral_captures_and_reefs_have_is_refused_elsewhere() {
    let refused = |params: CaptureParams| params.validate().unwrap_err().to_string();
    assert!(refused(CaptureParams { camera: Development::Action, ..small() }).contains("camera"));
    assert!(refused(CaptureParams { backlight: 0.5, ..small() }).contains("backlight"));
    let far = CaptureParams { physics: Physics::Spectral, backlight: 1.5, ..small() };
    assert!(refused(far).contains("0 to 1"));
    assert!(refused(CaptureParams { greys: true, place: Location::Pool, ..small() }).contains("greys"));
}
