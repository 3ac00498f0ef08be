//! The identity of this program: its version, the commit it was built from, its features and engines.

/// The version alone.
pub(crate) const NUMBER: &str = env!("CARGO_PKG_VERSION");
/// The commit that it was built from, or `unknown`.
pub(crate) const COMMIT: &str = env!("USE3D_COMMIT");
/// The features that were chosen when it was built.
pub(crate) const FEATURES: &str = env!("USE3D_FEATURES");
/// The engines that can train and draw.
pub(crate) const ENGINES: &str = env!("USE3D_ENGINES");
/// The kind of machine that it was built for.
pub(crate) const TARGET: &str = env!("USE3D_TARGET");

/// The text of `use3d --version` after the program's name.
pub(crate) const WHOLE: &str = concat!(
    env!("CARGO_PKG_VERSION"),
    " (commit ",
    env!("USE3D_COMMIT"),
    ", ",
    env!("USE3D_TARGET"),
    ")\nfeatures: ",
    env!("USE3D_FEATURES"),
    "\nengines: ",
    env!("USE3D_ENGINES")
);
