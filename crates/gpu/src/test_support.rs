//! Helpers that device tests share.

use std::process::Command;

use glam::DVec3;
use use3d_capture::{Camera, Intrinsics, MediumMaps, Pose};
use use3d_numerics::random::{Purpose, Stream};
use use3d_splat::Gaussians;

use crate::device::Gpu;

/// Opens the software adapter, or the adapter that `USE3D_TEST_CARD` names, on a device of its own. Without
/// one the test is skipped with a message, or fails if `USE3D_REQUIRE_GPU=1`.
pub(crate) fn software() -> Option<Gpu> {
    let card = std::env::var("USE3D_TEST_CARD");
    match Gpu::open(Some(card.as_deref().unwrap_or("llvmpipe"))) {
        Ok(gpu) => Some(gpu),
        Err(error) => {
            let required = std::env::var_os("USE3D_REQUIRE_GPU").is_some_and(|v| v == "1");
            assert!(!required, "USE3D_REQUIRE_GPU is set: {error}");
            // Written past the test harness's capture, so that a skip is visible.
            use std::io::Write;
            let _ = writeln!(
                std::io::stderr(),
                "SKIPPED, no software adapter (package mesa-vulkan-drivers): {error}"
            );
            None
        }
    }
}

/// Runs one test of this program in a process of its own, with this number of threads for the adapter and
/// of bits in a vector. Returns true if it passed, and its output.
pub(crate) fn elsewhere(test: &str, threads: &str, vector_bits: &str) -> (bool, String) {
    let output = Command::new(std::env::current_exe().expect("this program"))
        .args(["--exact", "--nocapture", test])
        .env("LP_NUM_THREADS", threads)
        .env("LP_NATIVE_VECTOR_WIDTH", vector_bits)
        // The keys of the driver's shader cache do not contain the width.
        .env("MESA_SHADER_CACHE_DISABLE", "true")
        .output()
        .expect("it starts");
    (output.status.success(), String::from_utf8_lossy(&output.stdout).into_owned())
}

/// Checks that a test that prints a line `digest …` prints the same line on any number of threads, with
/// vectors of any width.
pub(crate) fn same_bits_elsewhere(test: &str) {
    let digest = |threads: &str, bits: &str| {
        let (_, text) = elsewhere(test, threads, bits);
        let line = text.lines().find(|line| line.starts_with("digest ")).map(str::to_string);
        line.unwrap_or_else(|| panic!("{threads} threads, {bits} bits: {text}"))
    };
    let expected = digest("1", "256");
    // Each process compiles all kernels anew, so both are changed at once.
    for (threads, bits) in [("2", "128"), ("3", "512")] {
        assert_eq!(digest(threads, bits), expected, "{threads} threads, {bits} bits");
    }
}

/// Random Gaussians in front of a camera at the origin, around a log scale and an opacity logit.
pub(crate) fn cloud(n: usize, log_scale: f32, logit: f32) -> Gaussians {
    let stream = Stream::new(11, Purpose::new("device tests"), 0);
    let mut gaussians = Gaussians::empty(3);
    for i in 0..n as u64 {
        let z = |k: u64| stream.normal(i * 64 + k) as f32;
        gaussians.means.push([z(0), z(1), 3.0 + 0.8 * z(2)]);
        gaussians.log_scales.push([log_scale + z(3), log_scale + z(4), log_scale + z(5)]);
        gaussians.quaternions.push([z(6), z(7), z(8), z(9)]);
        gaussians.opacity_logits.push(logit + 2.0 * z(10));
        gaussians
            .sh
            .push(std::array::from_fn(|k| std::array::from_fn(|c| 0.3 * z(11 + 3 * k as u64 + c as u64))));
    }
    gaussians
}

/// A camera at the origin that looks along z, slightly turned.
pub(crate) fn camera(width: usize, height: usize) -> Camera {
    let (w, h) = (width as f64, height as f64);
    let intrinsics = Intrinsics { width, height, fx: 0.9 * w, fy: 0.95 * w, cx: 0.48 * w, cy: 0.53 * h };
    let pose = Pose::look_at(DVec3::new(0.1, -0.2, -0.3), DVec3::new(0.05, 0.1, 3.0), -DVec3::Y);
    Camera { intrinsics, pose }
}

/// Water that changes from pixel to pixel.
pub(crate) fn water(width: usize, height: usize) -> MediumMaps {
    let mut maps = MediumMaps::zeros(width, height);
    let stream = Stream::new(12, Purpose::new("device tests"), 1);
    for (salt, map) in [&mut maps.color, &mut maps.backscatter, &mut maps.attenuation].into_iter().enumerate()
    {
        for (i, v) in map.data_mut().iter_mut().enumerate() {
            let slow = (i % width) as f32 / width as f32;
            *v = 0.1 + 0.3 * slow + 0.02 * stream.uniform((salt * 1_000_000 + i) as u64) as f32;
        }
    }
    maps
}

/// `‖a − b‖ / ‖b‖`.
pub(crate) fn relative(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len());
    let square = |v: f64| v * v;
    let off: f64 = a.iter().zip(b).map(|(a, b)| square(f64::from(*a) - f64::from(*b))).sum();
    let size: f64 = b.iter().map(|b| square(f64::from(*b))).sum();
    if off == 0.0 { 0.0 } else { (off / size).sqrt() }
}
