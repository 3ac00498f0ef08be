//! The scene folder: Gaussians, medium and enhancement on disk
