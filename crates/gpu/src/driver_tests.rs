//! Tests with another driver in software, with the Khronos validation layer, and with another compiler. The
//! first two come with Debian's package `chromium-common`, the third with npm's `webgpu`. Without them a test
//! is skipped with a message.
//!
//! SwiftShader compiles kernels with another compiler, has subgroups of four, and binds ten storage buffers.
//! The layer finds missing barriers between dispatches, accesses beyond the end of a buffer, and races in the
//! memory of a workgroup; llvmpipe hides all of them, because it runs threads in order.

use std::path::{Path, PathBuf};
use std::process::Command;

use crate::device::Gpu;
use crate::twins::{self, SceneSize};

/// The folder of the package's libraries.
const CHROMIUM: &str = "/usr/lib/chromium";
/// The variable with the name of the adapter that the tests of this file open in processes of their own.
const ADAPTER: &str = "USE3D_TEST_ADAPTER";
/// An error in every kernel with workgroup memory that wgpu's compiler writes. It does no harm.
const HARMLESS: &str = "VUID-StandaloneSpirv-None-10684";

/// Says that a test is skipped, which fails in CI. Written past the test harness's capture.
fn skipped(why: &str) {
    assert!(std::env::var_os("CI").is_none(), "{why}");
    use std::io::Write;
    let _ = writeln!(std::io::stderr(), "SKIPPED: {why}");
}

fn library(name: &str) -> Option<PathBuf> {
    let path = Path::new(CHROMIUM).join(name);
    if path.is_file() {
        return Some(path);
    }
    skipped(&format!("there is no {} (package chromium-common)", path.display()));
    None
}

/// Runs a test of this file in a process of its own. Returns true if it passed, and its output.
fn elsewhere(test: &str, adapter: &str, variables: &[(&str, &Path)]) -> (bool, String) {
    let mut command = Command::new(std::env::current_exe().expect("this program"));
    command.args(["--exact", "--nocapture", "--ignored", test]).env(ADAPTER, adapter);
    command.envs(variables.iter().map(|(name, value)| (name, value.as_os_str())));
    let output = command.output().expect("it starts");
    let text = [output.stdout, output.stderr].concat();
    (output.status.success(), String::from_utf8_lossy(&text).into_owned())
}

fn adapter() -> Option<Gpu> {
    let name = std::env::var(ADAPTER).ok()?;
    Some(Gpu::open(Some(&name)).expect("the adapter of the test"))
}

#[test]
#[ignore = "not by itself: `swiftshader_passes_the_check_in_every_variant` runs it, with another driver"]
fn an_adapter_passes_its_check() {
    let Some(gpu) = adapter() else { return };
    for variant in gpu.variants() {
        crate::check(&gpu.clone().with(variant)).expect("the check");
        println!("\npassed: {} with {variant}.", gpu.adapter.name);
    }
}

#[test]
fn swiftshader_passes_the_check_in_every_variant() {
    let Some(driver) = library("vk_swiftshader_icd.json") else { return };
    let test = "driver_tests::an_adapter_passes_its_check";
    let (well, text) = elsewhere(test, "swiftshader", &[("VK_DRIVER_FILES", &driver)]);
    assert!(well && text.contains("with portable.") && text.contains("with subgroups of 4."), "{text}");
}

#[test]
#[ignore = "not by itself: the tests with the validation layer run it in a process of its own"]
fn small_work_is_done_in_every_variant() {
    let Some(gpu) = adapter() else { return };
    let scene = SceneSize { width: 48, height: 32, gaussians: 150, views: 1, seed: 1 };
    for variant in gpu.variants() {
        let mut engine = crate::stage1::Stage1::new(&gpu.clone().with(variant)).expect("an engine");
        let found = twins::step(&mut engine, &scene).expect("a step");
        assert!(found.iter().all(twins::Agreement::holds), "{found:?}");
        // Lists of more than 256 entries: loops over them run more than once.
        let deep = SceneSize { gaussians: 700, ..scene };
        let mut engine = crate::stage1::Stage1::new(&gpu.clone().with(variant)).expect("an engine");
        let found = twins::large_step(&mut engine, &deep, 330).expect("a step");
        assert!(found.iter().all(twins::Agreement::holds), "{found:?}");
    }
    let further = [twins::pictures(&gpu, &scene), twins::field(&gpu, &scene)];
    for found in further.into_iter().flat_map(|found| found.expect("pictures and a field")) {
        assert!(found.holds(), "{found:?}");
    }
}

