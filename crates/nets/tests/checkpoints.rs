//! Checkpoint files: every container format of every network gives the same tensors; a wrong file gives an
//! error that names the tensor.

use use3d_nets::models::DigestCheck;
use use3d_nets::weights::{StandIn, Weights};
use use3d_nets::{
    Archive, Checkpoint, DepthAnythingSize, DepthAnythingV2, Lpips, Models, Musiq, NetError, Network, Nu2Net,
    Raft, URanker,
};

#[allow(dead_code, unused_imports, reason = "each test binary uses a part of it")]
mod torch_files;
use torch_files::{
    Nesting, Tensors, heads, legacy_file, open, read_all, recorded, safetensors_file, zip_file,
};

fn check_containers(tensors: &Tensors, expected_values: usize) {
    let count: usize = tensors.values().map(|(_, v)| v.len()).sum();
    assert_eq!(count, expected_values, "values");
    let dir = tempfile::tempdir().unwrap();
    for bytes in
        [zip_file(tensors, Nesting::Net), legacy_file(tensors, Nesting::Module), safetensors_file(tensors)]
    {
        let read = read_all(dir.path(), &bytes, tensors).unwrap();
        assert!(read == *tensors, "the tensors differ");
    }
}

#[test]
fn every_container_of_nu2net_raft_and_lpips_gives_the_same_tensors() {
    check_containers(&recorded(|r| Nu2Net::from_weights(r).map(drop)), 3_145_923);
    // The counts are without the 29 counters of batches; 5 260 431 − 5 257 536 of the values are statistics
    // of batch norms.
    let raft = recorded(|r| Raft::from_weights(r).map(drop));
    let statistics: usize =
        raft.iter().filter(|(n, _)| n.contains("running_")).map(|(_, (_, v))| v.len()).sum();
    check_containers(&raft, 5_257_536 + statistics);
    check_containers(&recorded(|r| Lpips::from_weights(r, &mut StandIn).map(drop)), 2_469_696);
    check_containers(&heads(), 1_152);
}

#[test]
fn every_container_of_the_larger_networks_gives_the_same_tensors() {
    // `norm1` of URanker is in the file and is not used; the same holds for DA2's mask token and the first
    // residual unit of the coarsest level.
    check_containers(&recorded(|r| URanker::from_weights(r).map(drop)), 21_588_823 - 2 * 152);
    check_containers(&recorded(|r| Musiq::from_weights(r).map(drop)), 27_125_825);
    let small = recorded(|r| DepthAnythingV2::from_weights(DepthAnythingSize::Small, r).map(drop));
    check_containers(&small, 24_785_089 - 384 - 2 * (64 * 64 * 9 + 64));
}

#[test]
#[cfg_attr(not(feature = "golden-networks"), ignore = "large; run with --features golden-networks")]
fn every_container_of_the_largest_networks_gives_the_same_tensors() {
    let base = recorded(|r| DepthAnythingV2::from_weights(DepthAnythingSize::Base, r).map(drop));
    check_containers(&base, 97_470_785 - 768 - 2 * (128 * 128 * 9 + 128));
    let large = recorded(|r| DepthAnythingV2::from_weights(DepthAnythingSize::Large, r).map(drop));
    check_containers(&large, 335_315_649 - 1024 - 2 * (256 * 256 * 9 + 256));
}

#[test]
fn nesting_and_prefixes_are_undone_and_other_tensors_left_alone() {
    let tensors = heads();
    let dir = tempfile::tempdir().unwrap();
    for nesting in [Nesting::Root, Nesting::Net, Nesting::Module] {
        for bytes in [zip_file(&tensors, nesting), legacy_file(&tensors, nesting)] {
            let checkpoint = open(dir.path(), &bytes).unwrap();
            let names: Vec<&str> = checkpoint.tensors().map(|(name, _)| name).collect();
            assert!(names.iter().copied().eq(tensors.keys().map(String::as_str)), "{nesting:?}: {names:?}");
            assert_eq!(checkpoint.unused().len(), tensors.len());
        }
    }
}

#[test]
fn missing_and_misshapen_tensors_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let mut tensors = heads();
    let load = |tensors: &Tensors| {
        let mut checkpoint = open(dir.path(), &zip_file(tensors, Nesting::Root)).unwrap();
        Lpips::from_weights(&mut StandIn, &mut checkpoint).map(|_| checkpoint.unused().join(","))
    };
    tensors.insert("spare".into(), (vec![2], vec![1.0, 2.0]));
    assert_eq!(load(&tensors).unwrap(), "spare");
    let third = tensors.remove("lin2.model.1.weight").unwrap();
    let message = load(&tensors).unwrap_err().to_string();
    assert!(message.contains("`lin2.model.1.weight` with shape [1, 384, 1, 1] is missing"), "{message}");
    tensors.insert("lin2.model.1.weight".into(), (vec![384, 1], third.1));
    let message = load(&tensors).unwrap_err().to_string();
    assert!(message.contains("has shape [384, 1], expected [1, 384, 1, 1]"), "{message}");
    let mut broken = heads();
    broken.get_mut("lin0.model.1.weight").unwrap().1[3] = f32::NAN;
    let message = load(&broken).unwrap_err().to_string();
    assert!(message.contains("`lin0.model.1.weight` holds NaN as value 3"), "{message}");
}

