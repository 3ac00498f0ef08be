//! Triangle meshes, a tree to cast rays into them, and the noise that shapes and colours them.

pub(crate) mod bvh;
pub(crate) mod mesh;
pub(crate) mod noise;
