//! The `use3d` command: arguments, progress, error texts. Nothing else.
fn main() {}