/// The layer's folder and settings, in a folder that is removed afterwards.
struct LayerFolder(PathBuf);

impl LayerFolder {
    fn new(layer: &Path, settings: &[&str]) -> Self {
        let name = format!("use3d-layer-{}-{}", std::process::id(), settings.len());
        let folder = std::env::temp_dir().join(name);
        std::fs::create_dir_all(&folder).expect("a folder");
        let manifest = serde_json::json!({
            "file_format_version": "1.2.0",
            "layer": {
                "name": "VK_LAYER_KHRONOS_validation",
                "type": "GLOBAL",
                "library_path": layer,
                "api_version": "1.3.0",
                "implementation_version": "1",
                "description": "validation"
            }
        });
        std::fs::write(folder.join("layer.json"), manifest.to_string()).expect("a manifest");
        let log = format!("log_filename = {}", folder.join("log.txt").display());
        let common = ["debug_action = VK_DBG_LAYER_ACTION_LOG_MSG", "report_flags = error", &log];
        let lines = common.iter().chain(settings).map(|line| format!("khronos_validation.{line}\n"));
        std::fs::write(folder.join("vk_layer_settings.txt"), lines.collect::<String>()).expect("settings");
        Self(folder)
    }

    /// The layer's errors, without the one that does no harm.
    fn errors(&self) -> Vec<String> {
        let text = std::fs::read_to_string(self.0.join("log.txt")).unwrap_or_default();
        text.lines()
            .filter(|line| line.contains("Validation Error: ["))
            .filter(|line| !line.contains(HARMLESS))
            .map(str::to_string)
            .collect()
    }
}

impl Drop for LayerFolder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

fn validated(settings: &[&str]) {
    let Some(layer) = library("libVkLayer_khronos_validation.so") else { return };
    let folder = LayerFolder::new(&layer, settings);
    let test = "driver_tests::small_work_is_done_in_every_variant";
    let variables = [
        ("VK_LAYER_PATH", &*folder.0),
        ("VK_INSTANCE_LAYERS", Path::new("VK_LAYER_KHRONOS_validation")),
        ("VK_LAYER_SETTINGS_PATH", &folder.0),
    ];
    let (well, text) = elsewhere(test, "llvmpipe", &variables);
    let errors = folder.errors();
    // The harmless error shows that the layer was there.
    let log = std::fs::read_to_string(folder.0.join("log.txt")).unwrap_or_default();
    assert!(well && log.contains(HARMLESS), "{text}");
    assert!(errors.is_empty(), "{errors:#?}");
}

#[test]
fn no_barrier_is_missing_between_dispatches() {
    validated(&["validate_core = true", "validate_sync = true"]);
}

#[test]
fn no_kernel_leaves_its_buffers_or_races_in_the_memory_of_a_workgroup() {
    validated(&[
        "gpuav_enable = true",
        "gpuav_shared_memory_data_race = true",
        "gpuav_shader_sanitizer = true",
        "validate_core = true",
    ]);
}

