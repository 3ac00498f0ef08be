//! Appearance Transition Consensus: extractor, proposers, calibrator, scene-global and Gaussian-local targets
