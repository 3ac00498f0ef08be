//! Functions that several tests of this crate share.

/// Returns true if vector code fuses multiply and add here, as the scalar twins always do.
pub(crate) fn fuses() -> bool {
    #[cfg(target_arch = "x86_64")]
    return std::arch::is_x86_feature_detected!("fma");
    #[cfg(not(target_arch = "x86_64"))]
    return cfg!(target_arch = "aarch64");
}