#[test]
fn files_that_are_no_checkpoints_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    for bytes in [&b""[..], b"PK\x03\x04", b"<html>not found</html>", &[0; 100], b"\x80\x02."] {
        assert!(matches!(open(dir.path(), bytes), Err(NetError::Damaged { .. })), "{bytes:?}");
    }
    assert!(matches!(Checkpoint::open(&dir.path().join("nothing")), Err(NetError::Read { .. })));
    assert!(Checkpoint::open(dir.path()).is_err());
}

#[test]
fn a_models_folder_gives_working_networks() {
    let dir = tempfile::tempdir().unwrap();
    let nu2net = recorded(|r| Nu2Net::from_weights(r).map(drop));
    std::fs::write(dir.path().join("NU2Net_ckpt.pth"), zip_file(&nu2net, Nesting::Net)).unwrap();
    let alexnet = recorded(|r| Lpips::from_weights(r, &mut StandIn).map(drop));
    std::fs::write(dir.path().join("alexnet-owt-7be5be79.safetensors"), safetensors_file(&alexnet)).unwrap();
    let models = Models::open(dir.path());
    assert!(models.has(Network::Nu2Net) && !models.has(Network::Nu2NetReleased));
    models.nu2net().unwrap();
    assert!(matches!(models.lpips(), Err(NetError::NotAvailable { network: "LPIPS 0.1 heads", .. })));
    std::fs::write(dir.path().join("alex.safetensors"), safetensors_file(&heads())).unwrap();
    models.lpips().unwrap();
    let status = models.status().unwrap();
    assert_eq!(status.iter().filter(|s| s.found.is_some()).count(), 3);
    assert!(status.iter().filter_map(|s| s.found.as_ref()).all(|f| f.verdict == DigestCheck::Unknown));
    let json = serde_json::to_string(&status).unwrap();
    assert!(json.contains("\"licence\":\"CC BY-NC 4.0\"") && json.contains("\"verdict\":\"unknown\""));
}

#[test]
fn a_file_that_cannot_serve_its_network_is_told_without_reading_its_values() {
    let dir = tempfile::tempdir().unwrap();
    let models = Models::open(dir.path());
    for (network, file, mut tensors) in [
        (Network::Nu2Net, "NU2Net_ckpt", recorded(|r| Nu2Net::from_weights(r).map(drop))),
        (Network::LpipsHeads, "alex", heads()),
        (
            Network::AlexNet,
            "alexnet-owt-7be5be79",
            recorded(|r| Lpips::from_weights(r, &mut StandIn).map(drop)),
        ),
        (Network::RaftLarge, "raft-things", recorded(|r| Raft::from_weights(r).map(drop))),
        (Network::URanker, "URanker_ckpt", recorded(|r| URanker::from_weights(r).map(drop))),
        (Network::Musiq, "musiq_koniq_ckpt-e95806b9", recorded(|r| Musiq::from_weights(r).map(drop))),
    ] {
        let path = dir.path().join(file).with_extension("safetensors");
        assert!(matches!(models.check(network), Err(NetError::NotAvailable { .. })), "{file}");
        std::fs::write(&path, safetensors_file(&tensors)).unwrap();
        models.check(network).unwrap_or_else(|e| panic!("{file}: {e}"));
        let last = tensors.keys().next_back().unwrap().clone();
        tensors.remove(&last);
        std::fs::write(&path, safetensors_file(&tensors)).unwrap();
        let message = models.check(network).unwrap_err().to_string();
        assert!(message.contains(&format!("`{last}`")) && message.contains("is missing"), "{message}");
        std::fs::write(&path, "no checkpoint").unwrap();
        assert!(matches!(models.check(network), Err(NetError::Damaged { .. })), "{file}");
    }
}

