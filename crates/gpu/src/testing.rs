//! What device tests share.

use crate::device::Gpu;

/// The software adapter, on a device of its own. Without one the test is left out, aloud; an error where `USE3D_REQUIRE_GPU=1`.
pub(crate) fn software() -> Option<Gpu> {
    match Gpu::open(Some("llvmpipe")) {
        Ok(gpu) => Some(gpu),
        Err(error) => {
            let required = std::env::var_os("USE3D_REQUIRE_GPU").is_some_and(|v| v == "1");
            assert!(!required, "USE3D_REQUIRE_GPU is set: {error}");
            // Past the test harness's capture, so that a skip is seen.
            use std::io::Write;
            let _ = writeln!(
                std::io::stderr(),
                "SKIPPED, no software adapter (package mesa-vulkan-drivers): {error}"
            );
            None
        }
    }
}
