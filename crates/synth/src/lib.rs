//! A synthetic underwater capture with known truth: scene, water, cameras, pairs