#[test]
fn princeton_files_of_raft_load_too() {
    let torchvision = recorded(|r| Raft::from_weights(r).map(drop));
    let princeton: Tensors = torchvision
        .iter()
        .map(|(name, tensor)| {
            let name = name
                .replace("feature_encoder", "fnet")
                .replace("context_encoder", "cnet")
                .replace("motion_encoder.", "encoder.")
                .replace("recurrent_block.", "gru.")
                .replace("mask_predictor.convrelu.0", "update_block.mask.0")
                .replace("mask_predictor.conv", "update_block.mask.2");
            let name = if name.contains("update_block.encoder") {
                name.replace("convcorr", "convc").replace("convflow", "convf").replace(".0.", ".")
            } else if name.contains("gru.") {
                let unit = if name.contains("convgru1") { "1" } else { "2" };
                let name = name.replace(&format!("convgru{unit}."), "");
                ["convz", "convr", "convq"].iter().fold(name, |n, g| n.replace(g, &format!("{g}{unit}")))
            } else {
                let mut name = name;
                for k in ["1", "2"] {
                    name = name.replace(&format!("convnormrelu{k}.0"), &format!("conv{k}"));
                    name = name.replace(&format!("convnormrelu{k}.1"), &format!("norm{k}"));
                }
                for encoder in ["fnet", "cnet"] {
                    name = name.replace(&format!("{encoder}.convnormrelu.0"), &format!("{encoder}.conv1"));
                    name = name.replace(&format!("{encoder}.convnormrelu.1"), &format!("{encoder}.norm1"));
                    name = name.replace(&format!("{encoder}.conv."), &format!("{encoder}.conv2."));
                }
                name
            };
            (name, tensor.clone())
        })
        .collect();
    assert!(
        princeton.contains_key("fnet.conv2.weight") && princeton.contains_key("update_block.gru.convz1.bias")
    );
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("raft-things.pth"), legacy_file(&princeton, Nesting::Module)).unwrap();
    let mut checkpoint = Models::open(dir.path()).checkpoint(Network::RaftLarge).unwrap();
    for (name, (shape, values)) in &torchvision {
        assert_eq!(checkpoint.tensor(name, shape).unwrap(), *values, "{name}");
    }
}

#[test]
fn an_archive_gives_all_tensors_beside_its_marker_and_the_words_at_the_top() {
    use use3d_golden::torch::{released_calibrator, released_calibrator_tensors};

    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("transition_calibrator.pth");
    let tensors = released_calibrator_tensors([16, 24]);
    let unneeded = |name: &str| name.contains("support_");
    let read = |most: usize| Archive::read(&file, "global_head.0.bias", &unneeded, most);
    std::fs::write(&file, released_calibrator(5, &tensors)).unwrap();
    let archive = read(1 << 20).unwrap();
    let expected: Tensors =
        tensors.iter().filter(|(n, _)| !unneeded(n)).map(|(n, t)| (n.clone(), t.clone())).collect();
    assert!(archive.tensors == expected, "{:?}", archive.tensors.keys());
    assert_eq!(archive.labels["schema"], "3duse_transition_calibrator");
    assert_eq!(archive.labels["schema_version"], "5");
    let message = read(1000).unwrap_err().to_string();
    assert!(message.contains("more than 1000 values"), "{message}");

    // At the root, in the older container, or as safetensors, the tensors are the same, and there is no text
    // about a schema.
    for bytes in [
        zip_file(&tensors, Nesting::Root),
        legacy_file(&tensors, Nesting::Module),
        safetensors_file(&tensors),
    ] {
        std::fs::write(&file, bytes).unwrap();
        let archive = read(1 << 20).unwrap();
        assert!(archive.tensors == expected && !archive.labels.contains_key("schema"));
    }
    std::fs::write(&file, zip_file(&heads(), Nesting::Root)).unwrap();
    let message = read(1 << 20).unwrap_err().to_string();
    assert!(message.contains("no tensor `global_head.0.bias`"), "{message}");
    std::fs::write(&file, b"no archive").unwrap();
    assert!(read(1 << 20).is_err());
}

/// The real heads of LPIPS, if a models folder is named.
#[test]
fn golden_real_lpips_heads() {
    let Some(dir) = std::env::var_os("USE3D_MODELS") else {
        println!("USE3D_MODELS is not set: the real LPIPS heads are NOT tested");
        return;
    };
    let models = Models::open(dir);
    if !models.has(Network::LpipsHeads) {
        println!("no LPIPS heads in {}: NOT tested", models.dir().display());
        return;
    }
    println!("testing the real LPIPS heads in {}", models.dir().display());
    let status = models.status().unwrap();
    let found = status.iter().find(|s| s.known.network == Network::LpipsHeads).unwrap();
    assert_eq!(found.found.as_ref().unwrap().verdict, DigestCheck::Official);
    let mut checkpoint = models.checkpoint(Network::LpipsHeads).unwrap();
    let largest = [49.21, 104.72, 132.36, 74.77, 41.31];
    for (i, (channels, largest)) in [64, 192, 384, 256, 256].into_iter().zip(largest).enumerate() {
        let name = format!("lin{i}.model.1.weight");
        let values = checkpoint.tensor(&name, &[1, channels, 1, 1]).unwrap();
        assert!(values.iter().all(|v| *v >= 0.0));
        let found = values.iter().copied().fold(0.0f32, f32::max);
        assert!((100.0 * found - largest).abs() < 5e-3, "{name}: {found}");
    }
    // The golden distance is computed with AlexNet by the stand-in rule and the real heads.
    let golden = use3d_golden::Part::load(&use3d_golden::root().join("networks/lpips_alex.safetensors"));
    let golden = golden.whole();
    let image = |name: &str| {
        let shape = golden.shape(name);
        use3d_capture::Image::from_planes(shape[3], shape[2], golden.f32(name)).unwrap()
    };
    let net = Lpips::from_weights(&mut StandIn, &mut checkpoint).unwrap();
    let distance = net.distance(&image("in0"), &image("in1")).unwrap();
    golden.check_within("out_real_lin", &[distance], 1e-6);
}
