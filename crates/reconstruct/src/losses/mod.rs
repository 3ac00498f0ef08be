//! What stage 1 minimises, each term with its gradient.

mod depth;
mod photometric;

pub use depth::{DEPTH_SCALE, DepthPriorLoss, FEWEST_PIXELS};
pub use photometric::{PhotometricLoss, PhotometricValue};

#[cfg(test)]
mod tests;