/// Tint, the compiler of Chrome, reads the texts by another implementation of the language. It refuses a
/// barrier that some threads of a workgroup may not reach.
#[test]
fn tint_accepts_every_text() {
    let tools = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/tint");
    if !tools.join("node_modules/webgpu").is_dir() {
        return skipped(&format!("`npm ci` was not run in {}", tools.display()));
    }
    let folder = std::env::temp_dir().join(format!("use3d-kernels-{}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("a folder");
    for (at, (_, text)) in crate::kernel_texts().iter().enumerate() {
        std::fs::write(folder.join(format!("{at:03}.wgsl")), text).expect("a text");
    }
    let output = Command::new("node").arg(tools.join("check.mjs")).arg(&folder).output().expect("node");
    let _ = std::fs::remove_dir_all(&folder);
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
}

const BARRIER: &str = "workgroupBarrier();";
/// The variable by which a test removes a barrier: the number of a part of the kernels' texts, and of a
/// barrier in it.
const REMOVED: &str = "USE3D_TEST_REMOVED_BARRIER";

/// The variable with the numbers of the parts whose barriers are removed, as in `3,17`; without it, all are.
const PARTS: &str = "USE3D_TEST_REMOVED_PARTS";

/// The parts of the kernels' texts that have barriers, each once.
fn parts_with_barriers() -> Vec<&'static str> {
    let mut all: Vec<&'static str> = crate::specs().into_iter().flat_map(|spec| spec.parts).collect();
    all.retain(|part| part.contains(BARRIER));
    all.sort_unstable();
    all.dedup();
    all
}

/// A part of a kernel's text, without the barrier that a test removes.
pub(crate) fn without_barrier(part: &'static str) -> std::borrow::Cow<'static, str> {
    let Ok(removed) = std::env::var(REMOVED) else { return part.into() };
    let (at, number) = removed.split_once(':').expect("two numbers");
    let [at, number] = [at, number].map(|text| text.parse::<usize>().expect("a number"));
    if parts_with_barriers().get(at) != Some(&part) {
        return part.into();
    }
    let pieces: Vec<&str> = part.split(BARRIER).collect();
    let barrier = |piece: usize| if piece == number { "" } else { BARRIER };
    let text: String = pieces
        .iter()
        .enumerate()
        .map(|(k, piece)| format!("{}{piece}", if k == 0 { "" } else { barrier(k - 1) }))
        .collect();
    text.into()
}

#[test]
fn a_barrier_is_removed_from_one_part_alone() {
    let parts = parts_with_barriers();
    let count = |part: &str| part.matches(BARRIER).count();
    assert!(parts.len() >= 15 && parts.iter().map(|part| count(part)).sum::<usize>() >= 40);
    assert!(parts.iter().all(|part| *part == without_barrier(part)));
}

/// Removes every barrier in turn, does small work with the layer's test for races, and prints which removals
/// are noticed. This takes half an hour on two cores. Barriers whose removal nothing notices are listed in
/// `docs/science/gpu.md`.
#[test]
#[ignore = "a measurement of half an hour, not a check: its result stands in docs/science/gpu.md"]
fn removed_barriers_are_noticed() {
    let Some(layer) = library("libVkLayer_khronos_validation.so") else { return };
    let test = "driver_tests::small_work_is_done_in_every_variant";
    for (at, part) in parts_with_barriers().into_iter().enumerate() {
        if std::env::var(PARTS).is_ok_and(|parts| parts.split(',').all(|part| part != at.to_string())) {
            continue;
        }
        let first = part.lines().next().unwrap_or_default();
        for number in 0..part.matches(BARRIER).count() {
            let folder =
                LayerFolder::new(&layer, &["gpuav_enable = true", "gpuav_shared_memory_data_race = true"]);
            let removed = PathBuf::from(format!("{at}:{number}"));
            let variables = [
                ("VK_LAYER_PATH", &*folder.0),
                ("VK_INSTANCE_LAYERS", Path::new("VK_LAYER_KHRONOS_validation")),
                ("VK_LAYER_SETTINGS_PATH", &folder.0),
                (REMOVED, &removed),
            ];
            let (well, _) = elsewhere(test, "llvmpipe", &variables);
            let said = if !folder.errors().is_empty() {
                "race reported"
            } else if !well {
                "wrong result"
            } else {
                "NOT noticed"
            };
            println!("{said:<14} {at}:{number} {first}");
        }
    }
}
